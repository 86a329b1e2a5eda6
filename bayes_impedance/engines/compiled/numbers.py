"""An interaction covariance as plain arrays, for loops that numba compiles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from gpytorch.kernels import AdditiveKernel, Kernel
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.kernels.impedance import InteractionKernel
from bayes_impedance.kernels.stationary import (
    Matern,
    Profile,
    RationalQuadratic,
    SquaredExponential,
    StationaryKernel,
)
from bayes_impedance.kernels.warped import ImpedanceProcess

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Profiles as compiled loops tell them apart; a Matérn profile is its degree, ν − ½.
SQUARED_EXPONENTIAL, RATIONAL_QUADRATIC = -1, -2
#: Where there is no column.
NONE = -1


class KernelNumbers(NamedTuple):
    """Hyperparameters and columns of an `InteractionKernel`, one row an axis.

    Columns: `theta`, `velocity` `(p,)`, `acceleration` `(p,)` or `(0,)`, `error` `(3,)` or `(0,)`, and `labels`
    `(2,)` of x_d and ũ, or `NONE`. Of k_xd: `profile` (see above), `precision` `(axes, p)`, `variance` `(axes,)` [m²],
    `shape` `(axes,)`. `expectation` E[w_j] `(axes, orders)`, `gaussian` `(orders,)`. `part_…`: the covariances over ξ,
    first those of the orders, then those of ũ: profile `(parts,)`, columns `(parts, widest)`, padded with `NONE`,
    ½ P `(axes, parts, widest)`, variance and shape `(axes, parts)`.
    """

    theta: Integers
    velocity: Integers
    acceleration: Integers
    error: Integers
    labels: Integers
    profile: int
    precision: Floats
    variance: Floats
    shape: Floats
    expectation: Floats
    gaussian: NDArray[np.bool_]
    part_profile: Integers
    part_columns: Integers
    part_precision: Floats
    part_variance: Floats
    part_shape: Floats

    @property
    def variances(self) -> Floats:
        """Prior variances of stiffness, damping and mass, `(axes, orders)`: stationary as they are."""
        own = self.part_variance[:, : self.gaussian.size]
        return np.where(self.gaussian, own, self.expectation**2 * np.expm1(own))

    def prior_mean(self, inputs: Floats) -> Floats:
        """E[u] = Σ_j E[w_j] ē_j at a sample, inputs `(axes, D)`, `(axes,)` [N]."""
        if not self.error.size:
            return np.zeros(inputs.shape[0])
        return np.einsum("aj,aj->a", self.expectation, inputs[:, self.error[: self.gaussian.size]])

    @classmethod
    def of(cls, kernel: InteractionKernel, width: int) -> KernelNumbers:
        """Those of a kernel of batch shape `(axes, 1)`, or of one axis without, whose inputs have `width` columns.

        Noise of the recorded motion is not among them.

        Raises:
            TypeError: a covariance of a class whose numbers are not known.
        """
        impedance, layout = kernel.impedance, kernel.impedance.layout
        axes = kernel.batch_shape[0] if kernel.batch_shape else 1
        processes = impedance.processes
        parts = [process.covariance for process in processes] + _summands(kernel.residual)
        for part in (impedance.trajectory, *parts):
            if not isinstance(part, StationaryKernel):
                raise TypeError(
                    "compiled covariance: expected covariances of class StationaryKernel, got "
                    f"{type(part).__name__}; use the dense posterior for it"
                )
        columns = [_columns_of(part, width) for part in parts]
        widest = max([1, *map(len, columns)])
        padded = np.full((len(parts), widest), NONE)
        precision = np.zeros((axes, len(parts), widest))
        for i, (part, own) in enumerate(zip(parts, columns, strict=True)):
            padded[i, : len(own)] = own
            if own:
                precision[:, i, : len(own)] = 0.5 * _by_axis(part.precision, axes, len(own))
        with torch.no_grad():
            return cls(
                theta=np.array(layout.theta),
                velocity=np.array(layout.theta_velocity),
                acceleration=np.array(layout.theta_acceleration, dtype=np.int64),
                error=np.array(layout.error, dtype=np.int64),
                labels=np.array([NONE if c is None else c for c in (layout.trajectory, layout.residual)]),
                profile=_code(impedance.trajectory.profile),
                precision=_by_axis(impedance.trajectory.precision, axes, len(layout.theta)),
                variance=_scalar(impedance.trajectory.sd, axes) ** 2,
                shape=_shape(impedance.trajectory, axes),
                expectation=np.stack([_expectation(process, axes) for process in processes], axis=1),
                gaussian=np.array([process.law == "gaussian" for process in processes]),
                part_profile=np.array([_code(part.profile) for part in parts]),
                part_columns=padded,
                part_precision=precision,
                part_variance=np.stack([_scalar(part.sd, axes) ** 2 for part in parts], axis=1),
                part_shape=np.stack([_shape(part, axes) for part in parts], axis=1),
            )


def _summands(kernel: Kernel | None) -> list[Any]:
    if kernel is None:
        return []
    return list(kernel.kernels) if isinstance(kernel, AdditiveKernel) else [kernel]


def _columns_of(kernel: StationaryKernel, width: int) -> Sequence[int]:
    if not kernel.num_dims:
        return ()
    columns: list[int] = list(range(width)) if kernel.active_dims is None else kernel.active_dims.tolist()
    return columns


def _code(profile: Profile) -> int:
    if isinstance(profile, SquaredExponential):
        return SQUARED_EXPONENTIAL
    if isinstance(profile, RationalQuadratic):
        return RATIONAL_QUADRATIC
    assert isinstance(profile, Matern)
    return profile.degree


def _expectation(process: ImpedanceProcess, axes: int) -> Floats:
    """E[w], the same at every sample: covariances are stationary."""
    level = _scalar(process.level, axes)
    if process.law == "gaussian":
        return level
    return level * np.exp(0.5 * _scalar(process.covariance.sd, axes) ** 2)


def _shape(kernel: StationaryKernel, axes: int) -> Floats:
    return np.ones(axes) if kernel.shape is None else _scalar(kernel.shape, axes)


def _scalar(value: Tensor, axes: int) -> Floats:
    return _by_axis(value, axes, 1)[:, 0]


def _by_axis(value: Tensor, axes: int, size: int) -> Floats:
    """`(axes, 1, 1, size)`, or what broadcasts to it, as `(axes, size)`."""
    return value.detach().expand(axes, 1, 1, size).reshape(axes, size).numpy().copy()
