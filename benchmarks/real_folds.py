"""Real recordings in the paper's setting: each run predicted from the others of its task, or its end from its start.

Every fold is predicted by the models of `benchmarks.paper_protocol`, whose naive GP is trained on the runs that are not
held out, and by an impedance model that learns all its hyperparameters from the same forces. Hyperpriors of what it
shares with the naive GP (residual and noise) and restarts are the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayes_impedance import ImpedanceModel, read_log
from bayes_impedance.config import Config, override_config
from bayes_impedance.evaluation.contenders import train_impedance
from bayes_impedance.evaluation.folds import Fold, Folds, split
from bayes_impedance.preprocessing import PreparedLog
from benchmarks.paper_protocol import KNOWN, NAIVE, Reuse, scores_of, settings
from benchmarks.results import RECORDINGS, Results

RESTARTS = 1

#: The model that learns its impedance, too.
LEARNED = "learned_impedance"


@dataclass(frozen=True)
class Task:
    """Runs of one task, the shipped configuration that reads them, samples a second, and what is held out."""

    source: str
    files: tuple[str, ...]
    rate: float = 10.0
    folds: Folds = "trials"

    @property
    def is_there(self) -> bool:
        """Whether the recordings are on this machine."""
        return all((RECORDINGS / file).is_file() for file in self.files)

    def prepared(self, config: Config) -> PreparedLog:
        """Samples of all runs."""
        return ImpedanceModel(config).prepare(
            read_log([RECORDINGS / file for file in self.files], config.log)
        )


def _bags(folder: str, runs: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"gp_mpc/{folder}/{run}.bag" for run in runs)


#: The twelve folds.
TWELVE: Mapping[str, Task] = {
    "acc_rail": Task("recordings/gp_mpc", _bags("acc_rail", ("1", "2", "3"))),
    "acc_twobag_l": Task("recordings/gp_mpc", _bags("acc_twobag", ("l1", "l2", "l3"))),
    "acc_twobag_r": Task("recordings/gp_mpc", _bags("acc_twobag", ("r1", "r2", "r3"))),
    "acc_twobag_rr": Task("recordings/gp_mpc", _bags("acc_twobag", ("rr1", "rr2", "rr3"))),
}
#: Runs on the rail last thrice as long.
TASKS: Mapping[str, Task] = {
    **TWELVE,
    "panda": Task("recordings/panda_comanipulation", ("panda_comanipulation/symbol_17_data.mat",)),
    "rail": Task("recordings/gp_mpc", _bags("rail", ("1", "2", "3")), 5.0, "last-third"),
}


def configuration(task: Task, overrides: Sequence[str] = (), restarts: int = RESTARTS) -> Config:
    """The paper's θ and ξ for a task, at its rate."""
    config = settings(task.source, [*overrides, f"training.restarts={restarts}"])
    return override_config(config, [f"preprocessing.rate={task.rate}"])


def _folds(task: Task, config: Config) -> tuple[Fold, ...]:
    return split(task.prepared(config), config, task.folds)


def held_out(name: str) -> list[Results]:
    """What each fold of a task holds out, and how many samples train."""
    folds = _folds(TASKS[name], configuration(TASKS[name]))
    return [{"held_out": list(fold.held_out), "samples": fold.training.n_samples} for fold in folds]


def reused(name: str, restarts: int = RESTARTS, only: int | None = None) -> list[Results]:
    """By fold: axis → model → scores, where the impedance model takes over what the naive GP has learned."""
    config = configuration(TASKS[name], KNOWN, restarts)
    found = []
    for index, fold in enumerate(_folds(TASKS[name], config)):
        if only in (None, index):
            reuse = Reuse.trained(config, fold.training)
            found.append(reuse.scores(fold.training, fold.target, fold.test))
    return found


def learned(name: str) -> list[Results]:
    """By fold: axis → scores of the model that learns all its hyperparameters."""
    config = configuration(TASKS[name])
    found = []
    for fold in _folds(TASKS[name], config):
        predictors = {LEARNED: train_impedance(config, fold.training, None)}
        found.append(scores_of(predictors, fold.training, fold.target, fold.test))
    return found


def compared(folds: Sequence[Results]) -> Results:
    """Of every model: mean MSLL over folds by axis and over all, and how often it is below that of the naive GP."""
    axes = list(folds[0]["axes"])
    summary: Results = {"folds": len(folds)}
    table = {
        model: np.array([[fold["axes"][axis][model]["msll"] for axis in axes] for fold in folds])
        for model in folds[0]["axes"][axes[0]]
    }
    rival = table[NAIVE]
    for model, msll in table.items():
        summary[model] = {
            "msll": float(msll.mean()),
            "msll_by_axis": dict(zip(axes, msll.mean(axis=0).tolist(), strict=True)),
            "median_msll": float(np.median(msll)),
        }
        if model != NAIVE:
            summary[model] |= {
                "folds_won": int((msll.mean(axis=1) < rival.mean(axis=1)).sum()),
                "axes_won": int((msll < rival).sum()),
                "axes_of": int(msll.size),
                "median_difference": float(np.median(msll - rival)),
            }
    return summary
