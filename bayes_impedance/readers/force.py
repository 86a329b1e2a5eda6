"""From what a sensor read to the force of the human on the robot: frame, tool, lag."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from bayes_impedance.config import LogConfig, ToolConfig
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.log import AXES, Array
from bayes_impedance.readers.columns import is_turned
from bayes_impedance.readers.samples import Samples
from bayes_impedance.readers.times import OF_THE_SENSOR, within
from bayes_impedance.recording.lag import LagEstimate, estimate_lag, remove_lag
from bayes_impedance.recording.tool import SMALLEST_SHARE, Identification, Tool, identify_tool, without_tool
from bayes_impedance.recording.wrench import in_base_frame, rotation_jumps, rotations

#: Over which the acceleration of a tool is taken from its positions [s].
ACCELERATION_WINDOW = 0.1
#: A step longer than so many medians is a gap.
LONGEST_STEP = 5.0


@dataclass(frozen=True)
class Preparation:
    """What was found on the way: the tool where it was identified, the lag where it was estimated."""

    tool: Identification | None = None
    lag: LagEstimate | None = None


def prepare_force(
    samples: Samples, config: LogConfig, axes: Sequence[str], source: str
) -> tuple[Samples, Preparation]:
    """`samples` with the force of the human along `axes` of the base frame, at the time it acted.

    Warns (LogWarning) where a lag was removed or could not be told, the orientation jumps, or weight explains little of
    what was felt in the part without contact.

    Raises:
        LogError: the orientation is none, or the tool cannot be told.
    """
    if "force" not in samples.values:
        return samples, Preparation()
    lag, estimate = config.force.lag, None
    if lag == "estimate":
        estimate = _estimate(samples, config, axes, source)
        lag = _stated(estimate, source)
    # A tool is told by force as it was at the time of its orientation.
    samples = _without_lag(samples, lag, source) if lag else samples
    sensor = _Sensor(samples, config, axes, source)
    sensor.question(samples.time, source)
    prepared = {"force": sensor.human(), "position": _along(axes, samples.values["position"])}
    human = replace(samples, values=dict(samples.values) | prepared)
    inside = within(human.time, config.window)
    return human if inside.all() else human.at(inside), Preparation(sensor.identification, estimate)


# --- frame and tool ------------------------------------------------------------------------------


class _Sensor:
    """Readings `force` of a sensor `(n, 3)` [N], or `(n, a)` where they are the human's force in the base frame."""

    def __init__(self, samples: Samples, config: LogConfig, axes: Sequence[str], source: str) -> None:
        self.force = samples.values["force"]
        self.identification: Identification | None = None
        self._turned = is_turned(config)
        if not self._turned:
            return
        self._axes = [AXES.index(axis) for axis in axes]
        self._in_tool = config.force.frame == "tool"
        try:
            self._rotation = rotations(samples.values["orientation"], config.force.rotation)
        except LogError as error:
            raise LogError(f"{source}: {error}") from error
        self._tool: Tool | None = None
        self._gravity = np.zeros(3)
        self._acceleration: Array | None = None
        if config.force.tool is not None:
            self._find_tool(samples, config.force.tool, source)

    def _find_tool(self, samples: Samples, tool: ToolConfig, source: str) -> None:
        self._gravity = np.array(tool.gravity)
        if tool.inertia:
            self._acceleration = _acceleration(samples.time, samples.values["position"])
        if tool.identify is None:
            assert tool.mass is not None
            center = None if tool.center_of_mass is None else np.array(tool.center_of_mass)
            self._tool = Tool(tool.mass, center, np.array(tool.bias), np.array(tool.torque_bias))
            return
        assert tool.identify.start is not None
        assert tool.identify.end is not None
        part = np.flatnonzero((samples.time >= tool.identify.start) & (samples.time < tool.identify.end))
        rotation = self._rotation[part]
        torque = samples.values.get("torque")
        try:
            self.identification = identify_tool(
                self._in_sensor(self.force[part], rotation),
                None if torque is None else self._in_sensor(torque[part], rotation),
                rotation,
                None if self._acceleration is None else self._acceleration[part],
                self._gravity,
            )
        except LogError as error:
            raise LogError(f"{source}: {error}") from error
        self._tool = self.identification.tool

    def question(self, time: Array, source: str) -> None:
        """Warn (LogWarning) of an orientation that jumps, and of a tool whose weight is not what the sensor felt."""
        if not self._turned:
            return
        starts = np.array([part.start for part in _stretches(time)], dtype=np.int64)
        jumps = rotation_jumps(self._rotation, starts)
        if jumps is not None:
            warnings.warn(f"{source}: {jumps.sentence}", LogWarning, stacklevel=4)
        if self.identification is not None and self.identification.explained < SMALLEST_SHARE:
            warnings.warn(f"{source}: {self.identification.sentence}", LogWarning, stacklevel=4)

    def human(self) -> Array:
        """Force of the human on the robot in the base frame, `(n, a)` [N]."""
        if not self._turned:
            return self.force
        force = self._in_sensor(self.force, self._rotation)
        if self._tool is not None:
            force = without_tool(force, self._rotation, self._tool, self._acceleration, self._gravity)
        return in_base_frame(force, self._rotation)[:, self._axes]

    def _in_sensor(self, vectors: Array, rotation: Rotation) -> Array:
        """In the frame of the sensor, for there its bias is constant and its tool at rest."""
        return vectors if self._in_tool else in_base_frame(vectors, rotation.inv())


