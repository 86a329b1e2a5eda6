"""Topics of a bag found by the type of their messages, named by the configuration, or told to be missing."""

import warnings

import pytest
from message_files import ENDINGS, header, joint_state, odometry, pose, vector, wrench, write_bag

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.readers import read_log
from bayes_impedance.readers.columns import of_axis
from bayes_impedance.readers.read import open_file

START = 1_700_000_000_000_000_000


def opened(tmp_path, *messages, ending=".bag", **log):
    file = write_bag(tmp_path / f"log{ending}", messages)
    return open_file(file, file.name, LogConfig.model_validate(log))


def twist(topic):
    return topic, "geometry_msgs/msg/TwistStamped", START, {"header": header(START)}


def acceleration(topic):
    return topic, "geometry_msgs/msg/AccelStamped", START, {"header": header(START)}


def transform(topic):
    content = {"header": header(START), "transform": {"translation": vector((1, 2, 3))}}
    return topic, "geometry_msgs/msg/TransformStamped", START, content


POSE, WRENCH = pose("/pose", START, (1, 2, 3)), wrench("/ft", START, (4, 5, 6))


# --- by type -------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize(
    ("message", "position", "orientation"),
    [
        (POSE, "/pose.pose.position.{axis}", "/pose.pose.orientation."),
        (transform("/tip"), "/tip.transform.translation.{axis}", "/tip.transform.rotation."),
        (
            odometry("/o", START, (1, 2, 3), (0, 0, 0), ""),
            "/o.pose.pose.position.{axis}",
            "/o.pose.pose.orientation.",
        ),
        (("/p", "geometry_msgs/msg/Pose", START, {}), "/p.position.{axis}", "/p.orientation."),
        (("/t", "geometry_msgs/msg/Transform", START, {}), "/t.translation.{axis}", "/t.rotation."),
        (
            ("/c", "geometry_msgs/msg/PoseWithCovarianceStamped", START, {}),
            "/c.pose.pose.position.{axis}",
            "/c.pose.pose.orientation.",
        ),
    ],
)
def test_pose_and_wrench_are_found_by_type(tmp_path, ending, message, position, orientation):
    found = opened(tmp_path, message, WRENCH, joint_state("/joints", START, (1, 2)), ending=ending)
    columns = found.config.columns
    assert columns.position == position
    assert columns.orientation == tuple(orientation + part for part in "xyzw")
    assert (columns.force, columns.torque) == ("/ft.wrench.force.{axis}", "/ft.wrench.torque.{axis}")
    names = [
        of_axis(template, axis) for template in (position, columns.force, columns.torque) for axis in "xyz"
    ]
    assert {*names, *columns.orientation} <= set(found.tables[0].columns)


def test_velocity_and_acceleration_are_found_by_type(tmp_path):
    columns = opened(tmp_path, POSE, WRENCH, twist("/v"), acceleration("/a")).config.columns
    assert (columns.velocity, columns.acceleration) == ("/v.twist.linear.{axis}", "/a.accel.linear.{axis}")


def test_what_is_not_there_stays_as_it_was(tmp_path):
    columns = opened(tmp_path, POSE, WRENCH).config.columns
    assert (columns.velocity, columns.reference) == ("velocity_{axis}", "reference_{axis}")


def test_what_is_named_is_kept_and_what_is_null_is_not_sought(tmp_path):
    named = {"force": "/joints.effort[{index}]", "velocity": None}
    joints = joint_state("/joints", START, (1, 2, 3), (4, 5, 6))
    columns = opened(tmp_path, POSE, WRENCH, twist("/v"), joints, columns=named).config.columns
    assert (columns.force, columns.velocity) == (named["force"], None)
    assert columns.torque == "torque_{axis}", "the effort has no torque of which we know"


def test_quaternion_is_in_the_order_of_the_configuration(tmp_path):
    columns = opened(tmp_path, POSE, WRENCH, force={"rotation": "quaternion_wxyz"}).config.columns
    assert columns.orientation == tuple(f"/pose.pose.orientation.{part}" for part in "wxyz")
    columns = opened(tmp_path / "..", POSE, WRENCH, force={"rotation": "ZYZ"}).config.columns
    assert columns.orientation == LogConfig().columns.orientation


# --- several, or none ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("extra", "key", "listed", "null"),
    [
        (wrench("/ft2", START, (1, 2, 3)), "force", r"/ft \(geometry_msgs/WrenchStamped\), /ft2 \(", False),
        (transform("/tip"), "position", r"/pose \(geometry_msgs/PoseStamped\), /tip \(", False),
        (twist("/w"), "velocity", r"/v \(geometry_msgs/TwistStamped\), /w \(", True),
    ],
)
def test_two_topics_of_one_kind_are_listed(tmp_path, extra, key, listed, null):
    with pytest.raises(LogError, match=f"expected one topic that holds {key}, found 2 .*{listed}") as caught:
        opened(tmp_path, POSE, WRENCH, twist("/v"), extra)
    assert f"name the one that is meant in log.columns.{key}, such as " in str(caught.value)
    assert str(caught.value).endswith("or set it to null") == null


