"""The paper's experiment: `make results` writes results/human_experiment.json.

Hyperparameters from one repetition, force of the others: three synthetic subjects with ten repetitions each, for the
paper's people are not at hand; then runs of real recordings (left out where ../shared/data is absent: the committed
figures stay). Each part is a function that returns plain figures; a run that was killed goes on behind its last job.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from bayes_impedance import ImpedanceModel
from bayes_impedance.config import Config
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.simulation.device import BandLimitedForce, Perturbation, Unperturbed
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.subjects import SUBJECTS, find_subject
from bayes_impedance.simulation.tasks import Flower
from benchmarks.ledger import Ledger
from benchmarks.paper_protocol import IMPEDANCE, KNOWN, NAIVE, UNREADABLE, Reuse, settings
from benchmarks.real_folds import LEARNED, RESTARTS, TASKS, TWELVE, compared, held_out, learned, reused
from benchmarks.results import Results, commit, committed
from benchmarks.sparse_curves import sparse, stream

# --- synthetic subjects --------------------------------------------------------------------------

REPETITIONS = 10
#: What the models see of a repetition of 8 to 12 s [Hz]: about a hundred samples, at most 1500 in all ten.
RATE = 12.5
#: Repetitions that predictions are given, while hyperparameters stay those of the first; the last two are predicted.
AMOUNTS = (1, 2, 4, 8)
#: The paper's people move freely; a perturbation is the harder case, for it cannot be foreseen from the motion alone.
PERTURBATIONS: Mapping[str, Perturbation] = {"unperturbed": Unperturbed(), "2 N": BandLimitedForce(2.0)}


def subject_configuration(restarts: int = RESTARTS) -> Config:
    """The paper's settings for simulated logs."""
    overrides = [*KNOWN, f"training.restarts={restarts}"]
    config = settings("position_velocity", overrides)
    return config.model_copy(update={"preprocessing": config.preprocessing.model_copy(update={"rate": RATE})})


def repetitions_of(name: str, perturbation: str) -> PreparedLog:
    """Ten repetitions of the flower by one subject, each at a pace of its own."""
    experiment = Experiment([find_subject(name)], Flower(), REPETITIONS, 1, PERTURBATIONS[perturbation])
    return ImpedanceModel(subject_configuration()).prepare(simulate(experiment))


def subject(name: str, perturbation: str, restarts: int = RESTARTS) -> Results:
    """Scores on nine unseen repetitions given the first, and on the last two over the amount of training data."""
    log = repetitions_of(name, perturbation)
    first, last = log.select([0]), log.select([REPETITIONS - 2, REPETITIONS - 1])
    unseen = log.select(range(1, REPETITIONS))
    reuse = Reuse.trained(subject_configuration(restarts), first)
    amounts = {}
    for amount in AMOUNTS:
        given = log.select(range(amount))
        amounts[str(amount)] = {"samples": given.n_samples, "axes": reuse.scores(given, last, last)}
    return {
        "samples": [log.select([k]).n_samples for k in range(REPETITIONS)],
        "naive": reuse.hyperparameters(),
        "unseen": {"axes": reuse.scores(first, unseen, unseen)},
        "last_two_over_amount": amounts,
    }


def subjects(ledger: Ledger) -> Results:
    """Every subject, with and without perturbation."""
    return {
        perturbation: {
            name: ledger.run(f"{perturbation} {name}", partial(subject, name, perturbation))
            for name in SUBJECTS
        }
        for perturbation in PERTURBATIONS
    }


# --- local sparse models ---------------------------------------------------------------------------


def local_models(ledger: Ledger) -> Results:
    """Every subject without perturbation: over inducing inputs and width of cells, and learning as samples come."""
    return {name: ledger.run(f"local {name}", partial(local_subject, name)) for name in SUBJECTS}


def local_subject(name: str) -> Results:
    """Eight repetitions given, the last two predicted; and one after another."""
    log = repetitions_of(name, "unperturbed")
    reuse = Reuse.trained(subject_configuration(), log.select([0]))
    given, last = log.select(range(REPETITIONS - 2)), log.select([REPETITIONS - 2, REPETITIONS - 1])
    return {"sparse": sparse(reuse, given, last), "stream": stream(reuse, log)}


# --- real recordings -----------------------------------------------------------------------------

#: Restarts of the naive GP in a second round: whether figures are those of an accidental optimum.
MORE = 3


def recordings(ledger: Ledger) -> Results:
    """Scores of every fold of every task by all models, the twelve folds together, and these with more restarts."""
    if not all(task.is_there for task in TASKS.values()):
        print("recordings are not in ../shared/data; their committed figures stay")
        return dict(committed("human_experiment")["recordings"])
    scores: dict[str, list[list[Results]]] = {name: [] for name in TASKS}
    for name in TASKS:
        scores[name].append(ledger.run(f"reused {name}", partial(reused, name)))
    for name in TASKS:
        scores[name].append(ledger.run(f"{LEARNED} {name}", partial(learned, name)))
    tasks = {name: _joined(held_out(name), scores[name]) for name in TASKS}
    again = [
        {"axes": axes}
        for name in TWELVE
        for axes in ledger.run(f"reused {name}, {MORE} restarts", partial(reused, name, MORE))
    ]
    return {
        "rate": {name: task.rate for name, task in TASKS.items()},
        "tasks": {name: {"folds": folds, "compared": compared(folds)} for name, folds in tasks.items()},
        "twelve_folds": compared([fold for name in TWELVE for fold in tasks[name]]),
        f"twelve_folds_{MORE}_restarts": compared(again),
    }


def _joined(folds: list[Results], scores: list[list[Results]]) -> list[Results]:
    """Folds with the scores of all models."""
    return [
        fold | {"axes": {axis: {k: v for part in parts for k, v in part[axis].items()} for axis in parts[0]}}
        for fold, *parts in zip(folds, *scores, strict=True)
    ]


# --- all -----------------------------------------------------------------------------------------

PARTS: Mapping[str, Callable[[Ledger], Results]] = {
    "subjects": subjects,
    "local": local_models,
    "recordings": recordings,
}


def main() -> None:
    """Compute every part and write the committed JSON."""
    ledger = Ledger("human_experiment")
    figures: Results = {"settings": {"subject_rate": RATE, "restarts": RESTARTS, "unreadable": UNREADABLE}}
    for name, part in PARTS.items():
        figures[name] = part(ledger)
    commit("human_experiment", 0, figures)
    ledger.close()
    for name, found in figures["subjects"]["unperturbed"].items():
        for axis, models in found["unseen"]["axes"].items():
            print(name, axis, *(f"{m} {models[m]['msll']:.3f}" for m in (IMPEDANCE, NAIVE)))
    for key in ("twelve_folds", f"twelve_folds_{MORE}_restarts"):
        for model, found in figures["recordings"][key].items():
            print(key, model, found)


if __name__ == "__main__":
    main()
