"""Paths against differences and geometry, and a pace whose phase never stands still."""

from __future__ import annotations

import math

import numpy as np
import pytest
from arm_oracles import Array
from hypothesis import given
from hypothesis import strategies as st

from bayes_impedance.errors import SimulationError
from bayes_impedance.simulation.arm import Arm
from bayes_impedance.simulation.tasks import (
    CENTRE,
    TASKS,
    FigureEight,
    Flower,
    Pace,
    Path,
    Reaches,
    Run,
    desired_motion,
    minimum_jerk,
)

PATHS = {
    "flower": Flower(),
    "figure-eight": FigureEight(),
    "reaches": Reaches(),
    "few reaches": Reaches(targets=1, dwell=0.0),
}
#: Phases at which the flower and the reaches have corners.
CORNERS = {
    "flower": np.cumsum([0.0, 2.0, 1.5, 1.5, 1.5, 1.5]) / 8.0,
    "figure-eight": np.array([0.0, 1.0]),
    "reaches": np.linspace(0.0, 1.0, 9),
    "few reaches": np.linspace(0.0, 1.0, 3),
}


@pytest.fixture(params=PATHS)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


# --- paths ---------------------------------------------------------------------------------------


def test_derivatives_are_those_of_position(name: str) -> None:
    path, size = PATHS[name], 1e-5
    phase = np.linspace(0.003, 0.997, 331)
    before, now, after = (path(phase + k * size) for k in (-1, 0, 1))
    far = np.abs(phase[:, None] - CORNERS[name]).min(1) > 2 * size
    scale = [np.abs(part).max() for part in now]
    for order in (0, 1):
        differences = (after[order] - before[order]) / (2 * size)
        np.testing.assert_allclose(differences[far], now[order + 1][far], atol=1e-5 * scale[order + 1])


def test_path_is_closed(name: str) -> None:
    ends = PATHS[name](np.array([0.0, 1.0]))
    for part in ends:
        np.testing.assert_allclose(part[0], part[1], atol=1e-12)


def test_position_velocity_and_acceleration_are_continuous_at_corners(name: str) -> None:
    path, corners = PATHS[name], CORNERS[name][1:-1]
    for size in (1e-6, 1e-8):
        for order, (left, right) in enumerate(zip(path(corners - size), path(corners + size), strict=True)):
            scale = np.abs(path(np.linspace(0.0, 1.0, 101))[order]).max()
            np.testing.assert_allclose(left, right, atol=200.0 * size * scale)


def test_length_is_that_of_a_fine_polygon(name: str) -> None:
    points = PATHS[name](np.linspace(0.0, 1.0, 20_001))[0]
    polygon = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    np.testing.assert_allclose(PATHS[name].length, polygon, rtol=1e-5)


def test_every_path_is_within_reach_of_the_default_arm(name: str) -> None:
    assert np.isfinite(Arm().posture(PATHS[name](np.linspace(0.0, 1.0, 1001))[0])).all()


def test_centre_moves_the_path(name: str) -> None:
    kind = type(PATHS[name])
    phase = np.linspace(0.0, 1.0, 50)
    there, here = kind(centre=(0.1, 0.2))(phase)[0], kind()(phase)[0]
    np.testing.assert_allclose(there - here, np.tile([0.1 - CENTRE[0], 0.2 - CENTRE[1]], (50, 1)), atol=1e-15)


