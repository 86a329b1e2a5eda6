"""Share of the force that impedance explains, where it is known."""

from dataclasses import replace

import numpy as np
import pytest

from bayes_impedance.config import parse_config
from bayes_impedance.evaluation.explained import EXPLAINING, impedance_share
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.posterior import Marginal, Posterior
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.simulation.generative import repeated_motion

#: A known spring, damper and mass around a known path, and almost no noise.
FIXED = {
    "trajectory_input": "time",
    "desired_trajectory": {"mean": "reference", "sd": 1e-5, "length_scale": {"time": 0.4}},
    "stiffness": {"level": 150, "log_sd": 1e-3},
    "damping": {"level": 12, "log_sd": 1e-3},
    "mass": {"level": 1.2, "sd": 1e-3},
    "noise_sd": 0.01,
}
RESIDUAL = {"sd": 2.0, "input": ["time"], "length_scale": {"time": 0.4}}


def motion(**changes) -> PreparedLog:
    log = repeated_motion(2, 3.0, 20.0, seed=4)
    return PreparedLog(log.axes, tuple(replace(trial, **changes) for trial in log.trials))


def with_force(log: PreparedLog, force) -> PreparedLog:
    return PreparedLog(log.axes, tuple(replace(trial, force=force(trial)) for trial in log.trials))


def arm(trial) -> np.ndarray:
    """u = k (x_d − x) + d (ẋ_d − ẋ) + m (ẍ_d − ẍ)."""
    return (
        150 * (trial.reference - trial.position)
        + 12 * (trial.reference_velocity - trial.velocity)
        + 1.2 * (trial.reference_acceleration - trial.acceleration)
    )


def bias(trial) -> np.ndarray:
    return 3.0 * np.stack([np.sin(2.0 * trial.time), np.cos(3.0 * trial.time)], axis=1)


def share(log: PreparedLog, residual=None) -> np.ndarray:
    config = parse_config({"model": FIXED | {"residual": residual}})
    return impedance_share(ImpedanceModel(config).fit(log).posterior(log, latents=EXPLAINING))


@pytest.mark.parametrize("residual", [None, RESIDUAL])
def test_an_arm_explains_all_of_its_force(residual):
    np.testing.assert_allclose(share(with_force(motion(), arm), residual), 1.0, atol=1e-3)


def test_an_arm_that_aims_at_the_hand_explains_nothing():
    log = motion()
    still = PreparedLog(
        log.axes,
        tuple(
            replace(
                trial,
                reference=trial.position,
                reference_velocity=trial.velocity,
                reference_acceleration=trial.acceleration,
            )
            for trial in log.trials
        ),
    )
    np.testing.assert_allclose(share(with_force(still, bias), RESIDUAL), 0.0, atol=1e-3)


def test_a_known_arm_explains_its_part_of_the_variance():
    log = with_force(motion(), lambda trial: arm(trial) + bias(trial))
    impedance, rest = (np.concatenate([part(trial) for trial in log.trials]) for part in (arm, bias))
    expected = 1.0 - np.var(rest, axis=0) / np.var(impedance + rest, axis=0)
    assert ((expected > 0.1) & (expected < 0.9)).all()
    np.testing.assert_allclose(share(log, RESIDUAL), expected, atol=0.01)


def test_a_free_desired_trajectory_takes_whatever_there_is():
    """So a high share is no proof of the impedance: here there is no arm at all."""
    config = parse_config(
        {
            "model": FIXED
            | {
                "residual": None,
                "desired_trajectory": {"mean": "equilibrium", "sd": 1.0, "length_scale": {"time": 0.2}},
            }
        }
    )
    log = with_force(motion(), bias)
    share_ = impedance_share(ImpedanceModel(config).fit(log).posterior(log, latents=EXPLAINING))
    assert (share_ > 0.99).all()


def test_only_known_forces_count():
    """u = 1 … 4 N, the last unknown; impedance 1, 2, 2 N: variances of (0, 0, 1) and (1, 2, 3) are 2/9 and 2/3."""
    log = repeated_motion(1, 0.2, 20.0, axes=("x",))
    log = with_force(log, lambda _: np.array([[1.0], [2.0], [3.0], [np.nan]]))
    column, one = np.ones((4, 1)), np.ones((4, 1))
    mean = np.array([[1.5], [2.5], [2.5], [77.0]])
    marginals = {
        latent: Marginal(latent, False, values, one, 0 * one, one)
        for latent, values in zip(EXPLAINING, (mean, 0.5 * column), strict=True)
    }
    assert impedance_share(Posterior(log, marginals)) == pytest.approx([1 - (2 / 9) / (2 / 3)])
