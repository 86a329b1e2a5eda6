"""Coupled axes beside independent ones: value and gradient of the training objective, and posteriors."""

from __future__ import annotations

import pytest

from bayes_impedance.config import load_config
from bayes_impedance.features import FeatureMap
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.priors import build_force_model
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from bayes_impedance.training import objective
from bayes_impedance.trajectory_mean import TrajectoryMean
from benchmarks.paired import paired

AXES = ("x", "y", "z")


def config_of(axes: str):
    return load_config("phase", [f"model.axes={axes}", "model.desired_trajectory.mean=reference"])


def log_of(samples: int, count: int):
    motion = repeated_motion(repetitions=4, duration=4.0, rate=samples / 16.0, axes=AXES[:count])
    return draw_force(config_of("coupled"), motion, seed=0)


def step_of(log, axes: str):
    """Objective and gradient of all axes."""
    config = config_of(axes)
    feature_map = FeatureMap(config, log.axes)
    features = feature_map(log, TrajectoryMean.from_training(config.model.desired_trajectory, log))
    model = build_force_model(config, feature_map)

    def step() -> float:
        value = objective(model, features, 1e-10)[0].sum()
        value.backward()
        return value.item()

    return step


@pytest.mark.parametrize(("samples", "count"), [(200, 2), (496, 2), (200, 3)])
def test_objective(benchmark, figures, samples, count):
    log = log_of(samples, count)
    coupled, independent = step_of(log, "coupled"), step_of(log, "independent")
    figures[f"coupled_{count}_axes_{samples}_samples_over_independent"] = paired(
        coupled, independent, rounds=8, calls=1
    )
    benchmark.pedantic(coupled, rounds=8)


def test_posterior(benchmark, figures):
    log = log_of(200, 2)

    def posterior_of(axes: str):
        model = ImpedanceModel(config_of(axes))
        return lambda: model.posterior(log)

    figures["coupled_posterior_200_samples_over_independent"] = paired(
        posterior_of("coupled"), posterior_of("independent"), rounds=8, calls=1
    )
    benchmark.pedantic(posterior_of("coupled"), rounds=8)
