"""Posteriors of every layout whose coordinates are drawn from a narrow prior: nothing samples, all else is as it is."""

from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np

from bayes_impedance.config import Config, load_config
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial
from bayes_impedance.preprocessing.prepared import ARRAYS
from bayes_impedance.sampling import sample as module
from bayes_impedance.sampling.drawn import DrawnPosterior
from bayes_impedance.sampling.draws import Draws
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from tests.impedance_functions.problems import MAP, MARKOV

#: Chains and draws of each.
CHAINS, DRAWS, PLACES = 2, 60, 9
SHORT = (*MAP, "engine.inducing=3", f"sampling.places={PLACES}")
CASES = {
    "groups": ("phase", (*MARKOV, *SHORT, "model.axes=coupled")),
    "inside one trial": ("phase", (*MARKOV, *SHORT, "model.damping.input=[]")),
    "time": ("time", SHORT),
    "times": ("time", SHORT),
    "position": ("position", SHORT),
    "own trajectories": ("phase", (*MARKOV, *SHORT, "shared.desired_trajectory=false")),
}


def config_of(case: str) -> Config:
    name, overrides = CASES[case]
    return load_config(name, overrides)


def motions(case: str) -> PreparedLog:
    """Trials of unequal length, or all repetitions in one."""
    if case == "inside one trial":
        return joined(repeated_motion(3, 2.0, 8.0, axes=("x", "y"), seed=1))
    first = repeated_motion(1 if case == "time" else 3, 2.0, 8.0, axes=("x", "y"), seed=1, group="b")
    if case == "time":
        return first
    second = repeated_motion(2, 2.5, 8.0, axes=("x", "y"), seed=2, group="a")
    trials = (first.trials[0], *second.trials, *first.trials[1:])
    named = tuple(replace(trial, name=f"{trial.group}{i}") for i, trial in enumerate(trials))
    return PreparedLog(first.axes, named)


def joined(log: PreparedLog) -> PreparedLog:
    """All trials as repetitions of one."""
    period = log.trials[0].time[1] - log.trials[0].time[0]
    arrays, start = {name: [] for name in ARRAYS}, 0.0
    for number, trial in enumerate(log.trials):
        for name in ARRAYS:
            arrays[name].append(getattr(trial, name))
        arrays["time"][-1] = trial.time + start
        arrays["repetition"][-1] = np.full(trial.n_samples, number)
        start = arrays["time"][-1][-1] + period
    whole = {name: np.concatenate(parts) for name, parts in arrays.items() if parts[0] is not None}
    return PreparedLog(log.axes, (PreparedTrial(name="all", group="g", source="memory", **whole),))


def from_prior(density, *_: object) -> Draws:
    """What stands for draws of a posterior."""
    generator = np.random.default_rng(5)
    shape = CHAINS, DRAWS
    stats = {
        "lp": generator.standard_normal(shape),
        "diverging": np.zeros(shape, dtype=bool),
        "n_steps": np.full(shape, 7),
        "energy": generator.standard_normal(shape),
    }
    return Draws("nuts", 0.4 * generator.standard_normal((*shape, density.size)), stats)


@cache
def drawn(case: str) -> DrawnPosterior:
    """Groups come in the order of the log, "b" before "a"; only forces of the log are given."""
    config = config_of(case)
    log = draw_force(config, motions(case), seed=3)
    with patch.object(module, "draw", from_prior):
        return ImpedanceModel(config).sample(log)
