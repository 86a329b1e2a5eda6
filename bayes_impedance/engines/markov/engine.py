"""Inference given impedance at a cost that grows with the number of samples (docs/model.md §13)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import Tensor

from bayes_impedance.engines.given_impedance import (
    LATENTS,
    MeanAndVariance,
    Processes,
    as_read,
    drawn_latents,
    prior_mean,
)
from bayes_impedance.engines.markov.arrangement import Samples, Sequences, Structure, arrange
from bayes_impedance.engines.markov.likelihood import FilterLikelihood, smoothed_states
from bayes_impedance.engines.markov.observation import Scales, by_sample, matrices_of
from bayes_impedance.engines.markov.prior_draws import Chain, chains_of, draw_states
from bayes_impedance.engines.markov.recursions import Integers
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import Features
from bayes_impedance.kernels.impedance import Latent


@dataclass(frozen=True)
class Joined:
    """Samples of an engine and, behind them, those of a `target`, in sequences of both.

    `samples` are those of the target; `rows` `(n + m,)` says which of them a step of the sequences takes, −1 for one of
    the engine's.
    """

    target: Features
    samples: Samples
    sequences: Sequences
    chains: tuple[Chain, ...]
    rows: Integers

    @classmethod
    def of(cls, target: Features, known: Samples, structure: Structure, axes: int) -> Self:
        """Those of a target and of the engine's `known` samples.

        Raises:
            ConfigurationError: they have no common order.
        """
        samples = Samples.of(target, structure, observed=False)
        both = known.followed_by(samples)
        sequences = arrange(both, structure, axes)
        rows = np.maximum(sequences.order - len(known.group), -1)
        return cls(target, samples, sequences, chains_of(both, structure), rows)


class MarkovEngine:
    """Exact inference given impedance by a Kalman filter over θ, for a Matérn-5/2 desired trajectory.

    θ is one number; samples are sorted by it once, here. `processes` of later calls may differ in hyperparameters only.
    Axes are filters of their own unless they are `coupled`.

    Raises:
        ConfigurationError: the processes have no state space of a few dimensions, or the samples no common order.
    """

    def __init__(self, features: Features, processes: Processes, coupled: bool) -> None:
        assert features.force is not None
        self.features, self.coupled = features, coupled
        self.axes = features.inputs.shape[0]
        self.structure = Structure.of(processes)
        samples = Samples.of(features, self.structure, observed=True)
        self.sequences = arrange(samples, self.structure, self._axes)
        self.samples = samples.in_order(self.sequences.order)
        self._force = by_sample(features.force, self.samples)
        errors = processes.layout.errors(features.inputs, order=2)
        self._last: Joined | None = None
        self._errors = None if errors is None else by_sample(torch.cat(errors, dim=-1), self.samples)

    def log_likelihood_given_impedance(self, processes: Processes, impedance: Tensor) -> Tensor:
        """See `ConditionalEngine`.

        Raises:
            NotPositiveDefiniteError: rounding left no positive variance of the forces.
        """
        scales = self._scales(processes)
        h, c, y, r = self._observed(scales, impedance)
        z = scales.steps(self.sequences.steps)
        values = FilterLikelihood.apply(z, h, c, y, r, self.sequences)
        groups = torch.from_numpy(self.sequences.group)
        return values.new_zeros(len(values), len(self.features.groups)).index_add(1, groups, values)

    def posterior(
        self, processes: Processes, impedance: Tensor, target: Features, target_impedance: Tensor
    ) -> Mapping[Latent, MeanAndVariance]:
        """See `ConditionalEngine`; no variance at the padding of `target`.

        Raises:
            NotPositiveDefiniteError: rounding left no positive variance of the forces.
            ConfigurationError: the samples of `target` have no common order with those of the engine.
        """
        with torch.no_grad():
            scales, joined = self._scales(processes), self._joined(target)
            samples = joined.samples
            matrices = matrices_of(target_impedance, samples, self.coupled)
            force = scales.force_rows(matrices, samples)
            states, covariance = self._smoothed(
                scales, joined, self._observed(scales, impedance), spread=True
            )
            known = as_read(target_impedance, self.coupled)
            result = {}
            for latent in LATENTS:
                rows = scales.latent_rows(latent, force, samples, self.structure)
                shift = (rows @ states.unsqueeze(-1))[..., 0]
                variance = ((rows @ covariance) * rows).sum(-1).clamp_min(0.0)
                mean, spread = (self._scattered(part, samples, target) for part in (shift, variance))
                result[latent] = (mean + prior_mean(processes.layout, target, known, latent), spread)
        return result

    def draw(
        self,
        processes: Processes,
        impedance: Tensor,
        target: Features,
        target_impedance: Tensor,
        generator: torch.Generator,
    ) -> Mapping[Latent, Tensor]:
        """See `ConditionalEngine`: states and forces y* drawn from the prior, then x* + E[x | y − y*].

        Raises:
            NotPositiveDefiniteError: rounding left no positive variance of the forces.
            ConfigurationError: the samples of `target` have no common order with those of the engine.
        """
        with torch.no_grad():
            scales, joined = self._scales(processes), self._joined(target)
            h, c, y, r = self._observed(scales, impedance)
            states = draw_states(joined.chains, scales, self.structure, generator)
            here, there = states.split([len(self.samples.group), len(joined.samples.group)])
            deviation, force = scales.latents(here, self.samples, self.structure)
            force = force + self._product(matrices_of(impedance, self.samples, self.coupled), deviation)
            noise = torch.randn(force.shape, generator=generator, dtype=force.dtype)
            y = y - scales.by_filter(force + scales.noise.sqrt() * noise)
            shift, _ = self._smoothed(scales, joined, (h, c, y, r), spread=False)
            drawn = there + scales.by_axis(shift, self.structure)
            deviation, residual = scales.latents(drawn, joined.samples, self.structure)
            result = deviation.new_zeros(*target.inputs.shape[:3], 4)
            place = torch.from_numpy(joined.samples.group), torch.from_numpy(joined.samples.row)
            result[:, *place] = torch.cat([deviation, residual.unsqueeze(-1)], dim=-1).transpose(0, 1)
            known = as_read(target_impedance, self.coupled)
            return drawn_latents(processes.layout, target, known, result[..., :3], result[..., 3])

    @property
    def _axes(self) -> int:
        """Axes of one filter."""
        return self.axes if self.coupled else 1

    def _scales(self, processes: Processes) -> Scales:
        return Scales.of(processes, self.structure, self.axes, self.coupled)

    def _observed(self, scales: Scales, impedance: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """h, c, y and r of the engine's samples."""
        matrices = matrices_of(impedance, self.samples, self.coupled)
        # u − Σ_j W_j ē_j
        y = self._force if self._errors is None else self._force - self._product(matrices, self._errors)
        rows = scales.force_rows(matrices, self.samples)
        return rows, scales.residual_sds(), scales.by_filter(y), scales.noise_variances()

    def _product(self, matrices: Tensor, errors: Tensor) -> Tensor:
        """Σ_j W_j e_j, `(n, axes)` [N], of `errors` `(n, axes, 3)`."""
        if self.coupled:
            return torch.einsum("njab,nbj->na", matrices, errors)
        return (matrices * errors.mT).sum(1)

    def _joined(self, target: Features) -> Joined:
        """With the samples of `target`, which one call after another has in common."""
        if self._last is None or self._last.target is not target:
            self._last = Joined.of(target, self.samples, self.structure, self._axes)
        return self._last

    def _smoothed(
        self, scales: Scales, joined: Joined, given: tuple[Tensor, Tensor, Tensor, Tensor], spread: bool
    ) -> tuple[Tensor, Tensor]:
        """Mean `(filters, m, states)` of the states that the target's samples see and, with `spread`, covariance.

        `given` are h, c, y and r of the engine's samples.
        """
        h, c, y, r = given
        order = torch.from_numpy(joined.sequences.order)
        h, y = (
            torch.cat([part, part.new_zeros(len(part), len(joined.samples.group), *part.shape[2:])], dim=1)[
                :, order
            ]
            for part in (h, y)
        )
        z = scales.steps(joined.sequences.steps)
        return smoothed_states([z, h, c, y, r], joined.sequences, joined.rows, spread)

    def _scattered(self, values: Tensor, samples: Samples, target: Features) -> Tensor:
        """`(filters, m, axes)` as `(axes, groups, rows)`."""
        result = values.new_zeros(target.inputs.shape[:3])
        by_axis = values[0].T if self.coupled else values[..., 0]
        result[:, torch.from_numpy(samples.group), torch.from_numpy(samples.row)] = by_axis
        return result


def unsupported(processes: Processes, features: Features, coupled: bool) -> str | None:
    """Why `MarkovEngine` cannot hold these processes and samples; None where it can."""
    try:
        structure = Structure.of(processes)
        samples = Samples.of(features, structure, observed=True)
        arrange(samples, structure, features.inputs.shape[0] if coupled else 1)
    except ConfigurationError as error:
        return str(error)
    return None
