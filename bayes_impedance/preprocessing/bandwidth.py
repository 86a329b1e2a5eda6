"""What a smoother passes and what it leaves of noise: bandwidth, noise of motion, and the force that this makes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from bayes_impedance.config import Smoother
from bayes_impedance.log import Array, Trial
from bayes_impedance.preprocessing.grid import on_even_grid
from bayes_impedance.preprocessing.savitzky_golay import SavitzkyGolay, choose_filter

#: Orders of differentiation that enter the force: position, velocity, acceleration.
ORDERS = (0, 1, 2)
#: Samples from which noise is estimated: more tell nothing new.
ENOUGH = 100_000


def bandwidth(smooth: SavitzkyGolay, derivative: int) -> float:
    """Frequency [Hz] at which a filtered derivative has fallen to 1/√2 of the true one; the half rate if it never does.

    |Σ_k c_k e^{2πifkΔ}| / (2πf)^r at derivative r, c the coefficients of the filter at steps of Δ.
    """
    weights = smooth.coefficients(derivative)
    half = smooth.length // 2

    def excess(frequency: float) -> float:
        angle = 2.0 * np.pi * frequency
        response = weights @ np.exp(1j * angle * smooth.step * np.arange(-half, half + 1))
        return float(abs(response)) / angle**derivative - math.sqrt(0.5)

    # The response first falls, later it ripples: the first frequency is wanted.
    frequencies = np.linspace(0.0, 0.5 / smooth.step, 8 * smooth.length)[1:]
    below = next((i for i, frequency in enumerate(frequencies) if excess(frequency) < 0), None)
    if below is None:
        return float(frequencies[-1])
    lower = frequencies[below - 1] if below else 0.5 * frequencies[0]
    return float(brentq(excess, lower, frequencies[below]))


def noise_covariance(smooth: SavitzkyGolay) -> Array:
    """Covariance of (x, ẋ, ẍ) from white noise of unit variance in the samples, `(3, 3)` [s^−(i + j)].

    S_ij = Σ_k c_k⁽ⁱ⁾ c_k⁽ʲ⁾.
    """
    weights = np.stack([smooth.coefficients(order) for order in ORDERS])
    covariance: Array = weights @ weights.T
    return covariance


def sample_noise(values: Array, smooth: SavitzkyGolay) -> Array:
    """SD of white noise in `values` `(n, c)`, `(c,)` in their unit, from what the filter leaves behind.

    Var[y − ŷ] = σ² (1 − c_0): the filter is a projection, whose middle coefficient c_0 is its own share. By the median
    absolute deviation, so that a motion too quick for the filter here and there does not count as noise.
    """
    residual = (values - smooth(values))[smooth.length // 2 : len(values) - smooth.length // 2]
    spread = np.median(np.abs(residual - np.median(residual, axis=0)), axis=0) / 0.6744897501960817
    kept = 1.0 - smooth.coefficients(0)[smooth.length // 2]
    deviation: Array = spread / np.sqrt(kept)
    return deviation


@dataclass(frozen=True)
class SmootherEffect:
    """What one window does.

    `window` [s]; `bandwidth` `(3,)` [Hz] of position, velocity and acceleration; `recorded_noise` `(a,)` [m]: SD of the
    noise of the recorded positions; `covariance` `(a, 3, 3)`: what it leaves in position [m], velocity [m/s] and
    acceleration [m/s²]; `removed` `(a,)` [1]: share of the variance of force that the window takes away, None without
    force.
    """

    window: float
    bandwidth: Array
    recorded_noise: Array
    covariance: Array
    removed: Array | None

    @property
    def noise(self) -> Array:
        """SD of position, velocity and acceleration, `(a, 3)` [m, m/s, m/s²]."""
        deviation: Array = np.sqrt(self.covariance.diagonal(axis1=1, axis2=2))
        return deviation

    def force_noise(self, stiffness: float, damping: float, mass: float) -> Array:
        """SD of k x + d ẋ + m ẍ from the noise of the positions, wᵀ S w, `(a,)` [N]."""
        weights = np.array([stiffness, damping, mass])
        deviation: Array = np.sqrt(weights @ self.covariance @ weights)
        return deviation


def smoother_effect(trial: Trial, smoother: Smoother) -> SmootherEffect:
    """Bandwidth of a smoother on a trial, and what it leaves of the noise of the trial's own positions.

    Raises:
        LogError: the trial is shorter than one window.
    """
    step = float(np.median(np.diff(trial.time)))
    trial = on_even_grid(trial, step)
    smooth = choose_filter(trial, smoother, step)
    noise = sample_noise(trial.position[:ENOUGH], smooth)
    removed = None
    if trial.force is not None:
        force = trial.force[:ENOUGH]
        whole = force.var(axis=0)
        removed = (force - smooth(force)).var(axis=0) / np.where(whole > 0, whole, 1.0)
    return SmootherEffect(
        smooth.length * step,
        np.array([bandwidth(smooth, order) for order in ORDERS]),
        noise,
        noise[:, None, None] ** 2 * noise_covariance(smooth),
        removed,
    )
