"""Compiled covariances equal those of `kernels.impedance`, for every configuration, profile and part."""

import gpytorch
import numpy as np
import pytest
import torch
from gpytorch.kernels import AdditiveKernel
from local_problems import ROWS, Problem, compiled, own_variances

from bayes_impedance.config import LocalConfig, load_config
from bayes_impedance.engines.compiled.numbers import KernelNumbers
from bayes_impedance.engines.local.build import build_local
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import FeatureMap
from bayes_impedance.kernels import (
    ImpedanceKernel,
    ImpedanceProcess,
    InteractionKernel,
    PDKernel,
    StationaryKernel,
)
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.priors import build_force_model

BATCH = torch.Size([2, 1])
SMOOTH = ("squared_exponential", "rational_quadratic", "matern52", "matern72", "matern92")
ALL = (
    "squared_exponential",
    "rational_quadratic",
    "matern12",
    "matern32",
    "matern52",
    "matern72",
    "matern92",
)


def assert_equal(problem, one, two, relative=1e-9):
    """All rows, rectangular, with samples that stand in both; relative to the largest entry."""
    for axis in range(len(problem.inputs)):
        found = compiled(problem.numbers, axis, one[axis], two[axis])
        own = own_variances(problem.numbers, axis, two[axis])
        for row, latent in enumerate(ROWS):
            expected = problem.cross(axis, one[axis], two[axis], latent)
            scale = np.abs(expected).max()
            assert np.abs(found[row] - expected).max() <= relative * scale, (axis, latent)
            prior = problem.own(axis, two[axis], latent)
            assert np.abs(own[row] - prior).max() <= relative * np.abs(prior).max(), (axis, latent)


def halves(problem):
    n = problem.inputs.shape[1]
    return problem.inputs[:, : n - 5], problem.inputs[:, n // 2 :]


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("time", ()),
        ("time", ("model.desired_trajectory.mean=constant",)),
        ("phase", ()),
        ("phase", ("model.desired_trajectory.mean=reference", "shared.residual=true")),
        ("phase", ("shared.desired_trajectory=false",)),
        ("position", ()),
        ("position", ("model.desired_trajectory.mean=constant",)),
        ("position_velocity", ()),
        ("position_velocity", ("model.drop_acceleration=true",)),
        ("position_velocity", ("model.desired_trajectory.mean=reference", "shared.residual=true")),
        ("admittance", ("device=null",)),
    ],
    ids=lambda value: value if isinstance(value, str) else ",".join(value),
)
def test_every_configuration(name, overrides):
    problem = Problem.of(name, overrides)
    assert_equal(problem, *halves(problem))


@pytest.mark.parametrize("theta", ["phase", "position_velocity"])
@pytest.mark.parametrize("profile", SMOOTH)
def test_every_profile_of_the_desired_trajectory(theta, profile):
    problem = Problem.of(theta, (f"model.desired_trajectory.kernel={profile}",))
    assert_equal(problem, *halves(problem))


@pytest.mark.parametrize("law", ["log_gp", "gp"])
def test_processes_that_are_gaussian_or_log_gaussian(law):
    spread = "log_sd" if law == "log_gp" else "sd"
    other = "sd" if law == "log_gp" else "log_sd"
    overrides = [
        f"model.{part}.{key}={value}"
        for part, level in (("stiffness", 150), ("damping", 12))
        for key, value in (
            ("prior", law), ("level", level), (spread, 0.3 if law == "log_gp" else 0.2 * level), (other, "null"),
        )
    ]  # fmt: skip
    problem = Problem.of("phase", overrides)
    assert bool(problem.numbers.gaussian[0]) is (law == "gp")
    assert_equal(problem, *halves(problem))


@pytest.mark.parametrize("log_sd", [1e-6, 0.005, 0.5])
def test_a_small_spread_loses_no_digits(log_sd):
    """eᵏ − 1 of a tiny k is its series, of a large one the exponential; both to rounding."""
    problem = Problem.of("phase", (f"model.stiffness.log_sd={log_sd}", "model.residual=null"))
    with torch.no_grad():
        problem.model.kernel.impedance.stiffness.covariance.sd = log_sd
        # Errors of a metre: what the spread of stiffness does is then not hidden beneath k_xd.
        problem.model.kernel.impedance.trajectory.sd = 1e-9
    numbers = KernelNumbers.of(problem.model.kernel, problem.feature_map.width)
    for axis in range(2):
        found = compiled(numbers, axis, problem.inputs[axis], problem.inputs[axis])[0]
        expected = problem.cross(axis, problem.inputs[axis], problem.inputs[axis])
        assert np.abs(found - expected).max() <= 1e-11 * np.abs(expected).max()


def custom(problem, residual, mass=True):
    """The kernel of a problem with parts of its own."""
    impedance = problem.model.kernel.impedance
    kernel = InteractionKernel(
        ImpedanceKernel(
            impedance.layout, impedance.trajectory, impedance.stiffness, impedance.damping,
            impedance.mass if mass else None,
        ),
        residual,
    ).double()  # fmt: skip
    numbers = KernelNumbers.of(kernel, problem.feature_map.width)
    return kernel, numbers


def stationary(profile, dims, sd, lengthscale=0.3, active=True):
    kernel = StationaryKernel(
        profile, num_dims=len(dims), batch_shape=BATCH, active_dims=dims if active and dims else None
    ).double()
    kernel.sd = torch.tensor([sd, 2.0 * sd], dtype=torch.float64).reshape(2, 1, 1, 1)
    if dims:
        kernel.lengthscale = lengthscale
    if kernel.profile.has_shape:
        kernel.shape = 1.7
    return kernel


