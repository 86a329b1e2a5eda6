"""Orientation of the tool, and force from its frame into that of the base."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from bayes_impedance.errors import LogError
from bayes_impedance.log import Array, Integers, named_rows

#: The norm of a quaternion may be off by as much, for few digits in a file.
NORM_TOLERANCE = 0.01
#: A hand does not turn so far [rad] between two samples.
LARGEST_TURN = 0.5


def rotations(orientation: Array, convention: str, unit: Literal["rad", "deg"] = "rad") -> Rotation:
    """Rotations from the tool's into the base frame, one for each row of `orientation`.

    `convention` as in `log.force.rotation`: `quaternion_xyzw` or `quaternion_wxyz` for `(n, 4)` [1], or the axes of
    Euler angles for `(n, 3)` [`unit`], upper case about the moving axes.

    Raises:
        LogError: a number is not finite, the columns do not fit the convention, or a quaternion is far from norm 1.
    """
    quaternions = convention.startswith("quaternion_")
    expected = 4 if quaternions else 3
    if orientation.ndim != 2 or orientation.shape[1] != expected:
        raise LogError(
            f"orientation: expected {expected} columns for log.force.rotation {convention}, found an array of shape "
            f"{orientation.shape}; name as many in log.columns.orientation, or mend log.force.rotation"
        )
    bad = np.flatnonzero(~np.isfinite(orientation).all(axis=1))
    if len(bad):
        raise LogError(
            f"orientation: expected finite numbers, found others at {named_rows(bad)}; leave these samples out with "
            "log.window, or set log.columns.orientation to null"
        )
    # A copy, for scipy does not take arrays that are read-only.
    orientation = np.array(orientation, dtype=np.float64)
    if not quaternions:
        return Rotation.from_euler(convention, orientation, degrees=unit == "deg")
    norm = np.linalg.norm(orientation, axis=1)
    bad = np.flatnonzero(np.abs(norm - 1.0) > NORM_TOLERANCE)
    if len(bad):
        raise LogError(
            f"orientation: expected quaternions of norm 1, found norm {norm[bad[0]]:.3g} at {named_rows(bad)}; check "
            "log.columns.orientation and log.force.rotation"
        )
    return Rotation.from_quat(orientation, scalar_first=convention == "quaternion_wxyz")


def in_base_frame(force: Array, rotation: Rotation) -> Array:
    """`force (n, 3)` [N] in the tool's frame turned into the base frame."""
    return np.asarray(rotation.apply(np.array(force)), dtype=np.float64)


@dataclass(frozen=True)
class Jumps:
    """Samples between which the tool seems to turn further than it can: how many, the first, and the largest [rad]."""

    count: int
    row: int
    largest: float

    @property
    def sentence(self) -> str:
        """What it is and how to mend it."""
        times = "once" if self.count == 1 else f"{self.count} times"
        return (
            f"orientation jumps by more than {LARGEST_TURN:g} rad between neighbouring samples {times}, first at row "
            f"{self.row} and by up to {self.largest:.2f} rad; check the order and unit of the angles in "
            "log.force.rotation, log.columns.orientation and log.units.angle, or gaps of the recording"
        )


def rotation_jumps(rotation: Rotation, starts: Integers | None = None) -> Jumps | None:
    """Jumps of the rotation itself: angles that wrap and quaternions that change sign are none.

    The samples `starts` begin a trial, so that they follow upon nothing.
    """
    if len(rotation) < 2:
        return None
    turn = np.asarray((rotation[:-1].inv() * rotation[1:]).magnitude())
    if starts is not None:
        turn[starts[starts > 0] - 1] = 0.0
    jumps = np.flatnonzero(turn > LARGEST_TURN)
    if not len(jumps):
        return None
    return Jumps(len(jumps), int(jumps[0]) + 1, float(turn.max()))
