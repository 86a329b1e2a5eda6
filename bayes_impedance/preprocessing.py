"""From raw samples to smoothed motion and force on an even grid.

The same Savitzky–Golay filter acts on force and on motion: filtering one alone would bias mass, damping
and stiffness, because u = m ẍ + d ẋ + k x + … holds between signals that saw the same filter.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial
from numpy.polynomial.legendre import legder, legvander
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import correlate1d

from bayes_impedance.config import PreprocessingConfig, Smoother
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.log import (
    VECTORS,
    Array,
    Integers,
    InteractionLog,
    Trial,
    TrialSet,
    read_only,
)

#: A channel and its first two derivatives.
Orders = tuple[Array, Array, Array]

#: Steps that differ from the median by more than this share of it make a trial unevenly sampled.
UNEVEN = 0.01
#: Samples of half a window; a number that does not overflow, and that no log has.
LONGEST = 1e9
#: Samples that interpolation may put in place of one; more are a gap that `max_gap` was raised above.
MOST_FILLED = 1000


@dataclass(frozen=True, slots=True, eq=False)
class PreparedTrial:
    """A trial with every derivative the model needs; arrays are read-only.

    `time (n,)` [s]; `(n, a)`: `position`, `reference` [m], `velocity`, `reference_velocity` [m/s],
    `acceleration`, `reference_acceleration` [m/s²], `jerk` [m/s³], `force`, `perturbation` [N]; `(n,)`:
    `repetition`, `phase` [1], `phase_velocity` [1/s], `phase_acceleration` [1/s²]; `truth` `(n,)` [SI] each.
    Force is NaN at samples where it is not known: nothing is conditioned on there.
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
    truth: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        for name in _ARRAYS:
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

    def __repr__(self) -> str:
        """Name, group, source and size."""
        naming = f"{self.name!r}, group={self.group!r}, source={self.source!r}"
        return f"PreparedTrial({naming}, {self.n_samples} samples)"


_NAMES = ("name", "group", "source")
_ARRAYS = tuple(entry.name for entry in fields(PreparedTrial) if entry.name not in (*_NAMES, "truth"))
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
            plain: dict[str, Any] = {name: own.pop(name) for name in _ARRAYS if name in own}
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


def prepare(log: InteractionLog, config: PreprocessingConfig) -> PreparedLog:
    """Every trial checked for gaps, put on an even grid, smoothed, differentiated and thinned to `rate`.

    Warns (LogWarning) when the smoother needs a longer window.

    Example:
        >>> time = np.arange(200) / 100.0
        >>> log = InteractionLog.from_arrays(time, time**2, np.sin(time), axes=["x"])
        >>> prepared = prepare(log, PreprocessingConfig(rate=20))
        >>> prepared.n_samples, prepared.trials[0].acceleration.mean().round(6).item()
        (40, 2.0)

    Raises:
        LogError: names source and trial.
    """
    return PreparedLog(log.axes, tuple(_prepare(trial, config) for trial in log.trials))


def _prepare(trial: Trial, config: PreprocessingConfig) -> PreparedTrial:
    steps = np.diff(trial.time)
    step = float(np.median(steps))
    gap = int(np.argmax(steps))
    # Relative slack, here and below: differences of time stamps carry rounding errors.
    if steps[gap] > config.max_gap * (1 + 1e-9):
        raise LogError(
            f"{_at(trial)}: expected steps of at most {config.max_gap:g} s, found a gap of {steps[gap]:g} s "
            f"from {trial.time[gap]:g} to {trial.time[gap + 1]:g} s; cut there with log.window, or raise "
            "preprocessing.max_gap"
        )
    if config.smoother is None:
        prepared = _as_logged(trial)
    else:
        if np.abs(steps - step).max() > UNEVEN * step * (1 + 1e-9):
            trial = _on_even_grid(trial, step)
        prepared = _smoothed(trial, _filter(trial, config.smoother, step))
    return _thinned(prepared, step, config.rate)


def _at(trial: Trial | PreparedTrial) -> str:
    return f"{trial.source}, trial {trial.name!r}"


def _repetitions(trial: Trial) -> Iterator[slice]:
    """The samples of each repetition; they lie next to each other."""
    edges = np.flatnonzero(np.diff(trial.repetition)) + 1
    for start, end in zip([0, *edges], [*edges, trial.n_samples], strict=True):
        yield slice(int(start), int(end))


# --- even grid -----------------------------------------------------------------------------------


