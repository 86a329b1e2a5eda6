"""The tool between force sensor and hand: what it weighs, and force and torque without it.

In the frame of the sensor, with the sign of force on the sensor:

    F = F_human + m γ + b_F,    T = T_human + c × m γ + b_T,    γ = Rᵀ(g − a)

m mass, c centre of mass, b bias, R the rotation into the base frame, g gravity, a the acceleration of the tool. What
turning quickly adds (angular acceleration, centrifugal force) is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bayes_impedance.errors import LogError
from bayes_impedance.log import Array
from bayes_impedance.recording.least_squares import fit

GRAVITY = np.array([0.0, 0.0, -9.81])
#: The direction of gravity in the sensor has to vary by as much [rad, RMS] for weight and bias to be told apart.
SMALLEST_VARIATION = 0.05
#: Standard errors that an estimate has to be away from zero to be taken for real.
SURE = 3.0
#: Less of the variance of force than this, explained by weight, means that something else is at work.
SMALLEST_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Tool:
    """`mass` [kg], `center_of_mass (3,)` [m], `bias (3,)` [N] and `torque_bias (3,)` [Nm], in the frame of the sensor.

    `center_of_mass` is None where torque was not recorded or could not tell it.
    """

    mass: float
    center_of_mass: Array | None
    bias: Array
    torque_bias: Array


@dataclass(frozen=True, eq=False)
class Identification:
    """A tool, standard errors of its values, and how well the part without contact speaks for it.

    `mass_error` [kg], `center_of_mass_error (3,)` [m], `bias_error (3,)` [N], `torque_bias_error (3,)` [Nm]; RMS of
    what is left of force [N] and torque [Nm]; `variation` [rad]: RMS by which the direction of gravity varies, in all
    and across the direction in which it varies most; `explained`: share of the variance of force, 1 is all.
    """

    tool: Tool
    mass_error: float
    bias_error: Array
    center_of_mass_error: Array | None
    torque_bias_error: Array | None
    force_rms: float
    torque_rms: float | None
    variation: tuple[float, float]
    explained: float

    @property
    def sentence(self) -> str:
        """What was found, and what to doubt about it."""
        tool = self.tool
        found = f"tool of {tool.mass:.3f} ± {self.mass_error:.3f} kg, bias {_listed(tool.bias)} N"
        if tool.center_of_mass is not None:
            found += f", centre of mass {_listed(tool.center_of_mass)} m"
        elif self.torque_rms is not None:
            found += (
                f", centre of mass not determined: gravity turns by {self.variation[1]:.2f} rad about a second axis; "
                "turn the tool about at least two axes, or give log.force.tool.center_of_mass"
            )
        if self.explained < SMALLEST_SHARE:
            found += (
                f"; weight explains only {100 * self.explained:.0f} % of the variance of force; unless the tool is "
                "very light, check log.force.rotation, and that nothing touches it in log.force.tool.identify"
            )
        return found


def identify_tool(
    force: Array,
    torque: Array | None,
    rotation: Rotation,
    acceleration: Array | None = None,
    gravity: Array = GRAVITY,
) -> Identification:
    """The tool from a part without contact, by least squares: (m, b_F) from force, then (m c, b_T) from torque.

    `force (n, 3)` [N] and `torque (n, 3)` [Nm] in the frame of the sensor, on the sensor; `acceleration (n, 3)`
    [m/s²] of the tool and `gravity (3,)` [m/s²] in the base frame; `rotation` from sensor to base.

    Raises:
        LogError: there are less than ten samples, the orientation hardly varies, or the mass is negative.
    """
    n = len(force)
    if n < 10:
        raise LogError(
            f"expected at least ten samples without contact, found {n}; widen log.force.tool.identify"
        )
    specific = _specific_force(rotation, n, acceleration, gravity)
    variation = _variation(specific, gravity)
    if variation[0] < SMALLEST_VARIATION:
        raise LogError(
            "expected a tool that is turned about without contact, found one whose orientation hardly varies: the "
            f"direction of gravity by {variation[0]:.3f} rad (RMS), so its mass and the bias of the sensor cannot be "
            "told apart; turn the tool about at least two axes in log.force.tool.identify, or give "
            "log.force.tool.mass"
        )
    unit = np.broadcast_to(np.eye(3), (n, 3, 3))
    weight = fit(np.concatenate([specific[:, :, None], unit], axis=2), force)
    mass, mass_error = float(weight.coefficients[0]), float(weight.standard_errors[0])
    if mass < -SURE * mass_error:
        raise LogError(
            f"expected a tool of positive mass, found {mass:.3g} ± {mass_error:.2g} kg: the force is probably of "
            "reversed sign; check log.force_direction, then log.force.rotation and log.force.tool.gravity"
        )
    total = np.sum((force - force.mean(axis=0)) ** 2)
    center, center_error, torque_bias, torque_bias_error, torque_rms = None, None, np.zeros(3), None, None
    if torque is not None:
        lever = fit(np.concatenate([_cross(specific), unit], axis=2), torque)
        torque_bias, torque_bias_error = lever.coefficients[3:], lever.standard_errors[3:]
        torque_rms = _rms(lever.residual)
        if variation[1] > SMALLEST_VARIATION and mass > SURE * mass_error:
            center = lever.coefficients[:3] / mass
            center_error = np.hypot(lever.standard_errors[:3], center * mass_error) / mass
    return Identification(
        tool=Tool(mass, center, weight.coefficients[1:], torque_bias),
        mass_error=mass_error,
        bias_error=weight.standard_errors[1:],
        center_of_mass_error=center_error,
        torque_bias_error=torque_bias_error,
        force_rms=_rms(weight.residual),
        torque_rms=torque_rms,
        variation=variation,
        explained=1.0 - float(np.sum(weight.residual**2) / total) if total > 0 else 1.0,
    )


def without_tool(
    force: Array,
    rotation: Rotation,
    tool: Tool,
    acceleration: Array | None = None,
    gravity: Array = GRAVITY,
) -> Array:
    """`force (n, 3)` [N] of the human in the sensor's frame: without weight, bias and, given `acceleration`, m a."""
    return force - tool.mass * _specific_force(rotation, len(force), acceleration, gravity) - tool.bias


