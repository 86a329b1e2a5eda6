"""Slow oracles: products, paths and moments written out, differentiated by autograd, conditioned by solve.

Nothing here calls the library's kernels; a `ProcessSpec` or `TrajectorySpec` states a prior once, for the
oracle's formula and for the library's module alike.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from bayes_impedance.config import Config, parse_config
from bayes_impedance.features import FeatureMap, Features
from bayes_impedance.kernels import ImpedanceProcess, StationaryKernel
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial

PROFILE_NAMES = ("squared_exponential", "rational_quadratic", "matern52", "matern72", "matern92")
SMOOTH = ("squared_exponential", "rational_quadratic")
TRAJECTORY = ("desired_position", "desired_velocity", "desired_acceleration")
IMPEDANCE = ("stiffness", "damping", "mass")


def relative_error(value: Tensor, expected: Tensor) -> float:
    """Largest deviation over the largest entry expected."""
    deviation = (value - expected).detach().abs().max()
    return float(deviation / expected.detach().abs().max().clamp_min(1e-300))


def double(value: float | Sequence[float]) -> Tensor:
    """Numbers in float64."""
    return torch.tensor(value, dtype=torch.float64)


def number(value: Tensor) -> float:
    """A one-element tensor as a number, outside the graph."""
    return float(value.detach())


# --- covariances of one pair -------------------------------------------------------------------------


def profile_of(name: str, s: Tensor, alpha: float = 1.0) -> Tensor:
    """κ(s) from textbook formulas (Rasmussen & Williams §4.2), s = ½ (r/ℓ)²."""
    if name == "squared_exponential":
        return torch.exp(-s)
    if name == "rational_quadratic":
        return (1.0 + s / alpha) ** (-alpha)
    nu = {"matern52": 2.5, "matern72": 3.5, "matern92": 4.5}[name]
    z = math.sqrt(2.0 * nu) * torch.sqrt(2.0 * s)
    polynomial = {
        2.5: 1.0 + z + z**2 / 3.0,
        3.5: 1.0 + z + 2.0 * z**2 / 5.0 + z**3 / 15.0,
        4.5: 1.0 + z + 3.0 * z**2 / 7.0 + 2.0 * z**3 / 21.0 + z**4 / 105.0,
    }[nu]
    return polynomial * torch.exp(-z)


@dataclass(frozen=True)
class TrajectorySpec:
    """k_xd: profile, SD, length scales of the components of θ, and α of the rational quadratic."""

    profile: str = "squared_exponential"
    sd: float = 0.02
    lengthscale: tuple[float, ...] = (0.3,)
    alpha: float = 1.3

    def covariance(self, theta1: Tensor, theta2: Tensor) -> Tensor:
        """Elementwise k_xd; the last dimension holds the components of θ."""
        r = (theta1 - theta2) / torch.tensor(self.lengthscale, dtype=theta1.dtype)
        return self.sd**2 * profile_of(self.profile, 0.5 * (r * r).sum(-1), self.alpha)

    def kernel(self) -> StationaryKernel:
        """The library's module."""
        kernel = StationaryKernel(self.profile, num_dims=len(self.lengthscale)).double()
        kernel.sd, kernel.lengthscale = double(self.sd), double(self.lengthscale)
        if kernel.profile.has_shape:
            kernel.shape = double(self.alpha)
        return kernel


