"""Samples in blocks that have features of their own (trials), and blocks of like length in batches."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from bayes_impedance.features import Features

#: Samples of a batch, and of a block where samples may be cut anywhere: bounds what is held at once.
LARGEST = 8192


@dataclass(frozen=True)
class Batch:
    """Blocks of samples of one group, padded to the longest of them.

    `labels` are those of the blocks; `index` `(blocks, n)` counts the samples of the group; `valid` `(blocks, n)` is
    False on padding.
    """

    group: int
    labels: tuple[float, ...]
    index: Tensor
    valid: Tensor

    def take(self, values: Tensor) -> Tensor:
        """Rows of `(axes, groups, n, …)` as `(axes, blocks, n, …)`."""
        return values[:, self.group, self.index]

    def blocks(self) -> Iterator[Batch]:
        """Each block by itself, without padding."""
        for b, label in enumerate(self.labels):
            valid = self.valid[[b]]
            yield Batch(self.group, (label,), self.index[[b]][valid].unsqueeze(0), valid[valid].unsqueeze(0))


def batches(features: Features, column: int | None) -> tuple[Batch, ...]:
    """Valid samples in blocks of equal label in `column` (None: of any length), blocks of like length together."""
    result: list[Batch] = []
    for group in range(features.inputs.shape[1]):
        blocks = sorted(_blocks(features, column, group), key=lambda block: len(block[1]))
        while blocks:
            longest = len(blocks[-1][1])
            # No block is padded to more than twice its length.
            members = [blocks.pop()]
            while blocks and 2 * len(blocks[-1][1]) >= longest and (len(members) + 1) * longest <= LARGEST:
                members.append(blocks.pop())
            result.append(_batch(group, members, longest))
    return tuple(result)


def _blocks(features: Features, column: int | None, group: int) -> Iterator[tuple[float, Tensor]]:
    n = features.inputs.shape[2]
    rows = torch.arange(n) if features.valid is None else features.valid[group].nonzero()[:, 0]
    if column is None or not len(rows):
        for part in rows.split(LARGEST):
            yield 0.0, part
        return
    labels = features.inputs[0, group, rows, column]
    for label in labels.unique():
        yield label.item(), rows[labels == label]


def _batch(group: int, members: list[tuple[float, Tensor]], longest: int) -> Batch:
    index = torch.zeros(len(members), longest, dtype=torch.long)
    valid = torch.zeros(len(members), longest, dtype=torch.bool)
    for b, (_, rows) in enumerate(members):
        index[b, : len(rows)] = rows
        valid[b, : len(rows)] = True
    return Batch(group, tuple(label for label, _ in members), index, valid)
