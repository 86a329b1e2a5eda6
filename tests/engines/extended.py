"""Forces of one axis given impedance, in extended precision: by covariances, and by the filter of the textbook."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Extended = NDArray[np.longdouble]

STATIONARY = np.array(
    [[1, 0, -1 / np.longdouble(3)], [0, 1 / np.longdouble(3), 0], [-1 / np.longdouble(3), 0, 1]]
)


@dataclass(frozen=True)
class Chain:
    """Samples in the order of θ: `place` λθ, `rows`, what the force is of (f, f'/λ, f''/λ²)/σ, force and noise."""

    place: Extended
    rows: Extended
    force: Extended
    noise: np.longdouble

    @classmethod
    def of(cls, problem, sd=None, lengthscale=None, noise=None):
        """A `ScalarProblem` of one axis without residual, from its figures as they are in double precision."""
        processes = problem.processes
        kernel = processes.trajectory
        sd = np.longdouble(kernel.sd.item() if sd is None else sd)
        rate = np.sqrt(np.longdouble(5)) / np.longdouble(
            kernel.lengthscale.item() if lengthscale is None else lengthscale
        )
        x = problem.features.inputs[0, 0].numpy().astype(np.longdouble)
        order = np.argsort(x[:, 0], kind="stable")
        theta, velocity, acceleration = x[order].T
        k, d, m = problem.impedance.detach()[0, :, :, 0, 0].numpy().astype(np.longdouble)[order].T
        columns = [k, d * velocity + m * acceleration, m * velocity**2]
        rows = np.stack([column * sd * rate**j for j, column in enumerate(columns)], axis=-1)
        force = problem.features.force[0, 0].numpy().astype(np.longdouble)[order]
        variance = np.longdouble(processes.noise_variance.item() if noise is None else noise)
        return cls(rate * theta, rows, force, variance)


def transition(z: Extended) -> Extended:
    """e^{Az} of the companion matrix A of (s + 1)³: (A + 1)³ = 0, so that its series has three terms, `(..., 3, 3)`."""
    nilpotent = np.array([[1, 1, 0], [0, 1, 1], [-1, -3, -2]], dtype=np.longdouble)
    z = np.asarray(z)[..., None, None]
    return np.exp(-z) * (np.eye(3) + z * nilpotent + z**2 / 2 * (nilpotent @ nilpotent))


def filtered(chain: Chain) -> np.longdouble:
    """log p by prediction P⁻ = P∞ + F (P − P∞) Fᵀ and update, a sample after another."""
    steps = transition(np.diff(chain.place, prepend=chain.place[0]))
    mean, covariance = np.zeros(3, dtype=np.longdouble), STATIONARY
    total = np.longdouble(0)
    for step, row, force in zip(steps, chain.rows, chain.force, strict=True):
        mean = step @ mean
        covariance = STATIONARY + step @ (covariance - STATIONARY) @ step.T
        gain = covariance @ row
        variance = row @ gain + chain.noise
        innovation = force - row @ mean
        total -= (np.log(2 * np.longdouble(np.pi) * variance) + innovation**2 / variance) / 2
        mean = mean + gain * (innovation / variance)
        covariance = covariance - np.outer(gain, gain) / variance
    return total


def solved(chain: Chain, targets: Extended) -> tuple[np.longdouble, Extended, Extended]:
    """log p, and mean `(m, 3)` and covariance `(m, 3, 3)` of the state at λθ = `targets`, by the covariance of all."""
    covariance = np.einsum("ni,nmij,mj->nm", chain.rows, _covariance(chain.place, chain.place), chain.rows)
    factor = _cholesky(covariance + chain.noise * np.eye(len(covariance)))
    white = _forward(factor, chain.force[:, None])[:, 0]
    total = (
        -(white @ white + 2 * np.log(np.diag(factor)).sum() + len(white) * np.log(2 * np.longdouble(np.pi)))
        / 2
    )
    cross = np.einsum("ni,nmij->nmj", chain.rows, _covariance(chain.place, targets))
    known = _forward(factor, cross.reshape(len(white), -1)).reshape(cross.shape)
    mean = np.einsum("nmj,n->mj", known, white)
    return total, mean, STATIONARY - np.einsum("nmi,nmj->mij", known, known)


def _covariance(first: Extended, second: Extended) -> Extended:
    """Cov of states at λθ: F(z) P∞ forwards, its transpose backwards, `(n, m, 3, 3)`."""
    lag = first[:, None] - second[None, :]
    forward = transition(np.abs(lag)) @ STATIONARY
    return np.where((lag >= 0)[..., None, None], forward, forward.swapaxes(-1, -2))


def _cholesky(matrix: Extended) -> Extended:
    rest, factor = matrix.copy(), np.zeros_like(matrix)
    for j in range(len(matrix)):
        factor[j:, j] = rest[j:, j] / np.sqrt(rest[j, j])
        rest[j:, j:] -= np.outer(factor[j:, j], factor[j:, j])
    return factor


def _forward(factor: Extended, right: Extended) -> Extended:
    result = right.astype(np.longdouble)
    for j in range(len(factor)):
        result[j] /= factor[j, j]
        result[j + 1 :] -= np.outer(factor[j + 1 :, j], result[j])
    return result
