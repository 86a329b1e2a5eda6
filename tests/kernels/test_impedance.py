"""Covariances of the interaction force against autograd of the defining products, and Monte Carlo."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable

import gpytorch
import numpy as np
import pytest
import torch
from gpytorch.kernels import AdditiveKernel
from oracles import (
    IMPEDANCE,
    PROFILE_NAMES,
    TRAJECTORY,
    ForceOracle,
    ProcessSpec,
    ResidualSpec,
    Samples,
    TrajectorySpec,
    configuration,
    double,
    number,
    oracle_of,
    path_derivatives,
    relative_error,
    samples_of,
    stacked,
)
from torch import Tensor

from bayes_impedance.config import Config
from bayes_impedance.features import FeatureMap
from bayes_impedance.kernels import (
    ImpedanceKernel,
    ImpedanceProcess,
    InputLayout,
    InteractionKernel,
    InteractionMean,
    Latent,
    PDKernel,
    StationaryKernel,
)
from bayes_impedance.kernels.impedance import force_covariance, same_label
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import build_force_model
from bayes_impedance.simulation.generative import repeated_motion
from bayes_impedance.trajectory_mean import TrajectoryMean

THETAS = ("time", "phase", "position", "position_velocity")
LATENTS = ("force", "residual_force", *TRAJECTORY, *IMPEDANCE)


def short_motion(seed: int = 2) -> PreparedLog:
    return repeated_motion(repetitions=2, duration=3.0, rate=4.0, seed=seed)


def inputs_of(config: Config, log: PreparedLog) -> Tensor:
    """Kernel inputs of the x axis, `(n, D)`."""
    mean = TrajectoryMean.from_training(config.model.desired_trajectory, log)
    return FeatureMap(config, log.axes)(log, mean).inputs[0, 0]


def kernel_of(config: Config, log: PreparedLog) -> InteractionKernel:
    """Kernel of both axes; they have the same hyperparameters."""
    return build_force_model(config, FeatureMap(config, log.axes)).kernel


def one_axis(covariance: Tensor) -> Tensor:
    """The x axis of `(axes, 1, n1, n2)`; what has no hyperparameters of its own has no such batch."""
    return covariance[0, 0] if covariance.ndim == 4 else covariance


class Case:
    """Library and oracle on the same log; the two sets of samples share no θ, where √s has no derivative."""

    def __init__(self, **model: object) -> None:
        self.config = configuration(**model)
        log = short_motion()
        self.inputs, self.kernel = inputs_of(self.config, log), kernel_of(self.config, log)
        self.samples, self.oracle = samples_of(self.config, log, axis=0), oracle_of(self.config, axes=2)
        n = len(self.inputs)
        self.odd, self.even = torch.arange(1, n, 2), torch.arange(0, n, 2)[:-1]

    def library(self, function: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        with torch.no_grad():
            return one_axis(function(self.inputs[self.odd], self.inputs[self.even]))

    def expected(self, latent: str) -> Tensor:
        return self.oracle.cross(self.samples[self.odd], self.samples[self.even], latent)


CASES = [
    *({"trajectory_input": theta, "profile": profile} for theta in THETAS for profile in PROFILE_NAMES),
    {"trajectory_input": "position_velocity", "profile": "squared_exponential", "drop_acceleration": True},
    {"trajectory_input": "position_velocity", "profile": "matern52", "drop_acceleration": True},
    {"trajectory_input": "phase", "profile": "squared_exponential", "law": "gaussian"},
    {"trajectory_input": "position", "profile": "matern52", "mean": "equilibrium"},
    {"trajectory_input": "position_velocity", "profile": "rational_quadratic", "mean": "equilibrium"},
    {"trajectory_input": "time", "profile": "matern72", "law": "gaussian", "offset": True},
]


def model_of(
    trajectory_input: str, profile: str, mean: str = "reference", law: str = "log_gaussian",
    drop_acceleration: bool = False, offset: bool = False,
) -> dict[str, object]:  # fmt: skip
    gaussian = law == "gaussian"
    return {
        "trajectory_input": trajectory_input,
        "drop_acceleration": drop_acceleration,
        "desired_trajectory": {
            "mean": mean,
            "kernel": profile,
            "sd": 0.02,
            "shape": 1.7,
            "length_scale": {"time": 0.4, "phase": 0.12, "position": 0.08, "velocity": 0.4},
        },
        "stiffness": {
            "prior": "gp" if gaussian else "log_gp",
            "level": 100,
            **({"sd": 30} if gaussian else {"log_sd": 0.3}),
            "input": ["position"],
            "length_scale": {"position": 0.1},
        },
        "damping": {
            "prior": "gp" if gaussian else "log_gp",
            "level": 9,
            **({"sd": 2} if gaussian else {"log_sd": 0.2}),
            "input": ["phase", "velocity"],
            "length_scale": {"phase": 0.3, "velocity": 0.4},
        },
        "mass": {"level": 1.2, "sd": 0.2},
        "residual": {
            "sd": 0.5,
            "input": ["position", "velocity"],
            "length_scale": {"position": 0.1, "velocity": 0.3},
            **({"offset_sd": 0.4} if offset else {}),
        },
        "noise_sd": 0.2,
    }


@pytest.fixture(scope="module", params=CASES, ids=lambda case: "-".join(str(v) for v in case.values()))
def case(request: pytest.FixtureRequest) -> Case:
    return Case(**model_of(**request.param))


class TestAgainstAutograd:
    @pytest.mark.parametrize("latent", LATENTS)
    def test_covariance_of_force_with_each_latent(self, case: Case, latent: str) -> None:
        value = case.library(lambda a, b: case.kernel.cross_covariance(a, b, Latent(latent)))
        expected = case.expected(latent)
        if latent in IMPEDANCE and case.config.model.desired_trajectory.mean == "equilibrium":
            # ē = 0: to second order the force says nothing of impedance.
            assert not expected.any()
            assert not value.any()
        else:
            assert relative_error(value, expected) < 1e-9

    def test_kernel_through_the_call_of_gpytorch(self, case: Case) -> None:
        value = case.library(lambda a, b: case.kernel(a, b).to_dense())
        assert relative_error(value, case.expected("force")) < 1e-9

    def test_impedance_kernel_without_residual(self, case: Case) -> None:
        oracle = ForceOracle(case.oracle.trajectory, case.oracle.processes)
        expected = oracle.covariance(case.samples[case.odd], case.samples[case.even])
        assert (
            relative_error(case.library(lambda a, b: case.kernel.impedance(a, b).to_dense()), expected) < 1e-9
        )

    def test_pd_kernel_without_mass(self, case: Case) -> None:
        impedance = case.kernel.impedance
        pd = PDKernel(impedance.layout, impedance.trajectory, impedance.stiffness, impedance.damping)
        without_mass = ForceOracle(case.oracle.trajectory, case.oracle.processes[:2])
        expected = without_mass.covariance(case.samples[case.odd], case.samples[case.even])
        assert relative_error(case.library(lambda a, b: pd(a, b).to_dense()), expected) < 1e-9
        assert pd.order == 1
        for order, latent in enumerate(TRAJECTORY):
            value = case.library(lambda a, b, r=order: pd.trajectory_covariance(a, b, r))
            expected = without_mass.cross(case.samples[case.odd], case.samples[case.even], latent)
            assert relative_error(value, expected) < 1e-9

    def test_prior_mean(self, case: Case) -> None:
        expected = case.oracle.mean(case.samples)
        for value in (case.kernel.prior_mean(case.inputs), InteractionMean(case.kernel)(case.inputs)):
            assert value.shape == (2, 1, len(expected))
            if case.config.model.desired_trajectory.mean == "equilibrium":
                assert not value.any()
            else:
                assert relative_error(value[0, 0].detach(), expected) < 1e-12


@pytest.mark.parametrize("latent", LATENTS)
@pytest.mark.parametrize("profile", ["squared_exponential", "rational_quadratic"])
def test_prior_variance_of_each_latent(profile: str, latent: str) -> None:
    # Smooth profiles: autograd is defined where samples coincide.
    case = Case(**model_of("position_velocity", profile, offset=True))
    value = case.kernel.prior_variance(case.inputs, Latent(latent)).detach()
    expected = case.oracle.own(case.samples, latent).diagonal()
    assert relative_error(value.expand(2, 1, len(expected))[0, 0], expected) < 1e-10


def test_pd_is_impedance_whose_mass_is_nought() -> None:
    case = Case(**model_of("phase", "squared_exponential"))
    impedance = copy.deepcopy(case.kernel.impedance)
    impedance.mass.level, impedance.mass.covariance.sd = double(1e-30), double(1e-30)
    pd = PDKernel(impedance.layout, impedance.trajectory, impedance.stiffness, impedance.damping)
    value, expected = (case.library(lambda a, b, k=k: k(a, b).to_dense()) for k in (pd, impedance))
    assert relative_error(value, expected) < 1e-14
    assert (
        relative_error(pd.prior_mean(case.inputs).detach(), impedance.prior_mean(case.inputs).detach())
        < 1e-14
    )


def test_force_covariance_with_every_pair_correlated() -> None:
    generator = torch.Generator().manual_seed(0)
    n1, n2 = 4, 3

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    e1, e2, w1, w2 = draw(3, n1), draw(3, n2), draw(3, n1), draw(3, n2)
    covariance, table, common = draw(3, 3, n1, n2), draw(3, 3, n1, n2), draw(n1, n2)
    expected = torch.zeros(n1, n2, dtype=torch.float64)
    for a in range(n1):
        for b in range(n2):
            for i in range(3):
                for j in range(3):
                    c = covariance[i, j, a, b]
                    expected[a, b] += (w1[i, a] * w2[j, b] + c) * common[a, b] * table[i, j, a, b]
                    expected[a, b] += c * e1[i, a] * e2[j, b]
    value = force_covariance(
        [w[:, None] for w in w1],
        [w[None] for w in w2],
        {(i, j): covariance[i, j] for i in range(3) for j in range(3)},
        [list(row) for row in table],
        common,
        [e[:, None] for e in e1],
        [e[None] for e in e2],
    )
    assert relative_error(value, expected) < 1e-13


# --- labels ------------------------------------------------------------------------------------------


def test_trials_share_impedance_but_not_what_has_their_label() -> None:
    case = Case(**model_of("time", "squared_exponential"))
    x, kernel = case.inputs, case.kernel
    n = len(x) // 2
    first, second = x[:n], x[n:]
    assert kernel.impedance.layout.trajectory is not None
    assert not kernel.cross_covariance(first, second, Latent.DESIRED_POSITION).any()
    assert not kernel.cross_covariance(first, second, Latent.RESIDUAL_FORCE).any()
    assert bool(kernel.cross_covariance(first, second, Latent.STIFFNESS).any())
    # What is left is Σ_j C_jj ē_j ē_j'.
    one, two = case.samples[:n], case.samples[n:]
    expected = torch.zeros(n, n, dtype=torch.float64)
    for j, process in enumerate(case.oracle.processes):
        xi = (
            (one.xi[process.component], two.xi[process.component])
            if process.lengthscale
            else (one.error, two.error)
        )
        moment = process.second_moment(*xi) - process.expectation**2
        expected = expected + moment * one.error[:, [j]] * two.error[:, j]
    assert relative_error(one_axis(kernel(first, second).to_dense().detach()), expected) < 1e-9


def test_same_label() -> None:
    x1, x2 = double([[0.0, 1.0], [1.0, 1.0]]), double([[1.0, 0.0], [0.0, 0.0], [1.0, 1.0]])
    assert same_label(x1, x2, None) is None
    assert same_label(x1, x2, 0, diag=True) is None
    shared = same_label(x1, x2, 0)
    assert shared is not None
    assert shared.tolist() == [[0.0, 1.0, 0.0], [1.0, 0.0, 1.0]]


def test_without_residual_its_covariance_is_zero() -> None:
    case = Case(**{**model_of("phase", "squared_exponential"), "residual": None})
    value = case.library(lambda a, b: case.kernel.cross_covariance(a, b, Latent.RESIDUAL_FORCE))
    assert value.shape == (len(case.odd), len(case.even))
    assert not value.any()
    assert not case.kernel.prior_variance(case.inputs, Latent.RESIDUAL_FORCE).any()


# --- Monte Carlo -------------------------------------------------------------------------------------

DRAWS = 400_000


def standard_errors(products: np.ndarray, expected: Tensor) -> float:
    """Largest deviation of the mean of `products` `(draws, …)` from what is expected, in standard errors."""
    error = products.std(axis=0) / math.sqrt(len(products))
    return float(np.max(np.abs(products.mean(axis=0) - expected.detach().numpy()) / error))


class MonteCarlo:
    """Draws of k, d, m and (x_d, ẋ_d, ẍ_d) at three samples of a curved path, and their products u."""

    def __init__(self, law: str, log_sd: float = 0.3) -> None:
        scale = {"gaussian": (30.0, 2.5), "log_gaussian": (log_sd, 0.25)}[law]
        self.processes = (
            ProcessSpec(law, 100.0, scale[0], (0.8,), "xi"),
            ProcessSpec(law, 9.0, scale[1], (1.5,), "xi"),
            ProcessSpec("gaussian", 1.2, 0.2),
        )
        self.trajectory = TrajectorySpec("squared_exponential", 0.05, (0.6, 0.9))
        self.residual = ResidualSpec(0.5, (0.7,), "xi")
        theta = double([[0.0, 0.1], [0.3, -0.2], [0.5, 0.4]])
        self.samples = Samples(
            theta=theta,
            velocity=double([[1.0, 0.4], [0.6, -0.8], [0.2, 1.1]]),
            acceleration=double([[-2.0, 1.0], [1.5, 2.5], [0.5, -3.0]]),
            error=double([[0.02, -0.1, 0.5], [-0.03, 0.2, 1.0], [0.05, 0.05, -1.5]]),
            xi={"xi": double([[0.0], [0.5], [1.0]])},
        )
        self.oracle = ForceOracle(self.trajectory, self.processes, self.residual)
        self.draw(np.random.default_rng(7))

    def draw(self, generator: np.random.Generator) -> None:
        s = self.samples
        joint = stacked(path_derivatives(self.trajectory.covariance, s, s)).numpy()
        deviation = generator.multivariate_normal(np.zeros(9), joint, DRAWS, method="eigh")
        self.desired = deviation.reshape(DRAWS, 3, 3)  # (draws, order, sample)
        self.gaussian, weights = [], []
        for process in self.processes:
            xi = s.xi["xi"] if process.lengthscale else s.theta
            k = process.gaussian(xi, xi).numpy()
            g = generator.multivariate_normal(np.zeros(3), k, DRAWS, method="eigh")
            self.gaussian.append(g)
            weights.append(process.level + g if process.law == "gaussian" else process.level * np.exp(g))
        residual = self.residual.covariance(s.xi["xi"], s.xi["xi"]).numpy()
        self.residual_force = generator.multivariate_normal(np.zeros(3), residual, DRAWS, method="eigh")
        error = self.desired + s.error.numpy().T
        self.force = sum(w * error[:, j] for j, w in enumerate(weights)) + self.residual_force

    def kernel(self) -> InteractionKernel:
        layout = InputLayout((0, 1), (2, 3), (4, 5), (6, 7, 8))
        processes = [p.kernel((9,) if p.lengthscale else None) for p in self.processes]
        residual = StationaryKernel(num_dims=1, active_dims=(9,)).double()
        residual.sd, residual.lengthscale = double(self.residual.sd), double(self.residual.lengthscale)
        return InteractionKernel(ImpedanceKernel(layout, self.trajectory.kernel(), *processes), residual)

    def inputs(self) -> Tensor:
        s = self.samples
        return torch.cat([s.theta, s.velocity, s.acceleration, s.error, s.xi["xi"]], dim=-1)


@pytest.fixture(scope="module", params=["gaussian", "log_gaussian"])
def monte_carlo(request: pytest.FixtureRequest) -> MonteCarlo:
    return MonteCarlo(request.param)


class TestMonteCarlo:
    def test_mean(self, monte_carlo: MonteCarlo) -> None:
        assert standard_errors(monte_carlo.force, monte_carlo.kernel().prior_mean(monte_carlo.inputs())) < 5

    def test_covariance(self, monte_carlo: MonteCarlo) -> None:
        x = monte_carlo.inputs()
        deviation = monte_carlo.force - monte_carlo.kernel().prior_mean(x).detach().numpy()
        products = deviation[:, :, None] * deviation[:, None, :]
        assert standard_errors(products, monte_carlo.kernel()(x).to_dense()) < 5

    @pytest.mark.parametrize("latent", LATENTS[1:])
    def test_covariance_with_latents(self, monte_carlo: MonteCarlo, latent: str) -> None:
        kernel, x = monte_carlo.kernel(), monte_carlo.inputs()
        deviation = monte_carlo.force - kernel.prior_mean(x).detach().numpy()
        if latent in TRAJECTORY:
            other = monte_carlo.desired[:, TRAJECTORY.index(latent)]
        elif latent in IMPEDANCE:
            other = monte_carlo.gaussian[IMPEDANCE.index(latent)]  # log w where warped
        else:
            other = monte_carlo.residual_force
        products = deviation[:, :, None] * other[:, None, :]
        assert standard_errors(products, kernel.cross_covariance(x, x, Latent(latent))) < 5

    def test_oracle_has_the_same_moments(self, monte_carlo: MonteCarlo) -> None:
        x, s = monte_carlo.inputs(), monte_carlo.samples
        assert (
            relative_error(monte_carlo.kernel()(x).to_dense().detach(), monte_carlo.oracle.covariance(s, s))
            < 1e-11
        )


def test_kurtosis_of_stiffness_times_error() -> None:
    # 3 exp(4 s²) = 4.3 at s = .3: why log-SD is kept at or under .5.
    draws = MonteCarlo("log_gaussian", log_sd=0.3)
    product = np.exp(draws.gaussian[0][:, 0]) * draws.desired[:, 0, 0]
    kurtosis = np.mean(product**4) / np.mean(product**2) ** 2
    assert kurtosis == pytest.approx(3.0 * math.exp(4.0 * 0.3**2), rel=0.05)


# --- battery -----------------------------------------------------------------------------------------

LAYOUT = InputLayout((0, 1), (2, 3), (4, 5), (6, 7, 8))
WIDTH = 11
NO_BATCH = torch.Size()


def processes(law: str, batch: torch.Size) -> list[ImpedanceProcess]:
    stiffness = ImpedanceProcess(
        StationaryKernel(num_dims=1, active_dims=(9,), batch_shape=batch), law, batch_shape=batch
    )
    damping = ImpedanceProcess(
        StationaryKernel(num_dims=2, active_dims=(9, 10), batch_shape=batch), law, batch_shape=batch
    )
    mass = ImpedanceProcess(StationaryKernel(num_dims=0, batch_shape=batch), "gaussian", batch_shape=batch)
    return [stiffness, damping, mass]


def set_to_usual_values(kernel: gpytorch.kernels.Kernel, batch: torch.Size) -> None:
    """Different numbers in every batch entry."""
    step = 1.0 + 0.2 * torch.arange(batch.numel(), dtype=torch.float64).reshape(*batch, 1, 1)
    impedance = kernel.impedance if isinstance(kernel, InteractionKernel) else kernel
    impedance.trajectory.sd = 0.05 * step
    impedance.trajectory.lengthscale = 0.8 * step
    for process, level in zip(impedance.processes, (100.0, 9.0, 1.2), strict=False):
        process.level = level * step
        process.covariance.sd = (0.25 if process.law == "log_gaussian" else 0.2 * level) * step.sqrt()


def make_kernel(
    which: str, law: str = "log_gaussian", batch: torch.Size = NO_BATCH
) -> gpytorch.kernels.Kernel:
    profile = "matern52" if which.endswith("matern52") else "squared_exponential"
    trajectory = StationaryKernel(profile, num_dims=2, batch_shape=batch)
    stiffness, damping, mass = processes(law, batch)
    if which == "pd":
        kernel: gpytorch.kernels.Kernel = PDKernel(LAYOUT, trajectory, stiffness, damping)
    else:
        kernel = ImpedanceKernel(LAYOUT, trajectory, stiffness, damping, mass)
    if which.startswith("interaction"):
        residual = AdditiveKernel(
            StationaryKernel(num_dims=2, active_dims=(0, 1), batch_shape=batch),
            StationaryKernel(num_dims=0, batch_shape=batch),
        )
        kernel = InteractionKernel(kernel, residual)
    kernel = kernel.double()
    set_to_usual_values(kernel, batch)
    return kernel


def random_inputs(n: int, seed: int = 0, batch: tuple[int, ...] = ()) -> Tensor:
    return torch.randn(*batch, n, WIDTH, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


BATTERY = ("pd", "impedance", "impedance_matern52", "interaction", "interaction_matern52")


@pytest.mark.parametrize("law", ["gaussian", "log_gaussian"])
@pytest.mark.parametrize("which", BATTERY)
class TestBattery:
    def test_symmetric_and_positive_semidefinite(self, which: str, law: str) -> None:
        x = random_inputs(30)
        k = make_kernel(which, law)(x).to_dense().detach()
        assert relative_error(k, k.mT) < 1e-12
        scale = k.diagonal().sqrt()
        assert torch.linalg.eigvalsh(k / scale[:, None] / scale[None]).min() > -1e-9

    def test_diagonal(self, which: str, law: str) -> None:
        x, kernel = random_inputs(30), make_kernel(which, law)
        assert relative_error(kernel(x, diag=True), kernel(x).to_dense().diagonal()) < 1e-11

    def test_rectangular_is_a_part_of_the_square(self, which: str, law: str) -> None:
        x, kernel = random_inputs(12), make_kernel(which, law)
        full, part = kernel(x).to_dense(), kernel(x[:5], x[5:]).to_dense()
        assert part.shape == (5, 7)
        assert relative_error(part, full[:5, 5:]) < 1e-11

    def test_batch_equals_one_at_a_time(self, which: str, law: str) -> None:
        axes, groups = 2, 8
        kernel, x = make_kernel(which, law, torch.Size([axes, 1])), random_inputs(6, batch=(axes, groups))
        full, diagonal = kernel(x).to_dense(), kernel(x, diag=True)
        assert full.shape == (axes, groups, 6, 6)
        assert diagonal.shape == (axes, groups, 6)
        mean = kernel.prior_mean(x)
        for a in range(axes):
            alone = make_kernel(which, law)
            state = {name: value[a, 0] for name, value in kernel.named_parameters()}
            alone.load_state_dict(state, strict=False)
            for g in range(groups):
                assert relative_error(full[a, g], alone(x[a, g]).to_dense()) < 1e-12
                assert relative_error(diagonal[a, g], alone(x[a, g], diag=True)) < 1e-12
                assert relative_error(mean[a, g], alone.prior_mean(x[a, g])) < 1e-13

    def test_inputs_of_another_dtype_are_refused(self, which: str, law: str) -> None:
        x = random_inputs(4).float()
        with pytest.raises(
            TypeError, match=r"hyperparameters' dtype torch\.float64, got torch\.float32: .*double"
        ):
            make_kernel(which, law)(x).to_dense()

    def test_gradients_are_finite_and_reach_every_hyperparameter(self, which: str, law: str) -> None:
        # The same sample twice: r = 0 away from the diagonal too.
        x = random_inputs(6)
        x = torch.cat([x, x[:2]])
        kernel = make_kernel(which, law)
        weight = torch.randn(8, 8, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        total = (kernel(x).to_dense() * (weight + weight.mT)).sum() + kernel.prior_mean(x).sum()
        gradients = torch.autograd.grad(total, list(kernel.parameters()))
        assert all(bool(torch.isfinite(g).all()) and bool(g.any()) for g in gradients)


@pytest.mark.parametrize("law", ["gaussian", "log_gaussian"])
def test_process_moments_equal_the_closed_form(law: str) -> None:
    spec = ProcessSpec(law, 100.0, 0.3 if law == "log_gaussian" else 30.0, (0.5, 0.7), "xi")
    generator = torch.Generator().manual_seed(0)
    x1 = torch.randn(5, 2, generator=generator, dtype=torch.float64)
    x2 = torch.randn(4, 2, generator=generator, dtype=torch.float64)
    process = spec.kernel((0, 1))
    e1, e2, c = process.moments(x1, x2)
    expected = spec.second_moment(x1, x2) - spec.expectation**2
    assert number((e1 - spec.expectation).abs().max()) < 1e-12 * spec.expectation
    assert number((e2 - spec.expectation).abs().max()) < 1e-12 * spec.expectation
    assert relative_error(c, expected) < 1e-12
    assert relative_error(process(x1, x2).to_dense(), expected) < 1e-12
    diagonal = (spec.second_moment(x1, x1) - spec.expectation**2).diagonal()
    assert relative_error(process(x1, diag=True), diagonal) < 1e-12


def test_only_a_covariance_names_its_columns() -> None:
    # The moments of a process are taken from all columns of the input: its own active_dims would go unheard.
    def constant(active_dims: tuple[int, ...] | None = None) -> ImpedanceProcess:
        return ImpedanceProcess(StationaryKernel(num_dims=0), active_dims=active_dims)

    trajectory = StationaryKernel(num_dims=2)
    for place in range(3):
        parts = [constant((9,) if j == place else None) for j in range(3)]
        with pytest.raises(ValueError, match="active_dims"):
            ImpedanceKernel(LAYOUT, trajectory, *parts)
    parts = [constant() for _ in range(3)]
    selecting = ImpedanceKernel(LAYOUT, trajectory, *parts, active_dims=tuple(range(WIDTH)))
    with pytest.raises(ValueError, match="active_dims"):
        InteractionKernel(selecting)


def test_laws_and_layouts_are_checked() -> None:
    with pytest.raises(ValueError, match=r"law: expected 'gaussian' or 'log_gaussian', got 'normal'"):
        ImpedanceProcess(StationaryKernel(num_dims=0), law="normal")
    with pytest.raises(ValueError, match=r"as many columns of velocity .* got 2, 1 and 0"):
        InputLayout(theta=(0, 1), theta_velocity=(2,))
    with pytest.raises(ValueError, match=r"got 1, 1 and 2"):
        InputLayout(theta=(0,), theta_velocity=(1,), theta_acceleration=(2, 3))
    with pytest.raises(ValueError, match=r"got 0, 0 and 0"):
        InputLayout(theta=(), theta_velocity=())
    with pytest.raises(ValueError, match=r"expected 3 error columns or none, got 2"):
        InputLayout(theta=(0,), theta_velocity=(1,), error=(2, 3))
