"""Hilbert-space features of the squared exponential over an interval, or a box of up to three dimensions.

On [−L, L] about the centre of θ, with frequencies ω_m = π m / (2L) (Solin & Särkkä, *Hilbert space methods for
reduced-rank Gaussian process regression*, Statistics and Computing 2020, (17) and (20)):

    φ_m(θ) = √S(ω_m) sin(ω_m (θ − c + L)) / √L,    S(ω) = σ² √(2π) ℓ exp(−ω² ℓ² / 2)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bayes_impedance.engines.lowrank.basis import Basis, Waves
from bayes_impedance.features import Features
from bayes_impedance.kernels.stationary import Stationary

#: Beyond so many times the cutoff a product of waves is left out; measured: within twice the error of all products.
RADIUS = 1.1


@dataclass(frozen=True)
class Accuracy:
    """How far features reach: L = S + `margin` · ℓ about a range of half-width S, frequencies up to `cutoff` / ℓ.

    The error of ∂_tⁱ ∂_t'ʲ k along a scalar θ, relative to its largest value: for i = j = 2 at most 1.5e-3 with
    (2.5, 4.5), 2.2e-5 with (3, 5.5), 1e-7 with (3.5, 6.5), 1e-10 with (4, 7.5); a hundredth of that for k itself. What
    this does to a likelihood grows with the samples and with (prior SD of force / SD of noise)².
    """

    margin: float
    cutoff: float


#: Errs by at most 1e-7 in the covariance of accelerations.
FINE = Accuracy(3.5, 6.5)
#: Errs by at most 2.2e-5 there, with four fifths of the features a dimension.
TIGHT = Accuracy(3.0, 5.5)
#: Errs by at most 1.5e-3 there, with three fifths of the features a dimension.
CHEAP = Accuracy(2.5, 4.5)


def chosen(accuracy: Accuracy | None, dims: int, derivatives: bool = True) -> Accuracy:
    """`accuracy`, or for None what costs little: `FINE` over a scalar θ, else `TIGHT`, as for a residual force.

    A step in the number of features, as the length scale changes, then moves the likelihood by hundredths of a nat or
    less where it is near its maximum, rather than by tenths, which stops a line search.
    """
    if accuracy is not None:
        return accuracy
    return FINE if derivatives and dims == 1 else TIGHT


@dataclass(frozen=True)
class Extent:
    """Middle and half the width of the values of a component of θ, in its unit."""

    centre: float
    half: float

    @classmethod
    def of(cls, logs: Sequence[Features], column: int) -> Extent:
        """What the valid samples of some logs cover of a column of their inputs, all axes and groups together."""
        values = [
            features.inputs[..., column]
            if features.valid is None
            else features.inputs[..., column][:, features.valid]
            for features in logs
        ]
        low = min(part.min().item() for part in values)
        high = max(part.max().item() for part in values)
        return cls(0.5 * (low + high), 0.5 * (high - low))


def length_scales(kernel: Stationary, axes: int) -> Tensor:
    """ℓ of every component, `(axes, 1, 1, p)`."""
    return kernel.lengthscale.expand(axes, 1, 1, kernel.num_dims)


def counts(kernel: Stationary, extents: Sequence[Extent], axes: int, accuracy: Accuracy) -> list[int]:
    """Waves that each component of θ needs: ⌈2 L · cutoff / (π ℓ)⌉ of the axis that needs most."""
    scales = length_scales(kernel, axes).detach()
    needed = []
    for d, extent in enumerate(extents):
        shortest = scales[..., d].min().item()
        length = extent.half + accuracy.margin * shortest
        needed.append(math.ceil(2.0 * length * accuracy.cutoff / (math.pi * shortest)))
    return needed


def products(kernel: Stationary, extents: Sequence[Extent], axes: int, accuracy: Accuracy) -> Tensor | None:
    """Products of waves that matter, Σ_d (ω_d ℓ_d)² within the cutoff, `(features, p)`; None for a scalar θ."""
    if len(extents) == 1:
        return None
    needed = counts(kernel, extents, axes, accuracy)
    indices = torch.cartesian_prod(*(torch.arange(count) for count in needed))
    scales = length_scales(kernel, axes).detach()[:, 0, 0]
    half = torch.tensor([extent.half for extent in extents], dtype=scales.dtype)
    step = 0.5 * math.pi * scales / (half + accuracy.margin * scales)
    radius = ((indices + 1.0) * step.unsqueeze(1)).square().sum(-1)
    return indices[radius.amin(0) <= (RADIUS * accuracy.cutoff) ** 2]


def hilbert_basis(
    kernel: Stationary,
    columns: Sequence[int],
    extents: Sequence[Extent],
    axes: int,
    accuracy: Accuracy,
) -> Basis:
    """Features of σ² exp(−s) over the columns of θ, which `extents` describe; L follows ℓ, their number in steps."""
    scales = length_scales(kernel, axes)
    waves = []
    for d, count in enumerate(counts(kernel, extents, axes, accuracy)):
        scale = scales[..., [d]]
        length = extents[d].half + accuracy.margin * scale
        frequency = 0.5 * math.pi * torch.arange(1, count + 1, dtype=scale.dtype) / length
        # √S(ω) as an exponential: the root of what underflows has no gradient.
        weight = (
            (2.0 * math.pi) ** 0.25
            * torch.sqrt(scale / length)
            * torch.exp(-0.25 * (frequency * scale).square())
        )
        if d == 0:
            weight = weight * kernel.sd.expand(axes, 1, 1, 1)
        waves.append(Waves(frequency, frequency * length, weight, extents[d].centre))
    return Basis(tuple(columns), tuple(waves), products(kernel, extents, axes, accuracy))


def constant_basis(kernel: Stationary, axes: int) -> Basis:
    """The one feature σ of a constant: a wave of frequency 0."""
    zero = kernel.sd.new_zeros(1, 1, 1, 1)
    return Basis((0,), (Waves(zero, zero + 0.5 * math.pi, kernel.sd.expand(axes, 1, 1, 1)),))
