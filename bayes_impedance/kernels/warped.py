"""Priors of mass, damping and stiffness: Gaussian processes, or their exponentials, with closed moments.

Log-Gaussian: log w ~ GP(log μ_w, k_w), so E[w] = μ_w exp(k_w(ξ,ξ)/2) and
Cov[w, w'] = E[w] E[w'] (exp k_w(ξ,ξ') − 1); μ_w is the median (docs/model.md §5).
"""

from __future__ import annotations

from typing import Literal

import torch
from gpytorch.constraints import Interval
from gpytorch.kernels import Kernel
from gpytorch.priors import Prior
from linear_operator import to_dense
from torch import Tensor

from bayes_impedance.kernels.stationary import (
    BatchedKernel,
    StationaryCovariance,
    register_positive,
    set_positive,
)

#: Whether w itself is a Gaussian process, or its logarithm.
Law = Literal["gaussian", "log_gaussian"]


class ImpedanceProcess(BatchedKernel):
    """One of k, d, m as a process over ξ; as a gpytorch kernel it is Cov[w(ξ), w(ξ')].

    Args:
        covariance: gpytorch kernel of w (gaussian) or of log w (log_gaussian), over its `active_dims`.
        law: "gaussian" or "log_gaussian".
        level_prior, level_constraint: of the level `(*batch, 1, 1)`: the mean of w, or the median.

    Example:
        >>> from bayes_impedance.kernels import StationaryKernel
        >>> stiffness = ImpedanceProcess(StationaryKernel()).double()
        >>> stiffness.level, stiffness.covariance.sd = 300.0, 0.3
        >>> phase = torch.linspace(0.0, 1.0, 5, dtype=torch.float64).unsqueeze(-1)
        >>> round(stiffness.expectation(phase)[0, 0].item(), 1)  # 300 exp(0.3² / 2) N/m
        313.8

    Raises:
        ValueError: an unknown law.
    """

    def __init__(
        self,
        covariance: Kernel,
        law: Law = "log_gaussian",
        level_prior: Prior | None = None,
        level_constraint: Interval | None = None,
        batch_shape: torch.Size | None = None,
        active_dims: tuple[int, ...] | None = None,
    ) -> None:
        if law not in ("gaussian", "log_gaussian"):
            raise ValueError(f"law: expected 'gaussian' or 'log_gaussian', got {law!r}")
        super().__init__(batch_shape=batch_shape, active_dims=active_dims)
        self.covariance = covariance
        self.law = law
        register_positive(self, "level", self._batch_shape, level_prior, level_constraint)

    @property
    def level(self) -> Tensor:
        """Mean (gaussian) or median (log_gaussian) of w, `(*batch, 1, 1)` [unit of w]."""
        return self.raw_level_constraint.transform(self.raw_level)

    @level.setter
    def level(self, value: Tensor | float) -> None:
        set_positive(self, "level", value)

    def gaussian_covariance(self, x1: Tensor, x2: Tensor, diag: bool = False) -> Tensor:
        """k_w: covariance of the Gaussian variable (w or log w), `(..., n1, n2)` or `(..., n)`."""
        return evaluate(self.covariance, x1, x2, diag)

    def expectation(self, x: Tensor) -> Tensor:
        """E[w(ξ)], `(..., n, 1)` or `(..., 1, 1)` [unit of w]."""
        if self.law == "gaussian":
            return self.level
        return self.level * torch.exp(0.5 * self.gaussian_covariance(x, x, diag=True).unsqueeze(-1))

    def sensitivity(self, x: Tensor) -> Tensor:
        """Cov[·, Gaussian variable] = sensitivity · k_w for anything linear in w: 1, or E[w(ξ)]."""
        return torch.ones_like(self.level) if self.law == "gaussian" else self.expectation(x)

    def moments(self, x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """E[w], E[w'] as `(..., n1, 1)`, `(..., 1, n2)`, and Cov[w, w'] `(..., n1, n2)`."""
        e1, e2 = self.expectation(x1), self.expectation(x2).mT
        k = self.gaussian_covariance(x1, x2)
        return e1, e2, k if self.law == "gaussian" else e1 * e2 * torch.expm1(k)

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: object) -> Tensor:
        """Cov[w(ξ), w(ξ')], `(..., n1, n2)` or `(..., n)` with `diag` [unit of w, squared]."""
        if diag:
            k = self.gaussian_covariance(x1, x2, diag=True)
            if self.law == "gaussian":
                return k
            e = self.expectation(x1)[..., 0]
            return e * e * torch.expm1(k)
        return self.moments(x1, x2)[2]


def evaluate(kernel: Kernel | StationaryCovariance, x1: Tensor, x2: Tensor, diag: bool = False) -> Tensor:
    """Dense covariance of any gpytorch kernel, without the cost of its lazy tensors."""
    if kernel.active_dims is not None:
        x1, x2 = x1.index_select(-1, kernel.active_dims), x2.index_select(-1, kernel.active_dims)
    values = kernel.forward(x1, x2, diag=diag)
    return values if isinstance(values, Tensor) else to_dense(values)
