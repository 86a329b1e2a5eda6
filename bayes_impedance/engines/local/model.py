"""Many local models of one force: cells of a grid, each of which learns the samples near it (docs/model.md §17)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.config import LocalConfig
from bayes_impedance.engines.compiled.numbers import KernelNumbers
from bayes_impedance.engines.local.cell import (
    Cell,
    Sums,
    choose,
    empty_cell,
    place,
    refresh,
    whitened,
)
from bayes_impedance.engines.local.grid import Grid, nearest, weights_of
from bayes_impedance.engines.local.step import learn_near, predict_near, prior_variances

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Member = TypeVar("Member")

#: Samples after which the factor of a cell is computed anew; more often where it forgets, this often in its memory.
REFRESH, STEPS_OF_MEMORY = 1000, 20
#: Samples of a cell among which inducing inputs are chosen, evenly spread over them, and samples that are taught at
#: once: bounds of memory.
CANDIDATES, BLOCK = 4000, 4096


class Coverage(IntEnum):
    """What a prediction rests on: cells that have learned; no such cell near; a place outside of the grid."""

    LEARNED = 0
    UNVISITED = 1
    OUTSIDE = 2


class LocalMoments(NamedTuple):
    """Deviations of force, x_d and ẋ_d from their prior means, `(axes, 3)` [N, m, m/s], and their variances.

    Force is without noise. Where `coverage` says that nothing is known, these are the prior's.
    """

    mean: Floats
    variance: Floats
    coverage: Coverage


@dataclass(frozen=True)
class Snapshot:
    """What is known at one instant; nothing changes it, and any thread may read it.

    `numbers` and `noise` σ_r² `(axes,)` [N²] are hyperparameters; `cells` by their place in the grid, of which the
    `active` nearest predict.
    """

    numbers: KernelNumbers
    noise: Floats
    grid: Grid
    active: int
    cells: Mapping[int, Cell]

    def predict(self, x: Floats) -> LocalMoments:
        """Moments at the inputs `x` `(axes, D)` of a sample: a mixture of the nearest cells, with its second moment."""
        codes, weights = np.empty(self.active, dtype=np.int64), np.empty(self.active)
        inside = nearest(self.grid, x[0], codes, weights)
        near = [self.cells.get(code) for code in codes.tolist()] if inside else []
        cells = [cell for cell in near if cell is not None]
        if not cells:
            coverage = Coverage.UNVISITED if inside else Coverage.OUTSIDE
            prior = prior_variances(self.numbers, x)
            return LocalMoments(np.zeros_like(prior), prior, coverage)
        if len(cells) < self.active:
            weights = weights[[cell is not None for cell in near]]
        mean, variance = predict_near(self.numbers, _filled(cells, self.active), weights, x)
        return LocalMoments(mean, variance, Coverage.LEARNED)


@dataclass
class LocalModel:
    """Cells that learn, and predictions from them.

    `width` D is the number of columns of an input. One thread learns; a cell is replaced as a whole, never changed, so
    that others may read at any time.
    """

    numbers: KernelNumbers
    noise: Floats
    grid: Grid
    settings: LocalConfig
    width: int
    cells: dict[int, Cell] = field(default_factory=dict)
    sums: dict[int, Sums] = field(default_factory=dict)

    @property
    def view(self) -> Snapshot:
        """What is known at any time: its cells are those that learn."""
        return Snapshot(self.numbers, self.noise, self.grid, self.settings.active, self.cells)

    @property
    def snapshot(self) -> Snapshot:
        """What is known now."""
        return replace(self.view, cells=dict(self.cells))

    def learn(self, x: Floats, residual: Floats) -> Coverage:
        """One sample: inputs `(axes, D)`, u − E[u] `(axes,)` [N]; into the nearest cells.

        A place outside of the grid teaches nothing; nor does one whose cells were never visited, when there are
        `settings.cells` already (`UNVISITED`).
        """
        active = self.settings.active
        codes = np.empty(active, dtype=np.int64)
        if not nearest(self.grid, x[0], codes, np.empty(active)):
            return Coverage.OUTSIDE
        changed: dict[int, Cell] = {}
        for code in codes.tolist():
            cell = self._visit(code, changed)
            if cell is None:
                continue
            changed[code] = cell.successor()
            sums = self.sums[code]
            if sums.stale[0] >= self.refresh_every:
                # Before the sample is learned, which nothing is forgotten of yet.
                refresh(changed[code], sums, self._keep(int(sums.stale[0])))
        if not changed:
            return Coverage.UNVISITED
        cells = _filled(list(changed.values()), active)
        sums_ = _filled([self.sums[code] for code in changed], active)
        learn_near(self.numbers, self.noise, self.settings.novelty, cells, sums_, len(changed), x, residual)
        # At once, so that a snapshot has a sample in all of its cells or in none.
        self.cells.update(changed)
        return Coverage.LEARNED

    def learn_all(self, inputs: Floats, residual: Floats) -> None:
        """Many samples at once, `(axes, n, D)` and `(axes, n)`, into cells that are empty before.

        Inducing inputs are chosen among all samples of a cell. With the same inducing inputs, and nothing forgotten,
        this is what `learn` comes to sample by sample.
        """
        codes, _ = weights_of(self.grid, inputs[0], self.settings.active)
        # In the order of their first visit, as a stream comes to them: there may be more than `settings.cells`.
        for code in dict.fromkeys(codes[codes >= 0].tolist()):
            rows = np.flatnonzero((codes == code).any(axis=1))
            cell = self._visit(code)
            if cell is not None:
                self._teach(
                    cell, self.sums[code], *map(np.ascontiguousarray, (inputs[:, rows], residual[:, rows]))
                )
                self.cells[code] = cell

    def compile(self, x: Floats) -> None:
        """Compile all that a loop calls, at inputs `x` `(axes, D)` within the grid; nothing is learned."""
        scratch = replace(self, cells={}, sums={})
        scratch.learn(x, np.zeros(len(x)))
        scratch.view.predict(x)
        for code, cell in scratch.cells.items():
            refresh(cell, scratch.sums[code], 1.0)

    @property
    def refresh_every(self) -> int:
        """Samples after which the factor of a cell is computed anew."""
        memory = self.settings.forgetting
        return REFRESH if memory is None else max(1, min(REFRESH, round(memory / STEPS_OF_MEMORY)))

    def _teach(self, cell: Cell, sums: Sums, inputs: Floats, residual: Floats) -> None:
        n = inputs.shape[1]
        candidates = np.unique(np.linspace(0, n - 1, min(n, CANDIDATES)).astype(int))
        for axis in range(self.noise.size):
            among = inputs[axis, candidates]
            enough = self.settings.novelty * self.noise[axis]
            chosen = choose(self.numbers, axis, among, self.settings.inducing, enough)
            place(self.numbers, axis, cell, among[chosen])
            for start in range(0, n, BLOCK):
                block = slice(start, start + BLOCK)
                white, scaled = whitened(
                    self.numbers, self.noise[axis], axis, cell, inputs[axis, block], residual[axis, block]
                )
                sums.gram[axis] += white.T @ white
                sums.moment[axis] += white.T @ scaled
        sums.samples[0] += n
        refresh(cell, sums, 1.0)

    def _visit(self, code: int, learning: Iterable[int] = ()) -> Cell | None:
        """A cell, an empty one where it was never visited; None where there is no room beside those `learning`.

        Nobody sees an empty cell before it has learned something.
        """
        if code in self.cells:
            return self.cells[code]
        if (
            code < 0
            or len(self.cells) + sum(one not in self.cells for one in learning) >= self.settings.cells
        ):
            return None
        axes, inducing = self.noise.size, self.settings.inducing
        self.sums[code] = Sums.empty(axes, inducing)
        return empty_cell(axes, inducing, self.width)

    def _keep(self, samples: int) -> float:
        """Weight that what a cell was taught keeps after so many more `samples`; it is forgotten in such steps."""
        memory = self.settings.forgetting
        return 1.0 if memory is None else float(np.exp(-samples / memory))


def _filled(members: list[Member], length: int) -> tuple[Member, ...]:
    """As a tuple of that length, which ends with copies of the first: what is compiled for one length serves."""
    return (*members, *members[:1] * (length - len(members)))
