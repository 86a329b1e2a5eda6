"""Many cells: one that holds all is dense, a stream is its batch, memory is bounded, coverage says what is known."""

import sys
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
from local_problems import ROWS, Problem

from bayes_impedance.config import LocalConfig
from bayes_impedance.engines.local import build, model
from bayes_impedance.engines.local.build import build_local
from bayes_impedance.engines.local.cell import place
from bayes_impedance.engines.local.grid import Grid, weights_of
from bayes_impedance.engines.local.model import Coverage, LocalModel
from bayes_impedance.errors import ConfigurationError

EVERYTHING = LocalConfig(inducing=200, novelty=0.0, active=1)
SHARED = ("shared.residual=true",)


def between(problem):
    return np.ascontiguousarray(0.5 * (problem.inputs[:, 1:] + problem.inputs[:, :-1])[:, ::3])


def predict(local, target):
    """Means and variances at `(axes, m, D)`, `(axes, m, 3)` each."""
    found = [local.view.predict(np.ascontiguousarray(target[:, t])) for t in range(target.shape[1])]
    return np.stack([one.mean for one in found], axis=1), np.stack([one.variance for one in found], axis=1)


def stream(local, problem, rows=None):
    for t in range(problem.inputs.shape[1]) if rows is None else rows:
        local.learn(np.ascontiguousarray(problem.inputs[:, t]), problem.residual[:, t].copy())
    return local


def assert_close(found, expected, relative):
    for one, other in zip(found, expected, strict=True):
        scale = np.abs(other).max(axis=(0, 1))
        assert (np.abs(one - other) <= relative * scale).all(), np.abs(one - other).max(axis=(0, 1)) / scale


@pytest.fixture(scope="module")
def problem():
    return Problem.of("phase", SHARED, n=60, seed=2)


@pytest.fixture(scope="module")
def wide():
    """θ = [x, ẋ]: a grid of four dimensions."""
    return Problem.of("position_velocity", SHARED, n=80, seed=2)


def local_of(problem, **settings):
    return build_local(problem.model, problem.feature_map, LocalConfig(**settings), problem.inputs[0])


@pytest.mark.parametrize("way", ["stream", "batch"])
@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("phase", SHARED),
        ("phase", ("model.desired_trajectory.kernel=matern52",)),
        ("position", ()),
        ("position_velocity", SHARED),
        ("time", ()),
    ],
    ids=lambda value: value if isinstance(value, str) else ",".join(value),
)
def test_one_cell_with_every_sample_is_dense(name, overrides, way):
    """Issue: "one cell with every point as inducing input equals dense to 1e-6"."""
    problem = Problem.of(name, overrides, n=60, seed=2)
    local = problem.whole(EVERYTHING)
    if way == "stream":
        stream(local, problem)
    else:
        local.learn_all(problem.inputs, problem.residual)
    assert list(local.cells) == [0]
    target = between(problem)
    expected = np.empty((2, *target.shape[:2], 3))
    for axis in range(2):
        x = problem.inputs[axis]
        k = problem.cross(axis, x, x) + problem.noise[axis] * np.eye(len(x))
        for column, latent in enumerate(ROWS):
            cross = problem.cross(axis, x, target[axis], latent)
            solved = np.linalg.solve(k, cross)
            expected[0, axis, :, column] = solved.T @ problem.residual[axis]
            expected[1, axis, :, column] = problem.own(axis, target[axis], latent) - (cross * solved).sum(0)
    assert_close(predict(local, target), expected, 1e-6)


def copy_of(problem, inducing=8, n=100_000):
    """A long stream over the places of `problem`, and two models with the same inducing inputs."""
    generator = np.random.default_rng(3)
    rows = generator.integers(0, problem.inputs.shape[1], size=n)
    residual = problem.residual[:, rows] + generator.standard_normal((2, n))
    inputs = np.ascontiguousarray(problem.inputs[:, rows])
    one, other = (problem.whole(LocalConfig(inducing=inducing, active=1)) for _ in range(2))
    other.learn_all(inputs, residual)
    # The stream begins with the inputs that the batch has chosen, and without a sample.
    cell = one._visit(0)
    for axis in range(2):
        chosen = other.cells[0].inputs[axis, :, : other.cells[0].used[axis]].T
        place(problem.numbers, axis, cell, np.ascontiguousarray(chosen))
    one.cells[0] = cell
    return one, other, inputs, residual


def test_a_stream_is_its_batch_after_100_000_updates(problem):
    """Issue: "incremental equals batch to 1e-8 after 100 000 updates"; refreshed a hundred times on the way."""
    one, other, inputs, residual = copy_of(problem)
    x = np.ascontiguousarray(inputs.transpose(1, 0, 2))
    y = np.ascontiguousarray(residual.T)
    for t in range(len(x)):
        one.learn(x[t], y[t])
    assert one.sums[0].samples[0] == other.sums[0].samples[0] == 100_000
    assert_close(predict(one, between(problem)), predict(other, between(problem)), 1e-8)


