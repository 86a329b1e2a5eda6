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
from bayes_impedance.engines.local.build import build_local
from bayes_impedance.engines.local.cell import Cell, whitened
from bayes_impedance.engines.local.grid import weights_of
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import FeatureMap, Features
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.posterior.compute import Posterior, marginal_of
from bayes_impedance.posterior.conditioning import (
    Moments,
    chunks,
    offset_covariance,
    select_groups,
    unwarped,
)
from bayes_impedance.posterior.independent import (
    Prior,
    is_warped,
    level_loading,
    level_variance,
    prior_of,
    prior_only,
)
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import ForceModel
from bayes_impedance.training import observations

Array = NDArray[np.float64]


def local_posterior(
    model: ForceModel, feature_map: FeatureMap, settings: LocalConfig, log: PreparedLog,
    target: Features, given: Features | None, latents: Sequence[Latent] | None = None,
) -> Posterior:  # fmt: skip
    """Posteriors at `target`, the features of `log`, given the forces of `given`; the prior where it is None.

    Groups of `target` without a namesake in `given` keep their prior, and so do samples outside of the range of motion
    of `given`.

    Raises:
        ConfigurationError: see `LocalConditioner`.
    """
    latents = list(Latent) if latents is None else latents
    parts: list[tuple[list[str], dict[Latent, Moments]]] = []
    with torch.no_grad():
        for group in target.groups:
            own = select_groups(target, [group])
            if given is None or group not in given.groups:
                parts.append(([group], prior_only(model, own, latents)))
                continue
            conditioner = LocalConditioner(model, feature_map, settings, select_groups(given, [group]))
            parts.append(([group], conditioner.moments(own, latents)))
    return Posterior(log, {latent: marginal_of(model, log, target, latent, parts) for latent in latents})


class _Learned(NamedTuple):
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
        ConfigurationError: the model is none that local models hold, a device answers its force, or the widths of cells
            fit no grid.
    """

    def __init__(
        self, model: ForceModel, feature_map: FeatureMap, settings: LocalConfig, given: Features
    ) -> None:
        if given.loop is not None:
            raise ConfigurationError(
                "device: expected none with engine.name: local, which takes the recorded motion as given, got a robot "
                "whose answer tells of the mass; set engine.name=dense, or device=null"
            )
        self.model = model
        self.kernels = [model.kernel[axis, 0] for axis in range(len(feature_map.axes))]
        n = len(given.rows[0])
        inputs = np.ascontiguousarray(given.inputs[:, 0, :n].numpy())
        self.local = build_local(model, feature_map, settings, inputs[0])
        self.local.learn_all(inputs, observations(model, given).residual[:, 0, :n].numpy())
        loading = level_loading(model, given.inputs, Latent.FORCE)[:, 0, :n].numpy()
        variance = level_variance(model)
        assert variance is not None
        codes, _ = weights_of(self.local.grid, inputs[0], settings.active)
        self.learned: dict[int, list[_Learned]] = {}
        for code, cell in self.local.cells.items():
            rows = np.flatnonzero((codes == code).any(axis=1))
            self.learned[code] = [
                self._learned(cell, axis, inputs[axis, rows], loading[axis, rows], variance[axis, 0])
                for axis in range(len(inputs))
            ]

    def _learned(self, cell: Cell, axis: int, inputs: Array, loading: Array, variance: Tensor) -> _Learned:
        n = int(cell.used[axis])
        one = np.ones(len(inputs))
        a, scale = whitened(self.local.numbers, self.local.noise[axis], axis, cell, inputs, one)
        scaled = torch.from_numpy(loading * scale[:, None])
        factor = torch.from_numpy(cell.posterior[axis, :n, :n]).mT
        seen = torch.linalg.solve_triangular(factor, torch.from_numpy(a[:, :n]).mT @ scaled, upper=False)
        return _Learned(
            torch.from_numpy(np.ascontiguousarray(cell.inputs[axis, :, :n].T)),
            torch.from_numpy(cell.prior[axis, :n, :n]),
            factor,
            torch.from_numpy(cell.d[axis, :n]),
            seen,
            offset_covariance(scaled.mT @ scaled - seen.mT @ seen, variance),
        )

    def moments(self, target: Features, latents: Sequence[Latent]) -> dict[Latent, Moments]:
        """Moments of each latent at the samples of `target`, of the same group."""
        found: dict[Latent, Moments] = {}
        for latent in latents:
            pieces = [self._chunk(piece, latent) for piece in chunks(target)]
            a, b, c, d = zip(*pieces, strict=True)
            found[latent] = (torch.cat(a, -1), torch.cat(b, -1), torch.cat(c, -1), torch.cat(d, -1))
        return found

    def _chunk(self, target: Features, latent: Latent) -> Moments:
        prior = prior_of(self.model, target, latent)
        shape = target.inputs.shape[:-1]
        prior_location, prior_variance = prior.location.expand(shape), prior.variance.expand(shape)
        codes, weights = weights_of(self.local.grid, target.inputs[0, 0].numpy(), self.local.settings.active)
        # Σ g, Σ g mean, Σ g (variance + mean²)
        total = torch.zeros(3, *shape, dtype=prior_variance.dtype)
        for code in np.unique(codes):
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
        learned: _Learned,
        axis: int,
        target: Features,
        rows: NDArray[np.int64],
        prior: Prior,
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
