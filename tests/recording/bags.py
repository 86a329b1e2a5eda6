"""Messages of the real recordings: their stamps, motion and force."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class States:
    """Messages of the robot's state: stamps [s], position [m], angles [rad] and wrench `(n, 3)` in the tool frame."""

    sent: Array
    received: Array
    position: Array
    angles: Array
    wrench: Array

    @property
    def human_force(self) -> Array:
        """Force of the human on the robot in the base frame [N]."""
        return -Rotation.from_euler("ZYZ", self.angles).apply(self.wrench)


def states(path: Path, topic: str = "robot_state") -> States:
    """All messages of one topic, with or without a slash in front of its name."""
    highlevel = pytest.importorskip("rosbags.highlevel")
    typesys = pytest.importorskip("rosbags.typesys")
    rows = []
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    with highlevel.AnyReader([path], default_typestore=store) as reader:
        chosen = [c for c in reader.connections if c.topic.strip("/") == topic]
        for connection, received, raw in reader.messages(connections=chosen):
            message = reader.deserialize(raw, connection.msgtype)
            sent = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
            effort = message.effort[:3] if len(message.effort) else np.full(3, np.nan)
            rows.append([sent, 1e-9 * received, *message.position[:6], *effort])
    table = np.array(rows)
    return States(table[:, 0], table[:, 1], table[:, 2:5], table[:, 5:8], table[:, 8:11])
