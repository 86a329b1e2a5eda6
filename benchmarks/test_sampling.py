"""Draws a second: NUTS beside the plain formulation and beside NumPyro, a thousand forces, and Laplace.

The plain formulation has a dense covariance of all forces, a diagonal mass matrix, and Pyro's own start.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyro
import pytest
import torch
from arviz_stats.base import array_stats
from numpy.typing import NDArray

from bayes_impedance.config import SamplingConfig
from bayes_impedance.sampling.chains import sample_nuts
from bayes_impedance.sampling.importance import laplace_draws
from bayes_impedance.sampling.program import pyro_program
from bayes_impedance.sampling.start import Start, find_start
from bayes_impedance.sampling.transport import TransportedDensity
from benchmarks.drawn_density import Posed, in_jax, posed

Array = NDArray[np.float64]

#: Warm-up and draws of ours and NumPyro's.
SETTINGS = SamplingConfig(chains=1)
#: Of the plain formulation: its ESS of so few draws is uncertain, but its seconds a draw are not.
PLAIN_WARMUP, PLAIN_DRAWS = 100, 100
#: Repetitions, samples of each.
SMALL, LARGE = (4, 50), (5, 200)


# A chain among other work takes minutes.
pytestmark = pytest.mark.timeout(0)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """More threads only wait for each other in matrices of this size."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def small() -> Posed:
    return posed(*SMALL)


@pytest.fixture(scope="module")
def ours(small: Posed) -> dict[str, Any]:
    return nuts(small)


class Watch:
    """Wall and processor seconds since it was made; the latter know nothing of what else the machine does."""

    def __init__(self) -> None:
        self.start = time.perf_counter(), time.process_time()

    def read(self) -> Array:
        return np.array([time.perf_counter() - self.start[0], time.process_time() - self.start[1]])


def least_ess(standard: Array) -> float:
    """Smallest bulk ESS of the coordinates of `(chains, draws, size)`."""
    return min(float(array_stats.ess(standard[..., i], method="bulk")) for i in range(standard.shape[-1]))


def chains_cpu() -> float:
    """Processor seconds of chains that have ended: children of those processes that this one started."""
    started = Path(f"/proc/self/task/{os.getpid()}/children").read_text(encoding="ascii").split()
    fields = [
        Path(f"/proc/{child}/stat").read_text(encoding="utf-8").split(")")[-1].split() for child in started
    ]
    return sum(int(own[13]) + int(own[14]) for own in fields) / os.sysconf("SC_CLK_TCK")


def nuts(problem: Posed) -> dict[str, Any]:
    """One chain in this process as the command samples it."""
    watch = Watch()
    density = TransportedDensity(problem.density)
    start = find_start(density, problem.config.training)
    begun, marks = watch.read(), []

    def note(_chain: int, done: int, _total: int, _line: str) -> None:
        if done >= SETTINGS.warmup:
            marks.append((done, watch.read()))

    draws = sample_nuts(density, start, SETTINGS, note, processes=1)
    spent = watch.read()
    (done, before), total = marks[0], SETTINGS.warmup + SETTINGS.draws
    drawing = (spent - before) * SETTINGS.draws / (total - done)
    least = least_ess(density.all_standard(draws.standard))
    gradients = int(draws.stats["n_steps"].sum())
    return {
        "density": density,
        "start": start,
        "least": least,
        "drawing": drawing,
        "figures": {
            "minimum_ess": least,
            "divergences": int(draws.stats["diverging"].sum()),
            "start_seconds": begun[0],
            "start_cpu_seconds": begun[1],
            **per_second(least, spent, drawing, gradients),
        },
    }


def per_second(least: float, spent: Array, drawing: Array, gradients: int) -> dict[str, float]:
    """`spent` on all, `drawing` after the warm-up, wall and processor each; `gradients` of the latter."""
    return {
        "seconds": spent[0],
        "cpu_seconds": spent[1],
        "ess_per_second": least / spent[0],
        "ess_per_cpu_second": least / spent[1],
        "ess_per_second_after_warmup": least / drawing[0],
        "ess_per_cpu_second_after_warmup": least / drawing[1],
        "gradients_after_warmup": gradients,
        "ess_per_gradient": least / gradients,
        "cpu_milliseconds_per_gradient": 1e3 * drawing[1] / gradients,
    }


def test_beside_the_plain_formulation(ours, figures):
    density = posed(*SMALL, settings=("engine.name=dense",)).density
    assert density.engine_choice.name == "dense"
    assert density.size == 22
    pyro.set_rng_seed(0)
    kernel = pyro.infer.NUTS(pyro_program(density), full_mass=False)
    gradients, marks = [0], []
    step, watch = kernel._build_basetree, Watch()

    def counted(*arguments: Any) -> Any:
        gradients[0] += 1
        return step(*arguments)

    def note(_kernel: Any, _samples: Any, stage: str, _i: int) -> None:
        if stage != "Warmup" and not marks:
            marks.append((watch.read(), gradients[0]))

    kernel._build_basetree = counted
    with pyro.validation_enabled(False):
        sampler = pyro.infer.MCMC(
            kernel, num_samples=PLAIN_DRAWS, warmup_steps=PLAIN_WARMUP, disable_progbar=True, hook_fn=note
        )
        sampler.run()
    spent = watch.read()
    # Of the first draw nothing is known but its end.
    before, known = marks[0]
    share = PLAIN_DRAWS / (PLAIN_DRAWS - 1)
    drawing, steps = (spent - before) * share, round((gradients[0] - known) * share)
    least = least_ess(density.standard(sampler.get_samples()).numpy()[None])
    plain = {"minimum_ess": least, **per_second(least, spent, drawing, steps)}
    figures["nuts_n200_plain"] = plain
    figures["nuts_n200"] = mine = ours["figures"]
    names = [name for name in plain if name.startswith("ess_per")]
    figures["nuts_n200_over_plain"] = {
        **{name: mine[name] / plain[name] for name in names},
        # As though each of its draws were worth a whole one.
        "ess_per_cpu_second_after_warmup_over_draws": (
            mine["ess_per_cpu_second_after_warmup"] / (PLAIN_DRAWS / drawing[1])
        ),
    }


