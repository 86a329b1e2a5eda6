"""How many repetitions and how much perturbation an experiment needs for an interval of a wanted width.

Given hyperparameters, the width of a posterior depends on motion and hardly on force, so a simulated session of each
design tells it without training on each. The hyperparameters themselves depend on the perturbation: a model without
coupling puts the force that one axis causes along another into its residual, and that force grows with the
perturbation. So they are trained on a simulated pilot at each perturbation, unless a fitted model brings its own.
A width is how far estimates scatter; what biases them, no width tells (docs/model.md §11).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bayes_impedance.config import replace_value
from bayes_impedance.engines.dense import check_capacity
from bayes_impedance.errors import ConfigurationError, SimulationError
from bayes_impedance.identifiability import Support
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.posterior import Marginal
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.simulation.device import (
    BandLimitedForce,
    ForcePulses,
    Perturbation,
    PositionDisplacement,
    Unperturbed,
)
from bayes_impedance.simulation.experiment import Experiment, simulate

Array = NDArray[np.float64]

#: What the size of a perturbation is called, and its unit.
SIZES: Mapping[type, tuple[str, str]] = {
    BandLimitedForce: ("sd", "N"),
    ForcePulses: ("amplitude", "N"),
    PositionDisplacement: ("amplitude", "m"),
}

#: Called as progress(sessions done, sessions planned, what comes next).
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Expectation:
    """What one design is expected to tell of one impedance along one axis.

    `width` (q95 − q05) / median of the path averages [1], `contraction` of the variance, both averaged over motions;
    `support` is the weakest verdict among them. `perturbation` in the unit of the plan.
    """

    latent: Latent
    axis: str
    repetitions: int
    perturbation: float
    width: float
    contraction: float
    support: Support


@dataclass(frozen=True)
class Plan:
    """Expectations of every design of a grid; immutable. `unit` is that of the perturbations.

    Example:
        >>> widths = {2: 0.4, 4: 0.2}
        >>> plan = Plan(
        ...     tuple(
        ...         Expectation(Latent.STIFFNESS, "x", r, 2.0, width, 0.9, Support.SUPPORTED)
        ...         for r, width in widths.items()
        ...     ),
        ...     "N",
        ... )
        >>> plan.smallest(0.25), plan.smallest(0.1)
        ({2.0: 4}, {2.0: None})
        >>> plan.sentences(0.25)
        ['stiffness, 2 N: 4 repetitions.']
    """

    expectations: tuple[Expectation, ...]
    unit: str

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes, in order of appearance."""
        return tuple(dict.fromkeys(entry.axis for entry in self.expectations))

    @property
    def repetitions(self) -> tuple[int, ...]:
        """Numbers of repetitions, ascending."""
        return tuple(sorted({entry.repetitions for entry in self.expectations}))

    @property
    def perturbations(self) -> tuple[float, ...]:
        """Perturbations, ascending [`unit`]."""
        return tuple(sorted({entry.perturbation for entry in self.expectations}))

    def along(self, latent: Latent | str, axis: str, perturbation: float) -> tuple[Expectation, ...]:
        """Expectations of one impedance at one perturbation, by ascending number of repetitions.

        Raises:
            SimulationError: the plan has no such impedance, axis or perturbation.
        """
        known: Mapping[str, tuple[tuple[object, ...], object]] = {
            "quantity": (tuple(each.value for each in IMPEDANCE_ORDER), getattr(latent, "value", latent)),
            "axis": (self.axes, axis),
            "perturbation": (self.perturbations, perturbation),
        }
        for name, (among, value) in known.items():
            if value not in among:
                listed = ", ".join(str(each) for each in among)
                raise SimulationError(
                    f"{name}: expected one that was planned for, {listed}, got {value!r}; choose one of them"
                )
        chosen = [
            entry
            for entry in self.expectations
            if (entry.latent, entry.axis, entry.perturbation) == (Latent(latent), axis, perturbation)
        ]
        return tuple(sorted(chosen, key=lambda entry: entry.repetitions))

    def smallest(
        self, width: float, latent: Latent | str = Latent.STIFFNESS, axis: str | None = None
    ) -> dict[float, int | None]:
        """Perturbation → least repetitions from which on the interval is at most `width` wide; None where none are.

        `width` [1] is relative to the median. Along `axis`, or along every axis. A width that the verdict "prior only"
        stands beside does not count.

        Raises:
            SimulationError: `width` is not positive, or the plan has no such impedance or axis.
        """
        check_width(width)
        axes = self.axes if axis is None else (axis,)
        found: dict[float, int | None] = {}
        for perturbation in self.perturbations:
            reached = None
            lines = zip(*(self.along(latent, each, perturbation) for each in axes), strict=True)
            for design in reversed(list(lines)):
                if any(entry.width > width or entry.support is Support.PRIOR_ONLY for entry in design):
                    break
                reached = design[0].repetitions
            found[perturbation] = reached
        return found

    def sentences(
        self, width: float, latent: Latent | str = Latent.STIFFNESS, axis: str | None = None
    ) -> list[str]:
        """What `smallest` found, a sentence for each perturbation.

        Raises:
            SimulationError: as `smallest` does.
        """
        found = self.smallest(width, latent, axis)
        name = Latent(latent).value
        return [
            f"{name}, {perturbation:g} {self.unit}: "
            + (
                f"none of the numbers planned for, {self.repetitions[-1]} repetitions at most, is enough."
                if count is None
                else f"{count} repetitions."
            )
            for perturbation, count in found.items()
        ]

    def table(self) -> pd.DataFrame:
        """One row a design, impedance and axis: its expected `width`, `contraction` and `verdict`."""
        return pd.DataFrame(
            {
                "quantity": entry.latent.value,
                "axis": entry.axis,
                f"perturbation [{self.unit}]": entry.perturbation,
                "repetitions": entry.repetitions,
                "width": entry.width,
                "contraction": entry.contraction,
                "verdict": entry.support.value,
            }
            for entry in self.expectations
        )


