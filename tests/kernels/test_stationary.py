"""κ(s) and its derivatives, and the kernels that are built on them."""

import math

import pytest
import torch
from oracles import PROFILE_NAMES, TrajectorySpec, double, number, profile_of, relative_error
from torch import Tensor

from bayes_impedance.kernels import StationaryKernel
from bayes_impedance.kernels.derivative import Path, derivative_table
from bayes_impedance.kernels.stationary import PROFILES, Matern, half_squared_distance, lengthscale_from_paper

CASES = [
    ("squared_exponential", 1.0),
    ("rational_quadratic", 0.4),
    ("rational_quadratic", 1.0),
    ("rational_quadratic", 7.5),
    ("matern52", 1.0),
    ("matern72", 1.0),
    ("matern92", 1.0),
]


def points(n: int, p: int, seed: int = 0, batch: tuple[int, ...] = ()) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*batch, n, p, generator=generator, dtype=torch.float64)


def loop(spec: TrajectorySpec, x1: Tensor, x2: Tensor) -> Tensor:
    return torch.stack([torch.stack([spec.covariance(a, b) for b in x2]) for a in x1])


@pytest.mark.parametrize(("name", "alpha"), CASES)
def test_profile_and_four_derivatives_equal_autograd(name: str, alpha: float) -> None:
    s = torch.logspace(-2, 1.5, 60, dtype=torch.float64).requires_grad_()
    shape = torch.tensor(alpha, dtype=torch.float64)
    expected = profile_of(name, s, alpha)
    assert relative_error(PROFILES[name].value(s, shape), expected) < 1e-13
    common, ratios = PROFILES[name].derivatives(s, shape)
    for order in range(5):
        value = (common * ratios[order]).expand_as(s)
        # Each point relative to itself: autograd through √s loses a few digits at small s.
        torch.testing.assert_close(value, expected, rtol=1e-9 if order < 4 else 1e-7, atol=1e-13)
        (expected,) = torch.autograd.grad(expected.sum(), s, create_graph=True)


def test_lag_derivatives_of_matern_five_halves_at_zero() -> None:
    sd, length = 0.7, 0.3
    kernel = TrajectorySpec("matern52", sd, (length,)).kernel()
    path = Path(torch.full((1, 1), 0.4).double(), torch.ones(1, 1).double(), None)
    for diag in (False, True):
        common, table = derivative_table(kernel, path, path, diag=diag)
        # σ² (1, 0, −5/3ℓ², 0, 25/ℓ⁴) in the lag; ∂_tⁱ ∂_t'ʲ = (−1)ʲ of the lag derivative of order i + j.
        lag = [sd**2, 0.0, -5.0 * sd**2 / (3.0 * length**2), 0.0, 25.0 * sd**2 / length**4]
        for i in range(3):
            for j in range(3):
                expected = (-1) ** j * lag[i + j]
                assert number(common * table[i][j]) == pytest.approx(expected, rel=1e-11, abs=1e-12)


def test_length_scale_of_the_paper() -> None:
    assert lengthscale_from_paper(0.2) == pytest.approx(0.31622776601683794)
    length, r = lengthscale_from_paper(0.2), 0.17
    assert math.exp(-0.5 * (r / length) ** 2) == pytest.approx(math.exp(-(r**2) / 0.2))


@pytest.mark.parametrize(("name", "alpha"), CASES)
@pytest.mark.parametrize("p", [1, 3])
def test_kernel_equals_the_loop_over_pairs(name: str, alpha: float, p: int) -> None:
    spec = TrajectorySpec(name, 0.8, (0.5, 0.9, 1.7)[:p], alpha)
    x1, x2 = points(7, p), points(5, p, seed=1)
    kernel = spec.kernel()
    assert relative_error(kernel(x1, x2).to_dense(), loop(spec, x1, x2)) < 1e-13
    full = kernel(x1).to_dense()
    assert torch.equal(full, full.mT) or relative_error(full, full.mT) < 1e-15
    assert relative_error(kernel(x1, diag=True), full.diagonal()) < 1e-14
    assert torch.linalg.eigvalsh(full.detach()).min() > -1e-12


def test_one_length_scale_for_all_dimensions() -> None:
    kernel = StationaryKernel("matern72", num_dims=3, ard=False).double()
    kernel.lengthscale, kernel.sd = double(0.6), double(1.4)
    assert kernel.lengthscale.shape == (1, 1)
    x1, x2 = points(4, 3), points(6, 3, seed=1)
    expected = loop(TrajectorySpec("matern72", 1.4, (0.6, 0.6, 0.6)), x1, x2)
    assert relative_error(kernel(x1, x2).to_dense(), expected) < 1e-13


