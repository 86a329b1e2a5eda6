"""Real recordings: a stiffness that is known, and one that cannot be known."""

from dataclasses import replace

import numpy as np
import pytest

from bayes_impedance.config import load_config, parse_config
from bayes_impedance.errors import LogWarning
from bayes_impedance.evaluation.cross_validation import cross_validate
from bayes_impedance.evaluation.folds import split
from bayes_impedance.identifiability import Support, caveat
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.log import InteractionLog
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.preprocessing import PreparedTrial
from bayes_impedance.readers import read_log


def verdict_on(model: ImpedanceModel, latent: Latent):
    return [verdict for verdict in model.verdicts() if verdict.latent is latent]


# --- a robot whose equilibrium was recorded ------------------------------------------------------

ROBOT = load_config(
    "recordings/iiwa_known_equilibrium", ["training.restarts=1", "training.max_iterations=20"]
)


@pytest.fixture(scope="module")
def robot_log(request):
    folder = request.getfixturevalue("shared_data") / "iiwa_known_equilibrium"
    (file,) = folder.glob("*.txt")
    return read_log(file, ROBOT.log)


@pytest.fixture(scope="module")
def robot(robot_log):
    return ImpedanceModel(ROBOT).fit(robot_log)


@pytest.fixture(scope="module")
def misled(robot_log):
    """The same model, told that the equilibrium came one second later."""
    (trial,) = robot_log.trials
    steps = 200
    assert trial.time[steps] - trial.time[0] == pytest.approx(1.0, abs=1e-6)
    late = np.concatenate([np.repeat(trial.reference[:1], steps, axis=0), trial.reference[:-steps]])
    return ImpedanceModel(ROBOT).fit(InteractionLog(robot_log.axes, (replace(trial, reference=late),)))


def line(trial: PreparedTrial) -> tuple[float, float]:
    """Stiffness [N/m] and offset [N] of u = k (x_d − x) + c by least squares."""
    slope, offset = np.polyfit((trial.reference - trial.position)[:, 0], trial.force[:, 0], 1)
    return float(slope), float(offset)


def residual_rms(model: ImpedanceModel) -> float:
    posterior = model.posterior(model.fitted.log)
    return float(np.sqrt(np.mean(posterior["residual_force"].mean ** 2)))


def test_stiffness_of_a_known_equilibrium_is_that_of_a_line(robot):
    (trial,) = robot.fitted.log.trials
    expected, _ = line(trial)
    # The README of the data says 138 N/m.
    assert expected == pytest.approx(138, abs=2)
    assert robot.posterior(robot.fitted.log)["stiffness"].mean.mean() == pytest.approx(expected, rel=0.05)


def test_stiffness_of_a_known_equilibrium_is_supported(robot):
    (verdict,) = verdict_on(robot, Latent.STIFFNESS)
    assert verdict.support is Support.SUPPORTED
    assert verdict.q05 < 138 < verdict.q95
    # The equilibrium is known, so no perturbation needs to be taken on trust.
    assert caveat(robot.verdicts(), robot.fitted.log, ROBOT) is None


def test_a_wrong_equilibrium_is_noticed(robot, misled):
    (right,), (wrong,) = robot.report.log_likelihood, misled.report.log_likelihood
    # 95 nats at the time of writing.
    assert right > wrong + 50
    assert residual_rms(misled) > 2 * residual_rms(robot)


def test_an_impedance_predicts_the_last_third_of_a_push(robot, robot_log):
    """The robot presses harder than it did before, where a naive GP knows nothing."""
    result = cross_validate(ImpedanceModel(ROBOT), robot_log, "last-third", ["naive", "without-residual"])
    scores = result["z"]
    assert scores["impedance"].n == robot.report.samples // 3
    assert scores["impedance"].smse < scores["naive"].smse / 100
    assert scores["impedance"].nlpd < scores["impedance_without_residual"].nlpd < scores["naive"].nlpd - 1
    # As good as a line through the first two thirds.
    (trial,) = robot.fitted.log.trials
    (beginning,) = split(robot.fitted.log, ROBOT, "last-third")[0].training.trials
    slope, offset = np.polyfit(
        (trial.reference - trial.position)[beginning.observed, 0], trial.force[beginning.observed, 0], 1
    )
    held_out = slice(-scores["impedance"].n, None)
    predicted = slope * (trial.reference - trial.position)[held_out, 0] + offset
    force = trial.force[held_out, 0]
    assert scores["impedance"].smse < 1.1 * np.mean((force - predicted) ** 2) / np.var(force)
    assert result.pooled.impedance_share["z"]["impedance"] == pytest.approx(1.0, abs=0.05)


# --- a person pushing a robot, with nothing known of where to ------------------------------------

PERSON = parse_config(
    {
        "log": {
            "columns": {
                "time": "t",
                "position": "{axis}",
                "velocity": "v{axis}",
                "force": "F{axis}",
                "acceleration": None,
                "reference": None,
                "perturbation": None,
            },
            "units": {"position": "mm", "velocity": "mm/s"},
            "window": {"start": 10, "end": 40},
        },
        # Samples come every 46 to 78 ms.
        "preprocessing": {"smoother": {"window": 0.5}, "rate": 5},
        "training": {"restarts": 1, "max_iterations": 10},
    }
)


def test_stiffness_of_a_person_who_is_only_watched_is_the_prior(shared_data):
    log = read_log(shared_data / "delta_robot" / "pHRI_test_experiment_dataset.csv", PERSON.log)
    assert log.axes == ("x", "y", "z")
    model = ImpedanceModel(PERSON).fit(log)
    verdicts = verdict_on(model, Latent.STIFFNESS)
    assert [verdict.axis for verdict in verdicts] == ["x", "y", "z"]
    for verdict in verdicts:
        assert verdict.support is Support.PRIOR_ONLY
        assert verdict.sentence.startswith(f"stiffness {verdict.axis}{verdict.axis}: prior only; ")
        assert "with the equilibrium mean" in verdict.sentence
        # As wide as the hyperprior: two orders of magnitude.
        assert verdict.q95 / verdict.q05 > 20


def test_millimetres_taken_for_metres_are_noticed(shared_data):
    units = PERSON.log.units.model_copy(update={"position": "m"})
    with pytest.warns(LogWarning, match=r"position_z spans 12.* m, .*; check log\.units\.position"):
        read_log(
            shared_data / "delta_robot" / "pHRI_test_experiment_dataset.csv",
            PERSON.log.model_copy(update={"units": units}),
        )
