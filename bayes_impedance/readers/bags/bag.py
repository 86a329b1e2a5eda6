"""ROS bags by the library rosbags: topics and raw messages; whatever the library raises becomes a LogError."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags import rosbag1, rosbag2
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from bayes_impedance.errors import LogError
from bayes_impedance.readers.bags.bounded import BoundedPath, bound_chunks
from bayes_impedance.readers.bags.layout import Definitions, Layout, MalformedError, Walker
from bayes_impedance.readers.cells import brief

bound_chunks()

#: What each ending stands for, and the tool that mends it.
KINDS = {
    ".bag": ("a ROS 1 bag", "rosbag reindex"),
    ".db3": ("a ROS 2 bag in SQLite", "ros2 bag reindex"),
    ".mcap": ("a ROS 2 bag in MCAP", "mcap recover"),
    "": ("the folder of a ROS 2 bag", "ros2 bag reindex"),
}
#: No clock shows later [ns]; differences stay within 64 bits.
LATEST = 2**62
#: What separates the definitions of several types in IDL.
RULE = "=" * 80 + "\n"
ZSTANDARD = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True)
class Topic:
    """A topic by its first message: type, definitions, layout, frames; or the `problem` why it cannot be read."""

    name: str
    kind: str
    problem: str | None = None
    definitions: Definitions | None = None
    layout: Layout | None = None
    frame: str = ""
    child: str = ""


@dataclass(frozen=True)
class Bag:
    """A bag opened as far as the first message of each topic; `origin` [ns] is where its time begins."""

    file: Path
    source: str
    topics: dict[str, Topic]
    origin: int

    @property
    def cdr(self) -> bool:
        """Whether messages are in CDR, as ROS 2 has them."""
        return is_ros2(self.file)

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of arrival [ns] and bytes of the messages of some topics, in the order of arrival.

        Raises:
            LogError: the bag is damaged.
        """
        with _opened(self.file, self.source) as reader:
            chosen = [connection for connection in reader.connections if connection.topic in topics]
            for connection, time, raw in reader.messages(chosen):
                # A damaged index leads to messages of other topics.
                if connection.topic in topics:
                    yield connection.topic, *_checked(time, raw)


def read_bag(file: Path, source: str) -> Bag:
    """The topics of a bag.

    Raises:
        LogError: it is damaged, is something else, or holds no messages.
    """
    with _opened(file, source) as reader:
        by_topic: dict[str, list[Any]] = {}
        for connection in reader.connections:
            # ROS allows no point in a name, which separates topic and field here.
            if "." not in connection.topic:
                by_topic.setdefault(connection.topic, []).append(connection)
        topics, starts = {}, []
        for name, connections in by_topic.items():
            with closing(reader.messages(connections)) as messages:
                first = next(messages, None)
            if first is None:
                topics[name] = Topic(name, connections[0].msgtype, "no messages")
                continue
            time, raw = _checked(*first[1:])
            starts.append(time)
            topics[name] = _topic(connections, raw, is_ros2(file))
    if not starts:
        raise LogError(f"{source}: expected messages, found a bag without any; record it anew")
    return Bag(file, source, topics, min(starts))


def is_ros2(file: Path) -> bool:
    """Whether a file or folder is a bag of ROS 2."""
    return file.suffix.lower() != ".bag" or file.is_dir()


@contextmanager
def _opened(file: Path, source: str) -> Iterator[Any]:
    """A reader of rosbags, open; every exception of the library within is a LogError."""
    kind, tool = KINDS["" if file.is_dir() else file.suffix.lower()]
    try:
        reader = (rosbag2 if is_ros2(file) else rosbag1).Reader(BoundedPath(file))
        with reader:
            yield reader
    except LogError:
        raise
    # Of a damaged file the library raises anything from AssertionError to struct.error and apsw.Error.
    except Exception as error:
        raise LogError(
            f"{source}: expected {kind}, found one that is damaged, was never closed, or is something else "
            f"({brief(error)}); repair it by `{tool}`, or record it anew"
        ) from error


def _checked(time: Any, raw: Any) -> tuple[int, bytes]:
    # A cell of SQLite may hold anything.
    if not isinstance(raw, bytes) or not isinstance(time, int) or not 0 <= time < LATEST:
        raise TypeError("a message without time or bytes")
    return time, raw


def _topic(connections: list[Any], raw: bytes, cdr: bool) -> Topic:
    """A topic by its connections and the bytes of its first message."""
    name, kind = connections[0].topic, connections[0].msgtype
    kinds = {connection.msgtype for connection in connections}
    if len(kinds) > 1:
        return Topic(name, kind, f"messages of several types ({', '.join(sorted(kinds))})")
    encoding = connections[0].ext.serialization_format if cdr else "ros1"
    if cdr and encoding != "cdr":
        return Topic(name, kind, f"messages encoded as {encoding!r}, not CDR")
    if cdr and raw.startswith(ZSTANDARD):
        return Topic(
            name, kind, "messages compressed one by one; name the folder of the bag, not the file in it"
        )
    try:
        definitions = _definitions(connections[0])
        layout = Walker(raw, definitions, cdr).layout(kind)
    except MalformedError as error:
        return Topic(name, kind, f"in its first message {error}")
    except Exception as error:  # of the library's parser
        return Topic(name, kind, f"a definition of its type that cannot be read ({brief(error)})")
    frame, child = (
        raw[layout.texts.get(field, slice(0))].decode(errors="replace").lstrip("/")
        for field in ("header.frame_id", "child_frame_id")
    )
    return Topic(name, kind, None, definitions, layout, frame, child)


def _definitions(connection: Any) -> Definitions:
    """Types as the file defines them; as ROS 2 does where the file defines none."""
    text, kind = connection.msgdef.data, connection.msgtype
    if connection.msgdef.format == MessageDefinitionFormat.NONE:
        return dict(get_typestore(Stores.LATEST).fielddefs)
    # Parsed only: to register a type, rosbags runs code made of names in the file.
    definitions = dict(get_typestore(Stores.EMPTY).fielddefs)
    if connection.msgdef.format == MessageDefinitionFormat.MSG:
        return definitions | get_types_from_msg(text, kind)
    # One definition, or one for each type under a line that names it.
    parts = [part.split("\n", 1)[1] for part in text.split(RULE)[1:]] if text.startswith(RULE) else [text]
    for part in parts:
        definitions |= get_types_from_idl(part)
    return definitions
