"""From one sample to the inputs of the kernels: what `features` does for logs, in microseconds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.errors import ConfigurationError, LogError
from bayes_impedance.features import FeatureMap
from bayes_impedance.online.sample import Sample
from bayes_impedance.trajectory_mean import Instant, TrajectoryMean

Floats = NDArray[np.float64]

#: A component with its first two time derivatives, as fields of a sample.
DERIVATIVES = {
    "position": ("position", "velocity", "acceleration"),
    "velocity": ("velocity", "acceleration", "jerk"),
    "phase": ("phase", "phase_velocity", "phase_acceleration"),
}
#: What no measurement reaches. One infinite covariance would never leave the sums of a cell again.
LARGEST = 1e30
BY_AXIS = ("position", "velocity", "acceleration", "jerk")
#: What the mean of the desired trajectory is made of.
REFERENCE = ("reference", "reference_velocity", "reference_acceleration")


def fill(place: Floats, value: object) -> bool:
    """Put numbers into `place`; False where they are none, or not as many: one number is not spread over axes."""
    try:
        found = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return False
    if found.size != place.size or found.ndim > 1:
        return False
    place[:] = found
    return True


def is_usable(values: Floats) -> bool:
    """Whether these are finite, and their fourth powers, too, of which covariances are made."""
    # Their norm bounds each of them, and takes a third of the time.
    return bool(np.vdot(values, values) < LARGEST**2 or np.abs(values).max(initial=0.0) < LARGEST)


class SampleInputs:
    """The map from samples of a group to inputs `(axes, D)` and prior means of x_d, ẋ_d, ẍ_d `(axes, 3)`.

    Raises:
        ConfigurationError: the model depends on time, or has something for each trial, of which a stream has none.
    """

    def __init__(self, feature_map: FeatureMap, mean: TrajectoryMean, group: str) -> None:
        _check(feature_map)
        self._map, self._mean, self._group = feature_map, mean, group
        axes = len(feature_map.axes)
        starts = {name: i * axes for i, name in enumerate(BY_AXIS)}
        scalars = DERIVATIVES["phase"]
        starts |= {name: len(BY_AXIS) * axes + i for i, name in enumerate(scalars)}
        self._size = len(BY_AXIS) * axes + len(scalars) + 1
        zero = self._size - 1
        self._starts = {
            name: slice(start, start + (axes if name in BY_AXIS else 1)) for name, start in starts.items()
        }
        # Every column but errors is one of a sample's numbers, the same for each axis.
        self._index = np.full(feature_map.width, zero)
        needed = {"position", "velocity"}
        layout = feature_map.layout
        order = (layout.theta, layout.theta_velocity, layout.theta_acceleration)
        last = feature_map.theta[-1]
        at = 0
        for component in feature_map.theta:
            count = len(feature_map.columns_of(component))
            for columns, name in zip(order, DERIVATIVES[component], strict=True):
                dropped = feature_map.model.drop_acceleration and component == last and columns is order[1]
                if columns and not dropped:
                    self._index[list(columns[at : at + count])] = starts[name] + np.arange(count)
                    needed.add(name)
            at += count
        for component in feature_map.xi:
            columns = feature_map.active_dims((component,))
            self._index[list(columns)] = starts[component] + np.arange(len(columns))
            needed.add(component)
        self._errors = list(layout.error)
        if self._errors:
            needed.add("acceleration")
        kind = feature_map.model.desired_trajectory.mean
        needed |= set(DERIVATIVES["phase"]) if kind == "trial_average" else set()
        self._filled = tuple(name for name in Sample._fields if name in needed)
        self._references = REFERENCE if kind == "reference" else ()
        #: Fields that a sample must have.
        self.needed = (*self._filled, *self._references)
        self._follows_hand = kind == "equilibrium"

    def __call__(self, sample: Sample) -> tuple[Floats, Floats]:
        """Inputs and prior means.

        Raises:
            LogError: a field lacks, is of another shape, or is not finite.
        """
        values = np.zeros(self._size)
        for name in self._filled:
            self._fill(values[self._starts[name]], sample, name)
        if not is_usable(values):
            self._refuse(sample, values)
        axes = len(self._map.axes)
        inputs = np.empty((axes, self._index.size))
        inputs[:] = values[self._index]
        hand = values[: 3 * axes].reshape(3, axes).T
        if self._follows_hand:
            return inputs, hand
        desired = self._desired(sample, values, hand)
        if self._errors:
            inputs[:, self._errors] = desired - hand
        return inputs, desired

    def _fill(self, place: Floats, sample: Sample, name: str) -> None:
        value = getattr(sample, name)
        if value is None:
            raise LogError(
                f"sample at {sample.time} s: expected {name}, which this configuration asks for, found none; give it"
            )
        if not fill(place, value):
            whole = (
                f"{place.size} numbers ({', '.join(self._map.axes)})"
                if name not in DERIVATIVES["phase"]
                else "one"
            )
            raise LogError(
                f"sample at {sample.time} s: expected {name} of {whole}, got {value!r}; give one for each"
            )

    def _refuse(self, sample: Sample, values: Floats) -> None:
        for name in self._filled:
            if not is_usable(values[self._starts[name]]):
                raise LogError(
                    f"sample at {sample.time} s: expected finite numbers below {LARGEST:g}, found {name} "
                    f"{values[self._starts[name]].tolist()}; leave the sample out"
                )

    def _desired(self, sample: Sample, values: Floats, hand: Floats) -> Floats:
        own: dict[str, Any] = {}
        for name in REFERENCE:
            own[name] = np.empty((1, len(self._map.axes))) if name in self._references else None
            if own[name] is not None:
                self._fill(own[name][0], sample, name)
        for name in DERIVATIVES["phase"]:
            own[name] = values[self._starts[name]] if name in self._filled else None
        motion = dict(zip(("position", "velocity", "acceleration"), hand.T[:, None], strict=True))
        instant = Instant(name="stream", group=self._group, source="sample", **motion, **own)
        desired = self._mean.derivatives(instant)[:, 0].T
        if not is_usable(desired):
            raise LogError(
                f"sample at {sample.time} s: expected a finite reference below {LARGEST:g}, found "
                f"{desired.tolist()}; leave the sample out"
            )
        return desired


def _check(feature_map: FeatureMap) -> None:
    if "time" in (*feature_map.theta, *feature_map.xi):
        raise ConfigurationError(
            "model.trajectory_input: expected functions of phase, position or velocity to predict online, got one of "
            "time, to which a stream never returns; set model.trajectory_input=position, and the inputs of stiffness, "
            "damping and residual likewise"
        )
    for key, shared in (
        ("desired_trajectory", feature_map.trajectory_shared),
        ("residual", feature_map.residual_shared or feature_map.model.residual is None),
    ):
        if not shared:
            raise ConfigurationError(
                f"shared.{key}: expected true to predict online, where there are no trials, got false; train with "
                f"shared.{key}=true"
            )
    if feature_map.device is not None:
        raise ConfigurationError(
            "device: expected none to predict online, for what the robot's answer tells of the mass is not learned "
            "sample by sample, got one; train with device=null"
        )
