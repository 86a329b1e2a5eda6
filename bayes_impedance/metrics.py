"""Scores of predicted force: SMSE, MSLL (Rasmussen & Williams 2006, §2.5), NLPD, coverage."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scores:
    """Scores of one axis over `n` test samples; NLPD in nats a sample."""

    smse: float
    msll: float
    nlpd: float
    coverage90: float
    n: int

    def as_dict(self) -> dict[str, float | int]:
        """JSON-able mapping."""
        return asdict(self)


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
    trivial = -norm.logpdf(force, training_force.mean(), training_force.std())
    loss = -norm.logpdf(force, mean, sd)
    inside = np.abs(force - mean) <= norm.ppf(0.95) * sd
    return Scores(
        smse=float(np.mean((force - mean) ** 2) / np.var(force)),
        msll=float(np.mean(loss - trivial)),
        nlpd=float(np.mean(loss)),
        coverage90=float(np.mean(inside)),
        n=int(force.size),
    )
