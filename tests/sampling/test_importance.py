"""Pareto-smoothed importance sampling: exact moments, k that tells good approximations from bad ones."""

import math

import numpy as np
import pytest
import torch
from scipy.special import digamma, polygamma
from scipy.stats import multivariate_t

from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.sampling.importance import (
    DEGREES,
    PROPOSALS,
    TRUSTED_K,
    approximate_draws,
    laplace_draws,
    log_densities,
    log_t,
    proposals,
    smoothed,
    systematic,
    weigh,
)
from tests.sampling.toy_densities import Toy, approximation, covariance, gaussian, settings, skewed

SIZE = 5
MEAN, COVARIANCE = np.linspace(-1.0, 1.0, SIZE), covariance(SIZE)


def effective(draws):
    """What draws with copies are worth."""
    _, copies = np.unique(draws.standard[0], axis=0, return_counts=True)
    return copies.sum() ** 2 / np.square(copies).sum()


def test_draws_of_a_gaussian_have_its_moments_and_a_small_k():
    density = gaussian(MEAN, COVARIANCE)
    draws = laplace_draws(density, approximation(MEAN, COVARIANCE), settings(draws=2000))
    assert (draws.method, draws.shape, draws.lost, draws.remarks) == ("laplace", (1, 4000), (), ())
    assert draws.pareto_k < 0.3
    sample, n = draws.standard[0], effective(draws)
    deviation = (sample.mean(0) - MEAN) / np.sqrt(np.diag(COVARIANCE) / n)
    assert np.abs(deviation).max() < 4.0
    scale = np.sqrt(np.outer(np.diag(COVARIANCE), np.diag(COVARIANCE)) * 2.0 / n)
    assert np.abs((np.cov(sample.T) - COVARIANCE) / scale).max() < 4.5
    assert draws.stats["lp"][0, 7] == pytest.approx(float(density.log_density(torch.from_numpy(sample[7]))))


