"""Force of given impedance at a given error, and what a device that answers force makes of it.

    u = Σ_j W_j e⁽ʲ⁾ + ũ + ε,    e = x_d − x

Positions are held. On a device M_r ẍ + D_r ẋ = u + p, whose own motion without the person's force of that instant is
v⁻, a⁻, the force of a sample moves velocity and acceleration of the same instant (docs/model.md §6):

    v = v⁻ + ½ Δ u/M_r,    a = a⁻ + (u − D_r ½ Δ u/M_r)/M_r
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.device import Loop

Array = NDArray[np.float64]


def impedance_force(impedance: Array, error: Array) -> Array:
    """Σ_j W_j e⁽ʲ⁾, `(axes, n)` [N], at `error` `(axes, n, 3)`.

    `impedance` `(axes, n, 3)`, or `(axes, n, 3, axes)` where axes are coupled.
    """
    if impedance.ndim == 3:
        return np.asarray((impedance * error).sum(-1))
    return np.einsum("anjc,cnj->an", impedance, error)


def impedance_truth(impedance: Array, a: int, axes: tuple[str, ...]) -> dict[str, Array]:
    """Impedance of axis number `a`, and where axes are coupled with those after it, by the names of a log."""
    truth: dict[str, Array] = {}
    for j, name in enumerate(("stiffness", "damping", "mass")):
        if impedance.ndim == 3:
            truth[f"{name}_{axes[a]}{axes[a]}"] = impedance[a, :, j]
        else:
            truth |= {f"{name}_{axes[a]}{axes[b]}": impedance[a, :, j, b] for b in range(a, len(axes))}
    return truth


def device_answer(loop: Loop, group: int) -> Array:
    """By how much a newton moves position, velocity and acceleration of its instant, `(axes, 3)` [m/N, …]."""
    mass, damping = loop.device_mass[:, 0].numpy(), loop.device_damping[:, 0].numpy()
    velocity = 0.5 * float(loop.step[group]) / mass
    return np.stack([np.zeros_like(mass), velocity, (1.0 - damping * velocity) / mass], axis=-1)


def force_in_loop(without: Array, impedance: Array, answer: Array) -> Array:
    """u `(axes, n)` that solves u = `without` − Σ_j W_j (answer_j u), the motion it causes taken into account.

    `without` `(axes, n)`: the force that the motion without it would bring about; `impedance` as in `impedance_force`,
    `answer` that of the device.
    """
    if impedance.ndim == 3:
        return without / (1.0 + np.einsum("anj,aj->an", impedance, answer))
    matrix = np.eye(len(without)) + np.einsum("anjc,cj->nac", impedance, answer)
    return np.linalg.solve(matrix, without.T[..., None])[..., 0].T