def test_without_a_refresh_a_stream_is_its_batch_too(problem, monkeypatch):
    monkeypatch.setattr(model, "REFRESH", 10**9)
    one, other, inputs, residual = copy_of(problem, n=5_000)
    for t in range(5_000):
        one.learn(np.ascontiguousarray(inputs[:, t]), residual[:, t].copy())
    assert one.sums[0].stale[0] == 5_000
    assert_close(predict(one, between(problem)), predict(other, between(problem)), 1e-9)


def test_many_cells_in_a_stream_and_in_a_batch(wide):
    """With room for every sample both have the same inducing inputs, in another order."""
    settings = {"inducing": 80, "novelty": 0.0, "active": 3, "width": {"position": 0.15, "velocity": 0.8}}
    one, other = stream(local_of(wide, **settings), wide), local_of(wide, **settings)
    other.learn_all(wide.inputs, wide.residual)
    assert set(one.cells) == set(other.cells)
    assert len(one.cells) > 5
    for code in one.cells:
        assert one.sums[code].samples[0] == other.sums[code].samples[0]
    assert_close(predict(one, between(wide)), predict(other, between(wide)), 1e-6)


def test_each_cell_has_learned_the_samples_that_it_is_near_to(wide):
    local = stream(local_of(wide, active=4), wide)
    codes, _ = weights_of(local.grid, wide.inputs[0], 4)
    for code in local.cells:
        assert local.sums[code].samples[0] == (codes == code).sum()
    assert sum(int(sums.samples[0]) for sums in local.sums.values()) == 4 * 80


def test_a_prediction_is_the_mixture_of_its_cells(wide):
    """Mean Σ g y / Σ g, variance that of the mixture: the means' own spread is in it."""
    local = stream(local_of(wide, active=5), wide)
    target = between(wide)
    codes, weights = weights_of(local.grid, target[0], 5)
    mean, variance = predict(local, target)
    several = 0
    for t in range(target.shape[1]):
        members, g = [], []
        for code, weight in zip(codes[t], weights[t], strict=True):
            if code in local.cells:
                alone = replace(local, cells={int(code): local.cells[int(code)]})
                members.append(alone.view.predict(np.ascontiguousarray(target[:, t])))
                g.append(weight)
        g = np.array(g) / sum(g)
        several += len(g) > 1
        first = sum(w * one.mean for w, one in zip(g, members, strict=True))
        second = sum(w * (one.variance + one.mean**2) for w, one in zip(g, members, strict=True))
        assert mean[:, t] == pytest.approx(first, rel=1e-9, abs=1e-12)
        assert variance[:, t] == pytest.approx(second - first**2, rel=1e-6, abs=1e-12)
    assert several > 10


def test_memory_does_not_grow(problem):
    """20 000 samples more leave no object behind, and 2 000 no byte, once the cells are there."""
    local = stream(local_of(problem, inducing=6, active=2), problem)
    cells = len(local.cells)
    generator = np.random.default_rng(0)

    def learn(samples):
        for t in range(samples):
            local.learn(np.ascontiguousarray(problem.inputs[:, t % 60]), generator.standard_normal(2))

    learn(5_000)
    before = sys.getallocatedblocks()
    learn(20_000)
    assert sys.getallocatedblocks() - before < 1_000
    tracemalloc.start()
    try:
        # Arrays that are replaced while they are traced count from here on.
        learn(200)
        before = tracemalloc.get_traced_memory()[0]
        learn(2_000)
        assert tracemalloc.get_traced_memory()[0] - before < 10_000
    finally:
        tracemalloc.stop()
    assert len(local.cells) == len(local.sums) == cells


def test_capacity_is_never_exceeded_and_the_first_cells_stay(wide):
    settings = {"cells": 4, "active": 3, "width": {"position": 0.1, "velocity": 0.4}}
    one, other = local_of(wide, **settings), local_of(wide, **settings)
    found = [
        one.learn(np.ascontiguousarray(wide.inputs[:, t]), wide.residual[:, t].copy()) for t in range(80)
    ]
    assert len(one.cells) == len(one.sums) == 4
    assert found[0] is Coverage.LEARNED
    assert Coverage.UNVISITED in found
    other.learn_all(wide.inputs, wide.residual)
    # A batch takes the cells that the stream would have come to first.
    assert set(other.cells) == set(one.cells)
    last = next(t for t in range(79, 0, -1) if found[t] is Coverage.UNVISITED)
    x = np.ascontiguousarray(wide.inputs[:, last])
    assert one.view.predict(x).coverage is Coverage.UNVISITED


