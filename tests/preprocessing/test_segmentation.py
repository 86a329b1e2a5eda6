"""Trials and repetitions from motion: known rests, gaps and rounds, with noise and uneven steps."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bayes_impedance.config import PreprocessingConfig
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.log import InteractionLog, RowNumbers, Trial, trial_arrays
from bayes_impedance.preprocessing import prepare, segment


def config(max_gap=0.5, **segmentation):
    return PreprocessingConfig(segmentation=segmentation, max_gap=max_gap)


def stroke(time, start, duration, length):
    """Minimum-jerk motion of `length` [m] from `start` [s] on, at rest before and after."""
    s = np.clip((time - start) / duration, 0.0, 1.0)
    return length * s**3 * (10 - 15 * s + 6 * s**2)


def sampled(duration, rate=100.0, uneven=0.0, seed=0):
    n = round(duration * rate) + 1
    return (np.arange(n) + np.random.default_rng(seed).uniform(-uneven, uneven, n)) / rate


def make(time, position, noise=0.0, seed=0, **optional):
    position = np.asarray(position, dtype=float)
    position = position[:, None] if position.ndim == 1 else position
    position = position + noise * np.random.default_rng(seed).normal(size=position.shape)
    axes = "xyz"[: position.shape[1]]
    return InteractionLog.from_arrays(time, position, 1 + position, axes=axes, **optional)


def ends(trial):
    return float(trial.time[0]), float(trial.time[-1])


#: Three strokes: from 1 to 3 s, from 4.2 to 5.7 s and from 5.8 to 6.8 s, the last two with a short pause between.
def strokes(time):
    return stroke(time, 1.0, 2.0, 0.3) - stroke(time, 4.2, 1.5, 0.2) + stroke(time, 5.8, 1.0, 0.1)


def test_nothing_is_touched_where_nothing_is_asked_for():
    time = sampled(3.0)
    log = make(time, strokes(time), repetition=(time > 2).astype(int))
    assert segment(log, PreprocessingConfig()).trials[0] is log.trials[0]


# --- rest ----------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    rate=st.sampled_from([40.0, 100.0, 333.0, 1000.0]),
    uneven=st.sampled_from([0.0, 0.3]),
    noise=st.sampled_from([0.0, 1e-5, 1e-4]),
)
def test_rest_splits_a_trial_whatever_noise_and_steps(seed, rate, uneven, noise):
    time = sampled(8.0, rate, uneven, seed)
    log = make(time, strokes(time), noise * np.sqrt(rate / 40.0), seed)
    first, second = segment(log, config(split="rest")).trials
    assert (first.name, second.name) == ("0.1", "0.2")
    (trimmed,) = segment(log, config(trim_rest=True)).trials
    assert trimmed.name == "0"
    # A stroke of 0.3 m in 2 s is at 5 mm/s 0.07 s after its start, and the means reach 0.075 s back; the largest noise
    # has a speed of 1.3 mm/s (SD), and the stroke is at 5 + 4 × 1.3 mm/s after 0.1 s.
    tolerance = 0.1 if noise < 1e-4 else 0.15
    for found, true in ((ends(first), (1.0, 3.0)), (ends(second), (4.2, 6.8)), (ends(trimmed), (1.0, 6.8))):
        np.testing.assert_allclose(found, true, rtol=0, atol=tolerance)


def test_trimming_keeps_pauses_in_the_middle():
    time = sampled(9.0)
    log = make(time, stroke(time, 1.0, 1.0, 0.1) + stroke(time, 5.0, 1.0, 0.1))
    (trial,) = segment(log, config(trim_rest=True)).trials
    np.testing.assert_allclose(ends(trial), (1.0, 6.0), atol=0.1)
    np.testing.assert_array_equal(np.diff(trial.time) < 0.011, True)


def test_noise_at_the_threshold_does_not_shatter_a_trial():
    time = sampled(20.0)
    # A drift at exactly the speed of rest, before and after a stroke, and a twitch of 50 ms.
    drift = 0.005 * time + stroke(time, 4.0, 0.05, 0.004)
    log = make(time, drift + stroke(time, 8.0, 2.0, 0.3), noise=3e-5)
    (trial,) = segment(log, config(split="rest")).trials
    np.testing.assert_allclose(ends(trial), (8.0, 10.0), atol=0.15)
    # Shorter rests are none; shorter motion is none.
    assert len(segment(log, config(split="rest", minimum_duration=0.1)).trials) == 2
    time = sampled(8.0)
    log = make(time, strokes(time))
    assert len(segment(log, config(split="rest", rest_duration=1.5)).trials) == 1
    assert len(segment(log, config(split="rest", rest_duration=0.1)).trials) == 3


def test_a_slow_hand_rests_all_the_time():
    time = sampled(4.0)
    log = make(time, 0.008 * time)
    with pytest.raises(
        LogError,
        match=r"expected motion in at least one trial after segmentation, found none: memory, trial '0': expected "
        r"motion for at least 0\.5 s that exceeds 2 × 0\.005 m/s, found speeds of 0\.008 \(median\) and 0\.008 m/s "
        r"\(largest\); lower preprocessing\.segmentation\.rest_speed or minimum_duration",
    ):
        segment(log, config(trim_rest=True))
    assert segment(log, config(trim_rest=True, rest_speed=0.003)).n_samples == log.n_samples


def test_a_trial_without_motion_is_left_out_aloud():
    time = sampled(8.0)
    moved = make(time, strokes(time)).trials[0]
    still = make(time, 1e-5 * time, trial="still").trials[0]
    with pytest.warns(LogWarning, match=r"a trial is left out: memory, trial 'still': expected motion"):
        log = segment(InteractionLog(("x",), (still, moved)), config(split="rest"))
    assert [trial.name for trial in log.trials] == ["0.1", "0.2"]


def test_all_that_belongs_to_a_sample_goes_with_it():
    time = sampled(8.0)
    n = len(time)
    rng = np.random.default_rng(3)
    vectors = {
        name: rng.normal(size=(n, 1))
        for name in ("force", "velocity", "acceleration", "reference", "perturbation")
    }
    whole = Trial(
        "0", "Ada", "memory", time, strokes(time)[:, None],
        **vectors, phase=np.linspace(0, 1, n), repetition=np.repeat([0, 1, 2], [350, 200, n - 550]),
        truth={"stiffness_xx": rng.normal(size=n)}, rows=RowNumbers("line", np.arange(n) + 2),
    )  # fmt: skip
    log = InteractionLog(("x",), (whole,))
    for trial in segment(log, config(split="rest")).trials:
        start = int(np.searchsorted(time, trial.time[0]))
        part = slice(start, start + trial.n_samples)
        before, after = trial_arrays(log.trials[0]), trial_arrays(trial)
        assert set(before) == set(after)
        for name in set(before) - {"repetition"}:
            np.testing.assert_array_equal(after[name], before[name][part])
        np.testing.assert_array_equal(np.diff(trial.repetition), np.diff(whole.repetition[part]))
        assert trial.repetition[0] == 0
        assert (trial.group, trial.source, trial.rows.word) == ("Ada", "memory", "line")
        np.testing.assert_array_equal(trial.rows.numbers, np.arange(n)[part] + 2)


# --- gaps ----------------------------------------------------------------------------------------


def with_gaps(*lengths, every=2.0):
    """Strokes of 2 s at 100 Hz with gaps of `lengths` [s] between."""
    start = np.cumsum([0.0, *(every + length for length in lengths)])
    time = np.concatenate([each + np.arange(0, every, 0.01) for each in start])
    return make(time, np.sin(time))


def test_gaps_split_a_trial_and_say_so():
    log = with_gaps(0.4, 1.0, 3.0)
    with pytest.warns(
        LogWarning,
        match=r"memory, trial '0': split into 3 at 2 gap\(s\) of more than 0\.5 s, the longest of 3\.01 s from 7\.39 "
        r"to 10\.4 s; 0 part\(s\) shorter than 0\.5 s are left out",
    ):
        parts = segment(log, config(gaps="split")).trials
    assert [trial.name for trial in parts] == ["0.1", "0.2", "0.3"]
    assert [trial.n_samples for trial in parts] == [400, 200, 200]
    np.testing.assert_array_equal(np.concatenate([trial.time for trial in parts]), log.trials[0].time)
    with pytest.warns(LogWarning, match=r"split into 1 at 2 gap\(s\).* 2 part\(s\) shorter than 2\.5 s"):
        assert segment(log, config(gaps="split", minimum_duration=2.5)).n_samples == 400
    with pytest.warns(LogWarning, match="split into 3"):
        assert len(prepare(log, config(gaps="split")).trials) == 3
    assert segment(with_gaps(0.4), config(gaps="split")).trials[0].name == "0"


def test_gaps_are_refused_unless_they_split():
    with pytest.raises(
        LogError,
        match=r"found a gap of 3\.01 s from 1\.99 to 5 s; cut there with log\.window, or raise preprocessing\.max_gap, "
        r"or let preprocessing\.segmentation\.gaps=split make trials of it",
    ):
        segment(with_gaps(3.0), config(trim_rest=True))


def test_nothing_but_gaps():
    with pytest.raises(
        LogError,
        match=r"found none: memory, trial '0': expected 0\.5 s without gap, found at most 0 s; raise preprocessing\."
        r"max_gap, or lower preprocessing\.segmentation\.minimum_duration",
    ):
        segment(with_gaps(0.4), config(gaps="split", max_gap=0.001))


def test_names_of_parts_may_not_be_taken():
    time = sampled(8.0)
    log = InteractionLog(
        ("x",), tuple(make(time, strokes(time), trial=name).trials[0] for name in ("a", "a.1"))
    )
    assert [trial.name for trial in segment(log, config(split="rest")).trials] == [
        "a.1",
        "a.2",
        "a.1.1",
        "a.1.2",
    ]
    time = time[time < 4]
    shorter = make(time, strokes(time), trial="a.1").trials[0]
    gap = with_gaps(1.0).trials[0]
    log = InteractionLog(("x",), (make(gap.time, gap.position, trial="a").trials[0], shorter))
    with (
        pytest.warns(LogWarning, match="split into 2"),
        pytest.raises(LogError, match=r"expected each trial of a source once, found trial 'a\.1' twice"),
    ):
        segment(log, config(gaps="split"))


# --- rounds --------------------------------------------------------------------------------------


def circle(time, period, radius=0.1):
    angle = 2 * np.pi * time / period
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@pytest.mark.parametrize("noise", [0.0, 5e-4])
@pytest.mark.parametrize("uneven", [0.0, 0.3])
def test_rounds_are_repetitions(noise, uneven):
    time = sampled(6.0, uneven=uneven, seed=4)
    (trial,) = segment(make(time, circle(time, 2.0), noise), config(split="return")).trials
    np.testing.assert_array_equal(trial.time, time)
    assert trial.repetition[[0, -1]].tolist() == [0, 2]
    assert set(np.diff(trial.repetition)) == {0, 1}
    cuts = time[1:][np.diff(trial.repetition) == 1]
    # At 0.31 m/s half a millimetre of noise hides the nearest sample within some 10 ms.
    np.testing.assert_allclose(cuts, [2.0, 4.0], atol=0.01 + 40 * noise)


def test_an_incomplete_round_is_left_out_aloud():
    time = sampled(5.0)
    log = make(time, circle(time, 2.0))
    with pytest.warns(
        LogWarning,
        match=r"memory, trial '0': left out the last round, from 4 s on, which is incomplete: it ends 0\.2 m from the "
        r"start, and preprocessing\.segmentation\.return_radius is 0\.02 m",
    ):
        (trial,) = segment(log, config(split="return")).trials
    assert trial.n_samples == 400
    assert np.bincount(trial.repetition).tolist() == [200, 200]
    assert trial.truth == {} and trial.force.shape == (400, 2)


def test_a_round_that_ends_near_the_start_is_complete():
    time = sampled(3.95)
    (trial,) = segment(make(time, circle(time, 2.0)), config(split="return")).trials
    assert np.bincount(trial.repetition).tolist() == [200, 196]
    # Beyond the start by less than the radius: still the same round.
    time = sampled(4.05)
    (trial,) = segment(make(time, circle(time, 2.0)), config(split="return")).trials
    assert np.bincount(trial.repetition).tolist() == [200, 206]


def test_rest_at_the_start_between_rounds_belongs_to_them():
    time = sampled(9.0)
    turned = np.clip(time - 1, 0, 2) + np.clip(time - 4, 0, 2) + np.clip(time - 7, 0, 1)
    log = make(time, circle(turned, 2.0), noise=1e-4, repetition=(time > 4).astype(int))
    with pytest.warns(LogWarning, match="left out the last round"):
        (trial,) = segment(log, config(trim_rest=True, split="return")).trials
    np.testing.assert_allclose(trial.time[0], 1.0, atol=0.1)
    (cut,) = trial.time[1:][np.diff(trial.repetition) == 1]
    assert 3.0 - 0.05 < cut < 4.0 + 0.05


def test_twitches_about_the_radius_are_no_rounds():
    time = sampled(6.0)
    wobble = 1 + 0.2 * stroke(time, 2.0, 0.1, 1.0) - 0.2 * stroke(time, 2.2, 0.1, 1.0)
    (trial,) = segment(make(time, circle(time, 2.0) * wobble[:, None]), config(split="return")).trials
    assert trial.repetition[-1] == 2


def test_a_hand_that_stays():
    time = sampled(4.0)
    with pytest.raises(
        LogError,
        match=r"expected a hand that leaves its start by 2 × 0\.02 m for at least 0\.5 s, found it 0\.03 m away at "
        r"most; lower preprocessing\.segmentation\.return_radius or minimum_duration",
    ):
        segment(make(time, circle(time, 2.0, 0.015)), config(split="return"))


def test_a_hand_that_does_not_return():
    time = sampled(1.7)
    with pytest.raises(
        LogError,
        match=r"expected a hand that returns to within 0\.02 m of its start, found it 0\.0908 m away at least; raise "
        r"preprocessing\.segmentation\.return_radius, or set preprocessing\.segmentation\.split to rest or none",
    ):
        segment(make(time, circle(time, 2.0)), config(split="return"))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(2, 200),
    split=st.sampled_from(["none", "rest", "return"]),
    speed=st.sampled_from([1e-320, 0.005, 0.1, 1e300]),
    duration=st.sampled_from([1e-320, 0.01, 0.3, 1e300]),
)
def test_any_motion_is_segmented_or_refused(seed, n, split, speed, duration):
    rng = np.random.default_rng(seed)
    time = 1e9 + np.cumsum(rng.uniform(0.001, 0.6, n))
    steps = rng.normal(size=(n, 2)) * rng.integers(0, 2, (n, 1))
    log = make(time, 0.05 * np.cumsum(steps, axis=0) + 1e-6 * np.arange(n)[:, None])
    wanted = config(
        gaps="split",
        trim_rest=True,
        split=split,
        rest_speed=speed,
        rest_duration=duration,
        minimum_duration=0.1,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LogWarning)
        try:
            result = segment(log, wanted)
        except LogError:
            return
    # Checked anew, as a log that was read: labels from zero, each sample once and in order.
    for trial in result.trials:
        np.testing.assert_array_equal(np.unique(trial.repetition), np.arange(trial.repetition[-1] + 1))
    together = np.concatenate([trial.time for trial in result.trials])
    assert (np.diff(together) > 0).all() and np.isin(together, time).all()


def test_repetitions_become_trials_once_smoothed():
    time = np.arange(400) / 100.0
    position = 0.1 * np.sin(np.pi * time)
    repetition = np.repeat([0, 1], 200)
    phase = np.tile(np.linspace(0.0, 0.99, 200), 2)
    log = InteractionLog.from_arrays(
        time, position, np.cos(time), axes=["x"], repetition=repetition, phase=phase
    )
    whole = prepare(log, PreprocessingConfig(rate=20)).trials[0]
    parts = prepare(log, PreprocessingConfig(rate=20, segmentation={"repetitions_as_trials": True})).trials
    assert [part.name for part in parts] == [f"{whole.name}.1", f"{whole.name}.2"]
    assert [len(np.unique(part.repetition)) for part in parts] == [1, 1]
    for name in ("time", "position", "velocity", "acceleration", "force", "phase", "phase_velocity"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(joined, getattr(whole, name))
