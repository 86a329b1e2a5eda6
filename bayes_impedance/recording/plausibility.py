"""What looks wrong between channels: velocity against position, the sign of force, and units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np

from bayes_impedance.config.log import FORCE_UNITS, LENGTH_UNITS
from bayes_impedance.log import Array
from bayes_impedance.recording import least_squares
from bayes_impedance.recording.alike import Alike

#: A velocity is off when its ratio to the derivative of position is off by as much, or it lags by as much [s].
RATIO_TOLERANCE, LAG_TOLERANCE = 0.1, 0.02
#: Correlation with the derivative of position below which a ratio means nothing.
SMALLEST_CORRELATION = 0.7
#: Of two signals with less roughness than this noise is no excuse.
LARGEST_ROUGHNESS = 0.1
#: Standard errors from zero that make a sign certain.
SURE = 3.0


@dataclass(frozen=True)
class VelocityMismatch:
    """A velocity that is `ratio` [1] times the derivative of position, `lag` [s] late."""

    channel: str
    ratio: float
    lag: float

    @property
    def sentence(self) -> str:
        """What it is and how to mend it."""
        return (
            f"{self.channel}: velocity is {self.ratio:.2f} times the derivative of position and "
            f"{1e3 * self.lag:.0f} ms late; set log.columns.velocity to null so that it is taken from position, or "
            "mend log.units.velocity, or the time of both, log.columns.time and log.sampling_rate"
        )


@dataclass(frozen=True)
class VelocityUnrelated:
    """A velocity that is no multiple of the derivative of position: their `correlation` [1], free of noise."""

    channel: str
    correlation: float

    @property
    def sentence(self) -> str:
        """What it is and how to mend it."""
        return (
            f"{self.channel}: velocity goes another way than the derivative of position (correlation "
            f"{self.correlation:.2f}), and noise does not explain it; set log.columns.velocity to null so that it is "
            "taken from position, or name the column that is meant"
        )


def velocity_mismatch(
    time: Array, position: Array, velocity: Array, channel: str, window: float = 0.3
) -> VelocityMismatch | VelocityUnrelated | None:
    """Velocity `(n,)` [m/s] against the derivative of position `(n,)` [m], smoothed alike over `window` [s].

        v(t) ≈ r ẋ(t − τ) ≈ r ẋ − r τ ẍ

    None also where noise drowns the motion, so that there is nothing to compare.

    Raises:
        LogError: the recording is shorter than three windows.
    """
    alike = Alike(time, window)
    v, x = alike.smooth(velocity[:, None]), position[:, None]
    slope, curvature = alike.derivative(x), alike.derivative(x, order=2)
    scale = float(np.sqrt(np.sum(v**2) * np.sum(slope**2)))
    if scale == 0:
        return None
    correlation = float(np.sum(v * slope)) / scale
    if abs(correlation) < SMALLEST_CORRELATION:
        noisy = max(alike.roughness(velocity[:, None]), alike.roughness(x, order=1)) > LARGEST_ROUGHNESS
        return None if noisy else VelocityUnrelated(channel, correlation)
    ratio, bent = least_squares.fit(np.stack([slope, curvature], axis=2), v).coefficients
    lag = float(-bent / ratio)
    if abs(ratio - 1.0) <= RATIO_TOLERANCE and abs(lag) <= max(LAG_TOLERANCE, 2 * alike.step):
        return None
    return VelocityMismatch(channel, float(ratio), lag)


class Sign(str, Enum):
    """What the flow of energy says about the sign of a force."""

    EXPECTED = "as expected"
    REVERSED = "looks reversed"
    UNKNOWN = "cannot tell"


@dataclass(frozen=True)
class SignCheck:
    """Mean power [W] that the human puts into the robot, its standard error [W], and the verdict."""

    power: float
    error: float
    sign: Sign

    @property
    def sentence(self) -> str:
        """What the power says, and how to mend a sign."""
        measured = f"the human puts {self.power:.3g} ± {self.error:.2g} W into the robot"
        if self.sign is Sign.EXPECTED:
            return f"sign of the force as expected: {measured}"
        if self.sign is Sign.REVERSED:
            return (
                f"sign of the force looks reversed: {measured}, where a person who guides a passive robot gives power; "
                "set log.force_direction to the other, unless the robot leads the motion"
            )
        return (
            f"sign of the force cannot be told: {measured}; it takes a passive robot that the person moves, not one "
            "that leads or perturbs the motion"
        )


def sign_check(force: Array, velocity: Array, perturbation: Array | None = None) -> SignCheck:
    """Sign of the force from P = Σ u·v, for `force`, the robot's `perturbation (n, a)` [N] and `velocity (n, a)` [m/s].

    The standard error is that of u ≈ B v given the motion, P = B Σ v·v: strokes of different size are no error. A
    person damps what the robot adds, so a perturbed robot proves nothing here; its `DeviceLaw` does.
    """
    size = float(np.mean(np.sum(velocity**2, axis=1)))
    slope = least_squares.fit(velocity[:, :, None], force)
    power, error = size * float(slope.coefficients[0]), size * float(slope.standard_errors[0])
    sign = Sign.UNKNOWN
    if abs(power) > SURE * error and (perturbation is None or not perturbation.any()):
        sign = Sign.EXPECTED if power > 0 else Sign.REVERSED
    return SignCheck(power, error, sign)


@dataclass(frozen=True)
class UnitSuspicion:
    """A quantity of size `value` (its SI unit), and the unit it probably is in."""

    quantity: str
    value: float
    unit: str
    probable: str

    @property
    def sentence(self) -> str:
        """What it is and how to mend it."""
        return (
            f"{self.quantity} of {self.value:.3g} {self.unit} is not what a hand does; set log.units.{self.quantity}, "
            f"probably to {self.probable}"
        )


#: The smallest and largest size of each quantity that is plausible (SI), and factors of the units that it may be in.
PLAUSIBLE: Mapping[str, tuple[float, float, str, Mapping[str, float]]] = {
    "position": (1e-4, 10.0, "m", LENGTH_UNITS),
    "velocity": (1e-4, 10.0, "m/s", {f"{unit}/s": factor for unit, factor in LENGTH_UNITS.items()}),
    "acceleration": (1e-4, 500.0, "m/s^2", {f"{unit}/s^2": factor for unit, factor in LENGTH_UNITS.items()}),
    "force": (0.02, 1000.0, "N", FORCE_UNITS),
}


def unit_check(quantity: str, values: Array) -> UnitSuspicion | None:
    """Size of `values (n, a)` over all axes: range of position, largest velocity or acceleration, RMS of force.

    None also for sizes that no other unit explains.
    """
    smallest, largest, unit, factors = PLAUSIBLE[quantity]
    if quantity == "position":
        size = float(np.ptp(values, axis=0).max())
    elif quantity == "force":
        size = float(np.sqrt(np.mean(np.sum(values**2, axis=1))))
    else:
        size = float(np.linalg.norm(values, axis=1).max())
    # Nothing but zeros is a matter of its own.
    if size == 0 or smallest <= size <= largest:
        return None
    middle = np.sqrt(smallest * largest)
    probable = min(factors, key=lambda name: abs(np.log(size * factors[name] / middle)))
    return None if factors[probable] == 1.0 else UnitSuspicion(quantity, size, unit, probable)
