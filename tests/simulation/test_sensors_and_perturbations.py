"""What the device's sensors make of a signal, and what it adds to the force of the hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from arm_oracles import Array

from bayes_impedance.errors import SimulationError
from bayes_impedance.log import Trial
from bayes_impedance.simulation.arm import arm_with
from bayes_impedance.simulation.device import (
    IDEAL,
    NO_SERVO,
    Admittance,
    BandLimitedForce,
    ForcePulses,
    Perturbation,
    PositionDisplacement,
    Sensor,
    Sensors,
    Unperturbed,
)
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.subjects import Subject
from bayes_impedance.simulation.tasks import FigureEight, Flower, Pace, Path

STEP = 1e-3
DEVICE = Admittance()


def recorded(
    sensors: Sensors = IDEAL,
    perturbation: Perturbation | None = None,
    stiffness: str = "low",
    noise: float = 0.0,
    path: Path | None = None,
    duration: float = 4.0,
) -> Trial:
    """One round at 1 kHz; the same seed always, so that only what is changed makes a difference."""
    person = Subject("P", arm_with(stiffness, noise=noise), Pace(duration))
    experiment = Experiment(
        [person],
        FigureEight() if path is None else path,
        trials=1,
        repetitions=1,
        perturbation=Unperturbed() if perturbation is None else perturbation,
        sensors=sensors,
        rate=1000.0,
    )
    return simulate(experiment, seed=4).trials[0]


def with_force(**values: float) -> Trial:
    return recorded(Sensors(Sensor(**values), Sensor()))


def with_position(**values: float) -> Trial:
    return recorded(Sensors(Sensor(), Sensor(**values)))


@pytest.fixture(scope="module")
def ideal() -> Trial:
    return recorded()


@dataclass(frozen=True)
class Steady:
    """The same force all along."""

    force: tuple[float, float]
    gains: tuple[float, float] = (0.0, 0.0)

    def draw(self, n: int, step: float, generator: np.random.Generator) -> tuple[Array, Array]:
        return np.tile(self.force, (n, 1)), NO_SERVO


def force_of_motion(trial: Trial) -> Array:
    """M_r a + D_r v − p of the true motion, by central differences."""
    velocity = np.gradient(trial.position, STEP, axis=0)
    acceleration = np.diff(trial.position, 2, axis=0) / STEP**2
    return DEVICE.mass * acceleration + DEVICE.damping * velocity[1:-1] - trial.perturbation[1:-1]


# --- sensors -------------------------------------------------------------------------------------


def test_resolution_of_force_rounds_the_recording_only(ideal: Trial) -> None:
    rounded = with_force(resolution=0.125)
    np.testing.assert_array_equal(rounded.position, ideal.position)
    np.testing.assert_array_equal(rounded.force % 0.125, 0.0)
    assert 0.06 < np.abs(rounded.force - ideal.force).max() <= 0.0625


def test_latency_of_force_delays_the_recording_only(ideal: Trial) -> None:
    late = with_force(latency=0.012)
    np.testing.assert_array_equal(late.position, ideal.position)
    np.testing.assert_array_equal(late.force[12:], ideal.force[:-12])
    np.testing.assert_array_equal(late.force[:12], np.tile(ideal.force[0], (12, 1)))


def test_bias_of_force_moves_the_device_as_a_steady_force_does(ideal: Trial) -> None:
    biased, pushed = with_force(bias=0.8), recorded(perturbation=Steady((0.8, 0.8)))
    np.testing.assert_array_equal(biased.position, pushed.position)
    np.testing.assert_allclose(biased.force, pushed.force + 0.8, atol=1e-12)
    assert np.abs(biased.position - ideal.position).max() > 1e-3


def test_noise_of_force_moves_the_device_and_is_recorded(ideal: Trial) -> None:
    noisy = with_force(noise_sd=0.5)
    assert np.abs(noisy.position - ideal.position).max() > 1e-5
    # Second differences see the mean of two steps, in each of which the controller held what it had measured.
    felt = 0.5 * (noisy.force[1:-1] + noisy.force[:-2])
    np.testing.assert_allclose(force_of_motion(noisy), felt, atol=0.02)
    # The arm gives way to noise, so that of u + n is less than that of n.
    mass = np.array(
        [[noisy.truth[f"mass_{name}"].mean() for name in row] for row in (("xx", "xy"), ("xy", "yy"))]
    )
    share = DEVICE.mass * np.linalg.inv(DEVICE.mass * np.eye(2) + mass)
    jumps = np.diff(noisy.force, axis=0).std(0)
    np.testing.assert_allclose(jumps, 0.5 * np.sqrt(2.0 * np.diag(share @ share.T)), rtol=0.05)


@pytest.mark.parametrize("axis", [0, 1])
def test_sensor_of_position_leaves_the_loop_alone(ideal: Trial, axis: int) -> None:
    noisy, biased = with_position(noise_sd=1e-4), with_position(bias=0.01)
    rounded, late = with_position(resolution=1e-4), with_position(latency=0.007)
    for trial in (noisy, biased, rounded, late):
        np.testing.assert_array_equal(trial.force, ideal.force)
        np.testing.assert_array_equal(trial.truth["mass_xy"], ideal.truth["mass_xy"])
    x = ideal.position[:, axis]
    error = noisy.position[:, axis] - x
    assert abs(error.std() - 1e-4) < 5e-6 and abs(error.mean()) < 6e-6
    assert abs(np.corrcoef(error[1:], error[:-1])[0, 1]) < 0.06
    np.testing.assert_allclose(biased.position[:, axis], x + 0.01, atol=1e-15)
    steps = rounded.position[:, axis] / 1e-4
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert np.abs(rounded.position[:, axis] - x).max() <= 0.5001e-4
    np.testing.assert_array_equal(late.position[7:, axis], x[:-7])


def test_latency_beyond_the_trial_records_its_first_sample() -> None:
    signal = np.arange(10.0).reshape(5, 2)
    np.testing.assert_array_equal(Sensor(latency=1e308).recorded(signal, STEP), np.tile(signal[0], (5, 1)))


def test_recorded_motion_and_force_obey_the_device(ideal: Trial) -> None:
    # Central differences err by h²/12 of the fourth derivative.
    np.testing.assert_allclose(force_of_motion(ideal)[20:], ideal.force[21:-1], atol=1e-3)
    for perturbation in (BandLimitedForce(3.0), PositionDisplacement()):
        trial = recorded(perturbation=perturbation, noise=0.1)
        jumps = np.abs(np.diff(trial.perturbation, axis=0)).max(1) + np.abs(np.diff(trial.force, axis=0)).max(
            1
        )
        # Away from steps of the servo, of which differences see a half on either side.
        calm = np.maximum(jumps[1:], jumps[:-1]) < 0.1
        assert calm.mean() > 0.5
        np.testing.assert_allclose(force_of_motion(trial)[calm], trial.force[1:-1][calm], atol=0.1)


# --- perturbations -------------------------------------------------------------------------------


def test_band_limited_force_has_its_band_and_deviation() -> None:
    draws = [
        BandLimitedForce(2.5, 1.0, 3.0).draw(20_000, STEP, np.random.default_rng(k))[0] for k in range(8)
    ]
    force = np.stack(draws)
    assert force.shape == (8, 20_000, 2)
    np.testing.assert_allclose(force.std(1).mean(), 2.5, rtol=0.05)
    power = np.abs(np.fft.rfft(force * np.hanning(20_000)[:, None], axis=1)) ** 2
    frequency = np.fft.rfftfreq(20_000, STEP)
    outside = (frequency < 0.9) | (frequency > 3.1)
    assert power[:, outside].sum() < 1e-3 * power.sum()
    # Each quarter of the band is used, by both axes, and they are not the same.
    for low in (1.0, 1.5, 2.0, 2.5):
        within = power[:, (frequency >= low) & (frequency < low + 0.5)].sum((0, 1))
        assert (within > 0.15 * power.sum((0, 1))).all()
    assert abs(np.corrcoef(force[..., 0].ravel(), force[..., 1].ravel())[0, 1]) < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_pulses_have_their_amplitude_and_width_and_do_not_overlap(seed: int) -> None:
    pulses = ForcePulses(4.0, width=0.15, interval=0.2)
    force, servo = pulses.draw(10_000, STEP, np.random.default_rng(seed))
    assert servo.shape == (0, 5)
    size = np.hypot(*force.T)
    on = size > 0
    np.testing.assert_allclose(size[on], 4.0, rtol=1e-14)
    # One in each interval, each as long as the others: none was cut by the next, though two may touch.
    assert on.sum() == 50 * 150
    for k in range(50):
        assert on[200 * k : 200 * (k + 1)].sum() == 150
    eighths = np.arctan2(force[on, 1], force[on, 0]) / (np.pi / 4)
    np.testing.assert_allclose(eighths, np.round(eighths), atol=1e-12)
    assert len(np.unique(np.round(eighths) % 8)) == 8


@pytest.mark.parametrize("seed", range(5))
def test_commanded_displacement_goes_smoothly_there_and_back(seed: int) -> None:
    displacement = PositionDisplacement(0.01, ramp=0.08, hold=0.12, interval=0.5)
    force, servo = displacement.draw(10_000, STEP, np.random.default_rng(seed))
    np.testing.assert_array_equal(force, 0.0)
    share, x, v = servo[:, 0], servo[:, 1:3], servo[:, 3:5]
    assert set(share) == {0.0, 1.0}
    assert share.sum() == 20 * 280
    np.testing.assert_array_equal(servo[share == 0], 0.0)
    np.testing.assert_allclose(np.gradient(x, STEP, axis=0), v, atol=0.02 * np.abs(v).max())
    # No steps in position, and none in velocity beyond what half a cosine has.
    assert np.abs(np.diff(x, axis=0)).max() < 1.01 * STEP * 0.01 * 0.5 * np.pi / 0.08
    assert np.abs(np.diff(v, axis=0)).max() < 1.01 * STEP * 0.01 * 0.5 * (np.pi / 0.08) ** 2
    held = np.hypot(*x.T) > 0.01 - 1e-12
    assert abs(held.sum() - 20 * 120) <= 20


@pytest.mark.parametrize("stiffness", ["low", "high"])
def test_servo_brings_the_hand_to_within_a_few_per_cent_of_the_displacement(stiffness: str) -> None:
    displacement = PositionDisplacement()
    common = {"stiffness": stiffness, "path": Flower(), "duration": 10.0}
    moved, free = recorded(perturbation=displacement, **common), recorded(**common)
    off = moved.position - free.position
    started = np.flatnonzero(np.diff((moved.perturbation != 0).any(1).astype(int)) == 1)
    assert len(started) == 6
    end = started + round((displacement.ramp + displacement.hold) / STEP)
    np.testing.assert_allclose(np.hypot(*off[end].T), displacement.amplitude, rtol=0.05)
    np.testing.assert_array_equal(off[: started[0]], 0.0)


def test_displacement_is_from_the_path_without_noise() -> None:
    displacement = PositionDisplacement()
    moved, predicted = recorded(perturbation=displacement, noise=0.1), recorded(noise=0.0)
    started = np.flatnonzero(np.diff((moved.perturbation != 0).any(1).astype(int)) == 1)
    end = started + round((displacement.ramp + displacement.hold) / STEP)
    off = moved.position[end] - predicted.position[end]
    np.testing.assert_allclose(np.hypot(*off.T), displacement.amplitude, rtol=0.1)


def test_nothing_is_what_no_perturbation_adds(ideal: Trial) -> None:
    np.testing.assert_array_equal(ideal.perturbation, 0.0)


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arrange", "sentence"),
    [
        (lambda: Admittance(mass=-1.0), "device.mass: expected a finite value >= 0, got -1.0; choose one"),
        (lambda: Admittance(damping=np.nan), "device.damping: expected a finite value >= 0, got nan"),
        (lambda: Sensor(noise_sd=-0.1), "sensor.noise_sd: expected a finite value >= 0, got -0.1"),
        (lambda: Sensor(resolution=-0.1), "sensor.resolution: expected a finite value >= 0"),
        (lambda: Sensor(latency=np.inf), "sensor.latency: expected a finite value >= 0, got inf"),
        (lambda: Sensor(bias=np.inf), "sensor.bias: expected a finite value, got inf; choose one"),
        (lambda: BandLimitedForce(-1.0), "perturbation.sd: expected a finite value >= 0"),
        (
            lambda: BandLimitedForce(1.0, 2.0, 2.0),
            "perturbation.low: expected less than high, 2 Hz, got 2 Hz; widen the band",
        ),
        (
            lambda: ForcePulses(1.0, width=0.5, interval=0.4),
            "perturbation.interval: expected more than the 0.5 s that a perturbation lasts, and that more than 0, got "
            "0.4 s; leave time between them",
        ),
        (lambda: ForcePulses(1.0, width=0.0), "perturbation.interval: expected more than the 0 s"),
        (lambda: PositionDisplacement(-0.01), "displacement.amplitude: expected a finite value >= 0"),
        (
            lambda: PositionDisplacement(ramp=0.0),
            "displacement.ramp: expected more than 0 s, got 0 s; give the hand time to move",
        ),
        (lambda: PositionDisplacement(hold=2.0), "perturbation.interval: expected more than the 2.2 s"),
    ],
)
def test_what_no_device_can_do_is_refused(arrange, sentence: str) -> None:
    with pytest.raises(SimulationError) as caught:
        arrange()
    assert sentence in str(caught.value)


def test_bias_may_be_negative() -> None:
    assert Sensor(bias=-1.0).added((2, 2), np.random.default_rng(0)).tolist() == [[-1.0, -1.0], [-1.0, -1.0]]
