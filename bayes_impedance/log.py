"""Interaction logs: motion of the hand and force on the robot, checked once and immutable from then on."""

from __future__ import annotations

import hashlib
import json
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
import numpy.typing as npt

from bayes_impedance.errors import LogError, LogWarning

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

AXES = ("x", "y", "z")
VECTORS = ("position", "force", "velocity", "acceleration", "reference", "perturbation")
TRUTH_COLUMN = re.compile(
    r"(desired_position|desired_velocity|desired_acceleration|residual_force)_[xyz]"
    r"|(stiffness|muscle_stiffness|damping|mass)_[xyz]{2}"
)
#: Nobody moves a handle this far [m]; more means that the unit is wrong.
LARGEST_RANGE = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class RowNumbers:
    """How errors name the samples of a trial: `word` ("line" or "row") and `numbers (n,)` in the source."""

    word: str
    numbers: Integers


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One uninterrupted recording, `n` samples of `a` axes.

    `time (n,)` [s]; `position`, `reference` `(n, a)` [m]; `force`, `perturbation` `(n, a)` [N], the force by
    the human on the robot; `velocity (n, a)` [m/s]; `acceleration (n, a)` [m/s²]; `repetition (n,)`; `phase
    (n,)` [1]; `truth`: what a simulation knows, `(n,)` [SI] a column. `InteractionLog` checks and freezes.

    Example:
        >>> time = np.arange(100) / 100.0
        >>> position, force = 0.1 * np.sin(time)[:, None], 3.0 * np.cos(time)[:, None]
        >>> Trial("first", group="Ada", source="memory", time=time, position=position, force=force)
        Trial('first', group='Ada', source='memory', 100 samples)
    """

    name: str
    group: str
    source: str
    time: Array
    position: Array
    force: Array | None = None
    velocity: Array | None = None
    acceleration: Array | None = None
    repetition: Integers = None  # type: ignore[assignment]  # zeros, set below
    phase: Array | None = None
    reference: Array | None = None
    perturbation: Array | None = None
    truth: Mapping[str, Array] = field(default_factory=dict)
    rows: RowNumbers | None = None

    def __post_init__(self) -> None:
        """Give a trial without repetitions one, labelled 0."""
        if self.repetition is None:
            object.__setattr__(self, "repetition", np.zeros(np.shape(self.time)[:1], dtype=np.int64))

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return len(self.time)

    def __repr__(self) -> str:
        """Name, group, source and size."""
        return f"Trial({self.name!r}, group={self.group!r}, source={self.source!r}, {self.n_samples} samples)"


class _Recorded(Protocol):
    @property
    def name(self) -> str: ...

    @property
    def group(self) -> str: ...

    @property
    def source(self) -> str: ...

    @property
    def n_samples(self) -> int: ...


T = TypeVar("T", bound=_Recorded)


class TrialSet(Generic[T]):
    """What raw and prepared logs have in common: trials that share their axes, and what is asked of them."""

    __slots__ = ()

    axes: tuple[str, ...]
    trials: tuple[T, ...]

    @property
    def groups(self) -> tuple[str, ...]:
        """Groups in order of appearance."""
        return tuple(dict.fromkeys(trial.group for trial in self.trials))

    @property
    def by_group(self) -> dict[str, list[int]]:
        """Indices of the trials of each group, groups in order of appearance."""
        members: dict[str, list[int]] = {}
        for index, trial in enumerate(self.trials):
            members.setdefault(trial.group, []).append(index)
        return members

    @property
    def n_samples(self) -> int:
        """Number of samples of all trials together."""
        return sum(trial.n_samples for trial in self.trials)

    def select(self, which: Callable[[T], bool] | Sequence[int]) -> Self:
        """Log of the trials that fulfil a predicate or have these indices, in the order given.

        Raises:
            LogError: that leaves no trial, or an index does not exist.
        """
        return self.with_trials(chosen_trials(self.trials, which))

    def with_trials(self, trials: Sequence[T]) -> Self:
        """Log of trials that were made of those of this one.

        Raises:
            LogError: two of them share source and name.
        """
        _check_names(trials)
        # Past the constructor: the trials are checked, and an axis may well rest in a part of a log.
        log = object.__new__(type(self))
        object.__setattr__(log, "axes", self.axes)
        object.__setattr__(log, "trials", tuple(trials))
        return log

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Every array by name, such as `trials.3.position` or `trials.3.truth.stiffness_xx`."""
        return {
            f"trials.{index}.{name}": array
            for index, trial in enumerate(self.trials)
            for name, array in trial_arrays(trial).items()
        }

    def fingerprint(self) -> str:
        """SHA-256 (hex) of axes, names, groups and arrays; where the files lie does not matter."""
        names = [[trial.name, trial.group] for trial in self.trials]
        return digest({"axes": self.axes, "trials": names}, self.arrays())

    def __repr__(self) -> str:
        """Axes and sizes."""
        sizes = f"{len(self.trials)} trials, {self.n_samples} samples"
        return f"{type(self).__name__}(axes={''.join(self.axes)}, {sizes})"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class InteractionLog(TrialSet[Trial]):
    """Trials that share their axes; arrays are float64, C-contiguous and read-only.

    Warns (LogWarning) when a range looks like a wrong unit.

    Example:
        >>> time = np.arange(100) / 100.0
        >>> log = InteractionLog.from_arrays(time, 0.1 * np.sin(time), 3.0 * np.cos(time), axes=["x"])
        >>> log
        InteractionLog(axes=x, 1 trials, 100 samples)
        >>> log.trials[0].force.shape
        (100, 1)

    Raises:
        LogError: a trial is not a valid recording.
    """

    axes: tuple[str, ...]
    trials: tuple[Trial, ...]

    def __post_init__(self) -> None:
        """Convert, check and freeze."""
        axes = tuple(self.axes)
        if not axes or len(set(axes)) != len(axes) or not set(axes) <= set(AXES):
            raise LogError(
                f"axes: expected some of x, y, z, each once, found {list(axes)}; mend the list of axes"
            )
        if not self.trials:
            raise LogError("expected at least one trial, found none; give a recording that holds samples")
        trials = tuple(_checked(trial, axes) for trial in self.trials)
        _check_names(trials)
        _check_axes(trials, axes)
        object.__setattr__(self, "axes", axes)
        object.__setattr__(self, "trials", trials)

    @classmethod
    def from_arrays(
        cls,
        time: npt.ArrayLike,
        position: npt.ArrayLike,
        force: npt.ArrayLike | None,
        *,
        axes: Sequence[str],
        group: str = "0",
        trial: str = "0",
        velocity: npt.ArrayLike | None = None,
        acceleration: npt.ArrayLike | None = None,
        repetition: npt.ArrayLike | None = None,
        phase: npt.ArrayLike | None = None,
        reference: npt.ArrayLike | None = None,
        perturbation: npt.ArrayLike | None = None,
        truth: Mapping[str, npt.ArrayLike] | None = None,
    ) -> Self:
        """Log of one trial in memory; arrays as in `Trial`, vectors of a single axis also as `(n,)`.

        Raises:
            LogError: as the constructor does.
        """
        optional: dict[str, Any] = {
            "force": force,
            "velocity": velocity,
            "acceleration": acceleration,
            "repetition": repetition,
            "phase": phase,
            "reference": reference,
            "perturbation": perturbation,
            "truth": truth or {},
        }
        vectors: Any = (time, position)
        return cls(tuple(axes), (Trial(str(trial), str(group), "memory", *vectors, **optional),))

    @classmethod
    def concatenate(cls, logs: Iterable[InteractionLog]) -> Self:
        """All trials of several logs, in their order.

        Raises:
            LogError: there is no log, axes differ, or two trials share source and name.
        """
        logs = tuple(logs)
        if not logs:
            raise LogError("expected at least one log, found none; give the logs to concatenate")
        for log in logs:
            if log.axes != logs[0].axes:
                raise LogError(
                    f"expected the same axes in every log, found axes that differ: {', '.join(logs[0].axes)} "
                    f"in {logs[0].trials[0].source} and {', '.join(log.axes)} in {log.trials[0].source}; set "
                    "log.axes to those they have in common"
                )
        return cls(logs[0].axes, tuple(trial for log in logs for trial in log.trials))


