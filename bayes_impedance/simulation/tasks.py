"""What the person wants to do: closed paths as functions of phase, and the pace at which phase runs.

A path knows its derivatives with respect to phase up to the second; both vanish where it has a corner, so that the
desired trajectory and its velocity and acceleration are continuous whatever the pace.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.errors import SimulationError

Array = NDArray[np.float64]

#: Middle of the workspace, from the shoulder [m].
CENTRE = (0.30, 0.325)
#: Where stiffness and mass of the arm hardly couple the axes [m].
UNCOUPLED = (0.275, 0.2)


class Path(Protocol):
    """A closed path: position at phase 0 and 1 is the same."""

    @property
    def length(self) -> float:
        """Length of one round [m]."""
        ...

    def __call__(self, phase: Array) -> tuple[Array, Array, Array]:
        """Position and its first and second derivative with respect to phase, `(n, 2)` [m], at phases `(n,)`."""
        ...


@dataclass(frozen=True)
class Flower:
    """A circle, then four arcs of 270° around it with centres √2 radii out, each traced from rest to rest.

    Path of the paper's simulation, radius .04 m. Each piece has a share of phase as of length, and a minimum-jerk
    profile along it.

    Raises:
        SimulationError: the radius is not positive.
    """

    centre: tuple[float, float] = CENTRE
    radius: float = 0.04

    def __post_init__(self) -> None:
        """Refuse a radius that is none."""
        _positive("radius", self.radius)

    @property
    def length(self) -> float:
        """2π r of the circle and four times 1.5 π r [m]."""
        return 8.0 * math.pi * self.radius

    def __call__(self, phase: Array) -> tuple[Array, Array, Array]:
        """See `Path`."""
        pieces = self._pieces()
        edges = np.cumsum([0.0] + [abs(sweep) for *_, sweep in pieces]) / (8.0 * math.pi)
        which = np.clip(np.searchsorted(edges, phase, side="right") - 1, 0, len(pieces) - 1)
        middle, start, sweep = (np.array(values)[which] for values in zip(*pieces, strict=True))
        share = (edges[1:] - edges[:-1])[which]
        s, s1, s2 = minimum_jerk((phase - edges[:-1][which]) / share)
        angle, rate, change = start + sweep * s, sweep * s1 / share, sweep * s2 / share**2
        out = np.stack([np.cos(angle), np.sin(angle)], -1)
        along = np.stack([-np.sin(angle), np.cos(angle)], -1)
        return (
            np.asarray(self.centre) + self.radius * (middle + out),
            self.radius * along * rate[:, None],
            self.radius * (along * change[:, None] - out * rate[:, None] ** 2),
        )

    def _pieces(self) -> list[tuple[tuple[float, float], float, float]]:
        """Centre in radii, first angle and sweep [rad] of each piece, which begins where the last one ended."""
        quarter = 0.5 * math.pi
        pieces = [((0.0, 0.0), 0.5 * quarter, 4.0 * quarter)]
        for k in range(1, 5):
            outward = k * quarter
            middle = (math.sqrt(2.0) * math.cos(outward), math.sqrt(2.0) * math.sin(outward))
            pieces.append((middle, outward - 1.5 * quarter, 3.0 * quarter))
        return pieces


@dataclass(frozen=True)
class FigureEight:
    """x = width/2 · sin 2πφ, y = height/2 · sin 4πφ around `centre` [m].

    Raises:
        SimulationError: a size is not positive.
    """

    centre: tuple[float, float] = CENTRE
    width: float = 0.16
    height: float = 0.08

    def __post_init__(self) -> None:
        """Refuse sizes that are none."""
        _positive("width", self.width)
        _positive("height", self.height)

    @property
    def length(self) -> float:
        """Length of the polygon through 2 000 points [m]."""
        points = self(np.linspace(0.0, 1.0, 2001))[0]
        return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())

    def __call__(self, phase: Array) -> tuple[Array, Array, Array]:
        """See `Path`."""
        omega = 2.0 * math.pi * np.array([1.0, 2.0])
        angle, amplitude = phase[:, None] * omega, 0.5 * np.array([self.width, self.height])
        return (
            np.asarray(self.centre) + amplitude * np.sin(angle),
            amplitude * omega * np.cos(angle),
            -amplitude * omega**2 * np.sin(angle),
        )


@dataclass(frozen=True)
class Reaches:
    """Minimum-jerk reaches from the centre to `targets` on a circle and back, one after the other.

    `distance` [m]; `dwell`, share of the time of each reach that the hand rests at its end.

    Raises:
        SimulationError: distance or number of targets is not positive, or no time is left to move.
    """

    centre: tuple[float, float] = CENTRE
    distance: float = 0.1
    targets: int = 4
    dwell: float = 0.2

    def __post_init__(self) -> None:
        """Refuse what is no reach."""
        _positive("distance", self.distance)
        if self.targets < 1:
            raise SimulationError(f"targets: expected at least 1, got {self.targets}; name one or more")
        if not 0.0 <= self.dwell < 1.0:
            raise SimulationError(
                f"dwell: expected a share in [0, 1), got {self.dwell:g}; leave time to move"
            )

    @property
    def length(self) -> float:
        """Out and back for every target [m]."""
        return 2.0 * self.targets * self.distance

    def __call__(self, phase: Array) -> tuple[Array, Array, Array]:
        """See `Path`."""
        reaches = 2 * self.targets
        which = np.clip(np.floor(phase * reaches).astype(int), 0, reaches - 1)
        moving = 1.0 - self.dwell
        s, s1, s2 = minimum_jerk(np.minimum((phase * reaches - which) / moving, 1.0))
        back = which % 2 == 1
        s, sign = np.where(back, 1.0 - s, s), np.where(back, -1.0, 1.0)
        angle = 2.0 * math.pi * (which // 2) / self.targets
        out = self.distance * np.stack([np.cos(angle), np.sin(angle)], -1)
        scale = reaches / moving
        return (
            np.asarray(self.centre) + out * s[:, None],
            out * (sign * s1 * scale)[:, None],
            out * (sign * s2 * scale**2)[:, None],
        )


#: Tasks by the name that the command line has for them.
TASKS: Mapping[str, type[Flower] | type[FigureEight] | type[Reaches]] = {
    "flower": Flower,
    "figure-eight": FigureEight,
    "reaches": Reaches,
}


def minimum_jerk(share: Array) -> tuple[Array, Array, Array]:
    """10 τ³ − 15 τ⁴ + 6 τ⁵ with its first and second derivative, at shares of a movement in [0, 1].

    Source: Flash & Hogan 1985.
    """
    t = share
    return (
        t**3 * (10.0 - 15.0 * t + 6.0 * t**2),
        30.0 * (t * (1.0 - t)) ** 2,
        60.0 * t * (1.0 - t) * (1.0 - 2.0 * t),
    )


@dataclass(frozen=True)
class Pace:
    """How long a repetition takes and how evenly.

    `repetition` [s], its median; `spread`, SD of its logarithm from trial to trial; `unevenness`, SD of the a of `Run`
    from repetition to repetition: the first half takes the hand (1 + a/π) / (1 − a/π) times as far as the second.

    Raises:
        SimulationError: a value is out of range.
    """

    repetition: float = 10.0
    spread: float = 0.05
    unevenness: float = 0.1

    def __post_init__(self) -> None:
        """Refuse what phase cannot follow."""
        _positive("pace.repetition", self.repetition)
        for name in ("spread", "unevenness"):
            value = getattr(self, name)
            if not 0.0 <= value < 0.5:
                raise SimulationError(
                    f"pace.{name}: expected a share in [0, 0.5), got {value:g}; choose a smaller one"
                )

    def draw(self, repetitions: int, generator: np.random.Generator) -> Run:
        """The pace of one trial."""
        duration = self.repetition * float(np.exp(self.spread * generator.standard_normal()))
        uneven = np.clip(self.unevenness * generator.standard_normal(repetitions), -0.9, 0.9)
        return Run(duration, uneven)


@dataclass(frozen=True)
class Run:
    """Phase over time of one trial: `duration` [s] of each repetition, `uneven` `(repetitions,)` as drawn.

        φ = τ + a W(τ),    W' = ½ sin 2πτ − ¼ sin 4πτ,    τ = share of the time of the repetition

    W' and W'' vanish at both ends, so pace is smooth from one repetition to the next.
    """

    duration: float
    uneven: Array

    def repetition(self, time: Array) -> NDArray[np.int64]:
        """Which repetition a time `(n,)` [s] falls into."""
        which = np.floor(time / self.duration).astype(np.int64)
        return np.clip(which, 0, len(self.uneven) - 1)

    def phase(self, time: Array) -> tuple[Array, Array, Array]:
        """φ, φ̇, φ̈ at times `(n,)` [s]."""
        which = self.repetition(time)
        share, amount = time / self.duration - which, self.uneven[which]
        once, twice = 2.0 * math.pi * share, 4.0 * math.pi * share
        integral = (1.0 - np.cos(once)) / (4.0 * math.pi) - (1.0 - np.cos(twice)) / (16.0 * math.pi)
        rate = 0.5 * np.sin(once) - 0.25 * np.sin(twice)
        change = math.pi * (np.cos(once) - np.cos(twice))
        return (
            share + amount * integral,
            (1.0 + amount * rate) / self.duration,
            amount * change / self.duration**2,
        )


def desired_motion(path: Path, run: Run, time: Array) -> tuple[Array, Array, Array]:
    """x_d, ẋ_d, ẍ_d `(n, 2)` [m, s] at times `(n,)` [s], by the chain rule."""
    phase, rate, change = run.phase(time)
    x, x1, x2 = path(phase)
    return x, x1 * rate[:, None], x2 * rate[:, None] ** 2 + x1 * change[:, None]


def _positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise SimulationError(f"{name}: expected a finite value > 0, got {value:g}; choose one")
