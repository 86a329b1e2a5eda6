"""Ranks of a correct model are uniform; those of a model with one injected error are not, for each that was feared."""

from tiny import configuration, settings

from bayes_impedance.calibration.run import Calibration, calibrate
from bayes_impedance.sampling import density as density_module
from bayes_impedance.sampling.density import JointDensity
from bayes_impedance.simulation import generative
from bayes_impedance.simulation.interaction import impedance_force

CONFIG = configuration(device={"mass": 0.7, "damping": 1.0})
#: What an error has to be as improbable as.
IMPOSSIBLE = 1e-4


def p_values(calibration: Calibration) -> dict[str, float]:
    return {found.name: found.p for found in calibration.uniformity}


def verdicts(calibration: Calibration) -> dict[str, str]:
    return {found.name: found.verdict for found in calibration.uniformity}


def test_ranks_of_the_model_itself_are_uniform() -> None:
    calibration = calibrate(settings(CONFIG), draws=60)
    assert calibration.remarks() == []
    assert set(verdicts(calibration)) == {
        "log stiffness x", "log damping x", "log mass x", "desired trajectory sd x", "noise sd x",
        "desired position x, phase 0.26", "desired position x, phase 0.65",
    }  # fmt: skip
    assert set(verdicts(calibration).values()) == {"uniform"}


def test_a_wrong_sign_of_the_error_is_caught(monkeypatch) -> None:
    monkeypatch.setattr(
        generative, "impedance_force", lambda matrices, error: -impedance_force(matrices, error)
    )
    calibration = calibrate(settings(CONFIG), draws=20)
    assert p_values(calibration)["noise sd x"] < IMPOSSIBLE
    assert "biased high" in verdicts(calibration)["noise sd x"]


def test_a_missing_jacobian_of_hyperparameters_is_caught(monkeypatch) -> None:
    right = JointDensity.log_density

    def over_values(self, standard):
        # The density of σ where that of log σ belongs.
        values = self.values(standard)
        return right(self, standard) - sum(
            values[p.name].log().sum() for p in self.parameters if p.median is not None
        )

    monkeypatch.setattr(JointDensity, "log_density", over_values)
    # So little of it shows in the force that the prior remains.
    trajectory = {"mean": "reference", "sd": 0.005, "length_scale": {"phase": {"median": 0.2, "log_sd": 2.0}}}
    noise = {"median": 2.0, "log_sd": 0.3}
    config = configuration(model={"desired_trajectory": trajectory, "noise_sd": noise})
    calibration = calibrate(settings(config), draws=24)
    assert p_values(calibration)["desired trajectory length scale phase x"] < IMPOSSIBLE
    assert "biased low" in verdicts(calibration)["desired trajectory length scale phase x"]


def test_a_missing_jacobian_of_the_closed_loop_is_caught(monkeypatch) -> None:
    monkeypatch.setattr(
        density_module, "log_jacobian", lambda loop, impedance, valid, coupled: impedance.sum() * 0.0
    )
    calibration = calibrate(settings(CONFIG), draws=20)
    assert p_values(calibration)["log mass x"] < IMPOSSIBLE
    assert "biased low" in verdicts(calibration)["log mass x"]
