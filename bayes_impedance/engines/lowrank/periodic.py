"""Fourier features of a squared exponential whose phase is joined at its ends.

The kernel is summed over whole turns, k_per(r) = Σ_n k(r + n), which is by Poisson's formula

    k_per(r) = S(0) + 2 Σ_{j ≥ 1} S(2πj) cos(2πj r),    S(ω) = σ² √(2π) ℓ exp(−ω² ℓ² / 2)

so x_d and all its derivatives agree at both ends, and its variance is the same at every phase: σ² as long as ℓ is short
of half a turn, and more beyond, where the turns overlap.
"""

from __future__ import annotations

import math

import torch

from bayes_impedance.engines.lowrank.basis import Basis, Waves
from bayes_impedance.engines.lowrank.hilbert import Accuracy, length_scales
from bayes_impedance.kernels.stationary import Stationary


def harmonics(kernel: Stationary, axes: int, accuracy: Accuracy) -> int:
    """J = ⌈cutoff / (2πℓ)⌉ of the axis that needs most."""
    shortest = length_scales(kernel, axes).detach().min().item()
    return math.ceil(accuracy.cutoff / (2.0 * math.pi * shortest))


def fourier_basis(kernel: Stationary, column: int, axes: int, accuracy: Accuracy) -> Basis:
    """The 2J + 1 features √S(0), √(2 S(2πj)) cos(2πjθ), √(2 S(2πj)) sin(2πjθ) of the phase in `column`."""
    count = harmonics(kernel, axes, accuracy)
    scale = length_scales(kernel, axes)
    turns = torch.arange(count + 1, dtype=scale.dtype)
    # Cosines first, as sines a quarter turn ahead; the sine of frequency zero is left out.
    frequency = 2.0 * math.pi * torch.cat([turns, turns[1:]])
    shift = torch.cat([turns.new_full((count + 1,), 0.5 * math.pi), turns.new_zeros(count)])
    double = torch.full_like(frequency, math.sqrt(2.0))
    double[0] = 1.0
    spectrum = torch.exp(-0.25 * (frequency * scale).square()) * scale.sqrt()
    weight = (2.0 * math.pi) ** 0.25 * kernel.sd.expand(axes, 1, 1, 1) * double * spectrum
    return Basis((column,), (Waves(frequency, shift, weight),))