def test_constant_kernel_without_dimensions() -> None:
    kernel = StationaryKernel(num_dims=0, batch_shape=torch.Size([2])).double()
    kernel.sd = double([0.3, 0.5]).reshape(2, 1, 1)
    x1, x2 = points(4, 2), points(3, 2, seed=1)
    expected = double([0.09, 0.25]).reshape(2, 1, 1).expand(2, 4, 3)
    torch.testing.assert_close(kernel(x1, x2).to_dense(), expected)
    torch.testing.assert_close(kernel(x1, diag=True), expected[..., 0].expand(2, 4))
    assert not any("lengthscale" in name for name, _ in kernel.named_parameters())


@pytest.mark.parametrize("name", PROFILE_NAMES)
def test_batches_equal_one_at_a_time(name: str) -> None:
    kernel = StationaryKernel(name, num_dims=2, batch_shape=torch.Size([3, 1])).double()
    kernel.sd = torch.tensor([0.5, 1.0, 2.0]).reshape(3, 1, 1, 1)
    kernel.lengthscale = torch.tensor([[0.4, 0.7], [1.0, 0.6], [0.8, 2.0]]).reshape(3, 1, 1, 2)
    x1, x2 = points(5, 2, batch=(3, 4)), points(6, 2, seed=1, batch=(3, 4))
    full, diagonal = kernel(x1, x2).to_dense(), kernel(x1, diag=True)
    assert full.shape == (3, 4, 5, 6)
    assert diagonal.shape == (3, 4, 5)
    for a in range(3):
        one = StationaryKernel(name, num_dims=2).double()
        one.sd, one.lengthscale = kernel.sd[a, 0], kernel.lengthscale[a, 0]
        for g in range(4):
            assert relative_error(full[a, g], one(x1[a, g], x2[a, g]).to_dense()) < 1e-14
            assert relative_error(diagonal[a, g], one(x1[a, g], diag=True)) < 1e-14


def test_dtype_follows_hyperparameters() -> None:
    x = points(4, 1)
    assert StationaryKernel().double()(x).to_dense().dtype == torch.float64
    assert StationaryKernel()(x.float()).to_dense().dtype == torch.float32


@pytest.mark.parametrize("name", PROFILE_NAMES)
def test_far_from_the_origin(name: str) -> None:
    # Inputs of 1e4 are themselves rounded to 2e-12; a kernel that squared them first would lose all digits.
    spec = TrajectorySpec(name, 0.8, (0.5, 0.9))
    offset = torch.tensor([1e4, -3e4], dtype=torch.float64)
    x1, x2 = points(7, 2) + offset, points(5, 2, seed=1) + offset
    assert relative_error(spec.kernel()(x1, x2).to_dense(), loop(spec, x1, x2)) < 1e-10


def test_half_squared_distance_by_products_and_by_differences_agree() -> None:
    precision = torch.tensor([[2.0, 0.3, 5.0]], dtype=torch.float64)
    x1, x2 = points(8, 3), points(6, 3, seed=1)
    exact = half_squared_distance(x1, x2, precision, exact=True)
    assert relative_error(half_squared_distance(x1, x2, precision, exact=False), exact) < 1e-14
    assert number(half_squared_distance(x1, x1, precision, exact=True).diagonal().abs().max()) == 0.0


def test_hyperparameters_are_kept_on_a_log_scale() -> None:
    kernel = StationaryKernel("rational_quadratic").double()
    kernel.sd, kernel.lengthscale, kernel.shape = double(0.02), double(0.3), double(1.7)
    assert number(kernel.raw_sd) == pytest.approx(math.log(0.02))
    assert number(kernel.raw_lengthscale) == pytest.approx(math.log(0.3))
    assert number(kernel.raw_shape) == pytest.approx(math.log(1.7))
    assert number(kernel.precision) == pytest.approx(1.0 / 0.09)
    assert StationaryKernel("matern52").shape is None


def test_a_plain_number_is_set_in_double_precision() -> None:
    kernel = StationaryKernel("rational_quadratic").double()
    kernel.sd, kernel.lengthscale, kernel.shape = 0.02, 0.3, 1.7
    values = {name: number(getattr(kernel, name)) for name in ("sd", "lengthscale", "shape")}
    assert values == pytest.approx({"sd": 0.02, "lengthscale": 0.3, "shape": 1.7}, rel=1e-14)


def test_unknown_profile_is_refused() -> None:
    with pytest.raises(ValueError, match=r"profile: expected one of squared_exponential, .*, got 'matern62'"):
        StationaryKernel("matern62")
    with pytest.raises(ValueError, match=r"nu: expected 0\.5, 1\.5, 2\.5, .*, got 2\.0"):
        Matern(2.0)
    with pytest.raises(ValueError, match="expected a Matérn profile with nu of 2.5 or more"):
        Matern(1.5).derivatives(torch.ones(1))
