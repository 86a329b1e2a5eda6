"""A control loop's share of the clock: update and prediction of one sample, and memory over a million of them.

Two axes, settings of the paper (θ = position and velocity), fifty inducing inputs, three active cells.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bayes_impedance import ImpedanceModel, OnlinePredictor, Sample
from bayes_impedance.simulation.generative import draw_force, repeated_motion

pytestmark = pytest.mark.timeout(0)

SETTINGS = (
    "shared.residual=true",
    "model.drop_acceleration=true",
    "training.restarts=1",
    "training.max_iterations=20",
)
ROUNDS, TIMED = 15, 10_000
MILLION = 1_000_000


@pytest.fixture(scope="module")
def predictor() -> OnlinePredictor:
    model = ImpedanceModel.from_config("position_velocity", SETTINGS)
    motion = repeated_motion(repetitions=4, duration=4.0, rate=25.0, axes=("x", "y"))
    return OnlinePredictor(model.fit(draw_force(model.config, motion, seed=0)))


def stream(count: int, begin: float) -> Iterator[Sample]:
    """Samples along the motion of training at 1 kHz, with white forces: what they teach does not matter here."""
    motion = repeated_motion(repetitions=4, duration=4.0, rate=1000.0, axes=("x", "y"))
    parts = [(trial.position, trial.velocity, trial.acceleration) for trial in motion.trials]
    position, velocity, acceleration = (np.concatenate(part) for part in zip(*parts, strict=True))
    generator = np.random.default_rng(0)
    for t in range(count):
        i = t % len(position)
        force = generator.standard_normal(2)
        yield Sample(begin + 1e-3 * t, position[i], velocity[i], force, acceleration[i])


def test_update_and_predict(predictor, figures):
    """Rounds one after another, for a machine that others share has slow minutes: the middle one counts."""
    samples = list(stream(ROUNDS * TIMED, 1e3))
    milliseconds: NDArray[np.float64] = np.empty((len(samples), 2))
    for i, sample in enumerate(samples):
        begin = time.perf_counter()
        predictor.update(sample)
        between = time.perf_counter()
        predictor.predict(sample)
        milliseconds[i] = 1e3 * (between - begin), 1e3 * (time.perf_counter() - between)
    rounds = milliseconds.reshape(ROUNDS, TIMED, 2)
    both = rounds.sum(axis=2)
    medians, p99 = np.median(both, axis=1), np.quantile(both, 0.99, axis=1)
    figures["online_update_and_predict"] = {
        "median_milliseconds": float(np.median(medians)),
        "fastest_round_median_milliseconds": medians.min(),
        "slowest_round_median_milliseconds": medians.max(),
        "p99_milliseconds": float(np.median(p99)),
        "slowest_round_p99_milliseconds": p99.max(),
        "update_median_milliseconds": float(np.median(rounds[..., 0])),
        "predict_median_milliseconds": float(np.median(rounds[..., 1])),
        "cells": predictor.cells,
    }


def test_memory_over_a_million_samples(predictor, figures):
    resident = []
    for part in range(10):
        for sample in stream(MILLION // 10, 2e3 + 200.0 * part):
            predictor.update(sample)
        resident.append(resident_megabytes())
    figures["online_memory"] = {
        "samples": float(MILLION),
        "resident_megabytes_after_a_tenth": resident[0],
        "resident_megabytes_at_the_end": resident[-1],
        "peak_megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "cells": predictor.cells,
    }


def resident_megabytes() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 2**20
