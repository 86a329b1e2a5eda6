"""The closed loop where axes are coupled: the Jacobian of every sample is the determinant of a matrix.

As for independent axes, with matrices: on a device M_r ẍ + D_r ẋ = u + p the density of the forces of all axes carries
det(I + Z M_r⁻¹) for each sample, with the apparent mass Z = M (I − ½ Δ M_r⁻¹ D_r) + ½ Δ D̄, M_r and D_r diagonal and D̄
the damping averaged over the samples. The entries of Z are linear in the terms of M and D. With vec Z ~ N(μ, S) given
the forces, the expectation of the n-th power of the determinant is taken by Laplace's method:

    ℓ(Z) = n log det(I + Z M_r⁻¹),   g = ∂ℓ/∂Z = n (M_r + Z)⁻ᵀ,   Λ = −∂²ℓ/∂Z²
    Ẑ = μ + S g(Ẑ),   log E[e^ℓ] ≈ ℓ(Ẑ) − ½ gᵀ S g − ½ log det(I + S Λ)

ℓ is concave where M_r + Z is positive definite, so the mode is one.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bayes_impedance.device import Loop
from bayes_impedance.engines.closed_loop import spread
from bayes_impedance.engines.dense import Factor, Observations, log_density, quadratic_forms
from bayes_impedance.kernels.coupled import CoupledImpedanceKernel, CoupledInteractionKernel

#: Newton steps to the mode; it converges quadratically, in five or so.
STEPS = 100
TOLERANCE = 1e-12


@dataclass(frozen=True)
class MatrixJacobian:
    """E[det(I + Z M_r⁻¹)ⁿ] under vec Z ~ N(μ, S), by Laplace's method.

    `mode` Ẑ `(*batch, axes, axes)` [kg]; `slope` g `(*batch, axes²)` [1/kg] and `curvature` Λ `(*batch, axes², axes²)`
    [1/kg²] there, so that it acts on vec Z like a measurement of precision Λ; `log_expectation` `(*batch,)` [nats].
    """

    mode: Tensor
    slope: Tensor
    curvature: Tensor
    log_expectation: Tensor


def matrix_jacobian(mean: Tensor, covariance: Tensor, count: Tensor, device_mass: Tensor) -> MatrixJacobian:
    """Laplace approximation for vec Z of mean `(*batch, axes²)` [kg] and covariance `(*batch, axes², axes²)` [kg²].

    `count` samples `(*batch,)`, `device_mass` the diagonal of M_r `(axes,)` [kg]; entries of Z row by row.
    Differentiable in mean and covariance: the last step of Newton's method, from the mode, carries its derivative.
    """
    with torch.no_grad():
        mode = _mode(mean, covariance, count, device_mass)
        slope, curvature = _derivatives(mode, count, device_mass)
        eye = torch.eye(mean.shape[-1], dtype=mean.dtype)
        gain = torch.linalg.inv(eye + covariance @ curvature)
    residual = mode - mean - (covariance @ slope.unsqueeze(-1)).squeeze(-1)
    mode = mode - (gain @ residual.unsqueeze(-1)).squeeze(-1)
    slope, curvature = _derivatives(mode, count, device_mass)
    spread_by_slope = (covariance @ slope.unsqueeze(-1)).squeeze(-1)
    inner = torch.eye(mean.shape[-1], dtype=mean.dtype) + covariance @ curvature
    log_expectation = (
        count * (torch.linalg.slogdet(_sum(mode, device_mass))[1] - device_mass.log().sum())
        - 0.5 * (slope * spread_by_slope).sum(-1)
        - 0.5 * torch.linalg.slogdet(inner)[1]
    )
    axes = device_mass.numel()
    return MatrixJacobian(mode.unflatten(-1, (axes, axes)), slope, curvature, log_expectation)


def _sum(entries: Tensor, device_mass: Tensor) -> Tensor:
    """M_r + Z."""
    axes = device_mass.numel()
    return torch.diag(device_mass) + entries.unflatten(-1, (axes, axes))


def _derivatives(entries: Tensor, count: Tensor, device_mass: Tensor) -> tuple[Tensor, Tensor]:
    """g and Λ of n log det(I + Z M_r⁻¹): with P = (M_r + Z)⁻¹, g_bc = n P_cb and Λ_bc,de = n P_cd P_eb."""
    inverse = torch.linalg.inv(_sum(entries, device_mass))
    slope = count[..., None, None] * inverse.mT
    curvature = torch.einsum("...,...cd,...eb->...bcde", count, inverse, inverse)
    return slope.flatten(-2), curvature.flatten(-4, -3).flatten(-2)


def _mode(mean: Tensor, covariance: Tensor, count: Tensor, device_mass: Tensor) -> Tensor:
    """Ẑ by Newton's method on Z − μ − S g(Z) = 0, kept where M_r + Z is positive definite."""
    eye = torch.eye(mean.shape[-1], dtype=mean.dtype)
    mode = torch.where(_is_proper(mean, device_mass).unsqueeze(-1), mean, torch.zeros_like(mean))
    for _ in range(STEPS):
        slope, curvature = _derivatives(mode, count, device_mass)
        residual = mode - mean - (covariance @ slope.unsqueeze(-1)).squeeze(-1)
        step = torch.linalg.solve(eye + covariance @ curvature, residual.unsqueeze(-1)).squeeze(-1)
        size = torch.ones_like(step[..., :1])
        for _ in range(STEPS):
            proper = _is_proper(mode - size * step, device_mass)
            if bool(proper.all()):
                break
            size = torch.where(proper.unsqueeze(-1), size, 0.5 * size)
        mode = mode - size * step
        if bool((step.abs() <= TOLERANCE * device_mass.max()).all()):
            break
    return mode


