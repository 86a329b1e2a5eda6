"""Bags of ROS 1 and ROS 2 as tables: what goes in comes out, whichever format, folder or compression."""

import shutil
import sqlite3
import tracemalloc
from contextlib import closing

import numpy as np
import pytest
from message_files import ENDINGS, HIDDEN, START, hidden, joint_state, odometry, pose, wrench, write_bag

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError
from bayes_impedance.readers import read_log
from bayes_impedance.readers.bags import messages as messages_module
from bayes_impedance.readers.read import open_file

POSE = ("/pose.pose.position.x", "/pose.pose.position.y", "/pose.pose.position.z")
FORCE = ("/ft.wrench.force.x", "/ft.wrench.force.y", "/ft.wrench.force.z")


def two_topics(n=30, seed=0):
    """Poses at 1 kHz and wrenches at 500 Hz, with stamps that neither clock rounds, and what both hold."""
    rng = np.random.default_rng(seed)
    times = START + np.arange(n) * 1_000_000 + rng.integers(0, 1000, n)
    positions, forces = rng.normal(size=(n, 3)), rng.normal(size=(n // 2, 3))
    sent = times - 7_000_000_123
    messages = [
        pose("/pose", int(time), position, sent=int(stamp))
        for time, position, stamp in zip(times, positions, sent, strict=True)
    ]
    messages += [
        wrench("/ft", int(time) + 5, force, sent=int(stamp))
        for time, force, stamp in zip(times[::2], forces, sent[::2], strict=True)
    ]
    return sorted(messages, key=lambda message: message[2]), times, sent, positions, forces


def load(file, names, config=None):
    (table,) = open_file(file, file.name, config or LogConfig()).tables
    return {stream.name: stream for stream in table.load(names, ())}


# --- what goes in comes out ----------------------------------------------------------------------


@pytest.mark.parametrize("ending", ENDINGS)
def test_topics_of_different_rates_come_back_to_the_bit(tmp_path, ending):
    messages, times, sent, positions, forces = two_topics()
    streams = load(write_bag(tmp_path / f"log{ending}", messages), (*FORCE, *POSE))
    assert list(streams) == ["/ft", "/pose"]
    for name, columns, values, which in (
        ("/pose", POSE, positions, slice(None)),
        ("/ft", FORCE, forces, slice(None, None, 2)),
    ):
        stream = streams[name]
        np.testing.assert_array_equal(
            np.stack([stream.columns[column] for column in columns], axis=1), values
        )
        assert all(stream.columns[column].dtype == np.float64 for column in columns)
        assert (stream.rows.word, stream.rows.numbers.tolist()) == (
            "message",
            list(range(1, len(values) + 1)),
        )
        arrival = times[which] - times[0] + (5 if name == "/ft" else 0)
        np.testing.assert_array_equal(stream.received, arrival / 1e9)
        np.testing.assert_array_equal(stream.sent, (sent[which] - times[0]) / 1e9)
        assert np.abs(np.rint(stream.sent * 1e9) - (sent[which] - times[0])).max() == 0


@pytest.mark.parametrize("ending", ENDINGS)
def test_batches_do_not_show(tmp_path, ending, monkeypatch):
    messages, *_ = two_topics()
    file = write_bag(tmp_path / f"log{ending}", messages)
    whole = load(file, (*FORCE, *POSE))
    monkeypatch.setattr(messages_module, "BATCH", 7)
    for name, stream in load(file, (*FORCE, *POSE)).items():
        for column, values in stream.columns.items():
            np.testing.assert_array_equal(values, whole[name].columns[column])
        np.testing.assert_array_equal(stream.sent, whole[name].sent)
        np.testing.assert_array_equal(stream.received, whole[name].received)


@pytest.mark.parametrize("ending", ENDINGS)
def test_wrench_hidden_in_effort_reads_as_a_log(tmp_path, ending):
    messages = hidden()
    log = read_log(write_bag(tmp_path / f"log{ending}", messages), HIDDEN)
    (trial,) = log.trials
    assert log.axes == ("x", "y", "z")
    np.testing.assert_array_equal(trial.position, [content["position"][:3] for *_, content in messages])
    np.testing.assert_array_equal(trial.force, [content["effort"][:3] for *_, content in messages])
    np.testing.assert_array_equal(trial.time, np.arange(20) * 10_000_000 / 1e9)
    assert trial.rows.word == "message"


@pytest.mark.parametrize("ending", ENDINGS)
def test_odometry_holds_position_and_velocity(tmp_path, ending):
    rng = np.random.default_rng(1)
    values = rng.normal(size=(9, 2, 3))
    messages = [odometry("/odom", START + 1000 * i, *value, child="") for i, value in enumerate(values)]
    log = read_log(write_bag(tmp_path / f"log{ending}", messages), require_force=False)
    np.testing.assert_array_equal(log.trials[0].position, values[:, 0])
    np.testing.assert_array_equal(log.trials[0].velocity, values[:, 1])


def test_every_number_of_every_topic_is_a_column(tmp_path):
    messages = [
        pose("/pose", START, (1, 2, 3)),
        joint_state("/joints", START, (1, 2), (3,)),
        ("/gain", "std_msgs/msg/Float64", START, {"data": 2.0}),
        ("/text", "std_msgs/msg/String", START, {"data": "abc"}),
    ]
    (table,) = open_file(write_bag(tmp_path / "log.mcap", messages), "log", LogConfig()).tables
    stamps = [f"{topic}.header.stamp.{part}" for topic in ("/pose", "/joints") for part in ("sec", "nanosec")]
    assert set(table.columns) == {
        *stamps,
        *POSE,
        *(f"/pose.pose.orientation.{part}" for part in "xyzw"),
        "/joints.position[0]",
        "/joints.position[1]",
        "/joints.effort[0]",
        "/gain.data",
    }
    assert table.timed


@pytest.mark.parametrize("compression", ["bz2", "lz4"])
def test_compressed_bags_of_ros1_read_alike(tmp_path, compression):
    log = read_log(write_bag(tmp_path / "log.bag", hidden(), compression), HIDDEN)
    plain = read_log(write_bag(tmp_path / "plain.bag", hidden()), HIDDEN)
    np.testing.assert_array_equal(log.trials[0].force, plain.trials[0].force)


@pytest.mark.parametrize(
    ("ending", "mode"), [(".mcap", "storage"), (".mcap", "message"), (".db3", "message"), (".db3", "file")]
)
def test_compressed_folders_of_ros2_read_alike(tmp_path, ending, mode):
    log = read_log(write_bag(tmp_path / f"log{ending}", hidden(), "zstd", mode=mode).parent, HIDDEN)
    plain = read_log(write_bag(tmp_path / f"plain{ending}", hidden()), HIDDEN)
    np.testing.assert_array_equal(log.trials[0].force, plain.trials[0].force)


@pytest.mark.parametrize("ending", [".db3", ".mcap"])
def test_folder_file_in_it_and_file_alone_are_one_recording(tmp_path, ending):
    file = write_bag(tmp_path / f"log{ending}", hidden())
    alone = tmp_path / f"alone{ending}"
    shutil.copy(file, alone)
    logs = [read_log(path, HIDDEN) for path in (file, file.parent, alone)]
    for log in logs[1:]:
        np.testing.assert_array_equal(log.trials[0].force, logs[0].trials[0].force)


def test_recording_split_into_files_is_read_whole_from_its_folder(tmp_path):
    messages = hidden()
    file = write_bag(tmp_path / "log.db3", messages)
    second = file.with_name("second.db3")
    shutil.copy(file, second)
    for path, keep in ((file, "<="), (second, ">")):
        with closing(sqlite3.connect(path)) as connection, connection:
            connection.execute(f"DELETE FROM messages WHERE NOT timestamp {keep} ?", (messages[7][2],))
    metadata = file.parent / "metadata.yaml"
    text = metadata.read_text(encoding="utf-8")
    assert text.count("- log.db3") == 1
    metadata.write_text(text.replace("- log.db3", "- log.db3\n  - second.db3"), encoding="utf-8")
    assert len(read_log(file, HIDDEN).trials[0].time) == 8
    assert len(read_log(file.parent, HIDDEN).trials[0].time) == 20


def test_file_without_definitions_is_read_by_those_of_ros2(tmp_path):
    # As ROS 2 recorded before Iron: neither a table of definitions nor one of the schema.
    file = write_bag(tmp_path / "log.db3", hidden())
    truth = read_log(file, HIDDEN).trials[0].force
    with closing(sqlite3.connect(file)) as connection, connection:
        for table in ("schema", "metadata", "message_definitions"):
            connection.execute(f"DROP TABLE {table}")
        connection.execute("ALTER TABLE topics DROP COLUMN type_description_hash")
    np.testing.assert_array_equal(read_log(file, HIDDEN).trials[0].force, truth)


def test_definitions_in_the_file_win(tmp_path):
    file = write_bag(tmp_path / "log.db3", hidden())
    with closing(sqlite3.connect(file)) as connection, connection:
        connection.execute(
            "UPDATE message_definitions SET encoded_message_definition = "
            "replace(encoded_message_definition, 'effort', 'torque')"
        )
    config = HIDDEN.model_copy(
        update={"columns": HIDDEN.columns.model_copy(update={"force": "/robot_state.torque[{index}]"})}
    )
    assert read_log(file, config).trials[0].force.shape == (20, 3)


IDL = {
    "builtin_interfaces/msg/Time": "module builtin_interfaces { module msg { struct Time { "
    "int32 sec; uint32 nanosec; }; }; };",
    "std_msgs/msg/Header": "module std_msgs { module msg { struct Header { "
    "builtin_interfaces::msg::Time stamp; string frame_id; }; }; };",
    "sensor_msgs/msg/JointState": "module sensor_msgs { module msg { struct JointState { std_msgs::msg::Header header; "
    "sequence<string> name; sequence<double> position, velocity, effort; }; }; };",
}


@pytest.mark.parametrize("together", [True, False])
def test_definitions_in_idl(tmp_path, together):
    file = write_bag(tmp_path / "log.db3", hidden())
    truth = read_log(file, HIDDEN).trials[0].force
    rule = 80 * "=" + "\n"
    text = (
        "\n".join(IDL.values())
        if together
        else "".join(f"{rule}IDL: {name}\n{idl}\n" for name, idl in IDL.items())
    )
    with closing(sqlite3.connect(file)) as connection, connection:
        connection.execute(
            "UPDATE message_definitions SET encoding = 'ros2idl', encoded_message_definition = ?", (text,)
        )
    np.testing.assert_array_equal(read_log(file, HIDDEN).trials[0].force, truth)


@pytest.mark.parametrize("ending", ENDINGS)
def test_any_name_of_a_folder_or_file_will_do(tmp_path, ending):
    folder = tmp_path / "run #1?a=b%20 é"
    folder.mkdir()
    file = folder / f"log #2%{ending}"
    shutil.copy(write_bag(tmp_path / f"log{ending}", hidden()), file)
    assert len(read_log(file, HIDDEN).trials[0].time) == 20


# --- stamps --------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", ENDINGS)
def test_messages_without_header_or_with_one_nobody_set_have_no_stamp_of_the_sender(tmp_path, ending):
    messages = [
        message
        for i in range(3)
        for message in (
            ("/p", "geometry_msgs/msg/Pose", START + i, {"position": {"x": float(i)}}),
            pose("/q", START + i, (0, 0, i), sent=0),
        )
    ]
    config = LogConfig.model_validate({"columns": {"position": "/p.position.{axis}"}})
    streams = load(
        write_bag(tmp_path / f"log{ending}", messages), ["/p.position.x", "/q.pose.position.z"], config
    )
    assert streams["/p"].sent is None
    assert streams["/q"].sent is None
    np.testing.assert_array_equal(streams["/p"].received, np.arange(3) / 1e9)


# --- arrays that lack what is wanted -------------------------------------------------------------


@pytest.mark.parametrize("ending", ENDINGS)
def test_array_that_is_too_short_in_some_messages_is_named_with_them(tmp_path, ending):
    messages = [
        joint_state("/robot_state", START + i, (i, 2, 3), (1, 2, 3)[: 3 if i % 4 else 1])
        for i in range(1, 11)
    ]
    with pytest.raises(
        LogError,
        match=r"log.*, topic '/robot_state': expected effort\[1\] in every message, found an array without it in 2 of "
        r"10 messages, first in message 4; name another field in log\.columns",
    ):
        read_log(write_bag(tmp_path / f"log{ending}", messages), HIDDEN)


@pytest.mark.parametrize("filled", [(), (5, 6)])
def test_array_that_is_empty_is_named_with_its_messages(tmp_path, filled):
    messages = [
        joint_state("/robot_state", START + i, (i, 2, 3), (1, 2, 3) if i in filled else ()) for i in range(9)
    ]
    match = rf"expected effort\[0\] in every message.* in {9 - len(filled)} of 9 messages, first in message 1"
    with pytest.raises(LogError, match=match):
        read_log(write_bag(tmp_path / "log.bag", messages), HIDDEN)


def test_short_arrays_of_topics_that_are_not_wanted_do_not_matter(tmp_path):
    messages = hidden() + [joint_state("/other", START + i, (1,) * i) for i in range(5)]
    assert len(read_log(write_bag(tmp_path / "log.bag", messages), HIDDEN).trials[0].time) == 20


# --- memory ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("wanted", ["/image.height", "/pose.pose.position.x"])
def test_messages_are_not_held(tmp_path, ending, wanted):
    image = {"height": 7, "data": np.zeros(200_000, dtype=np.uint8)}
    messages = [
        message
        for i in range(200)
        for message in (
            ("/image", "sensor_msgs/msg/Image", START + i, image),
            pose("/pose", START + i, (7, 8, 9)),
        )
    ]
    file = write_bag(tmp_path / f"log{ending}", messages)
    load(file, [wanted])
    tracemalloc.start()
    (stream,) = load(file, [wanted]).values()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (stream.columns[wanted] == 7).all()
    # Of 40 MB a batch, joined, and a chunk.
    assert peak < 15e6
