"""Force at one sample, given forces: everything that does not depend on the sample is computed beforehand.

Calls of torch on vectors of a few hundred entries cost more than the arithmetic. Here the sums of
`kernels` run on NumPy vectors: the bilinear forms of DESIGN §4 between one sample and all training samples
are one small matrix times a matrix kept from training.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gpytorch.kernels import AdditiveKernel, Kernel
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from torch import Tensor

from bayes_impedance.engines.dense import Factor, Observations
from bayes_impedance.kernels.derivative import Forms, combine
from bayes_impedance.kernels.impedance import InteractionKernel, force_covariance
from bayes_impedance.kernels.stationary import StationaryKernel
from bayes_impedance.kernels.warped import ImpedanceProcess

Array = NDArray[np.float64]


class PointPredictor:
    """Mean and variance of the force at one sample, for one axis and group.

    Args:
        kernel: without batch dimensions; its covariances must be `StationaryKernel`s or sums of them.
        observations: inputs `(n, D)`, residual `(n,)` [N], noise variance `(1,)` [N²].
        jitter: as in `engines.dense`.

    Raises:
        TypeError: a covariance of another kind.
        NotPositiveDefiniteError: no Cholesky factor at this jitter.
    """

    def __init__(self, kernel: InteractionKernel, observations: Observations, jitter: float = 0.0) -> None:
        factor = Factor(kernel, observations, jitter)
        inputs = observations.inputs.numpy()
        self._alpha = factor.alpha.numpy()
        n = len(self._alpha)
        self._inverse = solve_triangular(factor.cholesky.numpy(), np.eye(n), lower=True)
        self._noise = float(observations.noise_variance.detach())
        impedance = kernel.impedance
        self._layout = impedance.layout
        self._trajectory = _Trajectory(kernel, inputs)
        width = inputs.shape[1]
        impedance_parts = [_Stationary(process.covariance, width) for process in impedance.processes]
        residual_parts = [_Stationary(part, width) for part in _parts(kernel.residual)]
        self._rows = _Rows([*impedance_parts, *residual_parts], inputs)
        self._processes = [
            _Process(process, part.variance)
            for process, part in zip(impedance.processes, impedance_parts, strict=True)
        ]
        self._expectations = [process.expectation for process in self._processes]
        self._variances = {(j, j): process.variance for j, process in enumerate(self._processes)}
        self._residual_variance = sum(part.variance for part in residual_parts)
        self._labels = None if self._layout.residual is None else inputs[:, self._layout.residual]
        self._errors = [inputs[:, c] for c in self._layout.error] or None

    def predict(self, x: Array) -> tuple[float, float]:
        """E and Var of a new measurement of force [N, N²] at the inputs `x` `(D,)`, levels taken as known."""
        common, table = self._trajectory.table(x)
        rows = self._rows(x)
        count = len(self._processes)
        covariance = {(j, j): process.covariance(rows[j]) for j, process in enumerate(self._processes)}
        errors = [float(x[c]) for c in self._layout.error] or None
        weights = self._expectations
        cross = force_covariance(weights, weights, covariance, table, common, errors, self._errors)
        for row in rows[count:]:
            cross = cross + (
                row if self._labels is None else row * (self._labels == x[self._layout.residual])
            )
        own, own_table = self._trajectory.own(x)
        prior = self._residual_variance
        prior += force_covariance(weights, weights, self._variances, own_table, own, errors, errors)
        white = self._inverse @ cross
        mean = cross @ self._alpha
        if errors is not None:
            mean += sum(e * w for e, w in zip(errors, weights, strict=True))
        return float(mean), float(max(prior - white @ white, 0.0) + self._noise)


class _Trajectory:
    """Derivatives of k_xd between one sample and the training samples."""

    def __init__(self, kernel: InteractionKernel, inputs: Array) -> None:
        trajectory, self.layout = kernel.impedance.trajectory, kernel.impedance.layout
        _check(trajectory)
        self.profile, self.order = trajectory.profile, kernel.impedance.order
        self.precision = _scalar_row(trajectory.precision, len(self.layout.theta))
        self.variance = float(trajectory.sd.detach() ** 2)
        self.shape = None if trajectory.shape is None else trajectory.shape.detach().reshape(())
        self.labels = None if self.layout.trajectory is None else inputs[:, self.layout.trajectory]
        layout = self.layout
        self.has_acceleration = bool(layout.theta_acceleration)
        self.columns = [_columns(c) for c in (layout.theta, layout.theta_velocity, layout.theta_acceleration)]
        self.centre = inputs[:, self.columns[0]].mean(axis=0)
        self.theta, a, b = self._path(inputs)
        weighted = self.theta * self.precision
        p = len(self.precision)
        self.slices = {name: slice(k * p, (k + 1) * p) for k, name in enumerate(("theta", "a", "b"))}
        speed = (a * self.precision * a).sum(1)
        half = 0.5 * (self.theta * weighted).sum(1)
        turned = [(a * weighted).sum(1), (b * weighted).sum(1)]
        columns = [self.theta, a, b, *turned, speed, np.ones(len(inputs)), half]
        self.kept = np.column_stack(columns).T.copy()
        self.last = 3 * p
        self.coefficients = np.zeros((9, len(self.kept)))

    def table(self, x: Array) -> tuple[Array, list[list[Any]]]:
        theta, a, b = self._path(x)
        pt, pa, pb = self.precision * theta, self.precision * a, self.precision * b
        c, s, end = self.coefficients, self.slices, self.last
        # Rows: s10, s01, s11, s20, s02, s21, s12, s22, s; columns: θ', a', b', a'ᵀPθ', b'ᵀPθ', A', 1, ½θ'ᵀPθ'.
        c[0, s["theta"]], c[0, end + 3] = -pa, a @ pt
        c[1, s["a"]], c[1, end] = -pt, 1.0
        c[2, s["a"]] = -pa
        c[3, s["theta"]], c[3, end + 3] = -pb, a @ pa + b @ pt
        c[4, s["b"]], c[4, end + 1], c[4, end + 2] = -pt, 1.0, 1.0
        c[5, s["a"]], c[6, s["b"]], c[7, s["b"]] = -pb, -pa, -pb
        c[8, s["theta"]], c[8, end + 3], c[8, end + 4] = -pt, 0.5 * (theta @ pt), 1.0
        s10, s01, s11, s20, s02, s21, s12, s22, half = c @ self.kept
        if self.profile.exact_distance:
            half = 0.5 * (theta - self.theta) ** 2 @ self.precision
        third = (s21, s12, s22) if self.has_acceleration else (None, None, None)
        common, table = self._combine(Forms(half, s10, s01, s11, s20, s02, *third))
        if self.labels is not None:
            common = common * (self.labels == x[self.layout.trajectory])
        return common, table

    def own(self, x: Array) -> tuple[Any, list[list[Any]]]:
        """The same at the sample itself."""
        _, a, b = self._path(x)
        weighted = self.precision * b
        aa, ab, bb = float(a @ (self.precision * a)), float(a @ weighted), float(b @ weighted)
        third = (-ab, -ab, -bb) if self.has_acceleration else (None, None, None)
        forms = Forms(0.0, 0.0, 0.0, -aa, aa, aa, *third)
        if self.profile.is_exponential:
            return self.variance, combine(self.profile, forms, (), self.order)
        return self._combine(forms)

    def _combine(self, forms: Forms) -> tuple[Any, list[list[Any]]]:
        if self.profile.is_exponential:
            return self.variance * np.exp(-forms.s), combine(self.profile, forms, (), self.order)
        common, ratios = self.profile.derivatives(torch.as_tensor(forms.s, dtype=torch.float64), self.shape)
        plain = tuple(ratio.numpy() if isinstance(ratio, Tensor) else ratio for ratio in ratios)
        return self.variance * common.numpy(), combine(self.profile, forms, plain, self.order)

    def _path(self, x: Array) -> tuple[Array, Array, Array]:
        velocity = x[..., self.columns[1]]
        acceleration = x[..., self.columns[2]] if self.has_acceleration else np.zeros_like(velocity)
        return x[..., self.columns[0]] - self.centre, velocity, acceleration


class _Stationary:
    """Hyperparameters of a covariance over ξ."""

    def __init__(self, kernel: Kernel, width: int) -> None:
        _check(kernel)
        self.profile = kernel.profile
        self.variance = float(kernel.sd.detach() ** 2)
        self.shape = None if kernel.shape is None else kernel.shape.detach().reshape(())
        every = tuple(range(width)) if kernel.active_dims is None else tuple(kernel.active_dims.tolist())
        self.dims = every if kernel.num_dims else ()
        self.half_precision = (
            0.5 * _scalar_row(kernel.precision, len(self.dims)) if self.dims else np.zeros(0)
        )

    def from_distance(self, s: Array) -> Array:
        if self.profile.is_exponential:
            return self.variance * np.exp(-s)
        return self.variance * self.profile.value(torch.from_numpy(s), self.shape).numpy()


class _Rows:
    """All covariances over ξ between one sample and the training samples; those with equal ξ share r²."""

    def __init__(self, parts: Sequence[_Stationary], inputs: Array) -> None:
        self.parts = parts
        self.groups = []
        for dims in dict.fromkeys(part.dims for part in parts if part.dims):
            members = [k for k, part in enumerate(parts) if part.dims == dims]
            index = _columns(dims)
            weights = np.stack([parts[k].half_precision for k in members])
            self.groups.append((members, index, inputs[:, index].T.copy(), weights))

    def __call__(self, x: Array) -> list[Any]:
        rows: list[Any] = [part.variance for part in self.parts]
        for members, index, inputs, weights in self.groups:
            r = inputs - x[index, None]
            distances = weights @ (r * r)
            for k, s in zip(members, distances, strict=True):
                rows[k] = self.parts[k].from_distance(s)
        return rows


class _Process:
    """Moments of k, d or m; stationary, so that the expectation is one number."""

    def __init__(self, process: ImpedanceProcess, variance: float) -> None:
        self.gaussian = process.law == "gaussian"
        level = float(process.level.detach())
        self.expectation = level if self.gaussian else level * math.exp(0.5 * variance)
        self.variance = variance if self.gaussian else self.expectation**2 * math.expm1(variance)

    def covariance(self, k: Any) -> Any:
        """Cov[w, w'] from k_w."""
        return k if self.gaussian else self.expectation**2 * np.expm1(k)


def _columns(columns: Sequence[int]) -> Any:
    """An index for `columns`: a slice where they follow each other, which NumPy takes without copying."""
    first, count = (columns[0], len(columns)) if columns else (0, 0)
    if list(columns) == list(range(first, first + count)):
        return slice(first, first + count)
    return np.array(columns)


def _parts(kernel: Kernel | None) -> list[Kernel]:
    if kernel is None:
        return []
    return list(kernel.kernels) if isinstance(kernel, AdditiveKernel) else [kernel]


def _check(kernel: Kernel) -> None:
    if not isinstance(kernel, StationaryKernel):
        raise TypeError(
            f"one-point prediction: expected covariances of class StationaryKernel, got {type(kernel).__name__}; "
            "use the dense posterior for it"
        )


def _scalar_row(precision: Tensor, size: int) -> Array:
    return np.broadcast_to(precision.detach().numpy().reshape(-1), (size,)).copy()
