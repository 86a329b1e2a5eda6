"""Time derivatives of k_xd along a path, against nested autograd and closed forms."""

from __future__ import annotations

import math

import pytest
import torch
from oracles import (
    PROFILE_NAMES,
    SMOOTH,
    Samples,
    TrajectorySpec,
    configuration,
    number,
    path_derivatives,
    relative_error,
    samples_of,
    stacked,
)
from torch import Tensor

from bayes_impedance.kernels import StationaryKernel
from bayes_impedance.kernels.derivative import Path, derivative_table
from bayes_impedance.simulation.generative import repeated_motion

LENGTHS = (0.5, 0.8, 1.1, 0.7)


def random_samples(n: int, p: int, seed: int, batch: tuple[int, ...] = ()) -> Samples:
    generator = torch.Generator().manual_seed(seed)
    theta, a, b = torch.randn(3, *batch, n, p, generator=generator, dtype=torch.float64)
    return Samples(theta, a, b, theta)


def path_of(samples: Samples) -> Path:
    return Path(samples.theta, samples.velocity, samples.acceleration)


def products(kernel: StationaryKernel, one: Path, two: Path, **options: object) -> list[list[Tensor]]:
    common, table = derivative_table(kernel, one, two, **options)
    return [[common * entry for entry in row] for row in table]


@pytest.mark.parametrize("name", PROFILE_NAMES)
@pytest.mark.parametrize("p", [1, 2, 4])
def test_table_equals_nested_autograd(name: str, p: int) -> None:
    spec = TrajectorySpec(name, 0.7, LENGTHS[:p], alpha=0.8)
    one, two = random_samples(9, p, seed=1), random_samples(8, p, seed=2)
    expected = path_derivatives(spec.covariance, one, two)
    table = products(spec.kernel(), path_of(one), path_of(two))
    for i in range(3):
        for j in range(3):
            assert relative_error(table[i][j], expected[i][j]) < 1e-9, (i, j)


@pytest.mark.parametrize("name", PROFILE_NAMES)
@pytest.mark.parametrize("p", [1, 2])
def test_order_one_is_the_corner_of_order_two(name: str, p: int) -> None:
    kernel = TrajectorySpec(name, 0.7, LENGTHS[:p]).kernel()
    one, two = path_of(random_samples(6, p, seed=1)), path_of(random_samples(5, p, seed=2))
    full, corner = products(kernel, one, two), products(kernel, one, two, order=1)
    for i in range(2):
        for j in range(2):
            assert torch.equal(corner[i][j], full[i][j])


@pytest.mark.parametrize("name", PROFILE_NAMES)
def test_coincident_samples_equal_the_closed_form(name: str) -> None:
    # Autograd of √s is not defined at r = 0: there κ(0), κ'(0), κ''(0) alone decide.
    slopes = {
        "squared_exponential": (1.0, -1.0, 1.0),
        "rational_quadratic": (1.0, -1.0, 1.0 + 1.0 / 0.8),
        "matern52": (1.0, -5.0 / 3.0, 25.0 / 3.0),
        "matern72": (1.0, -7.0 / 5.0, 49.0 / 15.0),
        "matern92": (1.0, -9.0 / 7.0, 81.0 / 35.0),
    }[name]
    one = random_samples(6, 3, seed=3)
    spec = TrajectorySpec(name, 0.7, LENGTHS[:3], alpha=0.8)
    precision = torch.tensor(LENGTHS[:3], dtype=torch.float64) ** -2
    a, b = one.velocity, one.acceleration
    aa, ab, bb = ((u * precision * v).sum(-1) for u, v in ((a, a), (a, b), (b, b)))
    k0, k1, k2 = (0.49 * slope for slope in slopes)
    zero = torch.zeros_like(aa)
    expected = [
        [k0 + zero, zero, k1 * aa],
        [zero, -k1 * aa, -k1 * ab],
        [k1 * aa, -k1 * ab, 3.0 * k2 * aa**2 - k1 * bb],
    ]
    full = products(spec.kernel(), path_of(one), path_of(one))
    diagonal = products(spec.kernel(), path_of(one), path_of(one), diag=True)
    for i in range(3):
        for j in range(3):
            scale = (expected[i][i].abs().max() * expected[j][j].abs().max()).sqrt()
            assert (diagonal[i][j] - expected[i][j]).abs().max() < 1e-11 * scale, (i, j)
            assert (full[i][j].diagonal(dim1=-2, dim2=-1) - expected[i][j]).abs().max() < 1e-11 * scale, (
                i,
                j,
            )


