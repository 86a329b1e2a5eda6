"""A planar arm of two links and six muscles: its kinematics, its dynamics and the impedance of its hand.

    M_q(q) q̈ + c(q, q̇) = τ − Jᵀu,    τ = Aᵀ(u_N + K_X e_X + D_X ė_X),    K_X = K_0 + K_1 |u_N|,    D_X = K_X / 12 s⁻¹

u is the force of the hand on what it holds, u_N the tension that each muscle is told to have, e_X = A (q_d − q) how
much shorter it should be. Muscles come in three antagonistic pairs with constant moment arms: one around the shoulder,
one around the elbow, one around both (Katayama & Kawato 1993; the impedance law is that of Medina, Endo, Hirche 2016).
Every array may have any leading dimensions: samples, trials, subjects.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.errors import SimulationError

Array = NDArray[np.float64]

#: Of the reach, what a path may come near to the stretched or folded arm, where the hand has no defined impedance.
REACH_MARGIN = 0.02
#: Table I of the paper, average over the path of (K_xx, K_yy) [N/m] and (D_xx, D_yy) [Ns/m].
TABLE_I = {
    "low": {"stiffness": (118.7, 148.4), "damping": (9.89, 12.4)},
    "high": {"stiffness": (576.8, 723.5), "damping": (48.07, 60.29)},
}
#: Stiffness K_0 of one muscle [N/m] in its two settings.
MUSCLE_STIFFNESS = {"low": 3360.0, "high": 16800.0}


@dataclass(frozen=True)
class Arm:
    """Anthropometry, muscles and noise of one arm; shoulder at the origin, x to the right, y ahead.

    `lengths` [m], `masses` [kg], `centres` of mass from the proximal joint [m] and `inertias` about them [kg m²] of
    upper arm and forearm; `moment_arms` [m] of shoulder, elbow, and the biarticular pair at shoulder and elbow;
    `muscle_stiffness` K_0 [N/m] (0 switches the muscles off), `stiffness_per_tension` K_1 / K_0 [1/N] and
    `damping_ratio` D_X / K_X [s]; `co_contraction` [N], tension that every muscle has anyhow; `noise`, SD of tension as
    a share of it, correlated over `noise_time` [s]; `anticipation`, share of the device's load along the desired
    trajectory that the person feeds forward; `reflex_gain`, stretch reflex as a share of K_X and D_X, `reflex_delay`
    [s] late.

    Raises:
        SimulationError: a parameter is not physical.
    """

    lengths: tuple[float, float] = (0.33, 0.34)
    masses: tuple[float, float] = (1.93, 1.52)
    centres: tuple[float, float] = (0.165, 0.19)
    inertias: tuple[float, float] = (0.0141, 0.0188)
    moment_arms: tuple[float, float, float, float] = (0.040, 0.025, 0.028, 0.035)
    muscle_stiffness: float = MUSCLE_STIFFNESS["low"]
    stiffness_per_tension: float = 0.035
    damping_ratio: float = 1.0 / 12.0
    co_contraction: float = 0.5
    noise: float = 0.1
    noise_time: float = 0.05
    anticipation: float = 0.0
    reflex_gain: float = 0.0
    reflex_delay: float = 0.03

    def __post_init__(self) -> None:
        """Refuse what no arm can be."""
        positive = {"lengths", "masses", "inertias", "moment_arms", "noise_time"}
        for entry in fields(self):
            values = np.atleast_1d(np.asarray(getattr(self, entry.name), dtype=np.float64))
            size = np.size(getattr(Arm, entry.name))
            bound = "> 0" if entry.name in positive else ">= 0"
            valid = (values > 0) if entry.name in positive else (values >= 0)
            if values.shape != (size,) or not (np.isfinite(values) & valid).all():
                raise SimulationError(
                    f"arm.{entry.name}: expected {size} finite value{'s' if size > 1 else ''} {bound}, got "
                    f"{getattr(self, entry.name)}; no arm is like that"
                )
        for name, centre, length in zip(("upper arm", "forearm"), self.centres, self.lengths, strict=True):
            if centre > length:
                raise SimulationError(
                    f"arm.centres: expected a centre of mass within the {name} of {length:g} m, got {centre:g} m; "
                    "move it inside"
                )

    # --- kinematics ------------------------------------------------------------------------------

    @property
    def reach(self) -> tuple[float, float]:
        """Smallest and largest distance of the hand from the shoulder that a path may have [m]."""
        l1, l2 = self.lengths
        margin = REACH_MARGIN * (l1 + l2)
        return abs(l1 - l2) + margin, l1 + l2 - margin

    def hand(self, q: Array) -> Array:
        """Position `(..., 2)` [m] of the hand at angles `(..., 2)` [rad] of shoulder and elbow."""
        l1, l2 = self.lengths
        first, second = q[..., 0], q[..., 0] + q[..., 1]
        return np.stack(
            [l1 * np.cos(first) + l2 * np.cos(second), l1 * np.sin(first) + l2 * np.sin(second)], -1
        )

    def posture(self, x: Array) -> Array:
        """Joint angles `(..., 2)` [rad] with flexed elbow at positions `(..., 2)` [m].

        Raises:
            SimulationError: a position is out of reach.
        """
        distance = np.hypot(x[..., 0], x[..., 1])
        low, high = self.reach
        if not ((distance >= low) & (distance <= high)).all():
            worst = np.argmax(np.maximum(low - distance, distance - high))
            point = x.reshape(-1, 2)[worst]
            raise SimulationError(
                f"path: expected positions between {low:.3f} and {high:.3f} m from the shoulder, got "
                f"({point[0]:.3f}, {point[1]:.3f}) m, {np.hypot(*point):.3f} m away; move or shrink the path, or "
                "lengthen arm.lengths"
            )
        l1, l2 = self.lengths
        cosine = (distance**2 - l1**2 - l2**2) / (2.0 * l1 * l2)
        elbow = np.arccos(cosine)
        shoulder = np.arctan2(x[..., 1], x[..., 0]) - np.arctan2(l2 * np.sin(elbow), l1 + l2 * cosine)
        return np.stack([shoulder, elbow], -1)

    def jacobian(self, q: Array) -> Array:
        """J = ∂x/∂q, `(..., 2, 2)` [m/rad]."""
        l1, l2 = self.lengths
        first, second = q[..., 0], q[..., 0] + q[..., 1]
        s1, c1, s2, c2 = l1 * np.sin(first), l1 * np.cos(first), l2 * np.sin(second), l2 * np.cos(second)
        return _matrix(-s1 - s2, -s2, c1 + c2, c2)

    def jacobian_rate(self, q: Array, w: Array) -> Array:
        """J̇ at joint velocities `w` `(..., 2)` [rad/s], `(..., 2, 2)` [m/(rad s)]."""
        l1, l2 = self.lengths
        first, second = q[..., 0], q[..., 0] + q[..., 1]
        a, b = l1 * w[..., 0], l2 * (w[..., 0] + w[..., 1])
        s1, c1, s2, c2 = a * np.sin(first), a * np.cos(first), b * np.sin(second), b * np.cos(second)
        return _matrix(-c1 - c2, -c2, -s1 - s2, -s2)

    # --- dynamics --------------------------------------------------------------------------------

    def inertia_constants(self) -> tuple[float, float, float]:
        """a, b, c of M_q = [a + 2 b cos q₂, c + b cos q₂; c + b cos q₂, c] [kg m²]."""
        (l1, _), (m1, m2), (c1, c2), (i1, i2) = self.lengths, self.masses, self.centres, self.inertias
        return i1 + i2 + m1 * c1**2 + m2 * (l1**2 + c2**2), m2 * l1 * c2, i2 + m2 * c2**2

    def inertia(self, q: Array) -> Array:
        """Joint mass matrix M_q, `(..., 2, 2)` [kg m²]."""
        a, b, c = self.inertia_constants()
        bend = b * np.cos(q[..., 1])
        return _matrix(a + 2.0 * bend, c + bend, c + bend, np.full_like(bend, c))

    def coriolis(self, q: Array, w: Array) -> Array:
        """Torque c(q, q̇) of centrifugal and Coriolis forces, `(..., 2)` [Nm]."""
        turn = self.inertia_constants()[1] * np.sin(q[..., 1])
        w1, w2 = w[..., 0], w[..., 1]
        return np.stack([-turn * w2 * (2.0 * w1 + w2), turn * w1**2], -1)

    # --- muscles ---------------------------------------------------------------------------------

    @property
    def pair_arms(self) -> Array:
        """Moment arms of the flexors of the three pairs, `(3, 2)` [m]; an extensor has their negative."""
        shoulder, elbow, both_shoulder, both_elbow = self.moment_arms
        return np.array([[shoulder, 0.0], [0.0, elbow], [both_shoulder, both_elbow]])

    @property
    def tension_of_torque(self) -> Array:
        """Net tension of the pairs of least norm for a torque, `(3, 2)` [1/m]: f = B (BᵀB)⁻¹ τ."""
        arms = self.pair_arms
        return arms @ np.linalg.inv(arms.T @ arms)

    def command(self, torque: Array) -> Array:
        """Tension u_N that six muscles are told to have for a torque `(..., 2)` [Nm], `(..., 6)` [N].

        Flexors, then extensors. A muscle only pulls, so one of each pair has the net tension and both co-contract.
        """
        net = torque @ self.tension_of_torque.T
        return self.co_contraction + np.concatenate([np.maximum(net, 0.0), np.maximum(-net, 0.0)], -1)

    def joint_stiffness(self, command: Array) -> Array:
        """K_q = Aᵀ K_X A, K_X = K_0 + K_1 |u_N|, `(..., 2, 2)` [Nm/rad]."""
        each = self.muscle_stiffness * (1.0 + self.stiffness_per_tension * np.abs(command))
        pair = each[..., :3] + each[..., 3:]
        arms = self.pair_arms
        return np.asarray(np.einsum("...i,ij,ik->...jk", pair, arms, arms))

    # --- what the hand feels like ----------------------------------------------------------------

    def endpoint_stiffness(self, q: Array, command: Array, force: Array | None = None) -> Array:
        """K = J⁻ᵀ (K_q + ∂(Jᵀu)/∂q) J⁻¹, `(..., 2, 2)` [N/m], the second term at constant force u `(..., 2)` [N].

        It is −∂u/∂x at rest. Without `force` it lacks the geometric term, as Table I seems to (D = K/12 s there).
        """
        stiffness = self.joint_stiffness(command)
        if force is not None:
            stiffness = stiffness + self._geometric(q, force)
        return self._at_hand(q, stiffness)

    def endpoint_damping(self, q: Array, command: Array) -> Array:
        """D = J⁻ᵀ D_q J⁻¹, D_q = K_q / 12 s⁻¹ by default, `(..., 2, 2)` [Ns/m]."""
        return self._at_hand(q, self.damping_ratio * self.joint_stiffness(command))

    def endpoint_mass(self, q: Array) -> Array:
        """M = J⁻ᵀ M_q J⁻¹, `(..., 2, 2)` [kg]."""
        return self._at_hand(q, self.inertia(q))

    def _geometric(self, q: Array, force: Array) -> Array:
        """∂(Jᵀu)/∂q at constant u: the Hessian of u·x."""
        l1, l2 = self.lengths
        first, second = q[..., 0], q[..., 0] + q[..., 1]
        upper = -l1 * (np.cos(first) * force[..., 0] + np.sin(first) * force[..., 1])
        lower = -l2 * (np.cos(second) * force[..., 0] + np.sin(second) * force[..., 1])
        return _matrix(upper + lower, lower, lower, lower)

    def _at_hand(self, q: Array, joint: Array) -> Array:
        inverse = _inverse(self.jacobian(q))
        return np.asarray(np.swapaxes(inverse, -1, -2) @ joint @ inverse)


def arm_with(stiffness: str, **changes: object) -> Arm:
    """The arm of the paper's simulation in one of its two settings, "low" or "high".

    Example:
        >>> arm_with("high").muscle_stiffness
        16800.0

    Raises:
        SimulationError: there is no such setting, or a parameter is not physical.
    """
    if stiffness not in MUSCLE_STIFFNESS:
        raise SimulationError(
            f"stiffness: expected {' or '.join(MUSCLE_STIFFNESS)}, got {stiffness!r}; choose one of them"
        )
    return Arm(muscle_stiffness=MUSCLE_STIFFNESS[stiffness], **changes)  # type: ignore[arg-type]


def motion_of_joints(arm: Arm, x: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
    """Joint angles, velocities and accelerations `(..., 2)` [rad, s] of a motion of the hand [m, s].

    Raises:
        SimulationError: the motion leaves the arm's reach.
    """
    q = arm.posture(x)
    inverse = _inverse(arm.jacobian(q))
    w = (inverse @ v[..., None])[..., 0]
    turning = (arm.jacobian_rate(q, w) @ w[..., None])[..., 0]
    return q, w, (inverse @ (a - turning)[..., None])[..., 0]


def _matrix(xx: Array, xy: Array, yx: Array, yy: Array) -> Array:
    return np.stack([np.stack([xx, xy], -1), np.stack([yx, yy], -1)], -2)


def _inverse(m: Array) -> Array:
    """Inverse of `(..., 2, 2)`: written out it is ten times as fast as the general one."""
    a, b, c, d = m[..., 0, 0], m[..., 0, 1], m[..., 1, 0], m[..., 1, 1]
    return _matrix(d, -b, -c, a) / (a * d - b * c)[..., None, None]
