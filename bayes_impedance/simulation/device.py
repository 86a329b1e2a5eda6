"""The device in the hand: its admittance law, its sensors, and how it perturbs.

    M_r ẍ + D_r ẋ = u + n + p

u is the force of the hand, n what the force sensor adds to it, p the perturbation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.errors import SimulationError

Array = NDArray[np.float64]

#: Directions of pulses and displacements around the hand.
DIRECTIONS = 8


def _spaced(width: float, interval: float) -> None:
    if not 0 < width < interval:
        raise SimulationError(
            f"perturbation.interval: expected more than the {width:g} s that a perturbation lasts, and that more than "
            f"0, got {interval:g} s; leave time between them"
        )


def _at_least_zero(where: str, values: object, signed: tuple[str, ...] = ()) -> None:
    for entry in fields(values):  # type: ignore[arg-type]  # a dataclass of ours
        value = getattr(values, entry.name)
        numbers = np.asarray(value, dtype=np.float64)
        if not np.isfinite(numbers).all() or (entry.name not in signed and (numbers < 0).any()):
            bound = "a finite value" if entry.name in signed else "a finite value >= 0"
            raise SimulationError(f"{where}.{entry.name}: expected {bound}, got {value}; choose one")


@dataclass(frozen=True)
class Admittance:
    """Virtual mass M_r [kg] and damping D_r [Ns/m], the same along every axis.

    Raises:
        SimulationError: either is negative.
    """

    mass: float = 2.0
    damping: float = 6.0

    def __post_init__(self) -> None:
        """Refuse a device that would drive itself."""
        _at_least_zero("device", self)


@dataclass(frozen=True)
class Sensor:
    """What a sensor makes of a signal: white noise, resolution, bias in its unit, latency in seconds; 0 is off.

    Noise and bias of the force sensor act on the controller too. Resolution and latency are those of the recording.

    Raises:
        SimulationError: noise, resolution or latency is negative.
    """

    noise_sd: float = 0.0
    resolution: float = 0.0
    bias: float = 0.0
    latency: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what no sensor does."""
        _at_least_zero("sensor", self, signed=("bias",))

    def added(self, shape: tuple[int, ...], generator: np.random.Generator) -> Array:
        """Noise and bias, `shape` [unit of the signal]."""
        noise: Array = generator.standard_normal(shape)
        return self.bias + self.noise_sd * noise

    def recorded(self, signal: Array, step: float) -> Array:
        """`signal` `(n, axes)` late and in steps of the resolution; before the first sample arrives, that sample."""
        late = round(min(self.latency / step, len(signal) - 1))
        shifted = np.concatenate([np.repeat(signal[:1], late, axis=0), signal[: len(signal) - late]])
        return self.resolution * np.round(shifted / self.resolution) if self.resolution else shifted


@dataclass(frozen=True)
class Sensors:
    """Those of force [N] and position [m]."""

    force: Sensor = Sensor(noise_sd=0.05)
    position: Sensor = Sensor(resolution=1e-6)


IDEAL = Sensors(Sensor(), Sensor())


class Perturbation(Protocol):
    """A force that the device adds, and perhaps a displacement that it commands."""

    @property
    def gains(self) -> tuple[float, float]:
        """Stiffness and damping of the servo that commands displacements [N/m, Ns/m]; 0, 0 where it has none."""
        ...

    def draw(self, n: int, step: float, generator: np.random.Generator) -> tuple[Array, Array]:
        """Force `(n, 2)` [N], and `(n, 5)`: share of the servo, displacement [m] and its velocity [m/s].

        The second has no rows where no displacement is commanded.
        """
        ...


NO_SERVO: Array = np.empty((0, 5))


@dataclass(frozen=True)
class Unperturbed:
    """No perturbation at all."""

    gains: ClassVar[tuple[float, float]] = (0.0, 0.0)

    def draw(self, n: int, step: float, generator: np.random.Generator) -> tuple[Array, Array]:
        """See `Perturbation`."""
        return np.zeros((n, 2)), NO_SERVO