def test_coverage_and_the_prior_where_nothing_is_known(problem):
    local = local_of(problem)
    x = np.ascontiguousarray(problem.inputs[:, 5])
    away = x.copy()
    away[:, problem.feature_map.layout.theta[0]] = 1e6
    for place_, coverage in ((x, Coverage.UNVISITED), (away, Coverage.OUTSIDE)):
        found = local.view.predict(place_)
        assert found.coverage is coverage
        assert (found.mean == 0.0).all()
        for axis in range(2):
            prior = [problem.own(axis, place_[[axis]], latent)[0] for latent in ROWS]
            assert found.variance[axis] == pytest.approx(prior, rel=1e-9)
    assert local.learn(away, np.ones(2)) is Coverage.OUTSIDE
    assert not local.cells
    assert not local.sums
    assert local.learn(x, np.ones(2)) is Coverage.LEARNED
    assert local.view.predict(x).coverage is Coverage.LEARNED
    assert local.view.predict(away).coverage is Coverage.OUTSIDE


def test_nan_is_a_place_outside_and_teaches_nothing(problem):
    local = stream(local_of(problem), problem)
    before = {code: [array.copy() for array in sums] for code, sums in local.sums.items()}
    x = np.ascontiguousarray(problem.inputs[:, 5])
    x[:, problem.feature_map.layout.theta[0]] = np.nan
    assert local.learn(x, np.ones(2)) is Coverage.OUTSIDE
    for code, sums in local.sums.items():
        for one, other in zip(before[code], sums, strict=True):
            assert (one == other).all()


def test_what_is_forgotten_has_the_documented_weight(problem):
    """A sample weighs 1/e after `forgetting` more of its cell, in steps of a twentieth; the newest weighs one."""
    memory = 40.0
    settings = LocalConfig(inducing=60, novelty=0.0, active=1, forgetting=memory)
    local = stream(problem.whole(settings), problem)
    assert local.refresh_every == 2
    # Before sample t = 2, 4, … all earlier ones lose a twentieth of a 1/e.
    steps = np.array([sum(1 for later in range(t + 1, 60) if later % 2 == 0) for t in range(60)])
    weights = np.exp(-2.0 * steps / memory)
    age = 59 - np.arange(60)
    assert np.abs(np.log(weights) + age / memory).max() <= 1.0 / 20.0 + 1e-12
    target = between(problem)
    found = predict(local, target)
    for axis in range(2):
        x = problem.inputs[axis]
        k = problem.cross(axis, x, x) + np.diag(problem.noise[axis] / weights)
        cross = problem.cross(axis, x, target[axis])
        expected = cross.T @ np.linalg.solve(k, problem.residual[axis])
        assert found[0][axis, :, 0] == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("memory", [0.1, 1.0])
def test_with_the_shortest_memory_the_newest_sample_is_believed(problem, memory):
    local = problem.whole(LocalConfig(active=1, forgetting=memory))
    x = np.ascontiguousarray(problem.inputs[:, 7])
    for value in (5.0, -5.0, 5.0):
        local.learn(x, np.full(2, value))
    mean = local.view.predict(x).mean[:, 0]
    older = np.exp(-1.0 / memory)
    for axis in range(2):
        own, noise = problem.own(axis, x[[axis]])[0], problem.noise[axis]
        total = 1.0 + older + older**2
        expected = 5.0 * (1.0 - older + older**2) * own / (total * own + noise)
        assert mean[axis] == pytest.approx(expected, rel=1e-6)


def test_how_often_a_factor_is_computed_anew(problem):
    def every(forgetting):
        return problem.whole(LocalConfig(forgetting=forgetting)).refresh_every

    assert [every(value) for value in (None, 1e9, 20_000.0, 10_000.0, 40.0, 20.0, 1.0, 0.01)] == [
        1000, 1000, 1000, 500, 2, 1, 1, 1,
    ]  # fmt: skip


def test_a_snapshot_stays_what_it_was(wide):
    local = stream(local_of(wide, active=3), wide, range(40))
    snapshot = local.snapshot
    target = between(wide)
    before = [snapshot.predict(np.ascontiguousarray(target[:, t])) for t in range(target.shape[1])]
    stream(local, wide, range(40, 80))
    for t, old in enumerate(before):
        new = snapshot.predict(np.ascontiguousarray(target[:, t]))
        assert (new.mean == old.mean).all()
        assert (new.variance == old.variance).all()
        assert new.coverage is old.coverage
    changed = [local.view.predict(np.ascontiguousarray(target[:, t])) for t in range(target.shape[1])]
    assert any((new.mean != old.mean).any() for new, old in zip(changed, before, strict=True))


