"""Posterior density of impedance functions and of the hyperparameters beside them, given forces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.device import Loop
from bayes_impedance.engines.given_impedance import ConditionalEngine, Processes
from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.features import Features
from bayes_impedance.impedance_functions.function import ImpedanceFunction
from bayes_impedance.impedance_functions.tilted import TiltedDensity
from bayes_impedance.priors import Entry, ForceModel

Array = NDArray[np.float64]

#: Hyperparameters of the impedance's own priors: functions carry their levels, and evidence finds the others.
OF_IMPEDANCE = ("stiffness.", "damping.", "mass.")


@dataclass(frozen=True)
class Designs:
    """Designs of K, D and M at the same samples."""

    functions: tuple[ImpedanceFunction, ...]
    designs: tuple[Tensor, ...]

    @classmethod
    def at(cls, functions: tuple[ImpedanceFunction, ...], inputs: Tensor) -> Designs:
        """Those at `inputs` `(axes, groups, n, D)`."""
        return cls(functions, tuple(function.design(inputs) for function in functions))

    def matrices(self, weights: tuple[Tensor, ...]) -> Tensor:
        """K, D, M, `(groups, n, 3, axes, axes)`."""
        parts = zip(self.functions, self.designs, weights, strict=True)
        logarithms = [function.logarithm(design, own) for function, design, own in parts]
        return self.functions[0].exponential(torch.stack(logarithms, dim=2))


def beside_impedance(model: ForceModel) -> list[Entry]:
    """Learned hyperparameters of desired trajectory, residual force and noise."""
    return [
        entry for entry in model.entries if bool(entry.free.any()) and not entry.name.startswith(OF_IMPEDANCE)
    ]


def pack(entries: Sequence[Entry]) -> Array:
    """Unconstrained values of hyperparameters, one after another."""
    return np.concatenate([np.zeros(0), *(entry.raw.detach().reshape(-1).numpy() for entry in entries)])


def unpack(entries: Sequence[Entry], point: Array) -> None:
    """Write what `pack` gave back into the hyperparameters."""
    start = 0
    with torch.no_grad():
        for entry in entries:
            stop = start + entry.raw.numel()
            entry.raw.copy_(torch.from_numpy(point[start:stop]).reshape(entry.raw.shape))
            start = stop


def log_jacobian(loop: Loop, impedance: Tensor, valid: Tensor | None, coupled: bool) -> Tensor:
    """Σ_n log det ∂(u − Σ_j W_j e^{(j)})/∂u of a closed loop, `(axes, groups)` or `(1, groups)` [nats].

    On a device that answers force, M_r ẍ + D_r ẋ = u + p, the matrix is I + Z M_r⁻¹ with the apparent mass
    Z = M (I − ½ Δ D_r M_r⁻¹) + ½ Δ D, Δ the time between samples (docs/model.md §6). Axes that do not couple have the
    diagonal of it.
    """
    _, damping, mass = impedance.unbind(2)
    step = loop.step[:, None, None, None]
    device_mass, device_damping = loop.device_mass[:, 0], loop.device_damping[:, 0]
    # Columns belong to the axis that moves.
    apparent = mass * (1.0 - 0.5 * step * device_damping / device_mass) + 0.5 * step * damping
    axes = impedance.shape[-1]
    answer = torch.eye(axes, dtype=impedance.dtype) + apparent / device_mass
    if coupled:
        terms = torch.linalg.slogdet(answer).logabsdet.unsqueeze(0)
    else:
        terms = answer.diagonal(dim1=-2, dim2=-1).abs().log().movedim(-1, 0)
    return (terms if valid is None else terms * valid).sum(-1)


class Density(TiltedDensity):
    """Log density of weights and hyperparameters as functions of one vector.

    First the weights of each function, `(groups, entries, width)`, then the unconstrained values of the free
    hyperparameters of desired trajectory, residual force and noise.
    """

    def __init__(
        self,
        model: ForceModel,
        functions: tuple[ImpedanceFunction, ...],
        engine: ConditionalEngine,
        features: Features,
        coupled: bool,
        periodic: bool,
    ) -> None:
        self.model, self.functions, self.engine, self.features = model, functions, engine, features
        self.coupled, self.periodic = coupled, periodic
        self.entries = beside_impedance(model)
        groups = features.inputs.shape[1]
        self.shapes = [(groups, len(f.places), f.width) for f in functions]
        weight_count = sum(int(np.prod(shape)) for shape in self.shapes)
        # All but components that the configuration fixes.
        moves = [entry.free.repeat(entry.raw.shape[0]).numpy() for entry in self.entries]
        super().__init__(weight_count, np.concatenate([np.ones(weight_count, dtype=bool), *moves]))
        self.renew()

    def renew(self) -> None:
        """Take up changed hyperparameters of the functions' priors."""
        with torch.no_grad():
            self.designs = Designs.at(self.functions, self.features.inputs)

    def start(self) -> Array:
        """Weights at their prior mean, hyperparameters where the model stands."""
        return np.concatenate([np.zeros(self.weight_count), pack(self.entries)])

    def weights(self, point: Tensor) -> tuple[Tensor, ...]:
        """Weights of each function, `(groups, entries, width)`."""
        sizes = [int(np.prod(shape)) for shape in self.shapes]
        parts = point[: self.weight_count].split(sizes)
        return tuple(part.reshape(shape) for part, shape in zip(parts, self.shapes, strict=True))

    def set_hyperparameters(self, point: Array) -> None:
        """Write those of `point` into the model."""
        unpack(self.entries, point[self.weight_count :])

    @property
    def processes(self) -> Processes:
        """Desired trajectory, residual force and noise at the model's hyperparameters."""
        return Processes.of(self.model, self.periodic)

    def likelihood(self, impedance: Tensor) -> Tensor:
        """log p(u | W) with the Jacobian of the closed loop, `(axes, groups)` or `(1, groups)` [nats]."""
        value = self.engine.log_likelihood_given_impedance(self.processes, impedance)
        loop = self.features.loop
        if loop is None:
            return value
        return value + log_jacobian(loop, impedance, self.features.valid, self.coupled)

    def joint(self, point: Array) -> tuple[float, Array]:
        """Log density of forces, weights and hyperparameters, without constants of the priors, and its gradient.

        Raises:
            NotPositiveDefiniteError: it is not finite there.
        """
        self.set_hyperparameters(point)
        for entry in self.entries:
            entry.raw.grad = None
        free = torch.from_numpy(point[: self.weight_count]).requires_grad_()
        value = self.likelihood(self.designs.matrices(self.weights(free))).sum()
        value = value - 0.5 * free.square().sum() + self.log_hyperpriors()
        value.backward()
        parts = [free, *(entry.raw for entry in self.entries)]
        gradient = np.concatenate(
            [np.zeros(p.numel()) if p.grad is None else p.grad.reshape(-1).numpy() for p in parts]
        )
        if not (np.isfinite(gradient).all() and bool(value.isfinite())):
            raise NotPositiveDefiniteError(
                "expected a finite likelihood of the forces given impedance, found one that overflows, or its gradient "
                "does; check log.units, and that the medians under model are of the size that their unit lets expect"
            )
        return float(value.detach()), gradient

    def log_hyperpriors(self) -> Tensor:
        """Log density of the hyperparameters beside impedance, without constants [nats]."""
        total = torch.zeros((), dtype=torch.float64)
        for entry in self.entries:
            total = total + log_hyperprior(entry)
        return total


def log_hyperprior(entry: Entry) -> Tensor:
    """Log density of the logarithms of a hyperparameter's free components over all axes, without constants [nats]."""
    deviation = (entry.value.log() - entry.medians.log()) / entry.log_sds
    return -0.5 * (deviation.square() * entry.free).sum()
