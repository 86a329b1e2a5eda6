"""The dense engine against torch.distributions and plain autograd through the whole covariance."""

from __future__ import annotations

import math
import re

import pytest
import torch
from gpytorch.kernels import AdditiveKernel, Kernel
from oracles import double, number
from torch import Tensor
from torch.distributions import MultivariateNormal

from bayes_impedance.engines import dense
from bayes_impedance.engines.dense import Factor, Observations, check_capacity, log_marginal_likelihood
from bayes_impedance.errors import NotPositiveDefiniteError, TooManySamplesError
from bayes_impedance.kernels import (
    ImpedanceKernel,
    ImpedanceProcess,
    InputLayout,
    InteractionKernel,
    StationaryKernel,
)

LAYOUT = InputLayout((0, 1), (2, 3), (4, 5), (6, 7, 8), trajectory=10)
WIDTH = 11
NO_BATCH = torch.Size()


def make_kernel(batch: torch.Size = NO_BATCH, profile: str = "squared_exponential") -> InteractionKernel:
    def stationary(*columns: int) -> StationaryKernel:
        return StationaryKernel(num_dims=len(columns), active_dims=columns or None, batch_shape=batch)

    processes = {
        "stiffness": ImpedanceProcess(stationary(9), batch_shape=batch),
        "damping": ImpedanceProcess(stationary(9), "gaussian", batch_shape=batch),
        "mass": ImpedanceProcess(stationary(), "gaussian", batch_shape=batch),
    }
    trajectory = StationaryKernel(profile, num_dims=2, batch_shape=batch)
    residual = AdditiveKernel(stationary(0, 1), stationary())
    kernel = InteractionKernel(ImpedanceKernel(LAYOUT, trajectory, **processes), residual).double()
    # Different numbers in every batch entry.
    step = 1.0 + 0.3 * torch.arange(batch.numel(), dtype=torch.float64).reshape(*batch, 1, 1)
    trajectory.sd, trajectory.lengthscale = 0.05 * step, 0.9 * step
    for process, level, sd in zip(processes.values(), (20.0, 5.0, 1.2), (0.3, 1.5, 0.2), strict=True):
        process.level, process.covariance.sd = level * step, sd * step.sqrt()
    return kernel


