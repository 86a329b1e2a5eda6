"""One instant of a stream."""

from __future__ import annotations

from typing import NamedTuple

from numpy.typing import ArrayLike


class Sample(NamedTuple):
    """What is known at one instant: `time` [s]; the rest by axis, in the order of the model's axes.

    `position` [m], `velocity` [m/s], `force` of the human on the robot [N], which a prediction does without; and what
    the configuration asks for: `acceleration` [m/s²], `jerk` [m/s³], `phase` with `phase_velocity` [1/s] and
    `phase_acceleration` [1/s²], `reference` [m] with `reference_velocity` and `reference_acceleration`.
    """

    time: float
    position: ArrayLike
    velocity: ArrayLike
    force: ArrayLike | None = None
    acceleration: ArrayLike | None = None
    jerk: ArrayLike | None = None
    phase: float | None = None
    phase_velocity: float | None = None
    phase_acceleration: float | None = None
    reference: ArrayLike | None = None
    reference_velocity: ArrayLike | None = None
    reference_acceleration: ArrayLike | None = None
