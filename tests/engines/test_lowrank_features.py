"""Features against the kernels they stand for, and the regression on them against dense matrices."""

from functools import partial

import numpy as np
import pytest
import torch

from bayes_impedance.engines.lowrank.hilbert import (
    CHEAP,
    FINE,
    TIGHT,
    Accuracy,
    Extent,
    constant_basis,
    hilbert_basis,
)
from bayes_impedance.engines.lowrank.periodic import fourier_basis
from bayes_impedance.engines.lowrank.woodbury import Rows, Source, regress
from bayes_impedance.kernels.derivative import Path, derivative_table
from bayes_impedance.kernels.stationary import StationaryKernel

#: Relative to the largest ∂²∂'²k; products of several dimensions leave out what is at most twice as large again.
BOUNDS = {CHEAP: 1.5e-3, TIGHT: 2.2e-5, FINE: 1e-7, Accuracy(4.0, 7.5): 1e-10}


def kernel(scales, axes=2, sd=0.02):
    """One set of length scales an axis, the second axis 1.3 times the first."""
    result = StationaryKernel(num_dims=len(scales), batch_shape=torch.Size([axes, 1])).double()
    factor = torch.tensor([1.3**a for a in range(axes)], dtype=torch.float64).reshape(axes, 1, 1, 1)
    result.sd, result.lengthscale = sd, factor * torch.tensor(scales, dtype=torch.float64)
    return result


def path(dims, n, axes, half, seed=0, acceleration=True):
    generator = torch.Generator().manual_seed(seed)
    theta = half * (2.0 * torch.rand(1, 1, n, dims, generator=generator, dtype=torch.float64) - 1.0) + 0.7
    # The ends, where features are least accurate.
    theta[0, 0, 0], theta[0, 0, 1] = 0.7 - half, 0.7 + half
    a, b = (torch.randn(1, 1, n, dims, generator=generator, dtype=torch.float64) for _ in range(2))
    parts = (theta, a, b if acceleration else None)
    return Path(*(None if part is None else part.expand(axes, 1, n, dims) for part in parts))


def worst(process, basis, along, table):
    """Largest error of every ∂ⁱ∂'ʲ k, relative to the prior SDs of the two derivatives."""
    common, entries = table
    jet = basis.jet(along)
    truth = [[common * entry for entry in row] for row in entries]
    sd = [torch.as_tensor(truth[i][i]).diagonal(dim1=-2, dim2=-1).sqrt() for i in range(3)]
    return [
        [
            ((jet[i] @ jet[j].mT - truth[i][j]).abs() / (sd[i].unsqueeze(-1) * sd[j].unsqueeze(-2))).max()
            for j in range(3)
        ]
        for i in range(3)
    ]


@torch.no_grad()
@pytest.mark.parametrize("accuracy", BOUNDS, ids=lambda rule: f"{rule.margin:g}-{rule.cutoff:g}")
@pytest.mark.parametrize("scale", [0.05, 0.3, 4.0])
@pytest.mark.parametrize("acceleration", [True, False])
def test_scalar_features_are_the_kernel_and_its_derivatives(scale, accuracy, acceleration):
    process, along = kernel([scale]), path(1, 60, 2, 0.5, acceleration=acceleration)
    basis = hilbert_basis(process, (0,), [Extent(0.7, 0.5)], 2, accuracy)
    errors = worst(process, basis, along, derivative_table(process, along, along))
    assert max(map(max, errors)) < BOUNDS[accuracy]
    assert errors[0][0] < 0.02 * BOUNDS[accuracy]


@torch.no_grad()
@pytest.mark.parametrize("accuracy", [CHEAP, TIGHT, FINE])
@pytest.mark.parametrize("scales", [[0.3, 0.3], [0.15, 0.8]])
def test_features_over_a_plane_are_the_kernel_and_its_derivatives(scales, accuracy):
    process, along = kernel(scales), path(2, 60, 2, 0.5)
    basis = hilbert_basis(process, (0, 1), [Extent(0.7, 0.5)] * 2, 2, accuracy)
    errors = worst(process, basis, along, derivative_table(process, along, along))
    assert max(map(max, errors)) < 2.0 * BOUNDS[accuracy]
    products = np.prod([len(waves.frequency[0, 0, 0]) for waves in basis.waves])
    assert basis.size < 0.9 * products


