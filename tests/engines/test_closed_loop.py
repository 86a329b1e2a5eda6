"""The Jacobian of the closed loop against quadrature over the apparent mass, and against the loop itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles import configuration, double, feature_map
from scipy.integrate import quad
from torch import Tensor
from torch.distributions import MultivariateNormal

from bayes_impedance.config import Config, parse_config
from bayes_impedance.device import Loop
from bayes_impedance.engines.closed_loop import ApparentMass, jacobian, log_likelihood
from bayes_impedance.engines.dense import Observations, quadratic_forms
from bayes_impedance.features import Features
from bayes_impedance.kernels import Latent
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.posterior import compute_posterior
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import ForceModel, build_force_model
from bayes_impedance.simulation.device import Admittance
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from bayes_impedance.simulation.one_axis import STEP, ConstantImpedance, Signal, held_impedance
from bayes_impedance.training import objective, observations
from bayes_impedance.trajectory_mean import TrajectoryMean

DEVICE_MASS, DEVICE_DAMPING = 2.0, 6.0


def fixed_levels(device: bool = True, **model: object) -> Config:
    """Levels without uncertainty, so that the mass is the only thing that the quadrature has to run over."""
    content = configuration(
        desired_trajectory={"mean": "reference", "sd": 0.01},
        stiffness={"prior": "gp", "level": 150, "sd": 45, "input": ["position"]},
        damping={"prior": "gp", "level": 12, "sd": 2.4},
        mass={"level": 1.2, "sd": 0.3},
        residual={"sd": 0.4, "input": ["position", "velocity"]},
        noise_sd=0.2,
        **model,
    ).model_dump(mode="json")
    return parse_config(
        content | {"device": {"mass": DEVICE_MASS, "damping": DEVICE_DAMPING} if device else None}
    )


def problem(config: Config, rate: float = 12.0) -> tuple[PreparedLog, Features, ForceModel]:
    motion = repeated_motion(2, duration=2.0, rate=rate, displacement_sd=0.03, seed=4)
    log = draw_force(config, motion, seed=4)
    features = feature_map(config, log)(
        log, TrajectoryMean.from_training(config.model.desired_trajectory, log)
    )
    return log, features, build_force_model(config, feature_map(config, log))


class Quadrature:
    """p(z | u) ∝ N(u; z) (1 + z/M_r)ⁿ N(z) on a grid of z, for axis 0, group 0 and constant damping."""

    def __init__(self, model: ForceModel, features: Features, step: float) -> None:
        self.kernel, self.x = model.kernel, features.inputs[0, 0]
        impedance = self.kernel.impedance
        mass, mass_sd = float(impedance.mass.level[0]), float(impedance.mass.covariance.sd[0])
        damping, damping_variance = (
            float(impedance.damping.level[0]),
            float(impedance.damping.covariance.sd[0]) ** 2,
        )
        share = 1.0 - 0.5 * step * DEVICE_DAMPING / DEVICE_MASS
        # z = share · m + ½ Δ d
        self.mean = share * mass + 0.5 * step * damping
        self.variance = (share * mass_sd) ** 2 + (0.5 * step) ** 2 * damping_variance
        sd = np.sqrt(self.variance)
        self.z = torch.linspace(self.mean - 6 * sd, self.mean + 6 * sd, 1201, dtype=torch.float64)
        n = len(self.x)
        constant = torch.ones(n, dtype=torch.float64)
        errors = [self.x[:, column] for column in impedance.layout.error]
        #: Covariance of z with each latent.
        self.with_z = {
            Latent.FORCE: errors[2] * share * mass_sd**2 + 0.5 * step * errors[1] * damping_variance,
            Latent.MASS: constant * share * mass_sd**2,
            Latent.DAMPING: constant * 0.5 * step * damping_variance,
        }
        column = self.with_z[Latent.FORCE]
        noise = model.noise_variance[0, 0] * torch.eye(n, dtype=torch.float64)
        # What is left of the covariance once z is known, and the residual at each z.
        self.rest = (
            self.covariance(self.x, Latent.FORCE) + noise - torch.outer(column, column) / self.variance
        )
        residual = features.force[0, 0] - model.prior_mean(features.inputs)[0, 0]
        self.residuals = residual - torch.outer((self.z - self.mean) / self.variance, column)
        density = MultivariateNormal(torch.zeros(n, dtype=torch.float64), self.rest).log_prob(self.residuals)
        prior = torch.distributions.Normal(self.mean, sd).log_prob(self.z)
        self.log_joint = prior + density + n * torch.log1p(self.z / DEVICE_MASS)
        self.weights = torch.softmax(self.log_joint, 0)

    def covariance(self, x: Tensor, latent: Latent) -> Tensor:
        return self.kernel.cross_covariance(self.x, x, latent)[0, 0]

    @property
    def log_evidence(self) -> float:
        total = torch.logsumexp(self.log_joint, 0) + torch.log(self.z[1] - self.z[0])
        return float(total.detach())

    def moments(self, latent: Latent) -> tuple[Tensor, Tensor]:
        """Mean and variance of a latent at every sample, less its prior mean."""
        own = self.with_z.get(latent, torch.zeros(len(self.x), dtype=torch.float64))
        cross = self.covariance(self.x, latent)
        cross = cross - torch.outer(self.with_z[Latent.FORCE], own) / self.variance
        at_z = torch.linalg.solve(self.rest, cross)
        means = self.residuals @ at_z + torch.outer((self.z - self.mean) / self.variance, own)
        prior = self.kernel.prior_variance(self.x[None, None], latent)[0, 0] - own**2 / self.variance
        mean = self.weights @ means
        return mean, prior - (cross * at_z).sum(0) + self.weights @ (means - mean) ** 2


def step_of(log: PreparedLog) -> float:
    return float(np.mean(np.diff(log.trials[0].time)))


@pytest.mark.parametrize("count", [20, 200, 2000])
@pytest.mark.parametrize(("mean", "sd"), [(1.2, 0.3), (0.2, 0.05), (-0.5, 0.2), (5.0, 1e-4)])
def test_laplace_equals_quadrature(count: int, mean: float, sd: float) -> None:
    known = jacobian(double(mean), double(sd**2), double(count), double(DEVICE_MASS))
    mode = float(known.mode)

    def log_density(m: float) -> float:
        return float(count * np.log1p(m / DEVICE_MASS) - 0.5 * ((m - mean) / sd) ** 2)

    step = 1e-4 * sd
    assert log_density(mode) > max(log_density(mode - step), log_density(mode + step))
    width = 12.0 * sd
    area, _ = quad(
        lambda m: np.exp(log_density(m) - log_density(mode)), max(mode - width, -DEVICE_MASS), mode + width,
        points=[mode], epsabs=0.0, epsrel=1e-10, limit=200,
    )  # fmt: skip
    expected = log_density(mode) + np.log(area / (sd * np.sqrt(2.0 * np.pi)))
    # The error of Laplace's method is of order 1 / count.
    assert float(known.log_expectation) == pytest.approx(expected, abs=0.2 / count + 1e-6)


def test_known_mass_leaves_the_plain_jacobian() -> None:
    known = jacobian(double(1.2), double(0.0), double(50), double(DEVICE_MASS))
    assert float(known.mode) == pytest.approx(1.2, rel=1e-14)
    assert float(known.log_expectation) == pytest.approx(50 * np.log1p(0.6), rel=1e-14)


def test_determinant_of_a_loop_that_holds_its_force_is_that_of_the_mass() -> None:
    """∂u/∂(what the force holds beside the impedance), column by column."""
    arm, device, n = ConstantImpedance(), Admittance(), 40
    time = STEP * np.arange(n)
    still, nothing = Signal(np.zeros(1), np.ones(1), np.zeros(1)), np.zeros(n)
    columns = [held_impedance(arm, device, still, nothing, unit, time)[1] for unit in np.eye(n)]
    sign, log_det = np.linalg.slogdet(np.array(columns))
    assert sign == 1.0
    assert log_det == pytest.approx(-n * np.log1p(arm.mass / device.mass), rel=1e-12)


def test_determinant_of_a_loop_whose_force_is_smooth_has_half_a_step_of_both_dampings() -> None:
    """∂(u + k x + d ẋ + m ẍ)/∂u at samples between which u is a straight line."""
    arm, device, n, step, fine = ConstantImpedance(), Admittance(), 60, 0.04, 200
    grid = np.arange(n * fine - fine + 1) / fine
    columns = []
    for unit in np.eye(n):
        force = np.interp(grid, np.arange(n), unit)
        x = v = 0.0
        rows = []
        for i, u in enumerate(force):
            a = (u - device.damping * v) / device.mass
            if i % fine == 0:
                rows.append(u + arm.stiffness * x + arm.damping * v + arm.mass * a)
            middle = 0.5 * (u + force[min(i + 1, len(force) - 1)])
            h = step / fine
            a = (middle - device.damping * (v + 0.5 * h * a)) / device.mass
            x, v = x + h * v + 0.5 * h**2 * a, v + h * a
        columns.append(rows)
    _, log_det = np.linalg.slogdet(np.array(columns))
    mass_alone = n * np.log1p(arm.mass / device.mass)
    share = 1.0 - 0.5 * step * device.damping / device.mass
    expected = n * np.log1p((share * arm.mass + 0.5 * step * arm.damping) / device.mass)
    assert expected - mass_alone > 1.0
    # What is left is of second order in the step, k Δ²/6 the largest of it.
    second = n * arm.stiffness * step**2 / 6.0 / (device.mass + arm.mass)
    assert log_det - second == pytest.approx(expected, abs=0.15 * (expected - mass_alone))


def test_likelihood_equals_quadrature_over_the_apparent_mass() -> None:
    config = fixed_levels()
    log, features, model = problem(config)
    value = log_likelihood(model.kernel, observations(model, features), features.loop, jitter=0.0)
    assert float(value[0, 0].detach()) == pytest.approx(
        Quadrature(model, features, step_of(log)).log_evidence, abs=0.01
    )


def test_without_a_device_nothing_is_added() -> None:
    config = fixed_levels(device=False)
    _, features, model = problem(config)
    assert features.loop is None
    value, _ = objective(model, features, 0.0)
    with_device, _ = objective(
        model,
        replace(features, loop=Loop(double([[1e12], [1e12]]), double([[0.0], [0.0]]), double([0.1]))),
        0.0,
    )
    torch.testing.assert_close(value, with_device, rtol=1e-9, atol=1e-9)


def test_acceleration_that_does_not_enter_the_force_has_no_jacobian() -> None:
    content = fixed_levels().model_dump(mode="json")
    content["model"]["desired_trajectory"]["mean"] = "equilibrium"
    _, features, _ = problem(parse_config(content))
    assert features.loop is None


@pytest.mark.parametrize("latent", list(Latent))
def test_posterior_equals_quadrature_over_the_apparent_mass(latent: Latent) -> None:
    config = fixed_levels()
    log, features, model = problem(config)
    marginal = compute_posterior(model, log, features, features, 0.0, [latent])[latent]
    with torch.no_grad():
        mean, variance = Quadrature(model, features, step_of(log)).moments(latent)
    if latent is Latent.FORCE:
        variance = variance + model.noise_variance.detach()[0, 0]
    shift = marginal.location[:, 0] - marginal.prior_location[:, 0]
    scale = marginal.scale[:, 0]
    # Laplace's method gives the mode of z, the quadrature its mean: a tenth of a posterior SD apart at most.
    np.testing.assert_allclose(shift, mean.detach(), atol=float(0.1 * scale.max()), rtol=0.0)
    np.testing.assert_allclose(scale, variance.detach().sqrt(), rtol=0.05)


def test_the_jacobian_raises_mass_and_damping() -> None:
    log, features, model = problem(fixed_levels())
    with_it = compute_posterior(model, log, features, features, 0.0)
    without = compute_posterior(model, log, features, replace(features, loop=None), 0.0)
    for name in ("mass", "damping"):
        assert (with_it[name].location > without[name].location).all()
        assert (with_it[name].scale < without[name].scale).all()


def test_gradient_of_the_objective_is_that_of_finite_differences() -> None:
    content = fixed_levels().model_dump(mode="json")
    for name in ("mass", "stiffness", "damping"):
        content["model"][name]["level"]["fixed"] = False
    content["model"]["mass"]["sd"]["fixed"] = False
    _, features, model = problem(parse_config(content), rate=6.0)
    value, _ = objective(model, features, 1e-10)
    value.sum().backward()
    for entry in model.entries:
        if not bool(entry.free.any()):
            continue
        step = torch.zeros_like(entry.raw.detach())
        step.view(-1)[0] = 1e-5
        sides = []
        for sign in (1.0, -1.0):
            with torch.no_grad():
                entry.raw.add_(sign * step)
                sides.append(float(objective(model, features, 1e-10)[0].sum()))
                entry.raw.sub_(sign * step)
        numeric = (sides[0] - sides[1]) / 2e-5
        assert float(entry.raw.grad.view(-1)[0]) == pytest.approx(numeric, rel=1e-4, abs=1e-4), entry.name


def test_apparent_mass_of_damping_along_the_path_is_a_double_sum() -> None:
    content = fixed_levels().model_dump(mode="json")
    content["model"]["damping"] |= {"prior": "log_gp", "sd": None, "log_sd": 0.4, "input": ["position"]}
    log, features, model = problem(parse_config(content))
    impedance, given = model.kernel.impedance, observations(model, features)
    with torch.no_grad():
        apparent = ApparentMass(impedance, given, features.loop)
        x = features.inputs
        half = 0.5 * step_of(log)
        covariance = impedance.damping(x, x).to_dense()
        log_covariance = impedance.damping.gaussian_covariance(x, x)
        expected = impedance.damping.expectation(x)[..., 0]
        mass = impedance.mass.covariance.sd[..., 0, 0] ** 2
        n = x.shape[-2]
        share = 1.0 - half * DEVICE_DAMPING / DEVICE_MASS
        mean = share * impedance.mass.level[..., 0, 0] + half * expected.mean(-1)
        torch.testing.assert_close(apparent.mean, mean)
        torch.testing.assert_close(
            apparent.variance, share**2 * mass + half**2 * covariance.sum((-2, -1)) / n**2
        )
        errors = impedance.layout.errors(x, 2)
        force = errors[2][..., 0] * share * mass.unsqueeze(-1) + half * errors[1][..., 0] * covariance.mean(
            -1
        )
        torch.testing.assert_close(apparent.covariance(x, Latent.FORCE), force)
        damping = half * (log_covariance * expected.unsqueeze(-2)).mean(-1)
        torch.testing.assert_close(apparent.covariance(x, Latent.DAMPING), damping)
        assert not apparent.covariance(x, Latent.STIFFNESS).any()


def test_padding_does_not_count() -> None:
    config = fixed_levels()
    _, features, model = problem(config)
    given = observations(model, features)
    n = given.inputs.shape[-2]
    padded = Observations(
        torch.cat([given.inputs, given.inputs[..., :5, :] + 0.1], dim=-2),
        torch.cat([given.residual, given.residual[..., :5]], dim=-1),
        given.noise_variance,
        (torch.arange(n + 5) < n).expand(1, n + 5),
    )
    one = log_likelihood(model.kernel, given, features.loop, 0.0)
    other = log_likelihood(model.kernel, padded, features.loop, 0.0)
    torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-11)


def test_quadratic_forms_and_their_gradients_equal_autograd_through_the_inverse() -> None:
    _, features, model = problem(fixed_levels(), rate=6.0)
    given = observations(model, features)
    generator = torch.Generator().manual_seed(1)
    columns = torch.randn(*given.residual.shape, 3, generator=generator, dtype=torch.float64).requires_grad_()
    leaves = [columns, *(p for p in model.parameters() if p.requires_grad)]
    forms, log_det = quadratic_forms(model.kernel, given, columns)
    n = columns.shape[-2]
    k = model.kernel(given.inputs, given.inputs).to_dense()
    k = k + given.noise_variance.unsqueeze(-1) * torch.eye(n, dtype=torch.float64)
    expected = columns.mT @ torch.linalg.solve(k, columns)
    weight = torch.randn(expected.shape, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(forms, expected, rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(log_det, torch.logdet(k), rtol=1e-10, atol=1e-10)
    ours = torch.autograd.grad((forms * weight).sum() + 1.7 * log_det.sum(), leaves, allow_unused=True)
    theirs = torch.autograd.grad(
        (expected * weight).sum() + 1.7 * torch.logdet(k).sum(), leaves, allow_unused=True
    )
    for left, right in zip(ours, theirs, strict=True):
        if left is not None and right is not None:
            torch.testing.assert_close(left, right, rtol=1e-6, atol=1e-7 * float(right.abs().max()))


def test_one_point_prediction_knows_the_loop() -> None:
    content = fixed_levels().model_dump(mode="json")
    content["training"] = {"restarts": 1, "max_iterations": 1}
    config = parse_config(content)
    log, features, _ = problem(config)
    model = ImpedanceModel(config).fit(log)
    expected = model.posterior(log, given="training")["force"]
    for a, axis in enumerate(log.axes):
        predictor = model.point_predictor(axis, "0")
        for row in (0, 11, 30):
            mean, variance = predictor.predict(features.inputs[a, 0, row].numpy())
            assert mean == pytest.approx(expected.mean[row, a], rel=1e-8, abs=1e-8)
            assert np.sqrt(variance) == pytest.approx(expected.sd[row, a], rel=1e-6)


def test_model_reports_the_likelihood_with_the_jacobian() -> None:
    config = fixed_levels()
    log, features, model = problem(config)
    value = log_likelihood(model.kernel, observations(model, features), features.loop, config.engine.jitter)
    reported = ImpedanceModel(config).log_marginal_likelihood(log)
    for a, axis in enumerate(log.axes):
        assert reported[axis] == pytest.approx(float(value[a].sum().detach()), rel=1e-12)
