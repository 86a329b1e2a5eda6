"""The covariance that impedance priors give the interaction force (docs/model.md §2; paper (13)–(15)).

With w = (k, d, m), ē_j = E[e⁽ʲ⁾] and C_ij = Cov[w_i, w_j'], independent of x_d and ũ:

    E[u]      = Σ_j E[w_j] ē_j
    Cov[u,u'] = Σ_ij (E[w_i] E[w_j'] + C_ij) ∂_tⁱ ∂_t'ʲ k_xd + Σ_ij C_ij ē_i ē_j' + k_ũ
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import torch
from gpytorch.kernels import Kernel
from gpytorch.means import Mean
from torch import Tensor

from bayes_impedance.kernels.derivative import Path, Table, derivative_table, multiply_add
from bayes_impedance.kernels.motion_noise import MotionNoiseKernel
from bayes_impedance.kernels.stationary import BatchedKernel, StationaryKernel
from bayes_impedance.kernels.warped import ImpedanceProcess, evaluate


class Latent(Enum):
    """Quantities that have a posterior; the value is the name users see."""

    FORCE = "force"
    DESIRED_POSITION = "desired_position"
    DESIRED_VELOCITY = "desired_velocity"
    DESIRED_ACCELERATION = "desired_acceleration"
    RESIDUAL_FORCE = "residual_force"
    STIFFNESS = "stiffness"
    DAMPING = "damping"
    MASS = "mass"


#: Order of time derivative of x_d.
TRAJECTORY_ORDER = {
    Latent.DESIRED_POSITION: 0,
    Latent.DESIRED_VELOCITY: 1,
    Latent.DESIRED_ACCELERATION: 2,
}
#: Order j of the error e⁽ʲ⁾ that each impedance parameter multiplies.
IMPEDANCE_ORDER = {Latent.STIFFNESS: 0, Latent.DAMPING: 1, Latent.MASS: 2}


#: A common factor, and ∂_tⁱ ∂_t'ʲ k_xd over it.
Derivatives = tuple[Tensor, Table]


@dataclass(frozen=True)
class InputLayout:
    """Which columns of a kernel's input hold what; ξ of k, d and ũ is named by their own `active_dims`.

    `theta`, `theta_velocity` [1/s], `theta_acceleration` [1/s²]: θ and its time derivatives, p columns
    each; an empty acceleration means zero. `error`: ē_0, ē_1, ē_2 [m, m/s, m/s²]; empty where the prior
    mean of x_d is the hand itself. `trajectory`, `residual`: a column of labels; samples with different
    labels have independent x_d, or ũ. None means one for all. `smoothing`: see `MotionNoiseKernel`; empty where the
    noise of the recorded motion is left out.
    """

    theta: tuple[int, ...]
    theta_velocity: tuple[int, ...]
    theta_acceleration: tuple[int, ...] = ()
    error: tuple[int, ...] = ()
    trajectory: int | None = None
    residual: int | None = None
    smoothing: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        p = len(self.theta)
        if p == 0 or len(self.theta_velocity) != p or len(self.theta_acceleration) not in (0, p):
            raise ValueError(
                f"layout: expected as many columns of velocity (and acceleration, or none) as of theta, got "
                f"{p}, {len(self.theta_velocity)} and {len(self.theta_acceleration)}"
            )
        if len(self.error) not in (0, 3):
            raise ValueError(f"layout: expected 3 error columns or none, got {len(self.error)}")

    def path(self, x: Tensor) -> Path:
        """θ, θ̇, θ̈ of the rows of `x`."""
        acceleration = x[..., list(self.theta_acceleration)] if self.theta_acceleration else None
        return Path(x[..., list(self.theta)], x[..., list(self.theta_velocity)], acceleration)

    def errors(self, x: Tensor, order: int) -> list[Tensor] | None:
        """ē_0 … ē_order, `(..., n, 1)` each; None where they vanish."""
        return [x[..., [c]] for c in self.error[: order + 1]] if self.error else None


def same_label(x1: Tensor, x2: Tensor, column: int | None, diag: bool = False) -> Tensor | None:
    """1 where two samples carry the same label, else 0; None where all do."""
    if column is None or diag:
        return None
    return (x1[..., column].unsqueeze(-1) == x2[..., column].unsqueeze(-2)).to(x1.dtype)


def force_covariance(
    expectation1: Sequence[Any],
    expectation2: Sequence[Any],
    covariance: Mapping[tuple[int, int], Any],
    table: Table,
    common: Any,
    error1: Sequence[Any] | None = None,
    error2: Sequence[Any] | None = None,
) -> Any:
    """Σ_ij (E_i E_j' + C_ij) D_ij + Σ_ij C_ij ē_i ē_j', D_ij = `common` · `table[i][j]` (docs/model.md §2).

    `expectation1[i]` E_i broadcasts as `(..., n1, 1)`, `expectation2[j]` as `(..., 1, n2)`, `error1` and
    `error2` alike; `covariance[i, j]` C_ij is `(..., n1, n2)`, absent pairs are independent.
    NumPy arrays serve as well as tensors.
    """
    orders = range(len(table))
    total = None
    for j in orders:
        column = expectation1[0] * table[0][j]
        for i in orders[1:]:
            column = multiply_add(column, expectation1[i], table[i][j])
        total = column * expectation2[j] if total is None else multiply_add(total, column, expectation2[j])
    assert total is not None
    for (i, j), c in covariance.items():
        total = multiply_add(total, c, table[i][j])
    total = total * common
    if error1 is not None and error2 is not None:
        for (i, j), c in covariance.items():
            total = multiply_add(total, c, error1[i] * error2[j])
    return total


class ImpedanceKernel(BatchedKernel):
    """Covariance of Σ_j w_j e⁽ʲ⁾ over orders 0, 1, 2: the paper's impedance kernel (14) [N²].

    Args:
        layout: which input columns hold θ, θ̇, θ̈, ē and labels.
        trajectory: covariance of x_d over θ [m²].
        stiffness, damping: priors of k [N/m] and d [Ns/m] over their `active_dims`.
        mass: prior of m [kg]; None leaves the acceleration out (`PDKernel`).

    Example:
        >>> layout = InputLayout(theta=(0,), theta_velocity=(1,))  # a column of time, and one of its rate, 1
        >>> k, d, m = (ImpedanceProcess(StationaryKernel(num_dims=0)) for _ in range(3))
        >>> kernel = ImpedanceKernel(layout, StationaryKernel(), k, d, m).double()
        >>> kernel.stiffness.level, kernel.damping.level, kernel.mass.level = 300.0, 20.0, 1.5
        >>> time = torch.linspace(0.0, 1.0, 5, dtype=torch.float64)
        >>> x = torch.stack([time, torch.ones_like(time)], dim=-1)
        >>> tuple(kernel(x).shape)
        (5, 5)

    Raises:
        TypeError: input and hyperparameters of different dtype.
    """

    def __init__(
        self,
        layout: InputLayout,
        trajectory: StationaryKernel,
        stiffness: ImpedanceProcess,
        damping: ImpedanceProcess,
        mass: ImpedanceProcess | None,
        active_dims: tuple[int, ...] | None = None,
    ) -> None:
        super().__init__(active_dims=active_dims)
        for part in (trajectory, stiffness, damping, mass):
            if part is not None:
                _check_takes_every_column(
                    part, "name ξ by the active_dims of the covariance, θ by the layout"
                )
        self.layout = layout
        self.trajectory = trajectory
        self.stiffness = stiffness
        self.damping = damping
        self.mass = mass

    @property
    def processes(self) -> tuple[ImpedanceProcess, ...]:
        """(k, d, m), or (k, d) without mass; their place is the order of the error they multiply."""
        return (
            (self.stiffness, self.damping) if self.mass is None else (self.stiffness, self.damping, self.mass)
        )

    @property
    def order(self) -> int:
        """Highest time derivative that enters the force."""
        return len(self.processes) - 1

    def prior_mean(self, x: Tensor) -> Tensor:
        """E[u] = Σ_j E[w_j] ē_j, `(..., n)` [N]."""
        errors = self.layout.errors(x, self.order)
        if errors is None:
            return x.new_zeros(torch.broadcast_shapes(x.shape[:-1], (*self.batch_shape, 1)))
        total = torch.zeros((), dtype=x.dtype)
        for process, error in zip(self.processes, errors, strict=True):
            total = total + process.expectation(x) * error
        return total.squeeze(-1)

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: object) -> Tensor:
        """Cov[u, u'], `(..., n1, n2)`, or `(..., n)` with `diag` [N²]."""
        derivatives = self.derivatives(x1, x2, diag, self.order)
        return self.covariance(x1, x2, derivatives, diag)

    def derivatives(self, x1: Tensor, x2: Tensor, diag: bool = False, order: int = 2) -> Derivatives:
        """∂_tⁱ ∂_t'ʲ k_xd for i, j ≤ `order`; see `derivative_table`."""
        self._check_dtype(x1, x2)
        path = self.layout.path
        common, table = derivative_table(self.trajectory, path(x1), path(x2), order, diag)
        shared = same_label(x1, x2, self.layout.trajectory, diag)
        return common if shared is None else common * shared, table

    def covariance(self, x1: Tensor, x2: Tensor, derivatives: Derivatives, diag: bool = False) -> Tensor:
        """Cov[u, u'] for `derivatives` that are known already, `(..., n1, n2)`, or `(..., n)` with `diag` [N²]."""
        common, table = self._of_force(derivatives)
        if diag:
            return self._variance(x1, common, table)
        moments = [process.moments(x1, x2) for process in self.processes]
        return force_covariance(
            [e1 for e1, _, _ in moments],
            [e2 for _, e2, _ in moments],
            {(j, j): c for j, (_, _, c) in enumerate(moments)},
            table,
            common,
            self.layout.errors(x1, self.order),
            _transposed(self.layout.errors(x2, self.order)),
        )

    def _variance(self, x: Tensor, common: Tensor, table: Table) -> Tensor:
        expectations = [process.expectation(x)[..., 0] for process in self.processes]
        errors = self.layout.errors(x, self.order)
        flat = None if errors is None else [error[..., 0] for error in errors]
        variances = {(j, j): process.forward(x, x, diag=True) for j, process in enumerate(self.processes)}
        total = force_covariance(expectations, expectations, variances, table, common, flat, flat)
        return total.expand(torch.broadcast_shapes(total.shape, x.shape[:-1]))

    def trajectory_covariance(
        self, x1: Tensor, x2: Tensor, order: int, derivatives: Derivatives | None = None
    ) -> Tensor:
        """Cov[u, x_d⁽ʳ⁾'] = Σ_i E[w_i] ∂_tⁱ ∂_t'ʳ k_xd, r = `order`, `(..., n1, n2)` [N m/sʳ]."""
        common, table = self.derivatives(x1, x2) if derivatives is None else derivatives
        total = self.processes[0].expectation(x1) * table[0][order]
        for i, process in enumerate(self.processes[1:], start=1):
            total = multiply_add(total, process.expectation(x1), table[i][order])
        return total * common

    def trajectory_variance(self, x: Tensor, order: int, derivatives: Derivatives | None = None) -> Tensor:
        """Prior variance of x_d⁽ʳ⁾, r = `order`, `(..., n)` [m²/s²ʳ]."""
        common, table = self.derivatives(x, x, diag=True) if derivatives is None else derivatives
        return common * table[order][order]

    def impedance_covariance(self, x1: Tensor, x2: Tensor, order: int) -> Tensor:
        """Cov[u, g_j'] = ē_j · sensitivity_j · k_w, with g_j = w_j, or log w_j where warped (docs/model.md §4, §5)."""
        process = self.processes[order]
        k = process.gaussian_covariance(x1, x2)
        errors = self.layout.errors(x1, self.order)
        if errors is None:
            return torch.zeros_like(k)
        return errors[order] * process.sensitivity(x1) * k

    def _of_force(self, derivatives: Derivatives) -> Derivatives:
        """Those up to the order that enters the force."""
        common, table = derivatives
        return common, [row[: self.order + 1] for row in table[: self.order + 1]]

    def _check_dtype(self, *inputs: Tensor) -> None:
        for x in inputs:
            if x.dtype != self.dtype:
                raise TypeError(
                    f"expected inputs of the hyperparameters' dtype {self.dtype}, got {x.dtype}: "
                    "convert both with .double()"
                )


def PDKernel(  # noqa: N802 - named as the kernel it builds
    layout: InputLayout,
    trajectory: StationaryKernel,
    stiffness: ImpedanceProcess,
    damping: ImpedanceProcess,
    active_dims: tuple[int, ...] | None = None,
) -> ImpedanceKernel:
    """Covariance of k e + d ė: the paper's PD kernel (13), an `ImpedanceKernel` without mass.

    Example:
        >>> layout = InputLayout(theta=(0,), theta_velocity=(1,))  # a column of time, and one of its rate, 1
        >>> k, d = (ImpedanceProcess(StationaryKernel(num_dims=0)) for _ in range(2))
        >>> kernel = PDKernel(layout, StationaryKernel("matern52"), k, d)
        >>> kernel.order
        1
    """
    return ImpedanceKernel(layout, trajectory, stiffness, damping, mass=None, active_dims=active_dims)


class LatentCovariances(Kernel):
    """What interaction kernels share: covariances of the force with every latent, from those of its parts.

    `impedance` is the kernel of the impedance force. Shapes are those of the kernel's own covariance.
    """

    impedance: Any

    @abstractmethod
    def residual_covariance(self, x1: Tensor, x2: Tensor, diag: bool = False) -> Tensor:
        """k_ũ, zero between samples whose residual labels differ [N²]."""

    def prior_mean(self, x: Tensor) -> Tensor:
        """E[u], one for each row of the covariance [N]."""
        return self.impedance.prior_mean(x)

    @abstractmethod
    def covariance(self, x1: Tensor, x2: Tensor, derivatives: Any, diag: bool = False) -> Tensor:
        """Cov[u, u'] for `derivatives` that are known already [N²]."""

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: object) -> Tensor:
        """Cov[u, u'], or Var[u] of single samples with `diag` [N²]."""
        return self.covariance(x1, x2, self.impedance.derivatives(x1, x2, diag), diag)

    def cross_covariance(
        self, x1: Tensor, x2: Tensor, latent: Latent, derivatives: Any | None = None
    ) -> Tensor:
        """Cov[u(x1), latent(x2)]; warped impedance enters by its logarithm (docs/model.md §4), or by its terms.

        `derivatives`: `impedance.derivatives(x1, x2)`, which several latents have in common, where known already.
        """
        if latent is Latent.RESIDUAL_FORCE:
            return self.residual_covariance(x1, x2)
        if latent in IMPEDANCE_ORDER:
            return self.impedance.impedance_covariance(x1, x2, IMPEDANCE_ORDER[latent])
        derivatives = self.impedance.derivatives(x1, x2) if derivatives is None else derivatives
        if latent is Latent.FORCE:
            return self.covariance(x1, x2, derivatives)
        return self.impedance.trajectory_covariance(x1, x2, TRAJECTORY_ORDER[latent], derivatives)

    def prior_variance(self, x: Tensor, latent: Latent, derivatives: Any | None = None) -> Tensor:
        """Prior variance of a latent that is no impedance.

        `derivatives`: `impedance.derivatives(x, x, diag=True)`, where known already.
        """
        if latent is Latent.RESIDUAL_FORCE:
            return self.residual_covariance(x, x, diag=True)
        derivatives = self.impedance.derivatives(x, x, diag=True) if derivatives is None else derivatives
        if latent is Latent.FORCE:
            return self.covariance(x, x, derivatives, diag=True)
        return self.impedance.trajectory_variance(x, TRAJECTORY_ORDER[latent], derivatives)


class InteractionKernel(LatentCovariances, BatchedKernel):
    """Impedance plus residual force: the paper's interaction kernel (15) without its noise [N²].

    σ_r² belongs to the likelihood, as gpytorch has it.

    Args:
        impedance: covariance of the impedance force.
        residual: any gpytorch kernel for ũ; None for no residual.
        motion_noise: covariance that noise of the recorded motion adds to the force; None where it is left out.

    Example:
        >>> layout = InputLayout(theta=(0,), theta_velocity=(1,))  # a column of time, and one of its rate, 1
        >>> k, d, m = (ImpedanceProcess(StationaryKernel(num_dims=0)) for _ in range(3))
        >>> impedance = ImpedanceKernel(layout, StationaryKernel(), k, d, m)
        >>> kernel = InteractionKernel(impedance, residual=StationaryKernel(active_dims=(0,))).double()
        >>> time = torch.linspace(0.0, 1.0, 5, dtype=torch.float64)
        >>> x = torch.stack([time, torch.ones_like(time)], dim=-1)
        >>> tuple(kernel.cross_covariance(x, x[:2], Latent.DESIRED_POSITION).shape)
        (5, 2)
    """

    def __init__(
        self,
        impedance: ImpedanceKernel,
        residual: Kernel | None = None,
        active_dims: tuple[int, ...] | None = None,
        motion_noise: MotionNoiseKernel | None = None,
    ) -> None:
        super().__init__(active_dims=active_dims)
        for part in (impedance, motion_noise):
            if part is not None:
                _check_takes_every_column(part, "give active_dims to the InteractionKernel")
        self.impedance = impedance
        self.residual = residual
        self.motion_noise = motion_noise

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: object) -> Tensor:
        """Cov[u, u'], `(..., n1, n2)`, or `(..., n)` with `diag` [N²]."""
        derivatives = self.impedance.derivatives(x1, x2, diag, self.impedance.order)
        return self.covariance(x1, x2, derivatives, diag)

    def covariance(self, x1: Tensor, x2: Tensor, derivatives: Any, diag: bool = False) -> Tensor:
        """Cov[u, u'] for `derivatives` that are known already, `(..., n1, n2)`, or `(..., n)` with `diag` [N²]."""
        total = self.impedance.covariance(x1, x2, derivatives, diag)
        if self.motion_noise is not None:
            total = total + self.motion_noise.forward(x1, x2, diag=diag)
        return total if self.residual is None else total + self.residual_covariance(x1, x2, diag)

    def residual_covariance(self, x1: Tensor, x2: Tensor, diag: bool = False) -> Tensor:
        """k_ũ, zero between samples whose residual labels differ [N²]."""
        if self.residual is None:
            shape = x1.shape[:-1] if diag else (*x1.shape[:-1], x2.shape[-2])
            return x1.new_zeros(shape)
        k = evaluate(self.residual, x1, x2, diag)
        shared = same_label(x1, x2, self.impedance.layout.residual, diag)
        return k if shared is None else k * shared

    def prior_variance(self, x: Tensor, latent: Latent, derivatives: Any | None = None) -> Tensor:
        """Prior variance of the latent, of its logarithm where warped, `(..., n)`."""
        if latent in IMPEDANCE_ORDER:
            process = self.impedance.processes[IMPEDANCE_ORDER[latent]]
            return process.gaussian_covariance(x, x, diag=True)
        return super().prior_variance(x, latent, derivatives)


class InteractionMean(Mean):
    """Prior mean of the interaction force as a gpytorch mean, tied to the hyperparameters of its kernel."""

    def __init__(self, kernel: ImpedanceKernel | InteractionKernel) -> None:
        super().__init__()
        self.kernel = kernel

    def forward(self, x: Tensor) -> Tensor:
        """E[u] = Σ_j E[w_j] ē_j, `(..., n)` [N]."""
        return self.kernel.prior_mean(x)


def _check_takes_every_column(kernel: Kernel, remedy: str) -> None:
    if kernel.active_dims is not None:
        raise ValueError(
            f"expected a {type(kernel).__name__} over every column of the input, got active_dims "
            f"{kernel.active_dims.tolist()}, which would go unheard here; {remedy}"
        )


def _transposed(columns: list[Tensor] | None) -> list[Tensor] | None:
    return None if columns is None else [column.mT for column in columns]
