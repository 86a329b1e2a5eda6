"""A cell against dense algebra: FITC, growth while streaming, refresh, forgetting, and inputs that make it hard."""

import numpy as np
import pytest
from local_problems import ROWS, Problem, Taught, predict

from bayes_impedance.engines.local.cell import (
    LEAST_NOVELTY,
    Cell,
    choose,
    empty_cell,
    place,
    refresh,
    whitened,
)

SMALL = ("shared.residual=true",)


@pytest.fixture(scope="module")
def problem():
    """Phase, residual and errors: every term of the covariance is there."""
    return Problem.of("phase", SMALL, n=40, seed=1)


def inducing_rows(taught):
    """Samples of the problem that are inducing inputs, by axis, in their order."""
    found = []
    for axis, inputs in enumerate(taught.problem.inputs):
        n = taught.cell.used[axis]
        kept = taught.cell.inputs[axis, :, :n].T
        found.append([int(np.flatnonzero((inputs == z).all(axis=1))[0]) for z in kept])
    return found


def projected(problem, axis, seen, rows, inducing, target, weights=None):
    """Moments at `target` given samples `rows`, of which number i sees the inducing inputs `seen[i]` alone.

    r = k_Z K_ZZ⁻¹ f_Z + ε, with ε of variance σ² + δ: one joint Gaussian of f at all inducing inputs, conditioned by
    solve, without a whitening or a rotation. A weight divides the variance of ε.
    """
    x = problem.inputs[axis]
    z = x[inducing]
    k = problem.cross(axis, z, z)
    maps, noise = np.zeros((len(rows), len(inducing))), np.empty(len(rows))
    own = problem.own(axis, x)
    for i, row in enumerate(rows):
        m = seen[i]
        cross = problem.cross(axis, z[:m], x[[row]])[:, 0]
        maps[i, :m] = np.linalg.solve(k[:m, :m], cross)
        noise[i] = problem.noise[axis] + max(own[row] - cross @ maps[i, :m], 0.0)
    if weights is not None:
        noise = noise / weights
    gram = maps @ k @ maps.T + np.diag(noise)
    mean, variance = np.empty((2, len(target), 3))
    for column, latent in enumerate(ROWS):
        cross = maps @ problem.cross(axis, z, target, latent)
        solved = np.linalg.solve(gram, cross)
        mean[:, column] = solved.T @ problem.residual[axis, rows]
        variance[:, column] = problem.own(axis, target, latent) - (cross * solved).sum(axis=0)
    return mean, variance


def assert_close(found, expected, relative=1e-6):
    for one, other in zip(found, expected, strict=True):
        scale = np.abs(other).max(axis=0)
        assert (np.abs(one - other) <= relative * scale).all(), np.abs(one - other).max(axis=0) / scale


def between(problem):
    """Inputs that are no sample, but near them: means of neighbours."""
    return np.ascontiguousarray(0.5 * (problem.inputs[:, 1:] + problem.inputs[:, :-1])[:, ::3])


def test_fitc_when_all_inducing_inputs_are_there_from_the_start(problem):
    inducing = [0, 7, 15, 22, 31, 39]
    taught = Taught.empty(problem, 6)
    for axis in range(2):
        place(problem.numbers, axis, taught.cell, problem.inputs[axis, inducing])
    taught.novelty = np.inf
    rows = [t for t in range(40) if t not in inducing] + inducing
    taught.learn_all(rows)
    assert inducing_rows(taught) == [inducing, inducing]
    found = taught.predict(between(problem))
    for axis in range(2):
        expected = projected(problem, axis, [6] * 40, rows, inducing, between(problem)[axis])
        assert_close((found[0][axis], found[1][axis]), expected)


@pytest.mark.parametrize(("most", "novelty"), [(8, 0.3), (8, 60.0), (40, 10.0), (40, 0.3), (2, 0.0)])
def test_a_cell_that_grows_while_it_learns(problem, most, novelty):
    """Samples see the inducing inputs of their time; later ones are coordinates that they do not have."""
    taught = Taught.empty(problem, most, novelty)
    seen = []
    for t in range(40):
        taught.learn_all([t])
        seen.append(taught.cell.used.copy())
    inducing = inducing_rows(taught)
    found = taught.predict(between(problem))
    for axis in range(2):
        assert len(inducing[axis]) <= most
        counts = [int(one[axis]) for one in seen]
        expected = projected(problem, axis, counts, range(40), inducing[axis], between(problem)[axis])
        assert_close((found[0][axis], found[1][axis]), expected)