@torch.no_grad()
def test_features_over_space_are_the_kernel_and_its_derivatives():
    process, along = kernel([0.5, 0.5, 0.9]), path(3, 40, 2, 0.25)
    basis = hilbert_basis(process, (0, 1, 2), [Extent(0.7, 0.25)] * 3, 2, TIGHT)
    assert basis.size < 0.6 * np.prod([len(waves.frequency[0, 0, 0]) for waves in basis.waves])
    errors = worst(process, basis, along, derivative_table(process, along, along))
    assert max(map(max, errors)) < 2.0 * BOUNDS[TIGHT]


@torch.no_grad()
def test_values_alone_are_those_of_the_jet():
    process, along = kernel([0.3, 0.4]), path(2, 20, 2, 0.5)
    basis = hilbert_basis(process, (1, 0), [Extent(0.7, 0.5)] * 2, 2, TIGHT)
    torch.testing.assert_close(basis.values(along.theta.flip(-1)), basis.jet(along).value)


@torch.no_grad()
def test_jets_are_the_time_derivatives_of_features():
    process = kernel([0.3, 0.4])
    basis = hilbert_basis(process, (0, 1), [Extent(0.0, 1.0)] * 2, 2, CHEAP)

    def features(t):
        theta = torch.stack([torch.sin(2.0 * t), torch.cos(3.0 * t)]).reshape(1, 1, 1, 2).expand(2, 1, 1, 2)
        return basis.values(theta)

    def derivative(function):
        return lambda t: torch.func.jvp(function, (t,), (torch.ones_like(t),))[1]

    t = torch.tensor(0.4, dtype=torch.float64)
    parts = [
        (torch.sin(2 * t), torch.cos(3 * t)),
        (2 * torch.cos(2 * t), -3 * torch.sin(3 * t)),
        (-4 * torch.sin(2 * t), -9 * torch.cos(3 * t)),
    ]
    jet = basis.jet(Path(*(torch.stack(part).reshape(1, 1, 1, 2).expand(2, 1, 1, 2) for part in parts)))
    expected = [features(t), derivative(features)(t), derivative(derivative(features))(t)]
    for found, value in zip(jet, expected, strict=True):
        torch.testing.assert_close(found, value, rtol=1e-11, atol=1e-13)


def turns(process, along, count=15):
    """Σ_n ∂ⁱ∂'ʲ k(r + n)."""
    total = [[torch.zeros(()) for _ in range(3)] for _ in range(3)]
    for n in range(-count, count + 1):
        common, table = derivative_table(process, along._replace(theta=along.theta + n), along)
        for i in range(3):
            for j in range(3):
                total[i][j] = total[i][j] + common * table[i][j]
    return torch.ones((), dtype=torch.float64), total


@torch.no_grad()
@pytest.mark.parametrize("accuracy", BOUNDS, ids=lambda rule: f"{rule.margin:g}-{rule.cutoff:g}")
@pytest.mark.parametrize("scale", [0.06, 0.15, 0.7])
def test_fourier_features_are_the_sum_over_turns(scale, accuracy):
    process, along = kernel([scale]), path(1, 60, 2, 0.5)
    basis = fourier_basis(process, 0, 2, accuracy)
    errors = worst(process, basis, along, turns(process, along))
    assert max(map(max, errors)) < BOUNDS[accuracy]


@torch.no_grad()
def test_phase_joined_at_its_ends_has_one_variance_everywhere():
    process = kernel([0.15])
    basis = fourier_basis(process, 0, 2, FINE)
    theta = torch.tensor([0.0, 0.01, 0.5, 1.0], dtype=torch.float64).reshape(1, 1, 4, 1).expand(2, 1, 4, 1)
    jet = basis.jet(Path(theta, torch.ones_like(theta), torch.zeros_like(theta)))
    for part in jet:
        torch.testing.assert_close(
            part[..., 0, :], part[..., 3, :], rtol=0, atol=1e-12 * part.abs().max().item()
        )
        variance = part.square().sum(-1)
        torch.testing.assert_close(variance, variance[..., :1].expand_as(variance), rtol=1e-9, atol=0)
    # Half a turn is 2.6 length scales of the longer one: the turns hardly overlap.
    torch.testing.assert_close(
        jet.value.square().sum(-1), process.sd.square()[..., 0].expand(2, 1, 4), rtol=1e-3, atol=0
    )


