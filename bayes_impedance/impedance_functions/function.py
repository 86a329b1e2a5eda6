"""Stiffness, damping and mass as functions whose logarithm is linear in whitened weights (docs/model.md §13).

    S_e(ξ) = m_e + s_b b_e + s R(ξ, Z) L⁻ᵀ v_e,    L Lᵀ = R(Z, Z),    b_e, v_e ~ N(0, 1)

for each free entry e of the logarithm S of a matrix: m is the log median of its level and s_b the log-SD of that
hyperprior, s and R log-SD and correlation of its variation along the input ξ, which inducing inputs Z carry.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bayes_impedance.config import Config, Hyperparameter, ImpedancePrior, MassPrior
from bayes_impedance.features import Features
from bayes_impedance.impedance_functions.inducing import inducing_inputs
from bayes_impedance.impedance_functions.symmetric import entries, exponential
from bayes_impedance.kernels.stationary import Stationary
from bayes_impedance.kernels.warped import evaluate
from bayes_impedance.priors import ForceModel

#: Added to the diagonal of R(Z, Z), relative to its ones.
JITTER = 1e-9
#: Variance of the variation off the diagonal of S over that on it: with one half, no direction in space is special.
OFF_DIAGONAL = 0.5


@dataclass(frozen=True)
class ImpedanceFunction:
    """One of K, D, M.

    `covariance` of its variation along the input; `location` and `level_sd` `(entries,)`: prior mean and SD of the
    level of each entry of S at `places`; `scale` `(entries,)`: SD of its variation over that of `covariance`;
    `inducing` `(Z, D)`, None where the function is a constant.
    """

    covariance: Stationary
    places: tuple[tuple[int, int], ...]
    location: Tensor
    level_sd: Tensor
    scale: Tensor
    inducing: Tensor | None

    @property
    def axes(self) -> int:
        """Rows of the matrix."""
        return 1 + max(a for a, _ in self.places)

    @property
    def width(self) -> int:
        """Weights of each entry: one for the level, one for each inducing input."""
        return 1 if self.inducing is None else 1 + len(self.inducing)

    def design(self, inputs: Tensor) -> Tensor:
        """Factors of the weights of each entry at `inputs` `(axes, groups, n, D)`: `(groups, entries, n, width)`.

        Differentiable in log-SD and length scale.
        """
        level = self.level_sd[:, None, None].expand(*self.level_sd.shape, inputs.shape[-2], 1)
        level = level.expand(inputs.shape[1], *level.shape)
        if self.inducing is None:
            return level
        root = torch.linalg.cholesky(self.covariance_at_inducing())
        cross = evaluate(self.covariance, inputs, self.inducing)
        variation = torch.linalg.solve_triangular(root, cross.mT, upper=False).mT
        own = variation[[a for a, _ in self.places]].transpose(0, 1)
        return torch.cat([level, self.scale[:, None, None] * own], dim=-1)

    def covariance_at_inducing(self) -> Tensor:
        """s² R(Z, Z), `(axes, 1, Z, Z)`; differentiable in log-SD and length scale."""
        assert self.inducing is not None
        covariance = evaluate(self.covariance, self.inducing, self.inducing)
        jitter = JITTER * self.covariance.sd**2
        return covariance + jitter * torch.eye(len(self.inducing), dtype=covariance.dtype)

    def left_out(self, inputs: Tensor, design: Tensor) -> Tensor:
        """Prior variance that inducing inputs do not carry, `(groups, entries, n)`, given the `design` there."""
        if self.inducing is None:
            return inputs.new_zeros(design.shape[:-1])
        own = evaluate(self.covariance, inputs, inputs, diag=True)
        own = own.expand(inputs.shape[:-1])[[a for a, _ in self.places]].transpose(0, 1)
        carried = design[..., 1:].square().sum(-1)
        return (self.scale.square()[:, None] * own - carried).clamp_min(0.0)

    def prior(self, inputs: Tensor, design: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Location and covariance of S before any force, `(groups, n, entries)` and `(…, entries)`, given twice.

        `design` at `inputs`.
        """
        variance = (design.square().sum(-1) + self.left_out(inputs, design)).transpose(1, 2)
        location, covariance = self.location.expand_as(variance), torch.diag_embed(variance)
        return location, covariance, location, covariance

    def logarithm(self, design: Tensor, weights: Tensor) -> Tensor:
        """Entries of S, `(groups, n, entries)`, for `weights` `(groups, entries, width)`."""
        return self.location + (design @ weights.unsqueeze(-1))[..., 0].mT

    def matrices(self, design: Tensor, weights: Tensor) -> Tensor:
        """exp S, `(groups, n, axes, axes)`."""
        return self.exponential(self.logarithm(design, weights))

    def exponential(self, logarithm: Tensor) -> Tensor:
        """exp S, `(..., axes, axes)`, of the entries of S `(..., entries)`."""
        return exponential(logarithm, self.places, self.axes)


def choose_inducing(config: Config, model: ForceModel, features: Features) -> tuple[Tensor | None, ...]:
    """Inducing inputs of K, D and M that cover the samples of `features`; None for a constant."""
    processes = model.kernel.impedance.processes
    return tuple(
        inducing_inputs(process.covariance, features, config.engine.inducing) if prior.input else None
        for process, prior in zip(processes, _priors(config), strict=True)
    )


def build_functions(
    config: Config, model: ForceModel, inducing: Sequence[Tensor | None]
) -> tuple[ImpedanceFunction, ...]:
    """K, D and M under the priors of `config`, at the hyperparameters of `model`."""
    impedance = model.kernel.impedance
    axes = impedance.trajectory.batch_shape[0]
    places = entries(axes, config.model.axes == "coupled")
    functions = []
    for process, prior, own in zip(impedance.processes, _priors(config), inducing, strict=True):
        functions.append(_function(process.covariance, prior, places, own))
    return tuple(functions)


def _priors(config: Config) -> tuple[ImpedancePrior | MassPrior, ...]:
    return config.model.stiffness, config.model.damping, config.model.mass


def _function(
    covariance: Stationary,
    prior: ImpedancePrior | MassPrior,
    places: Sequence[tuple[int, int]],
    inducing: Tensor | None,
) -> ImpedanceFunction:
    level_sd = _level_sd(prior.level)
    coupling = prior.coupling.median
    if inducing is None:
        constant = _constant_log_sd(prior)
        level_sd = (level_sd**2 + constant**2) ** 0.5
        coupling = (coupling**2 + OFF_DIAGONAL * constant**2) ** 0.5

    def by_place(on: float, off: float) -> Tensor:
        return torch.tensor([on if a == b else off for a, b in places], dtype=torch.float64)

    return ImpedanceFunction(
        covariance=covariance,
        places=tuple(places),
        location=by_place(math.log(prior.level.median), 0.0),
        level_sd=by_place(level_sd, coupling),
        scale=by_place(1.0, OFF_DIAGONAL**0.5),
        inducing=inducing,
    )


def _level_sd(level: Hyperparameter) -> float:
    return 0.0 if level.fixed else level.log_sd


def _constant_log_sd(prior: ImpedancePrior | MassPrior) -> float:
    """Log-SD of a constant about its level."""
    if isinstance(prior, MassPrior):
        return prior.sd.median / prior.level.median
    return prior.scale.median