def test_every_sample_as_inducing_input_is_the_dense_gp(problem):
    taught = Taught.empty(problem, 40).learn_all()
    assert (taught.cell.used == 40).all()
    found = taught.predict(between(problem))
    for axis in range(2):
        x, target = problem.inputs[axis], between(problem)[axis]
        k = problem.cross(axis, x, x) + problem.noise[axis] * np.eye(40)
        mean, variance = np.empty((2, len(target), 3))
        for column, latent in enumerate(ROWS):
            cross = problem.cross(axis, x, target, latent)
            mean[:, column] = cross.T @ np.linalg.solve(k, problem.residual[axis])
            variance[:, column] = problem.own(axis, target, latent) - (cross * np.linalg.solve(k, cross)).sum(
                0
            )
        assert_close((found[0][axis], found[1][axis]), (mean, variance))


def test_novelty_decides_what_becomes_an_inducing_input(problem):
    """Exactly the samples whose variance, given those before, is above the bound, in variances of noise."""
    novelty = 10.0
    inducing = inducing_rows(Taught.empty(problem, 40, novelty).learn_all())
    for axis in range(2):
        x, expected = problem.inputs[axis], []
        own = problem.own(axis, x)
        for t in range(40):
            left = own[t]
            if expected:
                cross = problem.cross(axis, x[expected], x[[t]])[:, 0]
                left -= cross @ np.linalg.solve(problem.cross(axis, x[expected], x[expected]), cross)
            if left > novelty * problem.noise[axis]:
                expected.append(t)
        assert inducing[axis] == expected
        assert 2 < len(expected) < 40


def test_a_full_cell_goes_on_learning_and_takes_no_more_inputs(problem):
    taught = Taught.empty(problem, 3).learn_all([0, 10, 20])
    before = [array.copy() for array in taught.cell[:3]]
    narrow = taught.predict(between(problem))[1]
    taught.learn_all(range(21, 40))
    assert (taught.cell.used == 3).all()
    for one, other in zip(before, taught.cell[:3], strict=True):
        assert (one == other).all()
    assert (taught.predict(between(problem))[1] <= narrow * (1.0 + 1e-12)).all()
    assert taught.sums.samples[0] == 22


@pytest.mark.parametrize("most", [6, 40])
def test_refresh_changes_rounding_only(problem, most):
    taught = Taught.empty(problem, most, 1e-3).learn_all()
    assert taught.sums.stale[0] == 40
    before = taught.predict(between(problem))
    sums = [array.copy() for array in taught.sums]
    refresh(taught.cell, taught.sums, 1.0)
    assert taught.sums.stale[0] == 0
    for one, other in zip(sums[:3], taught.sums[:3], strict=True):
        assert (one == other).all()
    assert_close(taught.predict(between(problem)), before, relative=1e-9)


def test_refresh_in_the_middle_of_a_stream_changes_nothing_either(problem):
    plain = Taught.empty(problem, 10, 1e-3).learn_all()
    other = Taught.empty(problem, 10, 1e-3)
    for t in range(40):
        other.learn_all([t])
        refresh(other.cell, other.sums, 1.0)
    assert_close(other.predict(between(problem)), plain.predict(between(problem)), relative=1e-9)


def test_what_is_forgotten_weighs_less(problem):
    """`keep` multiplies the precision of every sample that was learned before it."""
    inducing = [0, 7, 15, 22, 31, 39]
    taught = Taught.empty(problem, 6)
    for axis in range(2):
        place(problem.numbers, axis, taught.cell, problem.inputs[axis, inducing])
    taught.learn_all(range(20))
    refresh(taught.cell, taught.sums, 0.25)
    taught.learn_all(range(20, 40))
    weights = np.where(np.arange(40) < 20, 0.25, 1.0)
    found = taught.predict(between(problem))
    for axis in range(2):
        expected = projected(problem, axis, [6] * 40, range(40), inducing, between(problem)[axis], weights)
        assert_close((found[0][axis], found[1][axis]), expected)


def test_who_read_a_cell_reads_the_same_ever_after(problem):
    taught = Taught.empty(problem, 30, 1e-3).learn_all(range(10))
    old = taught.cell
    before = predict(problem.numbers, old, between(problem))
    taught.learn_all(range(10, 40))
    assert (taught.cell.used > old.used).all()
    after = predict(problem.numbers, old, between(problem))
    assert (after[0] == before[0]).all()
    assert (after[1] == before[1]).all()


def test_an_empty_cell_predicts_the_prior(problem):
    target = between(problem)
    mean, variance = predict(problem.numbers, empty_cell(2, 4, problem.inputs.shape[-1]), target)
    assert (mean == 0.0).all()
    for axis in range(2):
        for column, latent in enumerate(ROWS):
            assert variance[axis, :, column] == pytest.approx(
                problem.own(axis, target[axis], latent), rel=1e-9
            )