@pytest.mark.parametrize("p", [1, 2, 4])
def test_matern_five_halves_is_continuous_at_coincident_samples(p: int) -> None:
    kernel = TrajectorySpec("matern52", 0.7, LENGTHS[:p]).kernel()
    here = path_of(random_samples(6, p, seed=3))
    at_zero = products(kernel, here, here, diag=True)
    direction = torch.ones(p, dtype=torch.float64) / math.sqrt(p)
    for distance in (1e-13, 1e-10, 1e-7, 1e-5):
        near = Path(here.theta + distance * direction, here.velocity, here.acceleration)
        table = products(kernel, here, near)
        for i in range(3):
            for j in range(3):
                value = table[i][j].diagonal()
                assert torch.isfinite(value).all()
                scale = (at_zero[i][i] * at_zero[j][j]).sqrt().max()
                # k22 has a kink: it changes in proportion to the distance.
                assert (value - at_zero[i][j]).abs().max() < (1e-12 + 200.0 * distance) * scale, (i, j)


@pytest.mark.parametrize("name", PROFILE_NAMES)
@pytest.mark.parametrize("diag", [False, True])
def test_no_acceleration_equals_zero_acceleration(name: str, diag: bool) -> None:
    kernel = TrajectorySpec(name, 0.7, LENGTHS[:2]).kernel()
    one, two = random_samples(6, 2, seed=1), random_samples(6, 2, seed=2)
    zero = torch.zeros_like(one.theta)
    if diag:
        two = one
    without = products(
        kernel, path_of(one)._replace(acceleration=None), path_of(two)._replace(acceleration=None), diag=diag
    )
    with_zero = products(
        kernel, path_of(one)._replace(acceleration=zero), path_of(two)._replace(acceleration=zero), diag=diag
    )
    for row, expected_row in zip(without, with_zero, strict=True):
        for entry, expected in zip(row, expected_row, strict=True):
            torch.testing.assert_close(entry, expected, rtol=1e-14, atol=1e-16)


@pytest.mark.parametrize("which", ["first", "second"])
def test_acceleration_of_one_side_only(which: str) -> None:
    # s21 = −bᵀPa' does not vanish because the other path has no acceleration.
    spec = TrajectorySpec("squared_exponential", 0.7, LENGTHS[:2])
    one, two = random_samples(6, 2, seed=1), random_samples(5, 2, seed=2)
    still = one if which == "second" else two
    silent = Samples(still.theta, still.velocity, torch.zeros_like(still.theta), still.theta)
    one, two = (silent, two) if which == "second" else (one, silent)
    expected = path_derivatives(spec.covariance, one, two)
    path1, path2 = path_of(one), path_of(two)
    if which == "second":
        path1 = path1._replace(acceleration=None)
    else:
        path2 = path2._replace(acceleration=None)
    table = products(spec.kernel(), path1, path2)
    for i in range(3):
        for j in range(3):
            assert relative_error(table[i][j], expected[i][j]) < 1e-9, (i, j)


@pytest.mark.parametrize("name", PROFILE_NAMES)
@pytest.mark.parametrize(
    ("theta", "lengths"),
    [
        ("time", (0.3,)),
        ("phase", (0.1,)),
        ("position", (0.06, 0.06)),
        ("position_velocity", (0.06, 0.06, 0.3, 0.3)),
    ],
)
def test_joint_covariance_of_position_velocity_acceleration_is_semidefinite(
    name: str, theta: str, lengths: tuple[float, ...]
) -> None:
    log = repeated_motion(repetitions=1, duration=4.0, rate=12.0, seed=4)
    samples = samples_of(configuration(trajectory_input=theta), log, axis=0)
    kernel = TrajectorySpec(name, 0.02, lengths, alpha=1.0).kernel()
    with torch.no_grad():
        joint = stacked(products(kernel, path_of(samples), path_of(samples)))
    scale = joint.diagonal().sqrt()
    values = torch.linalg.eigvalsh(joint / (scale[:, None] * scale[None]))
    assert values.min() >= -1e-8 * values.max()


