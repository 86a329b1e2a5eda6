"""What posteriors of independent and of coupled axes have in common: pieces, levels as offsets, logarithms."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from bayes_impedance.features import Features

#: Location, variance, prior location, prior variance, each `(axes, groups, m)`.
Moments = tuple[Tensor, Tensor, Tensor, Tensor]

#: Targets are taken at most this many at a time,
CHUNK = 512
#: and at most so many that a covariance with the forces given has this many entries, 2 MB: with the thirty or so arrays
#: of its size that are in use at a time, memory is bounded whatever the length of the log, and most of it is cache.
ENTRIES = 2**18
#: But so many are: a solve with fewer columns takes as long.
FEWEST = 32


def targets_at_once(rows: int) -> int:
    """How many targets to take at a time where each has `rows` covariances with forces, over all axes and groups."""
    return min(CHUNK, max(FEWEST, ENTRIES // max(1, rows)))


def offset_covariance(gram: Tensor, variance: Tensor) -> Tensor:
    """Covariance of offsets b ~ N(0, diag V) that load on forces by A, given these: V½ (I + V½ AᵀK⁻¹A V½)⁻¹ V½.

    `gram` AᵀK⁻¹A `(*batch, b, b)`, `variance` V `(*batch, b)`; defined for V = 0 too.
    """
    root = variance.sqrt()
    scaled = root.unsqueeze(-1) * gram * root.unsqueeze(-2)
    inner = torch.linalg.inv(torch.eye(gram.shape[-1], dtype=gram.dtype) + scaled)
    return root.unsqueeze(-1) * inner * root.unsqueeze(-2)


def unwarped(location: Tensor, prior_location: Tensor, variance: Tensor, prior_variance: Tensor) -> Tensor:
    """Location of log w to second order: that of the log-normal whose moments are those of w given the forces.

    To first order E[w|u] = E[w] (1 + a) with the shift a of log w, and E[w] = exp(location + ½ prior variance). The
    logarithm of 1 + a is replaced by its expansion below zero, where a linear estimate of w may become negative.
    """
    return prior_location + 0.5 * (prior_variance - variance) + log_shift(location - prior_location)


def log_shift(a: Tensor) -> Tensor:
    """log(1 + a), below zero to second order: of a linear estimate E[w] (1 + a) that may become negative."""
    return torch.where(a > 0.0, torch.log1p(a.clamp_min(0.0)), a - 0.5 * a.square())


def select_groups(features: Features, groups: Sequence[str]) -> Features:
    """The features of some groups, in that order."""
    index = [features.groups.index(group) for group in groups]
    return replace(
        features,
        groups=tuple(groups),
        inputs=features.inputs[:, index],
        force=None if features.force is None else features.force[:, index],
        trajectory_mean=features.trajectory_mean[:, index],
        valid=None if features.valid is None else features.valid[index],
        rows=tuple(features.rows[i] for i in index),
        loop=None if features.loop is None else features.loop.select(index),
    )


def pieces(features: Features, size: int) -> Iterator[Features]:
    """The inputs in pieces of at most `size` samples a group, without force."""
    for start in range(0, features.inputs.shape[2], size):
        piece = slice(start, start + size)
        yield replace(
            features,
            inputs=features.inputs[:, :, piece],
            force=None,
            trajectory_mean=features.trajectory_mean[:, :, piece],
            valid=None if features.valid is None else features.valid[:, piece],
            rows=tuple(rows[piece] for rows in features.rows),
        )
