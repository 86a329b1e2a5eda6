"""Bags of ROS 1 and ROS 2 as tables: what goes in comes out, whichever format, folder or compression."""

import bz2
import itertools
import shutil
import sqlite3
import tracemalloc
from contextlib import closing

import lz4.frame
import numpy as np
import pytest
from message_files import ENDINGS, ROS1, joint_state, odometry, pose, wrench, write_bag
from rosbags import rosbag1
from rosbags.rosbag2.storage_mcap import zstd

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.readers import bounded, read_log
from bayes_impedance.readers import messages as messages_module
from bayes_impedance.readers.read import open_file

START = 1_700_000_000_123_456_789
POSE = ("/pose.pose.position.x", "/pose.pose.position.y", "/pose.pose.position.z")
FORCE = ("/ft.wrench.force.x", "/ft.wrench.force.y", "/ft.wrench.force.z")
HIDDEN = LogConfig.model_validate(
    {"columns": {"position": "/robot_state.position[{index}]", "force": "/robot_state.effort[{index}]"}}
)


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


def hidden(n=20, **options):
    """A JointState with position and, as effort, force."""
    rng = np.random.default_rng(3)
    return [
        joint_state("/robot_state", START + 10_000_000 * i, *rng.normal(size=(2, 6)), **options)
        for i in range(n)
    ]


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


# --- bags that are not what they should be -------------------------------------------------------


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize(
    "content", [b"", b"time,position_x\n0,1\n1,2\n", bytes(200)], ids=["empty", "CSV", "zeros"]
)
def test_other_files_under_the_name_of_a_bag(tmp_path, ending, content):
    file = tmp_path / f"log{ending}"
    file.write_bytes(content)
    with pytest.raises(LogError, match="found one that is damaged, was never closed, or is something else"):
        read_log(file)


def test_unindexed_bag_of_ros1_says_how_to_mend_it(tmp_path):
    file = write_bag(tmp_path / "log.bag", hidden())
    raw = file.read_bytes()
    at = raw.index(b"index_pos=") + len(b"index_pos=")
    file.write_bytes(raw[:at] + bytes(8) + raw[at + 8 :])
    with pytest.raises(LogError, match="not indexed.*; repair it by `rosbag reindex`, or record it anew"):
        read_log(file, HIDDEN)


def test_mcap_that_was_never_closed_says_how_to_mend_it(tmp_path):
    file = write_bag(tmp_path / "log.mcap", hidden())
    file.write_bytes(file.read_bytes()[:-200])
    with pytest.raises(LogError, match="was never closed.*; repair it by `mcap recover`"):
        read_log(file, HIDDEN)


@pytest.mark.parametrize("ending", ENDINGS)
def test_bag_without_messages(tmp_path, ending):
    with pytest.raises(LogError, match="expected messages, found a bag without any; record it anew"):
        read_log(write_bag(tmp_path / f"log{ending}", []), HIDDEN)


def test_folder_with_broken_metadata(tmp_path):
    folder = write_bag(tmp_path / "log.db3", hidden()).parent
    (folder / "metadata.yaml").write_text("[: {")
    with pytest.raises(LogError, match="expected the folder of a ROS 2 bag, found one that is damaged"):
        read_log(folder, HIDDEN)


def test_folder_without_metadata_is_no_recording(tmp_path):
    file = write_bag(tmp_path / "log.db3", hidden())
    (file.parent / "metadata.yaml").unlink()
    with pytest.raises(LogError, match="expected a file, found a folder"):
        read_log(file.parent, HIDDEN)


def test_unknown_compression(tmp_path):
    file = write_bag(tmp_path / "log.bag", hidden())
    file.write_bytes(file.read_bytes().replace(b"compression=none", b"compression=zlib"))
    with pytest.raises(LogError, match="Compression 'zlib' is not supported"):
        read_log(file, HIDDEN)


