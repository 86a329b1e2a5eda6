"""Curvature at a mode and the evidence that follows, against autograd, dense Gaussians and brute force."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from scipy.linalg import block_diag
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from bayes_impedance.impedance_functions import evidence, laplace
from bayes_impedance.impedance_functions.density import log_hyperprior
from bayes_impedance.impedance_functions.evidence import (
    log_variation_prior,
    occam,
    update_variation,
    variation_entries,
)
from tests.impedance_functions.problems import COUPLED, density_of, small_problem, somewhere


def hessian_of_weights(density, point):
    """Minus the second derivatives of the log density over the weights, by autograd."""
    density.set_hyperparameters(point)

    def joint(weights):
        impedance = density.designs.matrices(density.weights(weights))
        return density.likelihood(impedance).sum() - 0.5 * weights.square().sum()

    found = torch.autograd.functional.hessian(joint, torch.from_numpy(point[: density.weight_count]))
    return -found.numpy()


@pytest.mark.parametrize("overrides", [(), (COUPLED,)])
def test_precision_is_autograds_hessian(overrides):
    density = density_of(small_problem(*overrides))
    point = somewhere(density)
    found = laplace.precision(lambda at: density.joint(at)[1], point, density.free)
    assert found.shape == (density.free.sum(),) * 2
    np.testing.assert_array_equal(found, found.T)
    count = density.weight_count
    expected = hessian_of_weights(density, point)
    # Central differences of 1e-3 err by 1e-6 / 6 of what fourth derivatives are.
    np.testing.assert_allclose(found[:count, :count], expected, atol=2e-6 * np.abs(expected).max())
    # What is fixed has no row.
    density.free[-1] = False
    fewer = laplace.precision(lambda at: density.joint(at)[1], point, density.free)
    np.testing.assert_array_equal(fewer, found[:-1, :-1])


def test_one_sided_differences_are_near_and_take_half_the_gradients(monkeypatch):
    density = density_of(small_problem(COUPLED))
    point = somewhere(density)
    taken = []

    def gradient(at):
        taken.append(at)
        return density.joint(at)[1]

    exact = laplace.precision(gradient, point, density.free)
    assert len(taken) == 2 * density.free.sum()
    taken.clear()
    found = laplace.precision(gradient, point, density.free, one_sided=True)
    assert len(taken) == 1 + density.free.sum()
    np.testing.assert_array_equal(found, found.T)
    # Half a step of third derivatives: a tenth of the step, a tenth of the error.
    error = np.abs(found - exact).max()
    assert 0.0 < error < 0.01 * np.abs(exact).max()
    monkeypatch.setattr(laplace, "STEP", 1e-4)
    nearer = laplace.precision(gradient, point, density.free, one_sided=True)
    assert np.abs(nearer - exact).max() == pytest.approx(0.1 * error, rel=0.1)


def test_covariance_is_the_inverse_where_there_is_curvature():
    generator = np.random.default_rng(0)
    root = generator.standard_normal((5, 5))
    precision = root @ root.T + np.eye(5)
    np.testing.assert_allclose(laplace.covariance(precision) @ precision, np.eye(5), atol=1e-10)
    vectors = np.linalg.qr(root)[0]
    values = np.array([100.0, 3.0, 1e-11, 0.0, -4.0])
    found = laplace.covariance((vectors * values) @ vectors.T)
    np.testing.assert_allclose(
        found, (vectors / [100.0, 3.0, 1.0, 1.0, 1.0]) @ vectors.T, rtol=1e-9, atol=1e-12
    )
    assert laplace.covariance(np.zeros((0, 0))).shape == (0, 0)


def test_log_determinant():
    generator = np.random.default_rng(0)
    root = generator.standard_normal((5, 5))
    precision = root @ root.T + np.eye(5)
    assert laplace.log_determinant(precision) == pytest.approx(np.linalg.slogdet(precision)[1], rel=1e-12)
    assert laplace.log_determinant(np.diag([8.0, 0.5, -1.0])) == pytest.approx(np.log(8.0), rel=1e-12)


# --- the trace -----------------------------------------------------------------------------------


def brute_occam(density, point):
    """Finite differences of −½ log det H by each hyperparameter, the weights where they are."""
    found = np.zeros_like(point)
    for place in range(density.weight_count, len(point)):
        step = 1e-3 * (np.arange(len(point)) == place)
        above, below = (np.linalg.slogdet(hessian_of_weights(density, point + s * step))[1] for s in (1, -1))
        found[place] = -0.5 * (above - below) / 2e-3
    return found


@dataclass
class Peak:
    """A density near a mode of its weights, and its curvature."""

    density: object
    point: np.ndarray
    precision: np.ndarray
    brute: np.ndarray


@pytest.fixture(scope="module", params=[(), (COUPLED,)], ids=["independent", "coupled"])
def peak(request):
    density = density_of(small_problem(*request.param, repetitions=3))
    point = density.start()
    for _ in range(8):
        # Newton's method, in which every weight is a coordinate.
        gradient = density.joint(point)[1][: density.weight_count]
        hessian = hessian_of_weights(density, point)
        point[: density.weight_count] += np.linalg.solve(
            hessian + 0.1 * np.diag(np.diag(hessian)), gradient
        ).clip(-1.0, 1.0)
    precision = laplace.precision(lambda at: density.joint(at)[1], point, density.free)
    assert np.linalg.eigvalsh(precision[: density.weight_count, : density.weight_count]).min() > 1.0 - 1e-6
    return Peak(density, point, precision, brute_occam(density, point))


def test_occam_with_all_directions_is_brute_force(peak, monkeypatch):
    monkeypatch.setattr(evidence, "DIRECTIONS", 10_000)
    found = occam(peak.density, peak.point, peak.precision)
    assert (found[: peak.density.weight_count] == 0.0).all()
    # A tenth of a posterior SD is no infinitesimal step.
    np.testing.assert_allclose(found, peak.brute, atol=0.005 * np.abs(peak.brute).max())


def test_occam_tends_to_brute_force_as_directions_grow(peak, monkeypatch):
    count = peak.density.weight_count
    errors = []
    for directions in (2, count // 2):
        monkeypatch.setattr(evidence, "DIRECTIONS", directions)
        squares = []
        for seed in range(4):
            monkeypatch.setattr(evidence, "SEED", seed)
            squares.append(np.square(occam(peak.density, peak.point, peak.precision) - peak.brute).sum())
        errors.append(np.sqrt(np.mean(squares)) / np.linalg.norm(peak.brute))
    # Half of an orthonormal basis leaves out some √(1/count) of a trace, two directions √(2/2) of it at most.
    assert errors[1] < 0.3
    assert errors[1] < errors[0] < 1.0


def test_occam_does_not_hang_on_signs_of_eigenvectors(peak, monkeypatch):
    expected = occam(peak.density, peak.point, peak.precision)
    eigh = np.linalg.eigh

    def flipped(matrix):
        values, vectors = eigh(matrix)
        return values[::-1], -vectors[:, ::-1]

    monkeypatch.setattr(np.linalg, "eigh", flipped)
    found = occam(peak.density, peak.point, peak.precision)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


# --- how functions vary --------------------------------------------------------------------------

VARYING = (
    "model.stiffness.log_sd={median: 0.2, log_sd: 0.5}",
    "model.stiffness.length_scale={phase: {median: 0.2, log_sd: 0.5}}",
    "model.stiffness.level={median: 300, log_sd: 0.7}",
    "model.damping={level: 20, input: [], log_sd: 0.2}",
    "model.mass={level: 1.5, sd: 0.2}",
)


@dataclass
class Quadratic:
    """Numbers y = G v + N(0, 1) of the weights v, at whose mode a density of that likelihood stands."""

    density: object
    measured: np.ndarray
    loading: np.ndarray
    mode: np.ndarray
    precision: np.ndarray
    roots: np.ndarray


def quadratic(*overrides):
    """Values of log K at the inducing inputs are measured; weights are those under the present hyperparameters."""
    density = density_of(small_problem(*VARYING, *overrides, axes=("x", "y")))
    count = density.weight_count
    generator = np.random.default_rng(4)
    loading = np.zeros((60, count))
    first = int(np.prod(density.shapes[0]))
    loading[:, :first] = 2.0 * generator.standard_normal((60, first)) / np.sqrt(first)
    truth = 2.5 * np.sin(np.arange(count))
    measured = loading @ truth + generator.standard_normal(60)
    inner = np.eye(count) + loading.T @ loading
    mode = np.concatenate([np.linalg.solve(inner, loading.T @ measured), density.start()[count:]])
    others = generator.standard_normal((len(mode) - count,) * 2)
    # What is beside the weights says nothing of them here.
    precision = block_diag(inner, others @ others.T + np.eye(len(others)))
    return Quadratic(density, measured, loading, mode, precision, _roots(density.functions[0]))


def _roots(function):
    with torch.no_grad():
        return np.linalg.cholesky(function.covariance_at_inducing()[:, 0].numpy())


def log_evidence(problem, log_sd, length_scale):
    """log p(y) with the kernel written out, and its hyperpriors, of axes that vary alike."""
    function = problem.density.functions[0]
    (column,) = function.covariance.active_dims.tolist()
    z = function.inducing[:, column].numpy()
    blocks = []
    for e, (a, b) in enumerate(function.places):
        covariance = log_sd**2 * (
            np.exp(-0.5 * ((z[:, None] - z) / length_scale) ** 2) + 1e-9 * np.eye(len(z))
        )
        white = np.linalg.solve(problem.roots[a], np.linalg.solve(problem.roots[a], covariance).T)
        assert e < function.axes or a != b
        blocks += [np.eye(1), white]
    rest = problem.density.weight_count - sum(len(block) for block in blocks)
    prior = block_diag(*blocks, np.eye(rest))
    covariance = problem.loading @ prior @ problem.loading.T + np.eye(len(problem.measured))
    hyperprior = -0.5 * ((np.log(log_sd / 0.2) / 0.5) ** 2 + (np.log(length_scale / 0.2) / 0.5) ** 2)
    return multivariate_normal(cov=covariance).logpdf(problem.measured) + hyperprior


def test_variation_is_where_the_evidence_is_greatest(monkeypatch):
    problem = quadratic(COUPLED)
    monkeypatch.setattr(evidence, "LARGEST_MOVE", 100.0)
    found = minimize(
        lambda x: -log_evidence(problem, np.exp(x[0]), np.exp(x[1])),
        np.log([0.2, 0.2]),
        method="Nelder-Mead",
        options={"xatol": 1e-7, "fatol": 1e-9},
    )
    _, moved = update_variation(problem.density, problem.mode, problem.precision)
    entries = {
        entry.name: entry.value.detach().reshape(-1).tolist() for entry in problem.density.model.entries
    }
    log_sd, length_scale = np.exp(found.x)
    # No limit stands in between: the bound of log-SDs is .5.
    assert log_sd < 0.45
    assert entries["stiffness.log_sd"] == pytest.approx([log_sd] * 2, rel=1e-3)
    assert entries["stiffness.length_scale"] == pytest.approx([length_scale] * 2, rel=1e-3)
    assert moved == pytest.approx(np.abs(np.log([log_sd / 0.2, length_scale / 0.2]) / 0.5).max(), rel=1e-2)


def test_one_turn_moves_only_so_far(monkeypatch):
    problem = quadratic(COUPLED)
    monkeypatch.setattr(evidence, "LARGEST_MOVE", 0.01)
    _, moved = update_variation(problem.density, problem.mode, problem.precision)
    assert 0.0 < moved <= 0.01 * (1.0 + 1e-9)


@pytest.mark.parametrize("overrides", [(), (COUPLED,)])
def test_functions_are_the_same_in_new_weights(overrides):
    problem = quadratic(*overrides)
    density = problem.density
    moved, _ = update_variation(density, problem.mode, problem.precision)
    assert not np.allclose(moved, problem.mode)
    rooted = _roots(density.functions[0]), problem.roots
    new, old = (density.weights(torch.from_numpy(point))[0].numpy() for point in (moved, problem.mode))
    for e, (a, _) in enumerate(density.functions[0].places):
        np.testing.assert_allclose(rooted[0][a] @ new[0, e, 1:], rooted[1][a] @ old[0, e, 1:], rtol=1e-8)
    # Levels and constants have no variation.
    np.testing.assert_array_equal(new[..., 0], old[..., 0])
    first = int(np.prod(density.shapes[0]))
    np.testing.assert_array_equal(moved[first:], problem.mode[first:])


def test_axes_that_do_not_couple_vary_each_in_its_own_way(monkeypatch):
    problem = quadratic()
    monkeypatch.setattr(evidence, "LARGEST_MOVE", 100.0)
    update_variation(problem.density, problem.mode, problem.precision)
    one, two = variation_entries(problem.density)[0].value.detach().reshape(-1).tolist()
    assert one != pytest.approx(two, rel=1e-3)


def test_hyperprior_of_coupled_axes_counts_once():
    for overrides, times in (((), 2), ((COUPLED,), 1)):
        density = density_of(small_problem(*VARYING, *overrides))
        with torch.no_grad():
            density.functions[0].covariance.sd = 0.4
        expected = times * -0.5 * (np.log(2.0) / 0.5) ** 2
        assert float(log_variation_prior(density).detach()) == pytest.approx(expected, rel=1e-12)
        stated = sum(float(log_hyperprior(entry).detach()) for entry in variation_entries(density))
        assert stated == pytest.approx(2 * expected / times, rel=1e-12)


def test_nothing_to_learn_of_variation():
    fixed = "model.stiffness={level: 300, input: [phase], log_sd: 0.2, length_scale: {phase: 0.2}}"
    density = density_of(small_problem(*VARYING, fixed))
    assert variation_entries(density) == []
    point = density.start()
    found, moved = update_variation(density, point, np.eye(len(point)))
    assert found is point
    assert moved == 0.0
    assert float(log_variation_prior(density)) == 0.0
