"""Streams of one file onto the times of position: stamps, gaps, rates, windows, labels, units; what is refused."""

from __future__ import annotations

import tracemalloc
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
from message_files import Message, vector
from recorded import START, Array, bag, columns, forces, only, poses, read, rms, wrenches
from scipy.spatial.transform import Rotation

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.readers import read_log
from bayes_impedance.readers.read import open_file
from bayes_impedance.readers.samples import read_samples


def position_at(time: Array) -> Array:
    return 0.1 * np.sin(np.array([1.1, 1.7, 0.9]) * time[:, None])


def force_at(time: Array) -> Array:
    return 5.0 * np.cos(np.array([2.0, 1.3, 3.1]) * time[:, None])


def as_hdf5(path: Path, arrays: Mapping[str, Any]) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values
    return path


def as_npz(path: Path, arrays: Mapping[str, Any]) -> Path:
    np.savez(path, **arrays)
    return path


def as_csv(path: Path, arrays: Mapping[str, Any]) -> Path:
    pd.DataFrame(arrays).to_csv(path, index=False)
    return path


def as_parquet(path: Path, arrays: Mapping[str, Any]) -> Path:
    frame = pd.DataFrame(arrays)
    # What is left of a longer table keeps its index.
    frame.index = pd.Index(np.arange(7, 7 + 3 * len(frame), 3))
    frame.to_parquet(path)
    return path


WRITERS = {".h5": as_hdf5, ".npz": as_npz, ".csv": as_csv, ".parquet": as_parquet}
LINE = np.arange(0.0, 4.0, 0.01)


def table(time: Array = LINE, **others: Any) -> dict[str, Any]:
    return columns(time=time, position=position_at(time), force=force_at(time)) | others


# --- stamps that repeat --------------------------------------------------------------------------


def test_equal_stamps_in_a_table_are_refused_or_dropped(tmp_path: Path) -> None:
    twice = {name: np.repeat(values, 1 + (np.arange(400) % 50 == 20)) for name, values in table().items()}
    labelled = pd.DataFrame(twice)
    # The first sample of a trial is none that repeats, whatever the last of the one before.
    both = pd.concat([labelled.assign(trial="a"), labelled.assign(time=lambda t: t.time + 3.99, trial="b")])
    file = as_csv(tmp_path / "log.csv", both)
    with pytest.raises(LogError, match="log.csv, trial 'a'.*time"):
        read(file)
    reading = read(file, clock={"duplicates": "drop"})
    assert [trial.n_samples for trial in reading.trials] == [400, 400]
    # Whoever inspects the file wants to know of them.
    assert len(reading.sensed.time) == 816
    for trial in reading.trials:
        np.testing.assert_array_equal(trial.force, force_at(LINE))


def test_equal_stamps_of_trials_whose_rows_lie_apart(tmp_path: Path) -> None:
    two = pd.concat([pd.DataFrame(table()).assign(trial=name) for name in "ab"]).sort_index(kind="stable")
    reading = read(as_csv(tmp_path / "log.csv", two), clock={"duplicates": "drop"})
    assert [trial.n_samples for trial in reading.trials] == [400, 400]
    np.testing.assert_array_equal(reading.trials[1].rows.numbers[:3], [3, 5, 7])


@pytest.mark.parametrize("topic", ["/pose", "/ft"])
def test_equal_stamps_of_messages_are_refused_or_dropped(tmp_path: Path, topic: str) -> None:
    arrival = LINE
    stamps = {name: LINE.copy() for name in ("/pose", "/ft")}
    stamps[topic][50::100] = stamps[topic][49::100]
    file = bag(
        tmp_path / "log.bag",
        poses(stamps["/pose"], arrival, position_at(LINE)),
        wrenches(stamps["/ft"], arrival, force_at(LINE)),
    )
    with pytest.raises(
        LogError,
        match=f"log.bag, {topic}: expected header stamps that differ, found 4 equal to the one before",
    ):
        read(file)
    reading = read(file, clock={"duplicates": "drop"})
    assert reading.sensed.clocks[topic].duplicates == 4
    trial = only(reading)
    assert trial.n_samples == (396 if topic == "/pose" else 400)
    np.testing.assert_allclose(trial.force, force_at(trial.time), atol=2e-3)


