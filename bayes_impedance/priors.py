"""Hyperpriors, and the gpytorch modules that a configuration stands for.

Every hyperparameter is positive with a log-normal hyperprior; MAP works on the logarithm, so that
the hyperprior alone puts the mode at the stated median whatever its width.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gpytorch
import torch
from gpytorch.constraints import Interval
from gpytorch.kernels import AdditiveKernel, Kernel
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.priors import NormalPrior
from torch import Tensor

from bayes_impedance.config import Config, Hyperparameter, ImpedancePrior, LengthScales, MassPrior
from bayes_impedance.config.model import LARGEST_LOG_SD
from bayes_impedance.config.sections import Component
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import UNITS, FeatureMap, baseline_components, theta_components
from bayes_impedance.kernels.coupled import (
    CoupledImpedanceKernel,
    CoupledInteractionKernel,
    by_axis,
    join_axes,
)
from bayes_impedance.kernels.coupled_terms import CoupledProcess, pair_names
from bayes_impedance.kernels.impedance import ImpedanceKernel, InputLayout, InteractionKernel
from bayes_impedance.kernels.motion_noise import MotionNoiseKernel
from bayes_impedance.kernels.stationary import StationaryKernel, log_positive
from bayes_impedance.kernels.warped import ImpedanceProcess, Law
from bayes_impedance.preprocessing.savitzky_golay import motion_weights

#: Constrained values stay inside the open interval that their constraint maps to.
INSIDE = 1e-3


class LogScalePrior(NormalPrior):
    """log h ~ N(log median, log_sd²), as a density over log h: its mode is the median of h."""

    def __init__(self, median: Tensor, log_sd: Tensor) -> None:
        super().__init__(median.log(), log_sd)

    def log_prob(self, value: Tensor) -> Tensor:
        """Density of log h at h = `value` [nats]."""
        return super().log_prob(value.log())

    def rsample(self, sample_shape: torch.Size = torch.Size()) -> Tensor:  # noqa: B008 - torch's own default
        """Draws of h."""
        return super().rsample(sample_shape).exp()


@dataclass(frozen=True)
class Entry:
    """One hyperparameter of a force model: where it lives, its units and hyperprior.

    `specs[c]` is the hyperprior of component c of the last dimension, `labels[c]` its name, `units[c]` its unit;
    `power` maps the module's value to the one that users see (σ_r from a variance). `members` names what the first
    dimension counts; empty where it is the axes.
    """

    name: str
    labels: tuple[str, ...]
    specs: tuple[Hyperparameter, ...]
    raw: torch.nn.Parameter
    constraint: Interval
    units: tuple[str, ...]
    power: float = 1.0
    members: tuple[str, ...] = ()

    @property
    def value(self) -> Tensor:
        """Value in the unit users see, `(axes, 1, 1, components)`, or `(members, 1, 1, components)`."""
        shape = (*self.raw.shape[:1], 1, 1, len(self.specs))
        return self.constraint.transform(self.raw).reshape(shape) ** self.power

    @cached_property
    def free(self) -> Tensor:
        """True for components that are learned."""
        return torch.tensor([not spec.fixed for spec in self.specs])

    def inverse(self, value: Tensor) -> Tensor:
        """Unconstrained value, in the shape of `raw`, for `value` as users see it."""
        inner = value ** (1.0 / self.power)
        low, high = self.constraint.lower_bound, self.constraint.upper_bound
        if torch.isfinite(high).all():
            inner = inner.clamp(float(low) + INSIDE, float(high) - INSIDE)
        return self.constraint.inverse_transform(
            inner.expand(self.raw.shape[0], 1, 1, -1).reshape(self.raw.shape)
        )

    @cached_property
    def medians(self) -> Tensor:
        """Medians of the hyperprior, `(components,)`."""
        return torch.tensor([spec.median for spec in self.specs], dtype=self.raw.dtype)

    @cached_property
    def log_sds(self) -> Tensor:
        """Log-SD of the hyperprior, `(components,)`."""
        return torch.tensor([spec.log_sd for spec in self.specs], dtype=self.raw.dtype)


class ForceModel(gpytorch.Module):
    """Kernel, prior mean and noise of the force, with its hyperparameters listed.

    Batch shape of every hyperparameter is `(axes, 1)`: one value an axis, shared by groups. Where axes are coupled that
    of couplings is `(2 pairs, 1)`, one for each sign of each pair, and there is one density of all forces together.
    """

    def __init__(
        self, kernel: Kernel, likelihood: GaussianLikelihood, entries: Callable[[ForceModel], Sequence[Entry]]
    ) -> None:
        super().__init__()
        self.kernel = kernel
        self.likelihood = likelihood
        self._list_entries = entries
        # Second derivatives of a kernel lose positive definiteness in single precision.
        self.double()
        for entry in self.entries:
            with torch.no_grad():
                entry.raw.copy_(entry.inverse(entry.medians))
            entry.raw.requires_grad_(bool(entry.free.any()))

    @property
    def entries(self) -> tuple[Entry, ...]:
        """Every hyperparameter, in the order in which it is shown."""
        return tuple(self._list_entries(self))

    def start_at(self, entries: Sequence[Entry]) -> None:
        """Learned hyperparameters take their values from `entries` of another model with the same ones.

        Raises:
            ConfigurationError: it has others, or another number of axes.
        """
        mine, others = (
            ", ".join(f"{entry.name} {tuple(entry.raw.shape)}" for entry in listed)
            for listed in (self.entries, entries)
        )
        if mine != others:
            raise ConfigurationError(
                f"expected a start with the hyperparameters (and shapes) {mine}, got {others}; start from a model of "
                "the same structure"
            )
        for entry, other in zip(self.entries, entries, strict=True):
            with torch.no_grad():
                entry.raw.copy_(torch.where(entry.free, other.raw, entry.raw))

    @property
    def is_coupled(self) -> bool:
        """Whether one density is of the forces along all axes together."""
        return isinstance(self.kernel, CoupledInteractionKernel)

    def prior_mean(self, inputs: Tensor) -> Tensor:
        """E[u], `(axes, groups, n)` [N]."""
        if isinstance(self.kernel, CoupledInteractionKernel):
            joined = join_axes(inputs, self.kernel.impedance.layout)
            return by_axis(self.kernel.prior_mean(joined), inputs.shape[0])
        if isinstance(self.kernel, InteractionKernel):
            return self.kernel.prior_mean(inputs)
        return inputs.new_zeros(inputs.shape[:-1])

    @property
    def noise_variance(self) -> Tensor:
        """σ_r², `(axes, 1, 1)` [N²]."""
        return self.likelihood.noise

    def log_prior(self) -> Tensor:
        """Log density of the hyperpriors, `(axes,)`, or `(1,)` where axes are coupled [nats]."""
        total = torch.zeros((), dtype=torch.float64)
        for _, module, prior, closure, _ in self.named_priors():
            density = prior.log_prob(closure(module))
            total = total + density.reshape(1 if self.is_coupled else density.shape[0], -1).sum(-1)
        return total


def build_force_model(config: Config, features: FeatureMap) -> ForceModel:
    """The interaction kernel, its mean and noise, at the hyperprior medians."""
    model = config.model
    batch = torch.Size([len(features.axes), 1])
    trajectory = _stationary(
        model.desired_trajectory.kernel,
        theta_components(model),
        features,
        model.desired_trajectory.length_scale,
        model.desired_trajectory.sd,
        batch,
        active_dims=None,
        shape=model.desired_trajectory.shape,
    )
    # Functions have matrices of their own: there these are the processes of the entries of a logarithm.
    coupled = model.axes == "coupled" and config.engine.impedance == "moments"
    impedance_of = _coupled_impedance if coupled else _impedance
    stiffness = impedance_of(model.stiffness, features, batch)
    damping = impedance_of(model.damping, features, batch)
    mass = impedance_of(model.mass, features, batch)
    residual = None
    if model.residual is not None:
        dims = features.active_dims(model.residual.input)
        residual = _stationary(
            model.residual.kernel, model.residual.input, features, model.residual.length_scale,
            model.residual.sd, batch, dims,
        )  # fmt: skip
        if model.residual.offset_sd is not None:
            offset = StationaryKernel(
                num_dims=0, batch_shape=batch, sd_prior=_prior(model.residual.offset_sd)
            )
            residual = AdditiveKernel(residual, offset)
    layout: InputLayout = features.layout
    motion_noise = None
    if layout.smoothing:
        assert model.position_noise_sd is not None
        processes = () if coupled else (stiffness, damping, mass)
        motion_noise = MotionNoiseKernel(
            layout.smoothing, processes, motion_weights, _prior(model.position_noise_sd), batch
        )
    kernel: Kernel
    if coupled:
        joint = CoupledImpedanceKernel(layout, features.width, trajectory, stiffness, damping, mass)
        kernel = CoupledInteractionKernel(joint, residual, motion_noise)
    else:
        impedance = ImpedanceKernel(layout, trajectory, stiffness, damping, mass)
        kernel = InteractionKernel(impedance, residual, motion_noise=motion_noise)

    def entries(force_model: ForceModel) -> list[Entry]:
        impedance = force_model.kernel.impedance
        listed = [
            _entry("stiffness.level", "N/m", impedance.stiffness, "level", model.stiffness.level),
            *_process_entries("stiffness", "N/m", impedance.stiffness, model.stiffness, features),
            *_coupling_entries("stiffness", impedance.stiffness, model.stiffness.coupling, features),
            _entry("damping.level", "Ns/m", impedance.damping, "level", model.damping.level),
            *_process_entries("damping", "Ns/m", impedance.damping, model.damping, features),
            *_coupling_entries("damping", impedance.damping, model.damping.coupling, features),
            _entry("mass.level", "kg", impedance.mass, "level", model.mass.level),
            *_process_entries("mass", "kg", impedance.mass, model.mass, features),
            *_coupling_entries("mass", impedance.mass, model.mass.coupling, features),
            _entry("desired_trajectory.sd", "m", impedance.trajectory, "sd", model.desired_trajectory.sd),
            _length_scales(
                "desired_trajectory", impedance.trajectory, model.desired_trajectory.length_scale,
                theta_components(model), features,
            ),
        ]  # fmt: skip
        if impedance.trajectory.profile.has_shape:
            shape = model.desired_trajectory.shape
            listed.append(_entry("desired_trajectory.shape", "1", impedance.trajectory, "shape", shape))
        if model.residual is not None:
            part = force_model.kernel.residual
            if model.residual.offset_sd is not None:
                part, offset = part.kernels
                listed.append(_entry("residual.offset_sd", "N", offset, "sd", model.residual.offset_sd))
            listed += _residual_entries(part, config, model.residual.input, features)
        listed.append(_noise_entry(force_model, config))
        if force_model.kernel.motion_noise is not None:
            assert model.position_noise_sd is not None
            part = force_model.kernel.motion_noise
            listed.append(_entry("position_noise_sd", "m", part, "sd", model.position_noise_sd))
        return listed

    return ForceModel(kernel, _likelihood(config, batch), entries)


def build_naive_model(config: Config, features: FeatureMap) -> ForceModel:
    """Squared-exponential GP on the baseline's inputs, with the residual's hyperpriors."""
    batch = torch.Size([len(features.axes), 1])
    components = baseline_components(config)
    assert config.model.residual is not None
    residual = config.model.residual
    kernel = _stationary(
        "squared_exponential", components, features, residual.length_scale, residual.sd, batch,
        features.active_dims(components),
    )  # fmt: skip

    def entries(force_model: ForceModel) -> list[Entry]:
        listed = _residual_entries(force_model.kernel, config, components, features)
        return [*listed, _noise_entry(force_model, config)]

    return ForceModel(kernel, _likelihood(config, batch), entries)


def _stationary(
    profile: str, components: Sequence[Component], features: FeatureMap, length_scale: LengthScales,
    sd: Hyperparameter, batch: torch.Size, active_dims: tuple[int, ...] | None,
    shape: Hyperparameter | None = None,
) -> StationaryKernel:  # fmt: skip
    specs = _length_scale_specs(length_scale, components, features)
    return StationaryKernel(
        profile=profile,
        num_dims=len(specs),
        batch_shape=batch,
        active_dims=active_dims,
        sd_prior=_prior(sd),
        lengthscale_prior=_prior(*specs) if specs else None,
        shape_prior=None if shape is None else _prior(shape),
    )


def _is_log(prior: ImpedancePrior | MassPrior) -> bool:
    return bool(prior.input) if isinstance(prior, MassPrior) else prior.prior == "log_gp"


def _impedance(
    prior: ImpedancePrior | MassPrior, features: FeatureMap, batch: torch.Size
) -> ImpedanceProcess:
    law: Law = "log_gaussian" if _is_log(prior) else "gaussian"
    covariance = _impedance_covariance(prior, features, batch)
    return ImpedanceProcess(covariance, law, level_prior=_prior(prior.level), batch_shape=batch)


def _coupled_impedance(
    prior: ImpedancePrior | MassPrior, features: FeatureMap, batch: torch.Size
) -> CoupledProcess:
    covariance = _impedance_covariance(prior, features, batch)
    relative = isinstance(prior, MassPrior) and not prior.input
    return CoupledProcess(
        covariance, batch[0], _prior(prior.level), _prior(prior.coupling), relative=relative
    )


def _impedance_covariance(
    prior: ImpedancePrior | MassPrior, features: FeatureMap, batch: torch.Size
) -> StationaryKernel:
    specs = _length_scale_specs(prior.length_scale, prior.input, features)
    learned_log_sd = _is_log(prior) and not prior.scale.fixed
    return StationaryKernel(
        num_dims=len(specs),
        batch_shape=batch,
        active_dims=features.active_dims(prior.input) if specs else None,
        sd_prior=_prior(prior.scale),
        # Beyond this log-SD the Gaussian approximation of the force fails, so training may not go there.
        sd_constraint=Interval(0.0, LARGEST_LOG_SD) if learned_log_sd else None,
        lengthscale_prior=_prior(*specs) if specs else None,
    )


def _likelihood(config: Config, batch: torch.Size) -> GaussianLikelihood:
    spec = config.model.noise_sd
    # log σ_r² = 2 log σ_r: the same hyperprior, stated for the variance that gpytorch keeps.
    prior = LogScalePrior(
        torch.tensor([spec.median**2], dtype=torch.float64),
        torch.tensor([2.0 * spec.log_sd], dtype=torch.float64),
    )
    return GaussianLikelihood(noise_prior=prior, noise_constraint=log_positive(), batch_shape=batch)


def _prior(*specs: Hyperparameter) -> LogScalePrior:
    return LogScalePrior(
        torch.tensor([[spec.median for spec in specs]], dtype=torch.float64),
        torch.tensor([[spec.log_sd for spec in specs]], dtype=torch.float64),
    )


def _length_scale_specs(
    length_scale: LengthScales, components: Sequence[str], features: FeatureMap
) -> list[Hyperparameter]:
    return [
        getattr(length_scale, component) for component in components for _ in features.labels([component])
    ]


def _entry(name: str, unit: str, module: Any, attribute: str, spec: Hyperparameter) -> Entry:
    raw, constraint = getattr(module, f"raw_{attribute}"), getattr(module, f"raw_{attribute}_constraint")
    return Entry(name, ("",), (spec,), raw, constraint, (unit,))


def _length_scales(
    name: str, module: StationaryKernel, length_scale: LengthScales, components: Sequence[str],
    features: FeatureMap,
) -> Entry:  # fmt: skip
    specs = tuple(_length_scale_specs(length_scale, components, features))
    labels = tuple(features.labels(components))
    units = tuple(UNITS[component] for component in components for _ in features.labels([component]))
    return Entry(
        f"{name}.length_scale", labels, specs,
        module.raw_lengthscale, module.raw_lengthscale_constraint, units,
    )  # fmt: skip


def _process_entries(
    name: str, unit: str, process: ImpedanceProcess, prior: ImpedancePrior | MassPrior, features: FeatureMap
) -> list[Entry]:
    scale_name, scale_unit = ("log_sd", "1") if _is_log(prior) else ("sd", unit)
    entries = [_entry(f"{name}.{scale_name}", scale_unit, process.covariance, "sd", prior.scale)]
    if prior.input:
        entries.append(_length_scales(name, process.covariance, prior.length_scale, prior.input, features))
    return entries


def _coupling_entries(
    name: str, process: ImpedanceProcess | CoupledProcess, spec: Hyperparameter, features: FeatureMap
) -> list[Entry]:
    if not isinstance(process, CoupledProcess):
        return []
    signs = tuple(f"{pair} {sign}" for pair in pair_names(features.axes) for sign in ("+", "−"))
    return [replace(_entry(f"{name}.coupling", "1", process, "coupling", spec), members=signs)]


def _residual_entries(
    kernel: StationaryKernel, config: Config, components: Sequence[str], features: FeatureMap
) -> list[Entry]:
    assert config.model.residual is not None
    residual = config.model.residual
    return [
        _entry("residual.sd", "N", kernel, "sd", residual.sd),
        _length_scales("residual", kernel, residual.length_scale, components, features),
    ]


def _noise_entry(force_model: ForceModel, config: Config) -> Entry:
    noise = force_model.likelihood.noise_covar
    spec = config.model.noise_sd
    return Entry("noise_sd", ("",), (spec,), noise.raw_noise, noise.raw_noise_constraint, ("N",), power=0.5)
