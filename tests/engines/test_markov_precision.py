"""The Markov engine against extended precision, over steps from 1e-6 to 10 and up to a hundred thousand samples."""

import numpy as np
import pytest

from bayes_impedance.engines.given_dense import DenseGivenImpedance
from bayes_impedance.engines.markov import MarkovEngine
from bayes_impedance.kernels.impedance import Latent
from benchmarks.problems import scalar_problem
from tests.engines.extended import Chain, filtered, solved

pytestmark = pytest.mark.skipif(
    np.finfo(np.longdouble).eps > 1e-18, reason="no extended precision on this machine"
)
STEPS = (1e-6, 1e-3, 0.1, 1.0, 10.0)


def markov(problem):
    return MarkovEngine(problem.features, problem.processes, False)


@pytest.mark.parametrize(("n", "step"), [(100_000, 1e-4), (2000, 1e-6), (2000, 1e-3), (2000, 10.0)])
def test_filter_keeps_ten_digits(n, step):
    problem = scalar_problem(n, step)
    value = markov(problem).log_likelihood_given_impedance(problem.processes, problem.impedance)
    expected = filtered(Chain.of(problem))
    assert abs(value.item() - expected) < 1e-10 * abs(expected)


@pytest.mark.parametrize("step", STEPS)
def test_nearer_to_the_truth_than_the_dense_engine_needs_to_be(step):
    """Value, and posterior of x_d, by covariances in extended precision; the dense engine is within 1e-8."""
    problem = scalar_problem(80, step)
    chain = Chain.of(problem)
    kernel = problem.processes.trajectory
    x = problem.features.inputs[0, 0].numpy().astype(np.longdouble)
    rate = np.sqrt(np.longdouble(5)) / np.longdouble(kernel.lengthscale.item())
    total, mean, covariance = solved(chain, rate * x[:, 0])
    np.testing.assert_allclose(float(filtered(chain) / total), 1.0, rtol=1e-13)
    sd = kernel.sd.item()
    # x_d, ẋ_d = θ̇ f', ẍ_d = θ̈ f' + θ̇² f'' of the state (f, f'/λ, f''/λ²)/σ
    zero, one, velocity, acceleration = np.zeros(80), np.ones(80), x[:, 1], x[:, 2]
    rows = {
        Latent.DESIRED_POSITION: (one, zero, zero),
        Latent.DESIRED_VELOCITY: (zero, rate * velocity, zero),
        Latent.DESIRED_ACCELERATION: (zero, rate * acceleration, rate**2 * velocity**2),
    }
    for engine, tolerance in ((markov(problem), 1e-10), (DenseGivenImpedance(problem.features, False), 1e-8)):
        value = engine.log_likelihood_given_impedance(problem.processes, problem.impedance)
        assert abs(value.item() - total) < tolerance * abs(total)
        found = engine.posterior(problem.processes, problem.impedance, problem.features, problem.impedance)
        for latent, columns in rows.items():
            row = sd * np.stack(columns, axis=-1)
            scale = np.sqrt((row**2).sum(-1)).astype(float)
            location, variance = (part[0, 0].numpy() for part in found[latent])
            assert np.max(np.abs(location - (row * mean).sum(-1)) / scale) < tolerance
            expected = np.einsum("ni,nij,nj->n", row, covariance, row)
            assert np.max(np.abs(variance - expected) / np.maximum(expected, 1e-3 * scale**2)) < tolerance


@pytest.mark.parametrize("step", STEPS)
def test_gradient_is_the_slope_in_extended_precision(step):
    """Central differences of the filter in extended precision, whose rounding and truncation are below 1e-9."""
    problem = scalar_problem(500, step)
    kernel = problem.processes.trajectory
    noise = problem.processes.noise_variance
    value = markov(problem).log_likelihood_given_impedance(problem.processes, problem.impedance)
    value.sum().backward()
    figures = {
        "sd": (kernel.sd.item(), kernel.raw_sd.grad.item()),
        "lengthscale": (kernel.lengthscale.item(), kernel.raw_lengthscale.grad.item()),
        "noise": (noise.item(), noise.grad.item() * noise.item()),
    }
    width = np.longdouble(1e-5)
    for name, (at, slope) in figures.items():
        # Gradients are by the logarithm.
        ends = [filtered(Chain.of(problem, **{name: at * np.exp(sign * width)})) for sign in (1, -1)]
        expected = float((ends[0] - ends[1]) / (2 * width))
        np.testing.assert_allclose(slope, expected, rtol=1e-7, atol=1e-7)
