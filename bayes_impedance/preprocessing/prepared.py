"""Trials as the model sees them: smoothed, on an even grid, with every derivative."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from bayes_impedance.errors import LogError
from bayes_impedance.log import Array, Integers, TrialSet, read_only


@dataclass(frozen=True, slots=True, eq=False)
class PreparedTrial:
    """A trial with every derivative the model needs; arrays are read-only.

    `time (n,)` [s]; `(n, a)`: `position`, `reference` [m], `velocity`, `reference_velocity` [m/s],
    `acceleration`, `reference_acceleration` [m/s²], `jerk` [m/s³], `force`, `perturbation` [N]; `(n,)`:
    `repetition`, `phase` [1], `phase_velocity` [1/s], `phase_acceleration` [1/s²]; `truth` `(n,)` [SI] each.
    Force is NaN at samples where it is not known: nothing is conditioned on there. `smoothing` `(n, 6)` is the filter
    that the motion went through, None where there was none: at each sample the first native sample of its window and
    its place in it, length of the window [samples], order of the polynomial, native step [s], and how many of position,
    velocity and acceleration come from the recorded positions.
    """

    name: str
    group: str
    source: str
    time: Array
    position: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    repetition: Integers
    force: Array | None = None
    phase: Array | None = None
    phase_velocity: Array | None = None
    phase_acceleration: Array | None = None
    reference: Array | None = None
    reference_velocity: Array | None = None
    reference_acceleration: Array | None = None
    perturbation: Array | None = None
    smoothing: Array | None = None
    truth: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        for name in ARRAYS:
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(
                    self, name, read_only(value, np.int64 if name == "repetition" else np.float64)
                )
        truth = {name: read_only(value, np.float64) for name, value in self.truth.items()}
        object.__setattr__(self, "truth", truth)

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return len(self.time)

    @property
    def observed(self) -> npt.NDArray[np.bool_]:
        """Samples whose force is known, `(n,)`."""
        if self.force is None:
            return np.zeros(self.n_samples, dtype=bool)
        return np.asarray(np.isfinite(self.force).all(axis=1))

    def part(self, rows: slice | Integers) -> Self:
        """The same trial with some of its samples."""
        arrays: dict[str, Any] = {
            name: value[rows] for name in ARRAYS if (value := getattr(self, name)) is not None
        }
        return replace(self, **arrays, truth={name: value[rows] for name, value in self.truth.items()})

    def __repr__(self) -> str:
        """Name, group, source and size."""
        naming = f"{self.name!r}, group={self.group!r}, source={self.source!r}"
        return f"PreparedTrial({naming}, {self.n_samples} samples)"


_NAMES = ("name", "group", "source")
#: Fields of a prepared trial that are arrays.
ARRAYS = tuple(entry.name for entry in fields(PreparedTrial) if entry.name not in (*_NAMES, "truth"))
_REQUIRED = ("time", "position", "velocity", "acceleration", "jerk", "repetition")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class PreparedLog(TrialSet[PreparedTrial]):
    """Prepared trials that share their axes."""

    axes: tuple[str, ...]
    trials: tuple[PreparedTrial, ...]

    def header(self) -> dict[str, Any]:
        """What `arrays` leaves out, as plain JSON: axes and, for each trial, name, group and source."""
        trials = [{name: getattr(trial, name) for name in _NAMES} for trial in self.trials]
        return {"axes": list(self.axes), "trials": trials}

    @classmethod
    def from_arrays(cls, header: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> Self:
        """The log that gave `header` and `arrays`, to the last bit.

        Raises:
            LogError: the header is not one, an array lacks or one belongs to no trial.
        """
        left = dict(arrays)
        try:
            axes = tuple(str(axis) for axis in header["axes"])
            names: list[dict[str, Any]] = [
                {name: str(entry[name]) for name in _NAMES} for entry in header["trials"]
            ]
        except (KeyError, TypeError) as error:
            raise LogError(
                f"stored log: expected axes and trials in the header, found another one ({error!r}); store "
                "it anew"
            ) from error
        trials = []
        for index, naming in enumerate(names):
            prefix = f"trials.{index}."
            own = {key.removeprefix(prefix): left.pop(key) for key in list(left) if key.startswith(prefix)}
            lacking = [name for name in _REQUIRED if name not in own]
            if lacking:
                raise LogError(
                    f"stored log: expected an array {prefix}{lacking[0]}, found none; store the log anew"
                )
            plain: dict[str, Any] = {name: own.pop(name) for name in ARRAYS if name in own}
            truth = {
                name.removeprefix("truth."): own.pop(name) for name in list(own) if name.startswith("truth.")
            }
            left |= {prefix + name: value for name, value in own.items()}
            trials.append(PreparedTrial(**naming, **plain, truth=truth))
        if left:
            raise LogError(
                f"stored log: expected arrays of {len(trials)} trials, found {min(left)!r} besides; store "
                "the log anew"
            )
        return cls(axes, tuple(trials))
