"""Signals of one recording on an even grid, smoothed and differentiated alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_filter

from bayes_impedance.errors import LogError
from bayes_impedance.log import Array

ORDER = 3


@dataclass(frozen=True, eq=False)
class Alike:
    """One filter for all signals of a recording with sample times `time (n,)` [s] and a window of `window` [s].

    Between samples signals are linear; what lies within a window of an end or of a gap is left out.

    Raises:
        LogError: the recording is shorter than three windows.
    """

    time: Array
    window: float

    def __post_init__(self) -> None:
        """Refuse what leaves next to nothing."""
        found = self.time[-1] - self.time[0]
        if not found >= 3 * self.window or self.length <= ORDER + 1:
            raise LogError(
                f"expected a recording of at least three windows of {self.window:g} s with more than {ORDER + 1} "
                f"samples in each, found {found:.3g} s at {1 / self.step:.4g} Hz; record for longer"
            )

    @property
    def step(self) -> float:
        """Of the even grid [s]."""
        return float(np.median(np.diff(self.time)))

    @property
    def length(self) -> int:
        """Of the filter, in samples; odd."""
        return 2 * round(self.window / self.step / 2) + 1

    @property
    def grid(self) -> Array:
        """Times `(m,)` [s] of the grid."""
        return np.arange(self.time[0], self.time[-1] + 0.01 * self.step, self.step)

    def smooth(self, signal: Array) -> Array:
        """Smoothed `signal (n, a)` at the inner times, `(k, a)`."""
        return self._filtered(signal)[self._inner()]

    def derivative(self, signal: Array, order: int = 1) -> Array:
        """Derivative of the smoothed `signal (n, a)` at the inner times, `(k, a)` [unit / s^order].

        Differences of what was smoothed, so that a signal and the derivative of its integral come out the same; the
        derivative of a local polynomial would be another filter.
        """
        values = self._filtered(signal)
        for _ in range(order):
            values = np.gradient(values, self.step, axis=0)
        return values[self._inner()]

    def roughness(self, signal: Array, order: int = 0) -> float:
        """Power of what half the window would leave more of a derivative of `signal (n, a)`, over that of the whole."""
        finer = Alike(self.time, self.window / 2)
        coarse, fine = (each._filtered(signal) for each in (self, finer))
        for _ in range(order):
            coarse, fine = (np.gradient(values, self.step, axis=0) for values in (coarse, fine))
        inner = self._inner()
        power = float(np.sum(coarse[inner] ** 2))
        return float(np.sum((fine - coarse)[inner] ** 2)) / power if power > 0 else np.inf

    def _filtered(self, signal: Array) -> Array:
        even = np.stack([np.interp(self.grid, self.time, column) for column in signal.T], axis=1)
        return np.asarray(savgol_filter(even, self.length, ORDER, axis=0))

    def _inner(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        grid, reach = self.grid, self.window / 2 + 2 * self.step
        inner = (grid >= self.time[0] + reach) & (grid <= self.time[-1] - reach)
        gaps = np.flatnonzero(np.diff(self.time) > max(5 * self.step, self.window / 3))
        for gap in gaps:
            inner &= (grid < self.time[gap] - reach) | (grid > self.time[gap + 1] + reach)
        return inner
