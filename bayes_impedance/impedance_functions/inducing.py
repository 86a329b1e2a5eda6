"""Inputs that carry a function: spread over what the samples cover."""

from __future__ import annotations

import torch
from torch import Tensor

from bayes_impedance.features import Features
from bayes_impedance.kernels.stationary import Stationary
from bayes_impedance.kernels.warped import evaluate

#: At most so many candidates among which inducing inputs of several dimensions are chosen.
CANDIDATES = 2000


def inducing_inputs(covariance: Stationary, features: Features, count: int) -> Tensor:
    """At most `count` rows like those of `features.inputs`, `(Z, D)`, of which only the columns of ξ matter.

    Evenly spaced from the least to the greatest value of a scalar ξ; else samples, each the one whose function value
    those before it tell least about (a pivoted Cholesky factor of the prior correlation).
    """
    rows = _rows(features)
    columns = covariance.active_dims
    assert columns is not None
    if len(columns) == 1:
        values = rows[:, columns[0]]
        result = rows.new_zeros(count, rows.shape[-1])
        result[:, columns[0]] = torch.linspace(
            float(values.min()), float(values.max()), count, dtype=rows.dtype
        )
        return result
    step = -(-len(rows) // CANDIDATES)
    return _least_known(covariance, rows[::step], count)


def _rows(features: Features) -> Tensor:
    """Every sample that is no padding, once, `(samples, D)`; ξ is the same for all axes."""
    rows = [features.inputs[0, g, : len(samples)] for g, samples in enumerate(features.rows)]
    return torch.cat(rows)


def _least_known(covariance: Stationary, rows: Tensor, count: int) -> Tensor:
    with torch.no_grad():
        prior = evaluate(covariance, rows, rows).reshape(-1, len(rows), len(rows))[0]
    remaining = prior.diagonal().clone()
    threshold = 1e-6 * float(remaining.max())
    factor = rows.new_zeros(0, len(rows))
    chosen: list[int] = []
    while len(chosen) < min(count, len(rows)):
        pivot = int(remaining.argmax())
        if float(remaining[pivot]) <= threshold:
            break
        chosen.append(pivot)
        row = (prior[pivot] - factor.T @ factor[:, pivot]) / remaining[pivot].sqrt()
        factor = torch.cat([factor, row.unsqueeze(0)])
        remaining = (remaining - row.square()).clamp_min(0.0)
    return rows[chosen]
