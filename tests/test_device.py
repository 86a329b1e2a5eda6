"""The law of a device, as a check on a log and as source of acceleration; the simulated loop; what is recovered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bayes_impedance.config import DeviceConfig, PreprocessingConfig, parse_config
from bayes_impedance.device import Loop, follow_law
from bayes_impedance.errors import ConfigurationError, LogError, LogWarning
from bayes_impedance.log import InteractionLog
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.preprocessing import PreparedLog, prepare
from bayes_impedance.readers import read_log
from bayes_impedance.simulation.device import Admittance
from bayes_impedance.simulation.one_axis import ConstantImpedance, held_device
from bayes_impedance.writer import write_log
from conftest import Outcome

ARM, DEVICE = ConstantImpedance(), Admittance()
LAW = DeviceConfig.model_validate({"mass": 2.0, "damping": 6.0, "acceleration": "law"})
MEASURED = LAW.model_copy(update={"acceleration": "measured"})


@pytest.fixture(scope="module")
def log() -> InteractionLog:
    return held_device(ARM, DEVICE, perturbation_sd=2.0, repetitions=3, seed=1)


def test_written_log_trains_under_the_shipped_configuration(
    log: InteractionLog, tmp_path: Path, command: Callable[..., Outcome]
) -> None:
    write_log(log, tmp_path / "log.csv")
    np.testing.assert_array_equal(
        read_log(tmp_path / "log.csv").trials[1].perturbation, log.trials[1].perturbation
    )
    quick = ("training.restarts=1", "training.max_iterations=2", "preprocessing.rate=10")
    settings = [argument for item in quick for argument in ("--set", item)]
    done = command(
        "train", tmp_path / "log.csv", "--config", "admittance", "--out", tmp_path / "model", *settings
    )
    assert (done.code, done.err) == (0, "")
    # The perturbation is recorded and the device is known, so nothing has to be taken on trust.
    assert "presume" not in done.out


@pytest.fixture(scope="module")
def prepared(log: InteractionLog) -> PreparedLog:
    return prepare(log, PreprocessingConfig())


def interior(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Without the half windows of the smoother at the ends."""
    return values[20:-20]


# --- the simulated loop ------------------------------------------------------------------------------


def test_simulated_motion_obeys_the_arm_and_the_device() -> None:
    log = held_device(ARM, DEVICE, perturbation_sd=2.0, noise_sd=0.0, repetitions=1, every=1, seed=1)
    trial = prepare(log, PreprocessingConfig.model_validate({"smoother": {"window": 0.02}})).trials[0]
    device = DEVICE.mass * trial.acceleration + DEVICE.damping * trial.velocity
    np.testing.assert_allclose(interior(device), interior(trial.force + trial.perturbation), atol=0.03)
    impedance = (
        ARM.stiffness * (trial.reference - trial.position)
        + ARM.damping * (trial.reference_velocity - trial.velocity)
        + ARM.mass * (trial.reference_acceleration - trial.acceleration)
    )
    residual = trial.truth["residual_force_x"][:, None]
    np.testing.assert_allclose(interior(impedance + residual), interior(trial.force), atol=0.03)


def test_simulated_signals_have_the_size_asked_for() -> None:
    log = held_device(ARM, DEVICE, perturbation_sd=3.0, residual_sd=0.5, repetitions=20, every=10, seed=0)
    perturbation = np.concatenate(
        [trial.perturbation for trial in log.trials if trial.perturbation is not None]
    )
    residual = np.concatenate([trial.truth["residual_force_x"] for trial in log.trials])
    assert perturbation.std() == pytest.approx(3.0, rel=0.1)
    assert residual.std() == pytest.approx(0.5, rel=0.1)
    # An SE process of length ℓ has a derivative of SD sd/ℓ.
    slope = np.diff(residual.reshape(20, -1), axis=1) / 0.01
    assert slope.std() == pytest.approx(0.5 / 0.1, rel=0.1)


def test_seed_decides_everything() -> None:
    one, again, other = (held_device(ARM, DEVICE, 1.0, repetitions=1, seed=s) for s in (3, 3, 4))
    np.testing.assert_array_equal(one.trials[0].force, again.trials[0].force)
    assert np.abs(one.trials[0].force - other.trials[0].force).max() > 0.1


# --- the law ------------------------------------------------------------------------------------------


def test_acceleration_by_the_law_is_that_of_force_and_perturbation(prepared: PreparedLog) -> None:
    followed = follow_law(prepared, LAW)
    for before, after in zip(prepared.trials, followed.trials, strict=True):
        expected = (before.force + before.perturbation - 6.0 * before.velocity) / 2.0
        np.testing.assert_allclose(after.acceleration, expected, rtol=1e-14)
        np.testing.assert_allclose(after.jerk[5, 0], np.gradient(expected[:, 0], before.time)[5], rtol=1e-10)
        assert np.abs(interior(after.acceleration - before.acceleration)).max() < 0.5
    # Once more changes nothing.
    again = follow_law(followed, LAW)
    np.testing.assert_array_equal(again.trials[0].acceleration, followed.trials[0].acceleration)


def test_measured_acceleration_stays(prepared: PreparedLog) -> None:
    assert follow_law(prepared, MEASURED) is prepared
    assert follow_law(prepared, DeviceConfig.model_validate({"mass": 2.0})) is prepared


