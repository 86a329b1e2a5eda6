"""Penalised regression beside stacked least squares, two stages beside the projection, choices beside loops."""

import numpy as np
import pytest

from bayes_impedance.baselines.phase_basis import PhaseBasis
from bayes_impedance.baselines.regression import WEIGHTS, fit

REPETITIONS = 4


@pytest.fixture(scope="module")
def problem():
    """Design of two blocks of splines, instruments beside it, forces, labels, a penalty for each block.

    The first has its weight, that of the second is to be chosen.
    """
    generator = np.random.default_rng(0)
    phase, label = np.tile(np.linspace(0, 1, 25), REPETITIONS), np.repeat(np.arange(REPETITIONS), 25)
    basis = PhaseBasis(6)(phase)
    cause = generator.standard_normal(phase.size)
    disturbed = cause + generator.standard_normal(phase.size)
    design = np.hstack([basis, basis * disturbed[:, None]])
    instruments = np.hstack([basis, basis * cause[:, None]])
    force = design @ np.sin(np.arange(12)) + 0.3 * generator.standard_normal(phase.size)
    penalty = PhaseBasis(6).penalty(1)
    penalties = [np.kron(np.diag(block), penalty) for block in ((1e-3, 0.0), (0.0, 1.0))]
    return design, instruments, force, label, penalties


def square_root(penalty: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(penalty)
    return np.sqrt(values.clip(0.0))[:, None] * vectors.T


def stacked(design, force, penalties, weight, n):
    """Least squares with the penalties as further rows."""
    rows = square_root(n * (penalties[0] + weight * penalties[1]))
    return np.linalg.lstsq(np.vstack([design, rows]), np.append(force, np.zeros(len(rows))), rcond=None)[0]


def projected(design, instruments):
    """X̂ = Q Qᵀ X, with Q an orthonormal basis of the instruments."""
    q, _ = np.linalg.qr(instruments)
    return q @ (q.T @ design)


def test_coefficients_are_those_of_stacked_least_squares(problem):
    design, _, force, label, penalties = problem
    found = fit(design, force, label, *penalties)
    expected = stacked(design, force, penalties, found.weight, len(force))
    np.testing.assert_allclose(found.coefficients, expected, rtol=1e-6, atol=1e-8)
    for repetition in range(REPETITIONS):
        rest = label != repetition
        expected = stacked(design[rest], force[rest], penalties, found.weight, len(force))
        np.testing.assert_allclose(found.left_out[repetition], expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("instrumented", [False, True])
def test_weight_predicts_left_out_repetitions_best(problem, instrumented):
    design, instruments, force, label, penalties = problem
    loss = {}
    for weight in WEIGHTS:
        loss[weight] = 0.0
        for repetition in range(REPETITIONS):
            rest, own = label != repetition, label == repetition
            seen = known = design
            if instrumented:
                first = np.linalg.lstsq(instruments[rest], design[rest], rcond=None)[0]
                seen = known = instruments @ first
            b = stacked(seen[rest], force[rest], penalties, weight, len(force))
            loss[weight] += float(np.sum((force[own] - known[own] @ b) ** 2))
    found = fit(design, force, label, *penalties, instruments if instrumented else None)
    assert loss[found.weight] == pytest.approx(min(loss.values()))


def test_two_stages_are_the_textbook_formula(problem):
    """(Xᵀ P_Z X)⁻¹ Xᵀ P_Z u with the projection on the instruments (Wooldridge, Econometric Analysis, §5.2)."""
    design, instruments, force, label, _ = problem
    free = [np.zeros((12, 12))] * 2
    found = fit(design, force, label, *free, instruments)
    projection = projected(np.eye(len(force)), instruments)
    expected = np.linalg.solve(design.T @ projection @ design, design.T @ projection @ force)
    np.testing.assert_allclose(found.coefficients, expected, rtol=1e-6, atol=1e-8)
    # Residuals are those of what was measured, not of its projection.
    left = [force[label == g] - design[label == g] @ found.left_out[g] for g in range(REPETITIONS)]
    assert found.residual_variance == pytest.approx(np.mean(np.concatenate(left) ** 2))
    hat = projected(design, instruments)
    np.testing.assert_allclose(
        found.covariance, found.residual_variance * np.linalg.inv(hat.T @ hat), rtol=1e-6, atol=1e-10
    )


def test_regressors_as_their_own_instruments_are_least_squares(problem):
    design, _, force, label, penalties = problem
    one, two = fit(design, force, label, *penalties), fit(design, force, label, *penalties, design)
    assert one.weight == two.weight
    np.testing.assert_allclose(one.coefficients, two.coefficients, rtol=1e-6, atol=1e-8)


def test_jackknife_is_the_scatter_of_left_out_estimates(problem):
    design, _, force, label, penalties = problem
    found = fit(design, force, label, *penalties)
    average = sum(found.left_out) / REPETITIONS
    expected = (
        sum(np.outer(b - average, b - average) for b in found.left_out) * (REPETITIONS - 1) / REPETITIONS
    )
    np.testing.assert_allclose(found.jackknife, expected, atol=1e-14)


def test_what_never_moves_has_no_part(problem):
    design, _, force, label, penalties = problem
    idle = np.zeros((len(force), 1))
    wider = [np.pad(penalty, (0, 1)) for penalty in penalties]
    found = fit(np.hstack([design, idle]), force, label, *wider)
    assert found.coefficients[-1] == 0.0
    np.testing.assert_allclose(
        found.coefficients[:-1], fit(design, force, label, *penalties).coefficients, rtol=1e-6
    )


@pytest.mark.parametrize("size", [1, 2, 3, 4, 9])
def test_splines_are_those_of_the_recursion(size):
    """Cox and de Boor, term by term."""
    phase = np.linspace(0.0, 1.0, 57)[:-1]
    degree = min(3, size - 1)
    knots = [0.0] * degree + list(np.linspace(0, 1, size - degree + 1)) + [1.0] * degree

    def value(i, k, t):
        if k == 0:
            return float(knots[i] <= t < knots[i + 1])
        rise, fall = knots[i + k] - knots[i], knots[i + k + 1] - knots[i + 1]
        up = (t - knots[i]) / rise * value(i, k - 1, t) if rise else 0.0
        return up + ((knots[i + k + 1] - t) / fall * value(i + 1, k - 1, t) if fall else 0.0)

    expected = [[value(i, degree, t) for i in range(size)] for t in phase]
    np.testing.assert_allclose(PhaseBasis(size)(phase), expected, atol=1e-13)


def test_phases_beyond_the_ends_count_as_the_ends():
    basis = PhaseBasis(7)
    np.testing.assert_array_equal(basis(np.array([-0.1, 1.01])), basis(np.array([0.0, 1.0])))


def test_penalties_leave_constants_and_lines():
    line = np.arange(7.0)
    basis = PhaseBasis(7)
    assert line @ basis.penalty(2) @ line == pytest.approx(0.0, abs=1e-12)
    assert line @ basis.penalty(1) @ line == pytest.approx(6.0)
    assert (line**2) @ basis.penalty(2) @ (line**2) == pytest.approx(5 * 2.0**2)
