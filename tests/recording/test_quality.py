"""Each check finds its trap, in made and in real recordings, and nothing in a clean one."""

import numpy as np
import pytest
from real_recordings import read_bag, read_delta, read_iiwa, read_panda

from bayes_impedance.recording.plausibility import Sign, sign_check, unit_check, velocity_mismatch
from bayes_impedance.recording.quality import dead_band, force_at_rest, held_samples, saturation
from bayes_impedance.simulation.device import BandLimitedForce, Sensor, Sensors, Unperturbed
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.subjects import Subject
from bayes_impedance.simulation.tasks import FigureEight, Flower, Pace, Reaches

TIME = 0.01 * np.arange(3000)
SMOOTH = 5.0 * np.sin(1.3 * TIME) + 2.0 * np.sin(3.1 * TIME)
NOISY = SMOOTH + 0.05 * np.random.default_rng(0).standard_normal(3000)


@pytest.fixture(scope="module")
def bag(shared_data):
    """Function that reads a bag of gp_mpc."""
    pytest.importorskip("rosbags")
    return lambda name: read_bag(shared_data / "gp_mpc" / f"{name}.bag")


# --- dead band -----------------------------------------------------------------------------------


def test_a_sensor_that_stops_on_both_sides():
    time = np.arange(4000) / 100.0
    found = saturation(np.clip(8 * np.sin(2 * time), -5, 5), "force_x")
    assert found is not None
    assert abs(found.value) == 5.0


def test_a_hard_dead_band_shows_its_width():
    found = dead_band(np.where(np.abs(NOISY) < 1.5, 0.0, NOISY), "force_x")
    assert found.share == pytest.approx(np.mean(np.abs(NOISY) < 1.5))
    assert found.half_width == pytest.approx(1.5, rel=0.05)
    assert "force_x: " in found.sentence and "a dead band up to 1.5" in found.sentence


def test_a_subtracted_dead_band_hides_its_width():
    found = dead_band(np.sign(NOISY) * np.maximum(np.abs(NOISY) - 1.5, 0.0), "force_x")
    assert found.half_width is None
    assert "of a width that does not show in the values" in found.sentence


def test_zeros_that_arithmetic_touched_are_zeros():
    values = np.where(np.abs(NOISY) < 1.5, 1e-15 * NOISY, NOISY)
    assert dead_band(values, "force_x").share == pytest.approx(np.mean(np.abs(NOISY) < 1.5))


def test_a_coarse_resolution_is_no_dead_band():
    assert dead_band(np.round(NOISY / 0.5) * 0.5, "force_x") is None


def test_nothing_but_zeros():
    found = dead_band(np.zeros(50), "force_x")
    assert found.share == 1.0 and found.half_width is None


@pytest.mark.parametrize("run", ["acc_rail/1", "acc_rail/2", "acc_rail/3", "acc_twobag/l1", "acc_twobag/r3"])
def test_real_dead_bands(bag, run):
    recording = bag(run)
    shares = [dead_band(column, "force").share for column in recording.sensed.T]
    assert min(shares) > 0.2 and max(shares) < 0.8
    # Turned into the base, zeros of one channel mix with the values of others.
    pushed = recording.force[np.any(recording.sensed, axis=1)]
    assert all(dead_band(column, "force") is None for column in pushed.T)


# --- saturation ----------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_channel_that_saturates(sign):
    found = saturation(sign * np.minimum(NOISY, 4.0), "force_x")
    assert found.value == pytest.approx(4.0 * sign)
    assert found.count > 0.8 * np.sum(NOISY >= 4.0)
    assert "stop at exactly" in found.sentence and "log.window" in found.sentence


@pytest.mark.parametrize(
    "values",
    [
        NOISY,
        np.round(NOISY / 0.1) * 0.1,
        np.maximum(NOISY, 0.0),
        np.repeat(NOISY[::4], 4),
        np.ones(100),
        np.ones(2),
    ],
    ids=["noise", "resolution", "rests at zero", "held", "constant", "short"],
)
def test_what_is_no_saturation(values):
    assert saturation(values, "force_x") is None


def test_a_real_speed_limit(shared_data):
    recording = read_delta(shared_data)
    found = saturation(np.linalg.norm(recording.velocity, axis=1), "speed")
    assert found.value == pytest.approx(0.0045)
    assert found.count > 0.5 * len(recording.time)


# --- held samples --------------------------------------------------------------------------------


