"""Force at one sample, given forces: everything that does not depend on the sample is computed beforehand.

Calls of torch on vectors of a few hundred entries cost more than the arithmetic. Here the sums of
`kernels` run on NumPy vectors: the bilinear forms of docs/model.md §3 between one sample and all training samples
are one small matrix times a matrix kept from training.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gpytorch.kernels import AdditiveKernel, Kernel
from numpy.typing import NDArray
from scipy.linalg.blas import dtrsv
from torch import Tensor

from bayes_impedance.device import Loop
from bayes_impedance.engines.closed_loop import LoopEvidence
from bayes_impedance.engines.dense import Factor, Observations
from bayes_impedance.kernels.derivative import Forms, Table, combine
from bayes_impedance.kernels.impedance import InteractionKernel, Latent, force_covariance
from bayes_impedance.kernels.motion_noise import MotionNoiseKernel, shared_noise
from bayes_impedance.kernels.stationary import StationaryKernel
from bayes_impedance.kernels.warped import ImpedanceProcess

Array = NDArray[np.float64]


class PointPredictor:
    """Mean and variance of the force at one sample, for one axis and group.

    Args:
        kernel: without batch dimensions; its covariances must be `StationaryKernel`s or sums of them.
        observations: inputs `(n, D)`, residual `(n,)` [N], noise variance `(1,)` [N²].
        jitter: as in `engines.dense`.
        loop: a device that answers force, of scalars; None for none.

    Raises:
        TypeError: a covariance of another kind.
        NotPositiveDefiniteError: no Cholesky factor at this jitter.
    """

    def __init__(
        self,
        kernel: InteractionKernel,
        observations: Observations,
        jitter: float = 0.0,
        loop: Loop | None = None,
    ) -> None:
        factor = Factor(kernel, observations, jitter)
        inputs = observations.inputs.numpy()
        self._alpha = factor.alpha.numpy()
        self._cholesky = np.asfortranarray(factor.cholesky.numpy())
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
        noise = kernel.motion_noise
        self._motion_noise = None if noise is None else _MotionNoise(noise, self._expectations, inputs)
        self._loop: LoopEvidence | None = None
        if loop is not None:
            self._loop = LoopEvidence(impedance, factor, observations, loop)
            self._loop_white = self._loop.white[:, 0].numpy()
            self._loop_slope = float(self._loop.jacobian.slope)
            self._loop_gain = float(self._loop.gain(self._loop.variance))

    def predict(self, x: Array) -> tuple[float, float]:
        """E and Var of a new measurement of force [N, N²] at the inputs `x` `(D,)`, levels taken as known."""
        common, table, own, own_table = self._trajectory.table(x)
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
        prior = self._residual_variance
        prior += force_covariance(weights, weights, self._variances, own_table, own, errors, errors)
        if self._motion_noise is not None:
            near, noise = self._motion_noise.row(x, covariance)
            cross[near] += noise
            prior += self._motion_noise.variance(x, self._variances)
        # On one thread, unlike a product with the inverse: waking another can cost milliseconds.
        white = dtrsv(self._cholesky, cross, lower=1)
        mean = cross @ self._alpha
        if errors is not None:
            mean += sum(e * w for e, w in zip(errors, weights, strict=True))
        variance = prior - float(white @ white)
        if self._loop is not None:
            with torch.no_grad():
                prior_with_loop = self._loop.apparent.covariance(
                    torch.from_numpy(x).unsqueeze(0), Latent.FORCE
                )
            with_loop = float(prior_with_loop) - float(white @ self._loop_white)
            mean += self._loop_slope * with_loop
            variance -= self._loop_gain * with_loop**2
        return float(mean), max(variance, 0.0) + self._noise


#: Coefficients of the forms s10, s01, s11, s20, s02, s21, s12, s22, s (rows) on θ', a', b' of the training
#: samples (blocks) are −P times θ, a or b of the sample: (row, block, which).
THETA, VELOCITY, ACCELERATION = 0, 1, 2
COEFFICIENTS = np.array(
    [
        (0, THETA, VELOCITY), (1, VELOCITY, THETA), (2, VELOCITY, VELOCITY), (3, THETA, ACCELERATION),
        (4, ACCELERATION, THETA), (5, VELOCITY, ACCELERATION), (6, ACCELERATION, VELOCITY),
        (7, ACCELERATION, ACCELERATION), (8, THETA, THETA),
    ]
).T  # fmt: skip


class _Trajectory:
    """Derivatives of k_xd between one sample and the training samples."""

    def __init__(self, kernel: InteractionKernel, inputs: Array) -> None:
        trajectory, layout = kernel.impedance.trajectory, kernel.impedance.layout
        _check(trajectory)
        self.profile, self.order = trajectory.profile, kernel.impedance.order
        self.precision = _scalar_row(trajectory.precision, len(layout.theta))
        self.variance = float(trajectory.sd.detach() ** 2)
        self.shape = None if trajectory.shape is None else trajectory.shape.detach().reshape(())
        self.label = layout.trajectory
        self.labels = None if self.label is None else inputs[:, self.label]
        self.has_acceleration = bool(layout.theta_acceleration)
        self.columns = [_columns(c) for c in (layout.theta, layout.theta_velocity, layout.theta_acceleration)]
        self.centre = inputs[:, self.columns[THETA]].mean(axis=0)
        theta, a, b = np.moveaxis(self._path(inputs), -2, 0)
        self.theta = theta
        weighted = theta * self.precision
        # Columns: θ', a', b', then what the forms add without a factor of the sample.
        extra = [(a * weighted).sum(1), (b * weighted).sum(1), (a * self.precision * a).sum(1)]
        extra += [0.5 * (theta * weighted).sum(1), np.ones(len(inputs))]
        self.kept = np.column_stack([theta, a, b, *extra]).T.copy()
        self.constant = np.zeros((9, len(self.kept)))
        for row, column in ((1, -5), (4, -4), (4, -3), (8, -2)):
            self.constant[row, column] = 1.0

    def table(self, x: Array) -> tuple[Any, Table, Any, Table]:
        """Common factor and table against the training samples, then at the sample itself."""
        path = self._path(x)
        minus = -self.precision * path
        gram = (path @ minus.T).tolist()
        c = self.constant.copy()
        rows, blocks, which = COEFFICIENTS
        c[:, : path.size].reshape(9, *path.shape)[rows, blocks] = minus[which]
        c[0, -1] = -gram[VELOCITY][THETA]
        c[3, -1] = -gram[VELOCITY][VELOCITY] - gram[ACCELERATION][THETA]
        c[8, -1] = -0.5 * gram[THETA][THETA]
        s10, s01, s11, s20, s02, s21, s12, s22, s = c @ self.kept
        if self.profile.exact_distance:
            s = 0.5 * (path[THETA] - self.theta) ** 2 @ self.precision
        third = (s21, s12, s22) if self.has_acceleration else (None, None, None)
        common, table = self._combine(Forms(s, s10, s01, s11, s20, s02, *third))
        if self.labels is not None:
            common = common * (self.labels == x[self.label])
        s11, s12, s22 = (
            gram[VELOCITY][VELOCITY],
            gram[VELOCITY][ACCELERATION],
            gram[ACCELERATION][ACCELERATION],
        )
        third = (s12, s12, s22) if self.has_acceleration else (None, None, None)
        return common, table, *self._combine(Forms(0.0, 0.0, 0.0, s11, -s11, -s11, *third))

    def _combine(self, forms: Forms) -> tuple[Any, Table]:
        if self.profile.is_exponential:
            return self.variance * np.exp(-forms.s), combine(self.profile, forms, (), self.order)
        common, ratios = self.profile.derivatives(torch.as_tensor(forms.s, dtype=torch.float64), self.shape)
        plain = tuple(ratio.numpy() if isinstance(ratio, Tensor) else ratio for ratio in ratios)
        return self.variance * common.numpy(), combine(self.profile, forms, plain, self.order)

    def _path(self, x: Array) -> Array:
        """θ (from its centre), θ̇ and θ̈, `(..., 3, p)`."""
        path = np.zeros((*x.shape[:-1], 3, len(self.precision)))
        path[..., THETA, :] = x[..., self.columns[THETA]] - self.centre
        path[..., VELOCITY, :] = x[..., self.columns[VELOCITY]]
        if self.has_acceleration:
            path[..., ACCELERATION, :] = x[..., self.columns[ACCELERATION]]
        return path


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


class _MotionNoise:
    """What noise of the recorded motion adds to the covariance, between one sample and the training samples."""

    def __init__(self, kernel: MotionNoiseKernel, expectations: Sequence[float], inputs: Array) -> None:
        self.columns = list(kernel.columns)
        self.weights = kernel.weights
        self.variance_of_noise = float(kernel.sd.detach() ** 2)
        self.products = np.outer(expectations, expectations)
        self.trial, first, place = inputs[:, self.columns[:3]].T
        self.first, self.place = first.astype(np.int64), place.astype(np.int64)

    def row(self, x: Array, covariance: Mapping[tuple[int, int], Any]) -> tuple[NDArray[np.int64], Array]:
        """Training samples whose windows share samples with that of `x`, and N at them [N²]."""
        trial, first, place, weights = self._window(x)
        lag = self.first - first
        near = np.flatnonzero((self.trial == trial) & (np.abs(lag) < weights.shape[-1]))
        if not near.size:
            return near, np.zeros(0)
        moments = {pair: c[near] if np.ndim(c) else c for pair, c in covariance.items()}
        return near, self._sum(shared_noise(weights, place, self.place[near], lag[near]), moments)

    def variance(self, x: Array, variances: Mapping[tuple[int, int], float]) -> float:
        """N of the sample itself [N²]."""
        _, _, place, weights = self._window(x)
        own = weights[:, place] @ weights[:, place].T
        return float(self._sum(own[None], variances)[0])

    def _window(self, x: Array) -> tuple[float, int, int, Array]:
        trial, first, place, length, order, step, from_positions = x[self.columns].tolist()
        weights = self.weights(int(length), int(order), step)
        return trial, int(first), int(place), weights[: int(from_positions)]

    def _sum(self, noise: Array, covariance: Mapping[tuple[int, int], Any]) -> Array:
        """Σ_ij (E_i E_j' + C_ij) S_ij over the orders that carry noise."""
        orders = noise.shape[-1]
        total = (noise * self.products[:orders, :orders]).sum((1, 2))
        for (i, j), c in covariance.items():
            if max(i, j) < orders:
                total = total + c * noise[:, i, j]
        return self.variance_of_noise * total


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
