"""The clock of a stream: what its stamps are like, which clock is chosen, and how far two clocks are apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bags import Array, states
from scipy.optimize import linprog

from bayes_impedance.config.log import ClockConfig
from bayes_impedance.errors import LogError
from bayes_impedance.recording.clock import StreamClock, choose_clock
from bayes_impedance.recording.offset import ClockOffset, compare_clocks, lower_line

DROP = ClockConfig(duplicates="drop")


def delays(n: int, interval: float, generator: np.random.Generator, bursts: int = 5) -> Array:
    """Exponential with mean 2 ms; in a burst, messages wait for up to 50 ms and then arrive together."""
    delay = generator.exponential(0.002, n)
    held = round(0.05 / interval)
    for first in generator.integers(0, n - held, bursts):
        delay[first : first + held] = np.maximum(
            delay[first : first + held], interval * np.arange(held, 0, -1)
        )
    return delay


def messages(
    rate: float, duration: float, offset: float, drift: float, seed: int, bursts: int = 5
) -> tuple[Array, Array, Array]:
    """True times on the recorder's clock, stamps of a sender's clock that is off, and arrivals."""
    generator = np.random.default_rng(seed)
    true = 1000.0 + np.arange(0.0, duration, 1.0 / rate)
    sent = 1000.0 + offset + (1.0 + 1e-6 * drift) * (true - 1000.0)
    return true, sent, true + delays(len(true), 1.0 / rate, generator, bursts)


def against(clock: StreamClock) -> ClockOffset:
    assert clock.report.against_recorder is not None
    return clock.report.against_recorder


# --- two clocks ----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_lower_line_solves_the_linear_program(seed: int) -> None:
    generator = np.random.default_rng(seed)
    x = np.sort(generator.uniform(0, 10, 300))
    x[1::7] = x[:-1:7]
    y = 0.3 - 0.02 * x + generator.exponential(0.1, 300)
    # Maximise a mean over all points, a + b x ≤ y.
    solution = linprog(
        [-1.0, -x.mean()], A_ub=np.stack([np.ones(300), x], axis=1), b_ub=y, bounds=[(None, None)] * 2
    )
    start, slope = lower_line(x, y)
    assert start + slope * x.mean() == pytest.approx(-solution.fun, abs=1e-9)
    np.testing.assert_allclose([start, slope], solution.x, atol=1e-7)


@pytest.mark.parametrize("rate", [200.0, 1000.0])
@pytest.mark.parametrize(("offset", "drift"), [(0.37, 200.0), (-362.0, -80.0), (0.37, 0.0)])
def test_offset_and_drift_are_found_through_one_sided_delays_and_bursts(
    rate: float, offset: float, drift: float
) -> None:
    for seed in range(5):
        _, sent, received = messages(rate, 20.0, offset, drift, seed)
        found = compare_clocks(sent, received)
        # The least of n exponential delays is 2 ms / n: a twentieth of a millisecond is many of that.
        assert found.offset == pytest.approx(offset, abs=5e-5)
        assert found.drift == pytest.approx(drift, abs=10.0)
        assert found.transport == pytest.approx(0.002, rel=0.5)


def test_a_line_through_the_middle_would_take_a_burst_for_drift() -> None:
    _, sent, received = messages(200.0, 20.0, 0.37, 200.0, seed=0)
    received[:400] += np.linspace(0.1, 0.0, 400)
    slope = np.polyfit(sent - sent[0], received - sent, 1)[0]
    assert abs(-1e6 * slope - 200.0) > 500.0
    assert compare_clocks(sent, received).drift == pytest.approx(200.0, abs=10.0)


@pytest.mark.parametrize("rate", [200.0, 1000.0])
def test_standard_errors_are_those_of_many_recordings(rate: float) -> None:
    found = [compare_clocks(*messages(rate, 10.0, 0.37, 200.0, seed, bursts=0)[1:]) for seed in range(60)]
    stated = np.median([(one.delay_error, one.drift_error) for one in found], axis=0)
    actual = np.std([(one.delay, one.drift) for one in found], axis=0)
    # A bootstrap of a minimum knows its scale, not more.
    assert np.all(np.abs(np.log(stated / actual)) < np.log(2.0))


def test_times_go_to_the_recorder_and_back() -> None:
    true, sent, received = messages(200.0, 20.0, 0.37, 200.0, seed=1)
    found = compare_clocks(sent, received)
    np.testing.assert_allclose(found.to_recorder(sent), true, atol=1e-4)
    np.testing.assert_allclose(found.to_sender(found.to_recorder(sent)), sent, rtol=0, atol=1e-9)


# --- one clock -----------------------------------------------------------------------------------


def test_a_regular_stream_is_described() -> None:
    generator = np.random.default_rng(0)
    sent = np.arange(500) / 100.0 + generator.normal(0, 1e-4, 500)
    report = choose_clock(sent, None, ClockConfig()).report
    assert (report.n, report.gaps, report.duplicates, report.backwards) == (500, (), 0, 0)
    assert report.rate == pytest.approx(100.0, rel=1e-2)
    # The difference of two stamps has √2 times the SD of one.
    assert report.jitter == pytest.approx(np.sqrt(2) * 1e-4, rel=0.15)
    assert (report.source, report.why) == ("header", "the only clock there is")
    assert report.against_recorder is None and report.remark == "only one clock was recorded"


def test_gaps_are_listed_and_one_lost_message_is_none() -> None:
    time = np.delete(np.arange(300) / 100.0, [50, *range(100, 140), 200, 201])
    gaps = choose_clock(time, None, ClockConfig()).report.gaps
    np.testing.assert_allclose(gaps, [(0.99, 0.41), (1.99, 0.03)], atol=1e-9)


def test_duplicates_are_refused_or_dropped() -> None:
    time = np.arange(100) / 100.0
    time[[10, 11, 60]] = time[[9, 9, 59]]
    with pytest.raises(
        LogError, match="stamps that differ, found 3 equal to the one before, first 0.090000 s"
    ):
        choose_clock(time, None, ClockConfig(), "a.csv")
    clock = choose_clock(time, None, DROP)
    np.testing.assert_array_equal(clock.kept, np.delete(np.arange(100), [10, 11, 60]))
    np.testing.assert_array_equal(clock.time, time[clock.kept])
    assert clock.report.duplicates == 3


def test_a_header_with_duplicates_is_still_the_clock() -> None:
    _, sent, received = messages(200.0, 5.0, 0.37, 0.0, seed=0)
    sent[7] = sent[6]
    clock = choose_clock(sent, received, DROP)
    assert clock.report.source == "header" and len(clock.time) == len(sent) - 1
    assert against(clock).offset == pytest.approx(0.37, abs=1e-4)


def test_a_header_that_goes_back_makes_way_for_the_record() -> None:
    _, sent, received = messages(200.0, 5.0, 0.37, 0.0, seed=0, bursts=0)
    received = np.sort(received)
    sent[300:] -= 1.0
    clock = choose_clock(sent, received, ClockConfig())
    assert (clock.report.source, clock.report.backwards) == ("record", 1)
    assert clock.report.why == "header stamps go back at message 300"
    np.testing.assert_array_equal(clock.time, received)
    with pytest.raises(
        LogError, match="a.bag: expected header stamps that do not go back, found .* at message 300"
    ):
        choose_clock(sent, received, ClockConfig(source="header"), "a.bag")


@pytest.mark.parametrize("stamp", [0.0, 12.5])
def test_a_constant_header_makes_way_for_the_record(stamp: float) -> None:
    received = np.arange(100) / 100.0
    clock = choose_clock(np.full(100, stamp), received, ClockConfig())
    assert clock.report.source == "record"
    assert clock.report.why == f"header stamps are all {stamp:g} s"
    assert clock.report.against_recorder is None and clock.report.remark == clock.report.why


@pytest.mark.parametrize("received", [np.full(100, 7.0), np.linspace(7.0, 7.01, 100)])
def test_arrivals_all_at_once_say_nothing_of_the_clock(received: Array) -> None:
    clock = choose_clock(5.0 + np.arange(100) / 100.0, received, ClockConfig())
    assert clock.report.source == "header" and clock.against_recorder is None
    assert clock.report.remark.endswith("they tell when messages were written, not when they arrived")


def test_two_messages_are_enough_for_a_clock() -> None:
    clock = choose_clock(np.array([5.0, 5.1]), np.array([7.0, 7.1]), ClockConfig())
    assert against(clock).offset == pytest.approx(-2.0)


def test_the_configuration_may_choose() -> None:
    _, sent, received = messages(200.0, 5.0, 0.37, 0.0, seed=0, bursts=0)
    clock = choose_clock(sent, np.sort(received), ClockConfig(source="record"))
    assert (clock.report.source, clock.report.why) == ("record", "log.clock.source says so")
    assert clock.against_recorder is not None and clock.against_recorder.offset == 0.0


def test_stamps_that_are_no_numbers_are_refused() -> None:
    time = np.arange(10.0)
    time[4] = np.nan
    with pytest.raises(
        LogError, match="found nan at message 4; repair the recording, or choose the other clock"
    ):
        choose_clock(time, None, ClockConfig(), "a.csv")


@pytest.mark.parametrize("n", [0, 1])
def test_one_message_has_no_clock(n: int) -> None:
    with pytest.raises(LogError, match=f"expected at least two messages at different times, found {n}"):
        choose_clock(np.zeros(n), None, ClockConfig())


# --- real recordings -----------------------------------------------------------------------------


def of_bag(path: Path) -> StreamClock:
    read = states(path)
    return choose_clock(read.sent, read.received, ClockConfig(), path.name)


def test_a_header_minutes_away_from_the_record(shared_data: Path) -> None:
    clock = of_bag(shared_data / "gp_mpc" / "acc_rail" / "1.bag")
    assert clock.report.source == "header"
    assert against(clock).offset == pytest.approx(362.367, abs=1e-3)
    assert abs(against(clock).drift) < 30.0
    assert against(clock).transport < 1e-3


def test_bursts_of_arrivals_leave_a_regular_header(shared_data: Path) -> None:
    path = shared_data / "gp_mpc" / "acc_twobag" / "r1.bag"
    read = states(path)
    assert np.diff(read.received).max() > 0.14
    clock = of_bag(path)
    assert (clock.report.source, clock.report.gaps) == ("header", ())
    assert clock.report.interval == pytest.approx(0.0202, abs=1e-4)
    assert abs(against(clock).drift) < 30.0


def test_record_times_of_a_copy_say_nothing_of_the_clock(shared_data: Path) -> None:
    clock = of_bag(shared_data / "gp_mpc" / "loader_edge_cases" / "contact_var_man_00_no_state_topic.bag")
    assert (clock.report.n, clock.report.source) == (350, "header")
    assert clock.report.span == pytest.approx(3.57, abs=0.01)
    assert clock.report.against_recorder is None and clock.against_recorder is None
    assert clock.report.remark.startswith("record stamps span 0.0485 s where header stamps span 3.57 s")


def test_a_gap_in_a_recording_is_listed(shared_data: Path) -> None:
    clock = of_bag(shared_data / "gp_mpc" / "loader_edge_cases" / "var_wd_cc_1_590ms_gap.bag")
    lengths = [length for _, length in clock.report.gaps]
    assert max(lengths) == pytest.approx(0.574, abs=0.001)


def test_a_drift_in_a_recording_is_that_of_the_least_delays(shared_data: Path) -> None:
    path = shared_data / "gp_mpc" / "loader_edge_cases" / "var_wd_cc_1_590ms_gap.bag"
    read = states(path)
    elapsed, delay = read.sent - read.sent[0], read.received - read.sent
    parts = np.array_split(np.arange(len(delay)), 20)
    least = [part[np.argmin(delay[part])] for part in parts]
    slope = np.polyfit(elapsed[least], delay[least], 1)[0]
    assert against(of_bag(path)).drift == pytest.approx(-1e6 * slope, abs=10.0)
    assert -1e6 * slope < -150.0


def test_thirty_messages_are_few_for_a_drift_and_say_so(shared_data: Path) -> None:
    clock = of_bag(shared_data / "gp_mpc" / "loader_edge_cases" / "polish_flat2_2_only31msgs.bag")
    assert abs(against(clock).drift) < 4 * against(clock).drift_error
    assert against(clock).drift_error > 50.0
