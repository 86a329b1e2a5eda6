"""The low-rank engine against dense covariances, its gradient, and what it refuses."""

from dataclasses import replace
from itertools import pairwise

import gpytorch
import pytest
import torch

from bayes_impedance.engines.given_dense import DenseGivenImpedance
from bayes_impedance.engines.given_impedance import LATENTS, Processes, as_read
from bayes_impedance.engines.lowrank import Accuracy, LowRankEngine, engine, unsupported
from bayes_impedance.engines.lowrank.blocks import LARGEST, batches
from bayes_impedance.engines.lowrank.hilbert import CHEAP, FINE, TIGHT, Extent, counts
from bayes_impedance.errors import ConfigurationError, NotPositiveDefiniteError
from bayes_impedance.kernels.impedance import Latent
from tests.engines.given import NO_RESIDUAL, given_problem

SE = ("model.desired_trajectory.kernel=squared_exponential",)
PLAIN = (*SE, *NO_RESIDUAL)
OVER_TIME = (*SE, "model.residual.kernel=squared_exponential", "model.residual.input=[time]")
OFFSET = (*OVER_TIME, "model.residual.offset_sd=0.3")
OVER_PHASE = (*SE, "model.residual.input=[phase]", "shared.residual=true")
OVER_PLANE = (*SE, "model.residual.input=[position]")
SHARED = (*OFFSET, "shared.residual=true")
TRIAL_EACH = (*OVER_TIME, "shared.desired_trajectory=false")
#: Errs by some 1e-12 of the kernel's derivatives, where rounding of the dense covariance takes over.
FINEST = Accuracy(4.5, 8.0)

CASES = {
    "phase": ("phase", PLAIN, ("x", "y")),
    "phase, three axes": ("phase", PLAIN, ("x", "y", "z")),
    "phase, residual and offset a trial": ("phase", OFFSET, ("x", "y")),
    "phase, shared residual": ("phase", OVER_PHASE, ("x", "y")),
    "phase, residual over the plane": ("phase", OVER_PLANE, ("x", "y")),
    "phase, trajectory and residual a trial": ("phase", TRIAL_EACH, ("x",)),
    "time": ("time", PLAIN, ("x", "y")),
    "time, residual and offset a trial": ("time", OFFSET, ("x", "y", "z")),
    "time, shared residual": ("time", SHARED, ("x", "y")),
    "position along a line": ("position", (*SE, "model.residual.input=[position]"), ("x",)),
    "position in the plane": ("position", PLAIN, ("x", "y")),
    "position and velocity": ("position_velocity", PLAIN, ("x",)),
    "position and velocity, no jerk": (
        "position_velocity", (*PLAIN, "model.drop_acceleration=true"), ("x",)
    ),
}  # fmt: skip


def problem(case, **settings):
    name, overrides, axes = CASES[case]
    return given_problem(name, overrides, axes, **{"groups": 2, "rate": 10.0, **settings})


def thinned(problem):
    """Groups whose trials differ in length: three of four samples of the first trial of each are left out."""
    features = problem.features
    groups, n = features.inputs.shape[1:3]
    valid = torch.ones(groups, n, dtype=torch.bool) if features.valid is None else features.valid.clone()
    for g, rows in enumerate(features.rows):
        for row, (trial, sample) in enumerate(rows):
            valid[g, row] &= bool(trial != rows[0, 0] or sample % 4 == 0)
    return replace(problem, features=replace(features, valid=valid))


def elsewhere(problem):
    """Targets beyond the data by a tenth of what θ covers, and one trial of which nothing is known."""
    features = problem.features
    layout = problem.processes.layout
    inputs = features.inputs.clone()
    theta = list(layout.theta)
    inputs[..., theta] += 0.1 * (inputs[..., theta].amax() - inputs[..., theta].amin())
    for column in {layout.trajectory, layout.residual} - {None}:
        inputs[..., column] = torch.where(inputs[..., column] == 0, 77.0, inputs[..., column])
    return replace(features, inputs=inputs)