def _on_even_grid(trial: Trial, step: float) -> Trial:
    """`trial` interpolated to steps of `step` [s]: monotone cubics, which do not overshoot."""
    time = trial.time
    count = math.floor((time[-1] - time[0]) / step + 1e-9) + 1
    if count > MOST_FILLED * trial.n_samples:
        raise LogError(
            f"{_at(trial)}: expected a log without long gaps, found {trial.n_samples} samples that would have to be "
            f"filled up to {count:.3g} at steps of {step:g} s; cut the gaps with log.window, or lower "
            "preprocessing.max_gap to find them"
        )
    grid = time[0] + step * np.arange(count)
    grid = np.minimum(grid, time[-1])
    before = np.clip(np.searchsorted(time, grid, side="right") - 1, 0, trial.n_samples - 2)
    # Between two repetitions the nearer sample decides; elsewhere both have one label.
    nearer = before + (grid - time[before] > time[before + 1] - grid)
    within = trial.repetition[before] == trial.repetition[before + 1]
    repetition = trial.repetition[np.where(within, before, nearer)]

    changes: dict[str, Any] = {"time": grid, "repetition": repetition, "rows": None}
    for name in VECTORS:
        values = getattr(trial, name)
        if values is not None:
            changes[name] = PchipInterpolator(time, values, axis=0)(grid)
    if trial.phase is not None:
        phase = np.empty_like(grid)
        for part in _repetitions(trial):
            chosen = repetition == trial.repetition[part.start]
            phase[chosen] = _phase_at(grid[chosen], time[part], trial.phase[part], trial)
        changes["phase"] = phase
    changes["truth"] = {name: np.interp(grid, time, values) for name, values in trial.truth.items()}
    return replace(trial, **changes)


def _phase_at(grid: Array, time: Array, phase: Array, trial: Trial) -> Array:
    """Phase of one repetition at `grid` [s]; continued straight beyond its first and last sample."""
    _check_phase_length(len(time), float(time[0]), trial)
    slope = np.diff(phase) / np.diff(time)
    straight = slope[0] * np.minimum(grid - time[0], 0) + slope[-1] * np.maximum(grid - time[-1], 0)
    value: Array = PchipInterpolator(time, phase)(np.clip(grid, time[0], time[-1])) + straight
    return value


def _check_phase_length(n: int, start: float, trial: Trial) -> None:
    if n < 2:
        raise LogError(
            f"{_at(trial)}: expected at least two samples in a repetition, for phase needs a rate, found one "
            f"at {start:g} s; cut it off with log.window"
        )


# --- smoothing -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _SavitzkyGolay:
    """Value or derivative of the local polynomial fit over `length` samples that are `step` [s] apart."""

    length: int
    order: int
    step: float

    def __call__(self, values: Array, derivative: int = 0) -> Array:
        """Filtered `values (n, …)`; the first and last fits also serve the half windows at the ends."""
        half = self.length // 2
        offsets = np.arange(-half, half + 1) / half
        # Legendre polynomials on [−1, 1], not savgol_filter of scipy: that fits powers of sample numbers,
        # which at order 7 costs half the digits with 101 samples and silently returns zeros with 501.
        fit = np.linalg.pinv(legvander(offsets, self.order))
        evaluate = legvander(offsets, self.order - derivative) @ legder(np.eye(self.order + 1), derivative)
        evaluate = evaluate / (half * self.step) ** derivative
        smoothed: Array = correlate1d(values, evaluate[half] @ fit, axis=0, mode="constant")
        smoothed[:half] = evaluate[:half] @ (fit @ values[: self.length])
        smoothed[-half:] = evaluate[half + 1 :] @ (fit @ values[-self.length :])
        return smoothed


def _filter(trial: Trial, smoother: Smoother, step: float) -> _SavitzkyGolay:
    # The odd number nearest to window / step.
    length = 2 * math.floor(min(smoother.window / step / 2, LONGEST) + 1e-9) + 1
    # With order + 1 samples the polynomial passes through every one of them and smooths nothing.
    if length <= smoother.polynomial_order + 1:
        length = smoother.polynomial_order + 2
        length += 1 - length % 2
        warnings.warn(
            f"a smoother of {smoother.window:g} s is too short for order {smoother.polynomial_order} at "
            f"{1 / step:.4g} Hz, so its window is {length * step:.3g} s ({length} samples); raise "
            "preprocessing.smoother.window or lower polynomial_order",
            LogWarning,
            stacklevel=5,
        )
    if trial.n_samples < length:
        raise LogError(
            f"{_at(trial)}: expected at least {length} samples, one window of the smoother "
            f"({length * step:.3g} s), found {trial.n_samples}; shorten preprocessing.smoother.window, or "
            "leave the trial out"
        )
    return _SavitzkyGolay(length, smoother.polynomial_order, step)


def _smoothed(trial: Trial, smooth: _SavitzkyGolay) -> PreparedTrial:
    # Differentiate what was measured as few times as possible: each order amplifies noise.
    if trial.velocity is None:
        velocity, acceleration, jerk = (smooth(trial.position, order) for order in (1, 2, 3))
    else:
        velocity, acceleration, jerk = (smooth(trial.velocity, order) for order in (0, 1, 2))
    if trial.acceleration is not None:
        acceleration, jerk = smooth(trial.acceleration), smooth(trial.acceleration, 1)
    return _assembled(
        trial,
        (smooth(trial.position), velocity, acceleration, jerk),
        value=smooth,
        orders=lambda values: (smooth(values), smooth(values, 1), smooth(values, 2)),
        phase_orders=lambda phase, part: _smooth_phase(trial, phase, part, smooth),
    )


