"""Coupled axes from end to end: what they are without coupling, what training recovers, posteriors, files, refusals."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from coupled_oracle import scatter_hyperparameters
from oracles import configuration

from bayes_impedance import sensitivity
from bayes_impedance.baselines.naive import NaiveModel
from bayes_impedance.config import load_config, parse_config
from bayes_impedance.errors import ConfigurationError, TooManySamplesError
from bayes_impedance.evaluation.cross_validation import cross_validate
from bayes_impedance.evaluation.held_out import evaluate
from bayes_impedance.features import FeatureMap
from bayes_impedance.identifiability import off_diagonals, summarise
from bayes_impedance.journal import open_journal
from bayes_impedance.kernels import ImpedanceProcess, Latent, StationaryKernel
from bayes_impedance.kernels.coupled import join_axes
from bayes_impedance.kernels.coupled_terms import term_directions
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.persistence import load_model, save_model
from bayes_impedance.posterior import Posterior, compute_posterior, draw_matrices, matrix_marginals
from bayes_impedance.posterior.terms import LogTerms
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import ForceModel, build_force_model
from bayes_impedance.simulation.generative import as_recording, draw_force, repeated_motion
from bayes_impedance.training import objective, observations
from bayes_impedance.trajectory_mean import TrajectoryMean
from bayes_impedance.writer import write_log
from conftest import TINY, Outcome

#: A known desired trajectory and little else, so that a short log says much.
CLEAR = {
    "trajectory_input": "phase",
    "desired_trajectory": {"mean": "reference", "sd": 0.004, "length_scale": {"phase": 0.15}},
    "stiffness": {"level": {"median": 250, "log_sd": 1.0}, "log_sd": 0.2, "input": ["phase"]},
    "damping": {"level": {"median": 15, "log_sd": 1.0}, "log_sd": 0.2, "input": ["phase"]},
    "mass": {"level": {"median": 1.4, "log_sd": 0.7}, "sd": 0.2},
    "residual": None,
    "noise_sd": {"median": 0.1, "log_sd": 1.0},
}


def clear(*overrides: str) -> ImpedanceModel:
    return ImpedanceModel(parse_config({"model": {"axes": "coupled", **CLEAR}}, overrides=overrides))


def motion(axes: tuple[str, ...] = ("x", "y"), repetitions: int = 3, rate: float = 10.0) -> PreparedLog:
    return repeated_motion(repetitions, duration=3.0, rate=rate, axes=axes, seed=5)


def coupled_log(
    model: ImpedanceModel, plus: float, minus: float, axes: tuple[str, ...] = ("x", "y")
) -> PreparedLog:
    """Force drawn with the couplings `plus` of (1, 1)/√2 and `minus` of (1, −1)/√2 in K, D and M alike."""
    truth = model.force_model(axes)
    for process in truth.kernel.impedance.processes:
        pairs = len(process.shares) - len(axes)
        signs = torch.tensor([plus, minus] * (pairs // 2), dtype=torch.float64)
        process.coupling = signs.reshape(-1, 1, 1, 1)
    return draw_force(model.config, motion(axes), 0, truth)


def features_of(config, log: PreparedLog):
    feature_map = FeatureMap(config, log.axes)
    mean = TrajectoryMean.from_training(config.model.desired_trajectory, log)
    return feature_map, feature_map(log, mean, observed=True)


# --- without coupling ----------------------------------------------------------------------------

UNCOUPLED = [f"model.{name}.coupling=1e-30" for name in ("stiffness", "damping", "mass")]
CASES = [
    ("phase", ["model.desired_trajectory.mean=reference"]),
    ("position_velocity", []),
    (
        "time",
        ["model.desired_trajectory.mean=reference", "shared.residual=true", "model.residual.offset_sd=0.5"],
    ),
]


def without_coupling(
    name: str, overrides: list[str], *more: str
) -> tuple[PreparedLog, list[ForceModel], list]:
    """A log, and the independent and the coupled model of it, with values of their own for every axis."""
    log, models, features = None, [], []
    for axes in ("independent", "coupled"):
        extra = UNCOUPLED if axes == "coupled" else []
        config = load_config(name, [*overrides, *extra, *more, f"model.axes={axes}"])
        if log is None:
            log = draw_force(config, motion(repetitions=2), seed=1)
        feature_map, its = features_of(config, log)
        features.append(its)
        models.append(build_force_model(config, feature_map))
    scatter_hyperparameters(models[0])
    values = {entry.name: entry.raw.detach() for entry in models[0].entries}
    for entry in models[1].entries:
        if entry.name in values:
            with torch.no_grad():
                entry.raw.copy_(values[entry.name])
    return log, models, features


@pytest.mark.parametrize(("name", "overrides"), CASES)
def test_without_coupling_objective_and_gradient_are_those_of_independent_axes(
    name: str, overrides: list[str]
) -> None:
    # So sure a mass is log-normal and normal alike.
    _, (independent, coupled), features = without_coupling(name, overrides, "model.mass.sd=1e-9")
    for model in (independent, coupled):
        objective(model, features[model is coupled], 0.0)[1].sum().backward()
    values = [objective(m, f, 0.0)[1].detach() for m, f in zip((independent, coupled), features, strict=True)]
    assert values[1].shape == (1,)
    torch.testing.assert_close(values[1][0], values[0].sum(), rtol=1e-10, atol=0)
    ours = {entry.name: entry.raw.grad for entry in coupled.entries if entry.raw.requires_grad}
    for entry in independent.entries:
        if entry.raw.requires_grad:
            torch.testing.assert_close(ours[entry.name], entry.raw.grad, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("name", "overrides"), CASES)
def test_without_coupling_posteriors_are_those_of_independent_axes(name: str, overrides: list[str]) -> None:
    log, (independent, coupled), features = without_coupling(name, overrides)
    # The same log-normal mass in both.
    process = coupled.kernel.impedance.mass
    mass = ImpedanceProcess(
        StationaryKernel(num_dims=0, batch_shape=torch.Size([2, 1])), batch_shape=torch.Size([2, 1])
    )
    mass = mass.double()
    with torch.no_grad():
        mass.level = process.level
        mass.covariance.sd = torch.log1p((process.covariance.sd / process.level).square()).sqrt()
    independent.kernel.impedance.mass = mass
    one, two = (
        compute_posterior(model, log, f, f, 1e-10)
        for model, f in zip((independent, coupled), features, strict=True)
    )
    for latent in Latent:
        assert two[latent].warped == one[latent].warped
        for part in ("location", "scale", "prior_location", "prior_scale"):
            np.testing.assert_allclose(
                getattr(two[latent], part),
                getattr(one[latent], part),
                rtol=1e-6,
                atol=1e-8,
                err_msg=f"{latent} {part}",
            )
    for latent in IMPEDANCE_ORDER:
        assert np.abs(two.couplings[latent].mean).max() < 1e-20


# --- drawn data ----------------------------------------------------------------------------------


@pytest.mark.parametrize("axes", [("x", "y"), ("x", "y", "z")], ids=len)
def test_drawn_force_is_the_product_of_drawn_matrices(axes: tuple[str, ...]) -> None:
    model = clear("model.noise_sd=1e-12")
    log = coupled_log(model, 0.7, 0.1, axes)
    for trial in log.trials:
        hand = (trial.position, trial.velocity, trial.acceleration)
        names = ("desired_position", "desired_velocity", "desired_acceleration")
        force = np.zeros_like(trial.position)
        for quantity, desired, actual in zip(("stiffness", "damping", "mass"), names, hand, strict=True):
            matrices = np.empty((len(trial.time), len(axes), len(axes)))
            for a, one in enumerate(axes):
                for b, two in enumerate(axes):
                    matrices[:, a, b] = trial.truth[f"{quantity}_{min(one, two)}{max(one, two)}"]
            assert (np.linalg.eigvalsh(matrices) > 0).all()
            error = np.stack([trial.truth[f"{desired}_{axis}"] for axis in axes], axis=1) - actual
            force += np.einsum("nab,nb->na", matrices, error)
        np.testing.assert_allclose(trial.force, force, rtol=1e-9, atol=1e-9)
    # One pair of terms a pair of axes, in which the positive one is the larger by far.
    assert all((trial.truth["stiffness_xy"] > 0).all() for trial in log.trials)


# --- posteriors ----------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=[("x", "y"), ("x", "y", "z")], ids=len)
def posterior(request: pytest.FixtureRequest) -> Posterior:
    model = clear()
    return model.posterior(coupled_log(model, 0.6, 0.1, request.param))


def sum_of_terms(terms: LogTerms, draws: int) -> np.ndarray:
    """Σ_r a_r a_rᵀ e^{g_r} with g drawn, `(draws, samples, axes, axes)`."""
    generator = np.random.default_rng(0)
    directions = term_directions(terms.axes).numpy()
    location = np.log(terms.expected) - 0.5 * terms.covariance.diagonal(axis1=1, axis2=2)
    g = np.stack(
        [
            generator.multivariate_normal(mean, covariance, size=draws, method="eigh")
            for mean, covariance in zip(location, terms.covariance, strict=True)
        ],
        axis=1,
    )
    return np.einsum("ra,rb,dnr->dnab", directions, directions, np.exp(g))


def narrowed(terms: LogTerms, factor: float, rows: slice) -> LogTerms:
    """Some samples, with covariances so much smaller."""
    return LogTerms(
        terms.axes,
        terms.expected[rows],
        factor * terms.own[rows],
        factor * terms.covariance[rows],
        terms.prior_expected[rows],
        terms.prior_own[rows],
        terms.prior_covariance[rows],
    )


def test_moments_of_matrices_are_those_of_drawn_terms_to_first_order(posterior: Posterior) -> None:
    """With SDs a hundredth of theirs, so that what is of second order in them is a few hundredths of an SD."""
    draws = 40_000
    for latent in IMPEDANCE_ORDER:
        terms = narrowed(posterior.terms[latent], 1e-4, slice(0, 4))
        drawn = sum_of_terms(terms, draws)
        diagonal, coupling = matrix_marginals(latent, terms)
        axes, upper = range(len(posterior.axes)), np.triu_indices(len(posterior.axes), 1)
        for marginal, values in ((diagonal, drawn[:, :, axes, axes]), (coupling, drawn[:, :, *upper])):
            assert np.all(
                np.abs(values.mean(0) - marginal.mean) < (5.0 / math.sqrt(draws) + 0.05) * marginal.sd
            )
            # An SD from so many draws is right to 1/√(2 draws), five times that and the second order.
            np.testing.assert_allclose(values.std(0), marginal.sd, rtol=5.0 / math.sqrt(2.0 * draws) + 0.05)


def test_drawn_posteriors_have_the_reported_moments(posterior: Posterior) -> None:
    draws = 20_000
    for latent in IMPEDANCE_ORDER:
        terms = narrowed(posterior.terms[latent], 1e-4, slice(0, 4))
        drawn = terms.draw(draws, np.random.default_rng(1))
        assert (np.linalg.eigvalsh(drawn) > 0).all()
        diagonal, coupling = matrix_marginals(latent, terms)
        axes, upper = range(len(posterior.axes)), np.triu_indices(len(posterior.axes), 1)
        for marginal, values in ((diagonal, drawn[:, :, axes, axes]), (coupling, drawn[:, :, *upper])):
            assert np.all(
                np.abs(values.mean(0) - marginal.mean) < (5.0 / math.sqrt(draws) + 0.05) * marginal.sd
            )
            np.testing.assert_allclose(values.std(0), marginal.sd, rtol=5.0 / math.sqrt(2.0 * draws) + 0.05)


def test_drawn_priors_are_sums_of_log_normal_terms() -> None:
    expected = np.array([[200.0, 150.0, 60.0, 40.0]])
    spread = np.diag([0.1, 0.2, 0.05, 0.08])[None]
    terms = LogTerms(2, expected, spread, spread, expected, spread, spread)
    drawn = terms.draw(100_000, np.random.default_rng(0), prior=True)
    # E[w_r] are the means, and Var[w_r] = E[w_r]² (e^{σ²} − 1).
    assert abs(drawn[:, 0, 0, 0].mean() - 250.0) < 5.0 * drawn[:, 0, 0, 0].std() / math.sqrt(100_000)
    variance = np.square(expected[0]) * np.expm1(np.diag(spread[0]))
    assert drawn[:, 0, 0, 1].mean() == pytest.approx(10.0, abs=0.3)
    assert drawn[:, 0, 0, 1].var() == pytest.approx((variance[2] + variance[3]) / 4.0, rel=0.03)
    assert drawn[:, 0, 1, 1].var() == pytest.approx(variance[1] + (variance[2] + variance[3]) / 4.0, rel=0.05)


@pytest.mark.parametrize("prior", [False, True])
def test_drawn_matrices_are_positive_definite_and_seeded(posterior: Posterior, prior: bool) -> None:
    axes, n = len(posterior.axes), len(posterior["mass"].mean)
    drawn = draw_matrices(posterior, 7, seed=3, prior=prior)
    assert drawn.shape == (7, n, 3, axes, axes)
    assert (np.linalg.eigvalsh(drawn) > 0).all()
    np.testing.assert_array_equal(drawn, draw_matrices(posterior, 7, seed=3, prior=prior))
    assert not np.array_equal(drawn, draw_matrices(posterior, 7, seed=4, prior=prior))
    median = np.median(drawn[:, :, 0, 0, 0], axis=0)
    shown = posterior["stiffness"].prior_quantile(0.5) if prior else posterior["stiffness"].quantile(0.5)
    # Seven draws of log-SD one or so: their median is within a factor of eight.
    assert np.all(np.abs(np.log(median / shown[:, 0])) < math.log(8.0))


def test_independent_axes_draw_diagonal_matrices() -> None:
    model = clear("model.axes=independent")
    found = model.posterior(draw_force(model.config, motion(), seed=0))
    assert (found.pairs, dict(found.couplings), dict(found.terms)) == ((), {}, {})
    drawn = draw_matrices(found, 4000, seed=0)
    assert not drawn[..., 0, 1].any()
    diagonal = np.stack([found[latent].mean for latent in IMPEDANCE_ORDER], axis=1)
    spread = np.stack([found[latent].sd for latent in IMPEDANCE_ORDER], axis=1)
    deviation = drawn.diagonal(axis1=-2, axis2=-1).mean(0) - diagonal
    assert np.all(np.abs(deviation) < 6.0 * spread / math.sqrt(4000))


def test_table_holds_couplings_after_the_diagonal(posterior: Posterior) -> None:
    table = posterior.table()
    pairs = {2: ("xy",), 3: ("xy", "xz", "yz")}[len(posterior.axes)]
    assert posterior.pairs == pairs
    for quantity in ("stiffness", "damping", "mass"):
        names = [c for c in table.columns if c.startswith(f"{quantity}_") and c.endswith("_mean")]
        entries = [2 * axis for axis in posterior.axes] + list(pairs)
        assert names == [f"{quantity}_{entry}_mean" for entry in entries]
        for entry in pairs:
            low, high = (table[f"{quantity}_{entry}_{q}"] for q in ("q05", "q95"))
            assert (low < table[f"{quantity}_{entry}_mean"]).all()
            assert np.allclose((high - low) / 2.0, 1.6448536 * table[f"{quantity}_{entry}_sd"])
    assert table.notna().all(axis=None)


@torch.no_grad()
def test_latents_are_conditioned_on_forces_of_all_axes() -> None:
    """Against solves with the joint covariance of forces, levels and terms, written out."""
    model = clear("model.residual={sd: 0.4, input: [position]}")
    log = coupled_log(model, 0.5, 0.1)
    feature_map, features = features_of(model.config, log)
    force_model = build_force_model(model.config, feature_map)
    scatter_hyperparameters(force_model)
    given = observations(force_model, features)
    x, kernel = given.inputs, force_model.kernel
    rows = slice(0, 10)
    target = join_axes(features.inputs[:, :, rows], feature_map.layout)
    # Offsets b of log level and log coupling, for which u is linearised by differences of E[u].
    hyper = [(p, name) for p in kernel.impedance.processes for name in ("raw_level", "raw_coupling")]
    columns, force_columns = [], []
    for process, name in hyper:
        raw = getattr(process, name)
        for i in range(raw.numel()):
            means = []
            # The log-variance of the mass is held: only its level moves.
            held = process.covariance.raw_sd.clone()
            for step in (1e-6, -1e-6):
                raw.view(-1)[i] += step
                if process.relative and name == "raw_level":
                    process.covariance.raw_sd.view(-1)[i] += step
                means.append((kernel.prior_mean(x)[0], kernel.prior_mean(target)[0]))
                raw.view(-1)[i] -= step
                process.covariance.raw_sd.copy_(held)
            columns.append((means[0][0] - means[1][0]) / 2e-6)
            force_columns.append((means[0][1] - means[1][1]) / 2e-6)
    a, b = torch.stack(columns, -1), torch.stack(force_columns, -1)
    variances = []
    for name in ("stiffness", "damping", "mass"):
        level, coupling = (
            getattr(getattr(model.config.model, name), key).log_sd for key in ("level", "coupling")
        )
        variances += [level**2] * 2 + [coupling**2] * 2
    v = torch.diag(torch.tensor(variances, dtype=torch.float64))
    noise = given.noise_variance
    k = kernel(x).to_dense()[0] + torch.diag(noise) + a @ v @ a.T
    found = compute_posterior(force_model, log, features, features, 0.0)
    for latent in (Latent.FORCE, Latent.RESIDUAL_FORCE, Latent.DESIRED_POSITION, Latent.DESIRED_ACCELERATION):
        loading = b if latent is Latent.FORCE else torch.zeros_like(b)
        cross = kernel.cross_covariance(x, target, latent)[0] + a @ v @ loading.T
        gain = torch.linalg.solve(k, cross)
        own = kernel.prior_variance(target, latent)[0] + (loading @ v @ loading.T).diagonal()
        variance = own - (cross * gain).sum(0) + (noise[:20] if latent is Latent.FORCE else 0.0)
        np.testing.assert_allclose(
            found[latent].sd[rows] ** 2,
            variance.reshape(-1, 2).numpy(),
            rtol=2e-5,
            atol=1e-9 * float(own.max()),
        )
        # The fitted level is the mode: the mean is that at known levels.
        alpha = torch.linalg.solve(k - a @ v @ a.T, given.residual[0])
        mean = kernel.cross_covariance(x, target, latent)[0].T @ alpha
        if latent is Latent.FORCE:
            mean = mean + kernel.prior_mean(target)[0]
        elif latent in (Latent.DESIRED_POSITION, Latent.DESIRED_ACCELERATION):
            order = 0 if latent is Latent.DESIRED_POSITION else 2
            mean = mean + features.trajectory_mean[:, 0, rows, order].T.reshape(-1)
        np.testing.assert_allclose(
            found[latent].mean[rows], mean.reshape(-1, 2).numpy(), rtol=1e-6, atol=1e-8
        )


def test_what_the_data_leave_to_each_term_is_not_added_to_the_matrix() -> None:
    """Two terms that are uncertain apart and certain together: the diagonal is certain, and not lifted."""
    expected = np.array([[1e-30, 1e-30, 30.0, 20.0]])
    covariance = np.zeros((1, 4, 4))
    # 30 δ₊ + 20 δ₋ = 0, and both have SDs of about one.
    direction = np.array([2.0, -3.0]) / 3.0
    covariance[0, 2:, 2:] = np.outer(direction, direction)
    terms = LogTerms(2, expected, covariance, covariance, expected, covariance, covariance)
    diagonal, coupling = matrix_marginals(Latent.STIFFNESS, terms)
    np.testing.assert_allclose(diagonal.mean, [[25.0, 25.0]], rtol=1e-12)
    np.testing.assert_allclose(diagonal.scale, 0.0, atol=1e-7)
    np.testing.assert_allclose(coupling.mean, [[5.0]], rtol=1e-12)
    # ½ (30 · ⅔ + 20 · 1)
    np.testing.assert_allclose(coupling.sd, [[20.0]], rtol=1e-12)
    assert (diagonal.warped, coupling.warped) == (True, False)


def test_groups_without_evidence_keep_their_prior() -> None:
    model = clear()
    log = coupled_log(model, 0.5, 0.1)
    other = replace(log, trials=tuple(replace(trial, group="other", force=None) for trial in log.trials[:1]))
    both = PreparedLog(log.axes, (*log.trials, *other.trials))
    found = model.posterior(both)
    own = found.trial_slice(3)
    for marginal in (found["stiffness"], found.couplings[Latent.STIFFNESS]):
        np.testing.assert_allclose(marginal.scale[own], marginal.prior_scale[own])
        assert (marginal.scale[: own.start] < 0.75 * marginal.prior_scale[: own.start]).all()
    np.testing.assert_allclose(found["stiffness"].location[own], found["stiffness"].prior_location[own])


# --- training ------------------------------------------------------------------------------------

TRAINING = ("training.restarts=1", "training.max_iterations=40")


@pytest.fixture(scope="module", params=[1.0, -1.0], ids=["positive", "negative"])
def trained(request: pytest.FixtureRequest) -> tuple[float, ImpedanceModel]:
    """A model trained on forces of strongly coupled axes, coupled in either sense."""
    couplings = (0.8, 0.05) if request.param > 0 else (0.05, 0.8)
    model = clear(*TRAINING)
    return request.param, model.fit(coupled_log(model, *couplings))


def test_training_recovers_coupling_of_either_sign(trained: tuple[float, ImpedanceModel]) -> None:
    sign, model = trained
    log = model.fitted.log
    found = model.posterior(log)
    for latent in IMPEDANCE_ORDER:
        truth = np.concatenate([trial.truth[f"{latent.value}_xy"] for trial in log.trials])
        coupling = found.couplings[latent]
        assert np.all(sign * truth > 0)
        # Every 90 % interval excludes zero on the right side, and the path average is within three of its SDs.
        assert np.all(sign * coupling.mean - 1.645 * coupling.sd > 0)
        assert abs(coupling.mean.mean() - truth.mean()) < 3.0 * coupling.sd.mean()
        for a, axis in enumerate("xy"):
            own = np.concatenate([trial.truth[f"{latent.value}_{axis}{axis}"] for trial in log.trials])
            assert abs(found[latent].mean[:, a].mean() - own.mean()) < 3.0 * found[latent].sd[:, a].mean()
    summary = summarise(model.verdicts(found), off_diagonals(found))
    assert set(summary["stiffness_xy"]) == {"mean", "q05", "q95", "contraction"}
    assert sign * summary["mass_xy"]["q05" if sign > 0 else "q95"] > 0
    assert summary["damping_xy"]["contraction"] > 0.9


def test_report_has_one_part(trained: tuple[float, ImpedanceModel]) -> None:
    _, model = trained
    report = model.report
    assert model.parts == ("xy",)
    assert len(report.best) == len(report.objective) == len(report.log_likelihood) == 1
    assert model.log_marginal_likelihood(model.fitted.log) == {
        "xy": pytest.approx(report.log_likelihood[0], rel=1e-9)
    }
    for entry in model.hyperparameters:
        shape = np.shape(report.log_sd.get(entry.name, np.zeros(entry.value.shape[::3])))
        assert shape == (entry.value.shape[0], entry.value.shape[3])
    # In each pair the term of the right sign is the large one.
    coupling = next(entry for entry in model.hyperparameters if entry.name == "stiffness.coupling")
    assert coupling.members == ("xy +", "xy −")
    assert coupling.value.shape == (2, 1, 1, 1)


def test_laplace_is_the_joint_curvature_of_all_axes(trained: tuple[float, ImpedanceModel]) -> None:
    """Against second differences of the objective itself, over every free hyperparameter of both axes."""
    _, model = trained
    _, features = features_of(model.config, model.fitted.log)
    force_model = model.force_model(("x", "y"))
    raws = [entry.raw for entry in force_model.entries if entry.free.any()]
    free = torch.cat([raw.detach().reshape(-1) for raw in raws])
    size = len(free)

    def gradient(point: torch.Tensor) -> torch.Tensor:
        start = 0
        for raw in raws:
            with torch.no_grad():
                raw.copy_(point[start : start + raw.numel()].reshape(raw.shape))
            start += raw.numel()
            raw.grad = None
        objective(force_model, features, model.config.engine.jitter)[0].sum().backward()
        return torch.cat([raw.grad.reshape(-1) for raw in raws])

    hessian = torch.stack(
        [
            -(gradient(free + 2e-3 * unit) - gradient(free - 2e-3 * unit)) / 4e-3
            for unit in torch.eye(size, dtype=torch.float64)
        ]
    )
    expected = torch.linalg.inv(0.5 * (hessian + hessian.T)).diagonal().sqrt()
    names = [entry.name for entry in force_model.entries if entry.free.any()]
    found = np.concatenate([np.reshape(model.report.log_sd[name], -1) for name in names])
    # Both constraints in play are logarithms, but for σ_r, kept as a variance.
    power = np.concatenate([np.full(e.raw.numel(), e.power) for e in force_model.entries if e.free.any()])
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found, power * expected.numpy(), rtol=0.05)


def test_sensitivity_refits_under_another_coupling(
    trained: tuple[float, ImpedanceModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sensitivity refits from where the model stands, and knows the coupling as one prior among others."""
    _, model = trained
    every = sensitivity.changes(model.hyperparameters)
    mine = [change for change in every if change.key == "model.stiffness.coupling"]
    assert [change.quantity for change in mine] == ["median", "median", "log_sd", "log_sd"]
    monkeypatch.setattr(sensitivity, "changes", lambda entries: mine[:1])
    found = sensitivity.prior_sensitivity(model)
    assert set(found.refits[0].log_likelihood_change) == {"xy"}
    assert found.refits[0].effects


