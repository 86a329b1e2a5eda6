"""Inference given impedance by the Markov engine: how time and memory grow, beside tinygp and the dense engine."""

from __future__ import annotations

import gc
import math
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch

from bayes_impedance.engines.given_dense import DenseGivenImpedance
from bayes_impedance.engines.given_impedance import ConditionalEngine
from bayes_impedance.engines.markov import MarkovEngine
from benchmarks.paired import paired
from benchmarks.problems import ScalarProblem, scalar_problem

SIZES = (10_000, 100_000, 1_000_000)
#: λΔ of neighbours.
STEP = 1e-3
#: Number of states → axes, which couple, and whether there is a residual.
STATES = {3: (1, False), 5: (1, True), 6: (2, False), 10: (2, True)}

MEMORY = """
from pathlib import Path
from benchmarks.test_markov import STEP, SIZES, markov, value_and_gradient
from benchmarks.problems import scalar_problem
def peak():
    # Not ru_maxrss, which starts at what the parent of this process held.
    return Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]
small = scalar_problem(10, STEP)
value_and_gradient(markov(small), small)()
print(peak())
problem = scalar_problem(SIZES[-1], STEP)
print(peak())
step = value_and_gradient(markov(problem), problem)
for _ in range(2):
    step()
print(peak())
"""


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """The filter runs on one; a second thread for what is around it only waits where the machine has other work."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def markov(problem: ScalarProblem) -> MarkovEngine:
    return MarkovEngine(problem.features, problem.processes, problem.features.inputs.shape[0] > 1)


def value_and_gradient(engine: ConditionalEngine, problem: ScalarProblem) -> Callable[[], float]:
    parameters = [*problem.processes.trajectory.parameters(), problem.processes.noise_variance]
    for term in problem.processes.residual:
        parameters += term.parameters()

    def step() -> float:
        for parameter in (*parameters, problem.impedance):
            parameter.grad = None
        value = engine.log_likelihood_given_impedance(problem.processes, problem.impedance).sum()
        value.backward()
        return value.item()

    return step


def seconds(step: Callable[[], object], rounds: int) -> float:
    """Of the fastest of some calls: what else the machine does only adds."""
    step()
    gc.collect()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        step()
        times.append(time.perf_counter() - start)
    return min(times)


def test_time_grows_with_the_samples(figures):
    times = []
    for n, rounds in zip(SIZES, (40, 15, 5), strict=True):
        problem = scalar_problem(n, STEP)
        times.append(seconds(value_and_gradient(markov(problem), problem), rounds))
    slope = np.polyfit(np.log(SIZES), np.log(times), 1)[0]
    named = {f"n{n}_seconds": value for n, value in zip(SIZES, times, strict=True)}
    figures["markov_value_and_gradient"] = named | {"slope_of_logarithms": float(slope)}


def test_peak_memory_of_a_million_samples(figures):
    """Of a process, above what imports and compiled code take; and what the samples themselves add to that."""
    printed = subprocess.run(
        [sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True
    ).stdout
    imports, samples, peak = (int(line) * 1024 / 1e9 for line in printed.split())
    figures["markov_value_and_gradient_n1000000_memory"] = {
        "gigabytes": peak - imports,
        "of_which_inputs_gigabytes": samples - imports,
        "imports_gigabytes": imports,
    }


@pytest.mark.parametrize("states", STATES)
def test_time_by_states(benchmark, figures, states):
    axes, residual = STATES[states]
    problem = scalar_problem(100_000, STEP, axes, residual)
    step = value_and_gradient(markov(problem), problem)
    figures[f"markov_value_and_gradient_n100000_{states}_states"] = {"seconds": seconds(step, 9)}
    benchmark.pedantic(step, rounds=3)


def test_beside_tinygp(figures):
    """Value and gradient of n = 100 000 forces against those of as many plain observations of a Matérn-5/2 process."""
    jax = pytest.importorskip("jax")
    tinygp = pytest.importorskip("tinygp")
    jax.config.update("jax_enable_x64", True)
    problem = scalar_problem(100_000, STEP)
    theta = problem.features.inputs[0, 0, :, 0].numpy()
    order = np.argsort(theta, kind="stable")
    place, force = (
        jax.numpy.asarray(theta[order]),
        jax.numpy.asarray(problem.features.force[0, 0].numpy()[order]),
    )

    @jax.jit
    @jax.value_and_grad
    def plain(parameters):
        sd, lengthscale, noise = jax.numpy.exp(parameters)
        kernel = sd**2 * tinygp.kernels.quasisep.Matern52(scale=lengthscale)
        process = tinygp.GaussianProcess(kernel, place, diag=noise**2, assume_sorted=True)
        return process.log_probability(force)

    start = jax.numpy.log(jax.numpy.array([1.0, 0.5, 0.2]))

    def theirs() -> float:
        value, slope = plain(start)
        slope.block_until_ready()
        return float(value)

    assert math.isfinite(theirs())
    ours = value_and_gradient(markov(problem), problem)
    figures["markov_value_and_gradient_n100000_over_tinygp"] = paired(ours, theirs, rounds=9)


def test_beside_dense(figures):
    problem = scalar_problem(4000, STEP)
    ours = value_and_gradient(markov(problem), problem)
    theirs = value_and_gradient(DenseGivenImpedance(problem.features, False), problem)
    start = time.perf_counter()
    theirs()
    dense = time.perf_counter() - start
    figures["markov_value_and_gradient_n4000_over_dense"] = {
        "ours_seconds": seconds(ours, 9),
        "theirs_seconds": dense,
        "ratio": seconds(ours, 9) / dense,
    }
