"""Slow, independent computations of what the simulated arm does, and drives to ask it with."""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from bayes_impedance.simulation.arm import Arm, motion_of_joints
from bayes_impedance.simulation.device import NO_SERVO
from bayes_impedance.simulation.dynamics import Drive
from bayes_impedance.simulation.tasks import Path, Run, desired_motion

Array = NDArray[np.float64]


def central(function, at: Array, size: float) -> Array:
    """∂f/∂x by central differences, `(..., m, n)` for f of shape `(..., m)` and x of shape `(..., n)`."""
    columns = []
    for k in range(at.shape[-1]):
        shift = np.zeros(at.shape[-1])
        shift[k] = size
        columns.append((function(at + shift) - function(at - shift)) / (2.0 * size))
    return np.stack(columns, -1)


def kinetic_energy(arm: Arm, q: torch.Tensor, w: torch.Tensor) -> torch.Tensor:
    """½ Σ m v² + ½ Σ I ω² of the two links, from the velocities of their centres of mass."""
    (l1, _), (m1, m2), (c1, c2), (i1, i2) = arm.lengths, arm.masses, arm.centres, arm.inertias
    turn = w[0] + w[1]
    elbow = l1 * w[0] * torch.stack([-torch.sin(q[0]), torch.cos(q[0])])
    forearm = elbow + c2 * turn * torch.stack([-torch.sin(q[0] + q[1]), torch.cos(q[0] + q[1])])
    return 0.5 * (m1 * (c1 * w[0]) ** 2 + m2 * (forearm @ forearm) + i1 * w[0] ** 2 + i2 * turn**2)


def euler_lagrange(arm: Arm, q: Array, w: Array) -> tuple[Array, Array]:
    """M_q and c(q, q̇) of d/dt ∂T/∂q̇ − ∂T/∂q by automatic differentiation."""

    def energy(angles: torch.Tensor, rates: torch.Tensor) -> torch.Tensor:
        return kinetic_energy(arm, angles, rates)

    at = (torch.tensor(q), torch.tensor(w))
    momentum = torch.func.grad(energy, argnums=1)
    mass = torch.func.jacrev(momentum, argnums=1)(*at)
    bias = torch.func.jacrev(momentum, argnums=0)(*at) @ at[1] - torch.func.grad(energy)(*at)
    return mass.numpy(), bias.numpy()


def muscle_torque(arm: Arm, command: Array, error: Array, error_rate: Array, noise: Array) -> Array:
    """τ = Aᵀ(u_N (1 + noise) + K_X A (e + ratio ė)), muscle by muscle, six of them."""
    arms = np.concatenate([arm.pair_arms, -arm.pair_arms])
    torque = np.zeros(2)
    for each, told, disturbed in zip(arms, command, noise, strict=True):
        stiffness = arm.muscle_stiffness * (1.0 + arm.stiffness_per_tension * abs(told))
        stretch = each @ (error + arm.damping_ratio * error_rate)
        torque += each * (told * (1.0 + disturbed) + stiffness * stretch)
    return torque


def acceleration(
    arm: Arm, mass: Array, damping: Array, state: Array, planned: Array, noise: Array, added: Array
) -> Array:
    """q̈ at a state `(4,)`; `planned` `(6,)` as in `Drive.desired`; `added` is p + n."""
    q, w = state[:2], state[2:]
    torque = muscle_torque(arm, arm.command(planned[4:]), planned[:2] - q, planned[2:4] - w, noise)
    jacobian, rate = arm.jacobian(q), arm.jacobian_rate(q, w)
    load = np.diag(mass) @ rate @ w + np.diag(damping) @ jacobian @ w - added
    whole = arm.inertia(q) + jacobian.T @ np.diag(mass) @ jacobian
    return np.linalg.solve(whole, torque - arm.coriolis(q, w) - jacobian.T @ load)


def plan(arm: Arm, path: Path, run: Run, time: Array) -> Array:
    """q_d, q̇_d and the inverse dynamics of the arm along the path, `(n, 6)`."""
    q, w, a = motion_of_joints(arm, *desired_motion(path, run, time))
    torque = (arm.inertia(q) @ a[..., None])[..., 0] + arm.coriolis(q, w)
    return np.concatenate([q, w, torque], 1)


def integrated(arm: Arm, mass: Array, damping: Array, path: Path, run: Run, time: Array) -> Array:
    """States `(n, 4)` at `time` by DOP853, without noise and perturbation."""

    def right_side(now: float, state: Array) -> Array:
        planned = plan(arm, path, run, np.array([now]))[0]
        bare = acceleration(arm, mass, damping, state, planned, np.zeros(6), np.zeros(2))
        return np.concatenate([state[2:], bare])

    start = plan(arm, path, run, np.zeros(1))[0, :4]
    solved = solve_ivp(
        right_side, (0.0, time[-1]), start, "DOP853", t_eval=time, rtol=1e-11, atol=1e-13, max_step=0.05
    )
    return solved.y.T


def quiet(desired: Array, start: Array | None = None, added: Array | None = None) -> Drive:
    """A drive without noise; `desired` `(2 n − 1, 6)`, start on it unless given, perturbation `added` `(n, 2)`."""
    n = (len(desired) + 1) // 2
    force = np.zeros((n, 2)) if added is None else added
    begin = desired[0, :4].copy() if start is None else start
    return Drive(desired, np.zeros((n, 6)), force, np.zeros((n, 2)), NO_SERVO, (0.0, 0.0), begin)


def resting(q: Array, n: int) -> Array:
    """A desired posture that is held for `n` samples, `(2 n − 1, 6)`."""
    return np.tile(np.concatenate([q, np.zeros(4)]), (2 * n - 1, 1))
