"""What is sampled: sites of the Pyro model, each a block of one vector of standard normal coordinates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bayes_impedance.impedance_functions.density import OF_IMPEDANCE, beside_impedance
from bayes_impedance.impedance_functions.function import ImpedanceFunction
from bayes_impedance.priors import Entry, ForceModel

#: Names of K, D and M.
QUANTITIES = ("stiffness", "damping", "mass")


@dataclass(frozen=True)
class Parameter:
    """A site: whitened weights of an impedance function, or the learned components of a hyperparameter.

    Weights b ~ N(0, I) `(groups, entries, width)` have neither `median` nor `log_sd`. A hyperparameter `(axes,
    components)`, or `(1, components)` where axes share it, is median · exp(log_sd · z), z ~ N(0, I); `labels` of its
    components, `units` of each.
    """  # fmt: skip

    name: str
    shape: tuple[int, ...]
    labels: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    median: Tensor | None = None
    log_sd: Tensor | None = None

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return int(torch.Size(self.shape).numel())

    def value(self, standard: Tensor) -> Tensor:
        """What coordinates `(..., size)` stand for, `(..., *shape)` [its units]."""
        z = standard.reshape(*standard.shape[:-1], *self.shape)
        if self.median is None or self.log_sd is None:
            return z
        return self.median * torch.exp(self.log_sd * z)

    def standard(self, value: Tensor) -> Tensor:
        """The inverse of `value`, `(..., size)`."""
        z = (
            value
            if self.median is None or self.log_sd is None
            else (value.log() - self.median.log()) / self.log_sd
        )
        return z.reshape(*value.shape[: value.ndim - len(self.shape)], self.size)


def weights_of(functions: Sequence[ImpedanceFunction], groups: int) -> list[Parameter]:
    """Weights of K, D and M."""
    return [
        Parameter(f"{name}_weights", (groups, len(function.places), function.width))
        for name, function in zip(QUANTITIES, functions, strict=True)
    ]


def hyperparameters_of(model: ForceModel, functions: Sequence[ImpedanceFunction]) -> list[Entry]:
    """Learned hyperparameters that the likelihood given impedance depends on.

    Those of desired trajectory, residual force and noise, then log-SD and length scales of functions that vary.
    """
    varying = {
        f"{name}.{scale}"
        for name, function in zip(QUANTITIES, functions, strict=True)
        for scale in ("log_sd", "length_scale")
        if function.inducing is not None
    }
    learned = [entry for entry in model.entries if entry.name in varying and bool(entry.free.any())]
    return beside_impedance(model) + learned


def parameter_of(entry: Entry, tied: bool) -> Parameter:
    """The site of the learned components of a hyperparameter; with `tied` axes share it."""
    free = entry.free
    axes = 1 if tied and entry.name.startswith(OF_IMPEDANCE) else entry.raw.shape[0]
    chosen = [c for c, is_free in enumerate(free.tolist()) if is_free]
    return Parameter(
        name=entry.name.replace(".", "_"),
        shape=(axes, len(chosen)),
        labels=tuple(entry.labels[c] for c in chosen),
        units=tuple(entry.units[c] for c in chosen),
        median=entry.medians[free],
        log_sd=entry.log_sds[free],
    )


def filled(entry: Entry, values: Mapping[str, Tensor]) -> Tensor:
    """A hyperparameter with its fixed components, `(axes, 1, 1, components)`, from values of sites."""
    axes, components = entry.raw.shape[0], len(entry.specs)
    whole = values.get(entry.name.replace(".", "_"), entry.medians)
    if whole.shape[-1] < components:
        learned = whole.expand(axes, whole.shape[-1])
        whole = entry.medians.expand(axes, components).index_copy(1, entry.free.nonzero()[:, 0], learned)
    return whole.expand(axes, components).reshape(axes, 1, 1, components)
