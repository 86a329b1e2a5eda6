"""Least squares whose standard errors respect that neighbouring samples of a recording err alike."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bayes_impedance.log import Array


@dataclass(frozen=True, eq=False)
class Fit:
    """Coefficients `(p,)`, their covariance `(p, p)`, and what is left of the target, `(n, r)`."""

    coefficients: Array
    covariance: Array
    residual: Array

    @property
    def standard_errors(self) -> Array:
        """Of the coefficients, `(p,)`."""
        return np.sqrt(np.diag(self.covariance))


def fit(design: Array, target: Array) -> Fit:
    """Coefficients c of target ≈ design c, for `design (n, r, p)` and `target (n, r)`: r equations a sample.

        Cov[c] = (XᵀX)⁻¹ S (XᵀX)⁻¹,    S = Σ_l (1 − |l|/L) Σ_t s_t s_{t+l}ᵀ,    s_t = X_tᵀ e_t

    The sandwich of Newey & West 1987, with the bandwidth L of Andrews 1991 for first-order autoregressive scores s.
    """
    solution = np.linalg.lstsq(design.reshape(-1, design.shape[2]), target.ravel(), rcond=None)[0]
    coefficients = np.asarray(solution, dtype=np.float64)
    residual = target - design @ coefficients
    bread = np.linalg.pinv(np.einsum("nrp,nrq->pq", design, design))
    scores = np.einsum("nrp,nr->np", design, residual)
    return Fit(coefficients, bread @ _long_run(scores) @ bread, residual)


def mean(values: Array) -> tuple[float, float]:
    """Mean of `(n,)` and its standard error, in the unit of the values."""
    found = fit(np.ones((len(values), 1, 1)), values[:, None])
    return float(found.coefficients[0]), float(found.standard_errors[0])


def _long_run(scores: Array) -> Array:
    total: Array = scores.T @ scores
    bandwidth = _bandwidth(scores)
    for lag in range(1, math.ceil(bandwidth)):
        product = scores[:-lag].T @ scores[lag:]
        total = total + (1.0 - lag / bandwidth) * (product + product.T)
    return total


def _bandwidth(scores: Array) -> float:
    """In samples; for the score that needs the longest, and at most a quarter of the recording."""
    power = np.sum(scores**2, axis=0)
    moving = power > 0
    correlation = np.sum(scores[1:] * scores[:-1], axis=0)[moving] / power[moving]
    rho = float(np.clip(np.max(correlation, initial=0.0), 0.0, 0.9999))
    alpha = 4.0 * rho**2 / ((1.0 - rho) ** 2 * (1.0 + rho) ** 2)
    return float(min(1.1447 * (alpha * len(scores)) ** (1 / 3), len(scores) / 4))