def torque_without_tool(
    torque: Array,
    rotation: Rotation,
    tool: Tool,
    acceleration: Array | None = None,
    gravity: Array = GRAVITY,
) -> Array:
    """`torque (n, 3)` [Nm] of the human about the origin of the sensor, in its frame.

    Raises:
        LogError: the centre of mass is not known.
    """
    if tool.center_of_mass is None:
        raise LogError(
            "expected a centre of mass to take the weight off the torque, found none; give "
            "log.force.tool.center_of_mass"
        )
    pull = tool.mass * _specific_force(rotation, len(torque), acceleration, gravity)
    return torque - np.cross(tool.center_of_mass, pull) - tool.torque_bias


def _specific_force(rotation: Rotation, n: int, acceleration: Array | None, gravity: Array) -> Array:
    """γ `(n, 3)` [m/s²]."""
    fall = np.tile(gravity, (n, 1))
    return np.asarray(rotation.inv().apply(fall if acceleration is None else fall - acceleration))


def _cross(vectors: Array) -> Array:
    """Matrices `(n, 3, 3)` with which h ↦ h × v."""
    zero = np.zeros(len(vectors))
    x, y, z = vectors.T
    return np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)


def _variation(specific: Array, gravity: Array) -> tuple[float, float]:
    """See `Identification`."""
    scale = max(float(np.linalg.norm(gravity)), 1e-300)
    scatter = np.linalg.eigvalsh(np.cov(specific.T / scale))
    return float(np.sqrt(scatter.sum())), float(np.sqrt(max(scatter[:2].sum(), 0.0)))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _listed(values: Array) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values) + ")"
