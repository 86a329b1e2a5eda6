"""The arm and the device in its hand, integrated together: Runge–Kutta of fourth order with a fixed step.

    (M_q + Jᵀ M_r J) q̈ = τ − c − Jᵀ (M_r J̇ q̇ + D_r J q̇ − p − n)

The controller of the device acts on the measured force u + n, which stands on both sides and is solved for. What a
controller or a noise source sets (p, n, noise of tension) is held for a step; what the person plans is continuous, and
given at half steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from bayes_impedance.errors import SimulationError
from bayes_impedance.simulation.arm import Arm

Array = NDArray[np.float64]

#: Largest |λ| · step: the region of stability reaches 2.79 along the negative and 2.83 along the imaginary axis.
STABLE = 2.5


@dataclass(frozen=True)
class Drive:
    """What drives one trial of `n` samples, in joint space where it is the person's.

    `desired` `(2 n − 1, 6)`: q_d, q̇_d and feedforward torque [rad, s, Nm] at half steps; `tension_noise` `(n, 6)` [1],
    a share of each tension; `perturbation` `(n, 2)` [N]; `sensor` `(n, 2)` [N], what the force sensor adds; `servo`
    `(n, 5)`: share in [0, 1] and commanded position and velocity [m, s] of a position servo with `gains`
    [N/m, Ns/m]; no rows where there is none. `start` `(4,)`: q and q̇.
    """

    desired: Array
    tension_noise: Array
    perturbation: Array
    sensor: Array
    servo: Array
    gains: tuple[float, float]
    start: Array


@dataclass(frozen=True)
class Motion:
    """Joint angles, velocities, accelerations `(n, 2)` [rad, s] and force `(n, 2)` [N] that the device added."""

    q: Array
    w: Array
    acceleration: Array
    perturbation: Array


def integrate(arm: Arm, mass: Array, damping: Array, drive: Drive, step: float) -> Motion:
    """Motion of an arm with a device of virtual `mass` and `damping` `(2,)` [kg, Ns/m], every `step` [s].

    Raises:
        SimulationError: `step` is too large to be stable, or to resolve a reflex delay; or numbers overflow.
    """
    _check_step(arm, mass, damping, drive, step)
    n = len(drive.perturbation)
    state, applied = np.empty((n, 6)), np.empty((n, 2))
    _integrate(
        _constants(arm, mass, damping, drive.gains),
        arm.tension_of_torque,
        arm.pair_arms,
        round(min(arm.reflex_delay / step, n)) if arm.reflex_gain > 0 else 0,
        step,
        drive.desired,
        drive.tension_noise,
        drive.perturbation,
        drive.sensor,
        drive.servo,
        drive.start,
        state,
        applied,
    )
    return Motion(state[:, :2], state[:, 2:4], state[:, 4:], applied)


def _check_step(arm: Arm, mass: Array, damping: Array, drive: Drive, step: float) -> None:
    if arm.reflex_gain > 0 and arm.reflex_delay < step:
        raise SimulationError(
            f"step: expected at most the reflex delay of {arm.reflex_delay:g} s, got {step:g} s; choose a smaller step"
        )
    planned = drive.desired[:: max(1, len(drive.desired) // 200)]
    q, torque = planned[:, :2], planned[:, 4:]
    jacobian = arm.jacobian(q)
    across = np.swapaxes(jacobian, -1, -2)
    stiffness, eye = arm.joint_stiffness(arm.command(torque)) * (1.0 + arm.reflex_gain), np.eye(2)
    spring, damper = drive.gains if len(drive.servo) else (0.0, 0.0)
    try:
        rate = _largest_rate(
            arm.inertia(q) + across @ np.diag(mass) @ jacobian,
            arm.damping_ratio * stiffness + across @ (np.diag(damping) + damper * eye) @ jacobian,
            stiffness + across @ (spring * eye) @ jacobian,
        )
    except np.linalg.LinAlgError as error:
        raise SimulationError(
            "expected inertia, damping and stiffness within the range of numbers, got some that overflow or vanish; "
            "choose arm, device and duration of a usual size"
        ) from error
    if step * rate > STABLE:
        raise SimulationError(
            f"step: expected at most {STABLE / rate:.2g} s, for the fastest mode of arm and device changes at "
            f"{rate:.3g} 1/s, got {step:g} s; choose a smaller step"
        )


def _largest_rate(mass: Array, damping: Array, stiffness: Array) -> float:
    """Largest |λ| [1/s] of the modes of M q̈ + D q̇ + K q = 0, of `(..., 2, 2)` matrices."""
    inverse = np.linalg.inv(mass)
    identity = np.broadcast_to(np.eye(2), mass.shape)
    upper = np.concatenate([np.zeros_like(mass), identity], -1)
    lower = np.concatenate([-inverse @ stiffness, -inverse @ damping], -1)
    return float(np.abs(np.linalg.eigvals(np.concatenate([upper, lower], -2))).max())


def _constants(arm: Arm, mass: Array, damping: Array, gains: tuple[float, float]) -> Array:
    return np.array(
        [
            *arm.lengths,
            *arm.inertia_constants(),
            arm.muscle_stiffness,
            arm.stiffness_per_tension,
            arm.damping_ratio,
            arm.co_contraction,
            arm.reflex_gain,
            *mass,
            *damping,
            *gains,
        ]
    )


@njit(nogil=True, cache=True)
def _integrate(  # type: ignore[no-untyped-def]  # numba compiles it for the types of `integrate`
    constants, tension_of_torque, arms, delay, step, desired, noise, perturbation, sensor, servo, start, state, applied
):  # fmt: skip
    mass_x, mass_y = constants[10], constants[11]
    damping_x, damping_y = constants[12], constants[13]
    n = perturbation.shape[0]
    q1, q2, w1, w2 = start
    # Errors of a stretch reflex at the three times of a step: q_d − q and q̇_d − q̇, `delay` steps ago.
    late = np.zeros((3, 4))
    for i in range(n):
        state[i, 0], state[i, 1], state[i, 2], state[i, 3] = q1, q2, w1, w2
        px, py = perturbation[i, 0], perturbation[i, 1]
        if servo.shape[0] > 0 and servo[i, 0] > 0.0:
            x, y, vx, vy = _hand(constants, q1, q2, w1, w2)
            px += servo[i, 0] * (constants[14] * (servo[i, 1] - x) + constants[15] * (servo[i, 3] - vx))
            py += servo[i, 0] * (constants[14] * (servo[i, 2] - y) + constants[15] * (servo[i, 4] - vy))
        applied[i, 0], applied[i, 1] = px, py
        px += sensor[i, 0]
        py += sensor[i, 1]
        if delay > 0 and i >= delay:
            _late_errors(i - delay, step, desired, state, late)
        held = (constants, tension_of_torque, arms, noise[i], mass_x, mass_y, damping_x, damping_y, px, py)
        a1, b1 = _acceleration(held, desired[2 * i], late[0], q1, q2, w1, w2)
        state[i, 4], state[i, 5] = a1, b1
        if i == n - 1:
            break
        middle, end = desired[2 * i + 1], desired[2 * i + 2]
        half = 0.5 * step
        c1, d1 = w1 + half * a1, w2 + half * b1
        a2, b2 = _acceleration(held, middle, late[1], q1 + half * w1, q2 + half * w2, c1, d1)
        c2, d2 = w1 + half * a2, w2 + half * b2
        a3, b3 = _acceleration(held, middle, late[1], q1 + half * c1, q2 + half * d1, c2, d2)
        c3, d3 = w1 + step * a3, w2 + step * b3
        a4, b4 = _acceleration(held, end, late[2], q1 + step * c2, q2 + step * d2, c3, d3)
        sixth = step / 6.0
        q1 += sixth * (w1 + 2.0 * (c1 + c2) + c3)
        q2 += sixth * (w2 + 2.0 * (d1 + d2) + d3)
        w1 += sixth * (a1 + 2.0 * (a2 + a3) + a4)
        w2 += sixth * (b1 + 2.0 * (b2 + b3) + b4)


@njit(nogil=True, cache=True)
def _hand(constants, q1, q2, w1, w2):  # type: ignore[no-untyped-def]
    """Position and velocity of the hand."""
    l1, l2 = constants[0], constants[1]
    s1, c1 = l1 * np.sin(q1), l1 * np.cos(q1)
    s2, c2 = l2 * np.sin(q1 + q2), l2 * np.cos(q1 + q2)
    w = w1 + w2
    return c1 + c2, s1 + s2, -s1 * w1 - s2 * w, c1 * w1 + c2 * w


@njit(nogil=True, cache=True)
def _late_errors(i, step, desired, state, late):  # type: ignore[no-untyped-def]
    """Errors at sample i, half a step later (cubic Hermite of the recorded states) and at sample i + 1."""
    for k in range(2):
        q0, q1, w0, w1 = state[i, k], state[i + 1, k], state[i, 2 + k], state[i + 1, 2 + k]
        late[0, k], late[0, 2 + k] = desired[2 * i, k] - q0, desired[2 * i, 2 + k] - w0
        late[1, k] = desired[2 * i + 1, k] - (0.5 * (q0 + q1) + 0.125 * step * (w0 - w1))
        late[1, 2 + k] = desired[2 * i + 1, 2 + k] - (1.5 * (q1 - q0) / step - 0.25 * (w0 + w1))
        late[2, k], late[2, 2 + k] = desired[2 * i + 2, k] - q1, desired[2 * i + 2, 2 + k] - w1


@njit(nogil=True, cache=True)
def _acceleration(held, planned, late, q1, q2, w1, w2):  # type: ignore[no-untyped-def]
    """q̈ from the equation at the head of this file."""
    constants, tension_of_torque, arms, noise, mass_x, mass_y, damping_x, damping_y, px, py = held
    stiffness, slope, ratio, idle, reflex = (
        constants[5],
        constants[6],
        constants[7],
        constants[8],
        constants[9],
    )
    e1, e2, v1, v2 = planned[0] - q1, planned[1] - q2, planned[2] - w1, planned[3] - w2
    torque1 = torque2 = 0.0
    for k in range(3):
        b1, b2 = arms[k, 0], arms[k, 1]
        net = tension_of_torque[k, 0] * planned[4] + tension_of_torque[k, 1] * planned[5]
        flexor, extensor = idle + max(net, 0.0), idle + max(-net, 0.0)
        pair = stiffness * (2.0 + slope * (flexor + extensor))
        tension = flexor * (1.0 + noise[k]) - extensor * (1.0 + noise[3 + k])
        tension += pair * (b1 * (e1 + ratio * v1) + b2 * (e2 + ratio * v2))
        if reflex > 0.0:
            tension += reflex * pair * (b1 * (late[0] + ratio * late[2]) + b2 * (late[1] + ratio * late[3]))
        torque1 += b1 * tension
        torque2 += b2 * tension
    l1, l2 = constants[0], constants[1]
    a, b, c = constants[2], constants[3], constants[4]
    bend, turn = b * np.cos(q2), b * np.sin(q2)
    torque1 += turn * w2 * (2.0 * w1 + w2)
    torque2 -= turn * w1 * w1
    s1, c1 = l1 * np.sin(q1), l1 * np.cos(q1)
    s2, c2 = l2 * np.sin(q1 + q2), l2 * np.cos(q1 + q2)
    w = w1 + w2
    # Columns of J, and the load that is known before q̈: M_r J̇ q̇ + D_r J q̇ − p − n.
    j11, j12, j21, j22 = -s1 - s2, -s2, c1 + c2, c2
    load_x = mass_x * (-c1 * w1 * w1 - c2 * w * w) + damping_x * (j11 * w1 + j12 * w2) - px
    load_y = mass_y * (-s1 * w1 * w1 - s2 * w * w) + damping_y * (j21 * w1 + j22 * w2) - py
    torque1 -= j11 * load_x + j21 * load_y
    torque2 -= j12 * load_x + j22 * load_y
    m11 = a + 2.0 * bend + mass_x * j11 * j11 + mass_y * j21 * j21
    m12 = c + bend + mass_x * j11 * j12 + mass_y * j21 * j22
    m22 = c + mass_x * j12 * j12 + mass_y * j22 * j22
    determinant = m11 * m22 - m12 * m12
    return (m22 * torque1 - m12 * torque2) / determinant, (m11 * torque2 - m12 * torque1) / determinant
