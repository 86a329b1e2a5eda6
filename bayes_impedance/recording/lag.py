"""Lag of logged force behind logged motion: the shift at which a law of motion explains force best.

    u(t + lag) + p(t) = M a(t) + D v(t) + K x(t) + what is slow + noise

holds with the robot's M and D where it answers force (K = 0), and with minus those of the arm where a perturbation
that nobody logged moves the hand. Which one is fitted does not matter, for nobody is asked but the lag. To first order
a lag changes D and nothing else; only acceleration over a broad band tells them apart, so it may be "not determined".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import uniform_filter1d
from scipy.optimize import minimize_scalar

from bayes_impedance.log import Array
from bayes_impedance.recording.spectra import Complex, CrossSpectra, cross_spectra, stretches, turned

#: Lags that are looked at, either way, and the step between them [s].
LARGEST, GRID = 0.2, 0.002
#: Two bands [Hz], each with a law of its own: an arm gives way to slow perturbations, and at high frequency only the
#: sensor's noise drives a robot, so that M and D may differ where the lag may not.
BANDS = ((1.0, 8.0), (8.0, 40.0))
#: Parts of the recording that the jackknife leaves out in turn.
PARTS = 12
#: A lag is determined at this standard error [s] or less, by a law that explains this share of the variance or more.
LARGEST_ERROR, LEAST_SHARE = 6e-4, 0.7
#: Two bands may differ by this [s] beyond chance: a controller holds force for one of its steps.
TOLERANCE = 1e-3
#: Rounds of weighing frequencies by what the law leaves unexplained there.
ROUNDS = 8
#: Share of a frequency's power that counts as unexplained at the least.
LEAST_LEFT = 1e-9


@dataclass(frozen=True)
class LagEstimate:
    """Lag of force behind motion [s], its standard error [s], and the share of the variance of force explained.

    Variance is weighed by frequency with the inverse of what the law leaves unexplained there. `reason` says why the
    lag is or is not `determined`; where not, it is no estimate.
    """

    lag: float
    standard_error: float
    explained: float
    determined: bool
    reason: str


def estimate_lag(
    time: Array, position: Array, force: Array, *, perturbation: Array | None = None
) -> LagEstimate:
    """Lag of `force (n, a)` [N] behind `position (n, a)` [m], both logged at `time (n,)` [s].

    Positive where force is logged later than the motion it belongs to. `perturbation (n, a)` [N] is what the robot
    adds to the force of the hand. Trials may follow each other: time jumps or begins anew between them. Samples with
    NaN are left out.

    Example:
        >>> time = np.arange(6000) / 200.0
        >>> tones = np.random.default_rng(0).uniform(2, 40, 40)[:, None]
        >>> position = (np.sin(tones * time) / tones**2).sum(axis=0)[:, None]
        >>> force = (-2 * np.sin(tones * (time - 0.01)) + 6 / tones * np.cos(tones * (time - 0.01))).sum(axis=0)
        >>> estimate = estimate_lag(time, position, force[:, None])
        >>> round(estimate.lag, 4), estimate.determined
        (0.01, True)
    """
    added = np.zeros_like(force) if perturbation is None else perturbation
    if len(time) < 2:
        return _undetermined(f"expected at least two samples, found {len(time)}")
    step = float(np.median(np.diff(time)))
    if step <= 0:
        return _undetermined("expected times that increase, found most that do not")
    parts = list(stretches(time, np.concatenate([force, added, position], axis=1), step))
    found: list[LagEstimate] = []
    shift = 0
    # A window cuts force where it cuts motion, so it is shifted by whole samples first.
    for _ in range(2):
        spectra = cross_spectra(parts, force.shape[1], step, shift, PARTS)
        if spectra is None:
            return _undetermined(f"expected at least {PARTS} windows of 2 s without gaps, found fewer")
        bands = [band for low, high in BANDS if len((band := spectra.between(low, high)).omega) >= 2]
        if not bands:
            return _undetermined(f"expected samples at 5 Hz or more, found {1 / step:.2g} Hz")
        found = [_of_band(band, shift * step) for band in bands]
        shift = round(_surest(found).lag / step)
    return _agreed(found)


def remove_lag(time: Array, force: Array, lag: float) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Force that is logged `lag` [s] late as it was at `time (n,)` [s], and which samples have one, `(n,)`.

    The first result `(m, …)` [N] holds the m samples that remain; the others would need force beyond the log.

    Example:
        >>> time = np.arange(5.0)
        >>> shifted, remain = remove_lag(time, 10.0 * time, 0.5)
        >>> shifted.tolist(), remain.tolist()
        ([5.0, 15.0, 25.0, 35.0], [True, True, True, True, False])
    """
    logged = time + lag
    remain = (logged >= time[0]) & (logged <= time[-1])
    return PchipInterpolator(time, force, axis=0)(logged[remain]), remain