# --- shared with prepared logs -------------------------------------------------------------------


def chosen_trials(trials: Sequence[T], which: Callable[[T], bool] | Sequence[int]) -> tuple[T, ...]:
    """Trials that fulfil a predicate or have these indices.

    Raises:
        LogError: none is left, or an index is out of range, repeated or a boolean.
    """
    if callable(which):
        chosen = tuple(trial for trial in trials if which(trial))
    else:
        indices = list(which)
        for index in indices:
            # A mask read as indices would quietly choose trials 0 and 1.
            if isinstance(index, (bool, np.bool_)) or not -len(trials) <= index < len(trials):
                raise LogError(
                    f"expected indices of trials between 0 and {len(trials) - 1}, found {index!r}; "
                    "select by index or with a predicate on the trial"
                )
        chosen = tuple(trials[index] for index in indices)
    if not chosen:
        raise LogError(
            f"expected at least one of {len(trials)} trials to be selected, found none; widen the choice"
        )
    return chosen


def trial_arrays(trial: Any) -> dict[str, npt.NDArray[Any]]:
    """Every array of a raw or prepared trial by name; those of truth as `truth.<column>`."""
    arrays = {
        name: value for name in trial.__slots__ if isinstance(value := getattr(trial, name), np.ndarray)
    }
    return arrays | {f"truth.{name}": value for name, value in sorted(trial.truth.items())}


