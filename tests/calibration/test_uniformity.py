"""Tests of uniform ranks: how often they raise a false alarm, and what they say of ranks that are not uniform."""

import numpy as np
import pytest
from scipy.stats import binom, norm

from bayes_impedance.calibration.uniformity import (
    assess_uniformity,
    bins_for,
    ecdf_band,
    ecdf_difference,
    histogram,
    histogram_band,
)
from bayes_impedance.errors import ConfigurationError

THINNED, COUNT = 99, 200


def gaussian_ranks(shift: float, spread: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Ranks and z of truths N(shift, spread²) among draws of a posterior N(0, 1)."""
    generator = np.random.default_rng(seed)
    truth = shift + spread * generator.standard_normal(COUNT)
    return generator.binomial(THINNED, norm.cdf(truth)), truth


def assess(shift: float, spread: float, seed: int = 0, level: float = 1e-3):
    ranks, z = gaussian_ranks(shift, spread, seed)
    return assess_uniformity("k", ranks, z, THINNED, ecdf_band(COUNT, THINNED, 1.0 - level), level)


def test_band_holds_uniform_ranks_as_often_as_it_says() -> None:
    low, high = ecdf_band(COUNT, THINNED, 0.9)
    generator = np.random.default_rng(1)
    inside = []
    for _ in range(1000):
        _, difference = ecdf_difference(generator.integers(0, THINNED + 1, COUNT), THINNED)
        inside.append(np.all((low - 1e-12 <= difference) & (difference <= high + 1e-12)))
    # Counts are whole: the band holds at least so often, and hardly oftener.
    assert 0.9 - 4.0 * np.sqrt(0.09 / 1000) < np.mean(inside) < 0.95


def test_ecdf_difference_counts() -> None:
    ranks = np.array([0, 0, 3, 9])
    at, difference = ecdf_difference(ranks, 9)
    assert [np.mean(ranks < k) - k / 10 for k in range(1, 10)] == pytest.approx(difference.tolist())
    assert at.tolist() == pytest.approx([k / 10 for k in range(1, 10)])


def test_histogram_covers_every_rank_once() -> None:
    counts = histogram(np.arange(100).repeat(2), 99)
    assert counts.tolist() == [10] * 20
    low, high = histogram_band(200, 20)
    assert binom.cdf(low - 1, 200, 0.05) < 0.005 < binom.cdf(low, 200, 0.05)
    assert binom.sf(high, 200, 0.05) < 0.005 < binom.sf(high - 1, 200, 0.05)


def test_uniform_ranks_pass() -> None:
    alarms = [assess(0.0, 1.0, seed).verdict != "uniform" for seed in range(20)]
    assert sum(alarms) == 0


@pytest.mark.parametrize(
    ("shift", "spread", "words"),
    [
        (0.5, 1.0, "not uniform: biased low by 0."),
        (-0.5, 1.0, "not uniform: biased high by 0."),
        (0.0, 1.6, "not uniform: too narrow, for the truth scatters by 1."),
        (0.0, 0.5, "not uniform: too wide, for the truth scatters by 0."),
    ],
)
def test_deviations_are_put_into_words(shift: float, spread: float, words: str) -> None:
    found = assess(shift, spread)
    assert found.verdict.startswith(words) and ";" not in found.verdict
    assert not found.inside and found.p < 1e-3


def test_what_z_does_not_explain_is_said_too() -> None:
    ranks = np.full(COUNT, 50)
    z = np.random.default_rng(0).standard_normal(COUNT)
    found = assess_uniformity("k", ranks, z, THINNED, ecdf_band(COUNT, THINNED), 0.01)
    assert found.verdict == "not uniform: neither bias nor width says why"


def test_ranks_that_cannot_be_tested_are_refused() -> None:
    with pytest.raises(
        ConfigurationError, match="draws with a posterior, for a test of uniform ranks, found 19"
    ):
        bins_for(19, 99)
    with pytest.raises(
        ConfigurationError, match="expected ranks that can be put into 2 to 20 equal bins, got 101"
    ):
        bins_for(200, 100)