@pytest.mark.parametrize("radius", [0.04, 0.03])
def test_flower_is_a_circle_and_four_arcs_of_270_degrees_around_it(radius: float) -> None:
    path, corners = Flower(radius=radius), CORNERS["flower"]
    centres = radius * np.array(
        [[0, 0], [0, math.sqrt(2)], [-math.sqrt(2), 0], [0, -math.sqrt(2)], [math.sqrt(2), 0]]
    )
    for middle, begin, end, turn in zip(
        centres, corners[:-1], corners[1:], [2 * np.pi] + 4 * [1.5 * np.pi], strict=True
    ):
        phase = np.linspace(begin + 1e-12, end - 1e-12, 401)
        away = path(phase)[0] - np.asarray(CENTRE) - middle
        np.testing.assert_allclose(np.hypot(*away.T), radius, rtol=1e-9)
        angle = np.unwrap(np.arctan2(away[:, 1], away[:, 0]))
        np.testing.assert_allclose(angle[-1] - angle[0], turn, rtol=1e-9)
        assert (np.diff(angle) >= 0).all()
    # Where one piece ends, on the circle and 90° apart, the next begins.
    joints = path(corners)[0] - np.asarray(CENTRE)
    np.testing.assert_allclose(np.hypot(*joints.T), radius, rtol=1e-9)
    quarters = np.unwrap(np.arctan2(joints[1:, 1], joints[1:, 0])) / (0.5 * np.pi)
    np.testing.assert_allclose(quarters, 0.5 + np.arange(5), atol=1e-9)


def test_reaches_go_out_rest_and_come_back_to_the_centre() -> None:
    path = Reaches(distance=0.08, targets=3, dwell=0.25)
    for k in range(3):
        target = np.asarray(CENTRE) + 0.08 * np.array([np.cos(2 * np.pi * k / 3), np.sin(2 * np.pi * k / 3)])
        resting = (2 * k + np.array([0.76, 0.9, 0.99])) / 6.0
        np.testing.assert_allclose(path(resting)[0], np.tile(target, (3, 1)), atol=1e-12)
        np.testing.assert_allclose(path(resting + 1 / 6)[0], np.tile(CENTRE, (3, 1)), atol=1e-12)
        np.testing.assert_allclose(path(resting)[1], 0.0, atol=1e-12)


def test_minimum_jerk_is_the_polynomial_that_rests_at_both_ends() -> None:
    polynomial = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    share = np.linspace(0.0, 1.0, 21)
    for order, part in enumerate(minimum_jerk(share)):
        expected = (polynomial.deriv(order) if order else polynomial)(share)
        np.testing.assert_allclose(part, expected, atol=1e-12)


def test_tasks_have_the_names_of_the_command_line() -> None:
    assert {name: kind() for name, kind in TASKS.items()} == {
        "flower": Flower(),
        "figure-eight": FigureEight(),
        "reaches": Reaches(),
    }


# --- pace ----------------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 2**32),
    repetition=st.floats(0.5, 30.0),
    spread=st.floats(0.0, 0.49),
    unevenness=st.floats(0.0, 0.49),
    repetitions=st.integers(1, 4),
)
def test_phase_increases_strictly_from_0_to_below_1_in_every_repetition(
    seed: int, repetition: float, spread: float, unevenness: float, repetitions: int
) -> None:
    run = Pace(repetition, spread, unevenness).draw(repetitions, np.random.default_rng(seed))
    time = np.arange(0.0, repetitions * run.duration, run.duration / 997.3)
    phase, rate, _ = run.phase(time)
    which = run.repetition(time)
    np.testing.assert_array_equal(np.unique(which), np.arange(repetitions))
    assert ((phase >= 0) & (phase < 1)).all()
    assert (np.diff(phase)[np.diff(which) == 0] > 0).all()
    assert (rate > 0.3 / run.duration).all()
    begins = np.flatnonzero(np.diff(which, prepend=-1))
    assert (phase[begins] < 0.003).all() and (phase[begins[1:] - 1] > 0.997).all()


@pytest.fixture
def run() -> Run:
    return Run(3.0, np.array([0.4, -0.7, 0.1]))


def test_rates_of_phase_are_its_derivatives(run: Run) -> None:
    time, size = np.linspace(0.01, 8.99, 400), 1e-5
    before, now, after = (run.phase(time + k * size) for k in (-1, 0, 1))
    inside = run.repetition(time - size) == run.repetition(time + size)
    for order in (0, 1):
        differences = (after[order] - before[order]) / (2 * size)
        np.testing.assert_allclose(differences[inside], now[order + 1][inside], atol=1e-8)


