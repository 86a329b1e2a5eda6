"""The design matrix: which feature enters which force, and which latent, with what factor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from bayes_impedance.engines.given_impedance import Processes
from bayes_impedance.engines.lowrank.basis import Basis
from bayes_impedance.engines.lowrank.hilbert import (
    Accuracy,
    Extent,
    chosen,
    constant_basis,
    hilbert_basis,
)
from bayes_impedance.engines.lowrank.periodic import fourier_basis
from bayes_impedance.features import Features
from bayes_impedance.kernels.impedance import InputLayout
from bayes_impedance.kernels.stationary import Stationary


@dataclass(frozen=True)
class Design:
    """Features of desired trajectory and residual force, as columns of the matrices that multiply β ~ N(0, I).

    Rows are samples, `(axes, groups, n, features)`; where axes couple, `(1, groups, axes · n, axes · features)`, with
    all samples of an axis, and all its features, next to each other. With β drawn given the forces, or sampled,
    `trajectory(inputs, 0) @ β` is x_d − μ_xd at these inputs, `force(inputs, impedance) @ β` its force. Where trials
    have trajectories of their own, each has its own β on the same columns.
    """

    layout: InputLayout
    coupled: bool
    basis: Basis
    residual_bases: tuple[Basis, ...]

    @classmethod
    def of(
        cls, processes: Processes, logs: Sequence[Features], coupled: bool, accuracy: Accuracy | None = None
    ) -> Self:
        """Features that hold at the samples of all `logs`: those conditioned on, and those predicted at.

        `accuracy` None is what `chosen` chooses."""
        axes = logs[0].inputs.shape[0]
        theta, kernel = processes.layout.theta, processes.trajectory
        rule = chosen(accuracy, len(theta))
        if processes.periodic:
            basis = fourier_basis(kernel, theta[0], axes, rule)
        else:
            basis = _hilbert(kernel, theta, logs, rule)
        terms = []
        for term in processes.residual:
            if term.num_dims == 0:
                terms.append(constant_basis(term, axes))
            else:
                rule = chosen(accuracy, term.num_dims, derivatives=False)
                terms.append(_hilbert(term, columns_of(term), logs, rule))
        return cls(processes.layout, coupled, basis, tuple(terms))

    def columns(self, axes: int) -> int:
        """Number of columns, of desired trajectory and residual force together."""
        size = self.basis.size + sum(basis.size for basis in self.residual_bases)
        return size * axes if self.coupled else size

    def force(self, inputs: Tensor, impedance: Tensor) -> Tensor:
        """Φ with Σ_j W_j f⁽ʲ⁾ = Φ β [N]: row of axis a is Σ_j Σ_c W_j,ac φ_c⁽ʲ⁾.

        `inputs` `(axes, groups, n, D)`, `impedance` `(groups, n, 3, axes, axes)`.
        """
        jet = self.basis.jet(self.layout.path(inputs))
        if not self.coupled:
            own = impedance.diagonal(dim1=-2, dim2=-1).permute(2, 3, 0, 1).unsqueeze(-1)
            return own[0] * jet.value + own[1] * jet.velocity + own[2] * jet.acceleration
        blocks = [torch.einsum("gnac,cgnm->gancm", impedance[:, :, j], part) for j, part in enumerate(jet)]
        return _flatten(blocks[0] + blocks[1] + blocks[2])

    def trajectory(self, inputs: Tensor, order: int) -> Tensor:
        """Features of x_d − μ_xd, or its time derivative of `order` 1 or 2 [m, m/s, m/s²]."""
        return self._spread(self.basis.jet(self.layout.path(inputs))[order])

    def residual(self, inputs: Tensor) -> Tensor:
        """Features of ũ, of all its terms [N]; none where ũ = 0."""
        none = inputs.new_zeros(*inputs.shape[:-1], 0)
        return self._spread(
            torch.cat([none, *(basis.values(inputs) for basis in self.residual_bases)], dim=-1)
        )

    def split(self, trajectory: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
        """Columns of trajectory and residual as those that trials have of their own, and those that a group shares."""
        parts = ((self.layout.trajectory, trajectory), (self.layout.residual, residual))
        own = [values for label, values in parts if label is not None and values.shape[-1]]
        shared = [values for label, values in parts if label is None and values.shape[-1]]
        none = trajectory[..., :0]
        return _join(own, none), _join(shared, none)

    def by_axis(self, own: Tensor, shared: Tensor) -> tuple[Tensor, Tensor]:
        """Coefficients of trajectory and residual, `(axes, features)` each, of those that `split` set apart."""
        residual = sum(basis.size for basis in self.residual_bases)
        axes = (own.shape[-1] + shared.shape[-1]) // (self.basis.size + residual) if self.coupled else 1
        left = {True: own, False: shared}
        parts = []
        for label, size in ((self.layout.trajectory, self.basis.size), (self.layout.residual, residual)):
            values = left[label is not None]
            part, left[label is not None] = values[..., : axes * size], values[..., axes * size :]
            parts.append(part.reshape(axes, size) if self.coupled else part)
        return parts[0], parts[1]

    def rows(self, values: Tensor) -> Tensor:
        """Values `(axes, groups, n)` in the order of the rows of these matrices, `(axes|1, groups, rows)`."""
        return values.transpose(0, 1).flatten(1).unsqueeze(0) if self.coupled else values

    def per_axis(self, values: Tensor, axes: int) -> Tensor:
        """The inverse of `rows`."""
        return values[0].unflatten(-1, (axes, -1)).transpose(0, 1) if self.coupled else values

    def _spread(self, values: Tensor) -> Tensor:
        """What each axis has of its own, in the rows and columns of all axes where they couple."""
        if not self.coupled:
            return values
        eye = torch.eye(values.shape[0], dtype=values.dtype)
        return _flatten(torch.einsum("agnm,ac->gancm", values, eye))


def columns_of(term: Stationary) -> tuple[int, ...]:
    """Columns of the input that a residual term reads."""
    return tuple(range(term.num_dims)) if term.active_dims is None else tuple(term.active_dims.tolist())


def _hilbert(
    kernel: Stationary, columns: Sequence[int], logs: Sequence[Features], accuracy: Accuracy
) -> Basis:
    extents = [Extent.of(logs, column) for column in columns]
    return hilbert_basis(kernel, columns, extents, logs[0].inputs.shape[0], accuracy)


def _flatten(blocks: Tensor) -> Tensor:
    groups, axes, n, _, features = blocks.shape
    return blocks.reshape(1, groups, axes * n, axes * features)


def _join(parts: list[Tensor], none: Tensor) -> Tensor:
    if len(parts) < 2:
        return parts[0] if parts else none
    return torch.cat(parts, dim=-1)
