"""gpytorch's own battery for kernels, and our kernels inside an ordinary gpytorch model."""

from __future__ import annotations

import unittest
from typing import Any

import gpytorch
import pytest
import torch
from gpytorch.distributions import MultivariateNormal
from gpytorch.kernels import Kernel
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.test.base_kernel_test_case import BaseKernelTestCase
from oracles import PROFILE_NAMES, double, number
from torch import Tensor

from bayes_impedance.engines.dense import Observations, log_marginal_likelihood
from bayes_impedance.kernels import (
    ImpedanceKernel,
    ImpedanceProcess,
    InputLayout,
    InteractionKernel,
    InteractionMean,
    PDKernel,
    StationaryKernel,
)

NO_BATCH = torch.Size()
# The battery's data have 2, 4, 6 or 10 columns: every role is played by one of the first two.
LAYOUT = InputLayout(theta=(0,), theta_velocity=(1,), theta_acceleration=(0,), error=(0, 1, 0))


class _Battery(BaseKernelTestCase):
    """A fixed seed for the random data."""

    def setUp(self) -> None:
        super().setUp()
        torch.manual_seed(0)


def process(columns: tuple[int, ...] | None, batch_shape: torch.Size) -> ImpedanceProcess:
    """A process over all columns (None) or some; over none of them it is a constant."""
    width = 2 if columns is None else len(columns)
    covariance = StationaryKernel(
        num_dims=width, ard=False, active_dims=columns or None, batch_shape=batch_shape
    )
    covariance.sd = 0.3
    return ImpedanceProcess(covariance, batch_shape=batch_shape)


def parts(batch_shape: torch.Size = NO_BATCH) -> dict[str, Kernel]:
    """Trajectory, stiffness, damping and mass, which all take every column as ξ."""
    return {
        "trajectory": StationaryKernel(num_dims=1, batch_shape=batch_shape),
        "stiffness": process(None, batch_shape),
        "damping": process(None, batch_shape),
        "mass": process((), batch_shape),
    }


def impedance_kernel(batch_shape: torch.Size = NO_BATCH, **kwargs: Any) -> ImpedanceKernel:
    return ImpedanceKernel(LAYOUT, **parts(batch_shape), **kwargs)


class _StationaryBattery(_Battery):
    profile: str

    def create_kernel_no_ard(self, **kwargs: Any) -> Kernel:
        return StationaryKernel(self.profile, num_dims=2, ard=False, **kwargs)

    def create_kernel_ard(self, num_dims: int, **kwargs: Any) -> Kernel:
        return StationaryKernel(self.profile, num_dims=num_dims, **kwargs)


class TestSquaredExponential(_StationaryBattery, unittest.TestCase):
    profile = "squared_exponential"


class TestRationalQuadratic(_StationaryBattery, unittest.TestCase):
    profile = "rational_quadratic"


class TestMatern52(_StationaryBattery, unittest.TestCase):
    profile = "matern52"


class TestMatern72(_StationaryBattery, unittest.TestCase):
    profile = "matern72"


class TestMatern92(_StationaryBattery, unittest.TestCase):
    profile = "matern92"


class TestGaussianProcessOfImpedance(_Battery, unittest.TestCase):
    def create_kernel_no_ard(self, batch_shape: torch.Size = NO_BATCH, **kwargs: Any) -> Kernel:
        covariance = StationaryKernel(num_dims=2, ard=False, batch_shape=batch_shape)
        return ImpedanceProcess(covariance, "gaussian", batch_shape=batch_shape, **kwargs)


class TestLogGaussianProcessOfImpedance(_Battery, unittest.TestCase):
    def create_kernel_no_ard(self, batch_shape: torch.Size = NO_BATCH, **kwargs: Any) -> Kernel:
        covariance = StationaryKernel(num_dims=2, ard=False, batch_shape=batch_shape)
        return ImpedanceProcess(covariance, "log_gaussian", batch_shape=batch_shape, **kwargs)


