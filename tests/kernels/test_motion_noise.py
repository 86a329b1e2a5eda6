"""What smoothed noise of the positions adds to the force: against loops over samples, and against filtered noise."""

from __future__ import annotations

import unittest
from typing import Any

import numpy as np
import pytest
import torch
from gpytorch.kernels import Kernel
from gpytorch.test.base_kernel_test_case import BaseKernelTestCase
from oracles import ProcessSpec, double, relative_error
from torch import Tensor

from bayes_impedance.kernels import (
    ImpedanceKernel,
    ImpedanceProcess,
    InputLayout,
    InteractionKernel,
    MotionNoiseKernel,
    StationaryKernel,
)
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.kernels.stationary import BatchedKernel
from bayes_impedance.preprocessing.savitzky_golay import SavitzkyGolay, motion_weights

COLUMNS = tuple(range(7))
#: ξ of stiffness follows the columns that the noise needs.
XI = 7
SPECS = (
    ProcessSpec("log_gaussian", 180.0, 0.4, (0.3,), "xi"),
    ProcessSpec("gaussian", 14.0, 4.0, (0.5,), "xi"),
    ProcessSpec("gaussian", 1.3, 0.3),
)
NOISE = 2e-4
NO_BATCH = torch.Size()


class Alone(BatchedKernel):
    """The noise with its processes, which elsewhere belong to an ImpedanceKernel."""

    def __init__(
        self, processes: list[ImpedanceProcess], batch_shape: torch.Size | None = None, **kwargs: Any
    ) -> None:
        super().__init__(batch_shape=batch_shape, **kwargs)
        self.processes = torch.nn.ModuleList(processes)
        self.noise = MotionNoiseKernel(COLUMNS, processes, motion_weights, batch_shape=batch_shape)

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: object) -> Tensor:
        """The kernel itself."""
        return self.noise.forward(x1, x2, diag)


def kernel_of() -> Alone:
    kernel = Alone([spec.kernel((XI,) if spec.lengthscale else None) for spec in SPECS]).double()
    kernel.noise.sd = double(NOISE)
    return kernel


def rows(
    smooth: SavitzkyGolay, n: int, trial: float = 0.0, every: int = 1, orders: int = 3, seed: int = 0
) -> Tensor:
    """Inputs of every so many of `n` native samples of a trial, with ξ somewhere."""
    first, place = smooth.windows(n)
    constants = (smooth.length, smooth.order, smooth.step, orders)
    xi = np.sort(np.random.default_rng(seed).normal(size=n))
    columns = [np.full(n, trial), first, place, *(np.full(n, value) for value in constants), xi]
    return torch.from_numpy(np.stack(columns, axis=1)[::every].astype(np.float64))


def matrix_of(smooth: SavitzkyGolay, n: int) -> np.ndarray:
    """The filter as matrices on the native samples, `(3, n, n)`: what it does to each unit vector."""
    return np.stack([smooth(np.eye(n), order) for order in range(3)])


def noise_of(smooth: SavitzkyGolay, n: int, every: int, specs: tuple[ProcessSpec, ...], xi: Tensor) -> Tensor:
    """Σ_ij E[w_i w_j'] S_ij in a loop over pairs, S from the filter's own matrices."""
    matrix = matrix_of(smooth, n)[:, ::every]
    second = [spec.second_moment(xi[:, None], xi[:, None]) for spec in specs]
    total = torch.zeros(len(xi), len(xi), dtype=torch.float64)
    for s in range(len(xi)):
        for t in range(len(xi)):
            for i, one in enumerate(specs):
                for j, two in enumerate(specs):
                    weight = float(second[i][s, t]) if i == j else one.expectation * two.expectation
                    total[s, t] += weight * NOISE**2 * float(matrix[i, s] @ matrix[j, t])
    return total


