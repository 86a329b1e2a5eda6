"""Several streams on one clock: alignment of senders, rates that differ, orientation, gaps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bags import states
from scipy.spatial.transform import Rotation
from test_clock import Array, messages

from bayes_impedance.config.log import ClockConfig
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.recording.clock import choose_clock
from bayes_impedance.recording.offset import RECORDER
from bayes_impedance.recording.synchronise import Stream, on_clock_of, synchronise

TONES = np.array([0.3, 1.1, 2.7, 4.0])


def signal(time: Array) -> Array:
    """Force of up to 4 Hz `(n, 2)` [N]."""
    angle = 2 * np.pi * TONES * (time[:, None] - 1000.0)
    return 3.0 * np.stack([np.sin(angle).sum(axis=1), np.cos(angle).sum(axis=1)], axis=1)


def stream(
    name: str, rate: float, offset: float, drift: float, seed: int, duration: float = 20.0
) -> tuple[Stream, Array]:
    """A stream of `signal` by a sender whose clock is off, and its true times."""
    true, sent, received = messages(rate, duration, offset, drift, seed)
    clock = choose_clock(sent, received, ClockConfig())
    return Stream(name, clock.time, signal(true), against_recorder=clock.against_recorder), true


def plain(name: str, time: Array) -> Stream:
    return Stream(name, time, signal(time))


# --- clocks --------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_force_of_another_sender_comes_to_its_true_time(seed: int) -> None:
    motion, true = stream("motion", 200.0, -12.0, -50.0, seed)
    force, _ = stream("force", 1000.0, -12.0 + 0.37, 150.0, seed + 100)
    result = synchronise(motion, [force])
    np.testing.assert_array_equal(result.time, motion.time[result.rows])
    assert len(result.rows) >= len(true) - 5
    # Sum of 4 tones of 3 N: the fastest changes by 75 N/s, so that .05 ms are .01 N; averaging takes off .1 %.
    np.testing.assert_allclose(result.columns["force"], signal(true[result.rows]), atol=0.02)
    np.testing.assert_array_equal(result.columns["motion"], motion.columns[result.rows])
    # Without alignment .37 s are lost, and what is left is another force.
    apart = synchronise(motion, [force], align=False)
    assert np.abs(apart.columns["force"] - signal(true[apart.rows])).max() > 5.0


def test_offset_and_drift_between_two_senders_vanish() -> None:
    motion, _ = stream("motion", 200.0, -12.0, -50.0, 0)
    force, true = stream("force", 1000.0, -11.63, 150.0, 100)
    mapped = on_clock_of(motion, force)
    wanted = 1000.0 - 12.0 + (1.0 - 50e-6) * (true - 1000.0)
    # 10 % of .37 s and of 200 ppm over 20 s are 37 and .4 ms.
    np.testing.assert_allclose(mapped, wanted, rtol=0, atol=1e-4)


def test_two_topics_of_one_sender_keep_their_stamps() -> None:
    motion, _ = stream("motion", 200.0, 5.0, 30.0, 0)
    force, _ = stream("force", 1000.0, 5.0, 30.0, 1)
    assert on_clock_of(motion, force) is force.time


def test_two_topics_of_a_real_recording_keep_their_stamps(shared_data: Path) -> None:
    streams = []
    for topic in ("robot_state", "joint_state"):
        read = states(shared_data / "gp_mpc" / "acc_twobag" / "r1.bag", topic)
        clock = choose_clock(read.sent, read.received, ClockConfig())
        streams.append(Stream(topic, clock.time, read.position, against_recorder=clock.against_recorder))
    assert on_clock_of(*streams) is streams[1].time
    result = synchronise(streams[0], streams[1:])
    # Arrivals of one topic pause for .14 s; the stamps do not.
    assert result.left_out == {"joint_state": 0} and result.outside <= 2


def test_a_header_and_a_record_clock_meet() -> None:
    motion, true = stream("motion", 200.0, 5.0, 30.0, 0)
    force = replace(plain("force", 1000.0 + np.arange(20_000) / 1000.0), against_recorder=RECORDER)
    result = synchronise(motion, [force])
    np.testing.assert_allclose(result.columns["force"], signal(true[result.rows]), atol=0.02)


def test_a_clock_that_nothing_tells_is_taken_as_it_is() -> None:
    motion, _ = stream("motion", 200.0, 0.0, 0.0, 0)
    force = plain("force", motion.time)
    with pytest.warns(
        LogWarning, match="motion and force: expected arrivals that tell both clocks, found none"
    ):
        result = synchronise(motion, [force])
    np.testing.assert_allclose(result.columns["force"], force.columns, atol=1e-12)
    assert len(synchronise(motion, [force], align=False).rows) == len(motion.time)


# --- rates ---------------------------------------------------------------------------------------


def test_a_faster_stream_is_averaged_without_lag_and_without_aliasing() -> None:
    base = plain("motion", np.arange(0.0, 10.0, 0.02))
    fast = np.arange(0.0, 10.0, 0.001)
    # 49 Hz would be seen as 1 Hz in samples at 50 Hz.
    noisy = Stream("force", fast, signal(fast) + 5.0 * np.sin(2 * np.pi * 49.0 * fast)[:, None])
    result = synchronise(base, [noisy])
    error = result.columns["force"] - signal(result.time)
    picked = np.interp(result.time, fast, noisy.columns[:, 0]) - signal(result.time)[:, 0]
    assert np.abs(picked).max() > 4.9
    # A mean over 20 ms leaves sin(π .98)/(π .98) = 2 % of it, and takes 1 % off 4 Hz.
    assert np.abs(error).max() < 0.25


def test_an_average_is_that_of_the_samples_around() -> None:
    base = plain("motion", np.arange(0.0, 10.0, 0.05) + 0.003)
    fast = np.arange(0.0, 10.0, 0.001)
    force = Stream("force", fast, np.random.default_rng(0).normal(size=(len(fast), 1)).cumsum(axis=0))
    result = synchronise(base, [force])
    for t, value in zip(result.time[::20], result.columns["force"][::20], strict=True):
        fine = np.linspace(t - 0.025, t + 0.025, 2001)
        expected = np.trapezoid(np.interp(fine, fast, force.columns[:, 0]), fine) / 0.05
        assert value[0] == pytest.approx(expected, abs=0.02)


def test_a_slower_stream_is_interpolated() -> None:
    base = plain("motion", 1000.0 + np.arange(0.0, 10.0, 0.005))
    slow = plain("force", 1000.0 + np.arange(0.0, 10.0, 0.02))
    result = synchronise(base, [slow])
    # Cubics between samples 20 ms apart of 3 N at 4 Hz; the limiter flattens peaks.
    np.testing.assert_allclose(result.columns["force"], signal(result.time), atol=0.3)
    on_sample = np.isin(result.time, slow.time)
    np.testing.assert_allclose(result.columns["force"][on_sample], signal(result.time[on_sample]), atol=1e-9)


def test_only_the_common_span_remains() -> None:
    base = plain("motion", np.arange(0.0, 10.0, 0.01))
    early = plain("early", np.arange(-1.0, 8.0, 0.01))
    late = plain("late", np.arange(2.0, 12.0, 0.01))
    result = synchronise(base, [early, late])
    assert (result.time[0], result.time[-1]) == (pytest.approx(2.0), pytest.approx(7.99))
    assert result.outside == 400 and result.left_out == {"early": 0, "late": 0}


def test_streams_that_do_not_overlap_are_refused() -> None:
    base = plain("motion", np.arange(0.0, 10.0, 0.01))
    other = plain("force", np.arange(100.0, 110.0, 0.01))
    sentence = (
        r"a.bag: expected motion and force to overlap in time, found 0 to 9.99 s and 100 to 109.99 s; set"
    )
    with pytest.raises(LogError, match=sentence):
        synchronise(base, [other], place="a.bag")


# --- gaps ----------------------------------------------------------------------------------------


def test_no_force_is_made_up_in_a_gap() -> None:
    base = plain("motion", np.arange(1, 2000) / 200.0)
    fast = np.arange(10_001) / 1000.0
    # 4 messages lost are bridged, 200 are not.
    fast = np.delete(fast, [*range(2000, 2004), *range(5001, 5200)])
    result = synchronise(base, [plain("force", fast)])
    # Windows of 5 ms that reach into the gap from 5.000 to 5.200 s.
    lost = (base.time + 0.0025 > 5.0) & (base.time - 0.0025 < 5.2)
    assert result.left_out == {"force": int(lost.sum())}
    np.testing.assert_array_equal(result.rows, np.flatnonzero(~lost))
    np.testing.assert_allclose(result.columns["force"], signal(result.time), atol=0.1)


def test_samples_that_are_no_numbers_are_missing() -> None:
    base = plain("motion", np.arange(1, 1000) / 100.0)
    other = plain("force", np.arange(1001) / 100.0)
    other.columns[501:510, 1] = np.nan
    result = synchronise(base, [other])
    assert result.left_out == {"force": 9}
    np.testing.assert_allclose(result.columns["force"], signal(result.time), atol=1e-9)
    other.columns[1:] = np.nan
    with pytest.raises(LogError, match="expected force to hold at least two samples of numbers, found 1"):
        synchronise(base, [other])


def test_the_caller_decides_what_a_gap_is() -> None:
    base = plain("motion", np.arange(1, 1000) / 100.0)
    other = plain("force", np.delete(np.arange(1001) / 100.0, range(501, 510)))
    assert synchronise(base, [other]).left_out == {"force": 9}
    assert synchronise(base, [other], max_gap=0.2).left_out == {"force": 0}


def test_streams_without_a_common_time_outside_gaps_are_refused() -> None:
    base = plain("motion", 5.0 + np.arange(20) / 100.0)
    other = plain("force", np.concatenate([np.arange(500) / 100.0, 6.0 + np.arange(500) / 100.0]))
    with pytest.raises(
        LogError, match="expected times at which motion, force all have samples, found none outside"
    ):
        synchronise(base, [other])


# --- orientation ---------------------------------------------------------------------------------


def spinning(time: Array) -> Rotation:
    """Two thirds of a turn a second about a slanted axis: angles wrap and quaternions change sign."""
    axis = np.array([1.0, 2.0, 2.0]) / 3.0
    return Rotation.from_rotvec(4.2 * time[:, None] * axis)


@pytest.mark.parametrize("rotation", ["quaternion_xyzw", "quaternion_wxyz", "ZYZ", "xyz"])
def test_orientation_turns_the_shorter_way(rotation: str) -> None:
    slow = np.arange(0.013, 6.0, 0.05)
    if rotation.startswith("quaternion"):
        columns = spinning(slow).as_quat(canonical=True, scalar_first=rotation.endswith("wxyz"))
        columns[::3] *= -1.0
    else:
        columns = spinning(slow).as_euler(rotation)  # type: ignore[call-overload]
    base = plain("motion", np.arange(0.1, 5.9, 0.005))
    result = synchronise(base, [Stream("pose", slow, columns, rotation=rotation)])
    found = result.columns["pose"]
    if rotation.startswith("quaternion"):
        turned = Rotation.from_quat(found, scalar_first=rotation.endswith("wxyz"))
    else:
        turned = Rotation.from_euler(rotation, found)
    # A steady turn is met exactly.
    np.testing.assert_allclose((turned * spinning(result.time).inv()).magnitude(), 0.0, atol=1e-9)


def test_angles_that_are_not_unique_still_tell_the_orientation() -> None:
    slow = np.arange(0.0, 2.0, 0.1)
    angles = np.stack([0.3 * slow, np.zeros_like(slow), 0.2 * slow], axis=1)
    base = plain("motion", np.arange(0.0, 1.9, 0.01))
    result = synchronise(base, [Stream("pose", slow, angles, rotation="ZYZ")])
    turned = Rotation.from_euler("ZYZ", result.columns["pose"])
    np.testing.assert_allclose(turned.as_rotvec(), np.outer(result.time, [0.0, 0.0, 0.5]), atol=1e-9)