def _undetermined(reason: str) -> LagEstimate:
    return LagEstimate(0.0, np.inf, 0.0, False, reason)


# --- one band ------------------------------------------------------------------------------------


def _of_band(spectra: CrossSpectra, shift: float) -> LagEstimate:
    """The lag in one band, beside the `shift` [s] that force has been moved by; determined or not."""
    total = spectra.parts.sum(axis=0)
    everything = np.ones((spectra.axes, len(spectra.omega)))
    weights = _inverse(_Profile(total, spectra.omega, everything, spectra.axes).spectrum(0.0)[1])
    lag, explained = 0.0, 0.0
    # Frequencies where the law does not hold, or with more noise, count less: the likelihood with a free spectrum
    # of the noise, smoothed over neighbouring frequencies.
    for _ in range(ROUNDS):
        profile = _Profile(total, spectra.omega, weights, spectra.axes)
        lag = _best(profile, shift)
        left, whole = profile.spectrum(lag)
        power = float((weights * whole).sum())
        explained = 1.0 - float((weights * left).sum()) / power if power > 0 else 0.0
        # Where motion is noise, its coefficients add noise; to count that would make a lag with less damping look best.
        held = np.maximum(1.0 - left * _inverse(whole), 0.0)
        weights = uniform_filter1d(held, 5, axis=1) * _inverse(uniform_filter1d(left, 5, axis=1))
    # Each looks at all lags: where two are about as good, the jackknife jumps from one to the other.
    without = np.array(
        [_best(_Profile(total - part, spectra.omega, weights, spectra.axes), shift) for part in spectra.parts]
    )
    error = float(np.sqrt((PARTS - 1) * without.var()))
    lag += shift
    if abs(lag) >= LARGEST - GRID:
        reason = f"force is explained best at the largest lag that is looked at, {LARGEST:g} s"
    elif explained < LEAST_SHARE:
        reason = f"expected mass, damping and stiffness to explain {LEAST_SHARE:.0%} of force, found {explained:.0%}"
    elif error > LARGEST_ERROR:
        reason = f"other lags explain force about as well: standard error {1e3 * error:.1f} ms"
    else:
        return LagEstimate(lag, error, explained, True, "acceleration tells the lag from damping")
    return LagEstimate(lag, error, explained, False, reason)


def _inverse(power: Array) -> Array:
    """1 / power, and 0 on an axis without force."""
    return np.divide(1.0, power, out=np.zeros_like(power), where=power > 0)


