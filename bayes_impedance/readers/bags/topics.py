"""Which topics of a bag hold what: as the configuration names them, else by the type of their messages."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Mapping
from typing import Any

from bayes_impedance.config import Columns, LogConfig
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.readers.bags.bag import Bag, Topic
from bayes_impedance.readers.columns import TIMES

#: Where messages hold a quantity. What carries no stamp or frame is taken too, but no Twist: that is a command.
PLACES: Mapping[str, Mapping[str, str]] = {
    "geometry_msgs/msg/PoseStamped": {"position": "pose.position", "orientation": "pose.orientation"},
    "geometry_msgs/msg/PoseWithCovarianceStamped": {
        "position": "pose.pose.position",
        "orientation": "pose.pose.orientation",
    },
    "geometry_msgs/msg/TransformStamped": {
        "position": "transform.translation",
        "orientation": "transform.rotation",
    },
    "nav_msgs/msg/Odometry": {
        "position": "pose.pose.position",
        "orientation": "pose.pose.orientation",
        "velocity": "twist.twist.linear",
    },
    "geometry_msgs/msg/Pose": {"position": "position", "orientation": "orientation"},
    "geometry_msgs/msg/Transform": {"position": "translation", "orientation": "rotation"},
    "geometry_msgs/msg/TwistStamped": {"velocity": "twist.linear"},
    "geometry_msgs/msg/AccelStamped": {"acceleration": "accel.linear"},
    "geometry_msgs/msg/WrenchStamped": {"force": "wrench.force", "torque": "wrench.torque"},
    "geometry_msgs/msg/Wrench": {"force": "force", "torque": "torque"},
}
#: Found by type, each on a topic of its own; orientation and torque come with position and force.
SOUGHT = ("position", "force", "velocity", "acceleration")
REQUIRED = {
    "position": (
        "a pose (PoseStamped, TransformStamped, Odometry, or one in a field that log.columns.position names, such as "
        '"/robot_state.position[{index}]")'
    ),
    "force": (
        "a wrench (WrenchStamped, or one in the effort of a JointState that log.columns.force names, such as "
        '"/robot_state.effort[{index}]")'
    ),
}


def name_columns(bag: Bag, config: LogConfig) -> tuple[LogConfig, dict[str, LogError]]:
    """`config` with the columns that were found, and what to say of required quantities that no topic holds.

    Raises:
        LogError: a topic that is named is not there or cannot be read, or several topics hold the same.
    """
    columns = {
        key: value
        for key in Columns.model_fields
        if key not in TIMES
        and (value := getattr(config.columns, key)) is not None
        and value != Columns.model_fields[key].default
    }
    columns = _respelled(bag, columns)
    absent = []
    for key in SOUGHT:
        if getattr(config.columns, key) != Columns.model_fields[key].default:
            continue
        if topic := _by_type(bag, key):
            columns[key] = f"{topic.name}.{PLACES[topic.kind][key]}.{{axis}}"
        elif key in REQUIRED:
            absent.append(key)
    for key, parent in (("orientation", "position"), ("torque", "force")):
        if getattr(config.columns, key) == Columns.model_fields[key].default and parent in columns:
            columns |= _beside(bag, key, columns[parent], config.force.rotation)
    _question_frames(bag, columns, config)
    named = config.model_copy(update={"columns": config.columns.model_copy(update=columns)})
    return named, dict.fromkeys(absent, _none(bag, absent))


def _respelled(bag: Bag, columns: Mapping[str, Any]) -> dict[str, Any]:
    """Columns whose topics are spelled as in the file."""
    spelled: dict[str, str] = {}

    def respell(key: str, column: str) -> str:
        topic, dot, field = column.partition(".")
        # One topic an axis: which there are is seen when axes are known.
        if "{" in topic:
            return column
        if topic not in spelled:
            spelled[topic] = _spelled(bag, key, topic)
        return spelled[topic] + dot + field

    return {
        key: tuple(respell(key, part) for part in value) if isinstance(value, tuple) else respell(key, value)
        for key, value in columns.items()
    }


def _spelled(bag: Bag, key: str, name: str) -> str:
    """The topic `name` of the configuration as the file spells it, with or without the slash."""
    other = name[1:] if name.startswith("/") else f"/{name}"
    if name not in bag.topics and other in bag.topics:
        warnings.warn(
            f"{bag.source}: the topic {name!r} of log.columns.{key} is taken to be {other!r}, for there is none of "
            "the former name; write it as in the file",
            LogWarning,
            stacklevel=2,
        )
        name = other
    if name not in bag.topics:
        near = difflib.get_close_matches(name, bag.topics, n=1, cutoff=0.0)
        raise LogError(
            f"{bag.source}: expected topic {name!r}, found none of that name (the nearest is {near[0]!r}); set "
            f"log.columns.{key} to a topic and field in the file: {_listed(bag)}"
        )
    if problem := bag.topics[name].problem:
        raise LogError(
            f"{bag.source}, topic {name!r}: expected messages that can be read, found {problem}; name another "
            f"topic in log.columns.{key}"
        )
    return name


def _by_type(bag: Bag, key: str) -> Topic | None:
    """The one topic whose type holds a quantity; None where there is none."""
    topics = [
        topic
        for topic in bag.topics.values()
        if topic.layout is not None and key in PLACES.get(topic.kind, {})
    ]
    if len(topics) > 1:
        null = ", or set it to null" if key not in REQUIRED else ""
        raise LogError(
            f"{bag.source}: expected one topic that holds {key}, found {len(topics)} "
            f"({', '.join(_described(topic) for topic in topics)}); name the one that is meant in "
            f'log.columns.{key}, such as "{topics[0].name}.{PLACES[topics[0].kind][key]}.{{axis}}"{null}'
        )
    if not topics:
        return None
    (topic,) = topics
    if key == "velocity" and topic.child not in ("", topic.frame):
        warnings.warn(
            f"{bag.source}: {topic.name} gives its twist in the moving frame {topic.child!r}, not in "
            f"{topic.frame!r}, so its velocity is left out; set log.columns.velocity to null, or name the twist "
            "if that frame does not turn",
            LogWarning,
            stacklevel=2,
        )
        return None
    return topic


def _beside(bag: Bag, key: str, template: str, rotation: str) -> dict[str, Any]:
    """Orientation of the message that holds the position, torque of the one that holds the force."""
    name = template.partition(".")[0]
    places = PLACES.get(bag.topics[name].kind, {}) if name in bag.topics else {}
    if key not in places:
        return {}
    path = f"{name}.{places[key]}"
    if key == "torque":
        return {key: f"{path}.{{axis}}"}
    order = rotation.removeprefix("quaternion_")
    return {key: tuple(f"{path}.{part}" for part in order)} if len(order) == 4 else {}


def _question_frames(bag: Bag, columns: Mapping[str, Any], config: LogConfig) -> None:
    """Warn where the wrench may be in the frame of the tool."""
    pose, wrench = (
        bag.topics.get(str(columns.get(key, "")).partition(".")[0]) for key in ("position", "force")
    )
    if config.force.frame != "base" or not pose or not wrench or not pose.frame or not wrench.frame:
        return
    if pose.frame != wrench.frame:
        warnings.warn(
            f"{bag.source}: {wrench.name} is in frame {wrench.frame!r}, {pose.name} in {pose.frame!r}, so the "
            "wrench may turn with the tool; set log.force.frame to tool if it does",
            LogWarning,
            stacklevel=2,
        )


def _none(bag: Bag, absent: list[str]) -> LogError:
    sought = " and ".join(REQUIRED[key] for key in absent)
    return LogError(
        f"{bag.source}: expected {sought}, found no such topic among {_listed(bag)}; record what is missing, or "
        "name the topic and field that hold it"
    )


def _listed(bag: Bag) -> str:
    topics = [_described(topic) for topic in bag.topics.values()]
    return ", ".join(topics[:10]) + (", …" if len(topics) > 10 else "")


def _described(topic: Topic) -> str:
    """A topic with its type, as people write it."""
    problem = f", {topic.problem}" if topic.problem else ""
    return f"{topic.name} ({topic.kind.replace('/msg/', '/')}{problem})"
