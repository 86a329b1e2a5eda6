"""Force at one sample, given forces: everything that does not depend on the sample is computed beforehand.

Calls of torch on vectors of a few hundred entries cost more than the arithmetic. Here the covariances between one
sample and all training samples are compiled (`engines.compiled`).
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg.blas import dtrsv

from bayes_impedance.device import Loop
from bayes_impedance.engines.closed_loop import LoopEvidence
from bayes_impedance.engines.compiled.covariance import covariances, impedance_covariances, variances
from bayes_impedance.engines.compiled.numbers import KernelNumbers
from bayes_impedance.engines.dense import Factor, Observations
from bayes_impedance.kernels.impedance import InteractionKernel, Latent
from bayes_impedance.kernels.motion_noise import MotionNoiseKernel, shared_noise

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
        inputs = observations.inputs.numpy()
        self._numbers = KernelNumbers.of(kernel, inputs.shape[1])
        # A row for each column of the input, so that a sample meets all others along one.
        self._inputs = np.ascontiguousarray(inputs.T)
        factor = Factor(kernel, observations, jitter)
        self._alpha = factor.alpha.numpy()
        self._cholesky = np.asfortranarray(factor.cholesky.numpy())
        self._noise = float(observations.noise_variance.detach())
        noise = kernel.motion_noise
        self._motion_noise = None if noise is None else _MotionNoise(noise, self._numbers, self._inputs)
        self._loop: LoopEvidence | None = None
        if loop is not None:
            self._loop = LoopEvidence(kernel.impedance, factor, observations, loop)
            self._loop_white = self._loop.white[:, 0].numpy()
            self._loop_slope = float(self._loop.jacobian.slope)
            self._loop_gain = float(self._loop.gain(self._loop.variance))
        # The first call compiles; a control loop is not to wait for that.
        self.predict(inputs[0])

    def predict(self, x: Array) -> tuple[float, float]:
        """E and Var of a new measurement of force [N, N²] at the inputs `x` `(D,)`, levels taken as known."""
        cross, own = np.empty((1, self._alpha.size)), np.empty(3)
        covariances(self._numbers, 0, self._inputs, x, cross)
        variances(self._numbers, 0, x, own)
        row, prior = cross[0], own[0]
        if self._motion_noise is not None:
            near, noise = self._motion_noise.row(x)
            row[near] += noise
            prior += self._motion_noise.variance(x)
        # On one thread, unlike a product with the inverse: waking another can cost milliseconds.
        white = dtrsv(self._cholesky, row, lower=1)
        mean = self._numbers.prior_mean(x[None])[0] + row @ self._alpha
        variance = prior - float(white @ white)
        if self._loop is not None:
            with torch.no_grad():
                prior_with_loop = self._loop.apparent.covariance(
                    torch.from_numpy(x).unsqueeze(0), Latent.FORCE
                )
            with_loop = float(prior_with_loop) - float(white @ self._loop_white)
            mean += self._loop_slope * with_loop
            variance -= self._loop_gain * with_loop**2
        return float(mean), max(float(variance), 0.0) + self._noise


class _MotionNoise:
    """What noise of the recorded motion adds to the covariance, between one sample and the training samples."""

    def __init__(self, kernel: MotionNoiseKernel, numbers: KernelNumbers, inputs: Array) -> None:
        self.columns = list(kernel.columns)
        self.weights = kernel.weights
        self.variance_of_noise = float(kernel.sd.detach() ** 2)
        self.numbers, self.inputs = numbers, inputs
        self.products = np.outer(numbers.expectation[0], numbers.expectation[0])
        self.trial, first, place = inputs[self.columns[:3]]
        self.first, self.place = first.astype(np.int64), place.astype(np.int64)

    def row(self, x: Array) -> tuple[NDArray[np.int64], Array]:
        """Training samples whose windows share samples with that of `x`, and N at them [N²]."""
        trial, first, place, weights = self._window(x)
        lag = self.first - first
        near = np.flatnonzero((self.trial == trial) & (np.abs(lag) < weights.shape[-1]))
        if not near.size:
            return near, np.zeros(0)
        noise = shared_noise(weights, place, self.place[near], lag[near])
        inputs = np.ascontiguousarray(self.inputs[:, near])
        moments = np.empty((self.products.shape[0], near.size))
        for order, own in enumerate(moments):
            impedance_covariances(self.numbers, 0, order, inputs, x, own)
        return near, self._sum(noise, moments)

    def variance(self, x: Array) -> float:
        """N of the sample itself [N²]."""
        _, _, place, weights = self._window(x)
        own = weights[:, place] @ weights[:, place].T
        return float(self._sum(own[None], self.numbers.variances[0])[0])

    def _window(self, x: Array) -> tuple[float, int, int, Array]:
        trial, first, place, length, order, step, from_positions = x[self.columns].tolist()
        weights = self.weights(int(length), int(order), step)
        return trial, int(first), int(place), weights[: int(from_positions)]

    def _sum(self, noise: Array, moments: Array) -> Array:
        """Σ_ij (E_i E_j' + C_ij) S_ij over the orders that carry noise."""
        orders = noise.shape[-1]
        total = (noise * self.products[:orders, :orders]).sum((1, 2))
        for order, own in enumerate(moments[:orders]):
            total = total + own * noise[:, order, order]
        return self.variance_of_noise * total