def valid_rows(features):
    groups, n = features.inputs.shape[1:3]
    return torch.ones(groups, n, dtype=torch.bool) if features.valid is None else features.valid


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_likelihood_and_posterior_are_those_of_dense_covariances(case, coupled):
    given = thinned(problem(case))
    processes, target = given.processes, elsewhere(given)
    dense = DenseGivenImpedance(given.features, coupled)
    # Products of many waves are for the next test.
    dims = len(processes.layout.theta)
    lowrank = LowRankEngine(given.features, coupled, FINEST if dims == 1 else FINE)
    tolerance = 1.0 if dims == 1 else 1e4
    with torch.no_grad():
        expected = dense.log_likelihood_given_impedance(processes, given.impedance)
        found = lowrank.log_likelihood_given_impedance(processes, given.impedance)
    assert found.shape == expected.shape
    torch.testing.assert_close(found, expected, rtol=1e-9 * tolerance, atol=1e-9 * tolerance)
    expected = dense.posterior(processes, given.impedance, target, given.impedance)
    found = lowrank.posterior(processes, given.impedance, target, given.impedance)
    valid = valid_rows(given.features)
    assert set(found) == set(LATENTS)
    for latent in LATENTS:
        (mean, variance), (mean0, variance0) = found[latent], expected[latent]
        assert mean.shape == variance.shape == mean0.shape
        sd = variance0[:, valid].sqrt() + 1e-12
        # In posterior SDs: 1e-7 of one with features so fine, 1e-4 with products of them.
        assert ((mean - mean0)[:, valid].abs() / sd).max() < 1e-7 * tolerance, latent
        scale = variance0[:, valid].clamp_min(1e-12)
        assert ((variance - variance0)[:, valid].abs() / scale).max() < 1e-7 * tolerance, latent


@torch.no_grad()
@pytest.mark.parametrize("case", ["phase", "time, residual and offset a trial", "position in the plane"])
@pytest.mark.parametrize("coupled", [False, True])
def test_dense_likelihood_is_reached_as_features_grow(case, coupled):
    given = problem(case)
    dense = DenseGivenImpedance(given.features, coupled)
    expected = dense.log_likelihood_given_impedance(given.processes, given.impedance)
    errors = []
    for accuracy in (CHEAP, TIGHT, FINE, FINEST):
        lowrank = LowRankEngine(given.features, coupled, accuracy)
        value = lowrank.log_likelihood_given_impedance(given.processes, given.impedance)
        errors.append((value - expected).abs().max().item())
    # Each step of the rule divides the error of the covariance by 70 and more; at one step errors may cancel.
    assert all(after < before / 5.0 for before, after in pairwise(errors))
    assert errors[-1] < 1e-9 * expected.abs().max().item()


@torch.no_grad()
@pytest.mark.parametrize("case", CASES)
def test_accuracy_of_the_default(case):
    given = problem(case)
    expected = DenseGivenImpedance(given.features, False).log_likelihood_given_impedance(
        given.processes, given.impedance
    )
    value = LowRankEngine(given.features, False).log_likelihood_given_impedance(
        given.processes, given.impedance
    )
    # `FINE` over a scalar, `TIGHT` over several components: one to two hundred times less accurate.
    rtol = 1e-5 if len(given.processes.layout.theta) == 1 else 1e-3
    torch.testing.assert_close(value, expected, rtol=rtol, atol=rtol)


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("recompute", [False, True])
def test_gradient_is_that_of_finite_differences(coupled, recompute, monkeypatch):
    if recompute:
        monkeypatch.setattr(engine, "RECOMPUTED", 0)
    given = given_problem("phase", OFFSET, ("x", "y"), repetitions=2, rate=4.0)
    function, inputs = likelihood_of_everything(given, LowRankEngine(given.features, coupled, CHEAP))
    assert torch.autograd.gradcheck(function, inputs)


@pytest.mark.parametrize("recompute", [False, True])
def test_second_derivatives_are_those_of_finite_differences(recompute, monkeypatch):
    if recompute:
        monkeypatch.setattr(engine, "RECOMPUTED", 0)
    given = given_problem("position", PLAIN, ("x",), repetitions=2, rate=4.0)
    function, inputs = likelihood_of_everything(given, LowRankEngine(given.features, False, CHEAP))
    assert torch.autograd.gradgradcheck(function, inputs)