class _Profile:
    """What a law of all axes leaves of force + perturbation at any lag, its coefficients fitted to it.

    `total (f, c, c)`: cross-spectra of the channels; `weights (a, f)`.
    """

    def __init__(self, total: Complex, omega: Array, weights: Array, axes: int) -> None:
        self.omega, self.weights = omega, weights
        motion = slice(4 * axes, None)
        self.motion = total[:, motion, motion].real
        # Force behind three windows, and perturbation.
        answers = [[a, axes + a, 2 * axes + a, 3 * axes + a] for a in range(axes)]
        self.power = [total[:, answer][:, :, answer] for answer in answers]
        self.products = [total[:, motion, answer] for answer in answers]
        gram = np.einsum("af,fij->aij", weights, self.motion)
        size = np.sqrt(np.einsum("aii->ai", gram))
        scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
        scaled = gram * scale[:, :, None] * scale[:, None, :]
        # An axis that does not move leaves no coefficient to be fitted.
        self.inverse = np.linalg.pinv(scaled, hermitian=True) * scale[:, :, None] * scale[:, None, :]

    def unexplained(self, lags: Array) -> Array:
        """Weighted power of force + perturbation that the law leaves, `(l,)`."""
        turn = self._turned(lags)
        left = np.zeros(len(lags))
        for weight, power, products, inverse in zip(
            self.weights, self.power, self.products, self.inverse, strict=True
        ):
            whole = np.einsum(
                "lfj,lfk,fjk->l", turn, turn.conj(), weight[:, None, None] * power, optimize=True
            )
            product = np.einsum("lfk,fik->li", turn.conj(), weight[:, None, None] * products).real
            left += whole.real - np.einsum("li,ij,lj->l", product, inverse, product)
        return left

    def spectrum(self, lag: float) -> tuple[Array, Array]:
        """What the law leaves of force + perturbation at each frequency, and the whole of it, `(a, f)` each."""
        turn = self._turned(np.array([lag]))[0]
        left, whole = [], []
        for weight, power, products, inverse in zip(
            self.weights, self.power, self.products, self.inverse, strict=True
        ):
            whole.append(np.einsum("fj,fk,fjk->f", turn, turn.conj(), power).real)
            product = np.einsum("fk,fik->fi", turn.conj(), products).real
            law = inverse @ (weight @ product)
            rest = whole[-1] - 2 * product @ law + np.einsum("i,fij,j->f", law, self.motion, law)
            # A law without any noise would get all the weight there is.
            left.append(np.maximum(rest, LEAST_LEFT * whole[-1]))
        return np.stack(left), np.stack(whole)

    def _turned(self, lags: Array) -> Complex:
        turn = turned(lags, self.omega)
        return np.concatenate([turn, np.ones_like(turn[..., :1])], axis=-1)


def _best(profile: _Profile, shift: float) -> float:
    """The lag [s] that leaves least, beside a shift of force that has been made."""
    lags = np.arange(-LARGEST, LARGEST + GRID / 2, GRID) - shift
    lowest = lags[np.argmin(profile.unexplained(lags))]
    refined = minimize_scalar(
        lambda lag: float(profile.unexplained(np.array([lag]))[0]),
        bounds=(lowest - GRID, lowest + GRID),
        method="bounded",
        options={"xatol": 1e-7},
    )
    return float(refined.x)


# --- both bands ----------------------------------------------------------------------------------


def _surest(found: list[LagEstimate]) -> LagEstimate:
    """The least standard error of those whose law explains force."""
    return min(found, key=lambda estimate: (estimate.explained < LEAST_SHARE, estimate.standard_error))


def _agreed(found: list[LagEstimate]) -> LagEstimate:
    """The mean of what the bands say, where those that determine a lag agree."""
    sure = [estimate for estimate in found if estimate.determined]
    if len(sure) < 2:
        return _surest(found)
    first, second = sure
    apart = abs(first.lag - second.lag)
    chance = float(np.hypot(first.standard_error, second.standard_error))
    precision = np.array([estimate.standard_error**-2 for estimate in sure])
    share = precision / precision.sum()
    lag = float(share @ [estimate.lag for estimate in sure])
    explained = float(share @ [estimate.explained for estimate in sure])
    # What the bands differ by beyond chance widens the error of their mean.
    error = float(precision.sum() ** -0.5) * max(1.0, apart / chance)
    if apart > 3 * chance + TOLERANCE:
        reason = (
            f"slow and fast motion disagree: {1e3 * first.lag:.1f} ms under {BANDS[0][1]:g} Hz, "
            f"{1e3 * second.lag:.1f} ms above"
        )
        return LagEstimate(lag, error, explained, False, reason)
    return LagEstimate(lag, error, explained, True, "slow and fast motion agree")
