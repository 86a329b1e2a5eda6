"""Posteriors from local sparse models: a mixture over the cells nearest to each sample (docs/model.md §17).

Every latent has a covariance with the force at a cell's inducing inputs, so that all are predicted from what the cell
has learned of the force. Levels that were learned are offsets, as in `posterior.independent`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.config import LocalConfig
from bayes_impedance.engines.local.build import build_local, learn_log
from bayes_impedance.engines.local.cell import Cell, whitened
from bayes_impedance.engines.local.grid import weights_of
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import FeatureMap, Features, LogFeatures
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.posterior.batches import Progress, each_group
from bayes_impedance.posterior.collected import MomentsAt, axes_last, collect
from bayes_impedance.posterior.conditioning import Moments, offset_covariance, unwarped
from bayes_impedance.posterior.independent import (
    IndependentPrior,
    LatentPrior,
    is_warped,
    level_loading,
)
from bayes_impedance.posterior.results import Posterior
from bayes_impedance.priors import ForceModel
from bayes_impedance.training import observations

Array = NDArray[np.float64]


def infer_local(
    model: ForceModel,
    target: LogFeatures,
    given: LogFeatures | None,
    settings: LocalConfig,
    latents: Sequence[Latent] | None = None,
    progress: Progress | None = None,
) -> Posterior:
    """Posteriors at every sample of the log of `target`, given the forces of that of `given`; else the prior.

    Groups of `target` without a namesake in `given` keep their prior, and so do samples outside of the range of motion
    of `given`. Memory beyond logs and results is that of the cells of the groups at work.

    Raises:
        ConfigurationError: see `LocalConditioner`.
    """
    latents = list(Latent) if latents is None else latents
    prior = IndependentPrior(model)

    def condition(evidence: Features | None) -> MomentsAt:
        source: IndependentPrior | LocalConditioner = prior
        if evidence is not None:
            source = LocalConditioner(prior, target.feature_map, settings, evidence)
        return lambda piece: axes_last(source.moments(piece, latents))

    batches = each_group(target.log, None if given is None else given.log)
    collected = collect(target, given, batches, condition, progress)
    return Posterior(
        target.log, {latent: collected.marginal(latent, is_warped(model, latent)) for latent in latents}
    )


class LearnedCell(NamedTuple):
    """A cell along one axis: inducing inputs `(B, D)`, factors L and Uᵀ, d `(B,)`.

    Offsets of levels: `loading` U⁻ᵀ Σ a ℓᵀ/(σ² + δ) `(B, 3)`, and their covariance `(3, 3)`.
    """

    inducing: Tensor
    prior: Tensor
    posterior: Tensor
    d: Tensor
    loading: Tensor
    levels: Tensor


class LocalConditioner:
    """Forces of one group, learned by local models, conditioned on for any number of targets.

    Raises:
        ConfigurationError: the model is none that local models hold, a device answers its force, the widths of cells
            fit no grid, or there are too few cells.
    """

    @torch.no_grad()
    def __init__(
        self, prior: IndependentPrior, feature_map: FeatureMap, settings: LocalConfig, given: Features
    ) -> None:
        if given.loop is not None:
            raise ConfigurationError(
                "device: expected none with engine.name: local, which takes the recorded motion as given, got a robot "
                "whose answer tells of the mass; set engine.name=dense, or device=null"
            )
        self.prior, self.model = prior, prior.model
        n = len(given.rows[0])
        inputs = np.ascontiguousarray(given.inputs[:, 0, :n].numpy())
        self.local = build_local(self.model, feature_map, settings, inputs[0])
        learn_log(self.local, inputs, observations(self.model, given).residual[:, 0, :n].numpy())
        self.kernels = [self.model.kernel[axis, 0] for axis in range(len(inputs))]
        loading = level_loading(self.model, given.inputs, Latent.FORCE)[:, 0, :n].numpy()
        assert prior.level_variance is not None
        codes, _ = weights_of(self.local.grid, inputs[0], settings.active)
        self.learned: dict[int, list[LearnedCell]] = {}
        for code, cell in self.local.cells.items():
            rows = np.flatnonzero((codes == code).any(axis=1))
            self.learned[code] = [
                self._learned(
                    cell, axis, inputs[axis, rows], loading[axis, rows], prior.level_variance[axis, 0]
                )
                for axis in range(len(inputs))
            ]

    def _learned(self, cell: Cell, axis: int, inputs: Array, loading: Array, variance: Tensor) -> LearnedCell:
        n = int(cell.used[axis])
        one = np.ones(len(inputs))
        a, scale = whitened(self.local.numbers, self.local.noise[axis], axis, cell, inputs, one)
        scaled = torch.from_numpy(loading * scale[:, None])
        factor = torch.from_numpy(cell.posterior[axis, :n, :n]).mT
        seen = torch.linalg.solve_triangular(factor, torch.from_numpy(a[:, :n]).mT @ scaled, upper=False)
        return LearnedCell(
            torch.from_numpy(np.ascontiguousarray(cell.inputs[axis, :, :n].T)),
            torch.from_numpy(cell.prior[axis, :n, :n]),
            factor,
            torch.from_numpy(cell.d[axis, :n]),
            seen,
            offset_covariance(scaled.mT @ scaled - seen.mT @ seen, variance),
        )

    @torch.no_grad()
    def moments(self, target: Features, latents: Sequence[Latent]) -> dict[Latent, Moments]:
        """Moments of each latent at the samples of `target`, of the same group."""
        codes, weights = weights_of(self.local.grid, target.inputs[0, 0].numpy(), self.local.settings.active)
        return {
            latent: self._moments(target, latent, prior, codes, weights)
            for latent, prior in self.prior.at(target, latents).items()
        }

    def _moments(
        self, target: Features, latent: Latent, prior: LatentPrior, codes: NDArray[np.int64], weights: Array
    ) -> Moments:
        shape = target.inputs.shape[:-1]
        prior_location, prior_variance = prior.location.expand(shape), prior.variance.expand(shape)
        # Σ g, Σ g mean, Σ g (variance + mean²)
        total = torch.zeros(3, *shape, dtype=prior_variance.dtype)
        for code in np.unique(codes).tolist():
            if code not in self.learned:
                continue
            rows, places = np.nonzero(codes == code)
            weight = torch.from_numpy(weights[rows, places])
            for axis, learned in enumerate(self.learned[code]):
                location, variance = self._of_cell(learned, axis, target, rows, prior, latent)
                total[:, axis, 0, rows] += weight * torch.stack(
                    [torch.ones_like(location), location, variance + location.square()]
                )
        known = total[0] > 0.0
        normaliser = torch.where(known, total[0], 1.0)
        location = torch.where(known, total[1] / normaliser, prior_location)
        spread = (total[2] / normaliser - location.square()).clamp_min(0.0)
        noise = self.model.noise_variance if latent is Latent.FORCE else 0.0
        variance = torch.where(known, spread + noise, prior_variance)
        return location, variance, prior.shown.expand(shape), prior_variance

    def _of_cell(
        self,
        learned: LearnedCell,
        axis: int,
        target: Features,
        rows: NDArray[np.int64],
        prior: LatentPrior,
        latent: Latent,
    ) -> tuple[Tensor, Tensor]:
        """Location and variance, without noise, that a cell gives some samples of an axis, `(m,)` each."""
        shape = target.inputs.shape[:-1]
        location, own = (
            prior.location.expand(shape)[axis, 0, rows],
            prior.own_variance.expand(shape)[axis, 0, rows],
        )
        cross = self.kernels[axis].cross_covariance(learned.inducing, target.inputs[axis, 0, rows], latent)
        a = torch.linalg.solve_triangular(learned.prior, cross, upper=False)
        v = torch.linalg.solve_triangular(learned.posterior, a, upper=False)
        found = location + v.mT @ learned.d
        known = (own - a.square().sum(0) + v.square().sum(0)).clamp_min(0.0)
        if is_warped(self.model, latent):
            found = unwarped(found, location, known, own)
        loading = prior.loading.expand(*shape, len(IMPEDANCE_ORDER))[axis, 0, rows] - v.mT @ learned.loading
        return found, known + ((loading @ learned.levels) * loading).sum(-1)
