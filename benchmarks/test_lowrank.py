"""Value and gradient given impedance on features, n = 10 000 and 100 000, and beside dense covariances at 2 000."""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from bayes_impedance.config import load_config
from bayes_impedance.engines.given_dense import DenseGivenImpedance
from bayes_impedance.engines.given_impedance import ConditionalEngine, Processes
from bayes_impedance.engines.lowrank import LowRankEngine
from bayes_impedance.features import FeatureMap, Features
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import ForceModel, build_force_model
from bayes_impedance.simulation.generative import repeated_motion
from bayes_impedance.trajectory_mean import TrajectoryMean
from benchmarks.paired import paired

#: Phase, ℓ = .15, one axis.
SETTINGS = (
    "model.desired_trajectory.mean=constant",
    "model.desired_trajectory.length_scale.phase=0.15",
    "model.residual=null",
)
#: A residual over time of its own for each trial besides.
OWN = (*SETTINGS[:2], "model.residual.input=[time]", "model.residual.length_scale.time=0.5")

MEMORY = """
import resource
from benchmarks.test_lowrank import LowRankEngine, problem, step
act = step(LowRankEngine, problem(100_000))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for _ in range(2):
    act()
print(before, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def problem(
    n: int, settings: tuple[str, ...] = SETTINGS, repetitions: int = 10
) -> tuple[Features, ForceModel]:
    """White forces along repetitions of ten seconds."""
    config = load_config("phase", settings)
    log = repeated_motion(repetitions, 10.0, n / repetitions / 10.0, axes=("x",))
    generator = np.random.default_rng(0)
    trials = (replace(trial, force=generator.standard_normal((trial.n_samples, 1))) for trial in log.trials)
    log = PreparedLog(log.axes, tuple(trials))
    feature_map = FeatureMap(config, log.axes)
    mean = TrajectoryMean.from_training(config.model.desired_trajectory, log)
    return feature_map(log, mean, observed=True), build_force_model(config, feature_map)


def step(
    kind: Callable[[Features, bool], ConditionalEngine], given: tuple[Features, ForceModel]
) -> Callable[[], float]:
    features, model = given
    engine = kind(features, False)
    levels = torch.tensor([300.0, 20.0, 1.5], dtype=torch.float64).reshape(1, 1, 3, 1, 1)
    impedance = levels.repeat(1, features.inputs.shape[2], 1, 1, 1).requires_grad_()

    def act() -> float:
        value = engine.log_likelihood_given_impedance(Processes.of(model), impedance).sum()
        value.backward()
        return value.item()

    return act


def seconds(function: Callable[[], float], rounds: int) -> float:
    function()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def test_peak_memory_of_the_process(figures):
    # Before dense covariances: a process counts what the one that starts it holds as its own peak.
    result = subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True)
    before, peak = (int(kilobytes) * 1024 / 1e9 for kilobytes in result.stdout.split())
    figures["lowrank_value_and_gradient_n100000_memory"] = {"gigabytes": peak, "gigabytes_before": before}


@pytest.mark.parametrize("n", [10_000, 100_000])
def test_value_and_gradient(n, figures):
    figures[f"lowrank_value_and_gradient_n{n}"] = {"seconds": seconds(step(LowRankEngine, problem(n)), 5)}


def test_value_and_gradient_with_a_residual_of_each_trial(figures):
    given = problem(10_000, OWN, repetitions=20)
    figures["lowrank_value_and_gradient_n10000_20_residuals"] = {
        "seconds": seconds(step(LowRankEngine, given), 5)
    }


def test_value_and_gradient_beside_dense_covariances(figures):
    given = problem(2000)
    figures["lowrank_value_and_gradient_n2000_over_dense"] = paired(
        step(LowRankEngine, given), step(DenseGivenImpedance, given), rounds=2
    )
