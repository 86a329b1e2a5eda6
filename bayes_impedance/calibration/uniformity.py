"""Whether ranks are uniform, and how a posterior deviates where they are not.

Where truth and posterior draws come from one joint distribution the rank of the truth among L independent draws is
uniform on 0 … L (Talts et al. 2018), and z = (truth − mean)/SD has mean 0 and variance 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom, chisquare

from bayes_impedance.errors import ConfigurationError

Array = NDArray[np.float64]
Ranks = NDArray[np.int64]

#: A test takes at least so many ranks expected in a bin, and no more bins than so many.
EXPECTED, MOST_BINS = 5, 20
#: Ranks below which no deviation but the grossest shows.
FEWEST = 20
#: Chance of a false alarm over all quantities together.
LEVEL = 0.01
#: Probability of the bands in figures.
BAND = 0.99
#: Deviations of mean and SD of z, in units of their standard errors, that are put into words.
NOTABLE = 3.0
#: Simulated samples of uniform ranks behind a band.
SIMULATIONS = 10_000
#: Of differences of shares.
ROUNDING = 1e-12


@dataclass(frozen=True)
class Uniformity:
    """What the ranks of one quantity show.

    `p` of the χ² test of uniform ranks, `bins` of it; `inside`: the ECDF stays in its simultaneous band; `shift` and
    `spread`: mean and SD of z over `count` draws; `verdict` in words.
    """

    name: str
    p: float
    bins: int
    inside: bool
    shift: float
    spread: float
    count: int
    verdict: str


def bins_for(count: int, thinned: int) -> int:
    """Bins of equal width for `count` ranks on 0 … `thinned`, as many as the χ² test bears.

    Example:
        >>> bins_for(200, 99), bins_for(30, 99)
        (20, 5)

    Raises:
        ConfigurationError: there are too few ranks, or their number has no divisor.
    """
    if count < FEWEST:
        raise ConfigurationError(
            f"--draws: expected at least {FEWEST} draws with a posterior, for a test of uniform ranks, found {count}; "
            "take more"
        )
    most = min(MOST_BINS, count // EXPECTED)
    fitting = [bins for bins in range(2, most + 1) if (thinned + 1) % bins == 0]
    if not fitting:
        raise ConfigurationError(
            f"--thinned: expected ranks that can be put into 2 to {most} equal bins, got {thinned + 1} of them; take "
            "one less than a multiple of 10, such as 99"
        )
    return fitting[-1]


def histogram(ranks: Ranks, thinned: int) -> NDArray[np.int64]:
    """Ranks in each bin of `bins_for`."""
    bins = bins_for(len(ranks), thinned)
    return np.bincount(ranks * bins // (thinned + 1), minlength=bins)


def histogram_band(count: int, bins: int, probability: float = BAND) -> tuple[float, float]:
    """What a bin of uniform ranks holds with that probability, from and to."""
    tail = 0.5 - 0.5 * probability
    return float(binom.ppf(tail, count, 1.0 / bins)), float(binom.ppf(1.0 - tail, count, 1.0 / bins))


def ecdf_difference(ranks: Ranks, thinned: int) -> tuple[Array, Array]:
    """Where, `(thinned,)`, and by how much the share of ranks below exceeds that of uniform ones, `(thinned,)`."""
    at = np.arange(1, thinned + 1) / (thinned + 1)
    below = np.searchsorted(np.sort(ranks), np.arange(1, thinned + 1), side="left") / len(ranks)
    return at, below - at


def ecdf_band(count: int, thinned: int, probability: float = BAND) -> tuple[Array, Array]:
    """Band that the whole difference stays in with that probability, `(thinned,)` each (Säilynoja et al. 2022).

    Pointwise binomial intervals, as much wider than that probability as simulated uniform ranks ask for.
    """
    at = np.arange(1, thinned + 1) / (thinned + 1)
    generator = np.random.default_rng(0)
    simulated = generator.multinomial(count, np.full(thinned + 1, 1.0 / (thinned + 1)), size=SIMULATIONS)
    below = simulated.cumsum(axis=1)[:, :-1]
    # Chance of so few ranks, or so many, below each place; the least of a simulation decides whether it leaves.
    possible = np.arange(count + 1)
    few, many = binom.cdf(possible, count, at[:, None]), binom.sf(possible - 1, count, at[:, None])
    rarest = np.minimum(few, many)[np.arange(thinned), below].min(axis=1)
    tail = np.quantile(rarest, 1.0 - probability, method="lower")
    low, high = binom.ppf(tail, count, at), count - binom.ppf(tail, count, 1.0 - at)
    return low / count - at, high / count - at


def assess_uniformity(
    name: str, ranks: Ranks, z: Array, thinned: int, band: tuple[Array, Array], level: float
) -> Uniformity:
    """Tests at `level` and words for the ranks and z `(count,)` of one quantity; `band` is that of `ecdf_band`.

    Raises:
        ConfigurationError: there are too few ranks.
    """
    counts = histogram(ranks, thinned)
    p = float(chisquare(counts).pvalue)
    _, difference = ecdf_difference(ranks, thinned)
    inside = bool(np.all((band[0] - ROUNDING <= difference) & (difference <= band[1] + ROUNDING)))
    shift, spread = float(np.mean(z)), float(np.std(z))
    verdict = "uniform" if p > level and inside else _deviation(shift, spread, len(z))
    return Uniformity(name, p, len(counts), inside, shift, spread, len(z), verdict)


def _deviation(shift: float, spread: float, count: int) -> str:
    words = []
    if abs(shift) > NOTABLE * spread / math.sqrt(count):
        # The truth lies above the posterior's mean where that is too low.
        words.append(f"biased {'low' if shift > 0 else 'high'} by {abs(shift):.2f} SD")
    if abs(spread - 1.0) > NOTABLE / math.sqrt(2.0 * count):
        words.append(f"too {'narrow' if spread > 1 else 'wide'}, for the truth scatters by {spread:.2f} SD")
    return f"not uniform: {'; '.join(words) or 'neither bias nor width says why'}"
