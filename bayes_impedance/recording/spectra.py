"""Cross-spectra of force and motion over overlapping windows, all that an estimate of their lag needs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from bayes_impedance.log import Array
from bayes_impedance.recording.clock import GAP

Complex = npt.NDArray[np.complex128]

#: Length of a window [s]; half of it overlaps the next.
WINDOW = 2.0
#: SD of the Gaussian filter and where its kernel is cut off, in samples.
SIGMA, REACH = 1.5, 9
#: Highest frequency that is looked at, as a share of the sampling rate: beyond, the filter has left little.
SHARE = 0.4


@dataclass(frozen=True)
class CrossSpectra:
    """Sums of z zᴴ over the windows of each part of a recording, z the transforms of the channels.

    `omega (f,)` [rad/s]; `parts (p, f, c, c)`. Channels, each for all `axes`: force behind the three parts of the
    window (see `turned`), then perturbation, acceleration, velocity and position behind the whole window.
    """

    omega: Array
    parts: Complex
    axes: int

    def between(self, low: float, high: float) -> CrossSpectra:
        """The frequencies from `low` to under `high` [Hz]."""
        chosen = (self.omega >= 2 * np.pi * low) & (self.omega < 2 * np.pi * high)
        return CrossSpectra(self.omega[chosen], self.parts[:, chosen], self.axes)


def turned(lags: Array, omega: Array) -> Complex:
    """Weights `(l, f, 3)` of the three force channels that make them the force at `lags (l,)` [s] later.

    Shifting the transform of w(t) u(t) by its phase alone would shift the window with the force, and a window that
    lies elsewhere than that of the motion makes no lag look best whatever the lag is. So u(t + τ) behind w(t) is
    e^{iωτ} times u(t) behind w(t − τ), and for a Hann window w(t − τ) = ½ − ½ cos τ' cos t' − ½ sin τ' sin t'.
    """
    phase = np.exp(1j * lags[:, None] * omega)
    angle = 2 * np.pi * lags[:, None] / WINDOW
    return phase[..., None] * np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=-1)


def stretches(time: Array, channels: Array, step: float) -> Iterator[Array]:
    """`channels (n, c)` at even steps of `step` [s], one array for what lies between two gaps, or starts of trials."""
    known = np.isfinite(channels).all(axis=1)
    time, channels = time[known], channels[known]
    steps = np.diff(time)
    edges = np.flatnonzero((steps > GAP * step) | (steps <= 0)) + 1
    for start, end in zip([0, *edges], [*edges, len(time)], strict=True):
        if end - start > 1:
            part = slice(start, end)
            grid = np.arange(time[start], time[end - 1], step)
            yield PchipInterpolator(time[part], channels[part])(grid)


def cross_spectra(
    parts: list[Array], axes: int, step: float, shift: int, n_parts: int
) -> CrossSpectra | None:
    """Of stretches `(n, 3 axes)` of force, perturbation and position; force taken `shift` samples later.

    None where there are fewer windows than `n_parts`.
    """
    length = round(WINDOW / step)
    windows = [window for part in parts for window in _windows(_channels(part, step, shift, axes), length)]
    if len(windows) < n_parts:
        return None
    frequency = np.fft.rfftfreq(length, step)
    # A Hann window spreads what is constant over the first bin, and drift a little farther.
    chosen = (frequency > 1.5 / WINDOW) & (frequency < SHARE / step)
    omega = 2 * np.pi * frequency[chosen]
    sums = np.zeros((n_parts, len(omega), 7 * axes, 7 * axes), dtype=np.complex128)
    angle = 2 * np.pi * np.arange(length)[:, None] / length
    tapers = (np.full_like(angle, 0.5), -0.5 * np.cos(angle), -0.5 * np.sin(angle))
    for number, window in enumerate(windows):
        centred = window - window.mean(axis=0)
        force, others = centred[:, :axes], centred[:, axes:]
        tapered = [*(taper * force for taper in tapers), (tapers[0] + tapers[1]) * others]
        z = np.fft.rfft(np.concatenate(tapered, axis=1), axis=0)[chosen]
        sums[number * n_parts // len(windows)] += z[:, :, None] * z[:, None, :].conj()
    return CrossSpectra(np.asarray(omega, dtype=np.float64), sums, axes)


def _channels(part: Array, step: float, shift: int, axes: int) -> Array:
    """Force, perturbation, acceleration, velocity and position behind one filter."""
    n = len(part) - abs(shift)
    if n <= 2 * REACH:
        return np.empty((0, 5 * axes))
    force = part[max(shift, 0) :, :axes][:n]
    others = part[max(-shift, 0) :, axes:][:n]

    # Not Savitzky–Golay: the frequency responses of its derivatives fall off differently, which at .1 s looks like a
    # lag of up to .1 ms. The derivatives of one Gaussian are consistent, and no window has to be chosen.
    def filtered(values: Array, order: int = 0) -> Array:
        smooth: Array = gaussian_filter1d(values, SIGMA, axis=0, order=order, radius=REACH) / step**order
        return smooth[REACH:-REACH]

    perturbation, position = others[:, :axes], others[:, axes:]
    motion = [filtered(position, order) for order in (2, 1, 0)]
    return np.concatenate([filtered(force), filtered(perturbation), *motion], axis=1)


def _windows(channels: Array, length: int) -> Iterator[Array]:
    for start in range(0, len(channels) - length + 1, max(1, length // 2)):
        yield channels[start : start + length]
