"""Draws from Gaussian distributions whose covariance need not have full rank."""

from __future__ import annotations

import numpy as np
import torch
from scipy.linalg.lapack import dpstrf
from torch import Tensor


def draw_gaussian(covariance: Tensor, generator: torch.Generator) -> Tensor:
    """A draw of N(0, `covariance`), `(..., n)`; positive semidefinite to rounding is enough."""
    scale = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0.0).sqrt()
    # On the scale of correlations rounding does not carry from accelerations over to positions.
    safe = torch.where(scale > 0, scale, 1.0)
    correlation = covariance / (safe.unsqueeze(-1) * safe.unsqueeze(-2))
    standard = torch.randn(scale.shape, generator=generator, dtype=scale.dtype)
    drawn = [
        _factor(c) @ z
        for c, z in zip(
            correlation.reshape(-1, *correlation.shape[-2:]), standard.flatten(0, -2), strict=True
        )
    ]
    return scale * torch.stack(drawn).reshape(scale.shape)


def _factor(correlation: Tensor) -> Tensor:
    """R with R Rᵀ = `correlation` to rounding, by Cholesky with pivoting: it ends at the numerical rank."""
    n = correlation.shape[-1]
    lower, pivots, rank, _ = dpstrf(correlation.numpy(), lower=1)
    factor = np.tril(lower)
    factor[:, rank:] = 0.0
    result = np.empty((n, n))
    result[pivots - 1] = factor
    return torch.from_numpy(result)