@dataclass(frozen=True)
class ProcessSpec:
    """Prior of k, d or m over columns `component` of ξ; without length scales it is one constant."""

    law: str = "log_gaussian"
    level: float = 100.0
    sd: float = 0.3
    lengthscale: tuple[float, ...] = ()
    component: str = ""

    def gaussian(self, xi1: Tensor, xi2: Tensor) -> Tensor:
        """k_w between rows, `(n1, n2)`: covariance of w, or of log w."""
        rows = []
        for a in xi1:
            s = torch.zeros(len(xi2), dtype=xi1.dtype)
            for c, length in enumerate(self.lengthscale):
                s = s + 0.5 * ((a[c] - xi2[:, c]) / length) ** 2
            rows.append(self.sd**2 * torch.exp(-s))
        return torch.stack(rows)

    @property
    def expectation(self) -> float:
        """E[w]; k_w is stationary, so it is one number."""
        return self.level if self.law == "gaussian" else self.level * math.exp(0.5 * self.sd**2)

    @property
    def sensitivity(self) -> float:
        """Cov[w, g] / Cov[g, g] for the Gaussian variable g = w or log w (Stein's lemma)."""
        return 1.0 if self.law == "gaussian" else self.expectation

    def second_moment(self, xi1: Tensor, xi2: Tensor) -> Tensor:
        """E[w w']: of a log-Gaussian, μ² exp(½ (k + k' + 2 k_w))."""
        k = self.gaussian(xi1, xi2)
        if self.law == "gaussian":
            return self.level**2 + k
        return self.level**2 * torch.exp(0.5 * (2.0 * self.sd**2 + 2.0 * k))

    def kernel(self, active_dims: tuple[int, ...] | None = None) -> ImpedanceProcess:
        """The library's module."""
        covariance = StationaryKernel(num_dims=len(self.lengthscale), active_dims=active_dims)
        process = ImpedanceProcess(covariance, self.law).double()
        process.level, covariance.sd = double(self.level), double(self.sd)
        if self.lengthscale:
            covariance.lengthscale = double(self.lengthscale)
        return process


@dataclass(frozen=True)
class ResidualSpec:
    """ũ ~ GP(0, SE) over columns of ξ, plus an offset a label."""

    sd: float = 0.0
    lengthscale: tuple[float, ...] = ()
    component: str = ""
    offset_sd: float = 0.0

    def covariance(self, xi1: Tensor, xi2: Tensor) -> Tensor:
        """k_ũ between rows whose labels agree."""
        return ProcessSpec("gaussian", 1.0, self.sd, self.lengthscale).gaussian(xi1, xi2) + self.offset_sd**2


# --- samples along paths -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Samples:
    """θ, θ̇, θ̈ `(n, p)`; ē, ē', ē'' `(n, 3)`; ξ by component `(n, q)`; labels `(n,)`; μ_xd `(n, 3)`."""

    theta: Tensor
    velocity: Tensor
    acceleration: Tensor
    error: Tensor
    xi: dict[str, Tensor] = field(default_factory=dict)
    trajectory: Tensor | None = None
    residual: Tensor | None = None
    mean: Tensor | None = None

    def __getitem__(self, rows: slice | Tensor | Sequence[int]) -> Samples:
        """Some of the samples."""

        def cut(value: Tensor | None) -> Tensor | None:
            return None if value is None else value[rows]

        return Samples(
            self.theta[rows], self.velocity[rows], self.acceleration[rows], self.error[rows],
            {name: value[rows] for name, value in self.xi.items()},
            cut(self.trajectory), cut(self.residual), cut(self.mean),
        )  # fmt: skip


def expansion(value: Tensor, rate: Tensor, change: Tensor, t: Tensor) -> Tensor:
    """value + rate t + ½ change t², whose derivatives at t = 0 are those given."""
    return value + rate * t + 0.5 * change * t * t


def derivatives_of(
    function: Callable[[Tensor, Tensor], Tensor], n1: int, n2: int, order: int = 2
) -> list[list[Tensor]]:
    """∂_tⁱ ∂_t'ʲ function(t, t') at t = t' = 0 by nested autograd, elementwise over `(n1, n2)`."""
    t1 = torch.zeros(n1, n2, dtype=torch.float64, requires_grad=True)
    t2 = torch.zeros(n1, n2, dtype=torch.float64, requires_grad=True)

    def differentiate(value: Tensor, by: Tensor) -> Tensor:
        if not value.requires_grad:
            return torch.zeros_like(by)
        (result,) = torch.autograd.grad(value.sum(), by, create_graph=True, allow_unused=True)
        return torch.zeros_like(by) if result is None else result

    row = [function(t1, t2)]
    for _ in range(order):
        row.append(differentiate(row[-1], t2))
    table = [row]
    for _ in range(order):
        table.append([differentiate(entry, t1) for entry in table[-1]])
    return [[entry.detach() for entry in entries] for entries in table]