# --- rates and gaps ------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", [".bag", ".db3", ".mcap"])
@pytest.mark.parametrize("rate", [30.0, 100.0, 1000.0])
def test_force_at_another_rate_than_the_pose(tmp_path: Path, ending: str, rate: float) -> None:
    time = 0.003 + np.arange(0.0, 4.0, 1 / rate)
    file = bag(
        tmp_path / f"log{ending}",
        poses(LINE, LINE, position_at(LINE)),
        wrenches(time, time, force_at(time)),
    )
    trial = only(read(file))
    assert trial.n_samples >= 395
    np.testing.assert_allclose(trial.position, position_at(trial.time), atol=1e-9)
    # Monotone cubics flatten a peak by up to ω² h² / 8 of it.
    np.testing.assert_allclose(
        trial.force, force_at(trial.time), atol=5 * (3.1 / min(rate, 100)) ** 2 / 8 + 1e-6
    )


def test_samples_in_a_gap_of_a_topic_are_left_out_with_a_word(tmp_path: Path) -> None:
    time = np.arange(0.0, 4.0, 0.005)
    there = (time < 1.0) | (time > 1.5)
    file = bag(
        tmp_path / "log.bag",
        poses(LINE, LINE, position_at(LINE), Rotation.identity(len(LINE))),
        wrenches(time[there], time[there], force_at(time[there])),
    )
    # Force and torque share their gap: one warning.
    with pytest.warns(
        LogWarning, match="^log.bag: 5[01] samples of /pose lie in gaps of /ft and are left out"
    ) as caught:
        trial = only(read(file, force={"frame": "tool"}))
    assert len(caught) == 1
    assert not ((trial.time > 1.0) & (trial.time < 1.495)).any()
    np.testing.assert_allclose(trial.force, force_at(trial.time), atol=2e-3)


def test_streams_that_do_not_overlap_are_refused(tmp_path: Path) -> None:
    file = bag(
        tmp_path / "log.bag",
        poses(LINE, LINE, position_at(LINE)),
        wrenches(LINE + 5.0, LINE + 5.0, force_at(LINE)),
    )
    with pytest.raises(
        LogError, match=r"log.bag: expected /pose and /ft \(force\) to overlap in time, found 0 to"
    ):
        read(file)


@pytest.mark.parametrize("n", [1, 2])
def test_a_window_of_a_sample_or_two(tmp_path: Path, n: int) -> None:
    file = bag(
        tmp_path / "log.bag", poses(LINE, LINE, position_at(LINE)), wrenches(LINE, LINE, force_at(LINE))
    )
    window = {"start": 0.995, "end": 0.995 + 0.01 * n}
    if n == 1:
        with pytest.raises(
            LogError, match="log.bag: expected at least two samples of /pose, found 1; widen log.wind"
        ):
            read(file, window=window)
    else:
        assert only(read(file, window=window)).n_samples == 2


def test_a_window_without_samples_names_what_the_file_spans(tmp_path: Path) -> None:
    file = bag(
        tmp_path / "log.bag", poses(LINE, LINE, position_at(LINE)), wrenches(LINE, LINE, force_at(LINE))
    )
    with pytest.raises(
        LogError,
        match=r"expected samples within log.window \(start 10.0, end None s\), found none, for the file spans 0",
    ):
        read(file, window={"start": 10})


@pytest.mark.parametrize("which", ["/pose", "/ft"])
def test_a_window_cuts_what_is_no_number_in_any_stream(tmp_path: Path, which: str) -> None:
    time = np.arange(0.0, 4.0, 0.002)
    position, force = position_at(LINE), force_at(time)
    (position if which == "/pose" else force)[:10] = np.nan
    file = bag(tmp_path / "log.bag", poses(LINE, LINE, position), wrenches(time, time, force))
    with pytest.raises(LogError, match="expected finite numbers, found nan or an empty cell at messages? 1"):
        read(file)
    trial = only(read(file, window={"start": 1.0}))
    np.testing.assert_allclose(trial.force, force_at(trial.time), atol=1e-3)