@pytest.mark.parametrize("mass", [True, False])
@pytest.mark.parametrize(
    "parts",
    [
        None,
        *[[(profile, (0, 1), 0.7)] for profile in ALL],
        [("squared_exponential", (), 0.4)],
        [("squared_exponential", (0, 1), 0.7), ("matern12", (2,), 0.3), ("rational_quadratic", (), 0.5)],
    ],
    ids=str,
)
def test_residuals_of_every_profile_sum_and_none(parts, mass):
    problem = Problem.of("phase")
    kernels = [stationary(*part) for part in parts or ()]
    residual = None if not kernels else kernels[0] if len(kernels) == 1 else AdditiveKernel(*kernels)
    kernel, numbers = custom(problem, residual, mass)
    inputs = problem.inputs
    for axis in range(2):
        found = compiled(numbers, axis, inputs[axis, :-4], inputs[axis, 10:])
        own = own_variances(numbers, axis, inputs[axis])
        one, two, every = (torch.from_numpy(a) for a in (inputs[axis, :-4], inputs[axis, 10:], inputs[axis]))
        with torch.no_grad():
            for row, latent in enumerate(ROWS):
                expected = kernel[axis, 0].cross_covariance(one, two, latent).numpy()
                assert np.abs(found[row] - expected).max() <= 1e-9 * np.abs(expected).max(), latent
                prior = kernel[axis, 0].prior_variance(every, latent).numpy()
                assert np.abs(own[row] - prior).max() <= 1e-9 * np.abs(prior).max(), latent


def test_pd_kernel_has_two_orders_and_the_error_columns_of_three():
    problem = Problem.of("phase")
    impedance = problem.model.kernel.impedance
    kernel = InteractionKernel(
        PDKernel(impedance.layout, impedance.trajectory, impedance.stiffness, impedance.damping)
    ).double()
    numbers = KernelNumbers.of(kernel, problem.feature_map.width)
    assert numbers.expectation.shape == (2, 2)
    found = compiled(numbers, 1, problem.inputs[1], problem.inputs[1])[0]
    with torch.no_grad():
        x = torch.from_numpy(problem.inputs[1])
        expected = kernel[1, 0].cross_covariance(x, x, Latent.FORCE).numpy()
    assert np.abs(found - expected).max() <= 1e-9 * np.abs(expected).max()


def test_a_residual_without_active_dims_takes_every_column():
    problem = Problem.of("position")
    width = problem.feature_map.width
    kernel, numbers = custom(problem, stationary("matern32", tuple(range(width)), 0.7, 3.0, active=False))
    x = torch.from_numpy(problem.inputs[0])
    found = compiled(numbers, 0, problem.inputs[0], problem.inputs[0])[0]
    with torch.no_grad():
        expected = kernel[0, 0].cross_covariance(x, x, Latent.FORCE).numpy()
    assert np.abs(found - expected).max() <= 1e-9 * np.abs(expected).max()


def test_labels_cut_the_desired_trajectory_and_the_residual():
    problem = Problem.of("time")
    assert (problem.numbers.labels >= 0).all()
    x = problem.inputs[0]
    label = x[:, problem.numbers.labels[0]]
    assert set(label) == {0.0, 1.0}
    found = compiled(problem.numbers, 0, x, x)
    other = label[:, None] != label[None]
    # x_d of another trial is independent of this one's force, whatever the distance.
    assert (found[1:, other] == 0.0).all()
    assert (found[1, ~other] != 0.0).any()


def test_where_a_sample_meets_itself_a_matern_profile_stays_finite():
    """κ''' and κ'''' of Matérn 5/2 diverge at r = 0, while their products vanish."""
    problem = Problem.of("position_velocity", ("model.desired_trajectory.kernel=matern52",))
    x = problem.inputs[0][:3]
    near = x + 1e-13
    found = compiled(problem.numbers, 0, x, near)[0]
    expected = problem.cross(0, x, near)
    assert np.isfinite(found).all()
    assert found == pytest.approx(expected, rel=1e-6)


def test_a_covariance_that_is_not_stationary_is_refused():
    problem = Problem.of("phase")
    linear = gpytorch.kernels.LinearKernel(batch_shape=BATCH).double()
    with pytest.raises(
        TypeError,
        match="compiled covariance: expected covariances of class StationaryKernel, got LinearKernel",
    ):
        custom(problem, linear)
    process = ImpedanceProcess(gpytorch.kernels.ConstantKernel(batch_shape=BATCH), batch_shape=BATCH)
    impedance = problem.model.kernel.impedance
    kernel = InteractionKernel(
        ImpedanceKernel(impedance.layout, impedance.trajectory, process, impedance.damping, None)
    ).double()
    with pytest.raises(TypeError, match="got ConstantKernel"):
        KernelNumbers.of(kernel, problem.feature_map.width)


def test_coupled_axes_and_noise_of_the_motion_are_refused():
    for name, overrides, refusal in (
        ("coupled", [], "expected model.axes: independent and an impedance model with local, got Coupled"),
        (
            "phase",
            ["model.position_noise_sd=0.0001"],
            "expected null with local sparse models, whose samples are",
        ),
    ):
        config = load_config(name, overrides)
        feature_map = FeatureMap(config, ("x", "y"))
        visited = np.zeros((2, feature_map.width))
        with pytest.raises(ConfigurationError, match=refusal):
            build_local(build_force_model(config, feature_map), feature_map, LocalConfig(), visited)
