"""A sender's clock against the recorder's, by when its messages arrived.

A message carries `sent`, the stamp of its sender's clock, and `received`, its arrival on the recorder's clock:

    received = sent + what the clocks differ by + delay,    delay ≥ 0
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import median_abs_deviation

from bayes_impedance.log import Array

#: Draws of the bootstrap behind standard errors.
DRAWS = 50
#: Delays that are drawn again.
LEAST_DELAYS = 5000


@dataclass(frozen=True)
class ClockOffset:
    """A sender's clock against the recorder's: the line received = origin + delay + (1 + rate)(sent − origin).

    No message arrived before it, so `delay` [s] holds what the clocks differ by at `origin` [s] and the shortest way.
    `rate` [1]; `delay_error` [s] and `rate_error` [1] are standard errors; `transport` is the robust SD [s] of delays.
    """

    origin: float = 0.0
    delay: float = 0.0
    rate: float = 0.0
    delay_error: float = 0.0
    rate_error: float = 0.0
    transport: float = 0.0

    @property
    def offset(self) -> float:
        """The sender's clock minus the recorder's at the first message [s]."""
        return -self.delay

    @property
    def drift(self) -> float:
        """By how much the sender's clock runs faster than the recorder's [ppm]."""
        return 1e6 * (1.0 / (1.0 + self.rate) - 1.0)

    @property
    def drift_error(self) -> float:
        """Standard error of the drift [ppm]."""
        return 1e6 * self.rate_error

    def to_recorder(self, sent: Array) -> Array:
        """Times of the sender's clock on the recorder's [s]."""
        return sent + self.delay + self.rate * (sent - self.origin)

    def to_sender(self, received: Array) -> Array:
        """Times of the recorder's clock on the sender's [s]."""
        return self.origin + (received - self.origin - self.delay) / (1.0 + self.rate)


#: The recorder's clock against itself.
RECORDER = ClockOffset()


def compare_clocks(sent: Array, received: Array) -> ClockOffset:
    """Offset and drift of a sender's clock, from stamps `sent (n,)` that increase and arrivals `received (n,)` [s].

    The line of the greatest mean that no delay lies under. Delays are one-sided and come in bursts: least squares
    would take a burst for drift, and the line under all of them needs but a few messages that were not held up.
    Standard errors by drawing blocks of the delays again.

    Source: Moon, Skelly, Towsley, Estimation and removal of clock skew from network delay measurements, 1999.
    """
    origin = float(sent[0])
    elapsed = sent - origin
    # Centred, for a difference of minutes leaves few digits for microseconds.
    typical = float(np.median(received - sent))
    delays = received - sent - typical
    start, rate = lower_line(elapsed, delays)
    above = delays - (start + rate * elapsed)

    # The least delay of a few neighbours stands for all of them: a line under it is under the others.
    starts = np.linspace(0, len(sent), min(len(sent), LEAST_DELAYS), endpoint=False).astype(np.int64)
    least = np.minimum.reduceat(above, starts)
    generator = np.random.default_rng(0)
    n = len(starts)
    block = int(np.ceil(np.sqrt(n)))
    draws = np.empty((DRAWS, 2))
    for draw in draws:
        firsts = generator.integers(0, n - block + 1, -(-n // block))
        again = (firsts[:, None] + np.arange(block)).ravel()[:n]
        draw[:] = lower_line(elapsed[starts], least[again])
    return ClockOffset(
        origin=origin,
        delay=typical + start,
        rate=rate,
        delay_error=float(draws[:, 0].std()),
        rate_error=float(draws[:, 1].std()),
        transport=float(median_abs_deviation(above, scale="normal")),
    )


def lower_line(x: Array, y: Array) -> tuple[float, float]:
    """Intercept and slope of the line under all points `(n,)` that is highest at the mean of x; x does not decrease.

    This is the linear program max Σ(a + b x) under a + b x ≤ y, whose answer is the edge of the lower convex hull
    above the mean of x. From the chord of the two ends, the point farthest below it replaces the end on its side.
    """
    left, right, mean = 0, len(x) - 1, x.mean()
    while True:
        slope = (y[right] - y[left]) / (x[right] - x[left])
        below = y - y[left] - slope * (x - x[left])
        lowest = int(np.argmin(below))
        # What is left is rounding.
        if lowest in (left, right) or below[lowest] >= -1e-12:
            return float(y[left] - slope * x[left]), float(slope)
        if x[lowest] <= mean:
            left = lowest
        else:
            right = lowest