def path_derivatives(
    covariance: Callable[[Tensor, Tensor], Tensor], one: Samples, two: Samples
) -> list[list[Tensor]]:
    """∂_tⁱ ∂_t'ʲ k(θ(t), θ(t')) for all pairs of samples."""

    def along(t1: Tensor, t2: Tensor) -> Tensor:
        theta1 = expansion(
            one.theta[:, None], one.velocity[:, None], one.acceleration[:, None], t1[..., None]
        )
        theta2 = expansion(two.theta[None], two.velocity[None], two.acceleration[None], t2[..., None])
        return covariance(theta1, theta2)

    return derivatives_of(along, len(one.theta), len(two.theta))


def stacked(table: list[list[Tensor]]) -> Tensor:
    """Joint covariance of (x_d, ẋ_d, ẍ_d): block (i, j) is `table[i][j]`."""
    return torch.cat([torch.cat(list(row), dim=-1) for row in table], dim=-2)


# --- moments of the force ----------------------------------------------------------------------------


@dataclass(frozen=True)
class ForceOracle:
    """Moments of u = Σ_j w_j e⁽ʲ⁾ + ũ from products of independent factors; `processes` are k, d[, m]."""

    trajectory: TrajectorySpec
    processes: tuple[ProcessSpec, ...]
    residual: ResidualSpec | None = None

    def mean(self, samples: Samples) -> Tensor:
        """E[u] = Σ_j E[w_j] ē_j."""
        return sum(process.expectation * samples.error[:, j] for j, process in enumerate(self.processes))

    def covariance(self, one: Samples, two: Samples) -> Tensor:
        """E[u u'] − E[u] E[u'] with E[u u'] = Σ_ij E[w_i w_j'] E[e⁽ⁱ⁾ e⁽ʲ⁾'], + k_ũ."""
        products = self._error_products(one, two)
        total = torch.zeros(len(one.theta), len(two.theta), dtype=torch.float64)
        for i, first in enumerate(self.processes):
            for j, second in enumerate(self.processes):
                if i == j:
                    weight = first.second_moment(_xi(one, first), _xi(two, first))
                else:
                    weight = torch.tensor(first.expectation * second.expectation, dtype=torch.float64)
                total = total + weight * products[i][j]
        return total - self.mean(one)[:, None] * self.mean(two)[None] + self.residual_covariance(one, two)

    def cross(self, one: Samples, two: Samples, latent: str) -> Tensor:
        """Cov[u, latent'], by its logarithm where warped."""
        if latent == "force":
            return self.covariance(one, two)
        if latent == "residual_force":
            return self.residual_covariance(one, two)
        if latent in TRAJECTORY:
            # Cov[Σ_i w_i e⁽ⁱ⁾, x_d⁽ʳ⁾'] = Σ_i E[w_i] Cov[x_d⁽ⁱ⁾, x_d⁽ʳ⁾']
            table = self._trajectory_table(one, two)
            order = TRAJECTORY.index(latent)
            return sum(process.expectation * table[i][order] for i, process in enumerate(self.processes))
        j = IMPEDANCE.index(latent)
        process = self.processes[j]
        k = process.gaussian(_xi(one, process), _xi(two, process))
        return one.error[:, [j]] * process.sensitivity * k

    def own(self, samples: Samples, latent: str) -> Tensor:
        """Prior covariance of a latent, of its logarithm where warped."""
        if latent in TRAJECTORY:
            order = TRAJECTORY.index(latent)
            return self._trajectory_table(samples, samples)[order][order]
        if latent in IMPEDANCE:
            process = self.processes[IMPEDANCE.index(latent)]
            return process.gaussian(_xi(samples, process), _xi(samples, process))
        return self.cross(samples, samples, latent)

    def location(self, samples: Samples, latent: str) -> Tensor:
        """Prior mean of a latent, of its logarithm where warped."""
        if latent == "force":
            return self.mean(samples)
        if latent in TRAJECTORY:
            assert samples.mean is not None
            return samples.mean[:, TRAJECTORY.index(latent)]
        if latent in IMPEDANCE:
            process = self.processes[IMPEDANCE.index(latent)]
            value = process.level if process.law == "gaussian" else math.log(process.level)
            return torch.full((len(samples.theta),), value, dtype=torch.float64)
        return torch.zeros(len(samples.theta), dtype=torch.float64)

    def level_loading(self, samples: Samples, latent: str) -> Tensor:
        """∂E[latent]/∂b_j for an offset b_j of each Gaussian variable, `(n, 3)`."""
        loading = torch.zeros(len(samples.theta), 3, dtype=torch.float64)
        if latent == "force":
            for j, process in enumerate(self.processes):
                loading[:, j] = samples.error[:, j] * process.sensitivity
        elif latent in IMPEDANCE:
            loading[:, IMPEDANCE.index(latent)] = 1.0
        return loading

    def residual_covariance(self, one: Samples, two: Samples) -> Tensor:
        """k_ũ between samples of one label, else 0."""
        if self.residual is None:
            return torch.zeros(len(one.theta), len(two.theta), dtype=torch.float64)
        k = self.residual.covariance(one.xi[self.residual.component], two.xi[self.residual.component])
        return torch.where(_same(one.residual, two.residual), k, 0.0)

    def _trajectory_table(self, one: Samples, two: Samples) -> list[list[Tensor]]:
        table = path_derivatives(self.trajectory.covariance, one, two)
        shared = _same(one.trajectory, two.trajectory)
        return [[torch.where(shared, entry, 0.0) for entry in row] for row in table]

    def _error_products(self, one: Samples, two: Samples) -> list[list[Tensor]]:
        """E[e⁽ⁱ⁾ e⁽ʲ⁾'] = ∂_tⁱ ∂_t'ʲ (ē(t) ē(t') + k_xd(θ(t), θ(t')))."""

        def mean_product(t1: Tensor, t2: Tensor) -> Tensor:
            e1 = expansion(*(one.error[:, None, j] for j in range(3)), t1)
            e2 = expansion(*(two.error[None, :, j] for j in range(3)), t2)
            return e1 * e2

        means = derivatives_of(mean_product, len(one.theta), len(two.theta))
        table = self._trajectory_table(one, two)
        return [[means[i][j] + table[i][j] for j in range(3)] for i in range(3)]


