"""Guides fitted by Pyro: the Gaussian they should find, convergence told, and the reader's Pyro left alone."""

import numpy as np
import pyro
import pytest
import torch

from bayes_impedance.sampling.diagnostics import diagnose
from bayes_impedance.sampling.importance import TRUSTED_K, laplace_draws
from bayes_impedance.sampling.variational import Fitted, fit_guide, svi_draws
from tests.sampling.small_densities import joint_density, laplace
from tests.sampling.toy_densities import Toy, approximation, covariance, gaussian, settings, skewed

SIZE = 4
MEAN, COVARIANCE = np.linspace(-1.0, 1.0, SIZE), covariance(SIZE)
GUIDES = ("multivariate_normal", "low_rank")


def chosen(guide=GUIDES[0], **values):
    return settings(**{"method": "svi", "guide": guide, "steps": 400, **values})


def covariance_of(fitted):
    return fitted.start.root @ fitted.start.root.T


@pytest.mark.parametrize("guide", GUIDES)
def test_a_guide_begins_at_laplaces_approximation(guide):
    start = approximation(MEAN, COVARIANCE)
    fitted = fit_guide(gaussian(MEAN, COVARIANCE), start, chosen(guide, steps=1))
    np.testing.assert_allclose(fitted.start.point, MEAN, atol=0.1)
    scale = np.sqrt(np.outer(np.diag(COVARIANCE), np.diag(COVARIANCE)))
    np.testing.assert_allclose(covariance_of(fitted) / scale, COVARIANCE / scale, atol=0.2)


@pytest.mark.parametrize("guide", GUIDES)
def test_a_guide_finds_the_gaussian_from_somewhere_else(guide):
    """From a mean that is half an SD off and SDs of 1.3 to the true ones, in every direction of the approximation."""
    root = 1.3 * np.linalg.cholesky(COVARIANCE)
    off = approximation(MEAN + root @ np.full(SIZE, 0.5), COVARIANCE, scale=1.3)
    fitted = fit_guide(gaussian(MEAN, COVARIANCE), off, chosen(guide, steps=800))
    whitened = np.linalg.solve(np.linalg.cholesky(COVARIANCE), fitted.start.root)
    # Steps of Adam leave a spread of its rate.
    np.testing.assert_allclose(whitened @ whitened.T, np.eye(SIZE), atol=0.2)
    error = np.linalg.solve(np.linalg.cholesky(COVARIANCE), fitted.start.point - MEAN)
    assert np.abs(error).max() < 0.12
    assert fitted.remarks == () and fitted.start.outcome == "the ELBO has settled"
    assert fitted.elbo[-200:].mean() > fitted.elbo[:50].mean()


def test_a_guide_of_a_skewed_posterior_is_closer_than_laplaces_approximation():
    density, start = skewed(3, 0.6), approximation(np.zeros(3), np.eye(3))
    fitted = fit_guide(density, start, chosen(steps=800))
    # E_q of the gradient, (1 − E exp(s z))/s, vanishes at m = −½ s, where E_q of the curvature is one.
    np.testing.assert_allclose(fitted.start.point, -0.3, atol=0.12)
    np.testing.assert_allclose(covariance_of(fitted), np.eye(3), atol=0.2)
    # Laplace's lies at zero.
    assert fitted.start.point.max() < -0.15


def test_draws_are_weighted_as_those_of_laplace():
    draws = svi_draws(gaussian(MEAN, COVARIANCE), approximation(MEAN, COVARIANCE), chosen())
    assert (draws.method, draws.shape) == ("svi", (1, 1000)) and draws.pareto_k < 0.5
    assert diagnose(draws, [f"z[{i}]" for i in range(SIZE)]).is_sound
    deviation = (draws.standard[0].mean(0) - MEAN) / np.sqrt(np.diag(COVARIANCE) / 1000)
    assert np.abs(deviation).max() < 4.5


def test_steps_without_a_factor_are_skipped():
    """Failures in a corner of 2 % of the draws leave the fit as it is."""
    density = gaussian(MEAN, COVARIANCE, fails=lambda z: bool(z[0] > MEAN[0] + 2.0 * COVARIANCE[0, 0] ** 0.5))
    fitted = fit_guide(density, approximation(MEAN, COVARIANCE), chosen())
    failed = np.isnan(fitted.elbo).sum()
    assert 0 < failed < 40 and fitted.remarks == ()
    np.testing.assert_allclose(np.sqrt(np.diag(covariance_of(fitted)) / np.diag(COVARIANCE)), 1.0, atol=0.35)


def test_gradients_that_are_not_finite_are_skipped():
    def log_density(z):
        value = -0.5 * z.square().sum()
        # √0, of which the gradient is not finite.
        return value if z[0] > -1.0 else value + torch.sqrt(0.0 * z[0].square())

    fitted = fit_guide(Toy(2, log_density), approximation(np.zeros(2), np.eye(2)), chosen(steps=100))
    assert np.isnan(fitted.elbo).any()
    assert np.isfinite(fitted.start.point).all() and np.isfinite(fitted.start.root).all()