def _is_proper(entries: Tensor, device_mass: Tensor) -> Tensor:
    matrix = _sum(entries, device_mass)
    return torch.linalg.eigvalsh(0.5 * (matrix + matrix.mT)).amin(-1) > 0.0


def coupled_log_likelihood(
    kernel: CoupledInteractionKernel, observations: Observations, loop: Loop, jitter: float
) -> Tensor:
    """log p(u) of the forces of all axes with the Jacobian of the closed `loop`, `(groups,)` [nats].

    Raises:
        NotPositiveDefiniteError: no Cholesky factor at this jitter.
    """
    apparent = ApparentMassMatrix(kernel.impedance, observations, loop)
    cross = apparent.force_covariance(observations.inputs)
    columns = torch.cat([observations.residual.unsqueeze(-1), cross], dim=-1)
    forms, log_det = quadratic_forms(kernel, observations, columns, jitter)
    mean, covariance = apparent.mean + forms[..., 0, 1:], apparent.covariance - forms[..., 1:, 1:]
    known = matrix_jacobian(mean, covariance, apparent.samples, apparent.device_mass)
    return log_density(forms[..., 0, 0], log_det, observations) + known.log_expectation


class ApparentMassMatrix:
    """Z before any force is known, D̄ the damping averaged over the samples given; entries row by row.

    `mean` `(groups, axes²)` [kg], `covariance` `(groups, axes², axes²)` [kg²]; `samples` of each group `(groups,)`;
    `loading` `(groups, axes², 3 terms)`: derivative of the mean by the logarithms of the terms of K, D and M.
    """

    def __init__(self, impedance: CoupledImpedanceKernel, observations: Observations, loop: Loop) -> None:
        self._impedance = impedance
        axes = impedance.axes
        self.samples = (observations.count / axes).expand(observations.inputs.shape[:-2])
        self.device_mass = loop.device_mass.reshape(-1)
        half = 0.5 * loop.step
        share = 1.0 - half.unsqueeze(-1) * (loop.device_damping / loop.device_mass).reshape(-1)
        _, damping, mass = impedance.processes
        dyads = damping.dyads
        # ∂Z/∂e^{g_r}, `(groups, axes, axes, terms)`: of the mass each column has its share, of the damping ½ Δ.
        self._by_mass = (dyads * share[:, None, :, None]).flatten(1, 2)
        self._by_damping = (dyads * half[:, None, None, None]).flatten(1, 2)
        self._anchors = spread(observations.inputs, self.samples)
        x = self._anchors
        # `(groups, terms)`
        masses = self._groups(mass.expectations(x)[..., 0].mean(-1))
        damped = self._groups(damping.expectations(x)[..., 0].mean(-1))
        spread_of_mass = masses.square() * torch.expm1(
            self._groups(mass.gaussian_covariance(x, x, diag=True).mean(-1))
        )
        spread_of_damping = self._groups(self._damping_covariance(x).mean((-2, -1)))
        self.mean = _apply(self._by_mass, masses) + _apply(self._by_damping, damped)
        self.covariance = _sandwich(self._by_mass, spread_of_mass) + _sandwich(
            self._by_damping, spread_of_damping
        )
        own = (
            torch.zeros_like(self._by_mass),
            self._by_damping * damped.unsqueeze(1),
            self._by_mass * masses.unsqueeze(1),
        )
        self.loading = torch.cat(own, dim=-1)

    def force_covariance(self, x: Tensor) -> Tensor:
        """Prior covariance of the forces at `x` `(groups, n, D)` with vec Z, `(groups, n · axes, axes²)` [N kg]."""
        _, damping, mass = self._impedance.processes
        damped = self._damping_covariance(x).mean(-1, keepdim=True) / damping.expectations(x)
        by_damping = self._impedance.row_loading(x, 1, damped)
        k = mass.gaussian_covariance(x, self._anchors)[..., :1]
        own = mass.expectations(self._anchors)[..., :1, :] * torch.expm1(k)
        by_mass = self._impedance.row_loading(x, 2, own)
        return by_damping @ self._by_damping.mT + by_mass @ self._by_mass.mT

    def term_covariance(self, x: Tensor, order: int) -> Tensor:
        """Prior covariance of g_jr at `x` with vec Z, j = `order`, `(groups, n, terms, axes²)` [kg]."""
        process = self._impedance.processes[order]
        if order == 0:
            return x.new_zeros(*x.shape[:-1], len(process.shares), self.mean.shape[-1])
        expected = process.expectations(self._anchors).mT
        covariance = (process.gaussian_covariance(x, self._anchors) * expected).mean(-1)
        covariance = covariance.expand(*covariance.shape[:-2], *x.shape[:-1]).movedim(0, -1)
        by_term = self._by_damping if order == 1 else self._by_mass
        return covariance.unsqueeze(-1) * by_term.mT.unsqueeze(-3)

    def _damping_covariance(self, x: Tensor) -> Tensor:
        """Cov[e^{g_r}, e^{g_r}'] of the damping's terms between `x` and the anchors, `(terms, groups, n, anchors)`."""
        damping = self._impedance.damping
        k = damping.gaussian_covariance(x, self._anchors)
        return damping.expectations(x) * damping.expectations(self._anchors).mT * torch.expm1(k)

    def _groups(self, terms: Tensor) -> Tensor:
        """`(terms, groups or 1)` as `(groups, terms)`."""
        return terms.movedim(0, -1).expand(len(self.samples), -1)


