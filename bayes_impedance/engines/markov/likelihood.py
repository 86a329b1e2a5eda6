"""Log likelihood of sequences as a torch function of the arrays that the filter takes."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from bayes_impedance.engines.markov.arrangement import Sequences
from bayes_impedance.engines.markov.recursions import Data, log_likelihoods, stored_length
from bayes_impedance.engines.markov.reverse import sweep
from bayes_impedance.errors import NotPositiveDefiniteError

#: Rows, means and covariances of a way back that smooths nothing.
NO_TARGETS = (np.zeros(0, dtype=np.int64), np.zeros((0, 0)), np.zeros((0, 0, 0)))


class FilterLikelihood(torch.autograd.Function):
    """log p(y) of every sequence, `(filters, sequences)` [nats]; filters share the order of samples, n of them.

    Args of `apply`: z `(filters, n, blocks)`, h `(filters, n, axes, 3 axes)` [N], c `(filters, axes, terms)` [N],
    y `(filters, n, axes)` [N], r `(filters, axes)` [N²], as in `Data`, then the `Sequences`.
    """

    @staticmethod
    def forward(
        ctx: Any, z: Tensor, h: Tensor, c: Tensor, y: Tensor, r: Tensor, sequences: Sequences
    ) -> Tensor:
        """One pass of the filter.

        Raises:
            NotPositiveDefiniteError: rounding left no positive variance of a force.
        """
        ctx.sequences = sequences
        arrays = [value.detach().contiguous() for value in (z, h, c, y, r)]
        filters = run_filters(arrays, sequences, any(ctx.needs_input_grad))
        ctx.stored = [stored for _, stored in filters]
        ctx.save_for_backward(*arrays)
        return torch.from_numpy(np.stack([values for values, _ in filters]))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, weights: Tensor) -> tuple[Tensor | None, ...]:
        """The reverse sweep."""
        arrays = ctx.saved_tensors
        results = tuple(torch.zeros_like(value) for value in arrays)
        for i, stored in enumerate(ctx.stored):
            data = Data(*(value[i].numpy() for value in arrays))
            out = Data(*(value[i].numpy() for value in results))
            sweep(ctx.sequences.plan, data, stored, weights[i].contiguous().numpy(), out, *NO_TARGETS)
        return *results, None


def run_filters(
    arrays: list[Tensor], sequences: Sequences, store: bool
) -> list[tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]]:
    """Log likelihoods `(sequences,)` of every filter, and the states that a way back starts from.

    Raises:
        NotPositiveDefiniteError: rounding left no positive variance of a force.
    """
    plan = sequences.plan
    result = []
    for i in range(arrays[0].shape[0]):
        data = Data(*(value[i].numpy() for value in arrays))
        stored = np.zeros(stored_length(plan) if store else 0)
        values = np.zeros(len(sequences.group))
        failed = log_likelihoods(plan, data, stored, values)
        if failed >= 0:
            raise NotPositiveDefiniteError(
                f"the variance of force {failed} of {len(sequences.order)} in the order of theta, given those before "
                "it, is not positive; raise model.noise_sd, or look for impedance or hyperparameters that overflow"
            )
        result.append((values, stored))
    return result


def smoothed_states(
    arrays: list[Tensor], sequences: Sequences, targets: np.ndarray[Any, Any], spread: bool
) -> tuple[Tensor, Tensor]:
    """Posterior mean `(filters, m, states)` and covariance of the states of the blocks at m samples.

    `targets` `(n,)`: the row of the result at each sample of the sequences, −1 for none. Covariances are
    `(filters, m, 0, 0)` without `spread`.

    Raises:
        NotPositiveDefiniteError: rounding left no positive variance of a force.
    """
    width, count = int(sequences.plan.sizes.sum()), int((targets >= 0).sum())
    arrays = [value.contiguous() for value in arrays]
    none = np.zeros(len(sequences.group))
    means = torch.zeros(arrays[0].shape[0], count, width, dtype=torch.float64)
    square = (width, width) if spread else (0, 0)
    covariances = torch.zeros(*means.shape[:2], *square, dtype=torch.float64)
    for i, (_, stored) in enumerate(run_filters(arrays, sequences, store=True)):
        data = Data(*(value[i].numpy() for value in arrays))
        sweep(sequences.plan, data, stored, none, data, targets, means[i].numpy(), covariances[i].numpy())
    return means, covariances
