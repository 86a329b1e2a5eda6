"""Axes and groups in one batch beside a loop over them: value and gradient of the training objective."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import pytest

from bayes_impedance.config import parse_config
from bayes_impedance.features import FeatureMap
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import build_force_model
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from bayes_impedance.training import objective
from bayes_impedance.trajectory_mean import TrajectoryMean
from benchmarks.paired import paired

CONFIG = parse_config(
    {"model": {"trajectory_input": "phase", "desired_trajectory": {"mean": "trial_average"}}}
)


def step_of(log: PreparedLog, axis: int | None = None):
    """Objective and gradient, of all axes or of one; θ and ξ are the same for both."""
    feature_map = FeatureMap(CONFIG, log.axes)
    features = feature_map(log, TrajectoryMean.from_training(CONFIG.model.desired_trajectory, log))
    if axis is None:
        model = build_force_model(CONFIG, feature_map)
    else:
        one = slice(axis, axis + 1)
        features = replace(
            features,
            inputs=features.inputs[one],
            force=features.force[one],
            trajectory_mean=features.trajectory_mean[one],
        )
        # Hyperparameters of one axis over inputs that still hold all of them.
        alone = copy(feature_map)
        alone.axes = log.axes[one]
        alone.labels = feature_map.labels
        model = build_force_model(CONFIG, alone)

    def step() -> float:
        value = objective(model, features, 1e-10)[0].sum()
        value.backward()
        return value.item()

    return step


def _loop(steps):
    return lambda: [step() for step in steps]


@pytest.mark.parametrize("samples", [50, 100])
def test_two_axes(benchmark, figures, samples):
    motion = repeated_motion(repetitions=2, duration=2.0, rate=samples / 4.0)
    log = draw_force(CONFIG.model_copy(update={"model": _drawable()}), motion, seed=0)
    together, apart = step_of(log), _loop([step_of(log, 0), step_of(log, 1)])
    figures[f"two_axes_{samples}_samples_over_loop"] = paired(together, apart, rounds=30, calls=3)
    benchmark.pedantic(together, rounds=10)


@pytest.mark.parametrize("samples", [50, 100])
def test_eight_groups(benchmark, figures, samples):
    logs = []
    for group in range(8):
        motion = repeated_motion(2, 2.0, samples / 4.0, axes=("x",), seed=group, group=str(group))
        logs.append(draw_force(CONFIG.model_copy(update={"model": _drawable()}), motion, seed=group))
    everyone = PreparedLog(logs[0].axes, tuple(trial for log in logs for trial in log.trials))
    together, apart = step_of(everyone), _loop([step_of(log) for log in logs])
    figures[f"eight_groups_{samples}_samples_over_loop"] = paired(together, apart, rounds=20, calls=2)
    benchmark.pedantic(together, rounds=10)


def _drawable():
    """The same model with a known path, from which force can be drawn."""
    return CONFIG.model.model_copy(
        update={
            "desired_trajectory": CONFIG.model.desired_trajectory.model_copy(update={"mean": "reference"})
        }
    )
