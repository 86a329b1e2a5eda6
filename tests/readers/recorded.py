"""What a perfect recorder would have written, and the files that faulty ones write of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from message_files import Message, header, vector, write_bag
from scipy.spatial.transform import Rotation

from bayes_impedance.config import LogConfig
from bayes_impedance.log import Trial
from bayes_impedance.readers.read import as_log, open_file, read_tables
from bayes_impedance.readers.trials import Reading
from bayes_impedance.simulation.arm import arm_with
from bayes_impedance.simulation.device import IDEAL, BandLimitedForce, Perturbation, Unperturbed
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.subjects import Subject
from bayes_impedance.simulation.tasks import FigureEight

Array = npt.NDArray[np.float64]

#: When bags begin [ns].
START = 1_700_000_000_000_000_000
GRAVITY = np.array([0.0, 0.0, -9.81])


@cache
def guided(trials: int = 1, perturbed: bool = True) -> tuple[Trial, ...]:
    """Trials of 30 s at 1 kHz of a simulated person who guides a robot, x and y, by sensors without noise."""
    perturbation: Perturbation = BandLimitedForce(2.0) if perturbed else Unperturbed()
    person = Subject("P", arm_with("low"))
    experiment = Experiment(
        [person], FigureEight(), trials=trials, perturbation=perturbation, sensors=IDEAL, rate=1000.0
    )
    return simulate(experiment, seed=0).trials


def with_z(vectors: Array, z: Array | float = 0.0) -> Array:
    """Vectors `(n, 2)` with a third component."""
    return np.column_stack([vectors, np.broadcast_to(z, len(vectors))])


def arrivals(sent: Array, generator: np.random.Generator) -> Array:
    """Delays of 2 ms in the mean; in five bursts messages wait for up to 50 ms. None overtakes another."""
    delay = generator.exponential(0.002, len(sent))
    held = round(0.05 / float(np.median(np.diff(sent))))
    for first in generator.integers(0, len(sent) - held, 5):
        burst = slice(first, first + held)
        delay[burst] = np.maximum(delay[burst], sent[first + held] - sent[burst])
    return np.asarray(np.maximum.accumulate(sent + delay))


# --- files ---------------------------------------------------------------------------------------


def _nanoseconds(times: Array) -> list[int]:
    return [START + round(1e9 * time) for time in times]


def poses(
    sent: Array, received: Array, position: Array, rotation: Rotation | None = None, topic: str = "/pose"
) -> Iterator[Message]:
    """Stamped poses `(n, 3)`; times [s] count from START."""
    quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (len(sent), 1)) if rotation is None else rotation.as_quat()
    for stamp, time, p, q in zip(
        _nanoseconds(sent), _nanoseconds(received), position, quaternions, strict=True
    ):
        pose = {"position": vector(p), "orientation": vector(q)}
        yield topic, "geometry_msgs/msg/PoseStamped", time, {"header": header(stamp), "pose": pose}


def wrenches(
    sent: Array, received: Array, force: Array, torque: Array | None = None, topic: str = "/ft"
) -> Iterator[Message]:
    """Stamped wrenches `(n, 3)`; times [s] count from START."""
    torque = np.zeros_like(force) if torque is None else torque
    for stamp, time, f, t in zip(_nanoseconds(sent), _nanoseconds(received), force, torque, strict=True):
        wrench = {"force": vector(f), "torque": vector(t)}
        yield topic, "geometry_msgs/msg/WrenchStamped", time, {"header": header(stamp), "wrench": wrench}


def forces(received: Array, force: Array, topic: str = "/ft") -> Iterator[Message]:
    """Wrenches without a stamp of their sender."""
    for time, f in zip(_nanoseconds(received), force, strict=True):
        yield topic, "geometry_msgs/msg/Wrench", time, {"force": vector(f)}


def bag(path: Path, *topics: Iterator[Message]) -> Path:
    """A bag of several topics in the order of arrival."""
    return write_bag(path, sorted((m for topic in topics for m in topic), key=lambda message: message[2]))


def columns(**vectors: Array) -> dict[str, Array]:
    """Arrays `(n,)` and `(n, a)` as columns: position becomes position_x, position_y …"""
    named: dict[str, Array] = {}
    for key, values in vectors.items():
        named |= (
            {key: values}
            if values.ndim == 1
            else {f"{key}_{a}": v for a, v in zip("xyzw", values.T, strict=False)}
        )
    return named


# --- reading -------------------------------------------------------------------------------------


def read(file: Path, require_force: bool = True, **log: Any) -> Reading:
    """The one recording of a file, whose trials make up a log."""
    (reading,) = read_tables(open_file(file, file.name, LogConfig.model_validate(log)), require_force)
    as_log([reading])
    return reading


def only(reading: Reading) -> Trial:
    """The one trial."""
    (trial,) = as_log([reading]).trials
    return trial


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


# --- a tool on a sensor --------------------------------------------------------------------------

TOOL = {
    "mass": 1.8,
    "center_of_mass": np.array([0.02, -0.01, 0.07]),
    "bias": np.array([3.0, -2.0, 5.0]),
    "torque_bias": np.array([0.1, -0.2, 0.05]),
}


def handled(rate: float = 200.0, brisk: float = 0.0, seed: int = 0, sign: float = 1.0) -> Mapping[str, Any]:
    """40 s of a tool that turns by ±40°, the first 20 s without contact, and what the sensor in its frame reads.

    `brisk` [m]: the hand shakes by as much at 2 Hz. Force of the human, tool, position are in closed form; the sensor
    has noise of .1 N and 10 mNm. `sign` −1 for a sensor that reads the force of the robot on the human.
    """
    generator = np.random.default_rng(seed)
    time = np.arange(0.0, 40.0, 1.0 / rate)
    angles = np.deg2rad(40.0) * np.stack(
        [np.sin(0.9 * time), np.sin(0.7 * time + 1), np.sin(0.5 * time + 2)], axis=1
    )
    rotation = Rotation.from_euler("ZYX", angles)
    omega = np.array([0.8, 1.1, 0.6])
    shake = 2 * np.pi * 2.0
    phase = np.array([0.0, 1.0, 2.0])
    slow, fast = omega * time[:, None] + phase, shake * time[:, None] + phase
    position = 0.1 * np.sin(slow) + brisk * np.sin(fast)
    acceleration = -0.1 * omega**2 * np.sin(slow) - brisk * shake**2 * np.sin(fast)
    human = 8.0 * np.sin(np.array([2.0, 2.7, 1.4]) * time[:, None]) * np.clip(time - 20.0, 0.0, 1.0)[:, None]
    weight = TOOL["mass"] * rotation.inv().apply(GRAVITY - acceleration)
    force = rotation.inv().apply(human) + weight + TOOL["bias"]
    torque = np.cross(TOOL["center_of_mass"], weight) + TOOL["torque_bias"]
    force = sign * (force + 0.1 * generator.standard_normal(force.shape))
    torque = sign * (torque + 0.01 * generator.standard_normal(torque.shape))
    return {
        "time": time,
        "position": position,
        "rotation": rotation,
        "human": human,
        "force": force,
        "torque": torque,
    }


def identify(**log: Any) -> dict[str, Any]:
    """The configuration that finds the tool."""
    return {"frame": "tool", "tool": {"identify": {"start": 0, "end": 20}}} | log