def test_one_sample_ten_thousand_times(problem):
    """Its force becomes known as the noise over n says; nothing is lost, nothing grows."""
    taught = Taught.empty(problem, 5, 1e-3)
    x, residual = np.ascontiguousarray(problem.inputs[:, 4]), problem.residual[:, 4].copy()
    for _ in range(10_000):
        taught.learn(x, residual)
    assert (taught.cell.used == 1).all()
    mean, variance = taught.predict(x[:, None])
    for axis in range(2):
        own = problem.own(axis, x[[axis]])[0]
        noise = problem.noise[axis] / 10_000
        assert mean[axis, 0, 0] == pytest.approx(residual[axis] * own / (own + noise), rel=1e-9)
        # own − own²/(own + noise) to the digits that are left of it
        assert variance[axis, 0, 0] == pytest.approx(own * noise / (own + noise), abs=1e-12 * own)


@pytest.mark.parametrize("distance", [1e-4, 1e-6, 1e-9, 1e-15])
def test_samples_that_hardly_differ(problem, distance):
    """Near-singular inputs at the least novelty: factors and predictions stay finite, variances in their bounds."""
    generator = np.random.default_rng(0)
    taught = Taught.empty(problem, 30)
    taught.novelty = 0.0
    for _ in range(300):
        x = problem.inputs[:, 4] * (1.0 + distance * generator.standard_normal(problem.inputs[:, 4].shape))
        taught.learn(x, problem.residual[:, 4] + 0.1 * generator.standard_normal(2))
    assert all(np.isfinite(array).all() for array in (*taught.cell, *taught.sums))
    mean, variance = taught.predict(problem.inputs)
    assert np.isfinite(mean).all()
    for axis in range(2):
        for column, latent in enumerate(ROWS):
            prior = problem.own(axis, problem.inputs[axis], latent)
            assert (variance[axis, :, column] >= 0.0).all()
            assert (variance[axis, :, column] <= prior * (1.0 + 1e-6)).all()
    # Where all the samples are the mean of their forces is known.
    assert mean[:, 4, 0] == pytest.approx(problem.residual[:, 4], abs=0.05)


def test_chosen_inputs_are_those_of_a_pivoted_factorisation(problem):
    for axis in range(2):
        x = problem.inputs[axis]
        chosen = choose(problem.numbers, axis, x, 8, 1e-6).tolist()
        expected, own = [], problem.own(axis, x)
        for _ in range(8):
            left = own.copy()
            if expected:
                cross = problem.cross(axis, x[expected], x)
                left -= (cross * np.linalg.solve(problem.cross(axis, x[expected], x[expected]), cross)).sum(0)
            expected.append(int(np.argmax(left)))
        assert chosen == expected


def test_as_many_are_chosen_as_are_new(problem):
    x = np.repeat(problem.inputs[0][[3, 9]], 20, axis=0)
    assert sorted(choose(problem.numbers, 0, x, 10, 0.0) // 20) == [0, 1]
    assert choose(problem.numbers, 0, problem.inputs[0], 1, 0.0).size == 1
    assert choose(problem.numbers, 0, problem.inputs[0], 10_000, 0.0).size <= 40


def test_what_is_placed_twice_keeps_its_factor_positive(problem):
    cell = empty_cell(2, 4, problem.inputs.shape[-1])
    place(problem.numbers, 0, cell, np.ascontiguousarray(problem.inputs[0][[3, 3, 3]]))
    assert cell.used.tolist() == [3, 0]
    least = LEAST_NOVELTY * problem.own(0, problem.inputs[0][[3]])[0]
    assert (np.diagonal(cell.prior[0])[:3] ** 2 >= least * (1.0 - 1e-9)).all()


def test_many_at_once_are_what_is_learned_one_by_one(problem):
    inducing = [0, 7, 15, 22, 31, 39]
    taught = Taught.empty(problem, 6)
    for axis in range(2):
        place(problem.numbers, axis, taught.cell, problem.inputs[axis, inducing])
    taught.learn_all()
    for axis in range(2):
        white, scaled = whitened(
            problem.numbers,
            problem.noise[axis],
            axis,
            taught.cell,
            problem.inputs[axis],
            problem.residual[axis],
        )
        gram = np.triu(white.T @ white)
        assert np.triu(taught.sums.gram[axis]) == pytest.approx(gram, rel=1e-9, abs=1e-12 * gram.max())
        assert taught.sums.moment[axis] == pytest.approx(white.T @ scaled, rel=1e-9, abs=1e-9)


def test_the_factor_is_that_of_its_sums(problem):
    """UᵀU = I + Σ a aᵀ/(σ² + δ) after every kind of step, inputs that came late included."""
    taught = Taught.empty(problem, 12, 1e-3).learn_all()
    assert isinstance(taught.cell, Cell)
    for axis in range(2):
        n = taught.cell.used[axis]
        upper = np.triu(taught.cell.posterior[axis, :n, :n])
        gram = np.triu(taught.sums.gram[axis, :n, :n])
        assert np.triu(upper.T @ upper) == pytest.approx(gram + np.eye(n), rel=1e-9, abs=1e-12 * gram.max())
        assert upper.T @ taught.cell.d[axis, :n] == pytest.approx(taught.sums.moment[axis, :n], rel=1e-8)
