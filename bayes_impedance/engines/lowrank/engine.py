"""The low-rank engine: exact inference given impedance on features of the processes, n · features²."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import torch
from torch import Tensor

from bayes_impedance.engines.given_impedance import (
    MeanAndVariance,
    Processes,
    as_read,
    mean_force,
)
from bayes_impedance.engines.lowrank.blocks import Batch, batches
from bayes_impedance.engines.lowrank.columns import Design
from bayes_impedance.engines.lowrank.hilbert import Accuracy
from bayes_impedance.engines.lowrank.prediction import draw, predict
from bayes_impedance.engines.lowrank.support import own_column, unsupported
from bayes_impedance.engines.lowrank.woodbury import Rows, Solution, Source, regress
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import Features
from bayes_impedance.kernels.impedance import Latent

#: Numbers in the design matrix beyond which features are made anew, batch by batch, rather than kept: what the backward
#: pass needs of four million takes some .6 GB. It takes twice the time.
RECOMPUTED = 4_000_000


class LowRankEngine:
    """Exact inference given impedance for processes that are sums of features.

    What features leave out of the kernels' derivatives is all that separates it from the dense engine; `accuracy` says
    how much that is (None: see `chosen`). Features that a trial has of its own are eliminated trial by trial, then
    those that its group shares. Length scales change the number of features in steps, which are not differentiated.
    """

    def __init__(self, features: Features, coupled: bool, accuracy: Accuracy | None = None) -> None:
        self.features, self.coupled, self.accuracy = features, coupled, accuracy
        self._last: tuple[Features, int | None, tuple[Batch, ...]] | None = None
        self._batches: dict[int | None, tuple[Batch, ...]] = {}

    def log_likelihood_given_impedance(self, processes: Processes, impedance: Tensor) -> Tensor:
        """See `ConditionalEngine`.

        Raises:
            ConfigurationError: processes that features cannot hold, see `unsupported`.
            NotPositiveDefiniteError: rounding leaves no Cholesky factor.
        """
        _, solution = self.coefficients(processes, impedance)
        # Rows were divided by σ_r, so its log det is that of every sample.
        noise = (self._noise(processes)[..., 0].log() + math.log(2.0 * math.pi)) * self.features.counts
        if self.coupled:
            noise = noise.sum(0, keepdim=True)
        return -0.5 * (solution.quadratic + solution.log_det + noise)

    def posterior(
        self, processes: Processes, impedance: Tensor, target: Features, target_impedance: Tensor
    ) -> Mapping[Latent, MeanAndVariance]:
        """See `ConditionalEngine`; features are those that hold at `target`, too, however far it is.

        Raises:
            ConfigurationError: processes that features cannot hold, see `unsupported`.
            NotPositiveDefiniteError: rounding leaves no Cholesky factor.
        """
        with torch.no_grad():
            design, solution = self.coefficients(processes, impedance, target)
            sources = self._blocks(processes)
            return predict(
                design,
                solution,
                sources,
                target,
                as_read(target_impedance, self.coupled),
                own_column(processes),
            )

    def draw(
        self,
        processes: Processes,
        impedance: Tensor,
        target: Features,
        target_impedance: Tensor,
        generator: torch.Generator,
    ) -> Mapping[Latent, Tensor]:
        """See `ConditionalEngine`; features as for `posterior`.

        Raises:
            ConfigurationError: processes that features cannot hold, see `unsupported`.
            NotPositiveDefiniteError: rounding leaves no Cholesky factor.
        """
        with torch.no_grad():
            design, solution = self.coefficients(processes, impedance, target)
            sources = self._blocks(processes)
            known = as_read(target_impedance, self.coupled)
            blocks = self._target_blocks(target, own_column(processes))
            return draw(design, solution, sources, target, known, blocks, generator)

    def design(self, processes: Processes, target: Features | None = None) -> Design:
        """Design matrices that hold at the engine's samples, and at those of `target`.

        Raises:
            ConfigurationError: processes that features cannot hold, see `unsupported`.
        """
        reason = unsupported(processes, self.features, self.coupled, self.accuracy, target)
        if reason is not None:
            raise ConfigurationError(f"the low-rank engine cannot hold this model: {reason}")
        logs = [self.features] if target is None else [self.features, target]
        return Design.of(processes, logs, self.coupled, self.accuracy)

    def coefficients(
        self, processes: Processes, impedance: Tensor, target: Features | None = None
    ) -> tuple[Design, Solution]:
        """The design and the posterior of its coefficients given impedance, from which x_d can be drawn as a function.

        Columns of `design.trajectory`, then of `design.residual`, as far as a group shares them, have coefficients
        β = `mean` + `factor`⁻ᵀ z, z ~ N(0, I), one vector for each group and, where axes do not couple, each axis.

        Raises:
            ConfigurationError: processes that features cannot hold, see `unsupported`.
            NotPositiveDefiniteError: rounding leaves no Cholesky factor.
        """
        design = self.design(processes, target)
        return design, self._solve(processes, design, as_read(impedance, self.coupled))

    def _noise(self, processes: Processes) -> Tensor:
        return processes.noise_variance.expand(self.features.inputs.shape[0], 1, 1)

    def _blocks(self, processes: Processes) -> tuple[Batch, ...]:
        column = own_column(processes)
        if column not in self._batches:
            self._batches[column] = batches(self.features, column)
        return self._batches[column]

    def _target_blocks(self, target: Features, column: int | None) -> tuple[Batch, ...]:
        """Those of the samples of `target`, which one call after another has in common."""
        if self._last is None or self._last[0] is not target or self._last[1] != column:
            blocks = [block for batch in batches(target, column) for block in batch.blocks()]
            self._last = target, column, tuple(blocks)
        return self._last[2]

    def _solve(self, processes: Processes, design: Design, impedance: Tensor) -> Solution:
        assert self.features.force is not None
        misfit = self.features.force - mean_force(processes.layout, self.features, impedance)
        deviation = self._noise(processes).sqrt()

        def rows(batch: Batch) -> Rows:
            weight = batch.valid / deviation
            x = batch.take(self.features.inputs)
            residual = design.residual(x)
            if residual.shape[-1]:
                residual = residual * design.rows(weight.expand(x.shape[:-1])).unsqueeze(-1)
            own, shared = design.split(
                # Rows of W over the σ_r of their axis.
                design.force(
                    x, impedance[batch.group, batch.index] * weight.permute(1, 2, 0)[:, :, None, :, None]
                ),
                residual,
            )
            return Rows(own, shared, design.rows(batch.take(misfit) * weight))

        blocks = self._blocks(processes)
        samples = sum(batch.index.numel() for batch in blocks)
        entries = samples * len(misfit) * design.columns(len(misfit))
        sources = [Source(batch.group, partial(rows, batch)) for batch in blocks]
        return regress(sources, recompute=entries > RECOMPUTED)
