"""Cells of a grid over the operating range, and those nearest to a sample, compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Directions in which a second neighbour is looked for beside the first; among nine cells no further one is nearer.
DIRECTIONS = 4
#: Width of the weights of cells, in cells.
BANDWIDTH = 0.5
#: Code where there is no cell.
OUTSIDE = -1


class Grid(NamedTuple):
    """A cell is a box; `columns` `(p,)` of the input lie in it, from `lower`, in steps of `width` `(p,)` [their units].

    There are `shape` `(p,)` of them; outside is nothing known.
    """

    columns: Integers
    lower: Floats
    width: Floats
    shape: Integers

    @property
    def size(self) -> int:
        """Cells that there can be."""
        return int(np.prod(self.shape))


@njit(cache=True, nogil=True, error_model="numpy")
def nearest(grid: Grid, x: Floats, codes: Integers, weights: Floats) -> bool:
    """The nearest cells to a sample `x` `(D,)`, as many as `codes` holds, nearest first, and their weights.

    g = exp(−r²/2b²) with r the distance to the centre in cells, not yet normalised. At a border there are fewer, for
    they are looked for near by; codes behind the last are −1. False where the sample lies outside of the grid.
    """
    p = grid.columns.size
    index = np.empty(p, dtype=np.int64)
    offset = np.empty(p)
    for c in range(p):
        place = (x[grid.columns[c]] - grid.lower[c]) / grid.width[c]
        # NaN is outside, too
        if not (place >= 0.0 and place < grid.shape[c]):
            return False
        index[c] = int(place)
        offset[c] = place - index[c] - 0.5
    # Neighbours in the direction whose border is nearest cost least.
    order = np.argsort(-np.abs(offset))
    few = min(p, DIRECTIONS)
    # Nine cells reach so far where there are few directions to take.
    reach = 4 if p == 1 else 2 if p == 2 else 1
    steps = 2 * reach + 1
    found = 0
    most = codes.size
    distance = np.full(most, np.inf)
    codes[:] = OUTSIDE
    step = np.zeros(p, dtype=np.int64)
    for combination in range(steps**few + 2 * (p - few)):
        step[:] = 0
        rest = combination
        if combination < steps**few:
            for c in range(few):
                step[order[c]] = rest % steps - reach
                rest //= steps
        else:
            rest = combination - steps**few
            step[order[few + rest // 2]] = 2 * (rest % 2) - 1
        code, r = 0, 0.0
        inside = True
        for c in range(p):
            at = index[c] + step[c]
            inside = inside and 0 <= at < grid.shape[c]
            code = code * grid.shape[c] + at
            r += (offset[c] - step[c]) ** 2
        if not inside:
            continue
        place = min(found, most - 1)
        if found == most and r >= distance[most - 1]:
            continue
        while place > 0 and distance[place - 1] > r:
            distance[place], codes[place] = distance[place - 1], codes[place - 1]
            place -= 1
        distance[place], codes[place] = r, code
        found = min(found + 1, most)
    for i in range(found):
        weights[i] = np.exp(-(distance[i] - distance[0]) / (2.0 * BANDWIDTH**2))
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def weights_of(grid: Grid, inputs: Floats, active: int) -> tuple[Integers, Floats]:
    """Codes and weights of the `active` nearest cells to many samples `(n, D)`, `(n, active)` each; −1 outside."""
    codes, weights = np.full((inputs.shape[0], active), OUTSIDE), np.zeros((inputs.shape[0], active))
    for t in range(inputs.shape[0]):
        nearest(grid, inputs[t], codes[t], weights[t])
    return codes, weights
