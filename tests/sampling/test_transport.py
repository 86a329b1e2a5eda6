"""Coordinates in which functions and how they vary are apart: the same density, whatever they are settled about."""

import numpy as np
import pytest
import torch

from bayes_impedance.config import SamplingConfig
from bayes_impedance.impedance_functions import laplace
from bayes_impedance.impedance_functions.function import choose_inducing
from bayes_impedance.sampling.density import JointDensity
from bayes_impedance.sampling.importance import laplace_draws
from bayes_impedance.sampling.parameters import QUANTITIES
from bayes_impedance.sampling.sample import draw
from bayes_impedance.sampling.start import find_start
from bayes_impedance.sampling.transport import TransportedDensity
from tests.impedance_functions.problems import COUPLED, DISTINCT, KNOWN_VARIATION, MARKOV, small_problem

VARYING = tuple(
    f"model.{name}.{key}"
    for name in ("stiffness", "damping")
    for key in (
        "log_sd={median: 0.3, log_sd: 0.5}",
        "length_scale={phase: {median: 0.2, log_sd: 0.5}}",
    )
)
OVER_POSITION = (
    "model.stiffness.input=[position]",
    "model.stiffness.log_sd={median: 0.3, log_sd: 0.5}",
    "model.stiffness.length_scale={position: {median: 0.1, log_sd: 0.5}}",
    "model.damping.input=[]",
)
CASES = {
    "one axis": (VARYING, {"axes": ("x",)}),
    "two axes, two groups": (VARYING, {"groups": 2}),
    "coupled, two groups": ((*VARYING, COUPLED), {"groups": 2}),
    "over position": (OVER_POSITION, {}),
    "nothing varies": (KNOWN_VARIATION, {"axes": ("x",)}),
    "constants": (("model.stiffness.input=[]", "model.damping.input=[]"), {"axes": ("x",)}),
}


class Quadratic(JointDensity):
    """Its likelihood is N(centre, curvature⁻¹) of the values of the functions at their inducing inputs and levels."""

    def place(self, centre, curvature):
        self.centre, self.curvature = centre, curvature
        return self

    def log_likelihood(self, values):
        away = self.spread(values) - self.centre
        return -0.5 * away @ self.curvature @ away

    def spread(self, values):
        parts = []
        for name, function in zip(QUANTITIES, self.functions(values), strict=True):
            for group in values[f"{name}_weights"]:
                for (a, _), weights in zip(function.places, group, strict=True):
                    parts.append(weights[:1])
                    if function.inducing is not None:
                        root = torch.linalg.cholesky(function.covariance_at_inducing())[a, 0]
                        parts.append(root @ weights[1:])
        return torch.cat(parts)


def density_of(case, kind=JointDensity):
    overrides, settings = CASES[case]
    problem = small_problem(*MARKOV, "engine.inducing=3", *overrides, **{"repetitions": 3, **settings})
    inducing = choose_inducing(problem.config, problem.model, problem.features)
    return kind(problem.config, problem.model, problem.features, inducing)


def somewhere(density, seed=0, scale=0.4):
    return scale * np.random.default_rng(seed).standard_normal(density.size)


def settled(density, seed=0):
    """About a place that is no mode, with a curvature that is not that of the density."""
    transported = TransportedDensity(density)
    factor = np.random.default_rng(seed).standard_normal((density.size, density.size))
    transported.settle(somewhere(density, seed + 1), np.eye(density.size) + 2.0 * factor @ factor.T)
    return transported


@pytest.mark.parametrize("case", CASES)
def test_settling_keeps_the_place_and_the_density_there(case):
    density = density_of(case)
    transported = TransportedDensity(density)
    point = expected = somewhere(density)
    np.testing.assert_array_equal(transported.all_standard(point), point)
    before = density.joint(point)[0]
    for seed in range(2):
        factor = np.random.default_rng(seed).standard_normal((density.size, density.size))
        point, moved = transported.settle(point, np.eye(density.size) + factor @ factor.T)
        assert moved == 0.0
        assert not point[: density.weight_count].any()
        np.testing.assert_allclose(transported.all_standard(point), expected, atol=1e-9)
        jacobian = float(transported.standard(torch.from_numpy(point))[1])
        assert transported.joint(point)[0] - jacobian == pytest.approx(before, rel=1e-10)