def test_compiling_teaches_nothing(problem):
    local = local_of(problem)
    local.compile(np.ascontiguousarray(problem.inputs[:, 0]))
    assert not local.cells
    assert not local.sums


def test_nothing_is_left_to_compile(wide):
    """Not for a first sample, nor where fewer cells are near than may be, nor outside, nor after a refresh."""
    dispatchers = (model.nearest, model.learn_near, model.predict_near, model.prior_variances, model.refresh)
    # A number of active cells that nothing else here has: its versions are not yet there.
    local = local_of(wide, active=7, cells=9, forgetting=20.0, width={"position": 0.15, "velocity": 0.8})
    x = np.ascontiguousarray(wide.inputs[:, 0])
    local.compile(x)
    before = [len(dispatcher.signatures) for dispatcher in dispatchers]
    found = {local.view.predict(x).coverage, local.learn(x + 1e3, np.ones(2))}
    for t in range(80):
        x = np.ascontiguousarray(wide.inputs[:, t])
        found |= {local.learn(x, wide.residual[:, t].copy()), local.view.predict(x).coverage}
    assert found == set(Coverage)
    assert [len(dispatcher.signatures) for dispatcher in dispatchers] == before


def test_blocks_and_candidates_bound_memory_and_change_nothing(problem, monkeypatch):
    one, other = (problem.whole(LocalConfig(inducing=10, active=1)) for _ in range(2))
    one.learn_all(problem.inputs, problem.residual)
    monkeypatch.setattr(model, "BLOCK", 7)
    other.learn_all(problem.inputs, problem.residual)
    assert_close(predict(one, between(problem)), predict(other, between(problem)), 1e-9)
    monkeypatch.setattr(model, "CANDIDATES", 5)
    few = problem.whole(LocalConfig(inducing=10, active=1))
    few.learn_all(problem.inputs, problem.residual)
    assert few.cells[0].used.max() <= 5
    assert few.sums[0].samples[0] == 60


# --- the grid that a model gets ----------------------------------------------------------------------


def test_cells_are_a_length_scale_of_the_desired_trajectory_wide(wide):
    local = local_of(wide)
    with torch.no_grad():
        scales = wide.model.kernel.impedance.trajectory.lengthscale.reshape(2, 4).amin(0).numpy()
    assert local.grid.width == pytest.approx(scales)
    assert local.grid.columns.tolist() == list(wide.feature_map.layout.theta)


def test_the_grid_reaches_one_cell_beyond_the_motion(wide):
    local = local_of(wide, width={"position": 0.07})
    place_ = wide.inputs[0][:, local.grid.columns]
    cells = (place_ - local.grid.lower) / local.grid.width
    assert (cells.min(axis=0) >= 1.0).all()
    assert (cells.min(axis=0) < 2.0).all()
    assert (cells.max(axis=0) <= local.grid.shape - 1.0).all()
    assert (cells.max(axis=0) > local.grid.shape - 2.0).all()
    assert local.grid.width.tolist() == [0.07, 0.07]


def test_a_motion_that_rests_has_three_cells(problem):
    still = np.repeat(problem.inputs[0][:1], 5, axis=0)
    local = build_local(problem.model, problem.feature_map, LocalConfig(), still)
    assert local.grid.shape.tolist() == [3]
    assert local.learn(np.ascontiguousarray(problem.inputs[:, 0]), np.ones(2)) is Coverage.LEARNED


def test_widths_of_components_that_are_not_in_the_model_are_refused(problem):
    with pytest.raises(
        ConfigurationError,
        match=r"engine.local.width: expected components that the model depends on \(phase, .*\), got time; remove it",
    ):
        local_of(problem, width={"time": 0.1})


def test_widths_by_a_component_of_xi_make_the_grid(problem):
    local = local_of(problem, width={"phase": 0.25, "position": 0.1})
    assert local.grid.columns.tolist() == [
        *problem.feature_map.layout.theta, *problem.feature_map.active_dims(("position",)),
    ]  # fmt: skip
    assert stream(local, problem).cells


def test_cells_too_small_to_be_counted_are_refused(wide):
    with pytest.raises(
        ConfigurationError,
        match=r"expected cells of which at most 9.0072e\+15 cover the range of motion, got 7.1e\+22; widen them",
    ):
        local_of(wide, width={"position": 1e-6, "velocity": 1e-6})
    assert build.MOST == 2**53


def test_a_model_of_one_cell_needs_no_neighbours(problem):
    grid = Grid(np.array([0]), np.array([-1.0]), np.array([9.0]), np.array([1]))
    local = LocalModel(problem.numbers, problem.noise, grid, LocalConfig(active=9), problem.inputs.shape[-1])
    stream(local, problem)
    assert list(local.cells) == [0]