def read_only(values: npt.ArrayLike, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """C-contiguous array that cannot be written to: a copy, unless `values` is one already and no view of another."""
    if (
        isinstance(values, np.ndarray)
        and values.dtype == dtype
        and values.base is None
        and values.flags.c_contiguous
        and not values.flags.writeable
    ):
        return values
    array = np.array(values, dtype=dtype, order="C", copy=True)
    array.setflags(write=False)
    return array


def digest(header: Any, arrays: Mapping[str, npt.NDArray[Any]]) -> str:
    """SHA-256 (hex) of a JSON-able header and of the names, types, shapes and bytes of arrays."""
    total = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        # Little-endian whatever the machine, so that a fingerprint can be compared between machines.
        array = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
        total.update(json.dumps([name, array.dtype.str, array.shape]).encode())
        total.update(array.tobytes())
    return total.hexdigest()


# --- checks of a trial ---------------------------------------------------------------------------


def _checked(trial: Trial, axes: tuple[str, ...]) -> Trial:
    """`trial` converted and frozen; raises LogError naming source, trial, column and row."""
    time = _numbers(trial, "time", trial.time)
    if time.ndim != 1:
        raise LogError(
            f"{_at(trial)}, column time: expected shape (n,), found {time.shape}; give one time a sample"
        )
    if len(time) < 2:
        raise LogError(
            f"{_at(trial)}: expected at least two samples, found {'one sample' if len(time) else 'none'}; "
            "leave the trial out, or check log.columns.trial and log.window"
        )
    converted: dict[str, Any] = {"time": time}
    for name in VECTORS:
        value = getattr(trial, name)
        converted[name] = None if value is None else _vector(trial, name, value, len(time), axes)
    if trial.phase is not None:
        converted["phase"] = _column(trial, "phase", trial.phase, len(time))
    unknown = [name for name in trial.truth if not TRUTH_COLUMN.fullmatch(name)]
    if unknown:
        raise LogError(
            f"{_at(trial)}: expected truth columns such as desired_position_x or stiffness_xy, found "
            f"{unknown[0]!r}; rename it"
        )
    converted["truth"] = {
        name: read_only(_column(trial, name, value, len(time)), np.float64)
        for name, value in trial.truth.items()
    }
    repetition = _repetition(trial, len(time))
    _check_time(trial, time)
    if trial.phase is not None:
        _check_phase(trial, converted["phase"], repetition)
    frozen = {
        name: read_only(value, np.float64)
        for name, value in converted.items()
        if isinstance(value, np.ndarray)
    }
    return replace(trial, **(converted | frozen), repetition=read_only(repetition, np.int64))


def _at(trial: Trial) -> str:
    return f"{trial.source}, trial {trial.name!r}"


def named_rows(indices: Iterable[int], rows: RowNumbers | None = None) -> str:
    """The first few samples by the numbers of their source: "row 3", "lines 17, 18, 19 and 4 more"."""
    listed = [int(index if rows is None else rows.numbers[index]) for index in indices]
    word = ("row" if rows is None else rows.word) + ("s" if len(listed) > 1 else "")
    more = f" and {len(listed) - 3} more" if len(listed) > 3 else ""
    return f"{word} {', '.join(map(str, listed[:3]))}{more}"


def _numbers(trial: Trial, column: str, values: npt.ArrayLike) -> Array:
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "fiubO":
            raise TypeError
        return array.astype(np.float64, copy=False)
    except (TypeError, ValueError) as error:
        raise LogError(
            f"{_at(trial)}, column {column}: expected real numbers, found something else; "
            "convert it to an array of floats"
        ) from error


def _finite(trial: Trial, column: str, values: Array) -> None:
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise LogError(
            f"{_at(trial)}, column {column}: expected finite numbers, found {values[bad[0]]:g} at "
            f"{named_rows(bad, trial.rows)}; fill or remove these samples"
        )


def _column(trial: Trial, name: str, values: npt.ArrayLike, n: int) -> Array:
    """`(n,)` finite."""
    array = _numbers(trial, name, values)
    if array.shape != (n,):
        raise LogError(
            f"{_at(trial)}, column {name}: expected shape ({n},), as many rows as time has, found "
            f"{array.shape}; give one value a sample"
        )
    _finite(trial, name, array)
    return array


def _vector(trial: Trial, name: str, values: npt.ArrayLike, n: int, axes: tuple[str, ...]) -> Array:
    """`(n, a)` finite; `(n,)` is taken as the column of a single axis."""
    array = _numbers(trial, name, values)
    if array.ndim == 1 and len(axes) == 1:
        array = array[:, None]
    if array.shape != (n, len(axes)):
        raise LogError(
            f"{_at(trial)}, {name}: expected shape ({n}, {len(axes)}), as many rows as time has and one "
            f"column for each of the axes {', '.join(axes)}, found {array.shape}; mend the array or the axes"
        )
    for index, axis in enumerate(axes):
        _finite(trial, f"{name}_{axis}", array[:, index])
    return array


def _repetition(trial: Trial, n: int) -> Integers:
    """Labels re-coded to 0, 1, … in order of appearance; raises LogError when one comes back."""
    labels = np.asarray(trial.repetition)
    if labels.shape != (n,):
        raise LogError(
            f"{_at(trial)}, column repetition: expected shape ({n},), as many rows as time has, found "
            f"{labels.shape}; give one label a sample"
        )
    if labels.dtype.kind == "f":
        _finite(trial, "repetition", labels.astype(np.float64))
    try:
        _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    except TypeError as error:
        raise LogError(
            f"{_at(trial)}, column repetition: expected labels of one kind, found a mixture; "
            "use numbers only or text only"
        ) from error
    codes = np.argsort(np.argsort(first))[inverse]
    # Coded in order of appearance, so a label that comes back is a step down.
    back = np.flatnonzero(np.diff(codes) < 0) + 1
    if len(back):
        raise LogError(
            f"{_at(trial)}, column repetition: expected the samples of a repetition next to each other, "
            f"found label {labels[back[0]].item()!r} again at {named_rows(back[:1], trial.rows)}; number "
            "repetitions anew"
        )
    return codes.astype(np.int64)


def _check_time(trial: Trial, time: Array) -> None:
    _finite(trial, "time", time)
    step = np.diff(time)
    back = np.flatnonzero(step < 0) + 1
    if len(back):
        raise LogError(
            f"{_at(trial)}, column time: expected time to increase, but time goes back at "
            f"{named_rows(back, trial.rows)} (from {time[back[0] - 1]:g} to {time[back[0]]:g} s); sort the "
            "rows, or give each trial its own label in the column that log.columns.trial names"
        )
    same = np.flatnonzero(step == 0) + 1
    if len(same):
        raise LogError(
            f"{_at(trial)}, column time: expected time to increase, found duplicate time stamps at "
            f"{named_rows(same, trial.rows)} ({time[same[0]]:g} s); keep one sample a time stamp, or log "
            "time in a finer resolution"
        )


def _check_phase(trial: Trial, phase: Array, repetition: Integers) -> None:
    outside = np.flatnonzero((phase < 0) | (phase > 1))
    if len(outside):
        raise LogError(
            f"{_at(trial)}, column phase: expected values between 0 and 1, found {phase[outside[0]]:g} at "
            f"{named_rows(outside, trial.rows)}; divide by the length of the task"
        )
    stuck = np.flatnonzero((np.diff(phase) <= 0) & (np.diff(repetition) == 0)) + 1
    if len(stuck):
        raise LogError(
            f"{_at(trial)}, column phase: expected phase to increase strictly within a repetition, found "
            f"{phase[stuck[0]]:g} after {phase[stuck[0] - 1]:g} at {named_rows(stuck, trial.rows)}; label "
            "repetitions in the column that log.columns.repetition names, and cut pauses"
        )


# --- checks of a log -----------------------------------------------------------------------------


def _check_names(trials: Sequence[_Recorded]) -> None:
    seen: set[tuple[str, str]] = set()
    for trial in trials:
        if (trial.source, trial.name) in seen:
            raise LogError(
                f"{trial.source}: expected each trial of a source once, found trial {trial.name!r} twice; "
                "give trials different names"
            )
        seen.add((trial.source, trial.name))


def _check_axes(trials: Sequence[Trial], axes: tuple[str, ...]) -> None:
    """Raises LogError when an axis rests or feels nothing all along; warns when it moves unbelievably far."""
    sources = ", ".join(dict.fromkeys(trial.source for trial in trials))
    forces = [trial.force for trial in trials if trial.force is not None]
    for index, axis in enumerate(axes):
        low = min(trial.position[:, index].min() for trial in trials)
        high = max(trial.position[:, index].max() for trial in trials)
        if low == high:
            raise LogError(
                f"{sources}: expected motion along axis {axis}, found position_{axis} = {low:g} m "
                f"throughout: nothing moves, so impedance cannot be inferred; drop {axis} from log.axes"
            )
        if forces and not any(force[:, index].any() for force in forces):
            raise LogError(
                f"{sources}: expected interaction force along axis {axis}, found force_{axis} = 0 "
                f"throughout; check log.columns.force, or drop {axis} from log.axes"
            )
        if high - low > LARGEST_RANGE:
            warnings.warn(
                f"{sources}: position_{axis} spans {high - low:g} m, units that make a hand move "
                f"{'kilometres' if high - low >= 1000 else 'that far'}; check log.units.position",
                LogWarning,
                stacklevel=4,
            )