@pytest.mark.parametrize("name", PROFILE_NAMES)
def test_batched_hyperparameters_broadcast(name: str) -> None:
    kernel = StationaryKernel(name, num_dims=2, batch_shape=torch.Size([3, 1])).double()
    kernel.sd = torch.tensor([0.5, 1.0, 2.0]).reshape(3, 1, 1, 1)
    kernel.lengthscale = torch.tensor([[0.4, 0.7], [1.0, 0.6], [0.8, 2.0]]).reshape(3, 1, 1, 2)
    one, two = random_samples(5, 2, 1, batch=(3, 4)), random_samples(6, 2, 2, batch=(3, 4))
    table, diagonal = (
        products(kernel, path_of(one), path_of(two)),
        products(kernel, path_of(one), path_of(one), diag=True),
    )
    for a in range(3):
        single = StationaryKernel(name, num_dims=2).double()
        single.sd, single.lengthscale = kernel.sd[a, 0], kernel.lengthscale[a, 0]
        for g in range(4):
            left, right = (Path(*(part[a, g] for part in path_of(side))) for side in (one, two))
            alone, alone_diagonal = products(single, left, right), products(single, left, left, diag=True)
            for i in range(3):
                for j in range(3):
                    assert relative_error(table[i][j][a, g], alone[i][j]) < 1e-12
                    difference = diagonal[i][j].expand(3, 4, 5)[a, g] - alone_diagonal[i][j]
                    assert number(difference.abs().max()) < 1e-12


@pytest.mark.parametrize("name", PROFILE_NAMES)
@pytest.mark.parametrize("p", [1, 2])
def test_gradients_by_hyperparameters_equal_finite_differences(name: str, p: int) -> None:
    kernel = TrajectorySpec(name, 0.7, LENGTHS[:p], alpha=0.8).kernel()
    one = path_of(random_samples(4, p, seed=1))
    other = path_of(random_samples(3, p, seed=2))
    # The second path begins with a sample of the first: r = 0 for one pair.
    two = Path(*(torch.cat([a[:1], b]) for a, b in zip(one, other, strict=True)))
    names = [name for name, _ in kernel.named_parameters()]

    def function(*values: Tensor) -> tuple[Tensor, ...]:
        state = dict(zip(names, values, strict=True))
        return tuple(
            torch.func.functional_call(
                _Table(kernel), {f"kernel.{k}": v for k, v in state.items()}, (one, two)
            )
        )

    values = [value.detach().clone().requires_grad_() for value in kernel.parameters()]
    assert torch.autograd.gradcheck(function, values, eps=1e-6, atol=1e-5, rtol=1e-5)


class _Table(torch.nn.Module):
    """The nine entries as a module's output, so that parameters can be replaced."""

    def __init__(self, kernel: StationaryKernel) -> None:
        super().__init__()
        self.kernel = kernel

    def forward(self, one: Path, two: Path) -> list[Tensor]:
        common, table = derivative_table(self.kernel, one, two)
        return [common * entry for row in table for entry in row]


@pytest.mark.parametrize("name", PROFILE_NAMES)
def test_gradients_are_finite_where_samples_coincide(name: str) -> None:
    kernel = TrajectorySpec(name, 0.7, LENGTHS[:2]).kernel()
    path = path_of(random_samples(5, 2, seed=1))
    common, table = derivative_table(kernel, path, path)
    total = sum((common * entry).sum() for row in table for entry in row)
    gradients = torch.autograd.grad(total, list(kernel.parameters()))
    assert all(torch.isfinite(gradient).all() for gradient in gradients)


def test_scaling_theta_scales_its_derivatives() -> None:
    # Phase in percent instead of [0, 1]: the same process in time.
    samples = random_samples(6, 1, seed=1)
    path = path_of(samples)
    percent = Path(*(100.0 * part for part in path))
    for name in SMOOTH:
        one = products(TrajectorySpec(name, 0.7, (0.5,)).kernel(), path, path)
        two = products(TrajectorySpec(name, 0.7, (50.0,)).kernel(), percent, percent)
        for i in range(3):
            for j in range(3):
                assert relative_error(two[i][j], one[i][j]) < 1e-12