def _along(axes: Sequence[str], vectors: Array) -> Array:
    """The components along `axes` of vectors that hold these or all."""
    return vectors if vectors.shape[1] == len(axes) else vectors[:, [AXES.index(axis) for axis in axes]]


def _acceleration(time: Array, position: Array) -> Array:
    """Of positions `(n, 3)` [m], smoothed; `(n, 3)` [m/s²], zero in trials too short for that."""
    acceleration = np.zeros_like(position)
    for part in _stretches(time):
        step = float(np.median(np.diff(time[part]))) if part.stop - part.start > 1 else np.inf
        length = 2 * max(2, round(ACCELERATION_WINDOW / step / 2)) + 1
        if part.stop - part.start >= length:
            acceleration[part] = savgol_filter(position[part], length, 3, deriv=2, delta=step, axis=0)
    return acceleration


# --- lag -----------------------------------------------------------------------------------------


def _estimate(samples: Samples, config: LogConfig, axes: Sequence[str], source: str) -> LagEstimate:
    """From the part that is kept, for without contact no law holds."""
    inside = within(samples.time, config.window)
    position = _along(axes, samples.values["position"])
    force = _Sensor(samples, config, axes, source).human()
    added = samples.values.get("perturbation")
    return estimate_lag(
        samples.time[inside],
        position[inside],
        force[inside],
        perturbation=None if added is None else added[inside],
    )


def _stated(estimate: LagEstimate, source: str) -> float:
    """The lag to be removed [s], and a word on it."""
    if estimate.determined:
        said = (
            f"force is logged {1e3 * estimate.lag:.1f} ± {1e3 * estimate.standard_error:.1f} ms after the motion it "
            "belongs to, which is removed; to keep this value, set log.force.lag"
        )
    else:
        said = (
            f"the lag between force and motion cannot be told ({estimate.reason}) and is taken for zero; measure it "
            "and set log.force.lag [s]"
        )
    warnings.warn(f"{source}: {said}", LogWarning, stacklevel=4)
    return estimate.lag if estimate.determined else 0.0


def _without_lag(samples: Samples, lag: float, source: str) -> Samples:
    """What the sensor read moved by `lag` [s], and the samples that have it.

    Raises:
        LogError: none have.
    """
    time = samples.time
    moved = {key: samples.values[key].copy() for key in OF_THE_SENSOR if key in samples.values}
    kept = [np.zeros(0, dtype=np.int64)]
    for part in _stretches(time):
        if part.stop - part.start < 2:
            continue
        for key, values in moved.items():
            shifted, remain = remove_lag(time[part], samples.values[key][part], lag)
            rows = part.start + np.flatnonzero(remain)
            values[rows] = shifted
        kept.append(rows)
    which = np.concatenate(kept)
    if not len(which):
        raise LogError(
            f"{source}: expected a log longer than the lag of its force, found a lag of {lag:g} s; change "
            "log.force.lag"
        )
    return replace(samples, values=dict(samples.values) | moved).at(which)


def _stretches(time: Array) -> Iterator[slice]:
    """Samples between two gaps, or between two starts of trials."""
    steps = np.diff(time)
    typical = float(np.median(steps)) if len(steps) else np.inf
    edges = np.flatnonzero((steps <= 0) | (steps > LONGEST_STEP * typical)) + 1
    for start, end in zip([0, *edges], [*edges, len(time)], strict=True):
        yield slice(int(start), int(end))
