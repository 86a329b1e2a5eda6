"""Tool, frame and orientation on the way from a sensor in the robot's wrist to the force of the human."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from recorded import (
    TOOL,
    Array,
    bag,
    columns,
    handled,
    identify,
    only,
    poses,
    read,
    rms,
    wrenches,
)
from scipy.spatial.transform import Rotation

from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.readers.trials import Reading

#: Of the sensor [N].
NOISE = 0.1
GIVEN = {key: np.asarray(value).tolist() for key, value in TOOL.items()}
#: Columns of an orientation in the three ways that files have it: convention, names, unit.
WAYS: Mapping[str, tuple[str, tuple[str, ...], str]] = {
    "xyzw": ("quaternion_xyzw", ("qx", "qy", "qz", "qw"), "rad"),
    "wxyz": ("quaternion_wxyz", ("qw", "qx", "qy", "qz"), "rad"),
    "ZYZ": ("ZYZ", ("alpha", "beta", "gamma"), "deg"),
    "xyz": ("xyz", ("roll", "pitch", "yaw"), "rad"),
}


def table(made: Mapping[str, Any], way: str = "xyzw", frame: str = "tool") -> pd.DataFrame:
    """Columns of what the sensor read, in its own frame or turned into that of the base."""
    rotation: Rotation = made["rotation"]
    named = columns(**{key: made[key] for key in ("time", "position", "force", "torque")})
    if frame == "base":
        named |= columns(force=rotation.apply(made["force"]), torque=rotation.apply(made["torque"]))
    convention, names, unit = WAYS[way]
    if convention.startswith("quaternion"):
        parts = rotation.as_quat(scalar_first=convention.endswith("wxyz"))
    else:
        parts = rotation.as_euler(convention, degrees=unit == "deg")
    return pd.DataFrame(named | dict(zip(names, parts.T, strict=True)))


def written(path: Path, frame: pd.DataFrame) -> Path:
    frame.to_csv(path, index=False)
    return path


def turned(way: str = "xyzw", **force: Any) -> dict[str, Any]:
    """The configuration of a `table`."""
    convention, names, unit = WAYS[way]
    return {
        "columns": {"orientation": names},
        "units": {"angle": unit},
        "force": {"rotation": convention} | force,
    }


def error_of(reading: Reading, made: Mapping[str, Any]) -> Array:
    """What the force that was read is off by [N], during work."""
    trial = only(reading)
    index = np.searchsorted(made["time"], trial.time - 1e-6)
    return np.asarray((trial.force - made["human"][index])[trial.time >= 20.0])


def assert_found(reading: Reading) -> None:
    """Everything within 10 %."""
    found = reading.preparation.tool
    assert found is not None and found.tool.center_of_mass is not None
    assert found.tool.mass == pytest.approx(TOOL["mass"], rel=0.1)
    np.testing.assert_allclose(found.tool.center_of_mass, TOOL["center_of_mass"], rtol=0.1)
    np.testing.assert_allclose(found.tool.bias, TOOL["bias"], rtol=0.1)
    np.testing.assert_allclose(found.tool.torque_bias, TOOL["torque_bias"], rtol=0.1)


# --- the tool ------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", WAYS)
def test_tool_is_found_and_taken_off(tmp_path: Path, way: str) -> None:
    made = handled(brisk=0.01)
    file = written(tmp_path / "log.csv", table(made, way))
    log = turned(way, **identify())
    log["force"]["tool"]["inertia"] = True
    reading = read(file, **log)
    assert_found(reading)
    assert rms(error_of(reading, made)) < 1.5 * NOISE
    # Not taken off: the weight, the bias, and what shakes.
    plain = read(file, **turned(way, frame="tool"))
    assert plain.preparation.tool is None
    assert rms(error_of(plain, made)) > 5.0


def test_tool_is_found_in_a_bag(tmp_path: Path) -> None:
    made = handled()
    time = made["time"]
    file = bag(
        tmp_path / "log.mcap",
        poses(time, time, made["position"], made["rotation"]),
        wrenches(time, time, made["force"], made["torque"]),
    )
    reading = read(file, force=identify())
    assert_found(reading)
    # Its acceleration of up to .1 m/s² stays in.
    assert rms(error_of(reading, made)) < 2 * NOISE


def test_pose_at_a_lower_rate_turns_the_force_of_a_faster_sensor(tmp_path: Path) -> None:
    made = handled(rate=500.0)
    time, every = made["time"], slice(None, None, 5)
    file = bag(
        tmp_path / "log.bag",
        poses(time[every], time[every], made["position"][every], made["rotation"][every]),
        wrenches(time, time, made["force"], made["torque"]),
    )
    log = identify()
    log["tool"]["inertia"] = True
    reading = read(file, force=log, axes=["x", "y"])
    assert_found(reading)
    trial = only(reading)
    assert trial.force.shape[1] == 2
    truth = made["human"][np.searchsorted(time, trial.time - 1e-6)]
    # Force is averaged over one interval of the pose, in the frame of the sensor, and so is its noise.
    assert rms((trial.force - truth[:, :2])[10:-10]) < 0.7 * NOISE


def test_orientation_of_another_topic_turns_the_force(tmp_path: Path) -> None:
    made = handled()
    time, every = made["time"], slice(None, None, 4)
    still = np.zeros_like(made["position"])
    file = bag(
        tmp_path / "log.bag",
        poses(time, time, made["position"]),
        poses(time[every], time[every], still[every], made["rotation"][every], topic="/imu"),
        wrenches(time, time, made["force"], made["torque"]),
    )
    names = {
        "position": "/pose.pose.position.{axis}",
        "orientation": [f"/imu.pose.orientation.{part}" for part in "xyzw"],
    }
    reading = read(file, columns=names, force=identify())
    assert_found(reading)
    assert rms(error_of(reading, made)) < 2 * NOISE


@pytest.mark.parametrize("frame", ["tool", "base"])
def test_tool_that_is_given_is_taken_off(tmp_path: Path, frame: str) -> None:
    # A sensor's bias is constant in its own frame, whatever frame force is logged in.
    made = handled(brisk=0.01)
    file = written(tmp_path / "log.csv", table(made, frame=frame))
    reading = read(file, **turned(frame=frame, tool=GIVEN | {"inertia": True}))
    assert reading.preparation.tool is None
    assert rms(error_of(reading, made)) < 1.5 * NOISE


def test_tool_is_found_from_force_in_the_base_frame(tmp_path: Path) -> None:
    made = handled(brisk=0.01)
    file = written(tmp_path / "log.csv", table(made, frame="base"))
    log = turned(**identify(frame="base"))
    log["force"]["tool"]["inertia"] = True
    reading = read(file, **log)
    assert_found(reading)
    assert rms(error_of(reading, made)) < 1.5 * NOISE


def test_acceleration_of_the_tool_matters_in_brisk_motion(tmp_path: Path) -> None:
    made = handled(brisk=0.02)
    file = written(tmp_path / "log.csv", table(made))
    without = error_of(read(file, **turned(frame="tool", tool=GIVEN)), made)
    with_ = error_of(read(file, **turned(frame="tool", tool=GIVEN | {"inertia": True})), made)
    # 1.8 kg at .02 m and 2 Hz: 4 N (RMS).
    assert rms(without) == pytest.approx(1.8 * 0.02 * (4 * np.pi) ** 2 / np.sqrt(2), rel=0.1)
    # The smoother of its acceleration takes 3 % off at 2 Hz.
    assert rms(with_) < np.hypot(NOISE, 0.04 * rms(without))


def test_part_without_contact_may_lie_outside_the_window(tmp_path: Path) -> None:
    made = handled()
    file = written(tmp_path / "log.csv", table(made))
    reading = read(file, **turned(**identify()), window={"start": 20})
    assert_found(reading)
    assert only(reading).time[0] == 20.0
    assert rms(error_of(reading, made)) < 2 * NOISE


def test_lag_is_taken_off_before_the_tool_is_found(tmp_path: Path) -> None:
    made = handled(rate=1000.0)
    late = 12
    shifted = pd.DataFrame(table(made))
    for name in (f"{key}_{axis}" for key in ("force", "torque") for axis in "xyz"):
        shifted[name] = np.concatenate([np.repeat(shifted[name][:1], late), shifted[name][:-late]])
    file = written(tmp_path / "log.csv", shifted.iloc[late:])
    log = turned(**identify(lag=0.012))
    log["force"]["tool"]["inertia"] = True
    reading = read(file, **log)
    found = reading.preparation.tool
    # Else .05 N of weight would be left, for the tool turns while force is on its way.
    assert found is not None and found.force_rms == pytest.approx(NOISE, rel=0.03)
    assert_found(reading)
    assert rms(error_of(reading, made)) < 1.5 * NOISE


def test_contact_where_none_was_said_to_be_is_questioned(tmp_path: Path) -> None:
    made = handled(rate=50.0)
    frame = table(made)
    pushed = 40.0 * np.sin(np.array([2.0, 2.7, 1.4]) * made["time"][:, None])
    frame[["force_x", "force_y", "force_z"]] += pushed
    with pytest.warns(
        LogWarning, match="log.csv: tool of .* kg.*; weight explains only .* and that nothing touches it"
    ):
        read(written(tmp_path / "log.csv", frame), **turned(**identify()))


# --- sign ----------------------------------------------------------------------------------------


def test_reversed_sign_is_named(tmp_path: Path) -> None:
    file = written(tmp_path / "log.csv", table(handled(sign=-1.0)))
    with pytest.raises(
        LogError,
        match=r"^log.csv: expected a tool of positive mass, found -1.8.* kg: the force is probably of rever",
    ):
        read(file, **turned(**identify()))


def test_sign_of_the_robot_is_mended_by_the_configuration(tmp_path: Path) -> None:
    made = handled(sign=-1.0)
    file = written(tmp_path / "log.csv", table(made))
    reading = read(file, **turned(**identify()), force_direction="robot_on_human")
    assert_found(reading)
    assert rms(error_of(reading, made)) < 2 * NOISE


# --- what cannot be told -------------------------------------------------------------------------


def test_a_part_that_is_too_short_is_refused_with_the_name_of_the_file(tmp_path: Path) -> None:
    file = written(tmp_path / "log.csv", table(handled()))
    with pytest.raises(
        LogError, match="log.csv: expected at least ten samples without contact, found 0; widen"
    ):
        read(file, **turned(frame="tool", tool={"identify": {"start": 50, "end": 60}}))


@pytest.mark.parametrize("own_topic", [False, True])
def test_columns_that_do_not_fit_the_convention_are_refused(tmp_path: Path, own_topic: bool) -> None:
    made = handled()
    if own_topic:
        time = made["time"]
        file = bag(
            tmp_path / "log.bag",
            poses(time, time, made["position"]),
            poses(time, time, made["position"], topic="/imu"),
            wrenches(time, time, made["force"]),
        )
        names = {
            "position": "/pose.pose.position.{axis}",
            "orientation": [f"/imu.pose.position.{part}" for part in "xyz"],
        }
    else:
        file = written(tmp_path / "log.csv", table(made, "ZYZ"))
        names = {"orientation": list(WAYS["ZYZ"][1])}
    with pytest.raises(
        LogError, match="log.*: orientation: expected 4 columns for log.force.rotation quaternion_xyzw"
    ):
        read(file, columns=names, force={"frame": "tool"})


@pytest.mark.parametrize("own_topic", [False, True])
def test_what_is_no_quaternion_is_refused(tmp_path: Path, own_topic: bool) -> None:
    made = handled(rate=50.0)
    if own_topic:
        time = made["time"]
        file = bag(
            tmp_path / "log.bag",
            poses(time, time, made["position"]),
            wrenches(time, time, made["position"], topic="/imu"),
            wrenches(time, time, made["force"]),
        )
        names = {
            "force": "/ft.wrench.force.{axis}",
            "orientation": [f"/imu.wrench.force.{part}" for part in "xyzx"],
        }
    else:
        file = written(tmp_path / "log.csv", table(made))
        names = {"orientation": ["position_x", "position_y", "position_z", "qw"]}
    with pytest.raises(LogError, match="log.*: orientation: expected quaternions of norm 1, found norm"):
        read(file, columns=names, force={"frame": "tool"})


def test_force_that_lacks_an_axis_cannot_be_turned(tmp_path: Path) -> None:
    frame = table(handled()).drop(columns="force_z")
    with pytest.raises(LogError, match="expected column 'force_z', found none of that name"):
        read(written(tmp_path / "log.csv", frame), axes=["x", "y"], **turned(frame="tool"))


def test_a_turned_force_without_orientation_is_refused(tmp_path: Path) -> None:
    frame = table(handled()).drop(columns="qw")
    with pytest.raises(LogError, match="expected column 'qw', found none of that name"):
        read(written(tmp_path / "log.csv", frame), **turned(frame="tool"))


@pytest.mark.parametrize("force", [{"frame": "tool"}, {"tool": {"mass": 1.0}}])
def test_a_turned_force_needs_an_orientation_that_is_named(tmp_path: Path, force: dict[str, Any]) -> None:
    with pytest.raises(
        ValueError, match="columns.orientation: expected the columns that tell how the tool turns"
    ):
        read(tmp_path / "log.csv", columns={"orientation": None}, force=force)


def test_orientation_that_jumps_is_questioned_once_for_a_file(tmp_path: Path) -> None:
    frame = table(handled(rate=50.0))
    frame.loc[100:, ["qx", "qy"]] *= -1
    with pytest.warns(
        LogWarning, match="log.csv: orientation jumps by more than 0.5 rad .* once, first at row 100"
    ):
        read(written(tmp_path / "log.csv", frame), **turned(frame="tool"))


def test_orientation_that_begins_anew_in_a_trial_is_not(tmp_path: Path) -> None:
    frame = table(handled(rate=50.0))
    turned_over = frame.assign(trial="b")
    turned_over[["qx", "qy", "qz", "qw"]] = frame[["qw", "qz", "qy", "qx"]].to_numpy() * [1, 1, -1, -1]
    file = written(tmp_path / "log.csv", pd.concat([frame.assign(trial="a"), turned_over]))
    assert len(read(file, **turned(frame="tool")).trials) == 2


# --- what is not needed --------------------------------------------------------------------------


def test_orientation_that_nothing_needs_is_not_read(tmp_path: Path) -> None:
    made = handled(rate=50.0)
    frame = table(made)
    frame["qw"] = "none of your business"
    reading = read(written(tmp_path / "log.csv", frame), **turned(frame="base"))
    assert "orientation" not in reading.sensed.values and "torque" not in reading.sensed.values
    np.testing.assert_array_equal(only(reading).force, made["force"])


@pytest.mark.parametrize("lacking", [[], ["qx", "qy", "qz", "qw"]])
@pytest.mark.parametrize("inertia", [False, True])
def test_a_log_without_force_is_read_as_it_is(tmp_path: Path, inertia: bool, lacking: list[str]) -> None:
    made = handled(rate=50.0)
    frame = table(made).drop(columns=["force_x", "force_y", "force_z", *lacking])
    log = turned(frame="tool", tool=GIVEN | {"inertia": inertia}, lag=0.012)
    trial = only(read(written(tmp_path / "log.csv", frame), require_force=False, axes=["x", "y"], **log))
    assert trial.force is None
    np.testing.assert_array_equal(trial.position, made["position"][:, :2])


@pytest.mark.parametrize("inertia", [False, True])
def test_two_axes_of_a_force_that_was_turned(tmp_path: Path, inertia: bool) -> None:
    made = handled(brisk=0.01 if inertia else 0.0)
    log = turned(frame="tool", tool=GIVEN | {"inertia": inertia})
    file = written(tmp_path / "log.csv", table(made))
    whole, two = only(read(file, **log)), only(read(file, axes=["x", "y"], **log))
    np.testing.assert_array_equal(two.force, whole.force[:, :2])
    np.testing.assert_array_equal(two.position, whole.position[:, :2])
    other = only(read(file, axes=["z", "x"], **log))
    np.testing.assert_array_equal(other.force, whole.force[:, [2, 0]])
    np.testing.assert_array_equal(other.position, whole.position[:, [2, 0]])