def test_a_guide_whose_steps_often_fail_says_so():
    density = gaussian(MEAN, COVARIANCE, fails=lambda z: bool(z[0] > MEAN[0]))
    draws = svi_draws(density, approximation(MEAN, COVARIANCE), chosen(steps=200))
    assert "the density was not finite at" in draws.remarks[0]
    assert (
        "of the 200 steps of the fit, which were skipped, so that the guide avoids places" in draws.remarks[0]
    )
    found = diagnose(draws, [f"z[{i}]" for i in range(SIZE)])
    assert set(draws.remarks) <= set(found.findings) and not found.is_sound


def test_a_fit_that_never_had_a_step_is_laplaces_approximation():
    start = approximation(MEAN, COVARIANCE)
    heard = []
    density = gaussian(MEAN, COVARIANCE, fails=lambda z: True)
    fitted = fit_guide(density, start, chosen(steps=50), lambda *state: heard.append(state))
    np.testing.assert_allclose(fitted.start.point, MEAN)
    np.testing.assert_allclose(covariance_of(fitted), COVARIANCE, atol=1e-10)
    assert heard == [(0, 50, 50, "the density is not finite at any draw of the guide")]
    assert len(fitted.remarks) == 2


def test_progress_tells_the_elbo():
    heard = []
    fitted = fit_guide(
        gaussian(MEAN, COVARIANCE),
        approximation(MEAN, COVARIANCE),
        chosen(steps=120),
        lambda *state: heard.append(state),
    )
    assert [state[:3] for state in heard] == [(0, 50, 120), (0, 100, 120)]
    assert heard[1][3] == f"ELBO {fitted.elbo[50:100].mean():.2f}"


@pytest.mark.parametrize(
    ("elbo", "sentence"),
    [
        (np.linspace(-50.0, 0.0, 400), "has not settled: its ELBO still rose by 13 nats in the last quarter of 400"),
        (np.linspace(-50.0, 0.0, 400), "set sampling.steps to 800"),
        (np.zeros(7), "7 steps of a fit are too few to say whether it settled; set sampling.steps to 1000 or more"),
        (
            100.0 * np.random.default_rng(0).standard_normal(2000),
            "nats from step to step, too much to say whether the fit of the guide has settled; set sampling.steps to",
        ),
    ],
)  # fmt: skip
def test_a_fit_that_has_not_settled_says_so(elbo, sentence):
    (remark,) = Fitted(approximation(MEAN, COVARIANCE), elbo).remarks
    assert sentence in remark


def test_noise_is_not_taken_for_a_rise():
    elbo = np.random.default_rng(1).standard_normal(2000)
    assert Fitted(approximation(MEAN, COVARIANCE), elbo).remarks == ()


def test_too_few_steps_to_climb_are_told():
    """Two SDs in a direction are more than 60 steps of at most .03 can go."""
    root = np.linalg.cholesky(COVARIANCE)
    far = approximation(MEAN + root @ np.full(SIZE, 2.0), COVARIANCE)
    fitted = fit_guide(gaussian(MEAN, COVARIANCE), far, chosen(steps=60))
    assert fitted.remarks == (fitted.start.outcome,)
    assert "set sampling.steps to 120" in fitted.start.outcome


@pytest.mark.parametrize("guide", GUIDES)
def test_same_seed_same_draws(guide):
    density, start = gaussian(MEAN, COVARIANCE), approximation(MEAN, COVARIANCE)
    first, second = (svi_draws(density, start, chosen(guide, steps=50)) for _ in range(2))
    np.testing.assert_array_equal(first.standard, second.standard)
    other = svi_draws(density, start, chosen(guide, steps=50, seed=4))
    assert not np.array_equal(first.standard, other.standard)


def test_parameters_and_random_numbers_of_the_reader_are_left_alone():
    with pyro.get_param_store().scope():
        mine = pyro.param("AutoMultivariateNormal.loc", torch.arange(3.0))
        torch_before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()
        threads = torch.get_num_threads()
        svi_draws(gaussian(MEAN, COVARIANCE), approximation(MEAN, COVARIANCE), chosen(steps=20))
        assert list(pyro.get_param_store().keys()) == ["AutoMultivariateNormal.loc"]
        assert torch.equal(pyro.param("AutoMultivariateNormal.loc"), mine)
        assert torch.equal(torch_before, torch.get_rng_state()) and threads == torch.get_num_threads()
        np.testing.assert_array_equal(numpy_before, np.random.get_state()[1])


def test_guide_and_laplace_agree_on_a_real_density():
    """Once weighted, both are draws of one posterior: means within Monte Carlo errors."""
    density, start = joint_density(), laplace()
    ours = laplace_draws(density, start, settings())
    fitted = svi_draws(density, start, chosen(steps=600))
    assert max(ours.pareto_k, fitted.pareto_k) < TRUSTED_K
    worth = [diagnose(draws, [str(i) for i in range(density.size)]).ess_bulk[0] for draws in (ours, fitted)]
    sd = ours.standard[0].std(0)
    difference = (ours.standard[0].mean(0) - fitted.standard[0].mean(0)) / sd
    assert np.abs(difference).max() < 4.5 * np.sqrt(1.0 / worth[0] + 1.0 / worth[1])
