"""A posterior by its draws: parameters, impedance, desired trajectory and forces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from bayes_impedance.config import Config
from bayes_impedance.engines.choice import EngineChoice
from bayes_impedance.features import Features
from bayes_impedance.identifiability import OffDiagonal
from bayes_impedance.impedance_functions.symmetric import entries
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial
from bayes_impedance.sampling.density import JointDensity
from bayes_impedance.sampling.diagnosis import Diagnosis
from bayes_impedance.sampling.draws import Draws
from bayes_impedance.sampling.impedance_draws import draw_impedance
from bayes_impedance.sampling.parameters import Parameter
from bayes_impedance.sampling.places import Places
from bayes_impedance.sampling.support import ExactVerdict

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

PRIOR_SEED = 0


@dataclass(frozen=True)
class DrawnPosterior:
    """Draws of every latent, with what the sampler and the data say of them.

    `latents[latent]` `(draws, axes, groups, m)`, of K, D, M `(draws, groups, m, axes, axes)`, at the samples that
    `places` names, in the rows of `target`; draws of all chains, one after another.
    """

    config: Config
    density: JointDensity
    draws: Draws
    places: Places
    target: Features
    latents: Mapping[Latent, Array]
    diagnosis: Diagnosis
    verdicts: tuple[ExactVerdict, ...]
    off_diagonals: tuple[OffDiagonal, ...] = ()

    @property
    def log(self) -> PreparedLog:
        """The trials of the log."""
        return PreparedLog(self.axes, tuple(self.kept(self.places.forces)[0]))

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes of the log."""
        return self.places.log.axes

    @property
    def groups(self) -> tuple[str, ...]:
        """Groups of the log."""
        return self.target.groups

    @property
    def coupled(self) -> bool:
        """Whether stiffness, damping and mass are matrices."""
        return self.density.coupled

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What was sampled."""
        return self.density.parameters

    @property
    def engine(self) -> EngineChoice:
        """What marginalised the rest."""
        return self.density.engine_choice

    def values(self) -> dict[str, Array]:
        """Draws of every site, `(chains, draws, *shape)`."""
        return {
            name: value.numpy()
            for name, value in self.density.values(torch.from_numpy(self.draws.standard)).items()
        }

    def entry_names(self) -> list[str]:
        """Names of the free entries of a matrix: xx, yy, then xy."""
        return [self.axes[a] + self.axes[b] for a, b in entries(len(self.axes), self.coupled)]

    def is_constant(self, latent: Latent) -> bool:
        """Whether K, D or M does not depend on an input."""
        return self.density.is_constant(IMPEDANCE_ORDER[latent])

    def matrices(self, latent: Latent) -> Array:
        """K, D or M at the places, `(chains, draws, …, axes, axes)` [unit of the latent]."""
        return self._at_places(self.latents[latent])

    def at_places(self, latent: Latent) -> Array:
        """Desired trajectory or a derivative at the places, `(chains, draws, …, axes)` [unit of the latent]."""
        return self._at_places(np.moveaxis(self.latents[latent], 1, -1))

    def at_samples(self, latent: Latent) -> Array:
        """Force or residual force at samples of the log, `(chains, draws, samples, axes)` [N]."""
        values = np.moveaxis(self.latents[latent], 1, -1)
        return self._by_chain(values[:, *self._index(self.places.forces)])

    def first_place(self, values: Array) -> Array:
        """Of values at the places `(chains, draws, …)` those at the first of each group, in their order."""
        if self.places.dimension == "phase":
            return values[:, :, :, 0]
        owners, _ = self._index(self.places.places)
        return values[:, :, [int(np.argmax(owners == g)) for g in range(len(self.groups))]]

    def kept(self, which: tuple[Integers, ...]) -> tuple[list[PreparedTrial], list[Integers]]:
        """Motions that have samples in `which`, and these samples."""
        pairs = [pair for pair in zip(self.places.log.trials, which, strict=True) if len(pair[1])]
        return [trial for trial, _ in pairs], [rows for _, rows in pairs]

    def recorded(self, name: str) -> Array | None:
        """An array of the trials where forces are kept, `(samples, axes)`; None where a trial has none."""
        trials, rows = self.kept(self.places.forces)
        arrays = [getattr(trial, name) for trial in trials]
        if any(array is None for array in arrays):
            return None
        return np.concatenate([array[own] for array, own in zip(arrays, rows, strict=True)])

    def trials_of(self, group: int) -> list[PreparedTrial]:
        """Trials of the log that belong to a group."""
        return [trial for trial in self.log.trials if trial.group == self.groups[group]]

    def places_of(self, group: int) -> Integers:
        """Which of all places, one after another, belong to a group, in the order of phase or time."""
        return np.flatnonzero(self._index(self.places.places)[0] == group)

    def of_group(self, values: Array, group: int) -> Array:
        """Of values at the places `(chains, draws, …)` those of a group, `(chains, draws, places, …)`."""
        if self.places.dimension == "phase":
            return values[:, :, group]
        return values[:, :, self.places_of(group)]

    def abscissa(self, group: int) -> tuple[Array, str]:
        """Phase of the places of a group, or time of its only trial [s], else their number; and what it is."""
        kept = self._kept_of(group)
        trial, rows = kept[0]
        if self.places.dimension == "phase" and trial.phase is not None:
            return trial.phase[rows], "phase"
        if len(kept) == 1:
            return trial.time[rows] - trial.time[0], "time [s]"
        return np.arange(sum(len(own) for _, own in kept), dtype=np.float64), "places of all trials"

    def pieces(self, group: int) -> list[slice]:
        """Which places of a group follow one another: those of each trial, or all."""
        ends = np.cumsum([len(rows) for _, rows in self._kept_of(group)])
        return [
            slice(end - len(rows), end) for end, (_, rows) in zip(ends, self._kept_of(group), strict=True)
        ]

    def courses(self, group: int) -> list[tuple[PreparedTrial, Integers, Array]]:
        """Trials of a group, and samples of each with their values of the `abscissa`."""
        if self.places.dimension == "phase":
            trials = [(trial, trial.phase) for trial in self.trials_of(group) if trial.phase is not None]
            orders = [np.argsort(phase, kind="stable") for _, phase in trials]
            return [
                (trial, order, phase[order]) for (trial, phase), order in zip(trials, orders, strict=True)
            ]
        kept = self._kept_of(group)
        if len(kept) == 1:
            trial = kept[0][0]
            return [(trial, np.arange(trial.n_samples), trial.time - trial.time[0])]
        numbers = [np.arange(piece.start, piece.stop, dtype=np.float64) for piece in self.pieces(group)]
        return [(trial, rows, own) for (trial, rows), own in zip(kept, numbers, strict=True)]

    def prior_impedance(self, draws: int) -> dict[Latent, Array]:
        """Draws of K, D and M at the places before any force, `(draws, places, axes, axes)` [unit of each]."""
        groups, rows = self._index(self.places.places)
        standard = np.random.default_rng(PRIOR_SEED).standard_normal((draws, self.density.size))
        found = draw_impedance(self.density, standard, self.target, PRIOR_SEED)
        return {latent: values[:, groups, rows] for latent, values in found.items()}

    def _kept_of(self, group: int) -> list[tuple[PreparedTrial, Integers]]:
        """Motions of a group that have places, and these."""
        pairs = zip(*self.kept(self.places.places), strict=True)
        return [(trial, rows) for trial, rows in pairs if trial.group == self.groups[group]]

    def _at_places(self, values: Array) -> Array:
        """Values `(draws, groups, m, …)` at the places, by chain, and by group where all have the same phases."""
        chosen = values[:, *self._index(self.places.places)]
        if self.places.dimension == "phase":
            chosen = chosen.reshape(len(chosen), len(self.groups), -1, *chosen.shape[2:])
        return self._by_chain(chosen)

    def _by_chain(self, values: Array) -> Array:
        return values.reshape(*self.draws.shape, *values.shape[1:])

    def _index(self, which: tuple[Integers, ...]) -> tuple[Integers, Integers]:
        """Group and row of each sample in `which` of each trial, `(samples,)` each."""
        groups, rows = [], []
        for i, (trial, own) in enumerate(zip(self.places.log.trials, which, strict=True)):
            g = self.groups.index(trial.group)
            known = self.target.rows[g]
            found = np.flatnonzero((known[:, 0] == i) & np.isin(known[:, 1], own))
            groups.append(np.full(len(found), g))
            rows.append(found)
        return np.concatenate(groups), np.concatenate(rows)
