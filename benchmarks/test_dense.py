"""Value and gradient of the dense marginal likelihood beside a gpytorch exact GP, n = 2 000."""

from __future__ import annotations

import subprocess
import sys

import gpytorch
import pytest
import torch

from bayes_impedance.engines.dense import Observations, log_marginal_likelihood
from benchmarks.paired import paired
from benchmarks.problems import XI, PlainGP, force, inputs, interaction_kernel

N = 2000

MEMORY = """
import resource
from benchmarks.test_dense import impedance_step
step = impedance_step()
for _ in range(2):
    step()
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def impedance_step():
    kernel, x, u = interaction_kernel(), inputs(N), force(N)
    noise = torch.tensor([0.3], dtype=torch.float64, requires_grad=True)

    def step() -> float:
        value = log_marginal_likelihood(kernel, Observations(x, u, noise**2), 1e-10)
        value.backward()
        return value.item()

    return step


def plain_step():
    x, u = inputs(N)[:, list(XI)], force(N)
    model = PlainGP(x, u).train()
    likelihood = gpytorch.mlls.ExactMarginalLogLikelihood(model.likelihood, model)

    def step() -> float:
        with gpytorch.settings.fast_computations(
            covar_root_decomposition=False, log_prob=False, solves=False
        ):
            value = likelihood(model(x), u)
            value.backward()
        return value.item()

    return step


@pytest.mark.benchmark(group="marginal likelihood, value and gradient, n = 2000")
def test_value_and_gradient(benchmark, figures):
    ours = impedance_step()
    figures["dense_value_and_gradient_n2000_over_gpytorch_cholesky"] = paired(ours, plain_step(), rounds=9)
    benchmark.pedantic(ours, rounds=3)


def test_peak_memory_of_the_process(figures):
    result = subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True)
    figures["dense_value_and_gradient_n2000_memory"] = {"gigabytes": int(result.stdout) * 1024 / 1e9}
