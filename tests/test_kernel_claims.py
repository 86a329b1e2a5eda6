"""What notebooks/01_impedance_kernel.ipynb says of the kernels, against derivatives of e^{−τ²/2ℓ²} by hand."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from oracles import ProcessSpec, TrajectorySpec, double, relative_error
from scipy.optimize import brentq
from torch import Tensor

from bayes_impedance.kernels import (
    ImpedanceKernel,
    ImpedanceProcess,
    InputLayout,
    InteractionKernel,
    PDKernel,
    StationaryKernel,
)
from bayes_impedance.kernels.derivative import derivative_table
from bayes_impedance.kernels.stationary import lengthscale_from_paper

Array = NDArray[np.float64]

#: Rows (t, 1) over time, or (x, ẋ) over position.
LAYOUT = InputLayout(theta=(0,), theta_velocity=(1,))


@dataclass(frozen=True)
class Arm:
    """Gaussian k [N/m], d [Ns/m], m [kg] and x_d with SD [m] and ℓ [s or m]."""

    stiffness: float = 0.0
    damping: float = 0.0
    mass: float = 0.0
    #: SD over mean of k, d and m.
    spread: float = 0.0
    trajectory_sd: float = 0.01
    lengthscale: float = 0.158

    def pd(self, impedance_lengthscale: float | None = None) -> ImpedanceKernel:
        """Without mass; k and d constant, or varying with the first column over that ℓ."""
        return PDKernel(
            LAYOUT,
            self._trajectory(),
            self._process(self.stiffness, impedance_lengthscale),
            self._process(self.damping, impedance_lengthscale),
        )

    def impedance(self) -> ImpedanceKernel:
        """All three, constant."""
        levels = (self.stiffness, self.damping, self.mass)
        return ImpedanceKernel(LAYOUT, self._trajectory(), *(self._process(level, None) for level in levels))

    def _trajectory(self) -> StationaryKernel:
        return TrajectorySpec(sd=self.trajectory_sd, lengthscale=(self.lengthscale,)).kernel()

    def _process(self, level: float, lengthscale: float | None) -> ImpedanceProcess:
        if lengthscale is None:
            return ProcessSpec("gaussian", level, self.spread * level).kernel()
        return ProcessSpec("gaussian", level, self.spread * level, (lengthscale,)).kernel((0,))

    def derivative(self, order: int, lag: Array | float) -> Array:
        """κ⁽ⁿ⁾(τ) = σ² (−1)ⁿ He_n(τ/ℓ) e^{−τ²/2ℓ²} / ℓⁿ."""
        z = np.asarray(lag) / self.lengthscale
        hermite = [1.0 + 0.0 * z, z, z**2 - 1.0, z**3 - 3.0 * z, z**4 - 6.0 * z**2 + 3.0][order]
        scale = self.trajectory_sd**2 / (-self.lengthscale) ** order
        return scale * hermite * np.exp(-0.5 * z**2)


def with_velocity(x: Array | float, velocity: float) -> Tensor:
    x = np.atleast_1d(x)
    return torch.from_numpy(np.stack([x, np.full_like(x, velocity)], axis=-1))


def between(kernel: ImpedanceKernel, x: Array | float, v: float, y: Array | float, w: float) -> Array:
    """Cov[u(x, v), u(y, w)] [N²]."""
    with torch.no_grad():
        return kernel(with_velocity(x, v), with_velocity(y, w)).to_dense().numpy()


def over_lag(kernel: ImpedanceKernel, lag: Array | float) -> Array:
    """Covariance of the force now with the force `lag` later, time running at 1 s/s."""
    return between(kernel, 0.0, 1.0, lag, 1.0)[0]


def zero_crossings(function: Callable[[float], float], grid: Array) -> list[float]:
    values = np.array([function(point) for point in grid])
    return [
        brentq(function, grid[i], grid[i + 1], xtol=1e-13)
        for i in np.flatnonzero(values[:-1] * values[1:] < 0.0)
    ]


LENGTHS = (0.08, 0.158, 0.9)
SPREADS = (0.0, 0.2)
#: Arms in which stiffness, damping and mass dominate in turn.
ARMS = [
    Arm(stiffness, damping, mass, spread, lengthscale=length)
    for (stiffness, damping, mass), spread, length in itertools.product(
        ((300.0, 15.0, 3.0), (100.0, 40.0, 3.0), (20.0, 2.0, 5.0)), SPREADS, LENGTHS
    )
]


def identify(arm: Arm) -> str:
    return f"k{arm.stiffness:g}-d{arm.damping:g}-m{arm.mass:g}-s{arm.spread:g}-l{arm.lengthscale:g}"


@pytest.fixture(params=ARMS, ids=identify)
def arm(request: pytest.FixtureRequest) -> Arm:
    return request.param


@pytest.fixture
def lag(arm: Arm) -> Array:
    return np.linspace(-6.0, 6.0, 241) * arm.lengthscale


def assert_close(value: Array, expected: Array) -> None:
    # Sums of a few terms of one size; none of them is larger than a hundred times the result.
    assert np.abs(value - expected).max() <= 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("parameters", [(0.2,), (0.05,), (0.05, 0.3)])
def test_lengths_of_the_paper(parameters: tuple[float, ...]) -> None:
    spec = TrajectorySpec(sd=0.01, lengthscale=tuple(lengthscale_from_paper(value) for value in parameters))
    points = np.random.default_rng(0).normal(scale=0.4, size=(2, 9, len(parameters)))
    r = points[0][:, None] - points[1][None]
    in_the_paper = 0.01**2 * np.exp(-(r**2 / np.array(parameters)).sum(-1))
    with torch.no_grad():
        value = spec.kernel()(torch.from_numpy(points[0]), torch.from_numpy(points[1])).to_dense()
    assert relative_error(value, torch.from_numpy(in_the_paper)) < 1e-13


class TestOverTime:
    def test_pd_kernel_without_stiffness_is_that_of_the_derivative(self, arm: Arm, lag: Array) -> None:
        damper = Arm(damping=arm.damping, spread=arm.spread, lengthscale=arm.lengthscale)
        weight = arm.damping**2 * (1.0 + arm.spread**2)
        assert_close(over_lag(damper.pd(), lag), -weight * damper.derivative(2, lag))

    def test_mass_alone_is_the_second_derivative(self, arm: Arm, lag: Array) -> None:
        mass = Arm(mass=arm.mass, spread=arm.spread, lengthscale=arm.lengthscale)
        weight = arm.mass**2 * (1.0 + arm.spread**2)
        assert_close(over_lag(mass.impedance(), lag), weight * mass.derivative(4, lag))

    def test_pd_kernel_of_a_constant_arm(self, arm: Arm, lag: Array) -> None:
        # E[k²] κ − E[d²] κ″; the products E[k] E[d] cancel.
        grown = 1.0 + arm.spread**2
        expected = grown * (
            arm.stiffness**2 * arm.derivative(0, lag) - arm.damping**2 * arm.derivative(2, lag)
        )
        assert_close(over_lag(arm.pd(), lag), expected)

    def test_impedance_kernel_of_a_constant_arm(self, arm: Arm, lag: Array) -> None:
        # E[k²] κ − (E[d²] − 2 E[k] E[m]) κ″ + E[m²] κ⁗
        grown = 1.0 + arm.spread**2
        expected = (
            grown * arm.stiffness**2 * arm.derivative(0, lag)
            - (grown * arm.damping**2 - 2.0 * arm.stiffness * arm.mass) * arm.derivative(2, lag)
            + grown * arm.mass**2 * arm.derivative(4, lag)
        )
        assert_close(over_lag(arm.impedance(), lag), expected)

    def test_spectrum_is_that_of_the_intention_times_mean_square_impedance(self, arm: Arm) -> None:
        lag = np.linspace(-10.0, 10.0, 2001) * arm.lengthscale
        omega = np.linspace(0.0, 5.0, 26) / arm.lengthscale
        # For e^{−τ²/2ℓ²} the trapezoidal rule is exact to rounding at this spacing.
        covariance = over_lag(arm.impedance(), lag)
        spectrum = np.trapezoid(covariance * np.cos(omega[:, None] * lag), lag, axis=1)
        response = arm.stiffness - arm.mass * omega**2 + 1j * arm.damping * omega
        parts = np.stack([0.0 * omega + arm.stiffness, arm.damping * omega, arm.mass * omega**2])
        mean_square = np.abs(response) ** 2 + arm.spread**2 * (parts**2).sum(0)
        intention = (
            arm.trajectory_sd**2
            * arm.lengthscale
            * math.sqrt(2.0 * math.pi)
            * np.exp(-0.5 * (arm.lengthscale * omega) ** 2)
        )
        expected = mean_square * intention
        assert np.abs(spectrum - expected).max() <= 1e-11 * expected.max()


class TestLobesOverTime:
    """Zeros and extremes of Hermite polynomials times a Gaussian."""

    @pytest.mark.parametrize("length", LENGTHS)
    @pytest.mark.parametrize(
        ("element", "crossings"),
        [
            ("stiffness", ()),
            ("damping", (1.0,)),
            ("mass", (math.sqrt(3.0 - math.sqrt(6.0)), math.sqrt(3.0 + math.sqrt(6.0)))),
        ],
    )
    def test_each_derivative_adds_a_pair_of_zero_crossings(
        self, element: str, crossings: tuple[float, ...], length: float
    ) -> None:
        kernel = Arm(**{element: 1.0}, lengthscale=length).impedance()
        # No point of the grid is a zero.
        found = zero_crossings(lambda z: over_lag(kernel, z * length)[0], np.linspace(-6.03, 6.01, 301))
        expected = sorted([*crossings, *(-z for z in crossings)])
        assert found == pytest.approx(expected, abs=1e-9)

    @pytest.mark.parametrize("length", LENGTHS)
    @pytest.mark.parametrize(
        ("element", "deepest"),
        [("damping", math.sqrt(3.0)), ("mass", math.sqrt(5.0 - math.sqrt(10.0)))],
    )
    def test_deepest_lobe(self, element: str, deepest: float, length: float) -> None:
        kernel = Arm(**{element: 1.0}, lengthscale=length).impedance()
        z = np.linspace(0.0, 6.0, 6001)
        covariance = over_lag(kernel, z * length)
        assert z[covariance.argmin()] == pytest.approx(deepest, abs=0.5e-3)
        ratio = {
            "damping": -2.0 * math.exp(-1.5),
            "mass": (deepest**4 - 6.0 * deepest**2 + 3.0) / 3.0 * math.exp(-0.5 * deepest**2),
        }[element]
        # At an extreme, half a step of the grid matters to second order.
        assert covariance.min() / covariance[0] == pytest.approx(ratio, abs=1e-6)

    def test_lobe_of_the_pd_kernel_deepens_with_damping_over_stiffness(self) -> None:
        # (1 + ρ − ρ z²) e^{−z²/2} is least at z² = 3 + 1/ρ, where it is −2ρ e^{−z²/2}.
        depths = []
        z = np.linspace(0.0, 8.0, 8001)
        for damping in (15.0, 40.0, 200.0):
            arm = Arm(stiffness=100.0, damping=damping)
            rho = (damping / (arm.stiffness * arm.lengthscale)) ** 2
            covariance = over_lag(arm.pd(), z * arm.lengthscale)
            assert z[covariance.argmin()] == pytest.approx(math.sqrt(3.0 + 1.0 / rho), abs=0.5e-3)
            depths.append(covariance.min() / covariance[0])
            expected = -2.0 * rho / (1.0 + rho) * math.exp(-0.5 * (3.0 + 1.0 / rho))
            assert depths[-1] == pytest.approx(expected, rel=1e-6)
        assert depths == sorted(depths, reverse=True)

    def test_mass_lowers_the_variance_of_a_slow_intention_and_raises_that_of_a_fast_one(self) -> None:
        # E[m²] κ⁗(0) + 2 E[k] E[m] κ″(0) changes sign at ℓ = √(3 m / 2 k).
        critical = math.sqrt(1.5 * 3.0 / 300.0)
        for length, sign in ((1.01 * critical, -1.0), (0.99 * critical, 1.0)):
            arm = Arm(300.0, 15.0, 3.0, lengthscale=length)
            assert sign * (over_lag(arm.impedance(), 0.0) - over_lag(arm.pd(), 0.0))[0] > 0.0


class Motion(NamedTuple):
    """A hand that sways around a reference: kernel, its inputs, and the terms by hand."""

    kernel: InteractionKernel
    x: Tensor
    terms: list[Array]


class TestTerms:
    @pytest.fixture(params=itertools.product((0.1, 0.4), (0.2, 0.6)), ids=lambda p: f"s{p[0]:g}-l{p[1]:g}")
    def motion(self, request: pytest.FixtureRequest) -> Motion:
        log_sd, length = request.param
        t = np.linspace(0.0, 2.0, 33)
        omega = 2.0 * math.pi / 1.6
        error = np.stack([0.02 * omega**j * np.sin(omega * t + 0.5 * j * math.pi) for j in range(3)])
        x = torch.from_numpy(np.vstack([t, np.ones_like(t), error]).T.copy())
        specs = (
            ProcessSpec("log_gaussian", 300.0, log_sd, (0.6,)),
            ProcessSpec("log_gaussian", 15.0, log_sd, (0.4,)),
            ProcessSpec("gaussian", 3.0, 0.3),
        )
        stiffness, damping, mass = specs[0].kernel((0,)), specs[1].kernel((0,)), specs[2].kernel()
        layout = InputLayout(theta=(0,), theta_velocity=(1,), error=(2, 3, 4))
        trajectory = TrajectorySpec(lengthscale=(length,), sd=0.01).kernel()
        residual = ProcessSpec("gaussian", 1.0, 2.0, (0.15,)).kernel((0,)).covariance
        kernel = InteractionKernel(ImpedanceKernel(layout, trajectory, stiffness, damping, mass), residual)

        lag = t[None, :] - t[:, None]
        arm = Arm(trajectory_sd=0.01, lengthscale=length)
        # ∂_tⁱ ∂_t'ʲ κ(t' − t) = (−1)ⁱ κ⁽ⁱ⁺ʲ⁾
        table = [[(-1.0) ** i * arm.derivative(i + j, lag) for j in range(3)] for i in range(3)]
        means = [300.0 * math.exp(0.5 * log_sd**2), 15.0 * math.exp(0.5 * log_sd**2), 3.0]
        covariances = [
            means[0] ** 2 * np.expm1(log_sd**2 * np.exp(-0.5 * (lag / 0.6) ** 2)),
            means[1] ** 2 * np.expm1(log_sd**2 * np.exp(-0.5 * (lag / 0.4) ** 2)),
            np.full_like(lag, 0.3**2),
        ]
        pairs = list(itertools.product(range(3), repeat=2))
        terms = [
            sum(means[i] * means[j] * table[i][j] for i, j in pairs),
            sum(covariances[j] * table[j][j] for j in range(3)),
            sum(covariances[j] * np.outer(error[j], error[j]) for j in range(3)),
            2.0**2 * np.exp(-0.5 * (lag / 0.15) ** 2),
        ]
        return Motion(kernel, x, terms)

    def test_sum_to_the_kernel(self, motion: Motion) -> None:
        with torch.no_grad():
            value = motion.kernel(motion.x, motion.x).to_dense().numpy()
        assert_close(value, sum(motion.terms))

    def test_each_is_a_covariance(self, motion: Motion) -> None:
        for term in motion.terms:
            assert np.linalg.eigvalsh(term).min() > -1e-13 * len(term) * term.max()

    def test_stiffness_against_mass_is_negative_and_damping_is_uncorrelated_at_one_instant(
        self, motion: Motion
    ) -> None:
        impedance = motion.kernel.impedance
        path = impedance.layout.path(motion.x)
        with torch.no_grad():
            common, table = derivative_table(impedance.trajectory, path, path)
        assert ((common * table[0][2]).diagonal() < 0.0).all()
        assert not (common * table[0][1]).diagonal().any()
        assert not (common * table[1][2]).diagonal().any()

    @pytest.mark.parametrize("order", range(3))
    def test_force_is_tied_to_an_impedance_only_where_its_error_is_not_zero(
        self, motion: Motion, order: int
    ) -> None:
        impedance = motion.kernel.impedance
        halted = motion.x.clone()
        halted[:5, impedance.layout.error[order]] = 0.0
        around_hand = ImpedanceKernel(LAYOUT, impedance.trajectory, *impedance.processes)
        with torch.no_grad():
            tied = impedance.impedance_covariance(halted, motion.x, order)
            assert not tied[:5].any()
            assert tied[5:].all()
            assert not around_hand.impedance_covariance(motion.x, motion.x, order).any()


@pytest.mark.parametrize("log_sd", [0.1, 0.3, 0.5, 1.0])
class TestWarpedStiffness:
    def test_mean_and_sd_scale_with_the_median(self, log_sd: float) -> None:
        x = double([[0.0]])
        for median in (50.0, 300.0):
            process = ProcessSpec("log_gaussian", median, log_sd).kernel()
            with torch.no_grad():
                mean, variance = process.expectation(x).item(), process(x).to_dense().item()
            assert mean == pytest.approx(median * math.exp(0.5 * log_sd**2), rel=1e-13)
            assert math.sqrt(variance) / mean == pytest.approx(math.sqrt(math.expm1(log_sd**2)), rel=1e-13)

    def test_correlation_falls_sooner_than_that_of_the_logarithm(self, log_sd: float) -> None:
        lag = np.linspace(0.0, 3.0, 301)
        process = ProcessSpec("log_gaussian", 300.0, log_sd, (0.6,)).kernel()
        with torch.no_grad():
            covariance = process(double([[0.0]]), torch.from_numpy(lag)[:, None]).to_dense()[0].numpy()
        gaussian = np.exp(-0.5 * (lag / 0.6) ** 2)
        shortfall = gaussian - covariance / covariance[0]
        assert shortfall.min() > -1e-14
        # ρ − expm1(s²ρ)/expm1(s²) is largest where its derivative by ρ vanishes.
        c = log_sd**2
        rho = math.log(math.expm1(c) / c) / c
        assert shortfall.max() == pytest.approx(rho - math.expm1(c * rho) / math.expm1(c), rel=1e-3)


VELOCITIES = [(0.0, 0.0), (0.5, 0.0), (0.0, -0.3), (0.5, 0.5), (0.5, -0.5), (0.5, 0.25), (-0.2, 0.6)]


@pytest.mark.parametrize("spread", SPREADS)
@pytest.mark.parametrize("impedance_length", [0.1, 0.224])
class TestOverPosition:
    x = np.linspace(-0.5, 0.5, 41)

    def case(self, spread: float, impedance_length: float) -> tuple[Arm, ImpedanceKernel]:
        arm = Arm(100.0, 40.0, spread=spread)
        return arm, arm.pd(impedance_length)

    @pytest.mark.parametrize(("v", "w"), VELOCITIES)
    def test_covariance_is_the_chain_rule_by_hand(
        self, v: float, w: float, spread: float, impedance_length: float
    ) -> None:
        arm, kernel = self.case(spread, impedance_length)
        r = self.x[:, None] - self.x[None, :]
        varying = spread**2 * np.exp(-0.5 * (r / impedance_length) ** 2)
        expected = (
            arm.stiffness**2 * (1.0 + varying) * arm.derivative(0, r)
            + arm.stiffness * arm.damping * (v - w) * arm.derivative(1, r)
            - arm.damping**2 * (1.0 + varying) * v * w * arm.derivative(2, r)
        )
        assert_close(between(kernel, self.x, v, self.x, w), expected)

    def test_damping_vanishes_where_the_hand_rests(self, spread: float, impedance_length: float) -> None:
        arm, kernel = self.case(spread, impedance_length)
        undamped = Arm(arm.stiffness, 0.0, spread=spread).pd(impedance_length)
        at_rest = between(kernel, self.x, 0.0, self.x, 0.0)
        assert np.array_equal(at_rest, between(undamped, self.x, 0.0, self.x, 0.0))

    def test_against_a_resting_hand_damping_is_linear_in_velocity_whatever_its_uncertainty(
        self, spread: float, impedance_length: float
    ) -> None:
        arm, kernel = self.case(spread, impedance_length)
        at_rest = between(kernel, self.x, 0.0, self.x, 0.0)
        parts = [between(kernel, self.x, v, self.x, 0.0) - at_rest for v in (0.2, 0.4, -0.4)]
        assert_close(parts[1], 2.0 * parts[0])
        assert_close(parts[2], -parts[1])
        stiffness = kernel.stiffness
        surely = ProcessSpec("gaussian", arm.damping, 0.0).kernel()
        sure = PDKernel(LAYOUT, kernel.trajectory, stiffness, surely)
        assert_close(between(kernel, self.x, 0.4, self.x, 0.0), between(sure, self.x, 0.4, self.x, 0.0))

    @pytest.mark.parametrize(("v", "w"), VELOCITIES)
    def test_slope_at_one_place_is_proportional_to_the_difference_of_velocities(
        self, v: float, w: float, spread: float, impedance_length: float
    ) -> None:
        arm, kernel = self.case(spread, impedance_length)
        other = with_velocity(0.07, w).requires_grad_()
        (gradient,) = torch.autograd.grad(kernel(with_velocity(0.07, v), other).to_dense().sum(), other)
        expected = arm.stiffness * arm.damping * (v - w) * (arm.trajectory_sd / arm.lengthscale) ** 2
        assert gradient[0, 0].item() == pytest.approx(expected, rel=1e-12, abs=1e-14)

    @pytest.mark.parametrize(("v", "w"), VELOCITIES)
    def test_odd_part_is_there_just_where_velocities_differ(
        self, v: float, w: float, spread: float, impedance_length: float
    ) -> None:
        arm, kernel = self.case(spread, impedance_length)
        section = between(kernel, 0.0, v, self.x, w)[0]
        odd = 0.5 * (section - section[::-1])
        expected = -arm.stiffness * arm.damping * (v - w) * arm.derivative(1, self.x)
        assert np.abs(odd - expected).max() <= 1e-13 * np.abs(section).max()
        assert bool(np.abs(odd).max() > 1e-3 * np.abs(section).max()) is (v != w)

    @pytest.mark.parametrize(("v", "w"), VELOCITIES)
    def test_only_the_difference_of_positions_matters_and_mirroring_all_changes_nothing(
        self, v: float, w: float, spread: float, impedance_length: float
    ) -> None:
        _, kernel = self.case(spread, impedance_length)
        covariance = between(kernel, self.x, v, self.x, w)
        assert_close(between(kernel, self.x + 0.3, v, self.x + 0.3, w), covariance)
        assert_close(between(kernel, -self.x, -v, -self.x, -w), covariance)
        assert_close(between(kernel, self.x, w, self.x, v).T, covariance)

    def test_opposite_velocities_at_one_place_turn_negative_at_stiffness_over_damping(
        self, spread: float, impedance_length: float
    ) -> None:
        arm, kernel = self.case(spread, impedance_length)
        turning = arm.stiffness * arm.lengthscale / arm.damping
        for share in (0.1, 0.99, 1.01, 3.0):
            value = between(kernel, 0.2, share * turning, 0.2, -share * turning).item()
            scale = arm.stiffness**2 * (1.0 + spread**2) * arm.trajectory_sd**2
            assert value == pytest.approx(scale * (1.0 - share**2), rel=1e-11)


class TestLookAhead:
    @pytest.mark.parametrize("v", [-0.6, -0.05, 0.05, 0.2, 0.6])
    def test_ridge_beside_a_resting_hand(self, v: float) -> None:
        # The maximum over δ = x' − x of (1 + τ v δ/ℓ²) e^{−δ²/2ℓ²}, τ = d/k.
        arm = Arm(100.0, 40.0)
        shift = arm.damping / arm.stiffness * v
        square = arm.lengthscale**2
        ridge = (math.sqrt(1.0 + 4.0 * shift**2 / square) - 1.0) * square / (2.0 * shift)
        delta = np.linspace(-0.5, 0.5, 10001)
        section = between(arm.pd(), 0.0, v, delta, 0.0)[0]
        assert delta[section.argmax()] == pytest.approx(ridge, abs=1.01e-4)
        assert abs(ridge) < min(abs(shift), arm.lengthscale)

    @pytest.mark.parametrize(("v", "w"), [(1.0, 0.0), (1.0, 0.5), (1.0, -0.5), (0.0, -1.0)])
    def test_slow_motion_is_rest_at_look_ahead_points(self, v: float, w: float) -> None:
        # k f(x) + d f'(x) ẋ = k f(x + τ ẋ) + O(ẋ²): a tenth of the speed leaves a hundredth of the error.
        arm = Arm(100.0, 40.0)
        kernel, tau = arm.pd(), arm.damping / arm.stiffness
        x = np.linspace(-0.4, 0.4, 81)
        errors = []
        for speed in (0.01, 0.001):
            moving = between(kernel, 0.0, speed * v, x, speed * w)
            resting = between(kernel, tau * speed * v, 0.0, x + tau * speed * w, 0.0)
            errors.append(np.abs(moving - resting).max())
        assert errors[1] / errors[0] == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("log_sd", [0.2, 0.4])
def test_products_have_the_covariance_of_the_kernel_and_heavier_tails(log_sd: float) -> None:
    t = np.linspace(0.0, 1.0, 5)
    length, number = 0.3, 200_000
    arm = Arm(trajectory_sd=0.01, lengthscale=length)
    lag = t[None, :] - t[:, None]
    joint = np.block([[(-1.0) ** i * arm.derivative(i + j, lag) for j in range(2)] for i in range(2)])
    generator = np.random.default_rng(1)

    def draw(covariance: Array) -> Array:
        values, vectors = np.linalg.eigh(covariance)
        return generator.normal(size=(number, len(values))) @ (vectors * np.sqrt(values.clip(0.0))).T

    motion = draw(joint)
    k_w = log_sd**2 * np.exp(-0.5 * (lag / 0.6) ** 2)
    error, rate = 0.02 * np.cos(4.0 * t), -0.08 * np.sin(4.0 * t)
    force = 300.0 * np.exp(draw(k_w)) * (error + motion[:, :5]) + 15.0 * np.exp(draw(k_w)) * (
        rate + motion[:, 5:]
    )

    stiffness, damping = (
        ProcessSpec("log_gaussian", level, log_sd, (0.6,)).kernel((0,)) for level in (300.0, 15.0)
    )
    trajectory = TrajectorySpec(sd=0.01, lengthscale=(length,)).kernel()
    layout = InputLayout(theta=(0,), theta_velocity=(1,), error=(2, 3, 4))
    kernel = PDKernel(layout, trajectory, stiffness, damping)
    x = torch.from_numpy(np.vstack([t, np.ones(5), error, rate, 0.0 * t]).T.copy())
    with torch.no_grad():
        mean, covariance = kernel.prior_mean(x).numpy(), kernel(x).to_dense().numpy()

    deviation = force - mean
    products = deviation[:, :, None] * deviation[:, None, :]
    # Five standard errors of the Monte Carlo mean, for 5 means and 15 covariances.
    assert (np.abs(deviation.mean(0)) < 5.0 * deviation.std(0) / math.sqrt(number)).all()
    assert (np.abs(products.mean(0) - covariance) < 5.0 * products.std(0) / math.sqrt(number)).all()
    kurtosis = (deviation**4).mean(0) / covariance.diagonal() ** 2
    # SD of the kurtosis of as many Gaussian draws: √(24/n).
    assert (kurtosis > 3.0 + 5.0 * math.sqrt(24.0 / number)).all()
