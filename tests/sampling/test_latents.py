"""Latents drawn for each posterior draw of impedance and hyperparameters."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bayes_impedance.engines.given_impedance import LATENTS
from bayes_impedance.impedance_functions.density import Designs
from bayes_impedance.impedance_functions.function import choose_inducing
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.sampling.density import JointDensity
from bayes_impedance.sampling.density import weights as weights_of
from bayes_impedance.sampling.latents import draw_latents
from tests.engines.given import NO_RESIDUAL, OVER_TIME, given_problem

MAP = ("engine.impedance=map", "engine.inducing=5")
SE = ("model.desired_trajectory.kernel=squared_exponential",)
VARYING = ("model.stiffness.log_sd.fixed=false", "model.stiffness.length_scale.phase.fixed=false")
CASES = {
    "markov": (OVER_TIME, ("x", "y"), "markov"),
    "markov, coupled, length scales": ((*OVER_TIME, *VARYING, "model.axes=coupled"), ("x", "y"), "markov"),
    "lowrank": ((*SE, *NO_RESIDUAL, "engine.name=lowrank"), ("x",), "lowrank"),
    "dense": ((*SE, *NO_RESIDUAL, "engine.name=dense"), ("x",), "dense"),
}


def density_of(case, **settings):
    overrides, axes, engine = CASES[case]
    settings = {"repetitions": 2, "rate": 7.0, "groups": 2, **settings}
    given = given_problem("phase", (*MAP, *overrides), axes, **settings)
    inducing = choose_inducing(given.config, given.model, given.features)
    density = JointDensity(given.config, given.model, given.features, inducing)
    assert density.engine_choice.name == engine
    return density


def coordinates(density, count, seed=0):
    return 0.5 * np.random.default_rng(seed).standard_normal((count, density.size))


def without_force(features):
    """The same samples as where something is to be predicted."""
    return replace(features, force=None, inputs=features.inputs.clone())


def valid(features):
    return torch.ones(features.inputs.shape[1:3]).bool() if features.valid is None else features.valid


@pytest.mark.parametrize("case", CASES)
def test_impedance_is_that_of_the_draw_and_force_has_noise_of_its_own(case):
    density = density_of(case, rate=20.0)
    target, standard = without_force(density.features), coordinates(density, 12)
    drawn = draw_latents(density, standard, target, seed=1)
    axes, groups, m = target.inputs.shape[:3]
    assert set(drawn) == {*LATENTS, *IMPEDANCE_ORDER}
    errors = torch.cat(
        density.processes(density.values(torch.zeros(density.size, dtype=torch.float64))).layout.errors(
            target.inputs, order=2
        ),
        dim=-1,
    )
    hand = (target.trajectory_mean - errors).numpy()
    noise = []
    for i, row in enumerate(torch.from_numpy(standard)):
        values = density.values(row)
        with torch.no_grad():
            impedance = density.impedance(values).numpy()
            noise_sd = density.processes(values).noise_variance.sqrt().numpy()
        for latent, j in IMPEDANCE_ORDER.items():
            assert drawn[latent].shape == (12, groups, m, axes, axes)
            np.testing.assert_allclose(drawn[latent][i], impedance[:, :, j], rtol=1e-12)
        desired = np.stack([drawn[latent][i] for latent in LATENTS[1:4]], axis=-1)
        force = np.einsum("gnjab,bgnj->agn", impedance, desired - hand) + drawn[Latent.RESIDUAL_FORCE][i]
        noise.append(((drawn[Latent.FORCE][i] - force) / noise_sd)[:, valid(target).numpy()])
    noise = np.stack(noise).ravel()
    assert abs(noise.mean()) < 4.0 / len(noise) ** 0.5
    assert abs(noise.var() - 1.0) < 4.0 * (2.0 / len(noise)) ** 0.5
    # White within draws, and not the same in each.
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 4.0 / len(noise) ** 0.5
    assert len(np.unique(noise)) == len(noise)


@pytest.mark.parametrize("case", CASES)
def test_draws_at_one_point_have_the_moments_of_the_posterior_there(case):
    density = density_of(case)
    target, count = without_force(density.features), 150 if case == "dense" else 300
    point = coordinates(density, 1)
    drawn = draw_latents(density, point.repeat(count, axis=0), target, seed=0)
    values = density.values(torch.from_numpy(point[0]))
    with torch.no_grad():
        impedance, processes = density.impedance(values), density.processes(values)
        expected = density.engine.posterior(processes, impedance, target, impedance)
        keep = valid(target).numpy()
        for latent, (mean, variance) in expected.items():
            if latent is Latent.RESIDUAL_FORCE and not processes.residual:
                assert not drawn[latent].any()
                continue
            if latent is Latent.FORCE:
                variance = variance + processes.noise_variance
            mean, variance = mean.numpy()[:, keep], variance.numpy()[:, keep]
            sample = drawn[latent][:, :, keep]
            error = (sample.mean(0) - mean) / np.sqrt(variance / count)
            ratio = (sample.var(0, ddof=1) / variance - 1.0) / (2.0 / count) ** 0.5
            assert abs(error).max() < 4.5, latent
            assert abs(ratio).max() < 5.0, latent


@pytest.mark.parametrize("case", CASES)
def test_a_draw_depends_on_its_row_its_number_and_the_seed(case):
    density = density_of(case)
    target, standard = without_force(density.features), coordinates(density, 5)
    first, again, fewer, other = (
        draw_latents(density, rows, target, seed)
        for rows, seed in ((standard, 2), (standard, 2), (standard[:2], 2), (standard, 3))
    )
    for latent in first:
        np.testing.assert_array_equal(first[latent], again[latent])
        np.testing.assert_array_equal(first[latent][:2], fewer[latent])
    assert (first[Latent.FORCE] != other[Latent.FORCE])[:, :, valid(target).numpy()].all()
    np.testing.assert_array_equal(first[Latent.STIFFNESS], other[Latent.STIFFNESS])


def test_impedance_elsewhere_is_that_of_the_functions():
    density = density_of("markov, coupled, length scales")
    features = density.features
    inputs = features.inputs.clone()
    phase = inputs[
        ..., density.processes(density.values(torch.zeros(density.size, dtype=torch.float64))).layout.theta[0]
    ].clone()
    same = [column for column in range(inputs.shape[-1]) if torch.equal(inputs[..., column], phase)]
    assert len(same) == 2
    inputs[..., same] += 0.01
    target = replace(features, force=None, inputs=inputs)
    standard = coordinates(density, 3)
    drawn = draw_latents(density, standard, target, seed=0)
    for i, row in enumerate(torch.from_numpy(standard)):
        values = density.values(row)
        functions = density.functions(values)
        with torch.no_grad():
            expected = Designs.at(functions, inputs).matrices(weights_of(values)).numpy()
        for latent, j in IMPEDANCE_ORDER.items():
            np.testing.assert_allclose(drawn[latent][i], expected[:, :, j], rtol=1e-12)
    here = draw_latents(density, standard, without_force(features), seed=0)
    assert (drawn[Latent.STIFFNESS] != here[Latent.STIFFNESS]).any()


def test_progress_counts_draws():
    density = density_of("lowrank")
    seen = []
    draw_latents(density, coordinates(density, 3), density.features, 0, lambda *done: seen.append(done))
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_no_draws_are_no_latents():
    density = density_of("lowrank")
    drawn = draw_latents(density, np.zeros((0, density.size)), density.features, 0)
    assert drawn[Latent.FORCE].shape == (0, *density.features.inputs.shape[:3])
