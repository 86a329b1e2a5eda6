"""A `JointDensity` that takes a blink, and Laplace's approximation of it."""

from functools import cache

from bayes_impedance.impedance_functions.function import choose_inducing
from bayes_impedance.sampling.density import JointDensity
from bayes_impedance.sampling.start import Start, find_start
from tests.impedance_functions.problems import KNOWN_VARIATION, MARKOV, small_problem

ONE_AXIS = {"axes": ("x",), "repetitions": 3, "rate": 16.0}


@cache
def joint_density(*overrides: str) -> JointDensity:
    problem = small_problem(*MARKOV, *KNOWN_VARIATION, "engine.inducing=3", *overrides, **ONE_AXIS)
    inducing = choose_inducing(problem.config, problem.model, problem.features)
    return JointDensity(problem.config, problem.model, problem.features, inducing)


@cache
def laplace(*overrides: str) -> Start:
    density = joint_density(*overrides)
    return find_start(density, density.config.training)