def likelihood_of_everything(given, lowrank):
    """The likelihood as a function of impedance [in units of its size], noise and all raw hyperparameters."""
    trajectory, residual = given.processes.trajectory, given.processes.residual
    holder = torch.nn.ModuleList([trajectory, *residual])
    names = [name for name, _ in holder.named_parameters()]
    size = torch.tensor([300.0, 20.0, 1.5], dtype=torch.float64).reshape(3, 1, 1)

    class Likelihood(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.holder = holder

        def forward(self, impedance, noise):
            processes = replace(given.processes, noise_variance=noise)
            return lowrank.log_likelihood_given_impedance(processes, impedance * size)

    module = Likelihood()

    def function(impedance, noise, *parameters):
        values = {f"holder.{name}": value for name, value in zip(names, parameters, strict=True)}
        return torch.func.functional_call(module, values, (impedance, noise)) / 100.0

    parts = [given.impedance / size, given.processes.noise_variance, *holder.parameters()]
    return function, tuple(part.detach().clone().requires_grad_() for part in parts)


@torch.no_grad()
def test_a_step_in_the_number_of_features_hardly_moves_the_likelihood():
    given = problem("phase", groups=1)
    kernel = given.processes.trajectory
    extents = [Extent.of([given.features], column) for column in given.processes.layout.theta]

    def number(scale):
        kernel.lengthscale = scale
        return counts(kernel, extents, 2, FINE)[0]

    low, high = 0.15, 0.16
    assert number(low) > number(high)
    while high - low > 1e-9:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if number(middle) > number(high) else (low, middle)
    values = []
    for scale in (low, high):
        kernel.lengthscale = scale
        lowrank = LowRankEngine(given.features, False)
        values.append(lowrank.log_likelihood_given_impedance(given.processes, given.impedance))
    # Against a likelihood of some thousand nats, which such data have under impedance that they were not drawn with.
    torch.testing.assert_close(values[0], values[1], rtol=1e-6, atol=0)


@torch.no_grad()
def test_samples_may_be_cut_anywhere(monkeypatch):
    given = problem("phase")
    whole = LowRankEngine(given.features, True).log_likelihood_given_impedance(
        given.processes, given.impedance
    )
    monkeypatch.setattr("bayes_impedance.engines.lowrank.blocks.LARGEST", 7)
    cut = LowRankEngine(given.features, True).log_likelihood_given_impedance(given.processes, given.impedance)
    torch.testing.assert_close(cut, whole, rtol=1e-9, atol=0)


def test_blocks_hold_every_valid_sample_once_and_little_padding():
    given = thinned(problem("time"))
    column = given.processes.layout.trajectory
    valid = valid_rows(given.features)
    seen = torch.zeros_like(valid, dtype=torch.long)
    for batch in batches(given.features, column):
        seen[batch.group, batch.index[batch.valid]] += 1
        assert batch.valid.sum() >= 0.5 * batch.valid.numel() and batch.valid.numel() <= LARGEST
        for b, label in enumerate(batch.labels):
            rows = batch.index[b][batch.valid[b]]
            assert (given.features.inputs[0, batch.group, rows, column] == label).all()
    assert torch.equal(seen, valid.long())


@torch.no_grad()
@pytest.mark.parametrize("coupled", [False, True])
def test_design_matrices_are_force_and_trajectory_of_the_same_coefficients(coupled):
    given = problem("phase, residual and offset a trial")
    lowrank, processes = LowRankEngine(given.features, coupled, FINEST), given.processes
    design = lowrank.design(processes)
    x = given.features.inputs
    axes, groups, n = x.shape[:3]
    force = design.force(x, given.impedance)
    rows = (1, groups, axes * n) if coupled else (axes, groups, n)
    assert force.shape == (*rows, design.basis.size * (axes if coupled else 1))
    assert design.residual(x).shape[:-1] == rows
    # Cov[u, x_d⁽ʳ⁾] as the dense engine has it, whose blocks without labels are those of one group.
    dense = DenseGivenImpedance(replace(given.features, valid=None), coupled)
    for order, latent in enumerate(
        (Latent.DESIRED_POSITION, Latent.DESIRED_VELOCITY, Latent.DESIRED_ACCELERATION)
    ):
        known = given.impedance
        read = as_read(known, dense.coupled)
        cross = dense._cross(processes, read, given.features, read, latent)
        found = force @ design.trajectory(x, order).mT
        torch.testing.assert_close(found, cross, rtol=0, atol=1e-9 * cross.abs().max().item())


@torch.no_grad()
@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("case", ["phase", "phase, residual and offset a trial", "phase, shared residual"])
def test_coefficients_have_the_posterior_of_the_trajectory(case, coupled):
    given = problem(case, groups=1)
    lowrank, processes, x = LowRankEngine(given.features, coupled), given.processes, given.features.inputs
    design, solution = lowrank.coefficients(processes, given.impedance)
    rows = design.trajectory(x, 0)
    size = rows.shape[-1]
    precision = solution.factor @ solution.factor.mT
    covariance = rows @ torch.linalg.inv(precision)[..., :size, :size] @ rows.mT
    found = lowrank.posterior(processes, given.impedance, given.features, given.impedance)
    mean, variance = found[Latent.DESIRED_POSITION]
    shift = design.rows(mean - given.features.trajectory_mean[..., 0])
    torch.testing.assert_close((rows @ solution.mean[..., :size, None])[..., 0], shift, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(
        covariance.diagonal(dim1=-2, dim2=-1), design.rows(variance), rtol=1e-6, atol=1e-14
    )


@torch.no_grad()
@pytest.mark.parametrize("case", ["phase", "phase, residual and offset a trial", "time"])
@pytest.mark.parametrize("coupled", [False, True])
def test_a_group_without_samples_has_its_prior(case, coupled):
    given = problem(case)
    valid = valid_rows(given.features).clone()
    valid[1] = False
    features = replace(given.features, valid=valid)
    lowrank, dense = LowRankEngine(features, coupled), DenseGivenImpedance(features, coupled)
    values = lowrank.log_likelihood_given_impedance(given.processes, given.impedance)
    assert not values[:, 1].any() and values[:, 0].all()
    target = replace(given.features, valid=None)
    found = lowrank.posterior(given.processes, given.impedance, target, given.impedance)
    expected = dense.posterior(given.processes, given.impedance, target, given.impedance)
    for latent in LATENTS:
        (mean, variance), (mean0, variance0) = (result[latent] for result in (found, expected))
        torch.testing.assert_close(mean[:, 1], mean0[:, 1], rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(variance[:, 1], variance0[:, 1], rtol=1e-4, atol=1e-12)


@torch.no_grad()
def test_padded_targets_keep_their_prior_mean():
    given = problem("phase")
    found = LowRankEngine(given.features, False).posterior(
        given.processes, given.impedance, given.features, given.impedance
    )
    for mean, variance in found.values():
        assert bool(mean.isfinite().all()) and not variance[:, ~given.features.valid].any()


def reason(name, overrides, axes=("x", "y"), **changes):
    given = given_problem(name, overrides, axes, repetitions=2, rate=6.0)
    processes = replace(given.processes, **changes)
    text = unsupported(processes, given.features)
    with pytest.raises(ConfigurationError, match="the low-rank engine cannot hold this model: ") as caught:
        LowRankEngine(given.features, False).log_likelihood_given_impedance(processes, given.impedance)
    assert str(caught.value).endswith(str(text))
    return text


@pytest.mark.parametrize("case", CASES)
def test_what_it_holds_has_no_reason_against_it(case):
    given = problem(case)
    assert unsupported(given.processes, given.features, coupled=True) is None


@pytest.mark.parametrize("kernel", ["matern52", "rational_quadratic"])
def test_trajectories_of_many_features_are_refused(kernel):
    text = reason("phase", (f"model.desired_trajectory.kernel={kernel}", *NO_RESIDUAL))
    assert "whose accelerations few features carry, got " + kernel in text
    assert "engine.name=markov" in text


def test_four_inputs_of_the_trajectory_are_refused():
    text = reason("position_velocity", PLAIN)
    assert "expected a desired trajectory over at most 3 inputs, got 4" in text


def test_periodic_over_the_plane_is_refused():
    assert "expected a scalar phase with" in reason("position", PLAIN, periodic=True)


def test_residuals_that_are_not_stationary_kernels_are_refused():
    text = reason("phase", PLAIN, residual=(gpytorch.kernels.LinearKernel().double(),))
    assert "expected a residual force of stationary kernels, got LinearKernel" in text


def test_residuals_of_other_kernels_are_refused():
    text = reason("phase", (*SE, "model.residual.kernel=matern32", "model.residual.input=[time]"))
    assert "expected model.residual.kernel=squared_exponential, got matern32" in text


def test_residuals_over_four_inputs_are_refused():
    text = reason("phase", SE)
    assert "expected a residual force over at most 2 inputs, got 4" in text


def test_labels_that_differ_are_refused():
    given = given_problem("time", OFFSET, ("x",), repetitions=2, rate=6.0)
    inputs = given.features.inputs.clone()
    inputs[..., given.processes.layout.residual] = 0.0
    text = unsupported(given.processes, replace(given.features, inputs=inputs))
    assert "for the same trials, got labels of the two that differ" in text


@pytest.mark.parametrize("name", ["phase", "position"])
@pytest.mark.parametrize("coupled", [False, True])
def test_too_many_features_are_refused(name, coupled):
    given = given_problem(name, PLAIN, repetitions=2, rate=6.0)
    given.processes.trajectory.lengthscale = 4e-4
    text = unsupported(given.processes, given.features, coupled)
    assert "expected at most 2000 features, found that " in text
    assert ("for each of 2 coupled axes" in text) == coupled


def test_too_many_features_of_a_periodic_phase_are_refused():
    given = given_problem(
        "phase",
        (*PLAIN, "engine.impedance=map", "model.desired_trajectory.periodic=true"),
        repetitions=2,
        rate=6.0,
    )
    assert unsupported(given.processes, given.features) is None
    given.processes.trajectory.lengthscale = 1e-4
    assert "expected at most 2000 features" in unsupported(given.processes, given.features)


def test_noise_that_leaves_no_factor_is_refused():
    given = problem("phase")
    for noise in (-1.0, 1e-22):
        processes = Processes(
            given.processes.layout, given.processes.trajectory, (), torch.full((2, 1, 1), noise).double()
        )
        with pytest.raises(NotPositiveDefiniteError, match="Cholesky factor of the precision of"):
            LowRankEngine(given.features, False).log_likelihood_given_impedance(processes, given.impedance)
