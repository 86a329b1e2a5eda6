"""Draws of K, D and M have what inducing inputs carry of a function, and the rest of its prior."""

import numpy as np
import pytest
import torch

from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.kernels.warped import evaluate
from bayes_impedance.sampling.impedance_draws import draw_impedance
from tests.sampling.small_densities import joint_density

DRAWS = 3000


@pytest.fixture(scope="module")
def before():
    """Draws of the prior, and the density."""
    density = joint_density()
    standard = np.random.default_rng(0).standard_normal((DRAWS, density.size))
    return density, draw_impedance(density, standard, density.features, seed=1)


@pytest.mark.parametrize("latent", IMPEDANCE_ORDER)
def test_the_prior_is_that_of_the_process(before, latent):
    density, found = before
    function = density.functions(density.values(torch.zeros(density.size, dtype=torch.float64)))[
        IMPEDANCE_ORDER[latent]
    ]
    logarithm = np.log(found[latent][:, 0, :, 0, 0])
    expected = function.level_sd[0].item() ** 2 * np.ones((logarithm.shape[1],) * 2)
    if function.inducing is not None:
        with torch.no_grad():
            x = density.features.inputs
            expected = expected + evaluate(function.covariance, x, x)[0, 0].numpy()
    # Of draws a covariance is good to √(2/n) of its diagonal, four times over.
    assert np.abs(np.cov(logarithm.T) - expected).max() < 4.0 * np.sqrt(2.0 / DRAWS) * expected.max()


def test_a_draw_is_one_function(before):
    _, found = before
    logarithm = np.log(found[Latent.STIFFNESS][:200, 0, :, 0, 0])
    phase = before[0].features.inputs[0, 0, :, 0].numpy()
    order = np.argsort(phase)
    steps = np.abs(np.diff(logarithm[:, order], axis=1))
    near = np.diff(phase[order]) < 0.02
    assert near.any()
    assert steps[:, near].max() < 0.2 * np.ptp(logarithm, axis=1).max()


def test_the_same_seed_gives_the_same_draws(before):
    density, _ = before
    standard = np.random.default_rng(1).standard_normal((3, density.size))
    one, two, other = (draw_impedance(density, standard, density.features, seed) for seed in (0, 0, 1))
    assert np.array_equal(one[Latent.STIFFNESS], two[Latent.STIFFNESS])
    assert not np.array_equal(one[Latent.STIFFNESS], other[Latent.STIFFNESS])
    assert np.array_equal(one[Latent.MASS], other[Latent.MASS])