def _xi(samples: Samples, process: ProcessSpec) -> Tensor:
    return samples.xi[process.component] if process.lengthscale else samples.theta


def _same(one: Tensor | None, two: Tensor | None) -> Tensor:
    if one is None or two is None:
        return torch.ones((), dtype=torch.bool)
    return one[:, None] == two[None]


def condition(
    oracle: ForceOracle, given: Samples, force: Tensor, target: Samples, latent: str, noise_variance: float,
    level_variance: Sequence[float] = (0.0, 0.0, 0.0), jitter: float = 0.0,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Mean and variance of a latent by solving with the full covariance; force is a new measurement."""
    variances = torch.diag(torch.tensor(level_variance, dtype=torch.float64))
    a, b = oracle.level_loading(given, "force"), oracle.level_loading(target, latent)
    own = oracle.covariance(given, given)
    diagonal = (noise_variance + jitter * own.diagonal().mean()) * torch.eye(len(force), dtype=torch.float64)
    k = own + a @ variances @ a.T + diagonal
    cross = oracle.cross(given, target, latent) + a @ variances @ b.T
    prior = oracle.own(target, latent).diagonal() + (b @ variances @ b.T).diagonal()
    gain = torch.linalg.solve(k, cross)
    variance = prior - (cross * gain).sum(0) + (noise_variance if latent == "force" else 0.0)
    return oracle.location(target, latent) + gain.T @ (force - oracle.mean(given)), variance


# --- from a configuration and a log ------------------------------------------------------------------

#: What data of tests are drawn from; the models that are trained on them start elsewhere (`configs/phase.yaml`).
TRUTH: dict[str, object] = {
    "model": {
        "trajectory_input": "phase",
        "desired_trajectory": {"mean": "reference", "sd": 0.015, "length_scale": {"phase": 0.12}},
        "stiffness": {"level": 180, "log_sd": 0.3, "input": ["phase"], "length_scale": {"phase": 0.2}},
        "damping": {"level": 14, "log_sd": 0.3, "input": ["phase"], "length_scale": {"phase": 0.2}},
        "mass": {"level": 1.3, "sd": 0.2},
        "residual": {"sd": 0.4, "input": ["position", "velocity"]},
        "noise_sd": 0.1,
    }
}

MODEL = {
    "trajectory_input": "phase",
    "desired_trajectory": {
        "mean": "reference",
        "sd": 0.02,
        "length_scale": {"time": 0.3, "phase": 0.1, "position": 0.06, "velocity": 0.3},
    },
    "stiffness": {"level": 100, "log_sd": 0.3, "input": ["position"], "length_scale": {"position": 0.1}},
    "damping": {"level": 9, "log_sd": 0.2, "input": ["position"], "length_scale": {"position": 0.15}},
    "mass": {"level": 1.2, "sd": 0.2},
    "residual": {"sd": 0.3, "input": ["position"], "length_scale": {"position": 0.1}},
    "noise_sd": 0.2,
}


def configuration(overrides: Sequence[str] = (), **model: object) -> Config:
    """Configuration whose hyperparameters are fixed; sections of `model` replace those above."""
    return parse_config({"model": {**MODEL, **model}}, overrides=overrides)


def oracle_of(config: Config, axes: int) -> ForceOracle:
    """The oracle at the hyperprior medians of a configuration."""
    model = config.model
    components = ("position", "velocity") if model.trajectory_input == "position_velocity" else (
        model.trajectory_input,
    )  # fmt: skip

    def lengths(scales: object, inputs: Sequence[str]) -> tuple[float, ...]:
        counts = {name: 1 if name in ("time", "phase") else axes for name in inputs}
        return tuple(getattr(scales, name).median for name in inputs for _ in range(counts[name]))

    desired = model.desired_trajectory
    processes = [
        ProcessSpec(
            "log_gaussian" if prior.prior == "log_gp" else "gaussian", prior.level.median, prior.scale.median,
            lengths(prior.length_scale, prior.input), "+".join(prior.input),
        )
        for prior in (model.stiffness, model.damping)
    ]  # fmt: skip
    processes.append(ProcessSpec("gaussian", model.mass.level.median, model.mass.sd.median))
    residual = None
    if model.residual is not None:
        offset = 0.0 if model.residual.offset_sd is None else model.residual.offset_sd.median
        scales = lengths(model.residual.length_scale, model.residual.input)
        residual = ResidualSpec(model.residual.sd.median, scales, "+".join(model.residual.input), offset)
    return ForceOracle(
        TrajectorySpec(
            desired.kernel, desired.sd.median, lengths(desired.length_scale, components), desired.shape.median
        ),
        tuple(processes),
        residual,
    )


def samples_of(config: Config, log: PreparedLog, axis: int) -> Samples:
    """Every sample of a log as the model's equations read it, trial after trial."""
    model = config.model
    parts = [_trial_samples(config, trial, axis) for trial in log.trials]
    # Trials have their own x_d over time, and their own residual.
    label = torch.cat([torch.full((len(part[0]),), float(i)) for i, part in enumerate(parts)])
    shared = config.shared.desired_trajectory
    own = model.trajectory_input == "time" if shared is None else not shared
    theta, velocity, acceleration, error, mean = (torch.cat([p[i] for p in parts]) for i in range(5))
    xi = {name: torch.cat([part[5][name] for part in parts]) for name in parts[0][5]}
    residual = None if config.shared.residual else label
    return Samples(theta, velocity, acceleration, error, xi, label if own else None, residual, mean)


def _trial_samples(config: Config, trial: PreparedTrial, axis: int) -> tuple[object, ...]:
    model = config.model
    elapsed = (trial.time - trial.time[0])[:, None]
    theta, velocity, acceleration = {
        "time": (elapsed, np.ones_like(elapsed), np.zeros_like(elapsed)),
        "phase": tuple(
            None if part is None else part[:, None]
            for part in (trial.phase, trial.phase_velocity, trial.phase_acceleration)
        ),
        "position": (trial.position, trial.velocity, trial.acceleration),
        "position_velocity": (
            np.hstack([trial.position, trial.velocity]),
            np.hstack([trial.velocity, trial.acceleration]),
            np.hstack([trial.acceleration, trial.jerk]),
        ),
    }[model.trajectory_input]
    if model.drop_acceleration:
        # The paper's rule: θ̇ = [ẋ, 0], θ̈ = 0.
        velocity = np.hstack([trial.velocity, np.zeros_like(trial.velocity)])
        acceleration = np.zeros_like(velocity)
    hand = np.stack([trial.position, trial.velocity, trial.acceleration], axis=-1)[:, axis]
    if model.desired_trajectory.mean == "equilibrium":
        desired = hand
    else:
        columns = (trial.reference, trial.reference_velocity, trial.reference_acceleration)
        desired = np.stack(columns, axis=-1)[:, axis]
    values = {
        "time": elapsed,
        "phase": None if trial.phase is None else trial.phase[:, None],
        "position": trial.position,
        "velocity": trial.velocity,
    }
    used = [model.stiffness.input, model.damping.input]
    used += [] if model.residual is None else [model.residual.input]
    xi = {
        "+".join(inputs): _tensor(np.hstack([values[name] for name in inputs])) for inputs in used if inputs
    }
    arrays = (theta, velocity, acceleration, desired - hand, desired)
    return (*(_tensor(array) for array in arrays), xi)


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.array(array, dtype=np.float64))


