"""A log density of weights and hyperparameters, and the tilt by which the uncertainty of the weights enters it."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: How far from the anchor a tilt is trusted, in unconstrained values: it fades beyond, and steps cost what a hyperprior
#: of this SD would.
TRUSTED = 2.0


class TiltedDensity(ABC):
    """Log density over one vector: first `weight_count` weights of functions, then hyperparameters.

    `free` `(size,)` marks the coordinates that are learned.
    """

    def __init__(self, weight_count: int, free: NDArray[np.bool_]) -> None:
        self.weight_count, self.free = weight_count, free
        #: Gradient of a term by which the uncertainty of the weights enters (see `evidence.occam`), and the
        #: hyperparameters at which it was found: it is local, so it fades away from them, and a step costs something.
        #: Where turns have settled that cost is none.
        self.tilt = np.zeros(len(free))
        self.anchor: Array | None = None

    @abstractmethod
    def joint(self, point: Array) -> tuple[float, Array]:
        """Log density of forces, weights and hyperparameters, and its gradient.

        Raises:
            NotPositiveDefiniteError: it is not finite there.
        """

    def __call__(self, point: Array) -> tuple[float, Array]:
        """`joint` with its tilt, and its gradient.

        Raises:
            NotPositiveDefiniteError: it is not finite there.
        """
        value, gradient = self.joint(point)
        away = np.zeros_like(point)
        if self.anchor is not None:
            away[self.weight_count :] = (point - self.anchor)[self.weight_count :] / TRUSTED
        # A linear term would drive noise without bound where weights outnumber forces.
        bounded = np.tanh(away)
        tilted = value + TRUSTED * float(self.tilt @ bounded) - 0.5 * float(away @ away)
        return tilted, (gradient + self.tilt * (1.0 - bounded**2) - away / TRUSTED) * self.free
