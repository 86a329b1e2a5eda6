"""Inference given impedance at a cost that grows with the number of samples (docs/model.md §13)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from bayes_impedance.engines.given_impedance import (
    LATENTS,
    MeanAndVariance,
    Processes,
    as_read,
    prior_mean,
)
from bayes_impedance.engines.markov.arrangement import Samples, Structure, arrange
from bayes_impedance.engines.markov.likelihood import FilterLikelihood, smoothed_states
from bayes_impedance.engines.markov.observation import Scales, by_sample, matrices_of
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import Features
from bayes_impedance.kernels.impedance import Latent


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
        self._errors = None if errors is None else by_sample(torch.cat(errors, dim=-1), self.samples)

    def log_likelihood_given_impedance(self, processes: Processes, impedance: Tensor) -> Tensor:
        """See `ConditionalEngine`.

        Raises:
            NotPositiveDefiniteError: rounding left no positive variance of the forces.
        """
        h, c, y, r = self._observed(processes, impedance)
        z = self._scales(processes).steps(self.sequences.steps)
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
            scales = self._scales(processes)
            samples = Samples.of(target, self.structure, observed=False)
            matrices = matrices_of(target_impedance, samples, self.coupled)
            force = scales.force_rows(matrices, samples)
            states, covariance = self._smoothed(processes, impedance, samples)
            known = as_read(target_impedance, self.coupled)
            result = {}
            for latent in LATENTS:
                rows = scales.latent_rows(latent, force, samples, self.structure)
                shift = (rows @ states.unsqueeze(-1))[..., 0]
                variance = ((rows @ covariance) * rows).sum(-1).clamp_min(0.0)
                mean, spread = (self._scattered(part, samples, target) for part in (shift, variance))
                result[latent] = (mean + prior_mean(processes.layout, target, known, latent), spread)
        return result

    @property
    def _axes(self) -> int:
        """Axes of one filter."""
        return self.axes if self.coupled else 1

    def _scales(self, processes: Processes) -> Scales:
        return Scales.of(processes, self.structure, self.axes, self.coupled)

    def _observed(self, processes: Processes, impedance: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """h, c, y and r of the engine's samples."""
        scales = self._scales(processes)
        matrices = matrices_of(impedance, self.samples, self.coupled)
        y = self._force
        if self._errors is not None:
            # u − Σ_j W_j ē_j
            form = "njab,nbj->na" if self.coupled else "nja,naj->na"
            y = y - torch.einsum(form, matrices, self._errors)
        rows = scales.force_rows(matrices, self.samples)
        return rows, scales.residual_sds(), scales.by_filter(y), scales.noise_variances()

    def _smoothed(self, processes: Processes, impedance: Tensor, samples: Samples) -> tuple[Tensor, Tensor]:
        """Mean `(filters, m, states)` and covariance of the states that the target's samples see."""
        both = self.samples.followed_by(samples)
        sequences = arrange(both, self.structure, self._axes)
        h, c, y, r = self._observed(processes, impedance)
        order = torch.from_numpy(sequences.order)
        h, y = (
            torch.cat([part, part.new_zeros(len(part), len(samples.group), *part.shape[2:])], dim=1)[:, order]
            for part in (h, y)
        )
        z = self._scales(processes).steps(sequences.steps)
        targets = (order - len(self.samples.group)).clamp_min(-1)
        return smoothed_states([z, h, c, y, r], sequences, targets.numpy())

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
