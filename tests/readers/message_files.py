"""Bags of ROS 1 and ROS 2 written by rosbags, for tests: messages as nested dictionaries, zero by default."""

import keyword
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from bayes_impedance.config import LogConfig

ENDINGS = (".bag", ".db3", ".mcap")
#: Topic, type, time of arrival [ns], content.
Message = tuple[str, str, int, Mapping[str, Any]]

START = 1_700_000_000_123_456_789

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)


def store_of(ending: str) -> Typestore:
    return ROS1 if ending == ".bag" else ROS2


def build(store: Typestore, kind: str, values: Mapping[str, Any]) -> Any:
    """A message object of rosbags."""

    def value(description: Any, given: Any) -> Any:
        node, what = description
        if node == Nodetype.NAME:
            return build(store, what, given or {})
        if node == Nodetype.BASE:
            return given if given is not None else ("" if what[0] == "string" else 0)
        (inner, name), size = what
        given = given if given is not None else [None] * (size if node == Nodetype.ARRAY else 0)
        if inner == Nodetype.BASE and name[0] != "string":
            dtype = {"bool": "bool", "char": "uint8", "byte": "int8"}.get(name[0], name[0])
            return np.array([0 if item is None else item for item in given], dtype=dtype)
        return [value((inner, name), item) for item in given]

    fields = store.fielddefs[kind][1]
    assert set(values) <= {name for name, _ in fields}, values
    return store.types[kind](
        **{
            (f"{name}_" if keyword.iskeyword(name) else name): value(description, values.get(name))
            for name, description in fields
        }
    )


def write_bag(
    path: Path, messages: Iterable[Message], compression: str | None = None, **options: Any
) -> Path:
    """The file `path` of ROS 1, or for ROS 2 that of its name in a folder beside metadata.yaml; returns its path."""
    store = store_of(path.suffix)
    if path.suffix == ".bag":
        writer: Any = rosbag1.Writer(path)
        if compression is not None:
            writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
    else:
        plugin = {".db3": rosbag2.StoragePlugin.SQLITE3, ".mcap": rosbag2.StoragePlugin.MCAP}[path.suffix]
        folder = path.parent / path.suffix[1:] / path.stem
        folder.parent.mkdir(exist_ok=True)
        writer = rosbag2.Writer(folder, version=options.get("version", 8), storage_plugin=plugin)
        if compression is not None:
            mode = rosbag2.CompressionMode[options.get("mode", "storage").upper()]
            writer.set_compression(mode, rosbag2.CompressionFormat[compression.upper()])
    connections: dict[str, Any] = {}
    with writer:
        for topic, kind, time, values in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            message = build(store, kind, values)
            raw = (store.serialize_ros1 if path.suffix == ".bag" else store.serialize_cdr)(message, kind)
            writer.write(connections[topic], time, raw)
    return path if path.suffix == ".bag" else folder / path.name


# --- messages ------------------------------------------------------------------------------------


def stamp(time: int) -> dict[str, int]:
    return {"sec": time // 10**9, "nanosec": time % 10**9}


def header(time: int, frame: str = "base") -> dict[str, Any]:
    return {"stamp": stamp(time), "frame_id": frame}


def vector(values: Sequence[float]) -> dict[str, float]:
    return dict(zip("xyzw", map(float, values), strict=False))


def pose(
    topic: str, time: int, position: Sequence[float], frame: str = "base", sent: int | None = None
) -> Message:
    content = {"position": vector(position), "orientation": vector((0, 0, 0, 1))}
    return (
        topic,
        "geometry_msgs/msg/PoseStamped",
        time,
        {"header": header(time if sent is None else sent, frame), "pose": content},
    )


def wrench(
    topic: str, time: int, force: Sequence[float], frame: str = "base", sent: int | None = None
) -> Message:
    content = {"force": vector(force), "torque": vector(0.1 * np.asarray(force))}
    return (
        topic,
        "geometry_msgs/msg/WrenchStamped",
        time,
        {"header": header(time if sent is None else sent, frame), "wrench": content},
    )


def joint_state(topic: str, time: int, position: Sequence[float], effort: Sequence[float] = ()) -> Message:
    content = {
        "header": header(time),
        "name": ["a", "bc"],
        "position": list(position),
        "effort": list(effort),
    }
    return topic, "sensor_msgs/msg/JointState", time, content


def odometry(
    topic: str, time: int, position: Sequence[float], velocity: Sequence[float], child: str
) -> Message:
    content = {
        "header": header(time),
        "child_frame_id": child,
        "pose": {"pose": {"position": vector(position), "orientation": vector((0, 0, 0, 1))}},
        "twist": {"twist": {"linear": vector(velocity)}},
    }
    return topic, "nav_msgs/msg/Odometry", time, content


#: Reads what `hidden` gives.
HIDDEN = LogConfig.model_validate(
    {"columns": {"position": "/robot_state.position[{index}]", "force": "/robot_state.effort[{index}]"}}
)


def hidden(n: int = 20) -> list[Message]:
    """A JointState with position and, as effort, force."""
    rng = np.random.default_rng(3)
    return [joint_state("/robot_state", START + 10_000_000 * i, *rng.normal(size=(2, 6))) for i in range(n)]