def check_width(width: float) -> None:
    """Refuse a wanted relative width that no interval has.

    Raises:
        SimulationError: it is not positive and finite.
    """
    if not (math.isfinite(width) and width > 0):
        raise SimulationError(
            f"width: expected a finite value > 0, got {width:g}; .2 asks for an interval of a fifth of the median"
        )


def plan(
    experiment: Experiment,
    model: ImpedanceModel,
    repetitions: Sequence[int],
    perturbations: Sequence[float],
    seed: int = 0,
    motions: int = 3,
    pilot: int = 4,
    progress: Progress | None = None,
) -> Plan:
    """Expected intervals of stiffness, damping and mass for each number of `repetitions` at each of `perturbations`.

    `experiment` is a template: one subject, task, device, sensors, and the kind of perturbation, whose SD or amplitude
    [N, m] is replaced by each of `perturbations`. Widths are averaged over `motions` simulated sessions. A fitted
    `model` keeps its hyperparameters, so it should stem from a perturbation like those planned for; one that is not
    fitted is trained anew, with one start, on the first `pilot` repetitions of each session. Ctrl-C ends it.

    Raises:
        SimulationError: nothing to plan for, a number is out of range, or the template has several subjects or no
            perturbation.
        ConfigurationError: impedance is a function, or as of a recording.
        LogError, TooManySamplesError, NotPositiveDefiniteError: as of a recording.
    """
    _check(experiment, repetitions, perturbations, motions, pilot)
    if model.config.engine.impedance == "map":
        raise ConfigurationError(
            "expected engine.impedance: moments to plan with, whose widths hardly depend on force, got map; set "
            "engine.impedance=moments (and what it cannot have otherwise), or plan with the configuration admittance"
        )
    counts, sizes = sorted(set(repetitions)), sorted(set(perturbations))
    unit = SIZES[type(experiment.perturbation)][1]
    sessions = [(size, seed + motion) for size in sizes for motion in range(motions)]
    judged: dict[tuple[float, int], list[list[Expectation]]] = {}
    for done, (size, each) in enumerate(sessions):
        if progress is not None:
            progress(done, len(sessions), f"{size:g} {unit}")
        rounds = experiment.repetitions
        trials = -(-max(counts[-1], pilot) // rounds)
        session = replace(experiment, trials=trials, perturbation=_of_size(experiment.perturbation, size))
        log = model.prepare(simulate(session, each))
        check_capacity(log.n_samples, model.config.engine.max_samples, f"{counts[-1]} repetitions")
        trained = model if model.is_fitted else _pilot(model, log.select(range(-(-pilot // rounds))))
        for count in counts:
            expected = _expect(trained, log.select(range(count // rounds)), count, size)
            judged.setdefault((size, count), []).append(expected)
    return Plan(
        tuple(_average(each) for motion in judged.values() for each in zip(*motion, strict=True)), unit
    )


def _check(
    experiment: Experiment,
    repetitions: Sequence[int],
    perturbations: Sequence[float],
    motions: int,
    pilot: int,
) -> None:
    if len(experiment.subjects) != 1:
        raise SimulationError(
            f"subjects: expected one to plan for, got {len(experiment.subjects)}; plan for each of them by itself"
        )
    if type(experiment.perturbation) not in SIZES:
        raise SimulationError(
            f"perturbation: expected a kind with a size to vary, {', '.join(kind.__name__ for kind in SIZES)}, got "
            f"{type(experiment.perturbation).__name__}; choose one of them, of any size"
        )
    if not repetitions or not perturbations:
        missing = "perturbations" if repetitions else "repetitions"
        raise SimulationError(f"{missing}: expected at least one to plan for, got none; name one or more")
    for count in repetitions:
        if count < 1 or count % experiment.repetitions:
            raise SimulationError(
                f"repetitions: expected multiples of {experiment.repetitions}, the rounds of a trial, and at least one "
                f"trial, got {count}; choose another number, or one round a trial"
            )
    for size in perturbations:
        if not (math.isfinite(size) and size >= 0):
            raise SimulationError(f"perturbations: expected finite values >= 0, got {size:g}; choose others")
    for name, value, least in (("motions", motions, 1), ("pilot", pilot, 2)):
        if value < least:
            raise SimulationError(f"{name}: expected at least {least} to plan with, got {value}; take more")


def _of_size(kind: Perturbation, size: float) -> Perturbation:
    """Without size nothing perturbs: a servo would still hold the hand."""
    return replace(kind, **{SIZES[type(kind)][0]: size}) if size else Unperturbed()  # type: ignore[type-var]


def _pilot(model: ImpedanceModel, log: PreparedLog) -> ImpedanceModel:
    # An average over motions needs no best of several restarts.
    trained = ImpedanceModel(replace_value(model.config, "training.restarts", 1)).fit(log)
    if trained.report.interrupted:
        raise KeyboardInterrupt
    return trained


def _expect(
    model: ImpedanceModel, log: PreparedLog, repetitions: int, perturbation: float
) -> list[Expectation]:
    """Of the hyperparameters of `model` and the motion and forces of `log` alone."""
    # The log takes the place of the one trained on, whose average path may be that of another task.
    planned = ImpedanceModel(model.config, replace(model.fitted, log=log))
    posterior = planned.posterior(log, latents=list(IMPEDANCE_ORDER))
    return [
        Expectation(
            verdict.latent,
            verdict.axis,
            repetitions,
            perturbation,
            relative_width(posterior[verdict.latent], log.axes.index(verdict.axis)),
            verdict.contraction,
            verdict.support,
        )
        for verdict in planned.verdicts(posterior)
    ]


def relative_width(marginal: Marginal, axis: int) -> float:
    """(q95 − q05) / median, each averaged over samples as in a verdict [1]; of one axis, by index."""
    low, middle, high = (float(marginal.quantile(p)[:, axis].mean()) for p in (0.05, 0.5, 0.95))
    return (high - low) / abs(middle)


def _average(entries: Sequence[Expectation]) -> Expectation:
    order = list(Support)
    return replace(
        entries[0],
        width=float(np.mean([entry.width for entry in entries])),
        contraction=float(np.mean([entry.contraction for entry in entries])),
        support=max((entry.support for entry in entries), key=order.index),
    )