class CoupledLoopEvidence:
    """What the Jacobian tells of the apparent mass beside the forces of `factor`, and through it of every latent.

    `white` L⁻¹ Cov[u, vec Z] `(groups, n · axes, axes²)`; `covariance` S of vec Z given the forces alone.
    """

    def __init__(
        self, impedance: CoupledImpedanceKernel, factor: Factor, observations: Observations, loop: Loop
    ) -> None:
        self.apparent = ApparentMassMatrix(impedance, observations, loop)
        cross = self.apparent.force_covariance(observations.inputs)
        self.white = factor.whiten(cross)
        self.covariance = self.apparent.covariance - self.white.mT @ self.white
        # On padding α is zero.
        mean = self.apparent.mean + (cross.mT @ factor.alpha.unsqueeze(-1)).squeeze(-1)
        self.jacobian = matrix_jacobian(
            mean, self.covariance, self.apparent.samples, self.apparent.device_mass
        )

    def gain(self, covariance: Tensor) -> Tensor:
        """Λ (I + S Λ)⁻¹ for the covariance S of vec Z: between Cov[·, vec Z], what the Jacobian takes away."""
        curvature = self.jacobian.curvature
        eye = torch.eye(curvature.shape[-1], dtype=curvature.dtype)
        return curvature @ torch.linalg.inv(eye + covariance @ curvature)


def _apply(weights: Tensor, terms: Tensor) -> Tensor:
    return (weights @ terms.unsqueeze(-1)).squeeze(-1)


def _sandwich(weights: Tensor, variances: Tensor) -> Tensor:
    return (weights * variances.unsqueeze(-2)) @ weights.mT
