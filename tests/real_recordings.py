"""The real recordings as plain arrays, read without the package's own readers."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import scipy.io
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Recording:
    """One run in SI units; `force` is the human's on the robot in the base frame, `sensed` what was logged."""

    name: str
    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    force: np.ndarray
    sensed: np.ndarray
    angles: np.ndarray | None = None


def read_bag(path: Path, topic: str = "/robot_state") -> Recording:
    """A bag of gp_mpc: effort is the wrench in the tool frame, with the sign of the tool on the human."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([path], default_typestore=get_typestore(Stores.ROS1_NOETIC)) as reader:
        connections = [connection for connection in reader.connections if connection.topic == topic]
        messages = [
            reader.deserialize(raw, connection.msgtype) for connection, _, raw in reader.messages(connections)
        ]
    stamps = [message.header.stamp for message in messages]
    # From the first stamp, for a float of seconds since 1970 holds only microseconds.
    time = np.array([(s.sec - stamps[0].sec) + 1e-9 * (s.nanosec - stamps[0].nanosec) for s in stamps])
    position = np.array([message.position for message in messages])
    effort = [message.effort[:3] if len(message.effort) else [np.nan] * 3 for message in messages]
    sensed, angles = np.array(effort), position[:, 3:6]
    force = -Rotation.from_euler("ZYZ", angles).apply(sensed)
    velocity = np.array([message.velocity[:3] for message in messages])
    name = f"{path.parent.name}/{path.stem}"
    return Recording(name, time, position[:, :3], velocity, force, sensed, angles)


def read_panda(folder: Path) -> list[Recording]:
    """Six tracings of a symbol at 1 kHz."""
    (cells,) = scipy.io.loadmat(folder / "panda_comanipulation" / "symbol_17_data.mat")["symbol_data"]
    recordings = []
    for index, (position, velocity, force) in enumerate(cells):
        time = 1e-3 * np.arange(position.shape[1])
        recordings.append(Recording(f"panda/{index}", time, position.T, velocity.T, force.T, force.T))
    return recordings


def read_delta(folder: Path) -> Recording:
    """Somebody pushes a delta robot; millimetres in the file."""
    table = pd.read_csv(folder / "delta_robot" / "pHRI_test_experiment_dataset.csv")
    force = table[["Fx", "Fy", "Fz"]].to_numpy()
    position, velocity = table[["x", "y", "z"]].to_numpy(), table[["vx", "vy", "vz"]].to_numpy()
    return Recording("delta", table["t"].to_numpy(), 1e-3 * position, 1e-3 * velocity, force, force)


def read_iiwa(folder: Path) -> Recording:
    """An arm presses on an environment; the file holds the force of the environment on the robot."""
    (path,) = (folder / "iiwa_known_equilibrium").glob("*.txt")
    table = pd.read_csv(path, sep="\t")
    force = table[["f_x", "f_y", "f_z"]].to_numpy()
    position, velocity = table[["x", "y", "z"]].to_numpy(), table[["dx", "dy", "dz"]].to_numpy()
    return Recording("iiwa", table["time"].to_numpy(), position, velocity, -force, force)
