"""Functions in whitened weights against the Gaussian process that they stand for, and where inducing inputs lie."""

import numpy as np
import pytest
import torch

from bayes_impedance.impedance_functions import inducing as inducing_module
from bayes_impedance.impedance_functions.function import OFF_DIAGONAL, build_functions, choose_inducing
from bayes_impedance.impedance_functions.inducing import inducing_inputs
from bayes_impedance.kernels.warped import evaluate
from tests.impedance_functions.problems import COUPLED, small_problem

LEARNED = "model.stiffness.level={median: 300, log_sd: 0.7}"
VECTOR = ("model.stiffness.input=[position]", "model.stiffness.length_scale={position: 0.05}")


def functions_of(problem, count=None):
    config = problem.config
    if count is not None:
        engine = config.engine.model_copy(update={"inducing": count})
        config = config.model_copy(update={"engine": engine})
    inducing = choose_inducing(config, problem.model, problem.features)
    return build_functions(config, problem.model, inducing)


def exact_covariance(problem, function, entry):
    """Of an entry of S at the samples, `(groups, n, n)`, from hyperprior and kernel."""
    a, b = function.places[entry]
    prior = problem.config.model.stiffness
    x = problem.features.inputs
    with torch.no_grad():
        own = evaluate(function.covariance, x, x)[a]
    if a == b:
        return (0.0 if prior.level.fixed else prior.level.log_sd**2) + own
    return prior.coupling.median**2 + OFF_DIAGONAL * own


@pytest.mark.parametrize("overrides", [(), (COUPLED,), (COUPLED, *VECTOR)])
@torch.no_grad()
def test_logarithm_is_linear_and_its_prior_is_the_process(overrides):
    problem = small_problem(*overrides, LEARNED, groups=2)
    function = functions_of(problem)[0]
    x = problem.features.inputs
    design = function.design(x)
    groups, n = x.shape[1:3]
    assert design.shape == (groups, len(function.places), n, function.width)
    generator = torch.Generator().manual_seed(0)
    one, two = torch.randn(2, groups, len(function.places), function.width, generator=generator).double()
    at = function.logarithm
    torch.testing.assert_close(
        at(design, 2.0 * one - two) - function.location,
        2.0 * (at(design, one) - function.location) - (at(design, two) - function.location),
    )
    # Weights are N(0, 1): what they carry and what they leave out make the variance of the process.
    variance = design.square().sum(-1) + function.left_out(x, design)
    location, covariance, _, _ = function.prior(x, function.design(x))
    for e, (a, b) in enumerate(function.places):
        expected = exact_covariance(problem, function, e).diagonal(dim1=-2, dim2=-1)
        torch.testing.assert_close(variance[:, e], expected, rtol=1e-7, atol=0)
        torch.testing.assert_close(covariance[..., e, e], expected, rtol=1e-7, atol=0)
        assert (location[..., e] == (np.log(300.0) if a == b else 0.0)).all()


@pytest.mark.parametrize("overrides", [(COUPLED,), (COUPLED, *VECTOR)])
@torch.no_grad()
def test_covariance_tends_to_that_of_the_process(overrides):
    problem = small_problem(*overrides)
    errors = []
    for count in (3, 6, 20):
        function = functions_of(problem, count)[0]
        design = function.design(problem.features.inputs)
        errors.append(
            max(
                float((design[:, e] @ design[:, e].mT - exact_covariance(problem, function, e)).abs().max())
                for e in range(len(function.places))
            )
        )
    assert errors[0] > errors[1] > errors[2]
    # Twenty inputs over as many samples carry all but the jitter, or what kernels of length .15 leave between them.
    assert errors[2] < 1e-5


