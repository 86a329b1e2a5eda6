"""Bags recorded on real robots, read by one configuration: what rosbags itself reads, or one clear sentence."""

import numpy as np
import pytest
from message_files import ROS1
from rosbags import rosbag1

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.readers import read_log


def joint_states(file):
    """`/robot_state` as rosbags itself reads it, message by message."""
    rows = []
    with rosbag1.Reader(file) as reader:
        for connection, time, raw in reader.messages():
            if connection.topic.strip("/") == "robot_state":
                message = ROS1.deserialize_ros1(raw, connection.msgtype)
                stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                rows.append((stamp, time, *message.position[:3], *message.velocity[:3], *message.effort[:3]))
    return rows


#: One configuration for every recording of gp_mpc.
GP_MPC = LogConfig.model_validate(
    {
        "columns": {
            "position": "/robot_state.position[{index}]",
            "velocity": "/robot_state.velocity[{index}]",
            "force": "/robot_state.effort[{index}]",
        }
    }
)
RECORDINGS = (
    *(f"acc_rail/{i}" for i in (1, 2, 3)),
    *(f"acc_twobag/{task}{i}" for task in ("l", "r", "rr") for i in (1, 2, 3)),
    *(f"rail/{i}" for i in (1, 2, 3)),
    "loader_edge_cases/nj60_single_front_no_effort",
    "loader_edge_cases/polish_flat2_2_only31msgs",
)


def check_against_library(log, file):
    (trial,) = log.trials
    truth = joint_states(file)
    stamps = [stamp for stamp, *_ in truth]
    values = np.array([row[2:] for row in truth])
    np.testing.assert_array_equal(trial.position, values[:, :3])
    np.testing.assert_array_equal(trial.velocity, values[:, 3:6])
    np.testing.assert_array_equal(trial.force, values[:, 6:])
    np.testing.assert_allclose(trial.time, [(stamp - stamps[0]) / 1e9 for stamp in stamps], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", RECORDINGS)
def test_real_bags_read_as_the_library_reads_them(shared_data, name):
    file = shared_data / "gp_mpc" / f"{name}.bag"
    check_against_library(read_log(file, GP_MPC), file)


def test_real_bag_whose_topic_lacks_the_slash_is_taken_with_a_warning(shared_data):
    file = shared_data / "gp_mpc" / "loader_edge_cases" / "contact_var_man_00_no_state_topic.bag"
    with pytest.warns(
        LogWarning, match="topic '/robot_state' of log.columns.position is taken to be 'robot_state'"
    ):
        log = read_log(file, GP_MPC)
    check_against_library(log, file)


def test_real_bag_without_force_along_two_axes(shared_data):
    file = shared_data / "gp_mpc" / "loader_edge_cases" / "var_wd_cc_1_590ms_gap.bag"
    with pytest.raises(
        LogError, match="expected interaction force along axis x, found force_x = 0 throughout"
    ):
        read_log(file, GP_MPC)


def test_real_bag_without_pose_and_wrench(shared_data):
    with pytest.raises(LogError) as caught:
        read_log(shared_data / "kuka_jointstate_only" / "test.bag")
    for part in (
        "WrenchStamped",
        "PoseStamped",
        "log.columns.force",
        "/joint_states (sensor_msgs/JointState)",
    ):
        assert part in str(caught.value)
