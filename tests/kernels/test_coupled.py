"""The covariance of forces under coupled impedance: loops over entries, Monte Carlo, and what every kernel keeps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from coupled_oracle import CoupledOracle, scatter_hyperparameters
from oracles import configuration

from bayes_impedance.engines import dense
from bayes_impedance.engines.dense import log_marginal_likelihood
from bayes_impedance.features import FeatureMap
from bayes_impedance.kernels import CoupledProcess, Latent, StationaryKernel
from bayes_impedance.kernels.coupled import by_axis, join_axes, rows_of
from bayes_impedance.kernels.coupled_terms import axis_pairs, pair_names, term_directions
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import build_force_model
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from bayes_impedance.training import observations
from bayes_impedance.trajectory_mean import TrajectoryMean

TWO, THREE = ("x", "y"), ("x", "y", "z")
#: Sections that replace those of `oracles.MODEL`.
CASES = {
    "phase": {},
    "equilibrium": {
        "trajectory_input": "position",
        "desired_trajectory": {"mean": "equilibrium", "sd": 0.02},
    },
    "position_velocity": {"trajectory_input": "position_velocity"},
    "no acceleration": {"trajectory_input": "position_velocity", "drop_acceleration": True},
    "time": {"trajectory_input": "time", "residual": None},
}


class Case:
    """Kernel, joined inputs and oracle of a few samples, with hyperparameters of their own for every axis and term."""

    def __init__(
        self, name: str = "phase", axes: tuple[str, ...] = TWO, rate: float = 2.0, seed: int = 2
    ) -> None:
        self.config = configuration(axes="coupled", **CASES[name])
        self.log = repeated_motion(repetitions=2, duration=2.0, rate=rate, axes=axes, seed=seed)
        self.map = FeatureMap(self.config, axes)
        mean = TrajectoryMean.from_training(self.config.model.desired_trajectory, self.log)
        self.features = self.map(self.log, mean)
        self.model = build_force_model(self.config, self.map)
        scatter_hyperparameters(self.model)
        self.kernel = self.model.kernel
        self.inputs = join_axes(self.features.inputs, self.map.layout)
        self.oracle = CoupledOracle(self.config, self.log, self.model)


@pytest.fixture(
    scope="module", params=[("phase", TWO), ("phase", THREE), *((name, TWO) for name in list(CASES)[1:])]
)
def case(request: pytest.FixtureRequest) -> Case:
    return Case(*request.param)


def square(covariance: np.ndarray) -> np.ndarray:
    n, axes = covariance.shape[:2]
    return covariance.reshape(n * axes, n * axes)


@torch.no_grad()
def test_moments_are_those_of_loops_over_entries(case: Case) -> None:
    value = case.kernel.impedance(case.inputs).to_dense()[0].numpy()
    expected = square(case.oracle.covariance())
    np.testing.assert_allclose(value, expected, atol=1e-10 * np.abs(expected).max())
    mean = case.kernel.prior_mean(case.inputs)[0].numpy()
    np.testing.assert_allclose(mean, case.oracle.mean().reshape(-1), rtol=1e-11, atol=1e-12)
    split = case.model.prior_mean(case.features.inputs)[:, 0].numpy()
    np.testing.assert_allclose(split.T, case.oracle.mean(), rtol=1e-11, atol=1e-12)


@torch.no_grad()
@pytest.mark.parametrize("axes", [TWO, THREE])
def test_moments_are_those_of_drawn_matrices_and_trajectories(axes: tuple[str, ...]) -> None:
    """Within five standard errors, which the draws tell themselves: products of log-normals have heavy tails."""
    draws = 120_000
    case = Case(axes=axes, rate=1.0)
    force, logarithms, deviation = case.oracle.draw(draws, seed=1)
    u = force.reshape(draws, -1)
    centred = u - u.mean(0)

    def compare(other: np.ndarray, value: torch.Tensor) -> None:
        other = other.reshape(draws, -1)
        product = np.einsum("di,dj->ij", centred, other - other.mean(0)) / draws
        square = np.einsum("di,dj->ij", centred**2, (other - other.mean(0)) ** 2) / draws
        error = np.sqrt((square - product**2) / draws)
        assert np.all(np.abs(product - value.numpy()) < 5.0 * error)

    mean = case.kernel.prior_mean(case.inputs)[0].numpy()
    assert np.all(np.abs(u.mean(0) - mean) < 5.0 * u.std(0) / math.sqrt(draws))
    compare(u, case.kernel.impedance(case.inputs).to_dense()[0])
    for order, latent in enumerate((Latent.STIFFNESS, Latent.DAMPING, Latent.MASS)):
        compare(logarithms[order], case.kernel.cross_covariance(case.inputs, case.inputs, latent)[0])
    trajectory = (Latent.DESIRED_POSITION, Latent.DESIRED_VELOCITY, Latent.DESIRED_ACCELERATION)
    for order, latent in enumerate(trajectory):
        compare(deviation[:, order], case.kernel.cross_covariance(case.inputs, case.inputs, latent)[0])


@torch.no_grad()
def test_noise_of_positions_acts_as_desired_trajectories_do() -> None:
    config = configuration(axes="coupled", position_noise_sd=1e-3)
    log = repeated_motion(repetitions=1, duration=2.0, rate=2.0, seed=2)
    n = len(log.trials[0].time)
    # Windows of three native samples at .1 s that overlap those of their neighbours.
    smoothing = np.column_stack([np.arange(n), *(np.full(n, v) for v in (1, 3, 2, 0.1, 3))])
    log = replace(log, trials=(replace(log.trials[0], smoothing=smoothing.astype(float)),))
    feature_map = FeatureMap(config, log.axes)
    features = feature_map(log, TrajectoryMean.from_training(config.model.desired_trajectory, log))
    model = build_force_model(config, feature_map)
    scatter_hyperparameters(model)
    x = join_axes(features.inputs, feature_map.layout)
    noise = model.kernel.motion_noise
    smoothed = noise.smoothed(x, x)[0].numpy()
    added = noise.sd.square().reshape(-1, 1, 1, 1, 1).numpy() * smoothed
    assert np.abs(smoothed).max() > 0
    expected = square(CoupledOracle(config, log, model).covariance(added))
    expected += model.kernel.residual_covariance(x, x)[0].numpy()
    value = model.kernel(x).to_dense()[0].numpy()
    np.testing.assert_allclose(value, expected, atol=1e-10 * np.abs(expected).max())
    np.testing.assert_allclose(model.kernel(x, diag=True)[0].numpy(), np.diag(value), rtol=1e-10)


@torch.no_grad()
def test_symmetric_positive_semidefinite_and_its_own_diagonal(case: Case) -> None:
    value = case.kernel(case.inputs).to_dense()[0]
    scale = value.abs().max()
    assert (value - value.mT).abs().max() <= 1e-13 * scale
    assert torch.linalg.eigvalsh(value).min() > -1e-12 * scale
    for latent in (Latent.FORCE, Latent.RESIDUAL_FORCE, Latent.DESIRED_VELOCITY):
        variance = case.kernel.prior_variance(case.inputs, latent)[0]
        if latent is not Latent.DESIRED_VELOCITY:
            dense_variance = case.kernel.cross_covariance(case.inputs, case.inputs, latent)[0].diagonal()
            torch.testing.assert_close(variance, dense_variance, rtol=1e-10, atol=1e-12)
        assert variance.shape == value.shape[:1]
        assert (variance >= 0).all()


@torch.no_grad()
def test_rectangular_covariances_are_parts_of_the_square_one(case: Case) -> None:
    axes = len(case.log.axes)
    for latent in Latent:
        whole = case.kernel.cross_covariance(case.inputs, case.inputs, latent)
        part = case.kernel.cross_covariance(case.inputs[:, 1:3], case.inputs[:, :5], latent)
        width = part.shape[-1]
        torch.testing.assert_close(
            part, whole[:, axes : 3 * axes, :width], rtol=1e-9, atol=1e-9 * float(whole.abs().max()) + 1e-300
        )
        assert width == 5 * (axes if latent.value not in ("stiffness", "damping", "mass") else axes**2)


def test_gradients_are_finite_differences() -> None:
    case = Case(rate=1.0)
    weights = torch.randn(1, 8, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def value() -> torch.Tensor:
        return (weights * case.kernel(case.inputs).to_dense()).sum()

    parameters = list(case.kernel.parameters())
    for parameter in parameters:
        parameter.requires_grad_(True)
    gradients = torch.autograd.grad(value(), parameters)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        flat = parameter.data.view(-1)
        for i in range(len(flat)):
            step = 1e-5
            with torch.no_grad():
                flat[i] += step
                above = value()
                flat[i] -= 2.0 * step
                below = value()
                flat[i] += step
            expected = float((above - below) / (2.0 * step))
            # Central differences of a sum of so many forces² round at 1e-16 / step of its size.
            assert float(gradient.view(-1)[i]) == pytest.approx(
                expected, rel=1e-5, abs=1e-6 * float(value().detach().abs())
            )


@pytest.mark.parametrize("block_entries", [1, 2**17])
def test_dense_engine_is_plain_autograd(block_entries: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dense, "BLOCK_ENTRIES", block_entries)
    case = Case(rate=12.0)
    log = draw_force(case.config, case.log, seed=0)
    mean = TrajectoryMean.from_training(case.config.model.desired_trajectory, log)
    for entry in case.model.entries:
        entry.raw.requires_grad_(True)
    given = observations(case.model, case.map(log, mean))
    parameters = [entry.raw for entry in case.model.entries]
    value = log_marginal_likelihood(case.kernel, given)
    covariance = case.kernel(given.inputs).to_dense() + torch.diag_embed(given.noise_variance)
    expected = torch.distributions.MultivariateNormal(
        torch.zeros(96, dtype=torch.float64), covariance
    ).log_prob(given.residual)
    torch.testing.assert_close(value, expected, rtol=1e-10, atol=1e-9)
    for ours, theirs in zip(
        torch.autograd.grad(value.sum(), parameters, retain_graph=True),
        torch.autograd.grad(expected.sum(), parameters),
        strict=True,
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-6)


def test_padded_groups_are_those_alone() -> None:
    config = configuration(axes="coupled")
    trials = []
    for group, repetitions in (("a", 1), ("b", 3)):
        trials += repeated_motion(repetitions, 2.0, 8.0, seed=repetitions, group=group).trials
    log = draw_force(config, PreparedLog(TWO, tuple(trials)), seed=0)
    feature_map = FeatureMap(config, TWO)
    mean = TrajectoryMean.from_training(config.model.desired_trajectory, log)
    model = build_force_model(config, feature_map)
    with torch.no_grad():
        together = log_marginal_likelihood(model.kernel, observations(model, feature_map(log, mean)))
        apart = [
            log_marginal_likelihood(model.kernel, observations(model, feature_map(log.select(rows), mean)))
            for rows in ([0], [1, 2, 3])
        ]
    torch.testing.assert_close(together, torch.cat(apart), rtol=1e-10, atol=0)


@torch.no_grad()
@pytest.mark.parametrize("axes", [2, 3])
def test_mean_matrices_are_symmetric_and_positive_definite_whatever_the_levels(axes: int) -> None:
    generator = torch.Generator().manual_seed(0)
    process = CoupledProcess(StationaryKernel(batch_shape=torch.Size([axes])), axes).double()
    process.covariance.sd = 0.5
    x = torch.linspace(0.0, 1.0, 5, dtype=torch.float64).unsqueeze(-1)
    for _ in range(50):
        for parameter in (process.raw_level, process.raw_coupling):
            parameter.copy_(2.0 * torch.randn(parameter.shape, generator=generator, dtype=torch.float64))
        matrices = process.mean_matrices(x)[..., 0].movedim(-1, 0)
        scale = torch.linalg.matrix_norm(matrices)
        assert ((matrices - matrices.mT).abs().amax((-2, -1)) <= 1e-15 * scale).all()
        assert (torch.linalg.eigvalsh(matrices).amin(-1) > 0).all()


def test_directions_span_symmetric_matrices_with_either_sign() -> None:
    for axes in (2, 3):
        directions = term_directions(axes).numpy()
        dyads = directions[:, :, None] * directions[:, None]
        pairs = len(axis_pairs(axes))
        assert len(directions) == axes + 2 * pairs
        np.testing.assert_allclose(np.square(directions).sum(1), 1.0, rtol=1e-15)
        assert np.linalg.matrix_rank(dyads.reshape(len(dyads), -1)) == axes + pairs
        upper = dyads[axes:][:, *np.triu_indices(axes, 1)]
        assert sorted(np.round(upper.sum(1), 12)) == [-0.5] * pairs + [0.5] * pairs
    assert pair_names(THREE) == ("xy", "xz", "yz")


def test_rows_go_there_and_back() -> None:
    values = torch.arange(24.0).reshape(2, 3, 4)
    assert rows_of(values)[0, :4].tolist() == [0.0, 12.0, 1.0, 13.0]
    assert torch.equal(by_axis(rows_of(values), 2), values)


def test_one_axis_does_not_couple() -> None:
    with pytest.raises(ValueError, match="axes: expected two or three that couple, got 1"):
        CoupledProcess(StationaryKernel(batch_shape=torch.Size([1])), axes=1)


def test_single_precision_inputs_are_refused() -> None:
    case = Case()
    with pytest.raises(
        TypeError, match="expected inputs of the dtype torch.float64 of the coupled hyperparameters"
    ):
        case.kernel(case.inputs.float()).to_dense()