def test_damaged_message_is_named_by_its_number(tmp_path):
    file = write_bag(tmp_path / "log.db3", hidden())
    with closing(sqlite3.connect(file)) as connection, connection:
        connection.execute("UPDATE messages SET data = substr(data, 1, 50) WHERE id = 13")
    with pytest.raises(
        LogError,
        match="log.db3, topic '/robot_state', message 13: expected a sensor_msgs/msg/JointState, found 50 bytes, an "
        "end within the message; repair the bag, or record it anew",
    ):
        read_log(file, HIDDEN)


@pytest.mark.parametrize(
    ("column", "cell"),
    [*itertools.product(["data", "timestamp"], ["NULL", "'text'", "-1.5"]), ("data", "12")],
)
def test_cells_of_sqlite_that_are_no_messages(tmp_path, column, cell):
    file = write_bag(tmp_path / "log.db3", hidden())
    with closing(sqlite3.connect(file)) as connection, connection:
        connection.execute("ALTER TABLE messages RENAME TO old")
        connection.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        connection.execute("INSERT INTO messages SELECT * FROM old")
        connection.execute(f"UPDATE messages SET {column} = {cell} WHERE id = 3")
    with pytest.raises(LogError, match="a message without time or bytes"):
        read_log(file, HIDDEN)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ("UPDATE topics SET serialization_format = 'json'", "found messages encoded as 'json', not CDR"),
        (
            "UPDATE message_definitions SET encoded_message_definition = 'float64 ['",
            "found a definition of its type that cannot be read",
        ),
        (
            "UPDATE message_definitions SET encoded_message_definition = 'Other other'",
            "found in its first message no definition of the type sensor_msgs/msg/Other",
        ),
        ("DELETE FROM messages WHERE topic_id = 1", "found no messages"),
        (
            "UPDATE topics SET name = '/robot_state'",
            r"found messages of several types \(sensor_msgs/msg/JointState, std_msgs/msg/Float64\)",
        ),
    ],
)
def test_topic_that_cannot_be_read_says_why(tmp_path, change, problem):
    file = write_bag(
        tmp_path / "log.db3", [*hidden(), ("/other", "std_msgs/msg/Float64", START, {"data": 1.0})]
    )
    with closing(sqlite3.connect(file)) as connection, connection:
        connection.execute(change)
    with pytest.raises(
        LogError,
        match=rf"topic '/robot_state': expected messages that can be read, {problem}.*; name another topic in "
        r"log\.columns\.position",
    ):
        read_log(file, HIDDEN)


def test_messages_compressed_one_by_one_need_their_folder(tmp_path):
    file = write_bag(tmp_path / "log.db3", hidden(), "zstd", mode="message")
    with pytest.raises(
        LogError, match="compressed one by one; name the folder of the bag, not the file in it"
    ):
        read_log(file, HIDDEN)


def test_names_in_a_file_are_never_run(tmp_path):
    # To register a type rosbags executes code that holds its name.
    witness = tmp_path / "witness"
    kind = f"a/msg/B:\n    __import__('pathlib').Path({str(witness)!r}).touch()\nclass C"
    file = write_bag(tmp_path / "log.db3", hidden())
    with closing(sqlite3.connect(file)) as connection, connection:
        connection.execute("UPDATE topics SET type = ?", (kind,))
        connection.execute("UPDATE message_definitions SET topic_type = ?", (kind,))
    with pytest.raises(LogError, match="expected messages that can be read"):
        read_log(file, HIDDEN)
    assert not witness.exists()


# --- bounds --------------------------------------------------------------------------------------

#: What reading a tiny file may take [byte], types included; a crafted length asks for gigabytes.
ROOM = 1 << 26
LZ4, ZSTANDARD = b"\x04\x22\x4d\x18", b"\x28\xb5\x2f\xfd"


def lz4_claiming(size, frame):
    """The header of an LZ4 frame (15 bytes) that claims another size; its last byte is a checksum, found by trying."""
    for checksum in range(256):
        claim = frame[:6] + size.to_bytes(8, "little") + bytes([checksum])
        try:
            lz4.frame.get_frame_info(claim)
        except RuntimeError:
            continue
        return claim
    raise AssertionError