def test_a_log_without_perturbation_column_was_not_perturbed(prepared: PreparedLog) -> None:
    silent = PreparedLog(prepared.axes, tuple(replace(t, perturbation=None) for t in prepared.trials))
    still = PreparedLog(
        prepared.axes, tuple(replace(t, perturbation=np.zeros_like(t.position)) for t in prepared.trials)
    )
    with pytest.warns(LogWarning, match="expected motion that follows the device"):
        accelerations = [follow_law(log, LAW).trials[0].acceleration for log in (silent, still)]
    np.testing.assert_array_equal(*accelerations)


@pytest.mark.parametrize(
    ("device", "flip"),
    [({"mass": 2.0, "damping": 60.0}, 1.0), ({"mass": 2.0, "damping": 6.0}, -1.0)],
    ids=["damping ten times too large", "force of the wrong sign"],
)
def test_a_device_that_contradicts_the_log_is_noticed(
    prepared: PreparedLog, device: dict[str, float], flip: float
) -> None:
    log = PreparedLog(prepared.axes, tuple(replace(t, force=flip * t.force) for t in prepared.trials))
    with pytest.warns(LogWarning, match=r"axis x: expected motion that follows the device.*explains \d+% of"):
        follow_law(log, DeviceConfig.model_validate(device))


def test_law_needs_force(prepared: PreparedLog) -> None:
    log = PreparedLog(prepared.axes, tuple(replace(t, force=None) for t in prepared.trials))
    with pytest.raises(
        LogError, match=r"memory, trial 0: expected force, from which device\.acceleration: law"
    ):
        follow_law(log, LAW)
    assert follow_law(log, MEASURED) is log


def test_an_axis_without_mass_is_named(prepared: PreparedLog) -> None:
    for device, words in (
        (
            {"mass": {"y": 2.0}},
            r"device\.mass: expected a mass \[kg\] for each of x, found none for x; add it, or give one number for all",
        ),
        ({"mass": 2.0, "damping": {"y": 1.0}}, r"device\.damping: expected a damping \[Ns/m\] for each of x"),
    ):
        with pytest.raises(ConfigurationError, match=words):
            follow_law(prepared, DeviceConfig.model_validate(device))


def test_loop_holds_one_step_a_group(prepared: PreparedLog) -> None:
    slow = tuple(replace(t, group="slow", time=2.0 * t.time) for t in prepared.trials)
    loop = Loop.of(PreparedLog(prepared.axes, prepared.trials + slow), LAW)
    np.testing.assert_allclose(loop.step.numpy(), [0.005, 0.01], rtol=1e-9)
    assert float(loop.one(0, 1).step) == float(loop.select([1]).step[0])
    assert float(loop.one(0, 0).device_damping) == 6.0
    assert float(Loop.of(prepared, DeviceConfig.model_validate({"mass": 2.0})).device_damping) == 0.0


# --- what is recovered --------------------------------------------------------------------------------


def test_prediction_on_a_log_of_the_device_knows_the_device(log: InteractionLog) -> None:
    """`law` acts on every log that the model sees, so a log without force is refused in words."""
    config = parse_config(
        {
            "device": {"mass": 2.0, "damping": 6.0, "acceleration": "law"},
            "preprocessing": {"rate": 10},
            "model": {"trajectory_input": "phase", "desired_trajectory": {"mean": "trial_average"}},
            "training": {"restarts": 1, "max_iterations": 2},
        }
    )
    model = ImpedanceModel(config).fit(log)
    silent = InteractionLog(log.axes, tuple(replace(trial, force=None) for trial in log.trials))
    with pytest.raises(LogError, match=r"set device\.acceleration=measured"):
        model.posterior(silent)


def test_with_a_known_trajectory_the_jacobian_keeps_the_mass_from_falling() -> None:
    """Known x_d, no perturbation: without the Jacobian the mass falls towards −M_r, with it the truth comes back."""
    log = held_device(ARM, DEVICE, perturbation_sd=0.0, residual_sd=0.4, repetitions=4, seed=2)

    def content(device: dict[str, object] | None) -> dict[str, object]:
        return {
            "preprocessing": {"rate": 25},
            "device": device,
            "model": {
                "trajectory_input": "phase",
                "desired_trajectory": {"mean": "reference", "sd": 0.0005, "length_scale": {"phase": 0.1}},
                "stiffness": {"level": {"median": 100, "log_sd": 1.0}, "log_sd": 0.05},
                "damping": {"level": {"median": 9, "log_sd": 1.0}, "log_sd": 0.05},
                "mass": {"level": 1.2, "sd": 5.0},
                "residual": {"sd": 0.4, "input": ["time"], "length_scale": {"time": 0.1}},
                "noise_sd": {"median": 0.05, "log_sd": 1.0},
            },
            "training": {"restarts": 1, "max_iterations": 30},
        }

    mass = {}
    for name, device in (
        ("with", {"mass": 2.0, "damping": 6.0, "acceleration": "law"}),
        ("without", None),
    ):
        model = ImpedanceModel(parse_config(content(device))).fit(log)
        mass[name] = model.posterior(model.fitted.log)["mass"].mean.mean()
    assert mass["without"] < 0.6
    assert mass["with"] == pytest.approx(1.2, abs=0.35)