def test_weights_put_skewness_right():
    """Moments of log gamma variables are polygamma functions; those of Laplace's approximation are not."""
    log_sd, n = 0.6, 20_000
    shape = 1.0 / log_sd**2
    # Mode at 0 and unit curvature there.
    draws = laplace_draws(skewed(2, log_sd), approximation(np.zeros(2), np.eye(2)), settings(draws=n // 2))
    mean = (digamma(shape) - math.log(shape)) / log_sd
    variance = polygamma(1, shape) / log_sd**2
    assert draws.pareto_k < TRUSTED_K
    error = np.sqrt(variance / effective(draws))
    assert np.abs(draws.standard[0].mean(0) - mean).max() < 4.0 * error
    assert abs(mean) > 8.0 * error


def test_an_approximation_of_half_the_sd_is_found_out():
    density = gaussian(MEAN, COVARIANCE)
    narrow = approximation(MEAN, COVARIANCE, scale=0.5)
    draws = laplace_draws(density, narrow, settings())
    assert draws.pareto_k > TRUSTED_K
    # It stays what it was, so that nobody takes half-corrected draws for either.
    sd = 0.5 * np.sqrt(np.diag(COVARIANCE))
    assert np.abs(draws.standard[0].std(0) / sd - 1.0).max() < 5.0 / np.sqrt(2 * effective(draws))
    assert density.evaluations == 3 * PROPOSALS


def test_a_wide_approximation_is_corrected():
    density = gaussian(MEAN, COVARIANCE)
    wide = laplace_draws(density, approximation(MEAN, COVARIANCE, scale=1.3), settings(draws=1000))
    assert wide.pareto_k < 0.5
    ratio = wide.standard[0].std(0) / np.sqrt(np.diag(COVARIANCE))
    assert np.abs(ratio - 1.0).max() < 5.0 / np.sqrt(2 * effective(wide))


def test_more_proposals_are_made_where_weights_are_uneven_and_never_more_than_four_times_the_draws():
    even, uneven = gaussian(MEAN, COVARIANCE), gaussian(MEAN, COVARIANCE)
    laplace_draws(even, approximation(MEAN, COVARIANCE), settings(draws=500))
    draws = laplace_draws(uneven, approximation(MEAN, COVARIANCE, scale=2.2), settings(draws=500))
    assert even.evaluations == PROPOSALS < uneven.evaluations <= 4 * 1000
    assert draws.pareto_k < TRUSTED_K


def test_places_without_a_finite_density_have_no_weight():
    """A Gaussian cut at its mean by failures, and by NaN and −∞ in an eighth each: draws are half normal."""

    def log_density(z):
        if z[1] < 0:
            return torch.tensor(torch.nan if z[2] < 0 else -torch.inf, dtype=torch.float64)
        return -0.5 * z.square().sum()

    density = Toy(3, log_density, fails=lambda z: bool(z[0] < 0))
    draws = laplace_draws(density, approximation(np.zeros(3), np.eye(3)), settings(draws=1000))
    sample = draws.standard[0]
    assert sample[:, :2].min() >= 0.0 and np.isfinite(draws.stats["lp"]).all()
    error = np.sqrt((1.0 - 2.0 / np.pi) / effective(draws))
    assert np.abs(sample[:, :2].mean(0) - np.sqrt(2.0 / np.pi)).max() < 4.0 * error


def test_an_approximation_beside_the_posterior_is_refused():
    density = gaussian(MEAN, COVARIANCE, fails=lambda z: True)
    with pytest.raises(
        NotPositiveDefiniteError, match="expected a posterior density that is finite about its mode"
    ):
        laplace_draws(density, approximation(MEAN, COVARIANCE), settings())


def test_density_overflowing_somewhere_gives_no_number_but_minus_infinity():
    density = gaussian(MEAN, COVARIANCE, fails=lambda z: bool(z[0] > 0))
    heard = []
    points = np.random.default_rng(0).standard_normal((200, SIZE))
    values = log_densities(density, points, lambda *state: heard.append(state))
    assert np.array_equal(np.isneginf(values), points[:, 0] > 0)
    assert [state[1:3] for state in heard] == [(100, 200), (200, 200)]


def test_smoothed_weights_keep_their_order_and_sum_to_one():
    ratios = np.random.default_rng(1).standard_normal(500)
    log_weights, k = smoothed(ratios)
    assert np.exp(log_weights).sum() == pytest.approx(1.0)
    assert np.all(np.diff(log_weights[np.argsort(ratios)]) >= -1e-12)
    shifted, same = smoothed(ratios + 1e4)
    np.testing.assert_allclose(shifted, log_weights, atol=1e-8)
    assert same == pytest.approx(k)


@pytest.mark.parametrize("shape", [0.2, 0.5, 1.0])
def test_k_is_the_shape_of_a_pareto_tail(shape):
    """Over 20 sets of Pareto ratios; the library's prior draws k towards .5 with the weight of ten of 300."""
    generator = np.random.default_rng(2)
    found = [smoothed(-shape * np.log(generator.random(10_000)))[1] for _ in range(20)]
    expected = (300 * shape + 10 * 0.5) / 310
    assert np.mean(found) == pytest.approx(expected, abs=4 * (1 + shape) / np.sqrt(300 * 20))


def test_ratios_that_are_all_alike_have_no_tail():
    log_weights, k = smoothed(np.full(300, 7.0))
    assert k == 0.0
    np.testing.assert_allclose(log_weights, -np.log(300))


@pytest.mark.parametrize("spread", [1e2, 1e3, 1e5])
def test_ratios_of_any_spread_have_a_finite_k_that_says_no(spread):
    log_weights, k = smoothed(spread * np.random.default_rng(3).standard_normal(1000))
    assert np.isfinite(k) and k > TRUSTED_K
    assert np.exp(log_weights).sum() == pytest.approx(1.0)


def test_effective_number_is_that_of_the_weights():
    values = np.concatenate([np.zeros(200), np.full(100, -np.inf)])
    weighted = weigh(np.zeros((300, 1)), values, np.zeros(300))
    assert weighted.effective == pytest.approx(200.0)


def test_systematic_resampling_takes_each_as_often_as_expected():
    weights = np.random.default_rng(4).dirichlet(np.ones(50))
    chosen = systematic(np.log(weights), 1000, np.random.default_rng(5))
    counts = np.bincount(chosen, minlength=50)
    assert np.abs(counts - 1000 * weights).max() < 1.0
    assert not np.all(np.diff(chosen) >= 0)


def test_proposals_are_those_of_a_multivariate_t():
    steps = proposals(500, SIZE, np.random.default_rng(6))
    oracle = multivariate_t(np.zeros(SIZE), np.eye(SIZE), df=DEGREES).logpdf(steps)
    difference = log_t(steps) - oracle
    np.testing.assert_allclose(difference, difference[0], atol=1e-10)


def test_same_seed_same_draws():
    density, start = gaussian(MEAN, COVARIANCE), approximation(MEAN, COVARIANCE, scale=1.1)
    first, second = (laplace_draws(density, start, settings()) for _ in range(2))
    np.testing.assert_array_equal(first.standard, second.standard)
    other = laplace_draws(density, start, settings(seed=4))
    assert not np.array_equal(first.standard, other.standard)


def test_global_random_state_is_left_alone():
    before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()
    laplace_draws(gaussian(MEAN, COVARIANCE), approximation(MEAN, COVARIANCE), settings())
    assert torch.equal(before, torch.get_rng_state())
    np.testing.assert_array_equal(numpy_before, np.random.get_state()[1])


def test_remarks_are_handed_on():
    draws = approximate_draws(
        "svi",
        gaussian(MEAN, COVARIANCE),
        approximation(MEAN, COVARIANCE),
        settings(),
        remarks=("not settled",),
    )
    assert (draws.method, draws.remarks) == ("svi", ("not settled",))
