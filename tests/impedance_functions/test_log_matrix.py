"""The law of a matrix by the Gaussian of its logarithm, against Monte Carlo."""

import numpy as np
import pytest
from scipy.linalg import expm, logm

from bayes_impedance.impedance_functions.log_matrix import LogMatrix
from bayes_impedance.impedance_functions.symmetric import entries


def law(axes, coupled, spread):
    places = entries(axes, coupled)
    generator = np.random.default_rng(axes)
    location = 0.5 * generator.standard_normal((3, len(places)))
    location[:, :axes] += np.log(200.0)
    root = generator.standard_normal((3, len(places), len(places)))
    covariance = spread**2 * (root @ root.transpose(0, 2, 1) / len(places) + 0.1 * np.eye(len(places)))
    return LogMatrix(places, location, covariance, location + 1.0, 4.0 * covariance)


def logarithms(one, prior=False):
    """The location as symmetric matrices."""
    location = one.prior_location if prior else one.location
    result = np.zeros((len(location), one.axes, one.axes))
    for e, (a, b) in enumerate(one.places):
        result[:, a, b] = result[:, b, a] = location[:, e]
    return result


@pytest.mark.parametrize("prior", [False, True])
@pytest.mark.parametrize(("axes", "coupled"), [(1, False), (2, False), (2, True), (3, True)])
def test_matrix_and_variance_are_monte_carlos(axes, coupled, prior):
    one = law(axes, coupled, 0.01)
    expected = np.stack([expm(s) for s in logarithms(one, prior)])
    np.testing.assert_allclose(one.matrix(prior), expected, rtol=1e-11, atol=1e-10)
    draws = one.draw(20_000, np.random.default_rng(1), prior)
    assert draws.shape == (20_000, 3, axes, axes)
    sd = draws.std(axis=0)
    where = np.ones((axes, axes), dtype=bool) if coupled else np.eye(axes, dtype=bool)
    # Means within four standard errors and what is second order in the spread.
    error = np.abs(draws.mean(axis=0) - expected)[:, where]
    assert (error < 4.0 * sd[:, where] / np.sqrt(20_000) + 1e-3 * expected.max()).all()
    np.testing.assert_allclose(np.sqrt(one.variance(prior))[:, where], sd[:, where], rtol=0.05)
    assert (one.variance(prior)[:, ~where] == 0.0).all()


@pytest.mark.parametrize("coupled", [False, True])
def test_draws_are_of_the_gaussian_of_the_logarithm(coupled):
    one = law(2, coupled, 0.3)
    drawn = one.draw(1000, np.random.default_rng(2))[:, 0]
    found = np.stack([logm(w)[tuple(np.transpose(one.places))] for w in drawn]).real
    errors = np.sqrt(np.diag(one.covariance[0]) / 1000)
    assert (np.abs(found.mean(axis=0) - one.location[0]) < 4.0 * errors).all()
    scale = np.sqrt(np.diag(one.covariance[0]))
    # Of 1000 draws a covariance is good to 1/√1000 = 3 %.
    np.testing.assert_allclose(
        np.cov(found.T) / np.outer(scale, scale), one.covariance[0] / np.outer(scale, scale), atol=0.13
    )


def test_marginals_of_entries():
    one = law(3, True, 0.05)
    location, scale = one.diagonal()
    np.testing.assert_allclose(np.exp(location), one.matrix().diagonal(axis1=1, axis2=2), rtol=1e-12)
    variance = one.variance().diagonal(axis1=1, axis2=2)
    np.testing.assert_allclose(np.exp(location) * scale, np.sqrt(variance), rtol=1e-12)
    mean, sd = one.beside(prior=True)
    for p, (a, b) in enumerate([(0, 1), (0, 2), (1, 2)]):
        np.testing.assert_array_equal(mean[:, p], one.matrix(prior=True)[:, a, b])
        np.testing.assert_allclose(sd[:, p], np.sqrt(one.variance(prior=True)[:, a, b]), rtol=1e-12)


def test_independent_axes_are_log_normal_exactly():
    one = law(2, False, 0.4)
    assert not one.is_coupled
    location, scale = one.diagonal()
    np.testing.assert_allclose(location, one.location, rtol=1e-12)
    np.testing.assert_allclose(scale, np.sqrt(one.covariance.diagonal(axis1=1, axis2=2)), rtol=1e-10)
