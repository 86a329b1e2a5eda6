"""Phase by path progress: closed forms, quadrature, finite differences, and any noisy motion with pauses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from bayes_impedance.config import PhaseConfig, PreprocessingConfig, Smoother
from bayes_impedance.errors import LogError
from bayes_impedance.log import InteractionLog
from bayes_impedance.preprocessing import prepare


def config(source="path", window=0.1, rate=None, **phase):
    smoother = None if window is None else Smoother(window=window)
    return PreprocessingConfig(smoother=smoother, rate=rate, phase=PhaseConfig(source=source, **phase))


def log_of(time, position, **optional):
    axes = "xyz"[: position.shape[1]]
    return InteractionLog.from_arrays(time, position, 1 + position, axes=axes, **optional)


def only(log, wanted):
    (trial,) = prepare(log, wanted).trials
    return trial


class Motion:
    """A curve that stops at 1.5 s for no time and is a turning point there, with velocity and acceleration known."""

    duration = 4.0

    def position(self, t):
        return np.stack(
            [0.1 * np.sin(np.pi * t / 1.5) / np.pi, 0.05 * np.cos(2 * np.pi * t / 3 + 1) * (t / 3)], -1
        )

    def velocity(self, t, step=1e-4):
        return (self.position(t + step) - self.position(t - step)) / (2 * step)

    def acceleration(self, t, step=1e-3):
        return (self.position(t + step) - 2 * self.position(t) + self.position(t - step)) / step**2

    def pace(self, t, rest_speed):
        return np.sqrt((self.velocity(t) ** 2).sum(-1) + rest_speed**2)


@pytest.mark.parametrize("rest_speed", [0.002, 0.05])
def test_phase_is_the_share_of_the_way(rest_speed):
    motion = Motion()
    time = np.linspace(0, motion.duration, 401)
    log = log_of(
        time, motion.position(time), velocity=motion.velocity(time), acceleration=motion.acceleration(time)
    )
    trial = only(log, config(window=None, rest_speed=rest_speed))
    length = quad(motion.pace, 0, motion.duration, (rest_speed,), limit=500)[0]
    expected = [quad(motion.pace, 0, t, (rest_speed,), limit=500)[0] / length for t in time[::40]]
    # A rule of fourth order: the step over the time that the motion takes to change, 0.01 / 0.5, to the fourth.
    np.testing.assert_allclose(trial.phase[::40], expected, rtol=0, atol=1e-7)
    assert trial.phase[0] == 0.0 and trial.phase[-1] == 1.0
    np.testing.assert_allclose(trial.phase_velocity, motion.pace(time, rest_speed) / length, rtol=1e-7)


def test_order_of_the_rule():
    motion = Motion()
    length = quad(motion.pace, 0, motion.duration, (0.01,), limit=500, epsabs=1e-13)[0]
    error = []
    for n in (100, 200):
        time = np.linspace(0, motion.duration, n + 1)
        log = log_of(
            time,
            motion.position(time),
            velocity=motion.velocity(time),
            acceleration=motion.acceleration(time),
        )
        trial = only(log, config(window=None, rest_speed=0.01))
        way = motion.pace(time, 0.01)[50] / trial.phase_velocity[50]
        error.append(abs(way - length))
    assert error[0] / error[1] > 2**3.5


def rounds(repetitions=3, rate=200.0):
    time = np.arange(round(2.0 * repetitions * rate)) / rate
    angle = np.pi * time + 0.2 * np.sin(2 * np.pi * time)
    position = 0.1 * np.stack([np.cos(angle), np.sin(angle)], -1)
    return log_of(time, position, repetition=np.floor(time / 2.0 + 1e-9).astype(int))


@pytest.mark.parametrize("source", ["path", "warping"])
def test_rates_are_derivatives_of_phase(source):
    trial = only(rounds(), config(source))
    for repetition in range(3):
        part = np.flatnonzero(trial.repetition == repetition)
        phase, time = trial.phase[part], trial.time[part]
        assert phase[0] == 0.0
        np.testing.assert_allclose(phase[-1], 1.0, rtol=0, atol=1e-15)
        inner = part[2:-2]
        # Central differences err by the third derivative times step² / 6: of some 5 /s³ and 40 /s⁴ here.
        rate, change = np.gradient(phase, time)[2:-2], np.gradient(trial.phase_velocity[part], time)[2:-2]
        np.testing.assert_allclose(trial.phase_velocity[inner], rate, atol=5 * 0.005**2)
        np.testing.assert_allclose(trial.phase_acceleration[inner], change, atol=40 * 0.005**2)


def test_phase_goes_on_through_a_pause_and_hardly_minds_it():
    def paused(pause):
        time = np.arange(0, 2 + pause, 0.005)
        s = np.clip(time, 0, 1) + np.clip(time - 1 - pause, 0, 1)
        u = s / 2 - np.sin(2 * np.pi * s) / (4 * np.pi) * 0.9
        return only(log_of(time, np.stack([0.3 * u, 0.1 * np.sin(np.pi * u)], -1)), config())

    brisk, slow = paused(0.0), paused(1.5)
    assert (np.diff(slow.phase) > 0).all()
    waiting = (slow.time > 1.2) & (slow.time < 2.3)
    np.testing.assert_allclose(slow.phase_velocity[waiting], slow.phase_velocity.min(), rtol=1e-6)
    # 1.5 s at 2 mm/s are 3 mm of some 0.37 m.
    phase = np.interp(slow.position[:, 0], brisk.position[:, 0], brisk.phase)
    np.testing.assert_allclose(slow.phase, phase, atol=0.003 / 0.37)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    source=st.sampled_from(["path", "warping"]),
    window=st.sampled_from([None, 0.08, 0.2]),
    noise=st.sampled_from([0.0, 1e-5, 1e-2]),
    rest_speed=st.sampled_from([1e-4, 0.002, 1.0, 1e300]),
    rate=st.sampled_from([None, 60.0]),
)
def test_phase_increases_and_stays_between_0_and_1(seed, source, window, noise, rest_speed, rate):
    rng = np.random.default_rng(seed)
    n, step = 400, rng.choice([0.001, 0.01])
    time = step * (np.arange(n) + rng.uniform(-0.3, 0.3, n))
    # Motion that stands still in half of twenty stretches, in two repetitions.
    moving = np.repeat(rng.integers(0, 2, 20), n // 20)[:, None]
    position = np.cumsum(0.2 * step * rng.normal(size=2) * moving, axis=0) + noise * rng.normal(size=(n, 2))
    position += 1e-9 * time[:, None]
    rough = {name: rng.normal(size=(n, 2)) * moving for name in ("velocity", "acceleration")}
    repetition = (np.arange(n) >= rng.integers(60, n - 60)).astype(int)
    log = log_of(time, position, repetition=repetition, **(rough if window is None else {}))
    trial = only(log, config(source, window, rate, rest_speed=rest_speed, knots=int(rng.choice([1, 8, 100]))))
    assert trial.phase.min() >= 0.0 and trial.phase.max() <= 1.0
    within = np.diff(trial.repetition) == 0
    assert (np.diff(trial.phase)[within] > 0).all()
    assert (trial.phase_velocity > 0).all()
    assert np.isfinite(trial.phase_acceleration).all()
    if rate is None:
        ends = np.flatnonzero(np.diff(trial.repetition, prepend=-1, append=9))
        np.testing.assert_array_equal(trial.phase[ends[:-1]], 0.0)
        np.testing.assert_allclose(trial.phase[ends[1:] - 1], 1.0, rtol=0, atol=1e-15)


def test_thinning_comes_after_phase():
    log = rounds()
    native, thinned = only(log, config()), only(log, config(rate=20))
    for name in ("phase", "phase_velocity", "phase_acceleration"):
        np.testing.assert_array_equal(getattr(thinned, name), getattr(native, name)[::10])


def test_a_column_is_used_or_ignored_as_configured():
    plain = rounds(1)
    time = plain.trials[0].time
    column = time / time[-1]
    log = log_of(time, plain.trials[0].position, phase=column)
    np.testing.assert_allclose(only(log, config("column")).phase, column, atol=1e-12)
    np.testing.assert_array_equal(only(log, config("path")).phase, only(plain, config("path")).phase)
    # Even one that the smoother would make go back.
    jumpy = log_of(time, plain.trials[0].position, phase=np.where(time < 1, 1e-6, 0.5) + 1e-7 * time)
    np.testing.assert_array_equal(only(jumpy, config("path")).phase, only(plain, config("path")).phase)


def test_phase_that_stands_still():
    time = np.arange(200) * 0.01
    position = 1 - np.clip(1 - time, 0, 1)[:, None] ** 2
    still = {"velocity": 2 * np.clip(1 - time, 0, 1)[:, None], "acceleration": np.zeros((200, 1))}
    with pytest.raises(
        LogError,
        match=r"memory, trial '0': expected phase to increase at every sample, found it standing still at 1\.01 s with "
        r"preprocessing\.phase\.rest_speed = 1e-300 m/s; raise it",
    ):
        prepare(log_of(time, position, **still), config(window=None, rest_speed=1e-300))


def test_a_repetition_of_one_sample():
    time = np.arange(200) * 0.01
    log = log_of(time, np.sin(time)[:, None], repetition=(time > 1.985).astype(int))
    with pytest.raises(
        LogError, match=r"expected at least two samples in a repetition, for phase needs a rate"
    ):
        prepare(log, config())