@torch.no_grad()
def test_constants():
    problem = small_problem("model.stiffness.input=[]", "model.stiffness.level={median: 200, log_sd: 0.4}")
    stiffness, _, mass = functions_of(problem)
    assert stiffness.inducing is None
    assert (stiffness.width, mass.width) == (1, 1)
    design = stiffness.design(problem.features.inputs)
    # What a constant is about its level adds to what its level is about its median.
    torch.testing.assert_close(design, torch.full_like(design, float(np.hypot(0.4, 0.3))))
    assert (stiffness.left_out(problem.features.inputs, design) == 0.0).all()
    expected = np.hypot(problem.config.model.mass.level.log_sd, 0.3 / 1.5)
    torch.testing.assert_close(mass.level_sd, torch.full((2,), expected, dtype=torch.float64))
    weights = torch.ones(1, 2, 1, dtype=torch.float64)
    diagonal = stiffness.matrices(design, weights).diagonal(dim1=-2, dim2=-1)
    torch.testing.assert_close(diagonal, torch.full_like(diagonal, 200.0 * np.exp(np.hypot(0.4, 0.3))))


@torch.no_grad()
def test_fixed_level_does_not_move():
    problem = small_problem(COUPLED, "model.stiffness.level=250")
    stiffness = functions_of(problem)[0]
    assert stiffness.level_sd.tolist() == [0.0, 0.0, 0.3]
    torch.testing.assert_close(stiffness.location[:2].exp(), torch.full((2,), 250.0, dtype=torch.float64))
    # Off the diagonal the level of the coupling is still to be found.
    assert (stiffness.design(problem.features.inputs)[:, 2, :, 0] == 0.3).all()


def test_inputs_of_a_scalar_span_the_samples_evenly_without_padding():
    problem = small_problem("model.stiffness.input=[time]", groups=2, repetitions=3)
    assert problem.features.valid is not None
    kernel = problem.model.kernel.impedance.stiffness.covariance
    found = inducing_inputs(kernel, problem.features, 5)
    (column,) = kernel.active_dims.tolist()
    times = np.concatenate([trial.time - trial.time[0] for trial in problem.log.trials])
    np.testing.assert_allclose(found[:, column], np.linspace(times.min(), times.max(), 5), atol=1e-15)
    shifted = small_problem("model.stiffness.input=[phase]", groups=2, repetitions=3)
    kernel = shifted.model.kernel.impedance.stiffness.covariance
    (column,) = kernel.active_dims.tolist()
    # Padding is at phase 0, which no sample has.
    assert float(inducing_inputs(kernel, shifted.features, 5)[0, column]) > 0.005


@torch.no_grad()
def test_inputs_of_a_vector_are_the_samples_least_known():
    problem = small_problem(*VECTOR)
    kernel = problem.model.kernel.impedance.stiffness.covariance
    found = inducing_inputs(kernel, problem.features, 6)
    rows = problem.features.inputs[0, 0]
    prior = evaluate(kernel, rows, rows).reshape(-1, len(rows), len(rows))[0]
    chosen = []
    for _ in range(6):
        variance = prior.diagonal().clone()
        if chosen:
            inner, outer = prior[chosen][:, chosen], prior[chosen]
            variance -= (outer * torch.linalg.solve(inner, outer)).sum(0)
        chosen.append(int(variance.argmax()))
    torch.testing.assert_close(found, rows[chosen], rtol=0, atol=0)


@torch.no_grad()
def test_no_more_inputs_than_tell_anything(monkeypatch):
    problem = small_problem(*VECTOR, "model.stiffness.length_scale={position: 1000.0}")
    kernel = problem.model.kernel.impedance.stiffness.covariance
    # Over a kilometre a movement of a few centimetres is one place.
    assert len(inducing_inputs(kernel, problem.features, 6)) == 1
    problem = small_problem(*VECTOR)
    kernel = problem.model.kernel.impedance.stiffness.covariance
    n = len(problem.features.rows[0])
    assert len(inducing_inputs(kernel, problem.features, 10 * n)) <= n
    monkeypatch.setattr(inducing_module, "CANDIDATES", n // 2)
    assert len(inducing_inputs(kernel, problem.features, 10 * n)) <= n // 2
