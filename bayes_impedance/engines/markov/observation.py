"""What a force is of the states: steps, rows and noise of the filter, from hyperparameters and impedance.

With f = x_d − μ_xd over θ, ḟ = θ̇ f' and f̈ = θ̇² f'' + θ̈ f'; so the force of axis a holds of axis c, in its state
(f, f'/λ, f''/λ²)/σ,

    (K_ac, D_ac θ̇ + M_ac θ̈, M_ac θ̇²) · (σ_c, σ_c λ_c, σ_c λ_c²)
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bayes_impedance.engines.given_impedance import Processes
from bayes_impedance.engines.markov.arrangement import Samples, Structure
from bayes_impedance.engines.markov.state_space import RATE
from bayes_impedance.kernels.impedance import TRAJECTORY_ORDER, Latent
from bayes_impedance.kernels.stationary import Stationary


@dataclass(frozen=True)
class Scales:
    """Hyperparameters by axis: σ [m] and λ [1/unit of θ] of the trajectory `(axes,)`, SD [N] and λ of each residual
    term `(axes, terms)` (0 for a constant), σ_r² [N²] `(axes,)`.

    Filters hold one axis each, or all of them where axes are `coupled`.
    """  # fmt: skip

    sd: Tensor
    rate: Tensor
    residual_sd: Tensor
    residual_rate: Tensor
    noise: Tensor
    coupled: bool

    @classmethod
    def of(cls, processes: Processes, structure: Structure, axes: int, coupled: bool) -> Scales:
        """Those of some processes."""
        terms = list(zip(processes.residual, structure.terms, strict=True))
        none = torch.zeros(axes, dtype=torch.float64)
        sds = [_by_axis(kernel.sd, axes) for kernel, _ in terms]
        rates = [none if term.column is None else _rate(kernel, term.size, axes) for kernel, term in terms]
        return cls(
            _by_axis(processes.trajectory.sd, axes),
            _rate(processes.trajectory, 3, axes),
            torch.stack(sds, -1) if sds else none.new_zeros(axes, 0),
            torch.stack(rates, -1) if rates else none.new_zeros(axes, 0),
            _by_axis(processes.noise_variance, axes),
            coupled,
        )

    def steps(self, increments: Tensor) -> Tensor:
        """z = λΔ of every block, `(filters, n, blocks)`, from increments `(n, 1 + terms)`."""
        own = self.rate.unsqueeze(-1) * increments[:, 0]
        residual = self.residual_rate.unsqueeze(1) * increments[:, 1:]
        if not self.coupled:
            return torch.cat([own.unsqueeze(-1), residual], dim=-1)
        return torch.cat([own.T, residual.transpose(0, 1).flatten(1)], dim=-1).unsqueeze(0)

    def force_rows(self, matrices: Tensor, samples: Samples) -> Tensor:
        """h, `(filters, n, axes, 3 axes)` [N]; `matrices` as from `matrices_of`."""
        rate, change = (_as_column(part, matrices) for part in (samples.velocity, samples.acceleration))
        k, d, m = matrices.unbind(1)
        rows = torch.stack([k, d * rate + m * change, m * rate**2], dim=-1) * self._powers()
        if self.coupled:
            return rows.flatten(-2).unsqueeze(0)
        return rows.transpose(0, 1).unsqueeze(2)

    def residual_sds(self) -> Tensor:
        """c, `(filters, axes, terms)` [N]."""
        return self.residual_sd.unsqueeze(0 if self.coupled else 1)

    def noise_variances(self) -> Tensor:
        """r, `(filters, axes)` [N²]."""
        return self.noise.unsqueeze(0 if self.coupled else 1)

    def by_filter(self, values: Tensor) -> Tensor:
        """`(n, axes)` as `(filters, n, axes)`."""
        return values.unsqueeze(0) if self.coupled else values.T.unsqueeze(-1)

    def latent_rows(self, latent: Latent, force: Tensor, samples: Samples, structure: Structure) -> Tensor:
        """What a latent is of the states of the blocks at each sample, `(filters, n, axes, states)`.

        `force`: h of the samples.
        """
        trajectory = torch.zeros_like(force)
        if latent is Latent.FORCE:
            trajectory = force
        elif latent in TRAJECTORY_ORDER:
            rate, change = samples.velocity, samples.acceleration
            zero, one = torch.zeros_like(rate), torch.ones_like(rate)
            derivatives = ((one, zero, zero), (zero, rate, zero), (zero, change, rate**2))
            single = torch.stack(derivatives[TRAJECTORY_ORDER[latent]], dim=-1)
            own = torch.einsum("ns,as->ans", single, self._powers())
            trajectory = own.unsqueeze(2)
            if self.coupled:
                trajectory = torch.diag_embed(own.movedim(0, -1), dim1=1, dim2=2).flatten(2).unsqueeze(0)
        if latent in TRAJECTORY_ORDER:
            residual = self._residual_rows(torch.zeros_like(self.residual_sd), structure)
        else:
            residual = self._residual_rows(self.residual_sd, structure)
        residual = residual.unsqueeze(1).expand(*trajectory.shape[:3], residual.shape[-1])
        return torch.cat([trajectory, residual], dim=-1)

    def by_axis(self, states: Tensor, structure: Structure) -> Tensor:
        """States of the blocks `(filters, n, states)` of each axis, `(n, axes, states)`."""
        if not self.coupled:
            return states.transpose(0, 1)
        axes, width = len(self.sd), sum(term.size for term in structure.terms)
        trajectory, residual = states[0].split([3 * axes, width * axes], dim=-1)
        return torch.cat([trajectory.unflatten(-1, (axes, 3)), residual.unflatten(-1, (axes, width))], dim=-1)

    def latents(self, states: Tensor, samples: Samples, structure: Structure) -> tuple[Tensor, Tensor]:
        """f, ḟ, f̈ `(n, axes, 3)` and ũ `(n, axes)` of the states of each axis, see `by_axis`."""
        position, slope, curvature = (states[..., :3] * self._powers()).unbind(-1)
        rate, change = samples.velocity.unsqueeze(-1), samples.acceleration.unsqueeze(-1)
        deviation = torch.stack([position, rate * slope, change * slope + rate**2 * curvature], dim=-1)
        first = [3 + sum(term.size for term in structure.terms[:j]) for j in range(len(structure.terms))]
        return deviation, (states[..., first] * self.residual_sd).sum(-1)

    def _powers(self) -> Tensor:
        """(σ, σλ, σλ²) `(axes, 3)`."""
        return torch.stack([self.sd, self.sd * self.rate, self.sd * self.rate**2], dim=-1)

    def _residual_rows(self, sds: Tensor, structure: Structure) -> Tensor:
        """First state of each term by its SD, `(filters, axes, states)`."""
        width = sum(term.size for term in structure.terms)
        own = sds.new_zeros(sds.shape[0], width)
        first = 0
        for j, term in enumerate(structure.terms):
            own[:, first] = sds[:, j]
            first += term.size
        if not self.coupled:
            return own.unsqueeze(1)
        return torch.diag_embed(own.T, dim1=0, dim2=1).flatten(1).unsqueeze(0)


def matrices_of(impedance: Tensor, samples: Samples, coupled: bool) -> Tensor:
    """K, D, M of each sample, `(n, 3, axes, axes)`, or their diagonals `(n, 3, axes)` where axes do not couple."""
    known = impedance if coupled else impedance.diagonal(dim1=-2, dim2=-1)
    place = torch.from_numpy(samples.group * impedance.shape[1] + samples.row)
    return known.flatten(0, 1).index_select(0, place)


def by_sample(values: Tensor, samples: Samples) -> Tensor:
    """`(axes, groups, rows, …)` as `(n, axes, …)`."""
    return values[:, torch.from_numpy(samples.group), torch.from_numpy(samples.row)].transpose(0, 1)


def _rate(kernel: Stationary, size: int, axes: int) -> Tensor:
    return RATE[size] / _by_axis(kernel.lengthscale, axes)


def _by_axis(value: Tensor, axes: int) -> Tensor:
    return value.reshape(-1).expand(axes)


def _as_column(values: Tensor, like: Tensor) -> Tensor:
    return values.reshape(-1, *[1] * (like.ndim - 2))