def _assembled(
    trial: Trial,
    motion: tuple[Array, Array, Array, Array],
    value: Callable[[Array], Array],
    orders: Callable[[Array], Orders],
    phase_orders: Callable[[Array, slice], Orders],
) -> PreparedTrial:
    """Prepared trial of position, velocity, acceleration and jerk, its other channels by the same rule.

    `value` gives a channel as the model sees it, `orders` it and two derivatives, `phase_orders` the same of phase
    within a repetition.
    """
    optional: dict[str, Any] = {}
    for name in ("force", "perturbation"):
        values = getattr(trial, name)
        optional[name] = None if values is None else value(values)
    if trial.reference is not None:
        optional |= _with_derivatives("reference", orders(trial.reference))
    if trial.phase is not None:
        parts = [phase_orders(trial.phase, part) for part in _repetitions(trial)]
        optional |= _with_derivatives(
            "phase", tuple(np.concatenate(order) for order in zip(*parts, strict=True))
        )
    position, velocity, acceleration, jerk = motion
    return PreparedTrial(
        name=trial.name,
        group=trial.group,
        source=trial.source,
        time=trial.time,
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        jerk=jerk,
        repetition=trial.repetition,
        truth=trial.truth,
        **optional,
    )


def _with_derivatives(name: str, orders: Sequence[Array]) -> dict[str, Array]:
    return dict(zip((name, f"{name}_velocity", f"{name}_acceleration"), orders, strict=True))


def _smooth_phase(trial: Trial, phase: Array, part: slice, smooth: _SavitzkyGolay) -> Orders:
    """Phase [1] and its two derivatives [1/s, 1/s²] within one repetition, since phase jumps between two."""
    time, values = trial.time[part], phase[part]
    _check_phase_length(len(time), float(time[0]), trial)
    if len(time) >= smooth.length:
        value, first, second = (smooth(values, order) for order in range(3))
    else:
        fit = Polynomial.fit(time, values, deg=min(smooth.order, len(time) - 1))
        value, first, second = fit(time), fit.deriv(1)(time), fit.deriv(2)(time)
    stuck = np.flatnonzero(np.diff(value) <= 0)
    if len(stuck):
        raise LogError(
            f"{_at(trial)}: expected smoothed phase to increase within repetition "
            f"{trial.repetition[part.start]}, found it resting or going back at {time[stuck[0] + 1]:g} s; "
            "cut pauses, or change preprocessing.smoother.window"
        )
    return value, first, second


# --- without smoother ----------------------------------------------------------------------------


def _as_logged(trial: Trial) -> PreparedTrial:
    """Values as they are; only what no log holds (jerk, derivatives of others) is differenced."""
    if trial.velocity is None or trial.acceleration is None:
        lacking = "velocity" if trial.velocity is None else "acceleration"
        raise LogError(
            f"{_at(trial)}: expected velocity and acceleration in a log that is not smoothed, found no "
            f"{lacking}; set preprocessing.smoother"
        )

    def phase_orders(phase: Array, part: slice) -> Orders:
        _check_phase_length(part.stop - part.start, float(trial.time[part.start]), trial)
        return _gradients(phase[part], trial.time[part])

    jerk = np.gradient(trial.acceleration, trial.time, axis=0)
    return _assembled(
        trial,
        (trial.position, trial.velocity, trial.acceleration, jerk),
        value=lambda values: values,
        orders=lambda values: _gradients(values, trial.time),
        phase_orders=phase_orders,
    )


def _gradients(values: Array, time: Array) -> Orders:
    first = np.gradient(values, time, axis=0)
    return values, first, np.gradient(first, time, axis=0)


# --- rate ----------------------------------------------------------------------------------------


def _thinned(trial: PreparedTrial, step: float, rate: float | None) -> PreparedTrial:
    """Every s-th sample, the first included, with s = the native over the wanted rate, rounded."""
    if rate is None:
        return trial
    if rate * step > 1 + UNEVEN:
        raise LogError(
            f"{_at(trial)}: expected preprocessing.rate of at most the native rate, {1 / step:.4g} Hz, found "
            f"{rate:g} Hz; lower it or leave it out"
        )
    # However low the rate, the first sample stays.
    every = max(1, round(1 / max(step * rate, 1 / trial.n_samples)))
    changes: dict[str, Any] = {
        name: value[::every] for name in _ARRAYS if (value := getattr(trial, name)) is not None
    }
    return replace(trial, **changes, truth={name: value[::every] for name, value in trial.truth.items()})
