"""Hyperparameters from the evidence, in which the functions are integrated out (docs/model.md §13).

A joint mode of functions and noise takes the noise for less than it is, for the functions follow it: each weight that
the data determine uses up one of their samples. The evidence has −½ log det H for that, H the precision of the weights.
Its gradient by the hyperparameters, at a fixed mode, is linear algebra with second differences of the likelihood, and
enters as a tilt of the joint density.

How far and how quickly impedance varies along its input needs no likelihood at all. At the mode the log likelihood is
replaced by its quadratic in the functions' values at the inducing inputs, other hyperparameters marginalised. The
integral over the functions is then closed, for any log-SD s and length scale ℓ. Mode and hyperparameters take turns.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from bayes_impedance.impedance_functions import laplace
from bayes_impedance.impedance_functions.density import OF_IMPEDANCE, Density, log_hyperprior, pack, unpack
from bayes_impedance.impedance_functions.function import ImpedanceFunction
from bayes_impedance.impedance_functions.tilted import TiltedDensity
from bayes_impedance.priors import Entry

Array = NDArray[np.float64]

#: Random directions of the estimate of a trace: with a hundred weights it is good to some per cent, and exact with as
#: many as there are weights.
DIRECTIONS = 16
SEED = 0
#: Their length in posterior SDs: over a whole one the curvature of the likelihood changes.
STEP = 0.1
#: Log-SDs of a hyperprior that one turn may move a hyperparameter, less near an upper bound: the quadratic is local.
LARGEST_MOVE = 1.0


def occam(density: TiltedDensity, mode: Array, precision: Array) -> Array:
    """Gradient of −½ log det H by the hyperparameters of `density`, `(size,)`, zero for the weights.

    ∂ log det H = tr H⁻¹ ∂H = Σ_i s_iᵀ ∂H s_i with s_i = H^{−½} q_i for orthonormal q_i, and sᵀ H s is minus the second
    difference of the log density along s. Of a hundred q_i some random ones stand for all (Hutchinson's estimate).
    """
    count = density.weight_count
    values, vectors = np.linalg.eigh(precision[:count, :count])
    # Symmetric, for signs and order of eigenvectors are arbitrary, and one turn should look where the last one did.
    root = (vectors / np.sqrt(np.maximum(values, 1.0))) @ vectors.T
    chosen = min(DIRECTIONS, count)
    generator = np.random.default_rng(SEED)
    directions = np.linalg.qr(generator.standard_normal((count, chosen)))[0]
    total = np.zeros_like(mode)
    _, centre = density(mode)
    for direction in directions.T:
        step = np.zeros_like(mode)
        step[:count] = STEP * root @ direction
        total += density(mode + step)[1] + density(mode - step)[1] - 2.0 * centre
    total[:count] = 0.0
    return 0.5 * total * count / (chosen * STEP**2)


def variation_entries(density: Density) -> list[Entry]:
    """Free log-SDs and length scales of the functions' variations."""
    return [
        entry
        for entry in density.model.entries
        if entry.name.startswith(OF_IMPEDANCE)
        and entry.name.endswith((".log_sd", ".length_scale"))
        and bool(entry.free.any())
    ]


def log_variation_prior(density: Density) -> Tensor:
    """Log density of `variation_entries`, without constants [nats]."""
    total = torch.zeros((), dtype=torch.float64)
    for entry in variation_entries(density):
        # Of coupled axes each stands for the same one hyperparameter.
        total = total + log_hyperprior(entry) / (len(entry.raw) if density.coupled else 1)
    return total


def update_variation(density: Density, mode: Array, precision: Array) -> tuple[Array, float]:
    """Set log-SDs and length scales to the maximum of the evidence about `mode`; the same functions in new weights.

    Also returns the largest change, in log-SDs of the hyperpriors.
    """
    entries = variation_entries(density)
    if not entries:
        return mode, 0.0
    quadratic = _Quadratic(density, mode, precision)
    start = pack(entries)
    scale = np.concatenate([np.tile(e.log_sds.numpy(), len(e.raw)) for e in entries])
    moves = np.concatenate([np.tile(e.free.numpy(), len(e.raw)) for e in entries])
    width = np.where(moves, LARGEST_MOVE * scale, 0.0)

    def objective(point: Array) -> tuple[float, Array]:
        unpack(entries, point)
        for entry in entries:
            entry.raw.grad = None
        value = quadratic.log_evidence() + log_variation_prior(density)
        value.backward()
        gradient = np.concatenate([_gradient(entry) for entry in entries])
        if density.coupled:
            gradient = _tied(entries, gradient)
        return -float(value.detach()), -gradient

    before = _scaled_logarithms(entries)
    found = minimize(
        objective, start, jac=True, method="L-BFGS-B",
        bounds=list(zip(start - width, start + width, strict=True)),
    )  # fmt: skip
    unpack(entries, found.x)
    moved = quadratic.translated(mode)
    density.renew()
    return moved, float(np.abs(_scaled_logarithms(entries) - before).max())


def _scaled_logarithms(entries: list[Entry]) -> Array:
    """Logarithms of the hyperparameters in log-SDs of their hyperpriors."""
    parts = [(entry.value.detach().log() / entry.log_sds).reshape(-1) for entry in entries]
    return torch.cat(parts).numpy()


def _gradient(entry: Entry) -> Array:
    grad = entry.raw.grad
    assert grad is not None
    return grad.reshape(-1).numpy()


def _tied(entries: list[Entry], gradient: Array) -> Array:
    """Of coupled axes all entries of a matrix vary alike: every axis takes the mean step."""
    result, start = gradient.copy(), 0
    for entry in entries:
        stop = start + entry.raw.numel()
        parts = gradient[start:stop].reshape(len(entry.raw), -1)
        result[start:stop] = np.broadcast_to(parts.mean(axis=0), parts.shape).reshape(-1)
        start = stop
    return result


class _Quadratic:
    """log p(u | functions) about the mode, in the whitened weights of the hyperparameters at which it was found."""

    def __init__(self, density: Density, mode: Array, precision: Array) -> None:
        self.density = density
        count = density.weight_count
        # The rest is marginalised: a Schur complement.
        inner = precision[:count, :count]
        outer = precision[:count, count:]
        marginal = inner - outer @ laplace.covariance(precision[count:, count:]) @ outer.T
        values, vectors = np.linalg.eigh(marginal - np.eye(count))
        likelihood = (vectors * np.maximum(values, 0.0)) @ vectors.T
        weights = mode[:count]
        self.likelihood = torch.from_numpy(likelihood)
        # At the mode the gradient of the likelihood is the weights themselves.
        self.linear = torch.from_numpy(weights + likelihood @ weights)
        with torch.no_grad():
            self.roots = [self._roots(function) for function in density.functions]

    def log_evidence(self) -> Tensor:
        """log ∫ p(u | functions) p(functions), without constants [nats]."""
        prior = self._prior_covariance()
        eye = torch.eye(len(prior), dtype=prior.dtype)
        mixed = eye + prior @ self.likelihood
        posterior = torch.linalg.solve(mixed, prior)
        return 0.5 * (self.linear @ posterior @ self.linear - torch.linalg.slogdet(mixed).logabsdet)

    def translated(self, mode: Array) -> Array:
        """`mode` with the weights that give the same functions under the present hyperparameters."""
        parts = []
        weights = self.density.weights(torch.from_numpy(mode))
        for function, own, root in zip(self.density.functions, weights, self.roots, strict=True):
            if root is None:
                parts.append(own)
                continue
            with torch.no_grad():
                now = self._roots(function)
            assert now is not None
            values = torch.einsum("ezw,gew->gez", root, own[..., 1:])
            new = torch.linalg.solve_triangular(now, values.unsqueeze(-1), upper=False)[..., 0]
            parts.append(torch.cat([own[..., :1], new], dim=-1))
        flat = torch.cat([part.reshape(-1) for part in parts]).numpy()
        return np.concatenate([flat, mode[self.density.weight_count :]])

    def _roots(self, function: ImpedanceFunction) -> Tensor | None:
        """Cholesky factor of s² R(Z, Z) of each entry, `(entries, Z, Z)`."""
        if function.inducing is None:
            return None
        covariance = function.covariance_at_inducing()[:, 0]
        return torch.linalg.cholesky(covariance)[[a for a, _ in function.places]]

    def _prior_covariance(self) -> Tensor:
        """Prior covariance of the weights of the mode's hyperparameters under the present ones."""
        blocks = []
        for function, root, (groups, entries, width) in zip(
            self.density.functions, self.roots, self.density.shapes, strict=True
        ):
            if root is None:
                blocks += [torch.eye(width, dtype=torch.float64)] * (groups * entries)
                continue
            covariance = function.covariance_at_inducing()[:, 0][[a for a, _ in function.places]]
            half = torch.linalg.solve_triangular(root, covariance, upper=False)
            white = torch.linalg.solve_triangular(root, half.mT, upper=False)
            one = torch.ones(1, 1, dtype=torch.float64)
            blocks += [torch.block_diag(one, block) for _ in range(groups) for block in white]
        return torch.block_diag(*blocks)
