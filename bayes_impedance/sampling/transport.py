"""The density in coordinates in which functions and how they vary have little to do with each other.

Where data determine a function f = L(η) v, its whitened weights v and its log-SD or length scale η lie on a curved
ridge; where they do not, f shrinks and grows with η. Both are gone in ε, the weights in units of their posterior at
each η,

    v = A⁻¹ Qᵀ (I + B) v₀ + A^{−½} ε,    A = I + Qᵀ B Q,    Q(η) = L(η₀)⁻¹ L(η),    log |∂v/∂ε| = −½ log det A

for a log likelihood that is a quadratic in f, of curvature B in weights v about v₀, at η₀. The one at hand is that only
nearly, which costs no draw its accuracy. At B = 0 nothing changes. (Papaspiliopoulos, Roberts and Sköld, *A general
framework for the parametrization of hierarchical models*, Statistical Science 2007, have the scalar case.)
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.sampling.density import JointDensity, SampledDensity
from bayes_impedance.sampling.parameters import QUANTITIES

Array = NDArray[np.float64]


class TransportedDensity(SampledDensity):
    """A `JointDensity` over (ε, hyperparameters), all else as it is."""

    def __init__(self, density: JointDensity) -> None:
        super().__init__(density.weight_count, density.free)
        self.density = density
        count = density.weight_count
        self._curvature = torch.zeros(count, count, dtype=torch.float64)
        self._target = torch.zeros(count, dtype=torch.float64)
        self._reference: dict[int, Tensor] = {}
        self._varies = any(density.varies(name) for name in QUANTITIES)
        self._at_reference = self._solved(self._curvature, self._target)

    def settle(self, point: Array, precision: Array) -> tuple[Array, float]:
        """Take the curvature about a mode for the likelihood's; the same place in the new coordinates.

        `precision` `(size, size)` of the present coordinates. Also returns 0: hyperparameters stay.
        """
        count = self.weight_count
        with torch.no_grad():
            coordinates = torch.from_numpy(point)
            standard, _ = self.standard(coordinates)
            root, _ = self._posterior(coordinates)
            whole = root @ torch.from_numpy(precision[:count, :count]) @ root.mT
            values, vectors = torch.linalg.eigh(whole - torch.eye(count, dtype=torch.float64))
            self._curvature = (vectors * values.clamp_min(0.0)) @ vectors.mT
            self._target = standard[:count] + self._curvature @ standard[:count]
            self._reference = self._roots(coordinates)
            self._at_reference = self._solved(self._curvature, self._target)
        return np.concatenate([np.zeros(count), point[count:]]), 0.0

    def standard(self, coordinates: Tensor) -> tuple[Tensor, Tensor]:
        """The standard normal coordinates `(size,)` that they stand for, and the logarithm of the Jacobian [nats]."""
        root, mean = self._posterior(coordinates)
        own = coordinates[: self.weight_count].unsqueeze(-1)
        weights = mean + torch.linalg.solve_triangular(root.mT, own, upper=True)[:, 0]
        jacobian = -root.diagonal().log().sum()
        return torch.cat([weights, coordinates[self.weight_count :]]), jacobian

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

    def _posterior(self, coordinates: Tensor) -> tuple[Tensor, Tensor]:
        """Cholesky factor of A, and the mean of v."""
        if not (self._varies and self._reference):
            return self._at_reference
        change = self._change(coordinates)
        return self._solved(change.mT @ self._curvature @ change, change.mT @ self._target)

    def _solved(self, curvature: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Cholesky factor of I + `curvature`, and A⁻¹ `target`."""
        root = torch.linalg.cholesky(torch.eye(self.weight_count, dtype=torch.float64) + curvature)
        return root, torch.cholesky_solve(target.unsqueeze(-1), root)[:, 0]

    def _change(self, coordinates: Tensor) -> Tensor:
        """Q, block diagonal over groups and entries of K, D and M."""
        roots = self._roots(coordinates)
        one = torch.ones(1, 1, dtype=torch.float64)
        blocks = []
        for j, parameter in enumerate(self.density.parameters[: len(QUANTITIES)]):
            groups, entries, width = parameter.shape
            if j not in roots:
                blocks.append(torch.eye(groups * entries * width, dtype=torch.float64))
                continue
            own = torch.linalg.solve_triangular(self._reference[j], roots[j], upper=False)
            blocks += [part for _ in range(groups) for block in own for part in (one, block)]
        return torch.block_diag(*blocks)

    def _roots(self, coordinates: Tensor) -> dict[int, Tensor]:
        """L of each entry of K, D and M `(entries, Z, Z)`, where how they vary is sampled."""
        values = self.density.values(coordinates)
        roots = {}
        for j, function in enumerate(self.density.functions(values)):
            if self.density.varies(QUANTITIES[j]):
                root = torch.linalg.cholesky(function.covariance_at_inducing())[:, 0]
                roots[j] = root[[a for a, _ in function.places]]
        return roots