def make_data(n: int, batch: tuple[int, ...] = (), seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Inputs, residual and noise variance; two trajectory labels."""
    generator = torch.Generator().manual_seed(seed)
    inputs = torch.randn(*batch, n, WIDTH, generator=generator, dtype=torch.float64)
    inputs[..., 10] = (torch.arange(n) > n // 2).double()
    residual = 2.0 * torch.randn(*batch, n, generator=generator, dtype=torch.float64)
    noise = 0.5 + torch.rand(*batch, 1, generator=generator, dtype=torch.float64)
    return inputs, residual.requires_grad_(), noise.requires_grad_()


def by_autograd(
    kernel: Kernel, inputs: Tensor, residual: Tensor, noise: Tensor, jitter: float = 0.0
) -> Tensor:
    """log p through a dense K that autograd sees whole."""
    k = kernel(inputs, inputs).to_dense()
    added = noise + jitter * k.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True).detach()
    k = k + torch.diag_embed(added.expand(*k.shape[:-1]))
    return MultivariateNormal(torch.zeros_like(residual), covariance_matrix=0.5 * (k + k.mT)).log_prob(
        residual
    )


def assert_same(value: Tensor, expected: Tensor, leaves: list[Tensor]) -> None:
    """Values and gradients agree to 1e-9 of the largest entry of each gradient."""
    torch.testing.assert_close(value, expected, rtol=1e-9, atol=1e-12)
    weight = torch.linspace(0.5, 1.5, value.numel(), dtype=value.dtype).reshape(value.shape)
    ours = torch.autograd.grad((value * weight).sum(), leaves)
    theirs = torch.autograd.grad((expected * weight).sum(), leaves)
    for left, right in zip(ours, theirs, strict=True):
        assert left.shape == right.shape
        assert number((left - right).abs().max()) <= 1e-9 * number(right.abs().max())
        assert bool(right.any())


@pytest.mark.parametrize("profile", ["squared_exponential", "rational_quadratic", "matern52"])
@pytest.mark.parametrize("block_entries", [1, 700, 2**17])
def test_value_and_gradients(profile: str, block_entries: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dense, "BLOCK_ENTRIES", block_entries)
    kernel, (inputs, residual, noise) = make_kernel(profile=profile), make_data(41)
    value = log_marginal_likelihood(kernel, Observations(inputs, residual, noise))
    assert value.shape == ()
    assert_same(value, by_autograd(kernel, inputs, residual, noise), [*kernel.parameters(), residual, noise])


@pytest.mark.parametrize("block_entries", [1, 2**17])
def test_axes_and_groups_together(block_entries: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dense, "BLOCK_ENTRIES", block_entries)
    kernel = make_kernel(torch.Size([2, 1]))
    inputs, residual, _ = make_data(23, (2, 8))
    noise = double([[[0.5]], [[0.9]]]).requires_grad_()  # one an axis, shared by groups
    value = log_marginal_likelihood(kernel, Observations(inputs, residual, noise))
    assert value.shape == (2, 8)
    assert_same(value, by_autograd(kernel, inputs, residual, noise), [*kernel.parameters(), residual, noise])
    for a in range(2):
        alone = make_kernel()
        alone.load_state_dict({name: p[a, 0] for name, p in kernel.named_parameters()}, strict=False)
        for g in range(8):
            one = log_marginal_likelihood(alone, Observations(inputs[a, g], residual[a, g], noise[a, 0]))
            assert number(one) == pytest.approx(number(value[a, g]), rel=1e-11)


@pytest.mark.parametrize("block_entries", [1, 2**17])
def test_padding_equals_groups_without_it(block_entries: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dense, "BLOCK_ENTRIES", block_entries)
    kernel = make_kernel(torch.Size([2, 1]))
    inputs, residual, noise = make_data(25, (2, 3))
    lengths = (25, 13, 1)
    valid = torch.arange(25) < torch.tensor(lengths)[:, None]
    # Whatever stands in the padding must not matter.
    junk = torch.where(valid.unsqueeze(-1), inputs, 5.0)
    value = log_marginal_likelihood(kernel, Observations(junk, residual, noise, valid))
    assert value.shape == (2, 3)
    parts = []
    for g, n in enumerate(lengths):
        parts.append(by_autograd(kernel, inputs[:, [g], :n], residual[:, [g], :n], noise[:, [g]]))
    assert_same(value, torch.cat(parts, dim=1), [*kernel.parameters(), residual, noise])


def test_fixed_hyperparameters_get_no_gradient() -> None:
    kernel, (inputs, residual, noise) = make_kernel(), make_data(17)
    kernel.impedance.mass.raw_level.requires_grad_(False)
    log_marginal_likelihood(kernel, Observations(inputs, residual.detach(), noise.detach())).backward()
    assert kernel.impedance.mass.raw_level.grad is None
    assert kernel.impedance.stiffness.raw_level.grad is not None


def test_gradient_where_only_the_noise_is_free() -> None:
    kernel, (inputs, residual, noise) = make_kernel(), make_data(17)
    kernel.requires_grad_(False)
    value = log_marginal_likelihood(kernel, Observations(inputs, residual, noise))
    assert_same(value, by_autograd(kernel, inputs, residual, noise), [residual, noise])


def test_jitter_is_relative_to_the_mean_prior_variance() -> None:
    kernel, (inputs, residual, noise) = make_kernel(), make_data(19)
    value = log_marginal_likelihood(kernel, Observations(inputs, residual, noise), jitter=1e-2)
    assert number(value) == pytest.approx(
        number(by_autograd(kernel, inputs, residual, noise, 1e-2)), rel=1e-11
    )
    without = log_marginal_likelihood(kernel, Observations(inputs, residual, noise))
    assert abs(number(value - without)) > 1e-3
    # A force in other units: σ ten times as large, everything else as it was, shifts log p by −n log 10.
    scaled = make_kernel()
    for process in scaled.impedance.processes:
        process.level = 10.0 * process.level.detach()
    for process in scaled.impedance.processes[1:]:
        process.covariance.sd = 10.0 * process.covariance.sd.detach()
    for part in scaled.residual.kernels:
        part.sd = 10.0 * part.sd.detach()
    other = log_marginal_likelihood(scaled, Observations(inputs, 10.0 * residual, 100.0 * noise), jitter=1e-2)
    assert number(other) == pytest.approx(number(value) - 19 * math.log(10.0), rel=1e-10)


def test_not_positive_definite_names_jitter_and_remedy() -> None:
    kernel, (inputs, residual, _) = make_kernel(), make_data(12)
    twice = torch.cat([inputs, inputs], dim=-2)
    observations = Observations(twice, torch.cat([residual, residual]), double([-1e-3]))
    for call in (
        lambda: log_marginal_likelihood(kernel, observations, 1e-9),
        lambda: Factor(kernel, observations, 1e-9),
    ):
        with pytest.raises(
            NotPositiveDefiniteError, match=r"24 forces .* jitter 1e-09 .*raise engine\.jitter tenfold"
        ):
            call()
    log_marginal_likelihood(kernel, observations, 1e-2)


@pytest.mark.parametrize("valid", [None, (11, 6)])
def test_factor(valid: tuple[int, ...] | None) -> None:
    kernel = make_kernel()
    inputs, residual, noise = make_data(11, (2,))
    mask = None if valid is None else torch.arange(11) < torch.tensor(valid)[:, None]
    factor = Factor(kernel, Observations(inputs, residual, noise, mask))
    columns = torch.randn(2, 11, 4, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    white = factor.whiten(columns)
    assert not factor.alpha.requires_grad
    for g, n in enumerate(valid or (11, 11)):
        with torch.no_grad():
            k = kernel(inputs[g, :n]).to_dense()
            k = k + noise[g] * torch.eye(n, dtype=torch.float64)
            torch.testing.assert_close(
                factor.alpha[g, :n], torch.linalg.solve(k, residual[g, :n]), rtol=1e-9, atol=1e-11
            )
            expected = columns[g, :n].T @ torch.linalg.solve(k, columns[g, :n])
            torch.testing.assert_close(white[g].T @ white[g], expected, rtol=1e-9, atol=1e-11)
        assert not factor.alpha[g, n:].any()
        assert not white[g, n:].any()


def test_jitter_of_a_group_does_not_depend_on_padding() -> None:
    kernel, (inputs, residual, noise) = make_kernel(), make_data(20, (2,))
    valid = torch.arange(20) < torch.tensor([20, 7])[:, None]
    padded = log_marginal_likelihood(kernel, Observations(inputs, residual, noise, valid), jitter=1e-3)
    alone = log_marginal_likelihood(
        kernel, Observations(inputs[1, :7], residual[1, :7], noise[1]), jitter=1e-3
    )
    assert number(padded[1]) == pytest.approx(number(alone), rel=1e-12)


def test_capacity() -> None:
    check_capacity(4000, 4000, "group '0'")
    message = "group '7': expected at most engine.max_samples = 4000 samples in a group"
    with pytest.raises(TooManySamplesError, match=re.escape(message)) as error:
        check_capacity(5000, 4000, "group '7'")
    assert "for the dense engine, got 5000" in str(error.value)
    assert "GB" in str(error.value)
    assert "preprocessing.rate" in str(error.value)