def test_a_stopped_training_continues_to_the_same_bits(
    trained: tuple[float, ImpedanceModel], tmp_path
) -> None:
    _, model = trained
    results = []
    for _ in range(2):
        with open_journal(tmp_path / "journal") as journal:
            fitted = clear(*TRAINING).fit(model.fitted.log, journal=journal)
            results.append([entry.raw.detach().numpy().tobytes() for entry in fitted.hyperparameters])
            count = len(journal)
    assert results[0] == results[1]
    assert count == fitted.report.restarts[0].evaluations + 2 * sum(
        int(entry.free.sum()) * entry.raw.shape[0] for entry in fitted.hyperparameters
    )


def test_saved_and_loaded_model_has_the_same_bits(trained: tuple[float, ImpedanceModel], tmp_path) -> None:
    _, model = trained
    save_model(model, tmp_path / "model")
    loaded = load_model(tmp_path / "model")
    log = model.fitted.log
    one, two = model.posterior(log), loaded.posterior(log)
    pd.testing.assert_frame_equal(one.table(), two.table(), check_exact=True)
    assert repr(loaded.report) == repr(model.report)


def test_scores_and_cross_validation(trained: tuple[float, ImpedanceModel]) -> None:
    """On coupled forces the coupled model predicts better than the independent one, and than a naive GP."""
    _, model = trained
    log = model.fitted.log
    quick = clear("training.restarts=1", "training.max_iterations=8")
    against = {"independent": ImpedanceModel(load_independent(quick))}
    result = cross_validate(quick, log, "trials", ["naive"], against)
    for axis in "xy":
        scores = result[axis]
        assert set(scores) == {"impedance", "naive", "independent"}
        assert scores["impedance"].msll < min(scores["independent"].msll, scores["naive"].msll)
    unseen = draw_force(model.config, repeated_motion(1, 3.0, 10.0, seed=9), 0, model.force_model(("x", "y")))
    assert evaluate(model, unseen)["y"]["impedance"].n == 30


