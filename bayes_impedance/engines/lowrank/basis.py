"""Features of a process over θ: products of sinusoids, with their exact time derivatives along a recorded path."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from bayes_impedance.kernels.derivative import Path


class Jet(NamedTuple):
    """Features and their first two time derivatives, `(axes, blocks, n, features)` each."""

    value: Tensor
    velocity: Tensor
    acceleration: Tensor


@dataclass(frozen=True)
class Waves:
    """w_m sin(ω_m (θ − c) + δ_m) over a scalar θ.

    `frequency` ω, `shift` δ and `weight` w broadcast as `(axes, 1, 1, features)`; ω in the inverse unit of θ, w in the
    unit of the process. `centre` c is in the unit of θ.
    """

    frequency: Tensor
    shift: Tensor
    weight: Tensor
    centre: float = 0.0

    def values(self, theta: Tensor) -> Tensor:
        """The waves at θ `(axes, blocks, n)`, `(axes, blocks, n, features)`."""
        return torch.sin(self._angle(theta)) * self.weight

    def jet(self, theta: Tensor, velocity: Tensor, acceleration: Tensor | None) -> Jet:
        """The waves with their time derivatives, from θ, θ̇, θ̈ `(axes, blocks, n)`; None stands for zero."""
        angle = self._angle(theta)
        value = torch.sin(angle) * self.weight
        slope = torch.cos(angle) * (self.weight * self.frequency)
        curvature = value * self.frequency.square()
        # f̈ = f'' θ̇² + f' θ̈
        second = -curvature * velocity.square().unsqueeze(-1)
        if acceleration is not None:
            second = second + slope * acceleration.unsqueeze(-1)
        return Jet(value, slope * velocity.unsqueeze(-1), second)

    def _angle(self, theta: Tensor) -> Tensor:
        return (theta - self.centre).unsqueeze(-1) * self.frequency + self.shift


@dataclass(frozen=True)
class Basis:
    """Features of a Gaussian process f = Σ_m φ_m β_m, β ~ N(0, I): products of one wave of each component of θ.

    `columns` are the columns of the input that hold θ, `kept[m, d]` is the wave of component d in feature m; it is None
    where θ is a scalar, whose waves are the features.
    """

    columns: tuple[int, ...]
    waves: tuple[Waves, ...]
    kept: Tensor | None = None

    @property
    def size(self) -> int:
        """Number of features."""
        return self.waves[0].frequency.shape[-1] if self.kept is None else len(self.kept)

    def values(self, inputs: Tensor) -> Tensor:
        """φ at the rows of `inputs` `(axes, blocks, n, D)`, `(axes, blocks, n, features)`."""
        product: Tensor | None = None
        for d, (column, waves) in enumerate(zip(self.columns, self.waves, strict=True)):
            factor = self._select(waves.values(inputs[..., column]), d)
            product = factor if product is None else product * factor
        assert product is not None
        return product

    def jet(self, path: Path) -> Jet:
        """φ, φ̇, φ̈ along a path whose arrays are `(axes, blocks, n, p)`; products by Leibniz' rule in time."""
        product: Jet | None = None
        for d, waves in enumerate(self.waves):
            acceleration = None if path.acceleration is None else path.acceleration[..., d]
            jet = waves.jet(path.theta[..., d], path.velocity[..., d], acceleration)
            factor = Jet(*(self._select(part, d) for part in jet))
            product = factor if product is None else _times(product, factor)
        assert product is not None
        return product

    def _select(self, values: Tensor, component: int) -> Tensor:
        return values if self.kept is None else values.index_select(-1, self.kept[:, component])


def _times(f: Jet, g: Jet) -> Jet:
    return Jet(
        f.value * g.value,
        f.velocity * g.value + f.value * g.velocity,
        f.acceleration * g.value + 2.0 * f.velocity * g.velocity + f.value * g.acceleration,
    )
