"""Scores of a trained model on logs it has not seen, beside a naive GP."""

from __future__ import annotations

import warnings

import numpy as np

from bayes_impedance.baselines.naive import NaiveModel
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.features import trial_key
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.log import InteractionLog
from bayes_impedance.metrics import Scores, score
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.posterior import Posterior
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.training import Progress

#: axis → name of the model → scores
Evaluation = dict[str, dict[str, Scores]]


def evaluate(
    model: ImpedanceModel,
    log: InteractionLog | PreparedLog,
    naive: bool = False,
    progress: Progress | None = None,
) -> Evaluation:
    """Score the force of `log` predicted from the training forces alone; optionally train a naive GP beside.

    Example:
        >>> from bayes_impedance.simulation.generative import draw_force, repeated_motion
        >>> model = ImpedanceModel.from_config("phase", ["training.restarts=1", "training.max_iterations=5"])
        >>> motion = repeated_motion(repetitions=3, duration=2.0, rate=10.0, axes=("x",))
        >>> log = draw_force(model.config, motion, seed=0)
        >>> scores = evaluate(model.fit(log.select([0, 1])), log.select([2]))
        >>> scores["x"]["impedance"].n
        20

    Raises:
        LogError: the log has no force, or the same force throughout.
    """
    prepared = model.prepare(log)
    if any(trial.force is None for trial in prepared.trials):
        raise LogError("expected a log with force to score against, found none; name log.columns.force")
    training = model.fitted.log
    _check_variation(prepared)
    seen = {trial_key(trial) for trial in training.trials}
    if any(trial_key(trial) in seen for trial in prepared.trials):
        warnings.warn(
            "some of these trials were trained on, so their scores tell how well they are remembered, not predicted",
            LogWarning,
            stacklevel=2,
        )
    predictions = {"impedance": model.posterior(prepared, given="training", latents=[Latent.FORCE])}
    if naive:
        competitor = NaiveModel(model.config, training, progress)
        if competitor.report.interrupted:
            # Half trained it would be no fair competitor.
            raise KeyboardInterrupt
        predictions["naive"] = competitor.predict(prepared)
    return {
        axis: {name: _scores(posterior, training, a) for name, posterior in predictions.items()}
        for a, axis in enumerate(prepared.axes)
    }


def as_json(evaluation: Evaluation) -> dict[str, object]:
    """The JSON that `evaluate --json` writes."""
    return {
        "axes": {
            axis: {name: scores.as_dict() for name, scores in models.items()}
            for axis, models in evaluation.items()
        }
    }


def _check_variation(log: PreparedLog) -> None:
    for a, axis in enumerate(log.axes):
        force = np.concatenate([trial.force[:, a] for trial in log.trials if trial.force is not None])
        # A constant that went through the smoother carries rounding errors.
        if np.ptp(force) <= 1e-9 * np.abs(force).max():
            raise LogError(
                f"expected force that varies along axis {axis} to score against, found {force[0]:.4g} N throughout; "
                f"drop {axis} from log.axes, or give a log with contact"
            )


def _scores(posterior: Posterior, training: PreparedLog, axis: int) -> Scores:
    marginal = posterior[Latent.FORCE]
    force = np.concatenate(
        [trial.force[:, axis] for trial in posterior.log.trials if trial.force is not None]
    )
    trained = np.concatenate([trial.force[:, axis] for trial in training.trials if trial.force is not None])
    return score(marginal.mean[:, axis], marginal.sd[:, axis], force, trained)