def load_independent(model: ImpedanceModel):
    return model.config.model_copy(
        update={"model": model.config.model.model_copy(update={"axes": "independent"})}
    )


def test_naive_baseline_stays_independent(trained: tuple[float, ImpedanceModel]) -> None:
    _, model = trained
    config = configuration(axes="coupled")
    log = model.fitted.log
    short = config.model_copy(
        update={"training": config.training.model_copy(update={"restarts": 1, "max_iterations": 2})}
    )
    naive = NaiveModel(short, log)
    assert len(naive.report.objective) == 2
    assert naive.predict(log)[Latent.FORCE].mean.shape == (90, 2)


# --- the command line ----------------------------------------------------------------------------


def test_commands_on_a_coupled_log(tmp_path, command: Callable[..., Outcome]) -> None:
    model = clear()
    log = as_recording(draw_force(model.config, motion(rate=50.0), 0), keep_reference=True)
    write_log(log.select([0, 1]), tmp_path / "log.csv")
    write_log(log.select([2]), tmp_path / "other.csv")
    settings = [argument for item in (*TINY, "preprocessing.rate=8") for argument in ("--set", item)]
    done = command(
        "train", tmp_path / "log.csv", "--config", "coupled", "--out", tmp_path / "model", *settings
    )
    assert done.code == 0, done.err
    # Of what one restart was best, and below the diagonal; columns are narrow, so names are broken.
    assert all("xy" in part for part in done.out.split("Impedance, averaged"))
    done = command(
        "infer",
        tmp_path / "model",
        tmp_path / "other.csv",
        "--out",
        tmp_path / "posterior.csv",
        "--figures",
        tmp_path / "figures",
    )
    assert done.code == 0, done.err
    table = pd.read_csv(tmp_path / "posterior.csv")
    assert {
        f"{q}_xy_{s}" for q in ("stiffness", "damping", "mass") for s in ("mean", "sd", "q05", "q95")
    } <= set(table)
    done = command(
        "evaluate",
        tmp_path / "model",
        tmp_path / "other.csv",
        "--baseline",
        "naive",
        "--json",
        tmp_path / "scores.json",
    )
    assert done.code == 0, done.err
    scores = json.loads((tmp_path / "scores.json").read_text())["axes"]
    assert set(scores["x"]) == {"impedance", "naive"}
    done = command("show", tmp_path / "model")
    assert done.code == 0, done.err
    assert "xy +" in done.out
    assert "xy −" in done.out
    done = command("show", tmp_path / "model", "--json")
    assert {"mean", "q05", "q95", "contraction"} == set(json.loads(done.out)["mass_xy"])


