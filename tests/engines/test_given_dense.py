"""Inference given impedance with dense covariances, against the moment engine and a sum over single entries."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bayes_impedance.engines.dense import log_marginal_likelihood
from bayes_impedance.engines.given_dense import DenseGivenImpedance
from bayes_impedance.engines.given_impedance import LATENTS, mean_force
from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.kernels.derivative import derivative_table
from bayes_impedance.posterior import compute_posterior
from bayes_impedance.training import observations
from tests.engines.given import NO_RESIDUAL, OVER_PHASE, OVER_TIME, given_problem

KNOWN = (
    "model.stiffness={prior: gp, level: 300, sd: 1e-9}",
    "model.damping={prior: gp, level: 20, sd: 1e-9}",
    "model.mass={level: 1.5, sd: 1e-9}",
)
OFFSET = (*OVER_TIME, "model.residual.offset_sd=0.3")


def constant(problem):
    levels = torch.tensor([300.0, 20.0, 1.5], dtype=torch.float64)
    eye = torch.eye(problem.impedance.shape[-1], dtype=torch.float64)
    return (levels[:, None, None] * eye).expand_as(problem.impedance)


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("overrides", [NO_RESIDUAL, OVER_PHASE, OFFSET])
def test_known_constant_impedance_is_the_moment_engine(overrides, coupled):
    problem = given_problem(overrides=(*overrides, *KNOWN), groups=2)
    engine = DenseGivenImpedance(problem.features, coupled)
    impedance = constant(problem)
    expected = log_marginal_likelihood(problem.model.kernel, observations(problem.model, problem.features))
    value = engine.log_likelihood_given_impedance(problem.processes, impedance)
    torch.testing.assert_close(
        value, expected.sum(0, keepdim=True) if coupled else expected, rtol=1e-9, atol=0
    )
    moments = compute_posterior(problem.model, problem.log, problem.features, problem.features, 0.0)
    found = engine.posterior(problem.processes, impedance, problem.features, impedance)
    noise = problem.model.noise_variance.detach().numpy()[:, 0, 0]
    for latent in LATENTS:
        mean, variance = (_rows(problem.features, part) for part in found[latent])
        np.testing.assert_allclose(mean, moments[latent].mean, rtol=1e-6, atol=1e-8)
        extra = noise if latent.value == "force" else 0.0
        np.testing.assert_allclose(variance + extra, moments[latent].sd ** 2, rtol=1e-6, atol=1e-12)


def _rows(features, values):
    return np.concatenate(
        [values[:, g, : len(rows)].detach().numpy().T for g, rows in enumerate(features.rows)]
    )


@torch.no_grad()
def test_coupled_force_is_the_product_of_matrices_and_derivatives():
    problem = given_problem(repetitions=2, rate=4.0)
    x = problem.features.inputs
    axes, _, n = x.shape[:3]
    kernel = problem.model.kernel.impedance
    path = kernel.layout.path(x)
    common, table = derivative_table(kernel.trajectory, path, path)
    noise = problem.processes.noise_variance
    covariance = np.zeros((axes * n, axes * n))
    for a in range(axes):
        for b in range(axes):
            for s in range(n):
                for t in range(n):
                    total = 0.0
                    for i in range(3):
                        for j in range(3):
                            for c in range(axes):
                                w = problem.impedance[0, s, i, a, c] * problem.impedance[0, t, j, b, c]
                                entry = common * table[i][j]
                                total += float(w * entry.expand(axes, 1, n, n)[c, 0, s, t])
                    covariance[a * n + s, b * n + t] = total + float(noise[a]) * (a == b and s == t)
    mean = mean_force(kernel.layout, problem.features, problem.impedance)
    residual = (problem.features.force - mean)[:, 0].reshape(-1).numpy()
    expected = -0.5 * (
        residual @ np.linalg.solve(covariance, residual)
        + np.linalg.slogdet(covariance)[1]
        + axes * n * np.log(2.0 * np.pi)
    )
    engine = DenseGivenImpedance(problem.features, coupled=True)
    value = engine.log_likelihood_given_impedance(problem.processes, problem.impedance)
    np.testing.assert_allclose(float(value), expected, rtol=1e-10)


def test_indefinite_covariance_is_refused():
    problem = given_problem()
    processes = replace(problem.processes, noise_variance=-problem.processes.noise_variance)
    with pytest.raises(NotPositiveDefiniteError, match="forces given impedance is not positive definite"):
        DenseGivenImpedance(problem.features, False).log_likelihood_given_impedance(
            processes, problem.impedance
        )
