"""Orientation of the tool and force in the base frame."""

import numpy as np
import pytest
from real_recordings import read_bag
from scipy.spatial.transform import Rotation

from bayes_impedance.errors import LogError
from bayes_impedance.recording.wrench import in_base_frame, rotation_jumps, rotations

ANGLES = np.random.default_rng(0).uniform(-1.5, 1.5, (20, 3))


def about(axis: str, angle: float) -> np.ndarray:
    """The matrix of an elementary rotation, written out."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array(
        {
            "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
            "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
            "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
        }[axis]
    )


@pytest.mark.parametrize("convention", ["ZYZ", "XYZ", "ZYX", "xyz", "zyx"])
@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_angles_are_products_of_elementary_rotations(convention, unit):
    given = ANGLES if unit == "rad" else np.rad2deg(ANGLES)
    for found, angles in zip(rotations(given, convention, unit).as_matrix(), ANGLES, strict=True):
        parts = [about(axis.lower(), angle) for axis, angle in zip(convention, angles, strict=True)]
        # Moving axes multiply from the right, fixed ones from the left.
        ordered = parts if convention.isupper() else parts[::-1]
        np.testing.assert_allclose(found, np.linalg.multi_dot(ordered), atol=1e-12)


def test_quaternions_of_both_orders():
    expected = Rotation.from_euler("ZYZ", ANGLES)
    xyzw = expected.as_quat()
    xyzw.setflags(write=False)
    for found in (
        rotations(xyzw, "quaternion_xyzw"),
        rotations(np.roll(xyzw, 1, axis=1), "quaternion_wxyz"),
        rotations(1.005 * xyzw, "quaternion_xyzw"),
    ):
        np.testing.assert_allclose(found.as_matrix(), expected.as_matrix(), atol=1e-12)


def test_force_is_turned_into_the_base():
    force = np.array([[1.0, 0.0, 0.0]])
    # As the arrays of a log are.
    force.setflags(write=False)
    found = in_base_frame(force, rotations(np.array([[np.pi / 2, 0.0, 0.0]]), "ZYX"))
    np.testing.assert_allclose(found, [[0.0, 1.0, 0.0]], atol=1e-12)


def test_the_norm_of_a_quaternion_is_checked():
    quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (5, 1))
    quaternions[3] *= 1.02
    with pytest.raises(
        LogError, match=r"expected quaternions of norm 1, found norm 1\.02 at row 3; check log"
    ):
        rotations(quaternions, "quaternion_xyzw")


def test_an_orientation_that_is_not_finite_is_refused():
    angles = ANGLES.copy()
    angles[[2, 4], 1] = np.nan
    with pytest.raises(LogError, match="orientation: expected finite numbers, found others at rows 2, 4"):
        rotations(angles, "ZYZ")


def test_columns_have_to_fit_the_convention():
    with pytest.raises(LogError, match=r"expected 4 columns for log\.force\.rotation quaternion_xyzw, found"):
        rotations(ANGLES, "quaternion_xyzw")


# --- jumps ---------------------------------------------------------------------------------------


def test_angles_that_wrap_and_quaternions_that_change_sign_do_not_jump():
    turn = np.linspace(0.0, 9.0, 300)
    wrapped = np.stack([(turn + np.pi) % (2 * np.pi) - np.pi, 0.2 * np.sin(turn), 0 * turn], axis=1)
    assert np.ptp(np.diff(wrapped[:, 0])) > 6
    assert rotation_jumps(rotations(wrapped, "ZYX")) is None
    quaternions = Rotation.from_euler("ZYX", wrapped).as_quat()
    quaternions[::7] *= -1
    assert rotation_jumps(rotations(quaternions, "quaternion_xyzw")) is None
    assert rotation_jumps(rotations(quaternions[:1], "quaternion_xyzw")) is None


def test_a_sample_that_is_turned_about_is_named():
    quaternions = Rotation.from_euler("z", np.linspace(0.0, 3.0, 100)[:, None]).as_quat()
    quaternions[40] = [0.0, 1.0, 0.0, 0.0]
    jumps = rotation_jumps(rotations(quaternions, "quaternion_xyzw"))
    assert (jumps.count, jumps.row) == (2, 40)
    assert "2 times, first at row 40" in jumps.sentence and "log.force.rotation" in jumps.sentence


def test_a_real_tool_does_not_jump_unless_its_angles_are_misread(shared_data):
    pytest.importorskip("rosbags")
    angles = read_bag(shared_data / "gp_mpc" / "rail" / "1.bag").angles
    # First and third angle jump by full turns.
    assert np.abs(np.diff(angles, axis=0)).max() > 3
    assert rotation_jumps(rotations(angles, "ZYZ")) is None
    assert rotation_jumps(rotations(angles, "zyx")) is not None
