"""Scores of predicted force: SMSE, MSLL (Rasmussen & Williams 2006, §2.5), NLPD, coverage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scores:
    """Scores of one axis over `n` test samples: NLPD in nats a sample, SMSE NaN where the test force does not vary."""

    smse: float
    msll: float
    nlpd: float
    coverage90: float
    n: int

    def as_dict(self) -> dict[str, float | int]:
        """JSON-able mapping."""
        return asdict(self)


@dataclass(frozen=True)
class Prediction:
    """Gaussian predictions of new measurements: `mean`, `sd` and the measured `force`, `(n,)` [N].

    `training_force` `(m,)` [N]: what the predictor was trained on.
    """

    mean: Array
    sd: Array
    force: Array
    training_force: Array


def score(mean: Array, sd: Array, force: Array, training_force: Array) -> Scores:
    """Scores of Gaussian predictions of a new measurement.

    SMSE = mean squared error / variance of the test force. MSLL = mean of −log N(u; mean, sd²) less the
    same under a Gaussian with mean and variance of the training force. All arguments `(n,)` [N].

    Example:
        >>> force = np.array([0.0, 1.0, 2.0, 3.0])
        >>> scores = score(force + 0.1, np.full(4, 0.2), force, training_force=force)
        >>> scores.n, scores.coverage90, round(scores.smse, 3), scores.msll < 0
        (4, 1.0, 0.008, True)
    """
    return pooled_score([Prediction(mean, sd, force, training_force)])


def pooled_score(predictions: Sequence[Prediction]) -> Scores:
    """Scores over the samples of several predictions together, the folds of a cross-validation, say.

    SMSE is relative to the variance of all test forces; MSLL compares each sample with the Gaussian of its own
    training forces.
    """
    mean, sd, force = (
        np.concatenate([getattr(part, name) for part in predictions]) for name in ("mean", "sd", "force")
    )
    trivial = -np.concatenate(
        [norm.logpdf(p.force, p.training_force.mean(), p.training_force.std()) for p in predictions]
    )
    loss = -norm.logpdf(force, mean, sd)
    inside = np.abs(force - mean) <= norm.ppf(0.95) * sd
    return Scores(
        smse=float(np.mean((force - mean) ** 2) / np.var(force)) if varies(force) else float("nan"),
        msll=float(np.mean(loss - trivial)),
        nlpd=float(np.mean(loss)),
        coverage90=float(np.mean(inside)),
        n=int(force.size),
    )


def varies(force: Array) -> bool:
    """Whether a force `(n,)` [N] is more than a constant that went through a smoother, which leaves rounding errors."""
    return bool(np.ptp(force) > 1e-9 * np.abs(force).max())
