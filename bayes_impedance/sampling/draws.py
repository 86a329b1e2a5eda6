"""What every method of sampling returns: coordinates, and how they were drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.config.inference import SamplingMethod

Array = NDArray[np.float64]

#: Called with a chain (or 0), the iterations done of it, how many there will be, and a line about the state.
Progress = Callable[[int, int, int, str], None]


@dataclass(frozen=True)
class Draws:
    """Coordinates `standard` `(chains, draws, size)` of a `JointDensity`.

    `stats`: by name, `(chains, draws)` each: for nuts those of a `Chain`, for approximations the log density "lp" alone.
    `pareto_k` is the shape of the tail of their importance ratios, None for nuts;
    `lost` says of each chain that died with what; `remarks` are what else a reader should know of how they were drawn.
    """

    method: SamplingMethod
    standard: Array
    stats: Mapping[str, NDArray[np.generic]]
    pareto_k: float | None = None
    lost: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def shape(self) -> tuple[int, int]:
        """Chains, and draws of each."""
        return self.standard.shape[0], self.standard.shape[1]
