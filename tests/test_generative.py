"""Data drawn from the model: products as they stand, with the moments that the kernel claims."""

import numpy as np
import pytest
import torch

from bayes_impedance.config import Config, parse_config
from bayes_impedance.features import FeatureMap
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial
from bayes_impedance.priors import build_force_model
from bayes_impedance.simulation.generative import as_recording, draw_force, repeated_motion
from bayes_impedance.trajectory_mean import TrajectoryMean

IMPEDANCE = ("stiffness", "damping", "mass")
RESIDUAL = {"sd": 0.4, "input": ["position", "velocity"]}


def configuration(**model: object) -> Config:
    defaults = {
        "trajectory_input": "phase",
        "desired_trajectory": {"mean": "reference", "sd": 0.02},
        "stiffness": {"level": 200, "log_sd": 0.3, "input": ["phase"]},
        "damping": {"level": 15, "log_sd": 0.2, "input": ["position"]},
        "mass": {"level": 1.5, "sd": 0.3},
        "residual": RESIDUAL,
        "noise_sd": 0.5,
    }
    return parse_config({"model": defaults | model})


CONFIGURATIONS = {
    "phase": configuration(),
    "time": configuration(
        trajectory_input="time",
        desired_trajectory={"mean": "equilibrium", "sd": 0.02, "kernel": "matern72"},
        stiffness={"level": 200, "log_sd": 0.4},
        residual={**RESIDUAL, "offset_sd": 1.0},
    ),
    "gp": configuration(
        stiffness={"prior": "gp", "level": 200, "sd": 40, "input": ["phase"]},
        damping={"prior": "gp", "level": 15, "sd": 3},
        residual=None,
    ),
    "position_velocity": configuration(
        trajectory_input="position_velocity",
        stiffness={"level": 200, "log_sd": 0.3, "input": ["position", "velocity"]},
    ),
}


def hand(trial: PreparedTrial, order: int) -> np.ndarray:
    return (trial.position, trial.velocity, trial.acceleration)[order]


def desired(trial: PreparedTrial, order: int, axis: str) -> np.ndarray:
    return trial.truth[f"desired_{('position', 'velocity', 'acceleration')[order]}_{axis}"]


def explained(trial: PreparedTrial, a: int, axis: str) -> np.ndarray:
    """Σ_j w_j e⁽ʲ⁾ + ũ from the truth beside the force."""
    total = trial.truth[f"residual_force_{axis}"].copy()
    for order, name in enumerate(IMPEDANCE):
        total += trial.truth[f"{name}_{axis}{axis}"] * (
            desired(trial, order, axis) - hand(trial, order)[:, a]
        )
    return total


def bits(log: PreparedLog) -> str:
    return log.fingerprint()


# --- motion --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fine():
    """Motion sampled so finely that central differences err by less than 1e-4 of the scale."""
    return repeated_motion(repetitions=2, duration=2.0, rate=2000.0, axes=("x", "y", "z"), seed=5)


