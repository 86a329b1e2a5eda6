"""Posteriors of many groups at once beside warm calls of one trial each, and the memory they take."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from bayes_impedance.config import load_config
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from benchmarks.inference_memory import trained_on
from benchmarks.paired import paired

GROUPS, SAMPLES = 64, 100
ROOT = Path(__file__).parents[1]
#: As `infer` runs: with every thread that torch has, and with one, as tests run.
THREADS = (torch.get_num_threads(), 1)


def model_of(name: str) -> tuple[ImpedanceModel, PreparedLog]:
    """A model at its medians that keeps the log of 64 groups, two axes, a hundred samples of each."""
    drawable = load_config(name, ["model.desired_trajectory.mean=reference"])
    trials = []
    for g in range(GROUPS):
        motion = repeated_motion(1, 4.0, SAMPLES / 4.0, seed=g, group=str(g))
        trials.append(replace(draw_force(drawable, motion, seed=g).trials[0], name=str(g)))
    log = PreparedLog(("x", "y"), tuple(trials))
    return trained_on(log, load_config(name)), log


@pytest.mark.parametrize("threads", sorted(set(THREADS)))
@pytest.mark.parametrize("name", ["phase", "coupled"])
def test_sixty_four_groups(benchmark, figures, name, threads):
    model, log = model_of(name)
    ones = [log.select([g]) for g in range(GROUPS)]

    def together() -> object:
        return model.posterior(log)

    def apart() -> object:
        return [model.posterior(one) for one in ones]

    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    figure = paired(together, apart, rounds=5)
    figures[f"infer_64_groups_{name}_over_calls_of_one_{threads}_threads"] = figure
    benchmark.pedantic(together, rounds=3)
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("kind", "size"), [("many", 500), ("many", 2000), ("long", 20_000), ("long", 200_000)]
)
def test_memory(figures, kind, size):
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.inference_memory", kind, str(size)],
        capture_output=True, text=True, check=True, cwd=ROOT,
    )  # fmt: skip
    figures[f"infer_memory_{kind}_{size}"] = json.loads(done.stdout)
