"""Results of batches put where they belong: from rows of groups back to samples of trials."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from threading import Lock

import numpy as np
import torch
from torch import Tensor

from bayes_impedance.features import Features, LogFeatures
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.posterior.batches import Batch, Progress, for_each
from bayes_impedance.posterior.conditioning import Moments
from bayes_impedance.posterior.results import Array, Marginal
from bayes_impedance.preprocessing import PreparedLog

#: Moments of each latent at some targets, `(groups, m, …)` each.
MomentsAt = Callable[[Features], dict[Latent, Sequence[Tensor]]]


class Collected:
    """Arrays `(samples, …)` of every latent at the samples of a log, filled from any number of threads."""

    def __init__(self, log: PreparedLog) -> None:
        self.log = log
        lengths = [trial.n_samples for trial in log.trials]
        self._starts = np.cumsum([0, *lengths])
        self._arrays: dict[Latent, list[Array]] = {}
        self._lock = Lock()

    def put(
        self,
        target: Features,
        moments: Mapping[Latent, Sequence[Tensor]],
        trials: Sequence[int] | None = None,
    ) -> None:
        """Take over moments `(groups, m, …)` at the samples of `target`, whose rows count the log's `trials`."""
        rows = np.concatenate(target.rows)
        trial = rows[:, 0] if trials is None else np.asarray(trials)[rows[:, 0]]
        places = self._starts[trial] + rows[:, 1]
        for latent, parts in moments.items():
            values = [
                (part.flatten(0, 1) if target.valid is None else part[target.valid]).numpy() for part in parts
            ]
            for array, value in zip(self._of(latent, values), values, strict=True):
                array[places] = value

    def take(self, latent: Latent) -> list[Array]:
        """The arrays of a latent, each of one kind of its moments; they are whole once every sample was put."""
        return self._arrays.pop(latent)

    def marginal(self, latent: Latent, warped: bool) -> Marginal:
        """Marginal of a latent whose moments are location and variance, and those of its prior."""
        location, variance, prior_location, prior_variance = self.take(latent)
        for array in (variance, prior_variance):
            np.sqrt(array, out=array)
        return Marginal(latent, warped, location, variance, prior_location, prior_variance)

    def _of(self, latent: Latent, values: Sequence[Array]) -> list[Array]:
        with self._lock:
            if latent not in self._arrays:
                self._arrays[latent] = [np.empty((self._starts[-1], *value.shape[1:])) for value in values]
            return self._arrays[latent]


def collect(
    target: LogFeatures,
    given: LogFeatures | None,
    batches: Sequence[Batch],
    condition: Callable[[Features | None], MomentsAt],
    progress: Progress | None = None,
) -> Collected:
    """Moments at every sample of the log of `target`, batch by batch (see `for_each`).

    `condition` takes the forces of a batch, of the log of `given`, or None where it has none.
    """
    collected = Collected(target.log)

    def infer(batch: Batch) -> Iterator[int]:
        with torch.no_grad():
            evidence = None if given is None or not batch.given else given(batch.given, observed=True)
            moments = condition(evidence)
            for samples in batch.pieces:
                piece = target(batch.target, samples=samples)
                collected.put(piece, moments(piece), batch.target)
                yield sum(len(rows) for rows in samples)

    for_each(infer, batches, target.log.n_samples, progress)
    return collected


def axes_last(moments: Mapping[Latent, Moments]) -> dict[Latent, Sequence[Tensor]]:
    """Moments `(axes, groups, m)` as they are collected, `(groups, m, axes)`."""
    return {latent: [part.movedim(0, -1) for part in parts] for latent, parts in moments.items()}
