"""B-splines over phase, and the penalty that keeps neighbouring ones alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

Array = NDArray[np.float64]

DEGREE = 3


@dataclass(frozen=True)
class PhaseBasis:
    """`size` cubic B-splines over phase [0, 1] with even knots; fewer than four are of lower degree, one is constant.

    Phases that a smoother moved beyond an end count as that end.

    Example:
        >>> PhaseBasis(5)(np.array([0.0, 0.5, 1.0])).round(2)
        array([[1.  , 0.  , 0.  , 0.  , 0.  ],
               [0.  , 0.25, 0.5 , 0.25, 0.  ],
               [0.  , 0.  , 0.  , 0.  , 1.  ]])
    """

    size: int

    def __call__(self, phase: Array) -> Array:
        """Values at `phase` `(n,)` [1], `(n, size)`; each row sums to one."""
        degree = min(DEGREE, self.size - 1)
        inner = np.linspace(0.0, 1.0, self.size - degree + 1)
        knots = np.concatenate([np.zeros(degree), inner, np.ones(degree)])
        return np.asarray(BSpline.design_matrix(np.clip(phase, 0.0, 1.0), knots, degree).toarray())

    def penalty(self, order: int) -> Array:
        """Quadratic form of the squared differences of `order` between coefficients, `(size, size)`.

        P-splines: Eilers and Marx, *Flexible smoothing with B-splines and penalties* (Statistical Science 11, 1996).
        """
        differences = np.diff(np.eye(self.size), order, axis=0)
        return np.asarray(differences.T @ differences)