# --- refusals ------------------------------------------------------------------------------------


def test_gaussian_priors_do_not_couple() -> None:
    sentence = r"damping.prior: expected log_gp with axes: coupled, .* got gp; set model.damping.prior=log_gp"
    with pytest.raises(ConfigurationError, match=sentence):
        load_config("coupled", ["model.damping={prior: gp, level: 10, sd: 2}"])


def test_no_verdict_on_a_coupling_that_was_not_learned() -> None:
    levels = ("stiffness", "damping", "mass")
    model = clear(*(f"model.{name}.level=10" for name in levels))
    posterior = model.posterior(coupled_log(model, 0.5, 0.1))
    with pytest.raises(ConfigurationError, match="expected a fitted model, got an untrained one"):
        model.verdicts(posterior)
    known = clear(*(f"model.{name}.{key}=1" for name in levels for key in ("level", "coupling")))
    assert len(known.verdicts(posterior)) == 6


def test_one_axis_alone_is_refused() -> None:
    with pytest.raises(
        ConfigurationError, match="expected a log of two or three axes with coupled, found x alone; set"
    ):
        clear().fit(draw_force(clear("model.axes=independent").config, motion(("x",)), 0))


def test_one_point_at_a_time_is_refused(trained: tuple[float, ImpedanceModel]) -> None:
    with pytest.raises(
        ConfigurationError, match="expected model.axes: independent to predict one sample of one axis"
    ):
        trained[1].point_predictor("x", "0")


def test_capacity_counts_every_axis() -> None:
    log = draw_force(clear().config, motion(), seed=0)
    with pytest.raises(
        TooManySamplesError, match="group '0', each counted once for every of 2 coupled axes: .* got 180"
    ):
        clear("engine.max_samples=100").fit(log)
    clear("engine.max_samples=180", "training.max_iterations=1", "training.restarts=1").fit(log)
