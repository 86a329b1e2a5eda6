"""One hour of motion and force at 1 kHz through the command `inspect`: time and peak memory, by format.

Beside it, in the same run, what a library takes for the bare numbers of the same file: pandas for the table, rosbags'
deserialiser (on a fiftieth of the messages) for the bag.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

RATE, HOUR = 1000, 3_600_000
SHARE = 50
MEASURED = """
import resource, sys, time
from bayes_impedance.cli import main
sys.argv = ["bayes-impedance", *sys.argv[1:]]
start = time.perf_counter()
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
print("MEASURED", time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
"""


@pytest.fixture(scope="module")
def hour() -> pd.DataFrame:
    """A person who moves a robot of 3 kg and 12 Ns/m along three axes, with 10 µm and 50 mN of noise."""
    rng = np.random.default_rng(0)
    clock = np.arange(HOUR) / RATE
    table = {"time": clock}
    tones = np.array([0.7, 1.3, 2.9, 7.1])[:, None]
    for index, axis in enumerate("xyz"):
        angles = tones * clock + index * tones
        velocity = (0.05 * np.cos(angles)).sum(axis=0)
        acceleration = (-0.05 * tones * np.sin(angles)).sum(axis=0)
        table[f"position_{axis}"] = (0.05 * np.sin(angles) / tones).sum(axis=0) + 1e-5 * rng.normal(size=HOUR)
        table[f"force_{axis}"] = 3.0 * acceleration + 12.0 * velocity + 0.05 * rng.normal(size=HOUR)
    return pd.DataFrame(table)


def write_csv(hour: pd.DataFrame, path: Path) -> None:
    hour.to_csv(path, index=False, float_format="%.7g")


def write_parquet(hour: pd.DataFrame, path: Path) -> None:
    hour.to_parquet(path, index=False)


def write_hdf5(hour: pd.DataFrame, path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["time"] = hour["time"].to_numpy()
        for name in ("position", "force"):
            file[name] = hour[[f"{name}_{axis}" for axis in "xyz"]].to_numpy()


def write_mcap(hour: pd.DataFrame, path: Path) -> None:
    """A JointState a millisecond, its numbers put into the bytes of a first one: serialising each would take longer."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    types, name = store.types, "sensor_msgs/msg/JointState"
    stamp = types["builtin_interfaces/msg/Time"](0, 0)
    header = types["std_msgs/msg/Header"](stamp, "base")
    zeros = np.zeros(3)
    first = bytes(store.serialize_cdr(types[name](header, [], zeros + 1.0, np.zeros(0), zeros + 2.0), name))
    at = [first.index(np.full(3, value).tobytes()) for value in (1.0, 2.0)]
    raw = np.tile(np.frombuffer(first, dtype=np.uint8), (HOUR, 1))
    nanoseconds = np.round(hour["time"].to_numpy() * 1e9).astype(np.int64)
    stamps = np.stack([nanoseconds // 10**9, nanoseconds % 10**9], axis=1)
    raw[:, 4:12] = stamps.astype("<u4").view(np.uint8)
    for start, quantity in zip(at, ("position", "force"), strict=True):
        values = np.ascontiguousarray(hour[[f"{quantity}_{axis}" for axis in "xyz"]].to_numpy())
        raw[:, start : start + 24] = values.view(np.uint8)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/robot_state", name, typestore=store)
        for now, message in zip(nanoseconds.tolist(), raw, strict=True):
            writer.write(connection, now + 10**15, message.tobytes())


def bare_csv(path: Path) -> float:
    start = time.perf_counter()
    pd.read_csv(path)
    return time.perf_counter() - start


def bare_mcap(path: Path) -> float:
    """Seconds for all messages, by a share of them."""
    with AnyReader([path]) as reader:
        start = time.perf_counter()
        for connection, _, raw in islice(reader.messages(), HOUR // SHARE):
            reader.deserialize(raw, connection.msgtype)
        return SHARE * (time.perf_counter() - start)


JOINTS = [
    f"--set=log.columns.{key}=/robot_state.{field}[{{index}}]"
    for key, field in (("position", "position"), ("force", "effort"))
]
FORMATS: dict[str, tuple[Callable[[pd.DataFrame, Path], None], list[str], Callable[[Path], float] | None]] = {
    "csv": (write_csv, ["--config", "time"], bare_csv),
    "parquet": (write_parquet, ["--config", "time"], None),
    "h5": (
        write_hdf5,
        ["--config", "time", *(f"--set=log.columns.{key}={key}[{{index}}]" for key in ("position", "force"))],
        None,
    ),
    "mcap": (write_mcap, ["--config", "time", *JOINTS], bare_mcap),
}


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("ending", FORMATS)
def test_an_hour_at_1_khz(figures, hour, tmp_path, ending):
    write, arguments, bare = FORMATS[ending]
    path = tmp_path / (f"hour.{ending}" if ending != "mcap" else "hour")
    write(hour, path)
    figure = ["--figure", str(tmp_path / "hour.png")]
    printed = subprocess.run(
        [sys.executable, "-c", MEASURED, "inspect", str(path), *arguments, *figure],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    _, seconds, gigabytes = printed.splitlines()[-1].split()
    figures[f"inspect_hour_at_1khz_{ending}"] = {
        "seconds": float(seconds),
        "peak_gigabytes": float(gigabytes),
    }
    if bare is not None:
        numbers = bare(path)
        figures[f"inspect_hour_at_1khz_{ending}"] |= {
            "bare_numbers_seconds": numbers,
            "ratio": float(seconds) / numbers,
        }