def slope(values: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Central differences, without the ends."""
    rise = values[2:] - values[:-2]
    return rise / (time[2:] - time[:-2]).reshape(-1, *[1] * (values.ndim - 1))


def agree(derivative: np.ndarray, values: np.ndarray, time: np.ndarray) -> None:
    scale = np.abs(derivative).max()
    np.testing.assert_allclose(slope(values, time), derivative[1:-1], atol=2e-4 * scale)


def test_every_derivative_of_the_motion_is_exact(fine):
    for trial in fine.trials:
        agree(trial.velocity, trial.position, trial.time)
        agree(trial.acceleration, trial.velocity, trial.time)
        agree(trial.reference_velocity, trial.reference, trial.time)
        agree(trial.reference_acceleration, trial.reference_velocity, trial.time)
        agree(trial.phase_velocity, trial.phase, trial.time)
        agree(trial.phase_acceleration, trial.phase_velocity, trial.time)


def test_jerk_lacks_only_that_of_the_phase(fine):
    for trial in fine.trials:
        # dx/dφ times the third derivative of φ
        third = slope(trial.phase_acceleration, trial.time)
        lacking = (trial.reference_velocity / trial.phase_velocity[:, None])[1:-1] * third[:, None]
        jerk = trial.jerk[1:-1] + lacking
        np.testing.assert_allclose(
            slope(trial.acceleration, trial.time), jerk, atol=2e-4 * np.abs(trial.jerk).max()
        )
        # It is small beside the jerk that the perturbation brings.
        assert np.abs(lacking).max() < 0.2 * np.abs(trial.jerk).max()


def test_phase_increases_within_the_unit_interval():
    for seed in range(20):
        for trial in repeated_motion(repetitions=3, duration=3.0, rate=100.0, seed=seed).trials:
            assert trial.phase[0] == pytest.approx(0.01)
            assert (np.diff(trial.phase) > 0).all()
            assert (trial.phase_velocity > 0).all()
            assert trial.phase[-1] < 1


def test_shape_of_the_motion():
    motion = repeated_motion(repetitions=3, duration=1.5, rate=40.0, axes=("y",), group="left", seed=1)
    assert motion.axes == ("y",)
    assert [trial.name for trial in motion.trials] == ["0", "1", "2"]
    assert motion.groups == ("left",)
    for trial in motion.trials:
        assert trial.position.shape == (60, 1)
        assert trial.time[-1] == pytest.approx(1.475)
        assert trial.force is None


def test_displacement_has_the_stated_size():
    """SD over repetitions, whose phases are drawn: each displacement is a sum of five sinusoids."""
    motion = repeated_motion(repetitions=400, duration=0.1, rate=10.0, displacement_sd=0.03, seed=2)
    first = np.array([(trial.position - trial.reference)[0] for trial in motion.trials]).ravel()
    n = first.size
    assert abs(first.mean()) < 5 * 0.03 / np.sqrt(n)
    # Kurtosis of the sum: 3 − 1.5 / 5, so the SE of its variance is σ² √((2.7 − 1) / n).
    assert abs(first.var() - 0.03**2) < 5 * 0.03**2 * np.sqrt(1.7 / n)
    still = repeated_motion(repetitions=1, displacement_sd=0.0).trials[0]
    np.testing.assert_array_equal(still.position, still.reference)


def test_same_seed_gives_the_same_bits():
    motions = [repeated_motion(repetitions=2, duration=1.0, rate=20.0, seed=seed) for seed in (4, 4, 5)]
    assert bits(motions[0]) == bits(motions[1]) != bits(motions[2])
    draws = [draw_force(CONFIGURATIONS["phase"], motions[0], seed) for seed in (7, 7, 8)]
    assert bits(draws[0]) == bits(draws[1]) != bits(draws[2])


def test_drawing_does_not_disturb_the_generators_of_others():
    torch.manual_seed(1)
    before = torch.get_rng_state()
    motion = repeated_motion(repetitions=1, duration=1.0, rate=20.0)
    draw_force(CONFIGURATIONS["phase"], motion, seed=3)
    assert torch.equal(torch.get_rng_state(), before)


# --- force ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_force_is_the_sum_of_its_parts(name):
    quiet = parse_config(CONFIGURATIONS[name].model_dump(), overrides=["model.noise_sd=1e-9"])
    drawn = draw_force(quiet, repeated_motion(repetitions=2, duration=1.0, rate=30.0, seed=1), seed=2)
    for trial in drawn.trials:
        for a, axis in enumerate(drawn.axes):
            u = trial.force[:, a]
            np.testing.assert_allclose(u, explained(trial, a, axis), atol=1e-8)
            assert np.abs(u).max() > 0.1


def test_noise_is_white_with_its_sd():
    motion = repeated_motion(repetitions=2, duration=5.0, rate=50.0, seed=1)
    drawn = draw_force(CONFIGURATIONS["phase"], motion, seed=2)
    noise = np.concatenate(
        [
            trial.force[:, a] - explained(trial, a, axis)
            for trial in drawn.trials
            for a, axis in enumerate("xy")
        ]
    )
    n = noise.size
    assert n == 1000
    assert abs(noise.mean()) < 5 * 0.5 / np.sqrt(n)
    assert abs(noise.var() - 0.25) < 5 * 0.25 * np.sqrt(2 / n)
    assert abs(np.mean(noise[1:] * noise[:-1])) < 5 * 0.25 / np.sqrt(n)


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_moments_of_the_force_are_those_of_the_kernel(name):
    """Mean and variance over draws of everything, within five standard errors at every sample."""
    config, draws = CONFIGURATIONS[name], 400
    motion = repeated_motion(repetitions=2, duration=0.8, rate=5.0, seed=6)
    feature_map = FeatureMap(config, motion.axes)
    mean = TrajectoryMean.from_training(config.model.desired_trajectory, motion)
    inputs = feature_map(motion, mean).inputs
    model = build_force_model(config, feature_map)
    with torch.no_grad():
        expected = model.prior_mean(inputs)[:, 0].numpy()
        variance = (model.kernel(inputs, diag=True) + model.noise_variance)[:, 0].numpy()
    drawn = np.array(
        [
            np.concatenate([trial.force for trial in draw_force(config, motion, seed).trials]).T
            for seed in range(draws)
        ]
    )
    assert drawn.shape == (draws, 2, 8)
    deviation = drawn - expected
    assert (np.abs(deviation.mean(axis=0)) < 5 * np.sqrt(variance / draws)).all()
    squares = deviation**2
    # The force is no Gaussian: its own fourth moment tells the standard error.
    error = squares.std(axis=0) / np.sqrt(draws)
    assert (np.abs(squares.mean(axis=0) - variance) < 5 * error).all()
    # And the test would notice a tenth of the variance.
    assert (error < 0.2 * variance).all()


def test_trials_of_a_group_share_what_the_model_shares():
    config = configuration(
        stiffness={"level": 200, "log_sd": 0.3}, damping={"level": 15, "log_sd": 0.3}, residual=None
    )
    motion = repeated_motion(repetitions=2, duration=1.0, rate=20.0, seed=1)
    others = repeated_motion(repetitions=1, duration=1.0, rate=20.0, seed=2, group="left")
    drawn = draw_force(config, PreparedLog(motion.axes, (*motion.trials, *others.trials)), seed=3)
    for name in IMPEDANCE:
        values = [np.unique(trial.truth[f"{name}_xx"].round(9)) for trial in drawn.trials]
        assert [value.size for value in values] == [1, 1, 1]
        assert values[0] == values[1]
        assert values[0] != values[2]
    # At equal phase both repetitions aim alike, relative to the reference at that phase.
    first, second, _ = drawn.trials
    gap = [desired(trial, 0, "x") - trial.reference[:, 0] for trial in (first, second)]
    at = np.linspace(0.1, 0.9, 9)
    curves = [np.interp(at, trial.phase, values) for trial, values in zip((first, second), gap, strict=True)]
    np.testing.assert_allclose(*curves, atol=2e-3)
    assert np.abs(curves[0]).max() > 5e-3


def test_desired_derivatives_belong_together():
    """Velocity and acceleration of x_d are the derivatives of its position, though drawn at samples alone."""
    motion = repeated_motion(repetitions=1, duration=1.0, rate=200.0, seed=1)
    (trial,) = draw_force(CONFIGURATIONS["time"], motion, seed=4).trials
    for order in (0, 1):
        exact = desired(trial, order + 1, "x")
        # Step² / 6 of a third derivative that is some (2π · 5 Hz)² of the first.
        np.testing.assert_allclose(
            slope(desired(trial, order, "x"), trial.time), exact[1:-1], atol=0.02 * np.abs(exact).max()
        )


# --- recording -----------------------------------------------------------------------------------


def test_recording_holds_what_a_logger_sees_and_the_truth():
    drawn = draw_force(
        CONFIGURATIONS["phase"], repeated_motion(repetitions=2, duration=1.0, rate=20.0), seed=1
    )
    log = as_recording(drawn)
    assert (log.axes, log.n_samples) == (("x", "y"), 40)
    for mine, its in zip(log.trials, drawn.trials, strict=True):
        assert (mine.name, mine.group) == (its.name, its.group)
        assert mine.velocity is mine.acceleration is mine.reference is None
        for name in ("time", "position", "force", "phase"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(its, name))
        assert set(mine.truth) == set(its.truth)
        assert len(mine.truth) == 2 * (3 + 1 + 3)
    kept = as_recording(drawn, keep_reference=True).trials[0]
    np.testing.assert_array_equal(kept.reference, drawn.trials[0].reference)