class TestImpedanceKernel(_Battery, unittest.TestCase):
    def create_kernel_no_ard(self, batch_shape: torch.Size = NO_BATCH, **kwargs: Any) -> Kernel:
        return impedance_kernel(batch_shape, **kwargs)


class TestPDKernel(_Battery, unittest.TestCase):
    def create_kernel_no_ard(self, batch_shape: torch.Size = NO_BATCH, **kwargs: Any) -> Kernel:
        chosen = parts(batch_shape)
        return PDKernel(LAYOUT, chosen["trajectory"], chosen["stiffness"], chosen["damping"], **kwargs)


class TestInteractionKernel(_Battery, unittest.TestCase):
    def create_kernel_no_ard(self, batch_shape: torch.Size = NO_BATCH, **kwargs: Any) -> Kernel:
        residual = StationaryKernel(num_dims=2, ard=False, batch_shape=batch_shape)
        return InteractionKernel(impedance_kernel(batch_shape), residual, **kwargs)


@pytest.mark.parametrize("shape", [(2,), (3, 2)])
def test_indexing_a_batch_of_kernels_with_active_dims(shape: tuple[int, ...]) -> None:
    # gpytorch's own version indexes the buffer active_dims as though it were a hyperparameter.
    batch = torch.Size(shape)
    chosen = parts(batch)
    chosen["stiffness"] = process((0, 1), batch)
    kernel, x = ImpedanceKernel(LAYOUT, **chosen), torch.randn(*shape, 5, 2)
    with torch.no_grad():
        kernel.stiffness.raw_level.normal_()
    last = tuple(n - 1 for n in shape)
    torch.testing.assert_close(kernel[last](x[last]).to_dense(), kernel(x).to_dense()[last])
    assert {name for name, _ in kernel[last].named_parameters()} == {
        name for name, _ in kernel.named_parameters()
    }


def test_expanding_a_batch_adds_no_parameters() -> None:
    kernel = InteractionKernel(impedance_kernel(torch.Size([2])))
    expanded = kernel.expand_batch(torch.Size([3, 2]))
    assert {name for name, _ in expanded.named_parameters()} == {
        name for name, _ in kernel.named_parameters()
    }
    x = torch.randn(3, 2, 5, 2)
    torch.testing.assert_close(expanded(x).to_dense(), kernel(x).to_dense())


@pytest.mark.parametrize("dims", [(0,), (1,), (0, 1)])
def test_active_dims_of_the_parts(dims: tuple[int, ...]) -> None:
    # Columns that a part does not name leave it alone.
    x = torch.randn(2, 3, 2)
    chosen = parts()
    chosen["stiffness"], chosen["damping"] = process(dims, torch.Size()), process((0, 1), torch.Size())
    kernel = ImpedanceKernel(LAYOUT, **chosen)
    wider = torch.cat([x, torch.randn(2, 3, 2)], dim=-1)
    torch.testing.assert_close(kernel(wider).to_dense(), kernel(x).to_dense())


def test_every_profile_has_its_battery() -> None:
    assert {case.profile for case in _StationaryBattery.__subclasses__()} == set(PROFILE_NAMES)


# --- inside an ordinary gpytorch model ---------------------------------------------------------------


class ForceGP(gpytorch.models.ExactGP):
    """An ExactGP as anyone would write it, with our kernel and mean."""

    def __init__(self, x: Tensor, force: Tensor, likelihood: GaussianLikelihood, kernel: Kernel) -> None:
        super().__init__(x, force, likelihood)
        self.mean_module = InteractionMean(kernel)
        self.covar_module = kernel

    def forward(self, x: Tensor) -> MultivariateNormal:
        return MultivariateNormal(self.mean_module(x), self.covar_module(x))