# --- time stamps of the sensor -------------------------------------------------------------------


@pytest.mark.parametrize("ending", [".h5", ".npz"])
def test_a_sensor_with_time_stamps_and_a_length_of_its_own(tmp_path: Path, ending: str) -> None:
    fast = np.arange(0.0, 4.0, 0.002)
    arrays = {"time": LINE, "position": position_at(LINE), "force_time": fast, "force": force_at(fast)}
    names = {"position": "position[{index}]", "force": "force[{index}]", "force_time": "force_time"}
    file = WRITERS[ending](tmp_path / f"log{ending}", arrays)
    reading = read(file, columns=names)
    trial = only(reading)
    assert trial.n_samples >= 398
    np.testing.assert_allclose(trial.position, position_at(trial.time), atol=1e-12)
    np.testing.assert_allclose(trial.force, force_at(trial.time), atol=1e-3)
    assert sorted(clock.n for clock in reading.sensed.clocks.values()) == [400, 2000]
    # Without them nobody knows when force was measured.
    with pytest.raises(
        LogError,
        match=rf"log{ending}: expected as many samples of force as of time, which tells their time, found 2000 and "
        "another number; name their time stamps in log.columns.force_time",
    ):
        read(file, columns=names | {"force_time": None})
    with pytest.raises(
        LogError,
        match="as many samples of force as of position, which tells their time, found 2000 and another",
    ):
        read(file, columns=names | {"force_time": None, "time": None}, sampling_rate=100.0)
    with pytest.raises(
        LogError, match="position as of force_time, .* name their time stamps in log.columns.time"
    ):
        read(file, columns=names | {"force_time": None, "time": "force_time"})


@pytest.mark.parametrize("ending", WRITERS)
def test_a_sensor_with_time_stamps_of_its_own_beside_those_of_position(tmp_path: Path, ending: str) -> None:
    # As many samples, 4 ms late and in ms as everything else.
    arrays = table() | columns(force=force_at(LINE - 0.004))
    arrays |= {"time": 1e3 * LINE, "force_time": 1e3 * (LINE - 0.004)}
    file = WRITERS[ending](tmp_path / f"log{ending}", arrays)
    trial = only(read(file, columns={"force_time": "force_time"}, units={"time": "ms"}))
    assert trial.n_samples == 399
    np.testing.assert_allclose(trial.force, force_at(trial.time), atol=1e-3)
    np.testing.assert_array_equal(trial.position, position_at(LINE)[:399])


def test_trials_in_one_table_with_time_stamps_of_the_sensor_are_refused(tmp_path: Path) -> None:
    both = pd.concat([pd.DataFrame(table(force_time=LINE)).assign(trial=name) for name in "ab"])
    with pytest.raises(
        LogError,
        match=r"log.csv, position, trial: expected times that do not go back, for samples at two sets of time stamps .*"
        "found 0 s after 3.99 s at line 402; write a file for each trial",
    ):
        read(as_csv(tmp_path / "log.csv", both), columns={"force_time": "force_time"})


