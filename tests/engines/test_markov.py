"""The Markov engine against covariances of all forces: value, gradient, and the posterior at any target."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bayes_impedance.engines.given_dense import DenseGivenImpedance
from bayes_impedance.engines.given_impedance import LATENTS
from bayes_impedance.engines.markov import MarkovEngine
from bayes_impedance.engines.markov.likelihood import FilterLikelihood
from tests.engines.given import NO_RESIDUAL, OVER_PHASE, OVER_TIME, given_problem

OFFSET = (*OVER_TIME, "model.residual.offset_sd=0.3")
SHARED_OVER_TIME = (*OVER_TIME, "shared.residual=true", "model.residual.kernel=matern12")
SMOOTH = (*OVER_PHASE, "model.residual.kernel=matern52", "model.residual.offset_sd=0.3")
#: θ, residual, axes, and whether these couple.
CASES = [
    ("phase", NO_RESIDUAL, ("x",), False),
    ("phase", NO_RESIDUAL, ("x", "y"), False),
    ("phase", NO_RESIDUAL, ("x", "y", "z"), True),
    ("phase", OVER_PHASE, ("x", "y"), False),
    ("phase", OVER_PHASE, ("x", "y"), True),
    ("phase", OVER_TIME, ("x", "y"), False),
    ("phase", OVER_TIME, ("x", "y"), True),
    ("phase", SMOOTH, ("x", "y"), True),
    ("position", NO_RESIDUAL, ("x",), False),
    ("time", NO_RESIDUAL, ("x", "y"), True),
    ("time", OVER_TIME, ("x", "y"), False),
    ("time", OFFSET, ("x", "y"), True),
    ("time", SHARED_OVER_TIME, ("x", "y"), True),
]
#: Mean λΔ of neighbours in the order of θ.
STEPS = (1e-3, 0.03, 1.0)
#: Rounding of the dense engine, which is the larger: see test_markov_precision.
TOLERANCE = 1e-8


def problem_of(name, overrides, axes, step, repeat=True):
    """Two groups of unequal size, with some samples at θ where another is."""
    problem = given_problem(name, overrides, axes=axes, repetitions=3, rate=9.0, groups=2)
    features, layout = problem.features, problem.processes.layout
    if repeat and layout.trajectory is None:
        # A sample of the second repetition is at the θ of the first one's, exactly.
        columns = [*layout.theta, *(column for column in own_columns(problem) if in_theta(problem, column))]
        features.inputs[:, 0, 20:36:5, columns] = features.inputs[:, 0, 2:18:5, columns]
    engine = MarkovEngine(features, problem.processes, len(axes) > 1)
    steps = engine.sequences.steps[:, 0]
    problem.model.kernel.impedance.trajectory.lengthscale = 5.0**0.5 * steps[steps > 0].mean().item() / step
    return problem


def own_columns(problem):
    return [int(c) for term in problem.processes.residual if term.num_dims for c in term.active_dims]


def in_theta(problem, column):
    x = problem.features.inputs
    return torch.equal(x[..., column], x[..., problem.processes.layout.theta[0]])


def valid(features):
    return torch.ones(features.inputs.shape[1:3]).bool() if features.valid is None else features.valid


def targets(problem):
    """Samples at the data, between them, before and beyond them, of their trials and of one that was never seen."""
    features, layout = problem.features, problem.processes.layout
    x, w = features.inputs, problem.impedance
    labels = [column for column in (layout.trajectory, layout.residual) if column is not None]
    between = torch.lerp(x[:, :, :-1], x[:, :, 1:], 0.3)
    same = (x[0, :, 1:, layout.theta[0]] > x[0, :, :-1, layout.theta[0]]) & valid(features)[:, 1:]
    ends = x[:, :, [0, -1]].clone() if features.valid is None else x[:, :, [0, 8]].clone()
    shifted = [*layout.theta, *own_columns(problem)]
    before, beyond, unseen = ends.clone(), ends.clone(), ends.clone()
    before[..., shifted] -= 3.0
    beyond[..., shifted] += 3.0
    unseen[..., labels] = 77.0
    inputs = torch.cat([x, between, before, beyond, unseen], dim=2)
    rest = torch.ones(len(same), 6, dtype=torch.bool)
    keep = torch.cat([valid(features), same, rest], dim=1)
    m = inputs.shape[2]
    index = torch.arange(m) % w.shape[1]
    mean = torch.randn(*inputs.shape[:3], 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    return replace(features, inputs=inputs, force=None, trajectory_mean=mean, valid=keep), w[:, index]


def prior_sds(problem, target, target_impedance, coupled):
    """Of every latent at every target: where the noise is so large that the data say nothing."""
    ignorant = replace(problem.processes, noise_variance=1e30 * problem.processes.noise_variance)
    engine = DenseGivenImpedance(problem.features, coupled)
    found = engine.posterior(ignorant, problem.impedance, target, target_impedance)
    return {latent: variance.sqrt() for latent, (_, variance) in found.items()}


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize(("name", "overrides", "axes", "coupled"), CASES)
def test_value_and_gradient_are_the_dense_engines(name, overrides, axes, coupled, step):
    problem = problem_of(name, overrides, axes, step)
    impedance = problem.impedance.clone().requires_grad_()
    parameters = [parameter for parameter in problem.model.parameters() if parameter.requires_grad]
    results = []
    for engine in (
        MarkovEngine(problem.features, problem.processes, coupled),
        DenseGivenImpedance(problem.features, coupled),
    ):
        value = engine.log_likelihood_given_impedance(problem.processes, impedance)
        weights = torch.arange(1.0, 1.0 + value.numel(), dtype=torch.float64).reshape(value.shape)
        gradient = torch.autograd.grad((weights * value).sum(), [impedance, *parameters], allow_unused=True)
        results.append((value.detach(), gradient))
    (value, gradient), (expected, expected_gradient) = results
    torch.testing.assert_close(value, expected, rtol=TOLERANCE, atol=0)
    for ours, theirs in zip(gradient, expected_gradient, strict=True):
        assert (ours is None) == (theirs is None)
        if ours is not None:
            scale = float(theirs.abs().max())
            torch.testing.assert_close(ours, theirs, rtol=TOLERANCE, atol=TOLERANCE * scale)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize(("name", "overrides", "axes", "coupled"), CASES)
def test_posterior_is_the_dense_engines(name, overrides, axes, coupled, step):
    problem = problem_of(name, overrides, axes, step, repeat=False)
    target, target_impedance = targets(problem)
    found, expected = (
        engine.posterior(problem.processes, problem.impedance, target, target_impedance)
        for engine in (
            MarkovEngine(problem.features, problem.processes, coupled),
            DenseGivenImpedance(problem.features, coupled),
        )
    )
    scales = prior_sds(problem, target, target_impedance, coupled)
    for latent in LATENTS:
        for ours, theirs, power in zip(found[latent], expected[latent], (1, 2), strict=True):
            unit = scales[latent] ** power
            keep = target.valid & (unit > 0.0)
            ratio = ((ours - theirs).abs() / (theirs.abs() + unit))[keep]
            assert ratio.numel() == 0 or float(ratio.max()) < TOLERANCE, latent
            assert torch.equal(ours[target.valid & (unit == 0.0)], theirs[target.valid & (unit == 0.0)])
        assert not found[latent][1][:, ~target.valid].any()


def test_a_trial_that_was_never_seen_has_the_prior_of_its_residual():
    problem = problem_of("phase", OVER_TIME, ("x", "y"), 0.03)
    target, target_impedance = targets(problem)
    engine = MarkovEngine(problem.features, problem.processes, True)
    mean, variance = engine.posterior(problem.processes, problem.impedance, target, target_impedance)[
        LATENTS[-1]
    ]
    prior = problem.processes.residual[0].sd.detach()[:, :, 0] ** 2
    assert not mean[..., -2:].any()
    torch.testing.assert_close(variance[..., -2:], prior.expand(2, 2, 2), rtol=1e-12, atol=0)


def test_samples_without_force_are_left_out():
    problem = given_problem(overrides=OVER_PHASE, groups=2)
    features = problem.features
    known = replace(
        features, force=features.force.clone(), valid=valid(features) & (torch.arange(72) % 3 != 1)
    )
    unknown = replace(features, force=features.force.masked_fill(torch.arange(72) % 3 == 1, torch.nan))
    values = [
        MarkovEngine(part, problem.processes, True).log_likelihood_given_impedance(
            problem.processes, problem.impedance
        )
        for part in (known, unknown)
    ]
    assert torch.equal(*values)


def test_order_of_samples_does_not_matter():
    problem = given_problem(overrides=OVER_TIME)
    features = problem.features
    order = torch.from_numpy(np.random.default_rng(3).permutation(features.inputs.shape[2]))
    shuffled = replace(features, inputs=features.inputs[:, :, order], force=features.force[:, :, order])
    value, other = (
        MarkovEngine(part, problem.processes, True).log_likelihood_given_impedance(
            problem.processes, matrices
        )
        for part, matrices in ((features, problem.impedance), (shuffled, problem.impedance[:, order]))
    )
    torch.testing.assert_close(value, other, rtol=1e-13, atol=0)


@pytest.mark.parametrize("overrides", [NO_RESIDUAL, OFFSET, SMOOTH])
def test_gradcheck_of_the_filter(overrides):
    """By the arrays of the filter themselves, whatever they mean; some steps are zero."""
    problem = given_problem(overrides=overrides, repetitions=2, rate=7.0, groups=2)
    sequences = MarkovEngine(problem.features, problem.processes, True).sequences
    n, axes, terms = len(sequences.order), 2, len(problem.processes.residual)
    generator = torch.Generator().manual_seed(1)

    def draw(*shape):
        return torch.randn(1, *shape, generator=generator, dtype=torch.float64)

    z = draw(n, axes * (1 + terms)).abs() * 0.5
    z[:, ::4] = 0.0
    arrays = (z, draw(n, axes, 3 * axes), draw(axes, terms), draw(n, axes), draw(axes).exp())
    for array in arrays:
        array.requires_grad_()
    assert torch.autograd.gradcheck(lambda *values: FilterLikelihood.apply(*values, sequences), arrays)


@pytest.mark.parametrize("coupled", [False, True])
def test_gradcheck_of_the_engine(coupled):
    problem = given_problem(overrides=OVER_PHASE, repetitions=2, rate=4.0)
    engine = MarkovEngine(problem.features, problem.processes, coupled)
    # Relative to its value, for stiffness and mass differ by a factor of hundreds.
    change = torch.zeros_like(problem.impedance, requires_grad=True)
    terms = (problem.processes.trajectory, *problem.processes.residual)
    parameters = [parameter for term in terms for parameter in term.parameters()]
    noise = problem.processes.noise_variance.detach().clone().requires_grad_()

    def value(*_):
        # The parameters are changed in place.
        processes = replace(problem.processes, noise_variance=noise)
        return engine.log_likelihood_given_impedance(processes, problem.impedance * (1.0 + change))

    # The value is in the millions where forces were drawn with other matrices: a step of 1e-6 would drown in rounding.
    assert torch.autograd.gradcheck(value, (change, noise, *parameters), eps=1e-4, atol=1e-4, rtol=1e-4)


def test_no_gradient_is_asked_of_what_needs_none():
    problem = given_problem()
    engine = MarkovEngine(problem.features, problem.processes, False)
    with torch.no_grad():
        value = engine.log_likelihood_given_impedance(problem.processes, problem.impedance)
    assert not value.requires_grad
    with_gradient = engine.log_likelihood_given_impedance(problem.processes, problem.impedance)
    assert torch.equal(value, with_gradient.detach())


def test_features_may_hold_no_sample_of_a_group():
    problem = given_problem(groups=2)
    features = problem.features
    none = replace(features, valid=valid(features) & torch.tensor([[True], [False]]))
    engine = MarkovEngine(none, problem.processes, True)
    value = engine.log_likelihood_given_impedance(problem.processes, problem.impedance)
    assert value.shape == (1, 2) and value[0, 0] != 0.0 and value[0, 1] == 0.0
