"""A phase joined at its ends: Fourier features against dense covariances summed over whole turns."""

from dataclasses import replace

import pytest
import torch

from bayes_impedance.engines import given_dense
from bayes_impedance.engines.given_dense import DenseGivenImpedance
from bayes_impedance.engines.given_impedance import LATENTS, diagonal_only
from bayes_impedance.engines.lowrank import Accuracy, LowRankEngine
from bayes_impedance.kernels.derivative import derivative_table
from bayes_impedance.kernels.impedance import Latent
from tests.engines.given import NO_RESIDUAL, given_problem

PERIODIC = (
    "model.desired_trajectory.kernel=squared_exponential",
    "engine.impedance=map",
    "model.desired_trajectory.periodic=true",
)
OVER_TIME = ("model.residual.kernel=squared_exponential", "model.residual.input=[time]")
#: So short that turns hardly overlap, as by default, and so long that they do.
SCALES = (0.08, 0.15, 0.5)
#: Frequencies of 8.5 / ℓ have e^(−36) of the spectrum at 0.
FINEST = Accuracy(4.5, 8.5)
TURNS = 8


@pytest.fixture
def over_turns(monkeypatch):
    """Dense covariances are Σ_n k(r + n) and its derivatives, each turn a path shifted by n."""

    def table(kernel, path1, path2, order=2, diag=False):
        total = [[torch.zeros(()) for _ in range(3)] for _ in range(3)]
        for n in range(-TURNS, TURNS + 1):
            common, part = derivative_table(kernel, path1._replace(theta=path1.theta + n), path2, order)
            for i in range(3):
                for j in range(3):
                    entry = common * part[i][j]
                    total[i][j] = total[i][j] + (entry.diagonal(dim1=-2, dim2=-1) if diag else entry)
        return torch.ones((), dtype=torch.float64), total

    monkeypatch.setattr(given_dense, "derivative_table", table)


def problem(scale=0.15, residual=NO_RESIDUAL, **settings):
    given = given_problem("phase", (*PERIODIC, *residual), **{"rate": 8.0, "groups": 2, **settings})
    assert given.processes.periodic
    given.processes.trajectory.lengthscale = scale
    return given


def at_phases(given, phases):
    """Targets at these phases, that move at one pace; padding of the data goes with them."""
    inputs = given.features.inputs[:, :, : len(phases)].clone()
    layout = given.processes.layout
    for columns, value in (
        (layout.theta, torch.tensor(phases, dtype=torch.float64)),
        (layout.theta_velocity, 0.4),
        (layout.theta_acceleration, 0.0),
    ):
        inputs[..., columns[0]] = value
    mean = torch.zeros_like(given.features.trajectory_mean[:, :, : len(phases)])
    return replace(given.features, inputs=inputs, trajectory_mean=mean, force=None, valid=None, rows=())


@pytest.mark.usefixtures("over_turns")
@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("residual", [NO_RESIDUAL, OVER_TIME])
@pytest.mark.parametrize("scale", SCALES)
def test_likelihood_and_posterior_are_those_of_the_sum_over_turns(scale, residual, coupled):
    given = problem(scale, residual)
    dense = DenseGivenImpedance(given.features, coupled)
    lowrank = LowRankEngine(given.features, coupled, FINEST)
    with torch.no_grad():
        torch.testing.assert_close(
            lowrank.log_likelihood_given_impedance(given.processes, given.impedance),
            dense.log_likelihood_given_impedance(given.processes, given.impedance),
            rtol=1e-8,
            atol=1e-8,
        )
    # Beyond the ends of the recorded phase, which they join.
    phases = [0.0, 0.005, 0.3, 0.77, 0.995, 1.0]
    target = at_phases(given, phases)
    impedance = given.impedance[:, : len(phases)]
    expected = dense.posterior(given.processes, given.impedance, target, impedance)
    found = lowrank.posterior(given.processes, given.impedance, target, impedance)
    for latent in LATENTS:
        (mean, variance), (mean0, variance0) = found[latent], expected[latent]
        sd = variance0.sqrt() + 1e-12
        # In posterior SDs; variances of the dense engine are differences of numbers up to 1e4 times as large.
        assert ((mean - mean0).abs() / sd).max() < 1e-6, latent
        torch.testing.assert_close(variance, variance0, rtol=1e-6, atol=1e-12)


@pytest.mark.usefixtures("over_turns")
@pytest.mark.parametrize("coupled", [False, True])
def test_gradient_is_that_of_the_sum_over_turns(coupled):
    given = problem()
    gradients = []
    for engine in (
        DenseGivenImpedance(given.features, coupled),
        LowRankEngine(given.features, coupled, FINEST),
    ):
        impedance = given.impedance.clone().requires_grad_()
        value = engine.log_likelihood_given_impedance(given.processes, impedance).sum()
        names = dict(given.model.named_parameters())
        chosen = [names[name] for name in names if "impedance.trajectory" in name or "noise" in name]
        assert len(chosen) == 3
        found = torch.autograd.grad(value, [impedance, *chosen])
        gradients.append([found[0] if coupled else diagonal_only(found[0]), *found[1:]])
    for ours, dense in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, dense, rtol=1e-6, atol=1e-7 * dense.abs().max().item())


@torch.no_grad()
def test_both_ends_of_the_phase_have_one_posterior():
    given = problem(groups=1)
    # The last quarter is not observed: what is known of it comes from both sides.
    known = given.features.inputs[0, :, :, given.processes.layout.theta[0]] < 0.75
    features = replace(given.features, valid=known)
    target = at_phases(given, [0.0, 1.0, 0.875])
    found = LowRankEngine(features, False).posterior(
        given.processes, given.impedance, target, given.impedance[:, :3]
    )
    for latent in (Latent.DESIRED_POSITION, Latent.DESIRED_VELOCITY, Latent.DESIRED_ACCELERATION):
        mean, variance = found[latent]
        torch.testing.assert_close(mean[..., 0], mean[..., 1], rtol=0, atol=1e-9)
        torch.testing.assert_close(variance[..., 0], variance[..., 1], rtol=1e-9, atol=0)
    mean, variance = found[Latent.DESIRED_POSITION]
    prior = given.processes.trajectory.sd.square()[..., 0]
    # The middle of what is not observed is known least, and no better than by the prior.
    assert (variance[..., 2] > variance[..., 0]).all() and (variance[..., 2] < 1.01 * prior[..., 0]).all()


@torch.no_grad()
@pytest.mark.parametrize("coupled", [False, True])
def test_prior_variance_is_not_halved_at_the_seam(coupled):
    given = problem(groups=1)
    # Forces that say nothing leave the prior.
    processes = replace(given.processes, noise_variance=torch.full((2, 1, 1), 1e12, dtype=torch.float64))
    target = at_phases(given, [0.0, 0.25, 0.5, 1.0])
    found = LowRankEngine(given.features, coupled).posterior(
        processes, given.impedance, target, given.impedance[:, :4]
    )
    _, variance = found[Latent.DESIRED_POSITION]
    expected = processes.trajectory.sd.square()[..., 0].expand_as(variance)
    torch.testing.assert_close(variance, expected, rtol=1e-6, atol=0)