@torch.no_grad()
def test_constant_is_one_feature():
    offset = StationaryKernel(num_dims=0, batch_shape=torch.Size([2, 1])).double()
    offset.sd = 0.3
    values = constant_basis(offset, 2).values(torch.randn(2, 3, 5, 4, dtype=torch.float64))
    assert values.shape == (2, 3, 5, 1)
    assert torch.equal(values, torch.full_like(values, 0.3))


def random_rows(seed, sd=0.3, own=3, shared=4):
    """Two batches in one group (one of them padded) and one in another, one axis."""
    generator = torch.Generator().manual_seed(seed)
    batches = []
    for group, blocks, n in ((0, 2, 7), (1, 1, 9), (0, 1, 5)):
        parts = [
            torch.randn(1, blocks, n, size, generator=generator, dtype=torch.float64) / sd
            for size in (own, shared, 1)
        ]
        if blocks == 2:
            for part in parts:
                part[:, 1, 4:] = 0.0
        batches.append((group, Rows(parts[0], parts[1], parts[2][..., 0])))
    return batches


def stacked(batches, group):
    """The same rows with a column for each feature of each block."""
    chosen = [rows for of, rows in batches if of == group]
    own = [rows.own[0, b].numpy() for rows in chosen for b in range(rows.own.shape[1])]
    design = np.zeros((sum(map(len, own)), sum(part.shape[1] for part in own)))
    row = column = 0
    for part in own:
        design[row : row + part.shape[0], column : column + part.shape[1]] = part
        row, column = row + part.shape[0], column + part.shape[1]
    shared = np.concatenate([rows.shared[0].flatten(0, 1).numpy() for rows in chosen])
    return np.concatenate([design, shared], axis=1), np.concatenate(
        [rows.force[0].reshape(-1).numpy() for rows in chosen]
    )


@pytest.mark.parametrize("recompute", [False, True])
@pytest.mark.parametrize(("own", "shared"), [(3, 4), (0, 4), (3, 0)])
def test_regression_is_the_dense_quadratic_form_and_determinant(own, shared, recompute):
    batches = random_rows(0, own=own, shared=shared)
    solution = regress([Source(group, partial(tuple, rows)) for group, rows in batches], recompute)
    for group in range(2):
        design, force = stacked(batches, group)
        covariance = np.eye(len(force)) + design @ design.T
        np.testing.assert_allclose(
            solution.quadratic[0, group], force @ np.linalg.solve(covariance, force), rtol=1e-10
        )
        np.testing.assert_allclose(solution.log_det[0, group], np.linalg.slogdet(covariance)[1], rtol=1e-12)


def test_small_noise_loses_no_digits_of_the_quadratic_form():
    generator = torch.Generator().manual_seed(1)
    n, features, sd = 200, 12, 1e-5
    phase = torch.linspace(0.0, 1.0, n, dtype=torch.float64)
    design = torch.cos(phase.unsqueeze(-1) * torch.arange(features, dtype=torch.float64))
    weights, noise = (torch.randn(size, generator=generator, dtype=torch.float64) for size in (features, n))
    force = design @ weights / sd + noise
    rows = design[None, None] / sd
    solution = regress([Source(0, lambda: Rows(rows[..., :0], rows, force[None, None]))])
    # Householder's QR of the rows with those of the prior below them, which squares nothing.
    tall = np.concatenate([design.numpy() / sd, np.eye(features)])
    q, r = np.linalg.qr(tall)
    left = np.concatenate([force.numpy(), np.zeros(features)])
    left = left - q @ (q.T @ left)
    np.testing.assert_allclose(solution.quadratic.item(), left @ left, rtol=1e-5)
    # Cholesky's factor of what was squared: rounding of 1e-16 of the largest eigenvalue, against a smallest of 1.
    np.testing.assert_allclose(solution.log_det.item(), 2.0 * np.log(np.abs(np.diag(r))).sum(), atol=1e-2)
    gradient = (rows[0, 0].mT @ force).unsqueeze(-1)
    subtracted = force @ force - (gradient.mT @ torch.cholesky_solve(gradient, solution.factor[0, 0])).item()
    assert abs(subtracted.item() - left @ left) > 100.0 * abs(solution.quadratic.item() - left @ left)