def test_held_samples():
    held = NOISY.copy()
    for t in range(2, 3000, 3):
        held[t] = held[t - 1]
    found = held_samples(held, "force_x")
    assert found.share == pytest.approx(1 / 3, abs=0.02)
    assert "33 % of samples repeat" in found.sentence and "1.5 times more slowly" in found.sentence


@pytest.mark.parametrize(
    "values",
    [
        NOISY,
        np.round(NOISY / 0.1) * 0.1,
        np.where(np.abs(NOISY) < 3, 0.0, NOISY),
        np.clip(NOISY, -3, 3),
        np.ones(500),
        np.concatenate([NOISY[:2000], np.repeat(NOISY[2000], 1000)]),
    ],
    ids=["noise", "resolution", "dead band", "saturation", "constant", "rest"],
)
def test_what_is_not_held(values):
    assert held_samples(values, "force_x") is None


def test_real_held_samples(shared_data):
    for recording in read_panda(shared_data):
        for column in recording.force.T:
            assert held_samples(column, "force").share == pytest.approx(0.3, abs=0.02)
        assert all(held_samples(column, "position") is None for column in recording.position.T)


def test_the_resolution_of_a_robot_at_rest_is_not_held(bag):
    position = bag("rail/2").position
    assert np.mean(np.diff(position[:, 0]) == 0) > 0.1
    assert held_samples(position[:, 0], "position_x") is None


# --- force at rest -------------------------------------------------------------------------------


def stops(drift=0.0, offset=0.0):
    """Time, force, speed with rests of two seconds."""
    moving = (TIME % 5) < 3
    force = np.where(moving, NOISY, 0.0) + offset + drift * TIME
    force = force + 0.05 * np.random.default_rng(1).standard_normal(3000)
    return TIME, force, np.where(moving, 0.1, 1e-5)


def test_an_offset_that_drifts_shows_at_rest():
    found = force_at_rest(*stops(drift=0.05, offset=1.0), "force_x")
    resting = stops()[2] < 0.01
    assert found.offset == pytest.approx(1.0 + 0.05 * TIME[resting].mean(), abs=0.05)
    assert found.drift == pytest.approx(0.05, rel=0.05)
    assert "drifts by 3 N a minute" in found.sentence and "bias of the sensor" in found.sentence


def test_no_offset_and_no_rest():
    assert force_at_rest(*stops(), "force_x") is None
    assert force_at_rest(TIME, NOISY + 9, np.full(3000, 0.1), "force_x") is None


# --- velocity against position -------------------------------------------------------------------


@pytest.mark.parametrize(("ratio", "late"), [(1.0, 0), (1.28, 0), (2.3, 10), (-1.0, 0), (1.0, 5)])
def test_ratio_and_lag_of_velocity(ratio, late):
    time = 0.01 * np.arange(-100, 3000)
    position = 0.1 * np.sin(1.3 * time) + 0.05 * np.sin(3.1 * time)
    velocity = 0.13 * np.cos(1.3 * time) + 0.155 * np.cos(3.1 * time)
    late_velocity = ratio * np.concatenate([velocity[:late], velocity[: len(velocity) - late]])
    found = velocity_mismatch(time[100:], position[100:], late_velocity[100:], "velocity_x")
    if ratio == 1.0 and late == 0:
        assert found is None
        return
    assert found.ratio == pytest.approx(ratio, rel=0.05)
    assert found.lag == pytest.approx(0.01 * late, abs=0.005 + 0.0005 * late)
    assert "times the derivative of position" in found.sentence


def test_a_position_that_only_trembles_tells_nothing():
    generator = np.random.default_rng(2)
    assert velocity_mismatch(TIME, *(1e-4 * generator.standard_normal((2, 3000))), "velocity_z") is None


@pytest.mark.parametrize("run", ["rail/1", "rail/2", "rail/3", "acc_rail/1", "acc_twobag/l1"])
def test_real_velocities_that_agree(bag, run):
    recording = bag(run)
    for position, velocity in zip(recording.position.T, recording.velocity.T, strict=True):
        assert velocity_mismatch(recording.time, position, velocity, "velocity") is None


def test_real_velocities_that_are_too_large(bag, shared_data):
    for recording, expected, window in (
        (bag("loader_edge_cases/nj60_single_front_no_effort"), 1.28, 0.3),
        (read_delta(shared_data), 2.3, 0.5),
    ):
        for position, velocity in zip(recording.position.T, recording.velocity.T, strict=True):
            found = velocity_mismatch(recording.time, position, velocity, "velocity", window)
            assert found.ratio == pytest.approx(expected, rel=0.02)


