"""The filter that smooths and differentiates every channel alike."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial.legendre import legder, legvander
from scipy.ndimage import correlate1d

from bayes_impedance.config import Smoother
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.log import Array, Integers, Trial
from bayes_impedance.preprocessing.grid import place

#: Samples of half a window; a number that does not overflow, and that no log has.
LONGEST = 1e9


@dataclass(frozen=True)
class SavitzkyGolay:
    """Value or derivative of the local polynomial fit over `length` samples that are `step` [s] apart."""

    length: int
    order: int
    step: float

    def __call__(self, values: Array, derivative: int = 0) -> Array:
        """Filtered `values (n, …)`, read-only; the first and last fits also serve the half windows at the ends."""
        half = self.length // 2
        fit, evaluate = self._fit(derivative)
        smoothed: Array = correlate1d(values, evaluate[half] @ fit, axis=0, mode="constant")
        smoothed[:half] = evaluate[:half] @ (fit @ values[: self.length])
        smoothed[-half:] = evaluate[half + 1 :] @ (fit @ values[-self.length :])
        # So that it need not be copied where it is kept.
        smoothed.setflags(write=False)
        return smoothed

    def coefficients(self, derivative: int = 0) -> Array:
        """Weights of the samples of a window in the value at its middle, `(length,)` [1/s^derivative]."""
        fit, evaluate = self._fit(derivative)
        weights: Array = evaluate[self.length // 2] @ fit
        return weights

    def weights(self, derivative: int = 0) -> Array:
        """Weights of a window's samples in the value at each of its places, `(length, length)` [1/s^derivative]."""
        fit, evaluate = self._fit(derivative)
        weights: Array = evaluate @ fit
        return weights

    def windows(self, n: int) -> tuple[Integers, Integers]:
        """First sample of the window that serves each of `n` samples, and the sample's place in it, `(n,)` each."""
        samples = np.arange(n)
        first = np.clip(samples - self.length // 2, 0, n - self.length)
        return first, samples - first

    def _fit(self, derivative: int) -> tuple[Array, Array]:
        """Samples of a window → coefficients of the polynomial, and these → a derivative at each sample."""
        half = self.length // 2
        offsets = np.arange(-half, half + 1) / half
        # Legendre polynomials on [−1, 1], not savgol_filter of scipy: that fits powers of sample numbers,
        # which at order 7 costs half the digits with 101 samples and silently returns zeros with 501.
        fit = np.asarray(np.linalg.pinv(legvander(offsets, self.order)), dtype=np.float64)
        evaluate = legvander(offsets, self.order - derivative) @ legder(np.eye(self.order + 1), derivative)
        return fit, evaluate / (half * self.step) ** derivative


@lru_cache(maxsize=64)
def motion_weights(length: int, order: int, step: float) -> Array:
    """Weights of a window in position, velocity and acceleration at each of its places, `(3, length, length)` [s^−r].

    The filter is that of `SavitzkyGolay(length, order, step)`.
    """
    smooth = SavitzkyGolay(length, order, step)
    weights = np.stack([smooth.weights(derivative) for derivative in range(3)])
    weights.setflags(write=False)
    return weights


def choose_filter(trial: Trial, smoother: Smoother, step: float) -> SavitzkyGolay:
    """The filter that `smoother` asks for at steps of `step` [s].

    Warns (LogWarning) when its window has to be longer.

    Raises:
        LogError: the trial is shorter than one window.
    """
    # The odd number nearest to window / step.
    length = 2 * math.floor(min(smoother.window / step / 2, LONGEST) + 1e-9) + 1
    # With order + 1 samples the polynomial passes through every one of them and smooths nothing.
    if length <= smoother.polynomial_order + 1:
        length = smoother.polynomial_order + 2
        length += 1 - length % 2
        warnings.warn(
            f"a smoother of {smoother.window:g} s is too short for order {smoother.polynomial_order} at "
            f"{1 / step:.4g} Hz, so its window is {length * step:.3g} s ({length} samples); raise "
            "preprocessing.smoother.window or lower polynomial_order",
            LogWarning,
            stacklevel=5,
        )
    if trial.n_samples < length:
        raise LogError(
            f"{place(trial)}: expected at least {length} samples, one window of the smoother "
            f"({length * step:.3g} s), found {trial.n_samples}; shorten preprocessing.smoother.window, or "
            "leave the trial out"
        )
    return SavitzkyGolay(length, smoother.polynomial_order, step)
