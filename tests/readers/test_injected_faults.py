"""Faults of real recorders, injected into simulated recordings and undone by reading them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from recorded import (
    Array,
    arrivals,
    bag,
    columns,
    forces,
    guided,
    only,
    poses,
    read,
    rms,
    with_z,
    wrenches,
)
from scipy.interpolate import make_interp_spline

from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.inspection.findings import look_at
from bayes_impedance.log import Trial
from bayes_impedance.recording.plausibility import Sign, SignCheck

OFFSET, DRIFT = 0.37, 200e-6
#: 10 % of 12 ms.
LAG, TOLERANCE = 0.012, 1.2e-3


def force_at(trial: Trial, time: Array) -> Array:
    """The true force of a trial at some times [s] since its start."""
    assert trial.force is not None
    return np.asarray(make_interp_spline(trial.time, trial.force)(time))


# --- two clocks ----------------------------------------------------------------------------------


def of_two_senders(path: Path, duration: float = 30.0) -> Path:
    """Poses at 200 Hz and wrenches at 1 kHz, whose sender's clock is off; both arrive late and in bursts."""
    (trial,) = guided()
    assert trial.force is not None
    generator = np.random.default_rng(1)
    n = round(1000 * duration)
    time, motion = trial.time[:n], trial.time[:n:5]
    moving = poses(motion, arrivals(motion, generator), with_z(trial.position[:n:5], 0.01 * np.sin(motion)))
    sent = OFFSET + (1 + DRIFT) * time
    return bag(path, moving, wrenches(sent, arrivals(time, generator), with_z(trial.force[:n])))


@pytest.mark.parametrize("ending", [".bag", ".mcap"])
def test_clocks_of_two_senders_are_put_right(tmp_path: Path, ending: str) -> None:
    (truth,) = guided()
    file = of_two_senders(tmp_path / f"log{ending}")
    reading = read(file, axes=["x", "y"])
    pose, wrench = (reading.sensed.clocks[name].against_recorder for name in ("/pose", "/ft"))
    assert pose is not None and wrench is not None
    # The shortest way of a message, some microseconds, cannot be told from the clock.
    assert pose.offset == pytest.approx(0.0, abs=1e-4) and pose.drift == pytest.approx(0.0, abs=10)
    assert wrench.offset == pytest.approx(OFFSET, rel=0.1)
    assert wrench.drift == pytest.approx(1e6 * DRIFT, rel=0.1)
    trial = only(reading)
    assert trial.n_samples > 0.98 * 6000
    error = trial.force - force_at(truth, trial.time)
    assert rms(error) < 0.02 * rms(truth.force)
    # Without: force comes .37 s too late, and stands in no relation to motion.
    late = only(read(file, axes=["x", "y"], clock={"align": False}))
    assert rms(late.force - force_at(truth, late.time)) > 0.3 * rms(truth.force)
    since = late.time[late.time > 1.0]
    shifted = late.force[late.time > 1.0] - force_at(truth, (since - OFFSET) / (1 + DRIFT))
    assert rms(shifted) < 0.02 * rms(truth.force)


def test_stamp_of_another_clock_meets_messages_without_one(tmp_path: Path) -> None:
    (truth,) = guided()
    n = 5000
    time, motion = truth.time[:n], truth.time[:n:5]
    moving = poses(motion - 12.0, motion, with_z(truth.position[:n:5]))
    trial = only(
        read(bag(tmp_path / "log.bag", moving, forces(time, with_z(truth.force[:n]))), axes=["x", "y"])
    )
    assert trial.n_samples > 900
    assert rms(trial.force - force_at(truth, trial.time)) < 0.02 * rms(truth.force)


def test_a_window_on_messages_counts_from_the_first_position(tmp_path: Path) -> None:
    (truth,) = guided()
    file = of_two_senders(tmp_path / "log.bag", duration=6.0)
    trial = only(read(file, axes=["x", "y"], window={"start": 2.0, "end": 4.0}))
    assert trial.time[0] == pytest.approx(2.0, abs=1e-6) and trial.time[-1] == pytest.approx(3.995, abs=1e-6)
    assert rms(trial.force - force_at(truth, trial.time)) < 0.03 * rms(truth.force)


# --- lag -----------------------------------------------------------------------------------------


def late(trial: Trial, lag: float = LAG, every: int = 1) -> dict[str, Array]:
    """Columns of a log whose force is `lag` [s] late."""
    assert trial.perturbation is not None
    time = trial.time[::every]
    force = force_at(trial, np.clip(time - lag, trial.time[0], trial.time[-1]))
    return columns(
        time=time, position=trial.position[::every], force=force, perturbation=trial.perturbation[::every]
    )