def test_a_sampling_rate_that_was_only_stated(shared_data):
    """1 kHz is said of it, but velocity and position agree at 694 Hz."""
    for recording in read_panda(shared_data):
        for k in range(2):
            found = velocity_mismatch(
                recording.time, recording.position[:, k], recording.velocity[:, k], "velocity"
            )
            assert found.ratio == pytest.approx(0.694, rel=0.01)
            assert "log.sampling_rate" in found.sentence


# --- sign of the force ---------------------------------------------------------------------------


def test_sign_by_energy_flow():
    velocity = np.stack([np.sin(TIME), np.cos(2 * TIME)], axis=1)
    force = 8.0 * velocity + np.random.default_rng(3).standard_normal((3000, 2))
    found = sign_check(force, velocity)
    assert found.sign is Sign.EXPECTED and found.power == pytest.approx(
        np.mean(np.sum(force * velocity, axis=1))
    )
    assert found.sentence.startswith("sign of the force as expected: the human puts 8")
    reversed_ = sign_check(-force, velocity)
    assert reversed_.sign is Sign.REVERSED and "set log.force_direction" in reversed_.sentence
    noise = np.random.default_rng(4).standard_normal((3000, 2))
    unknown = sign_check(noise, velocity)
    assert unknown.sign is Sign.UNKNOWN and "cannot be told" in unknown.sentence
    assert sign_check(-force, velocity, np.ones_like(force)).sign is Sign.UNKNOWN


@pytest.mark.parametrize(
    "run", [*(f"rail/{k}" for k in "123"), *(f"acc_rail/{k}" for k in "123"), "acc_twobag/l2"]
)
def test_people_guide_a_real_robot(bag, run):
    recording = bag(run)
    assert sign_check(recording.force, recording.velocity).sign is Sign.EXPECTED
    assert sign_check(-recording.force, recording.velocity).sign is Sign.REVERSED


def test_a_robot_that_leads_tells_nothing(shared_data, bag):
    for recording in (read_iiwa(shared_data), bag("loader_edge_cases/var_wd_cc_1_590ms_gap")):
        assert sign_check(recording.force, recording.velocity).sign is Sign.UNKNOWN


# --- units ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("quantity", "factor", "probable"),
    [("position", 1e3, "mm"), ("velocity", 1e3, "mm/s"), ("force", 1e3, "mN"), ("force", 1e-3, "kN")],
)
def test_units(quantity, factor, probable):
    values = np.stack([SMOOTH, 0.1 * SMOOTH], axis=1) * (1.0 if quantity == "force" else 0.03)
    assert unit_check(quantity, values) is None
    found = unit_check(quantity, factor * values)
    assert found.probable == probable
    assert f"set log.units.{quantity}, probably to {probable}" in found.sentence


def test_a_robot_at_rest_has_no_unit():
    assert unit_check("position", np.zeros((10, 2))) is None
    assert unit_check("position", 1e-7 * SMOOTH[:, None]) is None


def test_real_millimetres(shared_data):
    recording = read_delta(shared_data)
    assert unit_check("position", recording.position) is None
    assert unit_check("position", 1e3 * recording.position).probable == "mm"


# --- nothing wrong -------------------------------------------------------------------------------


@pytest.mark.parametrize("task", [Flower(), FigureEight(), Reaches()])
@pytest.mark.parametrize("perturbation", [Unperturbed(), BandLimitedForce(2.0)])
@pytest.mark.parametrize(
    "sensors", [Sensors(), Sensors(Sensor(0.05, resolution=0.05), Sensor(resolution=1e-5))]
)
def test_a_clean_recording_gives_no_findings(task, perturbation, sensors):
    experiment = Experiment(
        [Subject("P", pace=Pace(8.0))], task, 1, 1, perturbation=perturbation, sensors=sensors
    )
    (trial,) = simulate(experiment, seed=4).trials
    velocity = np.gradient(trial.position, trial.time, axis=0)
    speed = np.linalg.norm(velocity, axis=1)
    for k in range(2):
        x, v, u = trial.position[:, k], velocity[:, k], trial.force[:, k]
        assert [check(u, "force") for check in (dead_band, saturation, held_samples)] == [None] * 3
        assert held_samples(x, "position") is None
        assert force_at_rest(trial.time, u, speed, "force") is None
        assert velocity_mismatch(trial.time, x, v, "velocity") is None
    for quantity, values in (("position", trial.position), ("velocity", velocity), ("force", trial.force)):
        assert unit_check(quantity, values) is None
    assert sign_check(trial.force, velocity, trial.perturbation).sign is not Sign.REVERSED
