"""Training: the maximum and curvature that the oracles' objective has, where it starts, what it leaves alone.

Determinism, restarts, interruption and failure: test_posterior.py. Continuing after a kill: test_journal.py.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import pytest
import torch
from oracles import MODEL, configuration, feature_map, oracle_of, samples_of
from scipy.optimize import minimize

from bayes_impedance import training
from bayes_impedance.config import Config
from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.features import Features
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import ForceModel, build_force_model
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from bayes_impedance.training import TrainingReport, train
from bayes_impedance.trajectory_mean import TrajectoryMean

#: Learned, with hyperprior median and log-SD; all else is fixed at what the data were drawn from.
LEARNED = {"stiffness.level": (150.0, 0.6), "mass.level": (0.8, 0.5), "noise_sd": (0.4, 1.0)}

Density = Callable[[np.ndarray], float]


def configured(values: dict[str, object], *overrides: str) -> Config:
    return configuration(
        ("training.restarts=1", "training.gradient_tolerance=1e-6", "engine.jitter=0", *overrides),
        stiffness={**MODEL["stiffness"], "level": values["stiffness.level"]},
        mass={"level": values["mass.level"], "sd": 0.2},
        noise_sd=values["noise_sd"],
    )


LEARNING = configured({name: {"median": m, "log_sd": s} for name, (m, s) in LEARNED.items()})


@pytest.fixture(scope="module")
def log() -> PreparedLog:
    motion = repeated_motion(repetitions=2, duration=2.0, rate=6.0, axes=("x",), seed=4)
    return draw_force(configuration(), motion, seed=4)


@pytest.fixture(scope="module")
def density(log: PreparedLog) -> Density:
    """Log posterior density over the logarithms of LEARNED, up to a constant, by the oracles alone."""
    samples = samples_of(LEARNING, log, 0)
    force = torch.from_numpy(
        np.concatenate([trial.force[:, 0] for trial in log.trials if trial.force is not None])
    )

    def at(logs: np.ndarray) -> float:
        values = dict(zip(LEARNED, np.exp(logs).tolist(), strict=True))
        oracle = oracle_of(configured(dict(values)), axes=1)
        covariance = oracle.covariance(samples, samples).detach()
        covariance = covariance + values["noise_sd"] ** 2 * torch.eye(len(force), dtype=torch.float64)
        likelihood = torch.distributions.MultivariateNormal(oracle.mean(samples).detach(), covariance)
        medians, widths = np.array(list(LEARNED.values())).T
        return float(likelihood.log_prob(force)) - 0.5 * float(
            np.sum(((logs - np.log(medians)) / widths) ** 2)
        )

    return at


@pytest.fixture(scope="module")
def trained(log: PreparedLog) -> ImpedanceModel:
    return ImpedanceModel(LEARNING).fit(log)


def logs_of(model: ImpedanceModel) -> np.ndarray:
    values = {entry.name: float(entry.value.detach().reshape(-1)[0]) for entry in model.hyperparameters}
    return np.log([values[name] for name in LEARNED])


def problem(config: Config, log: PreparedLog) -> tuple[ForceModel, Features]:
    mapping = feature_map(config, log)
    mean = TrajectoryMean.from_training(config.model.desired_trajectory, log)
    return build_force_model(config, mapping), mapping(log, mean)


def train_again(model: ImpedanceModel, log: PreparedLog, warm: bool) -> tuple[ForceModel, TrainingReport]:
    _, features = problem(model.config, log)
    force_model = copy.deepcopy(model.fitted.force_model)
    report = train(force_model, features, model.config.training, model.config.engine.jitter, warm=warm)
    return force_model, report


# --- the maximum ---------------------------------------------------------------------------------


def test_the_optimum_is_that_of_another_optimiser_on_another_objective(trained, log, density):
    found = logs_of(trained)
    other = minimize(
        lambda logs: -density(logs),
        np.log([100.0, 1.2, 0.2]),
        method="Nelder-Mead",
        options={"xatol": 1e-4, "fatol": 1e-7},
    )
    assert density(found) == pytest.approx(-other.fun, abs=1e-4)
    np.testing.assert_allclose(found, other.x, atol=0.01)


def test_reported_likelihood_is_that_of_the_oracles(trained, density):
    medians, widths = np.array(list(LEARNED.values())).T
    found = logs_of(trained)
    prior = -0.5 * float(np.sum(((found - np.log(medians)) / widths) ** 2))
    assert trained.report.log_likelihood[0] == pytest.approx(density(found) - prior, abs=1e-7)


def test_laplace_standard_deviations_are_those_of_the_oracles_curvature(trained, density):
    found, step = logs_of(trained), 0.02
    steps = step * np.eye(len(LEARNED))
    hessian = np.array(
        [
            [
                (
                    density(found + a + b)
                    - density(found + a - b)
                    - density(found - a + b)
                    + density(found - a - b)
                )
                / (4 * step**2)
                for a in steps
            ]
            for b in steps
        ]
    )
    expected = np.sqrt(np.diag(np.linalg.inv(-hessian)))
    reported = [trained.report.log_sd[name][0][0] for name in LEARNED]
    np.testing.assert_allclose(reported, expected, rtol=0.01)


def test_what_is_fixed_stays_to_the_bit(trained, log):
    untrained, _ = problem(LEARNING, log)
    for entry, before in zip(trained.hyperparameters, untrained.entries, strict=True):
        changed = entry.raw.detach().numpy().tobytes() != before.raw.detach().numpy().tobytes()
        assert changed == (entry.name in LEARNED), entry.name
        assert (entry.name in trained.report.log_sd) == (entry.name in LEARNED)


# --- starts --------------------------------------------------------------------------------------


def test_warm_it_starts_where_the_model_stands_and_stays_there(trained, log):
    force_model, report = train_again(trained, log, warm=True)
    assert report.restarts[0].iterations <= 1
    assert report.restarts[0].evaluations < trained.report.restarts[0].evaluations
    assert report.objective[0] >= trained.report.objective[0]
    for entry, before in zip(force_model.entries, trained.hyperparameters, strict=True):
        np.testing.assert_allclose(entry.value.detach(), before.value.detach(), rtol=1e-3, err_msg=entry.name)


def test_cold_it_forgets_where_the_model_stands(trained, log):
    force_model, report = train_again(trained, log, warm=False)
    assert report.restarts[0].evaluations == trained.report.restarts[0].evaluations
    for entry, before in zip(force_model.entries, trained.hyperparameters, strict=True):
        assert torch.equal(entry.raw, before.raw)


def test_a_start_outside_the_bounds_is_brought_inside(log):
    force_model, features = problem(LEARNING, log)
    noise = next(entry for entry in force_model.entries if entry.name == "noise_sd")
    with torch.no_grad():
        noise.raw.add_(100.0)
    report = train(force_model, features, LEARNING.training, 0.0, warm=True)
    limit = np.log(LEARNED["noise_sd"][0]) + training.BOUND * LEARNED["noise_sd"][1]
    assert float(noise.value.detach().log().max()) < limit
    assert np.isfinite(report.objective).all()


# --- a likelihood that is not finite --------------------------------------------------------------


@pytest.mark.parametrize("broken", ["value", "gradient"])
def test_likelihood_that_is_nowhere_finite_is_an_error_and_no_interruption(log, monkeypatch, broken):
    def nowhere(model: ForceModel, *_: object) -> tuple[torch.Tensor, torch.Tensor]:
        raws = torch.stack([entry.raw.sum() for entry in model.entries])
        # The slope of √|x| at 0 is not finite.
        total = raws.sum() * torch.nan if broken == "value" else (raws - raws.detach()).abs().sqrt().sum()
        return total.reshape(1), total.detach().reshape(1)

    monkeypatch.setattr(training, "objective", nowhere)
    with pytest.raises(
        NotPositiveDefiniteError, match=r"found one that overflows, or its gradient does; check log"
    ):
        ImpedanceModel(LEARNING).fit(log)