@pytest.mark.parametrize("case", CASES)
def test_it_is_the_same_density_in_other_coordinates(case):
    density = density_of(case)
    transported = settled(density)
    points = np.stack([somewhere(density, seed, 1.0) for seed in range(6)])
    for point in points:
        coordinates = torch.from_numpy(point)
        standard, jacobian = transported.standard(coordinates)
        matrix = torch.autograd.functional.jacobian(lambda at: transported.standard(at)[0], coordinates)
        assert float(jacobian) == pytest.approx(float(torch.linalg.slogdet(matrix)[1]), abs=1e-9)
        expected = density.log_density(standard) + jacobian
        value, gradient = transported.joint(point)
        assert value == pytest.approx(float(expected), rel=1e-12)
        step = 1e-5 * np.random.default_rng(1).standard_normal(density.size)
        difference = transported.joint(point + step)[0] - transported.joint(point - step)[0]
        assert 2.0 * gradient @ step == pytest.approx(difference, rel=1e-5, abs=1e-7)
        # Hyperparameters are what they were.
        count = density.weight_count
        np.testing.assert_array_equal(standard[count:], point[count:])
    many = transported.all_standard(points.reshape(2, 3, -1))
    for point, found in zip(points, many.reshape(6, -1), strict=True):
        np.testing.assert_array_equal(found, transported.standard(torch.from_numpy(point))[0])


@pytest.mark.parametrize("case", CASES)
def test_of_a_quadratic_likelihood_weights_are_standard_normal_at_any_hyperparameters(case):
    density = density_of(case, Quadratic)
    count, size = density.weight_count, density.size
    generator = np.random.default_rng(3)
    factor = torch.from_numpy(generator.standard_normal((count, count)))
    curvature, centre = 4.0 * factor @ factor.T, torch.from_numpy(generator.standard_normal(count))
    density.place(centre, curvature)
    hyperparameters = somewhere(density, 4)
    # The mode of the weights at these hyperparameters, in one step of Newton's method.
    point = np.concatenate([np.zeros(count), hyperparameters[count:]])
    precision = laplace.precision(lambda at: density.joint(at)[1], point, density.free)
    point[:count] = np.linalg.solve(precision[:count, :count], density.joint(point)[1][:count])
    assert abs(density.joint(point)[1][:count]).max() < 1e-6
    transported = TransportedDensity(density)
    transported.settle(point, laplace.precision(lambda at: density.joint(at)[1], point, density.free))
    for seed in range(4):
        elsewhere = somewhere(density, seed, 1.0)
        middle = np.concatenate([np.zeros(count), elsewhere[count:]])
        difference = transported.joint(elsewhere)[0] - transported.joint(middle)[0]
        assert difference == pytest.approx(-0.5 * np.square(elsewhere[:count]).sum(), rel=1e-4)
    assert size > count


def test_draws_are_those_of_plain_coordinates():
    few = ("model.stiffness.log_sd={median: 0.3, log_sd: 0.5}", "model.damping.input=[]")
    problem = small_problem(*MARKOV, *few, *DISTINCT, "engine.inducing=2", axes=("x",), repetitions=3)
    inducing = choose_inducing(problem.config, problem.model, problem.features)
    density = JointDensity(problem.config, problem.model, problem.features, inducing)
    settings = SamplingConfig(method="laplace", draws=800, chains=1, seed=1)
    plain = laplace_draws(density, find_start(density, problem.config.training), settings)
    found = draw(density, problem.config.training, settings)
    assert max(plain.pareto_k, found.pareto_k) < 0.7
    np.testing.assert_allclose(found.standard[0].mean(0), plain.standard[0].mean(0), atol=0.2)
    np.testing.assert_allclose(found.standard[0].std(0), plain.standard[0].std(0), rtol=0.2)
