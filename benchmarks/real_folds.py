"""Real recordings in the paper's setting: each run predicted from the others of its task, or its end from its start.

Every fold twice: `reused` as in `benchmarks.paper_protocol`, the naive GP being trained on the training runs; and
`learned`, in which both models learn all their hyperparameters from the same forces, with the same hyperpriors on those
that they share, and the same restarts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayes_impedance import ImpedanceModel, read_log
from bayes_impedance.config import Config
from bayes_impedance.evaluation.contenders import baseline_contenders, train_impedance
from bayes_impedance.evaluation.folds import Folds, split
from bayes_impedance.evaluation.held_out import predict, scored
from bayes_impedance.preprocessing import PreparedLog
from benchmarks.paper_protocol import IMPEDANCE, KNOWN, NAIVE, Reuse, settings
from benchmarks.results import RECORDINGS, Results

RESTARTS = 3


@dataclass(frozen=True)
class Task:
    """Runs of one task, the shipped configuration that reads them, and what is held out."""

    source: str
    files: tuple[str, ...]
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


def _bags(folder: str, runs: Sequence[str], folds: Folds = "trials") -> Task:
    return Task("recordings/gp_mpc", tuple(f"gp_mpc/{folder}/{run}.bag" for run in runs), folds)


#: The twelve folds.
TWELVE: Mapping[str, Task] = {
    "acc_rail": _bags("acc_rail", ("1", "2", "3")),
    **{f"acc_twobag_{t}": _bags("acc_twobag", [f"{t}{run}" for run in (1, 2, 3)]) for t in ("l", "r", "rr")},
}
TASKS: Mapping[str, Task] = {
    **TWELVE,
    "panda": Task("recordings/panda_comanipulation", ("panda_comanipulation/symbol_17_data.mat",)),
    "rail": _bags("rail", ("1", "2", "3"), "last-third"),
}


def configuration(name: str, protocol: str, restarts: int = RESTARTS) -> Config:
    """Of a task under the protocol `reused` or `learned`."""
    known = KNOWN if protocol == "reused" else ()
    return settings(TASKS[name].source, [*known, f"training.restarts={restarts}"])


def folds_of(name: str, protocol: str, restarts: int = RESTARTS, only: int | None = None) -> Results:
    """Scores of every fold of a task, or of one of them, by axis and model."""
    task, config = TASKS[name], configuration(name, protocol, restarts)
    found = []
    for index, fold in enumerate(split(task.prepared(config), config, task.folds)):
        if only not in (None, index):
            continue
        figures: Results = {"held_out": list(fold.held_out), "samples": fold.training.n_samples}
        if protocol == "reused":
            reuse = Reuse.trained(config, fold.training)
            figures["axes"] = reuse.scores(fold.training, fold.target, fold.test)
            figures["naive"] = reuse.hyperparameters()
        else:
            figures["axes"] = _learned(config, fold.training, fold.target, fold.test)
        found.append(figures)
    return {"folds": found}


def _learned(config: Config, training: PreparedLog, target: PreparedLog, test: PreparedLog) -> Results:
    predictors = {IMPEDANCE: train_impedance(config, training, None)}
    for contender in baseline_contenders(config, ["naive"]):
        predictors[contender.name] = contender.train(training)
    predictions = predict(predictors, training, target, test)
    return {
        axis: {n: s.as_dict() for n, s in models.items()} for axis, models in scored([predictions]).items()
    }


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