# --- parts of features -------------------------------------------------------------------------------


def some_rows(features: Features, rows: Sequence[int]) -> Features:
    """Evidence that consists of some samples of every group; nothing may be padded."""
    assert features.valid is None
    assert features.force is not None
    index = torch.as_tensor(list(rows))
    return Features(
        features.groups,
        features.inputs[:, :, index],
        features.force[:, :, index],
        features.trajectory_mean[:, :, index],
        None,
        tuple(group_rows[index.numpy()] for group_rows in features.rows),
    )


def feature_map(config: Config, log: PreparedLog) -> FeatureMap:
    """The library's map of this configuration."""
    return FeatureMap(config, log.axes)


def truth_of(log: PreparedLog, name: str) -> np.ndarray:
    """A true latent at every sample, `(samples, axes)`."""
    ends = [axis + axis if name in IMPEDANCE else axis for axis in log.axes]
    return np.stack(
        [np.concatenate([trial.truth[f"{name}_{end}"] for trial in log.trials]) for end in ends], 1
    )


def timeless(log: PreparedLog) -> PreparedLog:
    """`log` without phase."""
    trials = (
        replace(trial, phase=None, phase_velocity=None, phase_acceleration=None) for trial in log.trials
    )
    return PreparedLog(log.axes, tuple(trials))
