"""The compiled integration against its equations, exact invariants, linearisation and another integrator."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from arm_oracles import Array, acceleration, integrated, plan, quiet, resting
from scipy.integrate import simpson
from scipy.linalg import expm

from bayes_impedance.errors import SimulationError
from bayes_impedance.simulation.arm import Arm, arm_with
from bayes_impedance.simulation.dynamics import Drive, Motion, integrate
from bayes_impedance.simulation.tasks import FigureEight, Flower, Path, Run

STEP = 1e-3
MASS, DAMPING, NONE = np.array([2.0, 2.5]), np.array([6.0, 4.0]), np.zeros(2)
SLACK = Arm(muscle_stiffness=0.0)
HAND = np.array([0.30, 0.325])
SLOW, QUICK = Run(10.0, np.array([0.1, -0.2, 0.05])), Run(2.0, np.array([0.2]))


def traced(arm: Arm, path: Path, run: Run, step: float) -> Motion:
    """The motion along a path, without noise and perturbation."""
    n = round(run.duration * len(run.uneven) / step)
    return integrate(arm, MASS, DAMPING, quiet(plan(arm, path, run, 0.5 * step * np.arange(2 * n - 1))), step)


# --- the equations -------------------------------------------------------------------------------


@pytest.mark.parametrize("servo", [False, True], ids=["force", "servo"])
def test_acceleration_is_that_of_the_equations_of_motion(servo: bool) -> None:
    generator = np.random.default_rng(2)
    arm, gains = arm_with("low", co_contraction=1.5), (900.0, 70.0)
    for _ in range(20):
        q = arm.posture(HAND + generator.normal(0.0, 0.03, 2))
        start = np.concatenate([q, generator.normal(0.0, 2.0, 2)])
        planned = np.concatenate([q, np.zeros(4)]) + generator.normal(0.0, 0.2, 6)
        noise, force, sensor = generator.normal(size=6), generator.normal(size=2), generator.normal(size=2)
        commanded = np.concatenate([[1.0], arm.hand(q), NONE]) + generator.normal(0.0, 0.1, 5)
        rows = commanded[None] if servo else np.empty((0, 5))
        drive = Drive(planned[None], noise[None], force[None], sensor[None], rows, gains, start)
        motion = integrate(arm, MASS, DAMPING, drive, STEP)
        added = force
        if servo:
            velocity = arm.jacobian(q) @ start[2:]
            pull = gains[0] * (commanded[1:3] - arm.hand(q)) + gains[1] * (commanded[3:] - velocity)
            added = force + commanded[0] * pull
        np.testing.assert_allclose(motion.perturbation[0], added, rtol=1e-12)
        expected = acceleration(arm, MASS, DAMPING, start, planned, noise, added + sensor)
        np.testing.assert_allclose(motion.acceleration[0], expected, rtol=1e-11)


@pytest.mark.parametrize(("slope", "error"), [(0.0, 1e-10), (0.035, 5e-8)], ids=["smooth", "kinked"])
def test_motion_is_that_of_another_integrator(slope: float, error: float) -> None:
    """Where a pair of muscles changes roles, stiffness that grows with tension has a kink, which a fixed step blurs."""
    arm, path = arm_with("high", stiffness_per_tension=slope), FigureEight()
    motion = traced(arm, path, QUICK, STEP)
    states = integrated(arm, MASS, DAMPING, path, QUICK, STEP * np.arange(len(motion.q)))
    np.testing.assert_allclose(motion.q, states[:, :2], rtol=0, atol=error)
    np.testing.assert_allclose(motion.w, states[:, 2:], rtol=0, atol=50.0 * error)


@pytest.mark.parametrize("reflex", [0.0, 0.5])
@pytest.mark.parametrize("stiffness", ["low", "high"])
def test_half_the_step_gives_the_same_path_to_a_micrometre(stiffness: str, reflex: float) -> None:
    arm = arm_with(stiffness, reflex_gain=reflex)
    whole, half = (traced(arm, Flower(), SLOW, step).q for step in (STEP, 0.5 * STEP))
    assert np.abs(arm.hand(whole) - arm.hand(half[::2])).max() < 1e-6


@pytest.mark.parametrize("reflex", [0.0, 0.5])
def test_integration_converges_with_the_fourth_order(reflex: float) -> None:
    arm = arm_with("high", stiffness_per_tension=0.0, reflex_gain=reflex, reflex_delay=0.032)
    finest = arm.hand(traced(arm, FigureEight(), QUICK, 2.5e-4).q)
    errors = []
    for step in (8e-3, 4e-3, 2e-3):
        x = arm.hand(traced(arm, FigureEight(), QUICK, step).q)
        errors.append(np.abs(x - finest[:: round(step / 2.5e-4)][: len(x)]).max())
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (orders > 3.7).all() and (orders < 4.5).all(), orders


# --- exact invariants, muscles off ---------------------------------------------------------------


def thrown(mass: Array, damping: Array, added: Array) -> tuple[Motion, Array, Array, Array]:
    """A slack arm that is thrown: its motion, hand, velocity of the hand and energy of arm and device."""
    q = SLACK.posture(HAND)
    drive = quiet(resting(q, len(added)), np.concatenate([q, [0.8, -1.1]]), added)
    motion = integrate(SLACK, mass, damping, drive, STEP)
    velocity = np.einsum("nij,nj->ni", SLACK.jacobian(motion.q), motion.w)
    energy = 0.5 * np.einsum("ni,nij,nj->n", motion.w, SLACK.inertia(motion.q), motion.w)
    return motion, SLACK.hand(motion.q), velocity, energy + 0.5 * velocity**2 @ mass


def test_energy_is_kept_without_muscles_and_damping() -> None:
    *_, energy = thrown(MASS, NONE, np.zeros((800, 2)))
    np.testing.assert_allclose(energy, energy[0], rtol=1e-10)


def test_perturbation_does_its_work_and_nothing_else_does() -> None:
    added = np.repeat(np.random.default_rng(3).normal(0.0, 3.0, (16, 2)), 50, axis=0)
    _, x, _, energy = thrown(MASS, NONE, added)
    # The force is held over each step, so its work is force times the way.
    work = np.cumsum((added[:-1] * np.diff(x, axis=0)).sum(1))
    np.testing.assert_allclose(energy[1:], energy[0] + work, atol=1e-10)


def test_damping_of_the_device_takes_its_power() -> None:
    _, _, velocity, energy = thrown(MASS, DAMPING, np.zeros((801, 2)))
    lost = simpson(velocity**2 @ DAMPING, dx=STEP)
    assert lost > 0.1 * energy[0]
    np.testing.assert_allclose(energy[0] - energy[-1], lost, rtol=1e-9)


@pytest.mark.parametrize("mass", [0.0, 2.0])
def test_angular_momentum_about_the_shoulder_is_kept_without_torque_there(mass: float) -> None:
    motion, x, velocity, _ = thrown(np.full(2, mass), NONE, np.zeros((800, 2)))
    arm = np.einsum("nij,nj->ni", SLACK.inertia(motion.q), motion.w)[:, 0]
    device = mass * (x[:, 0] * velocity[:, 1] - x[:, 1] * velocity[:, 0])
    np.testing.assert_allclose(arm + device, (arm + device)[0], rtol=1e-10)


# --- impedance -----------------------------------------------------------------------------------


@pytest.mark.parametrize("stiffness", ["low", "high"])
def test_small_displacement_dies_out_as_the_linearised_impedance_says(stiffness: str) -> None:
    arm, n = arm_with(stiffness), 600
    q, command = arm.posture(HAND), arm.command(NONE)
    displacement = np.array([2e-6, -1e-6])
    start = np.concatenate([arm.posture(HAND + displacement), NONE])
    motion = integrate(arm, MASS, DAMPING, quiet(resting(q, n), start), STEP)
    inverse = np.linalg.inv(np.diag(MASS) + arm.endpoint_mass(q))
    stiff, damped = arm.endpoint_stiffness(q, command), np.diag(DAMPING) + arm.endpoint_damping(q, command)
    flow = expm(STEP * np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ stiff, -inverse @ damped]]))
    states = [np.concatenate([displacement, NONE])]
    for _ in range(n - 1):
        states.append(flow @ states[-1])
    np.testing.assert_allclose(arm.hand(motion.q) - HAND, np.array(states)[:, :2], atol=1e-10)


@pytest.mark.parametrize("gain", [0.0, 0.4])
def test_steady_force_displaces_the_hand_by_the_stiffness_with_reflex_and_geometric_term(gain: float) -> None:
    arm, n = arm_with("low", reflex_gain=gain), 20_000
    q, command = arm.posture(HAND), arm.command(NONE)

    def rest(force: Array) -> tuple[Array, Array]:
        motion = integrate(arm, MASS, DAMPING, quiet(resting(q, n), added=np.tile(force, (n, 1))), STEP)
        assert np.abs(motion.w[-1]).max() < 1e-9
        return arm.hand(motion.q[-1]), motion.q[-1]

    load, small = np.array([4.0, -2.0]), 1e-4
    _, there = rest(load)
    columns = [(rest(load + d)[0] - rest(load - d)[0]) / (2.0 * small) for d in small * np.eye(2)]
    # At rest u = −p; muscles count once, and their reflex `gain` times.
    expected = arm.endpoint_stiffness(there, command, -load) + gain * arm.endpoint_stiffness(there, command)
    np.testing.assert_allclose(np.linalg.inv(np.stack(columns, 1)), expected, rtol=1e-4)


def test_reflex_comes_after_its_delay() -> None:
    n, delay = 200, 0.05
    drive = quiet(resting(Arm().posture(HAND), n), added=np.tile([3.0, 0.0], (n, 1)))
    without, late = (
        integrate(arm, MASS, DAMPING, drive, STEP).q
        for arm in (Arm(), Arm(reflex_gain=0.5, reflex_delay=delay))
    )
    same = round(delay / STEP)
    np.testing.assert_array_equal(late[: same + 1], without[: same + 1])
    assert np.abs(late[same + 20 :] - without[same + 20 :]).min() > 0


def test_reflex_later_than_the_end_never_comes() -> None:
    drive = quiet(resting(Arm().posture(HAND), 50), added=np.tile([3.0, 0.0], (50, 1)))
    without, never = (
        integrate(arm, MASS, DAMPING, drive, STEP).q
        for arm in (Arm(), Arm(reflex_gain=1.0, reflex_delay=1.7e308))
    )
    np.testing.assert_array_equal(never, without)


# --- refusals ------------------------------------------------------------------------------------


def refused(arm: Arm, step: float, mass: Array = MASS) -> str:
    drive = quiet(resting(arm.posture(HAND), 10))
    with pytest.raises(SimulationError) as caught, np.errstate(all="ignore"):
        integrate(arm, mass, DAMPING, drive, step)
    return str(caught.value)


def test_step_that_is_too_large_is_refused_before_the_motion_explodes() -> None:
    arm = arm_with("high")
    sentence = refused(arm, 0.5)
    limit = float(re.search(r"expected at most (\S+) s, for the fastest mode", sentence).group(1))
    assert sentence.endswith("got 0.5 s; choose a smaller step")
    q = arm.posture(HAND)
    start = np.concatenate([q + 1e-3, NONE])
    motion = integrate(arm, MASS, DAMPING, quiet(resting(q, 300), start), 0.95 * limit)
    assert np.abs(motion.q[-1] - q).max() < 1e-6


def test_step_beyond_the_delay_of_the_reflex_is_refused() -> None:
    assert refused(Arm(reflex_gain=0.1, reflex_delay=0.0005), STEP) == (
        "step: expected at most the reflex delay of 0.0005 s, got 0.001 s; choose a smaller step"
    )


def test_stiffness_of_a_servo_counts_for_the_step() -> None:
    q = Arm().posture(HAND)
    drive = replace(quiet(resting(q, 10)), servo=np.zeros((10, 5)), gains=(1e9, 0.0))
    with pytest.raises(SimulationError, match="for the fastest mode of arm and device"):
        integrate(Arm(), MASS, DAMPING, drive, STEP)


def test_numbers_that_overflow_are_refused() -> None:
    sentence = refused(Arm(), STEP, np.full(2, np.inf))
    assert "expected inertia, damping and stiffness within the range of numbers" in sentence
