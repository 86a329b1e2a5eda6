"""What a cross-validation holds out: each trial in turn, or the last third of every trial.

What is held out is force. The motion is an input of the prediction and known throughout, as is what follows from it
alone: the time since a trial began, its phase, and a prior mean learned from positions of trials that also train.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from bayes_impedance.config import Config
from bayes_impedance.errors import ConfigurationError, LogError, LogWarning
from bayes_impedance.features import model_components, trial_key
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial
from bayes_impedance.trajectory_mean import phase_derivatives

Folds = Literal["trials", "last-third"]

#: Held-out samples at phases that nobody trained on go without a word up to this share.
UNSEEN_PHASE = 0.1


@dataclass(frozen=True)
class Fold:
    """One split of a log.

    Train on `training`, predict every sample of `target`, score those whose force `test` knows; `target` and `test`
    have the same samples. `held_out` names what is predicted.
    """

    held_out: tuple[str, ...]
    training: PreparedLog
    target: PreparedLog
    test: PreparedLog


def split(log: PreparedLog, config: Config, folds: Folds) -> tuple[Fold, ...]:
    """Folds of `log`: one for each trial ("trials"), or a single one ("last-third").

    A trial that stands in the log twice counts once. Between the first two thirds of a trial and its last, one window
    of the smoother is used by neither, so that no raw sample enters both.

    Raises:
        ConfigurationError: `folds` is neither.
        LogError: force lacks, there are too few trials, or a trial is too short.
    """
    if folds not in get_args(Folds):
        raise ConfigurationError(
            f"folds: expected {' or '.join(get_args(Folds))}, got {folds!r}; choose one of the two"
        )
    if any(trial.force is None for trial in log.trials):
        raise LogError("expected a log with force to cross-validate on, found none; name log.columns.force")
    distinct = PreparedLog(log.axes, tuple({trial_key(trial): trial for trial in log.trials}.values()))
    if folds == "last-third":
        return (_last_third(distinct, config),)
    _check_trials(distinct, config)
    return tuple(_without_trials(distinct))


def _at(trial: PreparedTrial) -> str:
    return f"{trial.source}, trial {trial.name}"


# --- each trial in turn --------------------------------------------------------------------------


def _without_trials(log: PreparedLog) -> Iterator[Fold]:
    for index, trial in enumerate(log.trials):
        test = log.select([index])
        rest = log.select([other for other in range(len(log.trials)) if other != index])
        yield Fold((_at(trial),), rest, test, test)


def _check_trials(log: PreparedLog, config: Config) -> None:
    members = {group: [trial for trial in log.trials if trial.group == group] for group in log.groups}
    if len(log.trials) < 2:
        raise LogError(
            f"{_at(log.trials[0])}: expected at least two trials to leave one out, found one; give more recordings, "
            "or hold out the last third of each trial"
        )
    mean = config.model.desired_trajectory.mean
    for group, trials in members.items():
        if len(trials) < 2 and mean in ("trial_average", "constant"):
            raise LogError(
                f"{_at(trials[0])}: expected at least two trials in group '{group}' to leave one out, for its "
                f"{mean.replace('_', ' ')} comes from the others, found one; give more recordings, or hold out the "
                "last third of each trial"
            )


# --- the last third of every trial ---------------------------------------------------------------


def _last_third(log: PreparedLog, config: Config) -> Fold:
    smoother = config.preprocessing.smoother
    window = 0.0 if smoother is None else smoother.window
    names, training, test = [], [], []
    for trial in log.trials:
        start = trial.n_samples - max(trial.n_samples // 3, 1)
        held_out = np.arange(trial.n_samples) >= start
        # Two windows share no raw sample when their centres are further apart than one of them is long; differences of
        # time stamps carry rounding errors.
        known = trial.time[start] - trial.time > window * (1 + 1e-6)
        if not known.any():
            raise LogError(
                f"{_at(trial)}: expected samples before its last third and one window of the smoother ({window:g} s), "
                f"found none in a trial of {trial.n_samples} samples; leave it out, or shorten "
                "preprocessing.smoother.window"
            )
        names.append(f"{_at(trial)}, from {trial.time[start]:g} s")
        training.append(_with_force_at(trial, known))
        test.append(_with_force_at(trial, held_out))
    begun = PreparedLog(log.axes, tuple(training))
    # The very trials that train are the target, so that each goes on with its own x_d and offset of the residual.
    fold = Fold(tuple(names), begun, begun, PreparedLog(log.axes, tuple(test)))
    _question_phase(fold, config)
    return fold


def _with_force_at(trial: PreparedTrial, samples: npt.NDArray[np.bool_]) -> PreparedTrial:
    assert trial.force is not None
    return replace(trial, force=np.where(samples[:, None], trial.force, np.nan))


def _question_phase(fold: Fold, config: Config) -> None:
    """Warn when the model is a function of phase and the last thirds lie at phases that no training sample has."""
    if "phase" not in model_components(config.model):
        return
    unseen = []
    for group in fold.training.groups:
        trained, tested = (_phases(log, group) for log in (fold.training, fold.test))
        unseen.append((tested < trained.min()) | (tested > trained.max()))
    share = float(np.concatenate(unseen).mean())
    if share > UNSEEN_PHASE:
        warnings.warn(
            f"{100 * share:.0f} % of the held-out samples lie at phases that no training sample has, so their "
            "predictions rest on the prior; where a trial is one repetition, leave out whole trials instead",
            LogWarning,
            stacklevel=5,
        )


def _phases(log: PreparedLog, group: str) -> npt.NDArray[np.float64]:
    trials = [trial for trial in log.trials if trial.group == group]
    return np.concatenate([phase_derivatives(trial)[0][trial.observed] for trial in trials])