@pytest.mark.parametrize(
    ("smooth", "every"),
    [(SavitzkyGolay(21, 4, 0.005), 4), (SavitzkyGolay(11, 3, 0.01), 1), (SavitzkyGolay(9, 5, 0.02), 12)],
)
def test_equals_a_loop_over_pairs_up_to_the_ends_of_the_trial(smooth: SavitzkyGolay, every: int) -> None:
    x = rows(smooth, 60, every=every)
    kernel = kernel_of()
    expected = noise_of(smooth, 60, every, SPECS, x[:, XI])
    with torch.no_grad():
        value = kernel(x).to_dense()
        assert relative_error(value, expected) < 1e-12
        assert relative_error(kernel(x, x[2:5]).to_dense(), expected[:, 2:5]) < 1e-12
        assert relative_error(kernel(x, diag=True), expected.diagonal()) < 1e-12
        few = kernel(x[:1], x[-1:]).to_dense()
    assert few.shape == (1, 1)
    assert float(few) == 0.0
    # A window apart there is nothing left; the ends are noisier than the middle.
    assert bool((value[torch.abs(x[:, 1, None] - x[None, :, 1]) >= smooth.length] == 0).all())
    assert value[0, 0] > 3 * value[len(x) // 2, len(x) // 2]


def test_orders_that_do_not_come_from_positions_bring_no_noise() -> None:
    smooth = SavitzkyGolay(11, 4, 0.01)
    for orders in (1, 2):
        x = rows(smooth, 40, orders=orders)
        # What is logged by the robot has the weight 0.
        known = tuple(
            spec if order < orders else ProcessSpec("gaussian", 0.0, 0.0) for order, spec in enumerate(SPECS)
        )
        expected = noise_of(smooth, 40, 1, known, x[:, XI])
        assert relative_error(kernel_of()(x).to_dense(), expected) < 1e-12


def test_trials_are_independent_and_each_has_its_own_filter() -> None:
    slow, fast = SavitzkyGolay(11, 4, 0.01), SavitzkyGolay(21, 3, 0.004)
    one, two, padding = rows(slow, 30), rows(fast, 50, trial=1.0, seed=1), torch.zeros(4, XI + 1).double()
    kernel = kernel_of()
    with torch.no_grad():
        joint = kernel(torch.cat([one, two, padding])).to_dense()
        expected = torch.block_diag(kernel(one).to_dense(), kernel(two).to_dense(), padding[:, :4])
        variances = kernel(torch.cat([one, two, padding]), diag=True)
    torch.testing.assert_close(joint, expected, rtol=1e-13, atol=0.0)
    torch.testing.assert_close(variances, expected.diagonal(), rtol=1e-13, atol=0.0)


def test_equals_the_covariance_of_filtered_noise_times_drawn_impedance() -> None:
    """Σ_j w_j η̂⁽ʲ⁾ with white noise through the filter and w drawn from its prior."""
    smooth, n, every, draws = SavitzkyGolay(21, 4, 0.005), 60, 3, 40_000
    x = rows(smooth, n, every=every)
    rng = np.random.default_rng(3)
    eta = NOISE * rng.normal(size=(n, draws))
    total = np.zeros((len(x), draws))
    for order, spec in enumerate(SPECS):
        k = spec.gaussian(x[:, XI:], x[:, XI:]).numpy() + 1e-12 * spec.sd**2 * np.eye(len(x))
        g = np.linalg.cholesky(k) @ rng.normal(size=(len(x), draws))
        w = spec.level + g if spec.law == "gaussian" else spec.level * np.exp(g)
        total += w * smooth(eta, order)[::every]
    with torch.no_grad():
        expected = kernel_of()(x).to_dense().numpy()
    found = total @ total.T / draws
    error = np.sqrt(((total[:, None] * total[None]) ** 2).mean(-1) - found**2) / np.sqrt(draws)
    assert np.abs((found - expected) / error).max() < 5.0
    # Not that of noise which is white: neighbours differ from zero by far more.
    assert np.abs(np.diag(found, 1) / np.diag(error, 1)).max() > 30.0


def test_positive_semidefinite_with_any_thinning() -> None:
    for every in (1, 2, 7):
        x = torch.cat(
            [rows(SavitzkyGolay(21, 4, 0.005), 120, trial, every, seed=int(trial)) for trial in (0.0, 1.0)]
        )
        with torch.no_grad():
            value = kernel_of()(x).to_dense()
        torch.testing.assert_close(value, value.T, rtol=1e-12, atol=0.0)
        scale = value.diagonal().rsqrt()
        assert torch.linalg.eigvalsh(value * scale[:, None] * scale).min() > -1e-12


def test_gradients() -> None:
    x = rows(SavitzkyGolay(11, 4, 0.01), 30, every=2)
    kernel = kernel_of()
    parameters = dict(kernel.named_parameters())

    def covariance(*values: Tensor) -> Tensor:
        given = dict(zip(parameters, values, strict=True))
        return torch.func.functional_call(kernel, given, (x, x[3:9])).to_dense()

    assert torch.autograd.gradcheck(
        covariance, tuple(p.detach().clone().requires_grad_() for p in parameters.values()), rtol=1e-5
    )


def test_part_of_the_force_and_of_nothing_else() -> None:
    layout = InputLayout((7,), (6,), error=(7, 7, 7), smoothing=COLUMNS)
    processes = [spec.kernel((XI,) if spec.lengthscale else None) for spec in SPECS]
    impedance = ImpedanceKernel(layout, StationaryKernel().double(), *processes)
    noise = MotionNoiseKernel(layout.smoothing, processes, motion_weights).double()
    noise.sd = double(NOISE)
    without, carried = InteractionKernel(impedance), InteractionKernel(impedance, motion_noise=noise)
    x = rows(SavitzkyGolay(11, 4, 0.01), 30, every=2)
    with torch.no_grad():
        added = carried(x).to_dense() - without(x).to_dense()
        torch.testing.assert_close(added, noise(x).to_dense(), rtol=1e-6, atol=1e-9)
        for latent in Latent:
            if latent is not Latent.FORCE:
                theirs, ours = (k.cross_covariance(x, x[:4], latent) for k in (without, carried))
                assert torch.equal(theirs, ours)
                assert torch.equal(*(k.prior_variance(x, latent) for k in (without, carried)))
        more = carried.prior_variance(x, Latent.FORCE) - without.prior_variance(x, Latent.FORCE)
        torch.testing.assert_close(more, noise(x, diag=True), rtol=1e-6, atol=1e-9)
    # One set of hyperparameters, each listed once.
    assert len(list(carried.parameters())) == len(list(without.parameters())) + 1
    assert {id(p) for p in carried.parameters()} == {id(p) for p in without.parameters()} | {id(noise.raw_sd)}


def test_the_number_of_columns_is_checked() -> None:
    with pytest.raises(ValueError, match="columns: expected 7, got 2"):
        MotionNoiseKernel((0, 1), (), motion_weights)


class _OnWholeNumbers(Alone):
    """The battery's data are random reals: here two of their columns say trial and window."""

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: object) -> Tensor:
        """The kernel of windows that lie where the data say."""
        return super().forward(self._whole(x1), self._whole(x2), diag)

    @staticmethod
    def _whole(x: Tensor) -> Tensor:
        first, place = (10.0 * x[..., 0]).round(), (3.0 * x[..., 1]).round().clamp(-3.0, 3.0) + 3.0
        constants = [torch.full_like(first, value) for value in (7.0, 4.0, 1.0, 3.0)]
        return torch.stack([torch.zeros_like(first), first, place, *constants], dim=-1)


class TestMotionNoise(BaseKernelTestCase, unittest.TestCase):
    """gpytorch's own battery."""

    def setUp(self) -> None:
        super().setUp()
        torch.manual_seed(0)

    def create_kernel_no_ard(self, batch_shape: torch.Size = NO_BATCH, **kwargs: Any) -> Kernel:
        """Of constant impedance."""
        processes = []
        for _ in range(3):
            covariance = StationaryKernel(num_dims=0, batch_shape=batch_shape)
            processes.append(ImpedanceProcess(covariance, batch_shape=batch_shape))
        return _OnWholeNumbers(processes, batch_shape, **kwargs)