def test_naming_one_of_two_settles_it(tmp_path):
    other = wrench("/ft2", START, (1, 2, 3))
    columns = opened(
        tmp_path, POSE, WRENCH, other, columns={"force": "/ft2.wrench.force.{axis}"}
    ).config.columns
    assert columns.torque == "/ft2.wrench.torque.{axis}"


def test_no_wrench_says_what_was_sought_and_what_there_is(tmp_path):
    file = write_bag(tmp_path / "log.bag", [POSE, joint_state("/joints", START, (1, 2))])
    with pytest.raises(
        LogError,
        match=r"log.bag: expected a wrench \(WrenchStamped, or one in the effort of a JointState that "
        r'log.columns.force names, such as "/robot_state.effort\[\{index\}\]"\), found no such topic among /pose '
        r"\(geometry_msgs/PoseStamped\), "
        r"/joints \(sensor_msgs/JointState\); record what is missing",
    ):
        read_log(file)


def test_no_wrench_is_no_error_where_none_is_needed(tmp_path):
    messages = [pose("/pose", START + 1000 * i, (i, i, i)) for i in range(3)]
    assert read_log(write_bag(tmp_path / "log.bag", messages), require_force=False).trials[0].force is None


# --- names of the configuration ------------------------------------------------------------------


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize(("named", "there"), [("/ft", "ft"), ("ft", "/ft")])
def test_slash_that_is_missing_or_too_many_is_mended_with_a_warning(tmp_path, ending, named, there):
    with pytest.warns(
        LogWarning,
        match=f"log{ending}: the topic '{named}' of log.columns.force is taken to be '{there}', for there is none of "
        "the former name; write it as in the file",
    ) as caught:
        found = opened(
            tmp_path,
            POSE,
            wrench(there, START, (1, 2, 3)),
            ending=ending,
            columns={"force": f"{named}.wrench.force.{{axis}}"},
        )
    assert len(caught) == 1
    assert found.config.columns.force == f"{there}.wrench.force.{{axis}}"


def test_topic_that_is_not_there_names_the_nearest(tmp_path):
    with pytest.raises(
        LogError,
        match=r"expected topic '/force', found none of that name \(the nearest is '/force_torque'\); set "
        r"log.columns.force to a topic and field in the file: /pose \(geometry_msgs/PoseStamped\), /force_torque \(",
    ):
        opened(tmp_path, POSE, wrench("/force_torque", START, (1, 2, 3)), columns={"force": "/force.x{axis}"})


def test_field_that_is_not_there_names_the_nearest(tmp_path):
    file = write_bag(tmp_path / "log.bag", [POSE, WRENCH])
    config = LogConfig.model_validate({"columns": {"force": "/ft.force.{axis}"}})
    with pytest.raises(LogError, match=r"expected column '/ft.force.x'.*the nearest is '/ft.wrench.force.x'"):
        read_log(file, config)


def test_one_topic_for_each_axis(tmp_path):
    messages = [(f"/f{axis}", "std_msgs/msg/Float64", START, {"data": 1.0}) for axis in "xyz"]
    found = opened(tmp_path, POSE, *messages, columns={"force": "/f{axis}.data"})
    assert {"/fx.data", "/fy.data", "/fz.data"} <= set(found.tables[0].columns)


# --- frames --------------------------------------------------------------------------------------


def test_wrench_in_another_frame_than_the_pose_is_questioned(tmp_path):
    with pytest.warns(
        LogWarning,
        match="/ft is in frame 'sensor', /pose in 'base', so the wrench may turn with the tool; set log.force.frame",
    ):
        opened(tmp_path, POSE, wrench("/ft", START, (1, 2, 3), frame="sensor"))


@pytest.mark.parametrize(
    ("frame", "log"), [("sensor", {"force": {"frame": "tool"}}), ("", {}), ("base", {}), ("/base", {})]
)
def test_wrench_in_a_frame_that_is_right_or_unknown_is_not(tmp_path, frame, log):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opened(tmp_path, POSE, wrench("/ft", START, (1, 2, 3), frame=frame), **log)


def test_twist_in_a_moving_frame_is_no_velocity(tmp_path):
    with pytest.warns(
        LogWarning, match="/o gives its twist in the moving frame 'link', not in 'base', so its velocity"
    ):
        found = opened(tmp_path, odometry("/o", START, (1, 2, 3), (0, 0, 0), child="link"), WRENCH)
    assert found.config.columns.velocity == "velocity_{axis}"