def as_csv(path: Path, tables: list[dict[str, Array]]) -> Path:
    parts = [pd.DataFrame(table).assign(trial=f"t{k}") for k, table in enumerate(tables)]
    pd.concat(parts).to_csv(path, index=False)
    return path


@pytest.mark.parametrize("trials", [1, 2])
def test_lag_is_found_and_removed_in_a_table(tmp_path: Path, trials: int) -> None:
    file = as_csv(tmp_path / "log.csv", [late(trial, every=5) for trial in guided(trials)])
    with pytest.warns(LogWarning, match=r"log.csv: force is logged 1[123]\.\d ± .* ms after the motion it"):
        reading = read(file, force={"lag": "estimate"})
    assert reading.preparation.lag is not None and reading.preparation.lag.determined
    assert reading.preparation.lag.lag == pytest.approx(LAG, abs=TOLERANCE)
    assert len(reading.trials) == trials
    for trial, truth in zip(reading.trials, guided(trials), strict=True):
        # The end of each trial would need force of later.
        assert trial.time[0] == truth.time[0] and trial.time[-1] == pytest.approx(
            truth.time[-1] - 0.016, abs=6e-3
        )
        whole = late(truth, every=5)
        np.testing.assert_array_equal(trial.position[:, 0], whole["position_x"][: trial.n_samples])
        before = rms(whole["force_x"] - force_at(truth, whole["time"])[:, 0])
        after = rms(trial.force[:, 0] - force_at(truth, trial.time)[:, 0])
        assert after < 0.15 * before


@pytest.mark.parametrize("trials", [1, 2])
def test_lag_that_is_known_is_removed_as_it_is(tmp_path: Path, trials: int) -> None:
    file = as_csv(tmp_path / "log.csv", [late(trial) for trial in guided(trials)])
    reading = read(file, force={"lag": LAG})
    for trial, truth in zip(reading.trials, guided(trials), strict=True):
        # Twelve samples of a thousand a second; numbers are written to the last digit.
        assert trial.n_samples in (truth.n_samples - 12, truth.n_samples - 13)
        np.testing.assert_allclose(trial.force, force_at(truth, trial.time), atol=1e-6)
        np.testing.assert_array_equal(trial.position, truth.position[: trial.n_samples])


def test_lag_is_found_and_removed_in_a_bag(tmp_path: Path) -> None:
    (truth,) = guided(perturbed=False)
    force = force_at(truth, np.clip(truth.time - LAG, 0, None))
    position = with_z(truth.position)
    file = bag(
        tmp_path / "log.mcap",
        poses(truth.time, truth.time, position),
        wrenches(truth.time, truth.time, with_z(force)),
    )
    with pytest.warns(
        LogWarning, match="after the motion it belongs to, which is removed; to keep this value, set"
    ):
        reading = read(file, axes=["x", "y"], force={"lag": "estimate"})
    assert reading.preparation.lag is not None
    assert reading.preparation.lag.lag == pytest.approx(LAG, abs=TOLERANCE)
    trial = only(reading)
    left = rms(trial.force - force_at(truth, trial.time))
    # The controller holds force for its step of 1 ms, half of which looks like a lag; between samples lies noise.
    assert left < 0.15 * rms(force - force_at(truth, truth.time))
    exact = only(read(file, axes=["x", "y"], force={"lag": LAG}))
    np.testing.assert_allclose(exact.force, force_at(truth, exact.time), atol=1e-4)


def test_a_log_that_does_not_tell_its_lag_is_left_as_it_is(tmp_path: Path) -> None:
    time = np.arange(0.0, 60.0, 0.01)
    table = columns(time=time, position=0.1 * np.sin(time)[:, None], force=3.0 * np.cos(time)[:, None])
    file = as_csv(tmp_path / "log.csv", [table])
    with pytest.warns(
        LogWarning, match=r"lag between force and motion cannot be told \(.*\) and is taken for zero"
    ):
        reading = read(file, force={"lag": "estimate"})
    assert reading.preparation.lag is not None and not reading.preparation.lag.determined
    np.testing.assert_array_equal(only(reading).force[:, 0], table["force_x"])


def test_a_log_of_two_samples_does_not_tell_its_lag(tmp_path: Path) -> None:
    table = columns(time=np.array([0.0, 0.1]), position=np.eye(2), force=np.eye(2))
    file = as_csv(tmp_path / "log.csv", [table])
    with pytest.warns(LogWarning, match="cannot be told"):
        assert only(read(file, force={"lag": "estimate"})).n_samples == 2