def test_pace_is_smooth_from_one_repetition_to_the_next(run: Run) -> None:
    for join in (3.0, 6.0):
        before, after = (run.phase(np.array([join + size])) for size in (-1e-9, 1e-9))
        np.testing.assert_allclose(before[0] - 1.0, after[0], atol=1e-8)
        np.testing.assert_allclose(before[1], after[1], atol=1e-8)
        np.testing.assert_allclose(before[2], after[2], atol=1e-7)


def test_first_half_is_as_much_quicker_as_pace_says(run: Run) -> None:
    for k, amount in enumerate(run.uneven):
        first = run.phase(np.array([3.0 * k + 1.5]))[0][0]
        ratio = (1 + amount / np.pi) / (1 - amount / np.pi)
        np.testing.assert_allclose(first / (1 - first), ratio, rtol=1e-9)


def test_pace_varies_as_much_as_is_asked_for() -> None:
    pace, generator = Pace(8.0, 0.1, 0.2), np.random.default_rng(0)
    runs = [pace.draw(3, generator) for _ in range(2000)]
    durations = np.array([run.duration for run in runs])
    np.testing.assert_allclose(np.median(durations), 8.0, rtol=0.01)
    np.testing.assert_allclose(np.log(durations).std(), 0.1, rtol=0.05)
    np.testing.assert_allclose(np.array([run.uneven for run in runs]).std(), 0.2, rtol=0.05)


@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)
def test_desired_motion_is_twice_differentiable_through_all_repetitions(path: Path, run: Run) -> None:
    time, size = np.linspace(0.0, 8.99, 9000), 1e-5

    def position(shift: float) -> Array:
        return desired_motion(path, run, time[1:] + shift)[0]

    _, velocity, acceleration = (part[1:] for part in desired_motion(path, run, time))
    first = (position(size) - position(-size)) / (2 * size)
    np.testing.assert_allclose(first, velocity, atol=1e-7)
    second = (position(10 * size) - 2 * position(0.0) + position(-10 * size)) / (10 * size) ** 2
    np.testing.assert_allclose(second, acceleration, atol=2e-3 * np.abs(acceleration).max() + 1e-3)
    # No steps: neighbours differ by less than the largest jerk allows.
    assert np.abs(np.diff(acceleration, axis=0)).max() < 0.05 * np.abs(acceleration).max()


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arrange", "sentence"),
    [
        (lambda: Flower(radius=0.0), "radius: expected a finite value > 0, got 0; choose one"),
        (lambda: FigureEight(width=-0.1), "width: expected a finite value > 0, got -0.1; choose one"),
        (lambda: FigureEight(height=math.inf), "height: expected a finite value > 0, got inf; choose one"),
        (lambda: Reaches(distance=math.nan), "distance: expected a finite value > 0, got nan; choose one"),
        (lambda: Reaches(targets=0), "targets: expected at least 1, got 0; name one or more"),
        (lambda: Reaches(dwell=1.0), "dwell: expected a share in [0, 1), got 1; leave time to move"),
        (
            lambda: Pace(repetition=-1.0),
            "pace.repetition: expected a finite value > 0, got -1; choose one",
        ),
        (
            lambda: Pace(spread=0.5),
            "pace.spread: expected a share in [0, 0.5), got 0.5; choose a smaller one",
        ),
        (
            lambda: Pace(unevenness=math.nan),
            "pace.unevenness: expected a share in [0, 0.5), got nan; choose a smaller one",
        ),
    ],
)
def test_what_nobody_can_trace_is_refused(arrange, sentence: str) -> None:
    with pytest.raises(SimulationError) as caught:
        arrange()
    assert str(caught.value) == sentence
