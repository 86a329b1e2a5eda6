"""Coupled impedance written out in loops over entries, and drawn: nothing here calls the library's coupled kernels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from oracles import TrajectorySpec, path_derivatives, samples_of, stacked

from bayes_impedance.config import Config
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import ForceModel


@dataclass(frozen=True)
class Term:
    """w a aᵀ with log w ~ GP(log level, Σ_c shares_c sd_c² SE(ξ/ℓ_c))."""

    direction: np.ndarray
    level: float
    sd: np.ndarray
    lengthscale: np.ndarray

    def covariance(self, xi1: np.ndarray, xi2: np.ndarray) -> float:
        """k_r of one pair."""
        total = 0.0
        for c, a in enumerate(self.direction):
            s = sum(
                0.5 * ((p - q) / length) ** 2
                for p, q, length in zip(xi1, xi2, self.lengthscale[c], strict=True)
            )
            total += a**2 * self.sd[c] ** 2 * math.exp(-s)
        return total

    def expectation(self, xi: np.ndarray) -> float:
        """E[w]."""
        return self.level * math.exp(0.5 * self.covariance(xi, xi))


def directions(axes: int) -> list[np.ndarray]:
    """Each axis, then the sum and the difference of each pair."""
    listed = list(np.eye(axes))
    for p in range(axes):
        for q in range(p + 1, axes):
            for sign in (1.0, -1.0):
                a = np.zeros(axes)
                a[p], a[q] = 1.0 / math.sqrt(2.0), sign / math.sqrt(2.0)
                listed.append(a)
    return listed


class CoupledOracle:
    """Moments of u_a = Σ_j Σ_c W_j,ac e_c⁽ʲ⁾ + ũ_a at every sample of a log, under the hyperparameters of a model."""

    def __init__(self, config: Config, log: PreparedLog, model: ForceModel) -> None:
        self.axes = len(log.axes)
        values = {entry.name: entry.value.detach().numpy()[:, 0, 0] for entry in model.entries}
        self.samples = [samples_of(config, log, axis) for axis in range(self.axes)]
        one = self.samples[0]
        self.n = len(one.theta)
        self.error = np.stack([samples.error.numpy() for samples in self.samples])
        self.terms, self.xi = [], []
        for name in ("stiffness", "damping", "mass"):
            inputs = () if name == "mass" else getattr(config.model, name).input
            self.xi.append(one.xi["+".join(inputs)].numpy() if inputs else np.zeros((self.n, 0)))
            level, coupling = values[f"{name}.level"][:, 0], values[f"{name}.coupling"][:, 0]
            if name == "mass":
                sd = np.sqrt(np.log1p((values["mass.sd"][:, 0] / level) ** 2))
            else:
                sd = values[f"{name}.log_sd"][:, 0]
            lengthscale = values.get(f"{name}.length_scale", np.zeros((self.axes, 0)))
            listed = []
            for r, a in enumerate(directions(self.axes)):
                own = level[r] if r < self.axes else coupling[r - self.axes] * math.prod(level ** (a**2))
                listed.append(Term(a, float(own), sd, lengthscale))
            self.terms.append(listed)
        sds, lengths = values["desired_trajectory.sd"][:, 0], values["desired_trajectory.length_scale"]
        profile = config.model.desired_trajectory.kernel
        with torch.enable_grad():
            self.tables = [
                path_derivatives(TrajectorySpec(profile, sds[c], tuple(lengths[c])).covariance, one, one)
                for c in range(self.axes)
            ]
        for table in self.tables if one.trajectory is not None else ():
            same = one.trajectory[:, None] == one.trajectory[None]
            for row in table:
                row[:] = [torch.where(same, entry, 0.0) for entry in row]

    def mean_matrix(self, j: int, s: int) -> np.ndarray:
        """E[W_j] at sample s."""
        return sum(t.expectation(self.xi[j][s]) * np.outer(t.direction, t.direction) for t in self.terms[j])

    def matrix_covariance(self, j: int, s: int, t: int) -> np.ndarray:
        """Cov[W_j,ab(s), W_j,cd(t)], `(axes, axes, axes, axes)`."""
        total = np.zeros([self.axes] * 4)
        for term in self.terms[j]:
            one, two = self.xi[j][s], self.xi[j][t]
            spread = term.expectation(one) * term.expectation(two) * math.expm1(term.covariance(one, two))
            a = term.direction
            total += spread * np.einsum("a,b,c,d->abcd", a, a, a, a)
        return total

    def mean(self) -> np.ndarray:
        """E[u], `(n, axes)`."""
        return np.array(
            [sum(self.mean_matrix(j, s) @ self.error[:, s, j] for j in range(3)) for s in range(self.n)]
        )

    def covariance(self, added: np.ndarray | None = None) -> np.ndarray:
        """Cov[u, u'] of the impedance force, `(n, axes, n, axes)`; `added` `(axes, n, n, 3, 3)` joins D_ij,c."""
        total = np.zeros((self.n, self.axes, self.n, self.axes))
        means = [[self.mean_matrix(j, s) for s in range(self.n)] for j in range(3)]
        for s in range(self.n):
            for t in range(self.n):
                spread = [self.matrix_covariance(j, s, t) for j in range(3)]
                for a in range(self.axes):
                    for b in range(self.axes):
                        total[s, a, t, b] = self._entry(s, a, t, b, means, spread, added)
        return total

    def _entry(self, s, a, t, b, means, spread, added):
        total = 0.0
        for c in range(self.axes):
            for i in range(3):
                for j in range(3):
                    second = means[i][s][a, c] * means[j][t][b, c] + (
                        spread[j][a, c, b, c] if i == j else 0.0
                    )
                    derivative = float(self.tables[c][i][j][s, t])
                    derivative += 0.0 if added is None else added[c, s, t, i, j]
                    total += second * derivative
        for j in range(3):
            for c in range(self.axes):
                for d in range(self.axes):
                    total += spread[j][a, c, b, d] * self.error[c, s, j] * self.error[d, t, j]
        return total

    def draw(self, draws: int, seed: int) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
        """u without residual `(draws, n, axes)`, g_j `(draws, n, terms)`, x_d⁽ʳ⁾ − μ_xd⁽ʳ⁾ `(draws, 3, n, axes)`."""
        generator = np.random.default_rng(seed)
        deviation = np.stack(
            [_gaussian(stacked(table).numpy(), draws, generator).reshape(draws, 3, self.n) for table in self.tables],
            axis=-1,
        )  # fmt: skip
        force = np.zeros((draws, self.n, self.axes))
        logarithms = []
        for j in range(3):
            matrices = np.zeros((draws, self.n, self.axes, self.axes))
            columns = []
            for term in self.terms[j]:
                k = np.array([[term.covariance(p, q) for q in self.xi[j]] for p in self.xi[j]])
                g = math.log(term.level) + _gaussian(k, draws, generator)
                matrices += np.exp(g)[..., None, None] * np.outer(term.direction, term.direction)
                columns.append(g)
            error = deviation[:, j] + self.error[:, :, j].T
            force += np.einsum("dnac,dnc->dna", matrices, error)
            logarithms.append(np.stack(columns, axis=-1))
        return force, logarithms, deviation


def _gaussian(covariance: np.ndarray, draws: int, generator: np.random.Generator) -> np.ndarray:
    # On the scale of correlations, so that rounding of accelerations does not drown positions.
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    standard = generator.standard_normal((draws, len(scale)))
    return scale * (standard @ (vectors * np.sqrt(values.clip(min=0.0))).T)


def scatter_hyperparameters(model: ForceModel, seed: int = 0) -> None:
    """Give every axis, pair and sign values of its own, within a factor of two of where they stand."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for entry in model.entries:
            factor = torch.exp(0.3 * torch.randn(entry.value.shape, generator=generator, dtype=torch.float64))
            value = (entry.value * factor).reshape(entry.raw.shape) ** (1.0 / entry.power)
            if torch.isfinite(entry.constraint.upper_bound).all():
                value = value.clamp(max=0.45)
            entry.raw.copy_(entry.constraint.inverse_transform(value))
