"""Scores of a trained model on logs it has not seen, beside baselines and other models."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.evaluation.contenders import (
    IMPEDANCE,
    Baseline,
    Contender,
    Predictor,
    Watch,
    baseline_contenders,
    check_comparable,
)
from bayes_impedance.evaluation.explained import EXPLAINING, impedance_share
from bayes_impedance.evaluation.metrics import Prediction, Scores, pooled_score, varies
from bayes_impedance.features import trial_key
from bayes_impedance.log import InteractionLog
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.preprocessing import PreparedLog


@dataclass(frozen=True)
class Evaluation:
    """Scores by axis and model.

    `scores[axis][model]`; `impedance_share[axis][model]`: share of the training force that impedance explains (see
    `impedance_share`), of models that have an impedance.
    """

    scores: Mapping[str, Mapping[str, Scores]]
    impedance_share: Mapping[str, Mapping[str, float]]

    def __getitem__(self, axis: str) -> Mapping[str, Scores]:
        """Scores of one axis by model."""
        return self.scores[axis]


def evaluate(
    model: ImpedanceModel,
    log: InteractionLog | PreparedLog,
    baselines: Sequence[Baseline] = (),
    against: Mapping[str, ImpedanceModel] | None = None,
    progress: Watch | None = None,
) -> Evaluation:
    """Score the force of `log` predicted from the training forces alone.

    `baselines` are trained on the model's training log, as are those of `against` (name → model) that are not fitted;
    one that is fitted counts as it is. MSLL of every row is against the forces that `model` was trained on.

    Example:
        >>> from bayes_impedance.simulation.generative import draw_force, repeated_motion
        >>> model = ImpedanceModel.from_config("phase", ["training.restarts=1", "training.max_iterations=5"])
        >>> motion = repeated_motion(repetitions=3, duration=2.0, rate=10.0, axes=("x",))
        >>> log = draw_force(model.config, motion, seed=0)
        >>> scores = evaluate(model.fit(log.select([0, 1])), log.select([2]))
        >>> scores["x"]["impedance"].n
        20

    Raises:
        LogError: the log has no force, or the same force throughout, or a baseline can do nothing with it.
        ConfigurationError: a baseline is unknown, or a model of `against` is not of the same samples.
    """
    against = against or {}
    prepared = model.prepare(log)
    if any(trial.force is None for trial in prepared.trials):
        raise LogError("expected a log with force to score against, found none; name log.columns.force")
    training = model.fitted.log
    check_variation(prepared, "score against")
    check_comparable(model.config, against)
    fitted = {IMPEDANCE: model} | {name: other for name, other in against.items() if other.is_fitted}
    for name, other in fitted.items():
        other.prepare(prepared)
        _question_training(name, other, training, prepared)
    others = [Contender(name, other.config) for name, other in against.items() if not other.is_fitted]
    ours = baseline_contenders(model.config, baselines)
    contenders = (*ours, *others)
    for contender in contenders:
        contender.check(training, prepared)
    predictors = {name: Predictor.of(other) for name, other in fitted.items()}
    predictors |= {contender.name: contender.train(training, progress) for contender in contenders}
    rows = (IMPEDANCE, *(contender.name for contender in ours), *against)
    predictors = {name: predictors[name] for name in rows}
    predictions = predict(predictors, training, prepared, prepared)
    return Evaluation(scored([predictions]), shares(predictors, prepared.axes))


def as_json(evaluation: Evaluation) -> dict[str, object]:
    """The JSON that `evaluate --json` writes."""
    return {
        "axes": {
            axis: {name: scores.as_dict() for name, scores in models.items()}
            for axis, models in evaluation.scores.items()
        }
    }


def predict(
    predictors: Mapping[str, Predictor], training: PreparedLog, target: PreparedLog, test: PreparedLog
) -> dict[str, dict[str, Prediction]]:
    """Axis → model → prediction of the known forces of `test`, whose samples are those of `target`."""
    known = np.concatenate([trial.observed for trial in test.trials])
    forces = {name: predictor.predict(target) for name, predictor in predictors.items()}
    return {
        axis: {
            name: Prediction(
                predicted.mean[known, a],
                predicted.sd[known, a],
                known_force(test, a),
                known_force(training, a),
            )
            for name, predicted in forces.items()
        }
        for a, axis in enumerate(test.axes)
    }


def scored(
    folds: Sequence[Mapping[str, Mapping[str, Prediction]]],
) -> dict[str, dict[str, Scores]]:
    """Axis → model → scores over the samples of all folds."""
    return {
        axis: {name: pooled_score([fold[axis][name] for fold in folds]) for name in models}
        for axis, models in folds[0].items()
    }


def shares(predictors: Mapping[str, Predictor], axes: Sequence[str]) -> dict[str, dict[str, float]]:
    """Axis → model → share of its own training force that impedance explains, of impedance models."""
    models = {name: predictor.model for name, predictor in predictors.items()}
    explained = {
        name: impedance_share(model.posterior(model.fitted.log, latents=EXPLAINING))
        for name, model in models.items()
        if model is not None
    }
    return {axis: {name: float(share[a]) for name, share in explained.items()} for a, axis in enumerate(axes)}


def known_force(log: PreparedLog, axis: int) -> NDArray[np.float64]:
    """Known forces of one axis, trial after trial [N]."""
    return np.concatenate(
        [trial.force[trial.observed, axis] for trial in log.trials if trial.force is not None]
    )


def check_variation(log: PreparedLog, purpose: str) -> None:
    """Refuse a force that rests along an axis.

    Raises:
        LogError: SMSE or MSLL would divide by nought.
    """
    for a, axis in enumerate(log.axes):
        force = known_force(log, a)
        if not varies(force):
            raise LogError(
                f"expected force that varies along axis {axis} to {purpose}, found {force[0]:.4g} N throughout; "
                f"drop {axis} from log.axes, or give a log with contact"
            )


def _question_training(name: str, model: ImpedanceModel, training: PreparedLog, log: PreparedLog) -> None:
    """Warn of a model that knows the tested trials, or was trained on others than the one it is compared with."""
    seen = {trial_key(trial) for trial in model.fitted.log.trials}
    if any(trial_key(trial) in seen for trial in log.trials):
        found = (
            "some of these trials were trained on, so their"
            if name == IMPEDANCE
            else f"{name} was trained on some of these trials, so its"
        )
        warnings.warn(
            f"{found} scores tell how well they are remembered, not predicted", LogWarning, stacklevel=3
        )
    if seen != {trial_key(trial) for trial in training.trials}:
        warnings.warn(
            f"{name} was trained on other trials than the model it is compared with, so scores tell of the data too",
            LogWarning,
            stacklevel=3,
        )