@dataclass(frozen=True)
class BandLimitedForce:
    """Pseudo-random force on each axis: thirty sinusoids between `low` and `high` [Hz], SD `sd` [N].

    Raises:
        SimulationError: `sd` is negative, or the band is empty.
    """

    sd: float
    low: float = 0.3
    high: float = 4.0
    gains: ClassVar[tuple[float, float]] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Refuse an empty band."""
        _at_least_zero("perturbation", self)
        if not self.low < self.high:
            raise SimulationError(
                f"perturbation.low: expected less than high, {self.high:g} Hz, got {self.low:g} Hz; widen the band"
            )

    def draw(self, n: int, step: float, generator: np.random.Generator) -> tuple[Array, Array]:
        """See `Perturbation`."""
        terms = 30
        omega = 2.0 * math.pi * generator.uniform(self.low, self.high, (2, terms))
        shift = generator.uniform(0.0, 2.0 * math.pi, (2, terms))
        time = step * np.arange(n)
        force = np.zeros((n, 2))
        for a in range(2):
            for rate, start in zip(omega[a], shift[a], strict=True):
                force[:, a] += np.sin(rate * time + start)
        return self.sd * math.sqrt(2.0 / terms) * force, NO_SERVO


@dataclass(frozen=True)
class ForcePulses:
    """Rectangular pulses of `amplitude` [N] and `width` [s] in one of eight directions, about one in `interval` [s].

    Raises:
        SimulationError: a value is negative, or pulses would overlap.
    """

    amplitude: float
    width: float = 0.15
    interval: float = 1.0
    gains: ClassVar[tuple[float, float]] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Refuse pulses that overlap."""
        _at_least_zero("perturbation", self)
        _spaced(self.width, self.interval)

    def draw(self, n: int, step: float, generator: np.random.Generator) -> tuple[Array, Array]:
        """See `Perturbation`."""
        force = np.zeros((n, 2))
        for start, direction in _events(n * step, self.interval, self.width, generator):
            first = round(start / step)
            force[first : first + round(self.width / step)] = self.amplitude * direction
        return force, NO_SERVO


@dataclass(frozen=True)
class PositionDisplacement:
    """The ensemble method: a stiff servo moves the hand `amplitude` [m] off its unperturbed path, holds, and lets go.

    Along half a cosine of `ramp` [s] to one of eight directions, `hold` [s] there, and back; about one in `interval`
    [s]. `gains` of the servo [N/m, Ns/m]. Source: Burdet, Osu, Franklin, Yoshioka, Milner, Kawato 2000.

    Raises:
        SimulationError: a value is negative, there is no ramp, or displacements would overlap.
    """

    amplitude: float = 0.008
    ramp: float = 0.1
    hold: float = 0.15
    interval: float = 1.5
    gains: tuple[float, float] = (20000.0, 400.0)

    def __post_init__(self) -> None:
        """Refuse displacements that overlap."""
        _at_least_zero("displacement", self)
        if self.ramp == 0:
            raise SimulationError(
                "displacement.ramp: expected more than 0 s, got 0 s; give the hand time to move"
            )
        _spaced(self.width, self.interval)

    @property
    def width(self) -> float:
        """Duration of a displacement [s]."""
        return 2.0 * self.ramp + self.hold

    def draw(self, n: int, step: float, generator: np.random.Generator) -> tuple[Array, Array]:
        """See `Perturbation`; the displacement is from the unperturbed path."""
        servo = np.zeros((n, 5))
        for start, direction in _events(n * step, self.interval, self.width, generator):
            first = round(start / step)
            time = step * np.arange(min(round(self.width / step), n - first))
            # Up over one ramp, and down over the last.
            share = np.clip(np.minimum(time, self.width - time) / self.ramp, 0.0, 1.0)
            rising = np.where(time < 0.5 * self.width, 1.0, -1.0) * (share < 1.0)
            rows = slice(first, first + len(time))
            servo[rows, 0] = 1.0
            servo[rows, 1:3] = self.amplitude * direction * (0.5 - 0.5 * np.cos(math.pi * share))[:, None]
            slope = 0.5 * math.pi / self.ramp * np.sin(math.pi * share) * rising
            servo[rows, 3:5] = self.amplitude * direction * slope[:, None]
        return np.zeros((n, 2)), servo


def _events(
    duration: float, interval: float, width: float, generator: np.random.Generator
) -> list[tuple[float, Array]]:
    """Start and direction of one event in each interval that fits, at a random time of it."""
    events = []
    # Not `//`, which makes 49 of 10 s at .2 s.
    for k in range(int(duration / interval + 1e-9)):
        angle = 2.0 * math.pi * generator.integers(DIRECTIONS) / DIRECTIONS
        start = k * interval + generator.uniform(0.0, interval - width)
        events.append((start, np.array([math.cos(angle), math.sin(angle)])))
    return events
