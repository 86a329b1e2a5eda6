"""The density in other coordinates, in which functions that data determine do not move with how they vary.

Whitened weights v of a function have f = L(η) v at its inducing inputs, L Lᵀ = s² R(Z, Z): where data determine f,
weights and log-SD s or length scale ℓ lie on a curved ridge. So samplers move c = L(η₀)⁻¹ f, with η₀ the medians of
s and ℓ:

    v = L(η)⁻¹ L(η₀) c,    log |∂v/∂c| = log det L(η₀) − log det L(η)

Papaspiliopoulos, Roberts and Sköld, *A general framework for the parametrization of hierarchical models*, Statistical
Science 2007.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.sampling.density import JointDensity, SampledDensity
from bayes_impedance.sampling.parameters import QUANTITIES

Array = NDArray[np.float64]


class CentredDensity(SampledDensity):
    """A `JointDensity` over c in place of v, all else as it is."""

    def __init__(self, density: JointDensity) -> None:
        super().__init__(density.weight_count, density.free)
        self.density = density
        with torch.no_grad():
            self._reference = self._roots(torch.zeros(density.size, dtype=torch.float64))

    def standard(self, coordinates: Tensor) -> tuple[Tensor, Tensor]:
        """The standard normal coordinates `(size,)` that they stand for, and the logarithm of the Jacobian [nats]."""
        jacobian = coordinates.new_zeros(())
        if not self._reference:
            return coordinates, jacobian
        parts = list(coordinates.split(self.density.sizes))
        for j, root in self._roots(coordinates).items():
            shape = self.density.parameters[j].shape
            reference = self._reference[j]
            own = parts[j].reshape(shape)
            values = (reference @ own[..., 1:].unsqueeze(-1)).expand(*shape[:2], -1, 1)
            whitened = torch.linalg.solve_triangular(root, values, upper=False)[..., 0]
            parts[j] = torch.cat([own[..., :1], whitened], dim=-1).reshape(-1)
            ratio = reference.diagonal(dim1=-2, dim2=-1).log() - root.diagonal(dim1=-2, dim2=-1).log()
            jacobian = jacobian + shape[0] * ratio.sum()
        return torch.cat(parts), jacobian

    def all_standard(self, coordinates: Array) -> Array:
        """Standard normal coordinates of many, `(..., size)`."""
        rows = torch.from_numpy(coordinates.reshape(-1, self.size))
        with torch.no_grad():
            found = [self.standard(row)[0].numpy() for row in rows]
        return np.array(found).reshape(coordinates.shape)

    def log_density(self, coordinates: Tensor) -> Tensor:
        """log p(coordinates | u) up to a constant [nats].

        Raises:
            NotPositiveDefiniteError: see `JointDensity`.
        """
        standard, jacobian = self.standard(coordinates)
        return self.density.log_density(standard) + jacobian

    def _roots(self, coordinates: Tensor) -> dict[int, Tensor]:
        """L of each entry of K, D and M `(entries, Z, Z)`, where how they vary is sampled."""
        values = self.density.values(coordinates)
        roots = {}
        for j, function in enumerate(self.density.functions(values)):
            if self.density.varies(QUANTITIES[j]):
                root = torch.linalg.cholesky(function.covariance_at_inducing())[:, 0]
                roots[j] = root[[a for a, _ in function.places]]
        return roots
