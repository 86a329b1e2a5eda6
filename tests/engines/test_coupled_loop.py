"""The Jacobian of the closed loop where axes are coupled: draws, independent axes where nothing couples, the loop."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from coupled_oracle import CoupledOracle, directions, scatter_hyperparameters
from oracles import configuration

from bayes_impedance.config import Config, parse_config
from bayes_impedance.engines.closed_loop import jacobian
from bayes_impedance.engines.coupled_loop import ApparentMassMatrix, matrix_jacobian
from bayes_impedance.features import FeatureMap, Features
from bayes_impedance.kernels import Latent
from bayes_impedance.posterior import compute_posterior
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import ForceModel, build_force_model
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from bayes_impedance.training import log_evidence, objective, observations
from bayes_impedance.trajectory_mean import TrajectoryMean

DEVICE = {"mass": {"x": 2.0, "y": 3.0, "z": 2.5}, "damping": {"x": 6.0, "y": 4.0, "z": 5.0}}
MASSES = torch.tensor([2.0, 3.0], dtype=torch.float64)


def spread_matrix(axes: int, scale: float, seed: int = 0) -> torch.Tensor:
    """A covariance of vec Z, `(1, axes², axes²)`."""
    root = torch.randn(axes**2, axes**2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (scale**2 * root @ root.mT / axes**2).unsqueeze(0)


@pytest.mark.parametrize("count", [5.0, 40.0])
def test_laplace_is_close_to_the_average_over_draws(count: float) -> None:
    mean = torch.tensor([[1.4, -0.4, -0.4, 1.1]], dtype=torch.float64)
    covariance = spread_matrix(2, 0.15)
    found = matrix_jacobian(mean, covariance, torch.tensor([count], dtype=torch.float64), MASSES)
    generator = np.random.default_rng(1)
    drawn = generator.multivariate_normal(mean[0].numpy(), covariance[0].numpy(), size=400_000).reshape(
        -1, 2, 2
    )
    log = count * np.linalg.slogdet(np.eye(2) + drawn / MASSES.numpy())[1]
    weights = np.exp(log - log.max())
    expected = log.max() + math.log(weights.mean())
    error = weights.std() / weights.mean() / math.sqrt(len(weights))
    # What Laplace leaves out is of the order of skewness squared: n s³ / (M_r + z)³, squared.
    assert float(found.log_expectation) == pytest.approx(expected, abs=5.0 * error + 0.01)
    weights /= weights.sum()
    np.testing.assert_allclose(found.mode[0].numpy(), np.tensordot(weights, drawn, 1), atol=0.02)


def test_diagonal_matrices_are_one_axis_at_a_time() -> None:
    mean, variance = (
        torch.tensor([1.2, -2.5], dtype=torch.float64),
        torch.tensor([0.1, 0.4], dtype=torch.float64),
    )
    count = torch.tensor([60.0], dtype=torch.float64)
    vector = torch.diag(mean).reshape(1, 4)
    covariance = torch.diag(torch.tensor([0.1, 0.0, 0.0, 0.4], dtype=torch.float64)).unsqueeze(0)
    found = matrix_jacobian(vector, covariance, count, MASSES)
    expected = jacobian(mean, variance, count, MASSES)
    torch.testing.assert_close(
        found.log_expectation, expected.log_expectation.sum(0, keepdim=True), rtol=1e-10, atol=0
    )
    torch.testing.assert_close(found.mode[0].diagonal(), expected.mode, rtol=1e-10, atol=0)
    # Nothing is known against the entries beside the diagonal, which have no variance.
    assert float(found.mode[0, 0, 1].abs()) < 1e-15


def test_gradients_of_the_laplace_approximation() -> None:
    count = torch.tensor([30.0, 50.0], dtype=torch.float64)
    mean = torch.tensor(
        [[1.4, -0.4, -0.3, 1.1], [0.8, 0.2, 0.1, -2.0]], dtype=torch.float64, requires_grad=True
    )
    root = torch.cat([spread_matrix(2, 0.3, seed) for seed in (0, 1)]).requires_grad_(True)
    torch.autograd.gradcheck(
        lambda m, r: matrix_jacobian(m, r @ r.mT, count, MASSES).log_expectation, (mean, root), atol=1e-6
    )


# --- in a model ----------------------------------------------------------------------------------


def looped(**model: object) -> Config:
    return parse_config(configuration(**model).model_dump(mode="json") | {"device": DEVICE})


def drawn(config: Config, rate: float) -> PreparedLog:
    """Two groups of unequal length, so that one is padded."""
    trials = [
        trial
        for group, repetitions in (("a", 2), ("b", 1))
        for trial in repeated_motion(repetitions, 2.0, rate, seed=repetitions, group=group).trials
    ]
    return draw_force(config, PreparedLog(("x", "y"), tuple(trials)), seed=4)


def problem(config: Config, log: PreparedLog) -> tuple[Features, ForceModel]:
    feature_map = FeatureMap(config, log.axes)
    features = feature_map(log, TrajectoryMean.from_training(config.model.desired_trajectory, log))
    return features, build_force_model(config, feature_map)


KNOWN_MASS = {"level": 1.2, "sd": 1e-9, "coupling": 1e-30}
UNCOUPLED = {
    "stiffness": {"level": {"median": 100}, "log_sd": 0.3, "input": ["position"], "coupling": 1e-30},
    "damping": {"level": {"median": 9}, "log_sd": 0.4, "input": ["position"], "coupling": 1e-30},
    "mass": KNOWN_MASS,
}


def test_without_coupling_the_loop_is_that_of_independent_axes() -> None:
    """Objective, gradient and posteriors; the mass is known, for it is log-normal in one and normal in the other."""
    found = {}
    log = drawn(looped(**UNCOUPLED), rate=8.0)
    for axes in ("independent", "coupled"):
        features, model = problem(looped(axes=axes, **UNCOUPLED), log)
        assert features.loop is not None
        assert features.valid is not None
        likelihood = objective(model, features, 0.0)[1]
        likelihood.sum().backward()
        gradients = {entry.name: entry.raw.grad for entry in model.entries if entry.raw.grad is not None}
        posterior = compute_posterior(model, log, features, features, 0.0)
        without = log_evidence(model, Features(**{**vars(features), "loop": None}), 0.0).sum()
        found[axes] = (float(likelihood.sum().detach()), gradients, posterior, float(without.detach()))
    one, two = found["independent"], found["coupled"]
    assert two[0] == pytest.approx(one[0], rel=1e-9)
    # The loop has its say.
    assert abs(one[0] - one[3]) > 1.0
    for name, gradient in one[1].items():
        torch.testing.assert_close(two[1][name], gradient, rtol=1e-6, atol=1e-6)
    for latent in Latent:
        if latent is not Latent.MASS:
            for part in ("location", "scale", "prior_location", "prior_scale"):
                np.testing.assert_allclose(
                    getattr(two[2][latent], part), getattr(one[2][latent], part), rtol=1e-6, atol=1e-8
                )


@torch.no_grad()
@pytest.mark.parametrize("axes", [("x", "y"), ("x", "y", "z")])
def test_moments_of_the_apparent_mass_are_those_of_drawn_terms(axes: tuple[str, ...]) -> None:
    config = looped(axes="coupled", damping={"level": 9, "log_sd": 0.3, "input": ["position"]})
    log = draw_force(
        config, repeated_motion(repetitions=2, duration=2.0, rate=1.0, axes=axes, seed=2), seed=0
    )
    features, model = problem(config, log)
    scatter_hyperparameters(model)
    given = observations(model, features)
    assert features.loop is not None
    apparent = ApparentMassMatrix(model.kernel.impedance, given, features.loop)
    draws = 120_000
    force, logarithms, _ = CoupledOracle(config, log, model).draw(draws, seed=3)
    dyads = np.stack([np.outer(a, a) for a in directions(len(axes))])
    damping, mass = (np.einsum("dnr,rab->dnab", np.exp(g), dyads) for g in logarithms[1:])
    half = 0.5 * float(features.loop.step[0])
    device = [np.array([DEVICE[key][axis] for axis in axes]) for key in ("mass", "damping")]
    share = 1.0 - half * device[1] / device[0]
    z = (mass[:, 0] * share + half * damping.mean(1)).reshape(draws, -1)

    def compare(one: np.ndarray, value: torch.Tensor) -> None:
        one = one.reshape(draws, -1) - one.reshape(draws, -1).mean(0)
        two = z - z.mean(0)
        product = one.T @ two / draws
        error = np.sqrt(((one**2).T @ two**2 / draws - product**2) / draws)
        assert np.all(np.abs(product - value.numpy()) < 5.0 * error)

    assert np.all(np.abs(z.mean(0) - apparent.mean[0].numpy()) < 5.0 * z.std(0) / math.sqrt(draws))
    compare(z, apparent.covariance[0])
    compare(force, apparent.force_covariance(given.inputs)[0])
    for order in (0, 1, 2):
        compare(logarithms[order], apparent.term_covariance(given.inputs, order)[0].flatten(0, 1))
    # ∂E[Z]/∂ log level of a term is its share of the mean.
    torch.testing.assert_close(apparent.loading.sum(-1), apparent.mean, rtol=1e-12, atol=1e-15)


def test_gradient_of_the_likelihood_with_the_loop() -> None:
    config = looped(axes="coupled")
    features, model = problem(config, drawn(config, rate=4.0))
    scatter_hyperparameters(model)
    parameters = [entry.raw.requires_grad_(True) for entry in model.entries]
    gradients = torch.autograd.grad(log_evidence(model, features, 0.0).sum(), parameters)
    with torch.no_grad():
        for raw, gradient in zip(parameters, gradients, strict=True):
            flat = raw.view(-1)
            for i in range(len(flat)):
                values = []
                for step in (1e-5, -1e-5):
                    flat[i] += step
                    values.append(float(log_evidence(model, features, 0.0)))
                    flat[i] -= step
                expected = (values[0] - values[1]) / 2e-5
                assert float(gradient.view(-1)[i]) == pytest.approx(expected, rel=1e-4, abs=1e-4)