def force_gp(residual_column: int | None = None) -> tuple[ForceGP, GaussianLikelihood]:
    """Sixty samples of a spring, damper and mass that are pulled along a sine."""
    t = torch.linspace(0.0, 3.0, 60, dtype=torch.float64)
    one = torch.ones_like(t)
    e, rate, change = 0.02 * torch.sin(5 * t), 0.1 * torch.cos(5 * t), -0.5 * torch.sin(5 * t)
    label = torch.zeros_like(t)
    label[30:] = 1.0
    x = torch.stack([t, one, 0.0 * one, e, rate, change, label], dim=-1)
    noise = torch.randn(60, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    force = 80.0 * e + 6.0 * rate + 1.1 * change + 0.05 * noise
    layout = InputLayout((0,), (1,), (2,), (3, 4, 5), trajectory=6, residual=residual_column)
    processes = {
        name: ImpedanceProcess(StationaryKernel(num_dims=0)) for name in ("stiffness", "damping", "mass")
    }
    kernel = InteractionKernel(
        ImpedanceKernel(layout, StationaryKernel("matern52"), **processes),
        StationaryKernel(active_dims=(0,)),
    ).double()
    for process, level in zip(processes.values(), (100.0, 9.0, 1.2), strict=True):
        process.level, process.covariance.sd = double(level), double(0.3)
    kernel.impedance.trajectory.sd = double(0.01)
    likelihood = GaussianLikelihood().double()
    likelihood.noise = double(0.05)
    return ForceGP(x, force, likelihood, kernel), likelihood


def exact_likelihood(model: ForceGP, likelihood: GaussianLikelihood) -> Tensor:
    """log p(u) in nats as gpytorch computes it, by Cholesky."""
    mll = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)
    with gpytorch.settings.max_cholesky_size(10_000):
        return mll(model(*model.train_inputs), model.train_targets) * model.train_targets.numel()


@pytest.mark.parametrize("residual_column", [None, 6])
def test_likelihood_and_gradients_equal_the_dense_engine(residual_column: int | None) -> None:
    model, likelihood = force_gp(residual_column)
    model.train()
    x, force = model.train_inputs[0], model.train_targets
    expected = exact_likelihood(model, likelihood)
    kernel = model.covar_module
    observations = Observations(x, force - model.mean_module(x), likelihood.noise)
    value = log_marginal_likelihood(kernel, observations)
    assert number(value) == pytest.approx(number(expected), rel=1e-10)
    parameters = [*kernel.parameters(), *likelihood.parameters()]
    for ours, theirs in zip(
        torch.autograd.grad(value, parameters), torch.autograd.grad(expected, parameters), strict=True
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-8, atol=1e-8)


def test_training_and_prediction_in_an_exact_gp() -> None:
    model, likelihood = force_gp()
    model.train()
    optimiser = torch.optim.Adam(model.parameters(), lr=0.05)
    losses = []
    for _ in range(15):
        optimiser.zero_grad()
        loss = -exact_likelihood(model, likelihood)
        loss.backward()
        optimiser.step()
        losses.append(number(loss))
    assert losses[-1] < losses[0] - 1.0
    model.eval()
    likelihood.eval()
    x, force = model.train_inputs[0], model.train_targets
    with torch.no_grad(), gpytorch.settings.max_cholesky_size(10_000):
        predicted = likelihood(model(x[::3]))
    kernel = model.covar_module
    with torch.no_grad():
        k = kernel(x).to_dense() + likelihood.noise * torch.eye(len(x), dtype=x.dtype)
        gain = torch.linalg.solve(k, kernel(x, x[::3]).to_dense())
        mean = model.mean_module(x[::3]) + gain.T @ (force - model.mean_module(x))
        variance = kernel(x[::3], diag=True) - (kernel(x, x[::3]).to_dense() * gain).sum(0) + likelihood.noise
    # gpytorch solves with its own jitter.
    torch.testing.assert_close(predicted.mean, mean, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(predicted.variance, variance, rtol=1e-4, atol=1e-6)
    assert number((predicted.mean - force[::3]).std()) < 0.1
