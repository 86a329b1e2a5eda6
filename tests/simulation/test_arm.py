"""The arm's kinematics, dynamics and impedance against differences, a Lagrangian and static equilibrium."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from arm_oracles import Array, central, euler_lagrange, muscle_torque

from bayes_impedance.errors import SimulationError
from bayes_impedance.simulation.arm import MUSCLE_STIFFNESS, Arm, arm_with, motion_of_joints
from bayes_impedance.simulation.subjects import SUBJECTS
from bayes_impedance.simulation.tasks import FigureEight, Run, desired_motion

ARM = Arm()
ARMS = {"default": ARM, "A": SUBJECTS["A"].arm, "C": SUBJECTS["C"].arm}


@pytest.fixture
def states() -> tuple[Array, Array]:
    """Angles and angular velocities all over the range, `(30, 2)`."""
    generator = np.random.default_rng(0)
    q = np.stack([generator.uniform(-0.5, 2.0, 30), generator.uniform(0.3, 2.6, 30)], 1)
    return q, generator.normal(0.0, 3.0, (30, 2))


# --- kinematics ----------------------------------------------------------------------------------


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
def test_posture_is_the_inverse_of_hand_with_flexed_elbow(arm: Arm, states: tuple[Array, Array]) -> None:
    q = states[0]
    np.testing.assert_allclose(arm.posture(arm.hand(q)), q, atol=1e-12)


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
def test_jacobian_is_the_derivative_of_the_hand(arm: Arm, states: tuple[Array, Array]) -> None:
    np.testing.assert_allclose(arm.jacobian(states[0]), central(arm.hand, states[0], 1e-6), rtol=0, atol=1e-9)


def test_rate_of_the_jacobian_is_its_derivative_along_the_motion(states: tuple[Array, Array]) -> None:
    q, w = states
    differences = (ARM.jacobian(q + 1e-6 * w) - ARM.jacobian(q - 1e-6 * w)) / 2e-6
    np.testing.assert_allclose(ARM.jacobian_rate(q, w), differences, atol=1e-8)


def test_motion_of_joints_is_the_derivative_of_posture_along_a_path() -> None:
    time = np.linspace(0.1, 1.9, 7)
    run, path = Run(2.0, np.array([0.3])), FigureEight()
    q, w, a = motion_of_joints(ARM, *desired_motion(path, run, time))

    def posture(at: Array) -> Array:
        return ARM.posture(desired_motion(path, run, at)[0])

    step = 1e-4
    before, after = posture(time - step), posture(time + step)
    np.testing.assert_allclose(w, (after - before) / (2 * step), atol=1e-6)
    np.testing.assert_allclose(a, (after - 2 * q + before) / step**2, atol=1e-5)


def test_every_function_takes_leading_dimensions(states: tuple[Array, Array]) -> None:
    q, w = states
    stacked, turning = q.reshape(5, 2, 3, 2), w.reshape(5, 2, 3, 2)
    command, force = ARM.command(w), 3.0 * w
    pairs = (
        (ARM.posture(ARM.hand(stacked)), ARM.posture(ARM.hand(q))),
        (ARM.jacobian_rate(stacked, turning), ARM.jacobian_rate(q, w)),
        (ARM.coriolis(stacked, turning), ARM.coriolis(q, w)),
        (ARM.command(turning), command),
        (
            ARM.endpoint_stiffness(stacked, ARM.command(turning), 3.0 * turning),
            ARM.endpoint_stiffness(q, command, force),
        ),
        (ARM.endpoint_damping(stacked, ARM.command(turning)), ARM.endpoint_damping(q, command)),
        (ARM.endpoint_mass(stacked), ARM.endpoint_mass(q)),
    )
    for together, flat in pairs:
        np.testing.assert_allclose(together.reshape(flat.shape), flat, rtol=1e-13)


# --- dynamics ------------------------------------------------------------------------------------


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
def test_inertia_and_coriolis_torque_follow_from_the_lagrangian(
    arm: Arm, states: tuple[Array, Array]
) -> None:
    for q, w in zip(*states, strict=True):
        mass, bias = euler_lagrange(arm, q, w)
        np.testing.assert_allclose(arm.inertia(q), mass, rtol=1e-12)
        np.testing.assert_allclose(arm.coriolis(q, w), bias, atol=1e-12)


def test_mass_of_the_hand_has_the_kinetic_energy_of_the_arm(states: tuple[Array, Array]) -> None:
    q, w = states
    velocity = np.einsum("nij,nj->ni", ARM.jacobian(q), w)
    at_hand = np.einsum("ni,nij,nj->n", velocity, ARM.endpoint_mass(q), velocity)
    np.testing.assert_allclose(at_hand, np.einsum("ni,nij,nj->n", w, ARM.inertia(q), w), rtol=1e-10)


# --- muscles -------------------------------------------------------------------------------------


def test_muscles_only_pull_and_give_the_torque_asked_for_with_least_tension() -> None:
    torque = np.random.default_rng(1).normal(0.0, 2.0, (20, 2))
    command = ARM.command(torque)
    assert (command >= ARM.co_contraction).all()
    net = command[:, :3] - command[:, 3:]
    np.testing.assert_allclose(net @ ARM.pair_arms, torque, atol=1e-13)
    np.testing.assert_allclose(net, torque @ np.linalg.pinv(ARM.pair_arms), atol=1e-12)
    # One of each pair has nothing to do but to co-contract.
    np.testing.assert_array_equal(np.minimum(command[:, :3], command[:, 3:]), ARM.co_contraction)


def test_joint_stiffness_is_that_of_the_torque_of_six_muscles() -> None:
    command = ARM.command(np.array([1.5, -0.7]))

    def torque(error: Array) -> Array:
        return muscle_torque(ARM, command, error, np.zeros(2), np.zeros(6))

    np.testing.assert_allclose(ARM.joint_stiffness(command), central(torque, np.zeros(2), 1e-3), rtol=1e-10)


def test_tension_stiffens_a_muscle_as_the_paper_says() -> None:
    idle, tense = (replace(ARM, co_contraction=value).command(np.zeros(2)) for value in (0.0, 10.0))
    np.testing.assert_allclose(ARM.joint_stiffness(tense), 1.35 * ARM.joint_stiffness(idle), rtol=1e-14)


# --- impedance of the hand -----------------------------------------------------------------------


def static_force(arm: Arm, x: Array, desired: Array, command: Array) -> Array:
    """u of Jᵀu = τ at rest."""
    q = arm.posture(x)
    torque = muscle_torque(arm, command, desired - q, np.zeros(2), np.zeros(6))
    return np.linalg.solve(arm.jacobian(q).T, torque)


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
@pytest.mark.parametrize("displacement", [(0.0, 0.0), (0.05, -0.03), (-0.04, 0.06)])
def test_endpoint_stiffness_is_minus_the_derivative_of_static_force(
    arm: Arm, displacement: tuple[float, float]
) -> None:
    x = np.array([0.28, 0.31])
    desired, command = arm.posture(x + displacement), arm.command(np.array([0.8, -0.4]))
    force = static_force(arm, x, desired, command)
    assert np.linalg.norm(force) > 0.5
    stiffness = arm.endpoint_stiffness(arm.posture(x), command, force)
    differences = -central(lambda at: static_force(arm, at, desired, command), x, 1e-5)
    np.testing.assert_allclose(stiffness, differences, rtol=1e-6)
    # Muscles and a constant force have a potential, so it is symmetric; and the axes are coupled.
    np.testing.assert_allclose(stiffness, stiffness.T, rtol=1e-10)
    assert abs(stiffness[0, 1]) > 5.0


def test_geometric_term_is_what_a_force_adds_to_stiffness() -> None:
    q, command = ARM.posture(np.array([0.30, 0.325])), ARM.command(np.zeros(2))
    bare = ARM.endpoint_stiffness(q, command)
    np.testing.assert_array_equal(ARM.endpoint_stiffness(q, command, np.zeros(2)), bare)
    added = ARM.endpoint_stiffness(q, command, np.array([1.0, 0.0])) - bare
    assert 1.0 < np.abs(np.linalg.eigvalsh(added)).max() < 5.0


def test_endpoint_damping_is_minus_the_derivative_of_force_by_velocity() -> None:
    q, command = ARM.posture(np.array([0.28, 0.31])), ARM.command(np.array([0.8, -0.4]))
    jacobian = ARM.jacobian(q)

    def force(velocity: Array) -> Array:
        rate = -np.linalg.solve(jacobian, velocity)
        return np.linalg.solve(jacobian.T, muscle_torque(ARM, command, np.zeros(2), rate, np.zeros(6)))

    np.testing.assert_allclose(
        ARM.endpoint_damping(q, command), -central(force, np.zeros(2), 1e-3), rtol=1e-9
    )


def test_damping_is_a_twelfth_of_muscle_stiffness(states: tuple[Array, Array]) -> None:
    command = ARM.command(states[1])
    np.testing.assert_allclose(
        12.0 * ARM.endpoint_damping(states[0], command),
        ARM.endpoint_stiffness(states[0], command),
        rtol=1e-13,
    )


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"lengths": (0.3, 0.0)}, r"arm.lengths: expected 2 finite values > 0, got \(0.3, 0.0\)"),
        ({"lengths": (0.3,)}, r"arm.lengths: expected 2 finite values > 0, got \(0.3,\)"),
        ({"masses": (-1.0, 1.0)}, "arm.masses: expected 2 finite values > 0"),
        ({"inertias": (0.01, np.inf)}, "arm.inertias: expected 2 finite values > 0"),
        ({"moment_arms": (0.04, 0.0, 0.03, 0.03)}, "arm.moment_arms: expected 4 finite values > 0"),
        (
            {"muscle_stiffness": -1.0},
            r"arm.muscle_stiffness: expected 1 finite value >= 0, got -1.0; no arm is like that",
        ),
        ({"noise": np.nan}, "arm.noise: expected 1 finite value >= 0, got nan"),
        ({"noise_time": 0.0}, "arm.noise_time: expected 1 finite value > 0"),
        ({"reflex_gain": -0.1}, "arm.reflex_gain: expected 1 finite value >= 0"),
        (
            {"centres": (0.165, 0.5)},
            "arm.centres: expected a centre of mass within the forearm of 0.34 m, got 0.5 m; move it inside",
        ),
    ],
)
def test_what_no_arm_can_be_is_refused(change: dict[str, object], sentence: str) -> None:
    with pytest.raises(SimulationError, match=sentence):
        Arm(**change)


@pytest.mark.parametrize("x", [(0.5, 0.5), (0.01, 0.0), (np.nan, 0.3)])
def test_position_out_of_reach_is_named(x: tuple[float, float]) -> None:
    path = np.array([[0.3, 0.3], x, [0.2, 0.4]])
    with pytest.raises(
        SimulationError,
        match=re.escape("path: expected positions between 0.023 and 0.657 m from the shoulder, got ")
        + re.escape(f"({x[0]:.3f}, {x[1]:.3f}) m, ")
        + r".* m away; move or shrink the path, or lengthen arm\.lengths",
    ):
        ARM.posture(path)


def test_settings_of_the_paper_have_their_muscle_stiffness_and_take_changes() -> None:
    for name, value in MUSCLE_STIFFNESS.items():
        assert arm_with(name, noise=0.0) == Arm(muscle_stiffness=value, noise=0.0)


def test_unknown_setting_is_refused() -> None:
    with pytest.raises(
        SimulationError, match="stiffness: expected low or high, got 'medium'; choose one of them"
    ):
        arm_with("medium")