def test_labels_go_with_position_where_the_sensor_has_its_own_time(tmp_path: Path) -> None:
    arrays = table(
        repetition=np.arange(400) // 200, phase=(np.arange(400) % 200) / 200, force_time=LINE + 0.001
    )
    trial = only(read(as_csv(tmp_path / "log.csv", arrays), columns={"force_time": "force_time"}))
    kept = trial.n_samples
    np.testing.assert_array_equal(trial.repetition, (np.arange(400) // 200)[400 - kept :])
    np.testing.assert_allclose(trial.phase, arrays["phase"][400 - kept :])


@pytest.mark.parametrize("key", ["phase", "trial"])
def test_a_label_of_another_stream_is_refused(tmp_path: Path, key: str) -> None:
    topic = (("/label", "std_msgs/msg/Float64", START + round(1e9 * t), {"data": t / 4}) for t in LINE)
    file = bag(
        tmp_path / "log.bag",
        poses(LINE, LINE, position_at(LINE)),
        wrenches(LINE, LINE, force_at(LINE)),
        topic,
    )
    with pytest.raises(
        LogError,
        match=f"log.bag: expected {key} at the times of position, found it elsewhere; write it beside position, or set "
        f"log.columns.{key} to null",
    ):
        read(file, columns={key: "/label.data"})


def points(topic: str) -> Iterator[Message]:
    for time in LINE:
        yield topic, "geometry_msgs/msg/Vector3", START + round(1e9 * time), vector((time, time, time))


def test_position_of_two_topics_is_refused(tmp_path: Path) -> None:
    file = bag(
        tmp_path / "log.bag",
        *(points(f"/{axis}") for axis in "xy"),
        wrenches(LINE, LINE, force_at(LINE)),
    )
    with pytest.raises(
        LogError,
        match=r"log.bag: expected the columns of position at the same times, found /x.x, /y.x in /x, /y; name columns "
        "of one of them in log.columns.position",
    ):
        read(file, axes=["x", "y"], columns={"position": "/{axis}.x"})


def test_velocity_of_another_length_is_refused(tmp_path: Path) -> None:
    arrays = {
        "time": LINE,
        "position": position_at(LINE),
        "force": force_at(LINE),
        "v": position_at(LINE)[1:],
    }
    names = {"position": "position[{index}]", "force": "force[{index}]", "velocity": "v[{index}]"}
    with pytest.raises(
        LogError, match="as many samples of velocity as of time, .* set log.columns.velocity to null"
    ):
        read(as_hdf5(tmp_path / "log.h5", arrays), columns=names)


# --- clocks --------------------------------------------------------------------------------------


def test_clocks_that_cannot_be_told_are_questioned_once(tmp_path: Path) -> None:
    # All of it written at the end: arrival tells nothing.
    written = np.linspace(9.0, 9.01, len(LINE))
    file = bag(
        tmp_path / "log.bag", poses(LINE, LINE, position_at(LINE)), wrenches(LINE, written, force_at(LINE))
    )
    with pytest.warns(
        LogWarning, match="^/pose and /ft: expected arrivals that tell both clocks, found none of use for /ft"
    ) as caught:
        trial = only(read(file, force={"frame": "tool"}))
    assert len(caught) == 1
    np.testing.assert_allclose(trial.force, force_at(trial.time), atol=1e-6)


def test_two_topics_without_stamps_share_the_clock_of_their_arrival(tmp_path: Path) -> None:
    position = (
        ("/pose", "geometry_msgs/msg/Pose", START + round(1e9 * t), {"position": vector(p)})
        for t, p in zip(LINE, position_at(LINE), strict=True)
    )
    trial = only(read(bag(tmp_path / "log.bag", position, forces(LINE + 0.004, force_at(LINE + 0.004)))))
    assert trial.n_samples == 399
    np.testing.assert_allclose(trial.force, force_at(trial.time), atol=2e-3)


# --- without time, units -------------------------------------------------------------------------


def test_samples_without_time_begin_anew_in_each_trial(tmp_path: Path) -> None:
    arrays = table()
    del arrays["time"]
    both = pd.concat([pd.DataFrame(arrays).assign(trial=name) for name in ("a", "b")])
    file = as_csv(tmp_path / "log.csv", both)
    log = {"columns": {"time": None}, "sampling_rate": 100.0}
    for trial in read(file, **log).trials:
        np.testing.assert_allclose(trial.time, LINE, atol=1e-12)
    apart = as_csv(tmp_path / "apart.csv", both.sort_index(kind="stable"))
    for trial in read(apart, **log).trials:
        np.testing.assert_allclose(trial.time, LINE, atol=1e-12)
        np.testing.assert_array_equal(trial.force, force_at(LINE))
    # A window is a part of each trial.
    for trial in read(file, window={"start": 1.0, "end": 2.0}, **log).trials:
        np.testing.assert_allclose(trial.position, position_at(LINE[100:200]))


def test_angles_in_degrees_turn_the_force_of_another_stream(tmp_path: Path) -> None:
    angles = np.stack([0.5 * np.sin(LINE), 0.6 + 0.3 * np.cos(LINE), 3.0 * LINE], axis=1)
    rotation = Rotation.from_euler("ZYZ", angles)
    wrapped = np.rad2deg(np.mod(angles + np.pi, 2 * np.pi) - np.pi)
    # The angles have the sensor's time stamps beside them, position its own.
    arrays = columns(time=LINE, position=position_at(LINE), force=rotation.inv().apply(force_at(LINE)))
    arrays |= dict(zip("abc", wrapped.T, strict=True)) | {"force_time": LINE}
    log = {
        "columns": {"orientation": ["a", "b", "c"]},
        "units": {"angle": "deg", "torque": "mNm"},
        "force": {"frame": "tool", "rotation": "ZYZ"},
    }
    file = as_csv(tmp_path / "log.csv", arrays)
    np.testing.assert_allclose(only(read(file, **log)).force, force_at(LINE), atol=1e-9)
    with pytest.warns(LogWarning, match="log.units.angle"):
        wrong = only(read(file, **log | {"units": {}}))
    assert rms(wrong.force - force_at(LINE)) > 1.0


def test_units_and_direction_hold_in_every_stream(tmp_path: Path) -> None:
    fast = np.arange(0.0, 4.0, 0.002)
    arrays = {"time": LINE, "p": 1e3 * position_at(LINE), "f_t": fast, "f": -1e3 * force_at(fast)}
    names = {"position": "p[{index}]", "force": "f[{index}]", "force_time": "f_t"}
    trial = only(
        read(
            as_npz(tmp_path / "log.npz", arrays),
            columns=names,
            units={"position": "mm", "force": "mN"},
            force_direction="robot_on_human",
        )
    )
    np.testing.assert_allclose(trial.position, position_at(trial.time), atol=1e-9)
    np.testing.assert_allclose(trial.force, force_at(trial.time), atol=1e-3)


# --- memory --------------------------------------------------------------------------------------


def test_a_plain_table_is_not_copied_more_than_once(tmp_path: Path) -> None:
    n = 200_000
    time = np.arange(n) / 1000.0
    file = as_npz(tmp_path / "log.npz", table(time))
    config = LogConfig()
    (opened,) = open_file(file, file.name, config).tables
    wanted = {
        "time": ("time",),
        "position": ("position_x", "position_y", "position_z"),
        "force": ("force_x", "force_y", "force_z"),
    }
    streams = opened.load([name for names in wanted.values() for name in names], set())
    kept = type(opened)(opened.source, opened.columns, lambda *_: streams)
    tracemalloc.start()
    samples = read_samples(kept, wanted, config)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # Position and force as (n, 3), the mask of the window, and a check of a column.
    assert peak < 8 * n * (6 + 1.5)
    assert np.shares_memory(samples.rows.numbers, streams[0].rows.numbers)


def test_a_plain_log_is_not_copied_by_what_it_does_not_need(tmp_path: Path) -> None:
    reading = read(as_npz(tmp_path / "log.npz", table()))
    (trial,) = reading.trials
    assert np.shares_memory(trial.force, reading.sensed.values["force"])
    assert np.shares_memory(trial.time, reading.sensed.time)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_log(tmp_path / "log.npz").n_samples == 400


# --- what a file cannot give ---------------------------------------------------------------------


def test_stamps_of_a_sender_that_are_asked_for_and_are_not_there(tmp_path):
    position = poses(LINE, LINE, position_at(LINE))
    path = bag(tmp_path / "log.bag", position, forces(LINE + 0.004, force_at(LINE)))
    with pytest.raises(
        LogError, match="expected messages with the stamps of their sender, as log.clock.source"
    ):
        read(path, clock={"source": "header"})


def test_most_of_a_recording_without_force_is_said_to_be_left_out(tmp_path):
    half = LINE[LINE < 2.0]
    path = bag(
        tmp_path / "log.bag", poses(LINE, LINE, position_at(LINE)), wrenches(half, half, force_at(half))
    )
    with pytest.warns(LogWarning, match="samples of /pose lie before or after those of /ft and are left out"):
        trial = only(read(path))
    assert trial.time[-1] == pytest.approx(half[-1])