def test_beside_numpyro(small, ours, figures):
    jax = pytest.importorskip("jax")
    pytest.importorskip("numpyro")
    start: Start = ours["start"]
    density: TransportedDensity = ours["density"]
    centre = density.all_standard(start.point)
    log_density = in_jax(small.density, centre)
    both = jax.jit(jax.value_and_grad(log_density))
    generator = np.random.default_rng(1)
    for standard in density.all_standard(start.at(generator.standard_normal((5, density.size)))):
        value, gradient = small.density.joint(standard)
        theirs = both(standard)
        assert float(theirs[0]) == pytest.approx(value, rel=1e-8)
        np.testing.assert_allclose(theirs[1], gradient, rtol=1e-8, atol=1e-8 * np.abs(gradient).max())
    # Where nothing of how functions vary is sampled, our coordinates are an affine map of z.
    change = density.all_standard(start.at(np.eye(density.size))) - centre
    figures["nuts_n200_numpyro"] = numpyro_nuts(
        log_density, lambda z: z, generator.uniform(-2.0, 2.0, density.size)
    )
    figures["nuts_n200_numpyro_in_our_coordinates"] = numpyro_nuts(
        lambda y: log_density(centre + y @ change),
        lambda y: centre + y @ change,
        generator.standard_normal(density.size),
    )
    for name in ("", "_in_our_coordinates"):
        theirs = figures[f"nuts_n200_numpyro{name}"]
        figures[f"nuts_n200_over_numpyro{name}"] = {
            key: ours["figures"][key] / theirs[key] for key in theirs if key.startswith("ess_per")
        }


def numpyro_nuts(log_density: Any, standard: Any, begin: Array) -> dict[str, float]:
    """One chain from `begin`; the warm-up has compiling in it, draws are timed when they are drawn again."""
    import jax
    import numpyro

    kernel = numpyro.infer.NUTS(potential_fn=lambda z: -log_density(z), dense_mass=True)
    sampler = numpyro.infer.MCMC(
        kernel, num_warmup=SETTINGS.warmup, num_samples=SETTINGS.draws, progress_bar=False
    )
    watch = Watch()
    sampler.warmup(jax.random.PRNGKey(0), init_params=jax.numpy.asarray(begin))
    jax.block_until_ready(sampler.post_warmup_state.z)
    warming = watch.read()
    for _ in range(2):
        watch = Watch()
        sampler.run(jax.random.PRNGKey(1), extra_fields=("num_steps", "diverging"))
        draws = np.asarray(sampler.get_samples())
        drawing = watch.read()
    extra = sampler.get_extra_fields()
    least = least_ess(np.asarray(standard(draws))[None])
    return {
        "minimum_ess": least,
        "divergences": int(np.sum(extra["diverging"])),
        "warmup_cpu_seconds_with_compiling": warming[1],
        **per_second(least, warming + drawing, drawing, int(np.sum(extra["num_steps"]))),
    }


@pytest.mark.parametrize(("kernel", "engine"), [("matern52", "markov"), ("squared_exponential", "lowrank")])
def test_a_thousand_forces(kernel, engine, figures):
    """Default settings: four chains, as many at a time as there are cores."""
    problem = posed(*LARGE, kernel)
    assert problem.density.engine_choice.name == engine
    chains, watch, settings = chains_cpu(), Watch(), SamplingConfig()
    density = TransportedDensity(problem.density)
    draws = sample_nuts(density, find_start(density, problem.config.training), settings)
    spent = watch.read()
    # The server of processes counts a chain once that has gone.
    time.sleep(2.0)
    chains = chains_cpu() - chains
    least = least_ess(density.all_standard(draws.standard))
    step, calls = Watch(), 50
    for point in draws.standard[0, :calls]:
        density.joint(point)
    figures[f"nuts_n1000_{engine}"] = {
        "seconds": spent[0],
        "cpu_seconds": spent[1] + chains,
        "cores": len(os.sched_getaffinity(0)),
        "minimum_ess": least,
        "lost_chains": len(draws.lost),
        "divergences": int(draws.stats["diverging"].sum()),
        "gradients_after_warmup": int(draws.stats["n_steps"].sum()),
        "cpu_milliseconds_per_gradient": 1e3 * step.read()[1] / calls,
    }


@pytest.mark.parametrize("kernel", ["matern52", "squared_exponential"])
@pytest.mark.parametrize("size", [SMALL, LARGE])
def test_laplace(kernel, size, figures):
    problem = posed(*size, kernel)
    watch = Watch()
    density = TransportedDensity(problem.density)
    start = find_start(density, problem.config.training)
    begun = watch.read()
    draws = laplace_draws(density, start, SamplingConfig(method="laplace"))
    spent = watch.read()
    figures[f"laplace_n{size[0] * size[1]}_{problem.density.engine_choice.name}"] = {
        "seconds": spent[0],
        "cpu_seconds": spent[1],
        "start_cpu_seconds": begun[1],
        "pareto_k": float(draws.pareto_k),
    }
