"""Cross-validation: every fold trains anew on the rest of the trials and predicts the force that was held out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayes_impedance.evaluation.contenders import (
    IMPEDANCE,
    Baseline,
    Contender,
    Watch,
    baseline_contenders,
    check_comparable,
)
from bayes_impedance.evaluation.folds import Folds, split
from bayes_impedance.evaluation.held_out import Evaluation, check_variation, predict, scored, shares
from bayes_impedance.evaluation.metrics import Scores
from bayes_impedance.log import InteractionLog
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.preprocessing import PreparedLog


@dataclass(frozen=True)
class FoldEvaluation:
    """Scores of one fold; `held_out` names what it predicted."""

    held_out: tuple[str, ...]
    evaluation: Evaluation


@dataclass(frozen=True)
class CrossValidation:
    """Scores over all held-out samples together, and those of each fold.

    The share of the force that impedance explains is in `pooled` the mean over the folds.
    """

    pooled: Evaluation
    folds: tuple[FoldEvaluation, ...]

    def __getitem__(self, axis: str) -> Mapping[str, Scores]:
        """Pooled scores of one axis by model."""
        return self.pooled[axis]


def cross_validate(
    model: ImpedanceModel,
    log: InteractionLog | PreparedLog | None = None,
    folds: Folds = "trials",
    baselines: Sequence[Baseline] = (),
    against: Mapping[str, ImpedanceModel] | None = None,
    progress: Watch | None = None,
) -> CrossValidation:
    """Cross-validate the configuration of `model` on `log`, by default the log that it was trained on.

    `folds`: "trials" leaves out each trial in turn; "last-third" trains on the first two thirds of every trial and
    predicts the last ones, in which a trial's own x_d and sensor offset go on. Only configurations count, so that a
    fitted model gives nothing away: each fold trains `model`, `baselines` and those of `against` (name → model) anew,
    deterministic under `training.seed`.

    Raises:
        LogError, ConfigurationError: the log cannot be split so, a model is not of the same samples, or a baseline can
            do nothing with a fold.
        TooManySamplesError, NotPositiveDefiniteError: see `ImpedanceModel.fit`.
    """
    against = against or {}
    config = model.config
    check_comparable(config, against)
    contenders = [
        Contender(IMPEDANCE, config),
        *baseline_contenders(config, baselines),
        *(Contender(name, other.config) for name, other in against.items()),
    ]
    prepared = ImpedanceModel(config).prepare(model.fitted.log if log is None else log)
    splits = split(prepared, config, folds)
    tested = tuple(trial for fold in splits for trial in fold.test.trials)
    check_variation(PreparedLog(prepared.axes, tested), "score against")
    for fold in splits:
        check_variation(fold.training, "train on")
        for contender in contenders:
            contender.check(fold.training, fold.target)
    predictions, explained = [], []
    for index, fold in enumerate(splits):
        where = f"fold {index + 1} of {len(splits)}: "
        predictors = {c.name: c.train(fold.training, progress, where) for c in contenders}
        predictions.append(predict(predictors, fold.training, fold.target, fold.test))
        explained.append(shares(predictors, prepared.axes))
    each = (Evaluation(scored([p]), share) for p, share in zip(predictions, explained, strict=True))
    return CrossValidation(
        Evaluation(scored(predictions), _mean(explained)),
        tuple(FoldEvaluation(fold.held_out, scores) for fold, scores in zip(splits, each, strict=True)),
    )


def as_json(result: CrossValidation) -> dict[str, object]:
    """The JSON that `evaluate --folds … --json` writes; null where a fold's own force does not vary (SMSE)."""
    folds = [
        {"held_out": list(fold.held_out)} | _evaluation_as_json(fold.evaluation) for fold in result.folds
    ]
    return _evaluation_as_json(result.pooled) | {"folds": folds}


def _evaluation_as_json(evaluation: Evaluation) -> dict[str, object]:
    axes = {
        axis: {
            name: {key: _or_null(value) for key, value in scores.as_dict().items()}
            for name, scores in rows.items()
        }
        for axis, rows in evaluation.scores.items()
    }
    return {"axes": axes, "impedance_share": evaluation.impedance_share}


def _or_null(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _mean(folds: Sequence[Mapping[str, Mapping[str, float]]]) -> dict[str, dict[str, float]]:
    return {
        axis: {name: float(np.mean([fold[axis][name] for fold in folds])) for name in models}
        for axis, models in folds[0].items()
    }
