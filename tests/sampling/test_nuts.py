"""One chain of NUTS: moments that are known, what it notes of its draws, failures, and a state to go on from."""

import numpy as np
import pytest
import torch
from arviz_stats.base import array_stats
from pyro.infer.mcmc.adaptation import BlockMassMatrix
from toys import Funnel, Gaussian, start

from bayes_impedance.config import SamplingConfig
from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.sampling.kernel import BLOCK, WEIGHT, ShrunkMassMatrix
from bayes_impedance.sampling.nuts import STATISTICS, Chain, seed_of

SHORT = SamplingConfig(warmup=60, draws=30)


def drawn(density, settings, number=0, begin=None):
    chain = Chain(density, begin or start(), settings, number)
    while chain.done < chain.total:
        chain.advance()
    return chain


def assert_means(draws, expected, sd):
    """Within four standard errors, by the effective size of the sample."""
    for values, mean, own in zip(draws.T, expected, sd, strict=True):
        error = own / np.sqrt(float(array_stats.ess(values[None])))
        assert abs(values.mean() - mean) < 4.0 * error


@pytest.fixture(scope="module")
def gaussian():
    return drawn(Gaussian(), SamplingConfig(warmup=150, draws=400))


@pytest.fixture(scope="module")
def whole():
    return drawn(Gaussian(), SHORT)


def test_moments_of_a_gaussian(gaussian):
    mean, covariance = Gaussian.mean.numpy(), Gaussian.covariance.numpy()
    assert_means(gaussian.standard, mean, np.sqrt(np.diag(covariance)))
    away = gaussian.standard - mean
    # The variance of (x−μ)² is 2σ⁴.
    assert_means(away**2, np.diag(covariance), np.sqrt(2.0) * np.diag(covariance))
    spread = np.sqrt(covariance[0, 0] * covariance[1, 1] + covariance[0, 1] ** 2)
    assert_means(away[:, :1] * away[:, 1:2], [covariance[0, 1]], [spread])


def test_moments_of_a_funnel_from_a_start_that_is_off():
    chain = drawn(Funnel(), SamplingConfig(warmup=200, draws=500), begin=start(at=0.5, scale=0.6))
    assert_means(chain.standard[:, :1], [0.0], [1.0])
    # Scaled by what their width is given v, the others are standard normal.
    assert_means(chain.standard[:, 1:] * np.exp(-0.5 * chain.standard[:, :1]), [0.0, 0.0], [1.0, 1.0])


def test_what_is_noted_of_draws(gaussian):
    stats = gaussian.stats
    assert {name: values.dtype.type for name, values in stats.items()} == STATISTICS
    density = Gaussian()
    expected = [density.joint(point)[0] for point in gaussian.standard]
    np.testing.assert_allclose(stats["lp"], expected, rtol=0, atol=1e-12)
    assert not stats["diverging"].any()
    assert ((stats["acceptance_rate"] > 0) & (stats["acceptance_rate"] <= 1)).all()
    # A warm-up this short aims at .8 and ends somewhere near.
    assert stats["acceptance_rate"].mean() > 0.6
    assert len(set(stats["step_size"])) == 1
    # Momentum of three coordinates: kinetic energy ½ χ²(3), with mean 1.5 and SD √1.5, before each move.
    kinetic = stats["energy"][1:] + stats["lp"][:-1]
    assert (kinetic > 0).all()
    assert abs(kinetic.mean() - 1.5) < 4.0 * np.sqrt(1.5 / len(kinetic))
    assert gaussian.line == f"step size {stats['step_size'][0]:.2g}, 0 divergences"


def test_gradients_are_counted():
    density = Gaussian()
    chain = Chain(density, start(), SHORT, 0)
    while chain.done < chain.total:
        before = density.evaluations
        chain.advance()
        draw = chain.done - chain.warmup - 1
        if draw >= 0:
            assert chain.stats["n_steps"][draw] == density.evaluations - before


def test_failure_is_a_divergence():
    # The edge cuts the Gaussian at its mean: half of the trajectories run into it.
    chain = drawn(Gaussian(edge=1.0), SamplingConfig(warmup=100, draws=100), begin=start(at=-1.0))
    assert chain.stats["diverging"].sum() > 10
    assert chain.standard[:, 0].max() <= 1.0
    assert np.isfinite(chain.stats["lp"]).all()
    assert "divergences" in chain.line


def test_start_falls_back_to_the_mode():
    narrow = Gaussian(edge=1e-9)
    chain = Chain(narrow, start(at=0.0, scale=100.0), SHORT, 0)
    chain.advance()
    assert chain.done == 1 and chain.line.startswith("warm-up, step size")
    with pytest.raises(NotPositiveDefiniteError, match="beyond the edge"):
        Chain(Gaussian(edge=-1.0), start(scale=1e-3), SHORT, 0)


def test_same_seed_same_draws(whole):
    assert (drawn(Gaussian(), SHORT).standard == whole.standard).all()
    others = drawn(Gaussian(), SHORT, number=1), drawn(Gaussian(), SHORT.model_copy(update={"seed": 1}))
    assert all((whole.standard != other.standard).any() for other in others)
    assert len({seed_of(seed, number) for seed in range(20) for number in range(20)}) == 400


def test_random_numbers_of_others_are_left_alone():
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    drawn(Gaussian(), SamplingConfig(warmup=20, draws=1))
    assert (torch.rand(3) == expected).all()
    # And ours do not depend on theirs.
    torch.manual_seed(6)
    once = drawn(Gaussian(), SamplingConfig(warmup=20, draws=3)).standard
    torch.manual_seed(7)
    assert (drawn(Gaussian(), SamplingConfig(warmup=20, draws=3)).standard == once).all()


# The covariance is taken at iteration 53, and the warm-up ends with 60.
@pytest.mark.parametrize("stop", [0, 30, 52, 53, 54, 60, 75, 90])
def test_a_state_goes_on_to_the_same_bits(whole, stop):
    chain = Chain(Gaussian(), start(), SHORT, 0)
    while chain.done < stop:
        chain.advance()
    # The start that a later run finds may differ in its last bits: that of the state counts.
    rest = Chain(Gaussian(), start(at=0.1), SHORT, 0, chain.state())
    assert rest.done == stop
    while rest.done < rest.total:
        rest.advance()
    assert (rest.standard == whole.standard).all()
    for name, values in rest.stats.items():
        assert (values == whole.stats[name]).all()


def adapted(matrix, draws):
    matrix.configure({BLOCK: (22, 22)}, options={"dtype": torch.float64})
    for draw in draws:
        matrix.update({"y": draw}, None)
    matrix.end_adaptation()
    return matrix.inverse_mass_matrix[BLOCK]


def test_covariance_is_shrunk_towards_the_identity():
    generator = torch.Generator().manual_seed(0)
    draws = torch.randn(25, 22, generator=generator, dtype=torch.float64)
    own = adapted(ShrunkMassMatrix(), draws)
    weight = WEIGHT * 22
    expected = (25 * torch.cov(draws.T) + weight * torch.eye(22, dtype=torch.float64)) / (25 + weight)
    torch.testing.assert_close(own, expected)
    # The length of a trajectory in steps grows with the root of the condition number: the truth has one.
    assert torch.linalg.cond(own) < 2.0
    assert torch.linalg.cond(adapted(BlockMassMatrix(), draws)) > 100.0