def chunk_sizes(raw):
    """Bytes that end the index of the first chunk of an MCAP file: its compressed size and its size."""
    at = 8 + 9 + int.from_bytes(raw[9:17], "little")
    assert raw[at] == 6
    data = raw[at + 9 :]
    name = int.from_bytes(data[28:32], "little")
    return bytes(data[32 + name : 40 + name]) + bytes(data[16:24])


def peak_of(file):
    tracemalloc.start()
    try:
        with pytest.raises(LogError):
            read_log(file, HIDDEN)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("where", ["record", "chunk"])
def test_length_beyond_the_file_takes_no_memory_in_ros1(tmp_path, where):
    file = write_bag(tmp_path / "log.bag", hidden())
    raw = bytearray(file.read_bytes())
    # The first record begins after a line of text; the header of a chunk ends with its size, its data begin with it.
    at = raw.index(b"\n") + 1 if where == "record" else raw.index(b"size=") + len(b"size=") + 4
    raw[at : at + 4] = (2**31).to_bytes(4, "little")
    file.write_bytes(raw)
    assert peak_of(file) < ROOM


def test_chunk_longer_than_the_file_takes_no_memory_in_mcap(tmp_path):
    file = write_bag(tmp_path / "log.mcap", hidden())
    raw = bytearray(file.read_bytes())
    at = raw.index(chunk_sizes(raw))
    raw[at : at + 8] = (2**31).to_bytes(8, "little")
    file.write_bytes(raw)
    assert peak_of(file) < ROOM


@pytest.mark.parametrize("kind", ["lz4", "zstd"])
def test_chunk_that_claims_to_be_huge_takes_no_memory(tmp_path, kind):
    if kind == "lz4":
        file = write_bag(tmp_path / "log.bag", hidden(), "lz4")
        raw = bytearray(file.read_bytes())
        at = raw.index(LZ4)
        frame = lz4_claiming(2**31, bytes(raw[at : at + 15]))
        raw[at : at + 15] = frame
    else:
        file = write_bag(tmp_path / "log.mcap", hidden(400), "zstd")
        raw = bytearray(file.read_bytes())
        at = raw.index(ZSTANDARD)
        assert raw[at + 4] >> 6 == 2, "four bytes of size"
        raw[at + 5 : at + 9] = (2**31).to_bytes(4, "little")
    file.write_bytes(raw)
    assert peak_of(file) < ROOM


@pytest.mark.parametrize("name", ["bz2", "lz4", "zstd"])
def test_chunk_that_unpacks_without_end_or_ends_too_early(monkeypatch, name):
    pack, make = {
        "bz2": (bz2.compress, bz2.BZ2Decompressor),
        "lz4": (lz4.frame.compress, lz4.frame.LZ4FrameDecompressor),
        "zstd": (zstd.compress, zstd.ZstdDecompressor),
    }[name]
    data = bytes(range(256)) * (5 << 12)
    assert bounded.unpack(make(), pack(data)) == data
    with pytest.raises(Exception, match=r"ends too early"):
        bounded.unpack(make(), pack(data)[:-9])
    monkeypatch.setattr(bounded, "LARGEST_CHUNK", len(data) - 1)
    with pytest.raises(ValueError, match="unpacks to more than"):
        bounded.unpack(make(), pack(data))


def test_array_of_two_billion_numbers_takes_no_memory(tmp_path):
    for ending in ENDINGS:
        message = hidden(1)[0]
        file = write_bag(tmp_path / f"long{ending}", [message])
        raw = file.read_bytes()
        six = (6).to_bytes(4, "little")
        assert raw.count(six) >= 2
        file.write_bytes(raw.replace(six, (2**31).to_bytes(4, "little")))
        assert peak_of(file) < ROOM


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


# --- real recordings -----------------------------------------------------------------------------


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
