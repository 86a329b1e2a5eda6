"""Where samplers begin: the mode of greatest evidence, and the curvature about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.config import TrainingConfig
from bayes_impedance.impedance_functions import laplace
from bayes_impedance.impedance_functions.fit import take_turns
from bayes_impedance.sampling.density import SampledDensity

Array = NDArray[np.float64]

#: Turns of mode and evidence, and the move of a hyperparameter, in prior SDs, below which they end: a sampler goes on
#: from there anyway.
TURNS, SETTLED = 5, 0.2


@dataclass(frozen=True)
class Start:
    """Laplace's approximation N(`point`, `root` `root`ᵀ) of a density over its coordinates `(size,)`.

    `outcome` is that of the climb.
    """

    point: Array
    root: Array
    outcome: str

    def at(self, steps: Array) -> Array:
        """Coordinates of `steps` `(..., size)` in units of the approximation's SD."""
        return self.point + steps @ self.root.T


def find_start(
    density: SampledDensity,
    training: TrainingConfig,
    progress: Callable[[int, float], None] | None = None,
) -> Start:
    """Climb from the prior mean.

    A joint mode of functions and noise takes the noise for less than it is; so hyperparameters maximise the evidence
    (docs/model.md §15), about which the posterior lies.

    Raises:
        NotPositiveDefiniteError: the density is not finite somewhere on the way.
    """
    point, precision, climb = take_turns(
        density,
        np.zeros(density.size),
        training.max_iterations,
        training.gradient_tolerance,
        progress,
        vary=density.settle,
        turns=TURNS,
        settled=SETTLED,
        # What `settle` is given stays in the coordinates in which chains move.
        rough=False,
    )
    # No direction is known less than before any force.
    values, vectors = np.linalg.eigh(laplace.covariance(precision))
    root = vectors * np.sqrt(np.clip(values, 1e-12, 1.0))
    return Start(point, root, climb.outcome)
