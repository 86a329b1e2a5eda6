"""The posterior density that is sampled: impedance and hyperparameters, all else marginalised exactly.

    log p(z | u) = log p(u | W(z), h(z)) + log |det(I + Z M_r⁻¹)| − ½ |z|² + const

z are standard normal coordinates of every weight and hyperparameter; desired trajectory and residual force are
integrated out by an engine given impedance (docs/model.md §13), the determinant is that of a closed loop (§6).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.config import Config
from bayes_impedance.engines.choice import EngineChoice, build_engine, choose_engine
from bayes_impedance.engines.given_impedance import Processes
from bayes_impedance.errors import ConfigurationError, NotPositiveDefiniteError
from bayes_impedance.features import Features
from bayes_impedance.impedance_functions.density import Designs, log_jacobian
from bayes_impedance.impedance_functions.function import ImpedanceFunction, build_functions
from bayes_impedance.impedance_functions.tilted import TiltedDensity
from bayes_impedance.kernels.stationary import Stationary, StationaryCovariance
from bayes_impedance.priors import Entry, ForceModel
from bayes_impedance.sampling.parameters import (
    QUANTITIES,
    Parameter,
    filled,
    hyperparameters_of,
    parameter_of,
    weights_of,
)

Array = NDArray[np.float64]

#: Forces up to which dense is taken unasked: features of a few dozen columns are quicker beyond.
FEW = 50


class SampledDensity(TiltedDensity):
    """A log density that samplers climb and walk on, over coordinates of about unit size before any force."""

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.free)

    @abstractmethod
    def log_density(self, coordinates: Tensor) -> Tensor:
        """log p(coordinates | u) up to a constant, at coordinates `(size,)` [nats].

        Raises:
            NotPositiveDefiniteError: it is not finite there.
        """

    def settle(self, point: Array, precision: Array) -> tuple[Array, float]:
        """Take up what is known about a mode, its `precision` `(size, size)`; the same place, and how far it moved.

        Coordinates that know nothing of modes stay as they are.
        """
        return point, 0.0

    def joint(self, point: Array) -> tuple[float, Array]:
        """`log_density` and its gradient.

        Raises:
            NotPositiveDefiniteError: it is not finite there.
        """
        coordinates = torch.from_numpy(point).clone().requires_grad_()
        value = self.log_density(coordinates)
        (gradient,) = torch.autograd.grad(value, coordinates)
        if not (np.isfinite(value.item()) and np.isfinite(gradient.numpy()).all()):
            raise NotPositiveDefiniteError(
                "expected a finite posterior density, found one that overflows, or its gradient does; check log.units, "
                "and that the medians under model are of the size that their unit lets expect"
            )
        return value.item(), gradient.numpy()


class JointDensity(SampledDensity):
    """Log density of weights and hyperparameters given the forces of `features`.

    `parameters` in the order of their coordinates; `engine_choice` says which engine marginalises, and why.

    Raises:
        ConfigurationError: no engine holds the processes.
        TooManySamplesError: dense is asked for, and the samples are too many.
    """

    def __init__(
        self, config: Config, model: ForceModel, features: Features, inducing: tuple[Tensor | None, ...]
    ) -> None:
        self.config, self.features = config, features
        self.coupled = config.model.axes == "coupled"
        known = Processes.of(model, config.model.desired_trajectory.periodic)
        # No module stays: other processes take the density over, and those of gpytorch do not travel.
        self._known = replace(
            known,
            trajectory=_plain(known.trajectory),
            residual=tuple(map(_plain, known.residual)),
            noise_variance=known.noise_variance.detach(),
        )
        self._functions = tuple(
            replace(function, covariance=_plain(function.covariance))
            for function in build_functions(config, model, inducing)
        )
        self._entries = {entry.name: entry for entry in model.entries}
        # Components that nothing learns stay where the hyperprior has its median.
        learned: list[Entry] = hyperparameters_of(model, self._functions)
        self._varying = {entry.name.split(".")[0] for entry in learned}.intersection(QUANTITIES)
        self.parameters: tuple[Parameter, ...] = (
            *weights_of(self._functions, len(features.groups)),
            *(parameter_of(entry, self.coupled) for entry in learned),
        )
        sizes = [parameter.size for parameter in self.parameters]
        super().__init__(sum(sizes[: len(QUANTITIES)]), np.ones(sum(sizes), dtype=bool))
        self.sizes = sizes
        # exp of all hyperparameters at once.
        hyperparameters = self.parameters[len(QUANTITIES) :]
        self._medians = _joined([p.median.expand(p.shape) for p in hyperparameters if p.median is not None])
        self._log_sds = _joined([p.log_sd.expand(p.shape) for p in hyperparameters if p.log_sd is not None])
        with torch.no_grad():
            processes = self.processes(self.values(torch.zeros(self.size, dtype=torch.float64)))
            self._fixed = tuple(
                None if self.varies(name) else function.design(features.inputs)
                for name, function in zip(QUANTITIES, self._functions, strict=True)
            )
        self.engine_choice: EngineChoice = choose_engine(
            config.engine, processes, features, self.coupled, FEW
        )
        self.engine = build_engine(self.engine_choice.name, config.engine, processes, features, self.coupled)

    def values(self, standard: Tensor) -> dict[str, Tensor]:
        """Values of all sites at coordinates `(..., size)`, by name."""
        own, raw = standard.split([self.weight_count, self.size - self.weight_count], dim=-1)
        values = torch.cat([own, self._medians * torch.exp(self._log_sds * raw)], dim=-1)
        parts = zip(self.parameters, values.split(self.sizes, dim=-1), strict=True)
        return {p.name: part.reshape(*part.shape[:-1], *p.shape) for p, part in parts}

    def standard(self, values: Mapping[str, Tensor]) -> Tensor:
        """The inverse of `values`."""
        return torch.cat([p.standard(values[p.name]) for p in self.parameters], dim=-1)

    def processes(self, values: Mapping[str, Tensor]) -> Processes:
        """Desired trajectory, residual force and noise at the values of their sites."""
        known = self._known
        noise = filled(self._entries["noise_sd"], values)[:, 0].square()
        terms = [
            self._covariance(name, term, values)
            for name, term in zip(("residual", "residual.offset_sd"), known.residual, strict=False)
        ]
        trajectory = self._covariance("desired_trajectory", known.trajectory, values)
        return replace(known, trajectory=trajectory, residual=tuple(terms), noise_variance=noise)

    def functions(self, values: Mapping[str, Tensor]) -> tuple[ImpedanceFunction, ...]:
        """K, D and M as functions, at the log-SDs and length scales among the values."""
        return tuple(
            replace(function, covariance=self._covariance(name, function.covariance, values, scale="log_sd"))
            if self.varies(name)
            else function
            for name, function in zip(QUANTITIES, self._functions, strict=True)
        )

    def designs(self, values: Mapping[str, Tensor], target: Features | None = None) -> Designs:
        """Designs of K, D and M at the samples whose forces are given, or at those of `target`."""
        functions = self.functions(values)
        if target is not None:
            return Designs.at(functions, target.inputs)
        parts = zip(functions, self._fixed, strict=True)
        inputs = self.features.inputs
        return Designs(functions, tuple(f.design(inputs) if known is None else known for f, known in parts))

    def impedance(self, values: Mapping[str, Tensor], target: Features | None = None) -> Tensor:
        """K [N/m], D [Ns/m], M [kg] at the samples whose forces are given, or at those of `target`.

        `(groups, n, 3, axes, axes)`; what inducing inputs leave out of functions is left out here, too.
        """
        return self.designs(values, target).matrices(weights(values))

    def log_likelihood(self, values: Mapping[str, Tensor]) -> Tensor:
        """log p(u | values) of all axes and groups, with the Jacobian of the closed loop [nats].

        Raises:
            NotPositiveDefiniteError: rounding left no positive variance of the forces, or length scales are so short
                that no feature reaches them.
        """
        impedance = self.impedance(values)
        try:
            value = self.engine.log_likelihood_given_impedance(self.processes(values), impedance).sum()
        except ConfigurationError as error:
            # The processes were accepted at the medians: only the number of features can have grown.
            raise NotPositiveDefiniteError(
                f"length scales became shorter than an engine holds: {error}"
            ) from error
        loop = self.features.loop
        if loop is None:
            return value
        return value + log_jacobian(loop, impedance, self.features.valid, self.coupled).sum()

    def log_density(self, coordinates: Tensor) -> Tensor:
        """log p(z | u) up to a constant, at z `(size,)` [nats].

        Raises:
            NotPositiveDefiniteError: see `log_likelihood`.
        """
        return self.log_likelihood(self.values(coordinates)) - 0.5 * coordinates @ coordinates

    def is_constant(self, quantity: int) -> bool:
        """Whether K, D or M (0, 1, 2) does not depend on an input."""
        return self._functions[quantity].inducing is None

    def varies(self, quantity: str) -> bool:
        """Whether how a function varies is sampled, too."""
        return quantity in self._varying

    def _covariance(
        self, name: str, kernel: Stationary, values: Mapping[str, Tensor], scale: str = "sd"
    ) -> StationaryCovariance:
        """A covariance of the model at the values of its sites."""
        if name.endswith("offset_sd"):
            return StationaryCovariance.like(kernel, filled(self._entries[name], values), None)
        parts = {
            key: filled(entry, values)
            for key in (scale, "length_scale", "shape")
            if (entry := self._entries.get(f"{name}.{key}")) is not None
        }
        return StationaryCovariance.like(kernel, parts[scale], parts.get("length_scale"), parts.get("shape"))


def _joined(parts: list[Tensor]) -> Tensor:
    """All entries of some tensors in one row."""
    return torch.cat([torch.zeros(0, dtype=torch.float64), *(part.reshape(-1) for part in parts)])


def _plain(kernel: Stationary) -> StationaryCovariance:
    """What a kernel computes, at the hyperparameters it has."""
    lengthscale, shape = (None if own is None else own.detach() for own in (kernel.lengthscale, kernel.shape))
    return StationaryCovariance.like(kernel, kernel.sd.detach(), lengthscale, shape)


def weights(values: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
    """Weights of K, D and M among the values of all sites."""
    return tuple(values[f"{name}_weights"] for name in QUANTITIES)