def test_a_log_of_one_sample_is_refused_for_that(tmp_path: Path) -> None:
    table = columns(time=np.zeros(1), position=np.zeros((1, 2)), force=np.zeros((1, 2)))
    file = as_csv(tmp_path / "log.csv", [table])
    with (
        pytest.warns(LogWarning, match=r"cannot be told \(expected at least two samples, found 1\)"),
        pytest.raises(LogError, match="expected at least two samples, found one sample"),
    ):
        read(file, force={"lag": "estimate"})


@pytest.mark.parametrize("direction", [0.0, -1.0])
def test_times_that_do_not_increase_are_refused_for_that(tmp_path: Path, direction: float) -> None:
    table = columns(time=direction * np.arange(50.0), position=np.eye(50)[:, :2], force=np.eye(50)[:, :2])
    with (
        pytest.warns(
            LogWarning, match=r"cannot be told \(expected times that increase, found most that do not\)"
        ),
        pytest.raises(LogError, match="log.csv, trial 't0'.*time"),
    ):
        read(as_csv(tmp_path / "log.csv", [table]), force={"lag": "estimate"})


def test_a_lag_as_long_as_the_log_is_refused(tmp_path: Path) -> None:
    table = columns(time=0.1 * np.arange(10), position=np.arange(10.0)[:, None], force=np.ones((10, 1)))
    with pytest.raises(
        LogError, match="log.csv: expected a log longer than the lag of its force, found a lag of 1 s; change"
    ):
        read(as_csv(tmp_path / "log.csv", [table]), force={"lag": 1.0})


def test_stamps_that_repeat_do_not_cut_a_log_to_pieces(tmp_path: Path) -> None:
    (truth,) = guided()
    table = pd.DataFrame(late(truth)).iloc[:5000]
    twice = table.loc[table.index.repeat(1 + (np.arange(len(table)) % 10 == 0))]
    twice.to_csv(tmp_path / "log.csv", index=False)
    trial = only(read(tmp_path / "log.csv", force={"lag": LAG}, clock={"duplicates": "drop"}))
    assert trial.n_samples >= 5000 - 13
    np.testing.assert_allclose(trial.force, force_at(truth, trial.time), atol=1e-6)


def test_lag_of_trials_whose_rows_lie_apart(tmp_path: Path) -> None:
    tables = [
        pd.DataFrame(late(trial)).iloc[:2000].assign(trial=name)
        for trial, name in zip(guided(2), "ab", strict=True)
    ]
    pd.concat(tables).sort_index(kind="stable").to_csv(tmp_path / "log.csv", index=False)
    reading = read(tmp_path / "log.csv", force={"lag": LAG})
    for trial, truth in zip(reading.trials, guided(2), strict=True):
        assert trial.n_samples >= 1987
        np.testing.assert_allclose(trial.force, force_at(truth, trial.time), atol=1e-6)


def test_lag_of_trials_without_time(tmp_path: Path) -> None:
    tables = [
        pd.DataFrame(late(trial)).iloc[:2000].assign(trial=name)
        for trial, name in zip(guided(2), "ab", strict=True)
    ]
    pd.concat(tables).drop(columns="time").to_csv(tmp_path / "log.csv", index=False)
    log = {"columns": {"time": None}, "sampling_rate": 1000.0}
    reading = read(tmp_path / "log.csv", force={"lag": LAG}, **log)
    for trial, truth in zip(reading.trials, guided(2), strict=True):
        assert trial.time[0] == 0.0 and trial.n_samples >= 1987
        np.testing.assert_allclose(trial.force, force_at(truth, trial.time), atol=1e-6)


# --- sign ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("flipped", "direction"), [(False, "robot_on_human"), (True, "human_on_robot"), (True, "robot_on_human")]
)
def test_a_reversed_sign_is_seen_on_a_passive_robot(tmp_path: Path, flipped: bool, direction: str) -> None:
    (truth,) = guided(perturbed=False)
    every = slice(None, None, 5)
    force = truth.force[every] * (-1.0 if flipped else 1.0)
    table = columns(time=truth.time[every], position=truth.position[every], force=force)
    reading = read(as_csv(tmp_path / "log.csv", [table]), force_direction=direction)
    reversed_ = [finding for finding in look_at(reading) if isinstance(finding, SignCheck)]
    wrong = flipped == (direction == "human_on_robot")
    assert [check.sign for check in reversed_] == ([Sign.REVERSED] if wrong else [])
    assert all("set log.force_direction to the other" in check.sentence for check in reversed_)
