"""Bags that are damaged, closed by nobody, or made to take memory: one clear sentence."""

import bz2
import itertools
import sqlite3
import tracemalloc
from contextlib import closing

import lz4.frame
import pytest
from message_files import ENDINGS, HIDDEN, START, hidden, write_bag
from rosbags.rosbag2.storage_mcap import zstd

from bayes_impedance.errors import LogError
from bayes_impedance.readers import read_log
from bayes_impedance.readers.bags import bounded

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
