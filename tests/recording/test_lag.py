"""Lag of force behind motion: found where data tell it, and not stated where they do not."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from bags import Array, states
from scipy.interpolate import make_interp_spline
from test_clock import delays

from bayes_impedance.config.log import ClockConfig
from bayes_impedance.recording.clock import choose_clock
from bayes_impedance.recording.lag import LARGEST, LagEstimate, estimate_lag, remove_lag
from bayes_impedance.recording.spectra import WINDOW, cross_spectra, turned
from bayes_impedance.recording.synchronise import Stream, synchronise
from bayes_impedance.simulation.arm import arm_with
from bayes_impedance.simulation.device import BandLimitedForce, Perturbation, Unperturbed
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.subjects import Subject
from bayes_impedance.simulation.tasks import FigureEight

#: 10 % of 12 ms.
TOLERANCE = 1.2e-3


@cache
def simulated(seed: int, trials: int, perturbed: bool = True) -> tuple[tuple[Array, ...], ...]:
    """Time, position, force and perturbation of each trial of 30 s at 1 kHz."""
    perturbation: Perturbation = BandLimitedForce(2.0) if perturbed else Unperturbed()
    person = Subject("P", arm_with("low"))
    experiment = Experiment([person], FigureEight(), trials=trials, perturbation=perturbation, rate=1000.0)
    return tuple((t.time, t.position, t.force, t.perturbation) for t in simulate(experiment, seed).trials)  # type: ignore[misc]


def recorded(seed: int, rate: float, lag: float, trials: int = 1, perturbed: bool = True) -> list[Array]:
    """The same, trials behind each other, with force delayed at 1 kHz and all of it sampled at `rate`."""
    every = round(1000.0 / rate)
    logs = []
    for time, position, force, perturbation in simulated(seed, trials, perturbed):
        late = make_interp_spline(time, force)(np.clip(time - lag, time[0], time[-1]))
        logs.append([values[::every] for values in (time, position, late, perturbation)])
    return [np.concatenate(columns) for columns in zip(*logs, strict=True)]


def from_log(columns: list[Array], known: bool) -> LagEstimate:
    time, position, force, perturbation = columns
    return estimate_lag(time, position, force, perturbation=perturbation if known else None)


# --- simulated arm -------------------------------------------------------------------------------


@pytest.mark.parametrize("lag", [0.012, 0.0, -0.008])
@pytest.mark.parametrize("rate", [200.0, 1000.0])
@pytest.mark.parametrize("seed", range(3))
def test_lag_with_a_known_perturbation(seed: int, rate: float, lag: float) -> None:
    estimate = from_log(recorded(seed, rate, lag), known=True)
    assert estimate.determined, estimate.reason
    # The controller holds force for its step of 1 ms, half of which looks like a lag of its own.
    assert estimate.lag == pytest.approx(lag, abs=0.7e-3)
    assert estimate.explained > 0.99


@pytest.mark.parametrize("lag", [0.012, 0.0, -0.008])
@pytest.mark.parametrize("seed", range(3))
def test_lag_at_1_khz_where_nobody_logged_the_perturbation(seed: int, lag: float) -> None:
    estimate = from_log(recorded(seed, 1000.0, lag), known=False)
    assert estimate.determined, estimate.reason
    assert estimate.lag == pytest.approx(lag, abs=0.7e-3)


@pytest.mark.parametrize("lag", [0.012, 0.0, -0.008])
@pytest.mark.parametrize("seed", range(3))
def test_lag_at_200_hz_where_nobody_logged_the_perturbation_takes_some_minutes(seed: int, lag: float) -> None:
    estimate = from_log(recorded(seed, 200.0, lag, trials=5), known=False)
    assert estimate.determined, estimate.reason
    assert estimate.lag == pytest.approx(lag, abs=TOLERANCE)
    # 30 s have a standard error of about 1 ms, and say so.
    short = from_log([column[:6000] for column in recorded(seed, 200.0, lag, trials=5)], known=False)
    assert not short.determined
    assert short.reason.startswith("other lags explain force about as well: standard error")
    assert abs(short.lag - lag) < 3 * short.standard_error


def test_lag_behind_two_clocks_that_differ() -> None:
    # Motion at 200 Hz by one sender; force at 1 kHz, 12 ms late, by another that is .37 s and 200 ppm off.
    time, position, force, perturbation = recorded(0, 1000.0, 0.012)
    generator = np.random.default_rng(0)
    streams = []
    for name, every, columns, offset, drift in (
        ("motion", 5, np.hstack([position, perturbation]), 0.0, 0.0),
        ("force", 1, force, 0.37, 200e-6),
    ):
        true = 50.0 + time[::every]
        received = true + delays(len(true), 1e-3 * every, generator)
        clock = choose_clock(true + offset + drift * time[::every], received, ClockConfig())
        streams.append(Stream(name, clock.time, columns[::every], against_recorder=clock.against_recorder))
    result = synchronise(streams[0], streams[1:])
    motion, late = result.columns["motion"], result.columns["force"]
    estimate = estimate_lag(result.time, motion[:, :2], late, perturbation=motion[:, 2:])
    assert estimate.determined and estimate.lag == pytest.approx(0.012, abs=0.7e-3)
    repaired, remain = remove_lag(result.time, late, 0.012)
    truth = simulated(0, 1)[0][2][::5][result.rows[remain]]
    # The sensor's noise of .05 N is averaged in one and not in the other.
    assert np.sqrt(np.mean((repaired - truth) ** 2)) < 0.06


def test_the_robot_alone_tells_it_at_1_khz() -> None:
    estimate = from_log(recorded(1, 1000.0, 0.012, perturbed=False), known=False)
    assert estimate.determined and estimate.lag == pytest.approx(0.012, abs=0.7e-3)


def test_standard_errors_are_those_of_many_recordings() -> None:
    found = [
        from_log(
            [column[6000 * k : 6000 * (k + 1)] for column in recorded(0, 200.0, 0.012, trials=12)],
            known=False,
        )
        for k in range(12)
    ]
    stated = np.sqrt(np.mean([estimate.standard_error**2 for estimate in found]))
    actual = np.std([estimate.lag for estimate in found])
    # Twelve draws know their SD within a fifth.
    assert 0.5 < stated / actual < 2.0


# --- laws that are known -------------------------------------------------------------------------


def driven(
    tones: Array, lag: float, noise: float, generator: np.random.Generator, duration: float = 60.0
) -> tuple[Array, Array, Array]:
    """Time at 200 Hz, motion in `tones` [Hz] of 1 m/s² each, and force of 2 kg and 6 Ns/m, late and noisy."""
    time = np.arange(0.0, duration, 0.005)
    omega, phase = 2 * np.pi * tones, generator.uniform(0, 2 * np.pi, len(tones))
    angle = omega * time[:, None] + phase
    late = omega * (time[:, None] - lag) + phase
    position = (-np.sin(angle) / omega**2).sum(axis=1)
    force = (2.0 * np.sin(late) - 6.0 / omega * np.cos(late)).sum(axis=1)
    force += noise * generator.standard_normal(len(time))
    return time, position[:, None], force[:, None]


@pytest.mark.parametrize("lag", [0.0321, -0.0654, 0.003])
def test_a_broad_band_tells_the_lag(lag: float) -> None:
    generator = np.random.default_rng(0)
    estimate = estimate_lag(*driven(generator.uniform(1, 15, 40), lag, 0.1, generator))
    assert estimate.determined
    assert estimate.lag == pytest.approx(lag, abs=4 * estimate.standard_error + 1e-5)


def test_uneven_steps_gaps_and_unknown_samples_do_no_harm() -> None:
    generator = np.random.default_rng(0)
    time, position, force = driven(generator.uniform(1, 8, 40), 0.0, 0.0, generator)
    kept = np.delete(np.arange(len(time)), [*range(3000, 3400), *range(7000, 7003)])
    jitter = np.clip(generator.normal(0, 2e-4, len(kept)), -1e-3, 1e-3)
    moved = time[kept] + jitter
    late = make_interp_spline(time, force)(np.clip(moved - 0.012, 0, None))
    late[500:510] = np.nan
    estimate = estimate_lag(moved, make_interp_spline(time, position)(moved), late)
    assert estimate.determined and estimate.lag == pytest.approx(0.012, abs=1e-4)


def test_an_axis_that_rests_does_no_harm() -> None:
    generator = np.random.default_rng(0)
    time, position, force = driven(generator.uniform(1, 15, 40), 0.012, 0.1, generator)
    rest = np.zeros_like(position)
    estimate = estimate_lag(time, np.hstack([position, rest]), np.hstack([force, rest]))
    assert estimate.determined and estimate.lag == pytest.approx(0.012, abs=1e-3)


# --- not determined ------------------------------------------------------------------------------


def test_noise_tells_nothing() -> None:
    for seed in range(4):
        generator = np.random.default_rng(seed)
        position = 1e-4 * generator.standard_normal((6000, 2)).cumsum(axis=0)
        estimate = estimate_lag(np.arange(6000) / 200.0, position, generator.standard_normal((6000, 2)))
        assert not estimate.determined
        assert "mass, damping and stiffness" in estimate.reason or "largest lag" in estimate.reason


def test_slow_motion_tells_nothing() -> None:
    for seed in range(4):
        generator = np.random.default_rng(seed)
        time, position, force = driven(generator.uniform(0.05, 0.3, 10), 0.012, 0.0, generator)
        # A range of some centimetres.
        position = 0.005 * position + 1e-6 * generator.standard_normal(position.shape)
        force = 0.005 * force + 0.05 * generator.standard_normal(force.shape)
        assert not estimate_lag(time, position, force).determined


@pytest.mark.parametrize("tone", [1.3, 2.0, 5.0])
def test_one_tone_is_explained_at_any_lag(tone: float) -> None:
    # Any lag of a single tone is a change of damping.
    generator = np.random.default_rng(0)
    time, position, force = driven(np.array([tone]), 0.012, 0.05, generator)
    position = position + 1e-6 * generator.standard_normal(position.shape)
    estimate = estimate_lag(time, position, force)
    assert not estimate.determined and estimate.explained > 0.999


def test_a_lag_beyond_those_looked_at_is_not_stated() -> None:
    generator = np.random.default_rng(0)
    estimate = estimate_lag(*driven(generator.uniform(1, 7, 40), LARGEST + 0.1, 0.1, generator))
    assert not estimate.determined
    assert estimate.reason == "force is explained best at the largest lag that is looked at, 0.2 s"


def test_bands_that_disagree_determine_nothing() -> None:
    generator = np.random.default_rng(0)
    time, position, force = driven(generator.uniform(1, 7, 40), 0.012, 0.02, generator)
    _, quick, late = driven(generator.uniform(9, 30, 40), 0.003, 0.02, generator)
    estimate = estimate_lag(time, position + quick, force + late)
    assert not estimate.determined
    assert estimate.reason == "slow and fast motion disagree: 12.0 ms under 8 Hz, 3.0 ms above"


def test_a_short_log_tells_nothing() -> None:
    generator = np.random.default_rng(0)
    estimate = estimate_lag(*driven(generator.uniform(1, 15, 40), 0.012, 0.1, generator, duration=8.0))
    assert not estimate.determined and estimate.standard_error == np.inf
    assert estimate.reason == "expected at least 12 windows of 2 s without gaps, found fewer"


def test_slow_samples_tell_nothing() -> None:
    generator = np.random.default_rng(0)
    log = [column[::80] for column in driven(generator.uniform(0.1, 1, 40), 0.012, 0.1, generator)]
    assert estimate_lag(*log).reason == "expected samples at 5 Hz or more, found 2.5 Hz"


def test_force_that_is_zero_throughout_tells_nothing() -> None:
    generator = np.random.default_rng(0)
    time, position, force = driven(generator.uniform(1, 8, 40), 0.012, 0.0, generator)
    assert not estimate_lag(time, position, 0.0 * force).determined


@pytest.mark.parametrize("known", [0, 1])
def test_force_that_is_never_known_tells_nothing(known: int) -> None:
    time, position, force = np.arange(1000) / 100.0, np.zeros((1000, 2)), np.full((1000, 2), np.nan)
    force[:known] = 0.0
    assert not estimate_lag(time, position, force).determined


def test_no_lag_is_stated_for_the_real_recordings(shared_data: Path) -> None:
    # Under 1 Hz these robots are guided, above it contact and noise make up most of the force.
    for name in ("rail/1", "rail/3", "acc_rail/1", "acc_rail/2"):
        read = states(shared_data / "gp_mpc" / f"{name}.bag")
        assert not estimate_lag(read.sent - read.sent[0], read.position, read.human_force).determined


# --- parts ---------------------------------------------------------------------------------------


def test_turned_channels_are_the_transform_of_shifted_force() -> None:
    step, lag = 0.005, 0.0123

    def force(time: Array) -> Array:
        return np.sin(2 * np.pi * 3.3 * time + 0.3) + np.cos(2 * np.pi * 7.1 * time)

    time = step * np.arange(420)
    spectra = cross_spectra([np.stack([force(time), 0 * time, force(time + lag)], axis=1)], 1, step, 0, 1)
    assert spectra is not None
    # Position holds force as it is `lag` later; z zᴴ of one window, with that channel as the common factor.
    column = spectra.parts[0][:, :, -1]
    later = (turned(np.array([lag]), spectra.omega)[0] * column[:, :3]).sum(axis=1)
    # What the shifted window would see beyond the ends of this one is (π lag / WINDOW)² of force there.
    scale = np.abs(column[:, -1]).max()
    np.testing.assert_allclose(later, column[:, -1], atol=(np.pi * lag / WINDOW) ** 2 * scale)


def test_removing_a_lag_brings_force_to_its_time() -> None:
    time = np.arange(0.0, 5.0, 0.005)
    late = np.sin(3.0 * (time - 0.012))[:, None]
    force, remain = remove_lag(time, late, 0.012)
    assert force.shape == (remain.sum(), 1)
    np.testing.assert_array_equal(remain, time + 0.012 <= time[-1])
    # Monotone cubics flatten a peak by up to its curvature 9 times (5 ms)² / 8.
    np.testing.assert_allclose(force[:, 0], np.sin(3.0 * time[remain]), atol=3e-5)
    early, remain = remove_lag(time, late, -0.012)
    np.testing.assert_array_equal(remain, time - 0.012 >= 0.0)
    np.testing.assert_allclose(early[:, 0], np.sin(3.0 * (time[remain] - 0.024)), atol=3e-5)


def test_no_lag_leaves_force_as_it_is() -> None:
    time, force = np.arange(100) / 100.0, np.random.default_rng(0).normal(size=(100, 2))
    same, remain = remove_lag(time, force, 0.0)
    assert remain.all()
    np.testing.assert_allclose(same, force, atol=1e-12)
