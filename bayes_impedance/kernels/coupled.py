"""The covariance that coupled impedance gives the interaction force (docs/model.md, coupled axes).

With u_a = Σ_j Σ_c W_j,ac e_c⁽ʲ⁾ + ũ_a, W_j = Σ_r a_r a_rᵀ e^{g_jr}, D_ij,c = ∂_tⁱ ∂_t'ʲ k_xd,c and
V_jr = Cov[e^{g_jr}, e^{g_jr'}]:

    E[u_a]         = Σ_j Σ_c E[W_j,ac] ē_j,c
    Cov[u_a, u_b'] = Σ_ij Σ_c E[W_i,ac] E[W_j,bc'] D_ij,c
                     + Σ_j Σ_r a_ra a_rb V_jr (Σ_c a_rc² D_jj,c + (a_r·ē_j)(a_r·ē_j')) + δ_ab k_ũ,a

One sample of the input has a force along each axis: as in gpytorch's own kernels of several outputs, rows of a
covariance are samples, and within each sample its axes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from gpytorch.kernels import Kernel
from torch import Tensor

from bayes_impedance.kernels.coupled_terms import CoupledProcess, contract
from bayes_impedance.kernels.derivative import derivative_table, multiply_add
from bayes_impedance.kernels.impedance import (
    InputLayout,
    LatentCovariances,
    same_label,
)
from bayes_impedance.kernels.motion_noise import MotionNoiseKernel
from bayes_impedance.kernels.stationary import StationaryKernel
from bayes_impedance.kernels.warped import evaluate

#: D_ij,c for i, j ≤ 2, `(axes, *batch, n1, n2)` each, or `(axes, *batch, n)` of single samples.
Derivatives = list[list[Tensor]]


def join_axes(inputs: Tensor, layout: InputLayout) -> Tensor:
    """One row a sample from inputs of each axis: `(axes, groups, n, D)` to `(groups, n, D + 3 (axes − 1))`.

    The columns of the first axis, whose errors ē_j alone are its own, and after them the errors of the others.
    """
    if not layout.error:
        return inputs[0]
    return torch.cat([inputs[0], *inputs[1:, ..., list(layout.error)]], dim=-1)


def rows_of(values: Tensor) -> Tensor:
    """`(axes, …, n)` in the order of a coupled covariance, `(…, n · axes)`."""
    return values.movedim(0, -1).flatten(-2)


def by_axis(rows: Tensor, axes: int) -> Tensor:
    """What `rows_of` put in order, `(…, n · axes)`, back as `(axes, …, n)`."""
    return rows.unflatten(-1, (-1, axes)).movedim(-1, 0)


def _interleaved(blocks: Tensor) -> Tensor:
    """Blocks `(rows, columns, *batch, n1, n2)` of axes or terms as one matrix `(*batch, n1 · rows, n2 · columns)`."""
    return blocks.movedim(0, -2).movedim(0, -1).flatten(-4, -3).flatten(-2)


class _Side(NamedTuple):
    """Moments at the samples of one side of a covariance, orders 0 to 2, shaped to broadcast along the other."""

    matrices: list[Tensor]
    terms: list[Tensor]
    errors: list[Tensor] | None

    def reshaped(self, change: Callable[[Tensor], Tensor]) -> _Side:
        """The same moments, each in another shape."""
        errors = None if self.errors is None else [change(e) for e in self.errors]
        return _Side([change(m) for m in self.matrices], [change(t) for t in self.terms], errors)


class CoupledImpedanceKernel(Kernel):
    """Covariance of Σ_j W_j e⁽ʲ⁾ over orders 0, 1, 2 [N²], `(*batch, n1 · axes, n2 · axes)`.

    Args:
        layout: which input columns hold θ, θ̇, θ̈ and labels, and ē of the first axis.
        width: number of columns before those that hold ē of the others, as `join_axes` puts them.
        trajectory: covariance of x_d over θ [m²], of batch shape `(axes, *batch)`: components are independent.
        stiffness, damping, mass: priors of K [N/m], D [Ns/m], M [kg].

    Example:
        >>> layout = InputLayout(theta=(0,), theta_velocity=(1,))  # a column of time, and one of its rate, 1
        >>> two = torch.Size([2])
        >>> k, d, m = (CoupledProcess(StationaryKernel(num_dims=0, batch_shape=two), axes=2) for _ in range(3))
        >>> kernel = CoupledImpedanceKernel(layout, 2, StationaryKernel(batch_shape=two), k, d, m).double()
        >>> time = torch.linspace(0.0, 1.0, 5, dtype=torch.float64)
        >>> x = torch.stack([time, torch.ones_like(time)], dim=-1)
        >>> tuple(kernel(x).shape)
        (10, 10)

    Raises:
        TypeError: input and hyperparameters of different dtype.
    """

    def __init__(
        self,
        layout: InputLayout,
        width: int,
        trajectory: StationaryKernel,
        stiffness: CoupledProcess,
        damping: CoupledProcess,
        mass: CoupledProcess,
    ) -> None:
        super().__init__()
        self.layout = layout
        self.axes = trajectory.batch_shape[0]
        starts = range(width, width + 3 * (self.axes - 1), 3)
        others = [(start, start + 1, start + 2) for start in starts]
        #: Columns of ē_0, ē_1, ē_2 of each axis; none where they vanish.
        self.errors = [layout.error, *others] if layout.error else []
        self.trajectory = trajectory
        self.stiffness, self.damping, self.mass = stiffness, damping, mass

    @property
    def processes(self) -> tuple[CoupledProcess, ...]:
        """(K, D, M); their place is the order of the error they multiply."""
        return self.stiffness, self.damping, self.mass

    @property
    def batch_shape(self) -> torch.Size:
        """Batch of the covariance: that of the parts without their axes."""
        return self.trajectory.batch_shape[1:]

    def num_outputs_per_input(self, x1: Tensor, x2: Tensor) -> int:
        """Forces of a sample: one an axis."""
        return self.axes

    def prior_mean(self, x: Tensor) -> Tensor:
        """E[u] = Σ_j E[W_j] ē_j, `(*batch, n · axes)` [N]."""
        errors = self._errors(x)
        batch = torch.broadcast_shapes(x.shape[:-2], self.batch_shape)
        total = x.new_zeros(self.axes, *batch, x.shape[-2], 1)
        for j, process in enumerate(self.processes if errors is not None else ()):
            assert errors is not None
            total = total + (process.mean_matrices(x) * errors[j]).sum(1)
        return rows_of(total[..., 0])

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: object) -> Tensor:
        """Cov[u, u'], `(*batch, n1 · axes, n2 · axes)`, or `(*batch, n · axes)` with `diag` [N²]."""
        return self.covariance(x1, x2, self.derivatives(x1, x2, diag), diag)

    def derivatives(self, x1: Tensor, x2: Tensor, diag: bool = False) -> Derivatives:
        """D_ij,c of every component of x_d [m²/sⁱ⁺ʲ]."""
        self._check_dtype(x1, x2)
        common, table = derivative_table(
            self.trajectory, self.layout.path(x1), self.layout.path(x2), diag=diag
        )
        shared = same_label(x1, x2, self.layout.trajectory, diag)
        common = common if shared is None else common * shared
        return [[common * entry for entry in row] for row in table]

    def covariance(self, x1: Tensor, x2: Tensor, derivatives: Derivatives, diag: bool = False) -> Tensor:
        """Cov[u, u'] for given D_ij,c, to which the noise of the recorded motion may have been added [N²]."""
        one, two = self._side(x1), self._side(x2)
        if diag:
            one, two = (side.reshaped(lambda value: value[..., 0]) for side in (one, two))
        else:
            two = two.reshaped(lambda value: value.mT)
        total: Tensor | None = None
        for j in range(3):
            # Σ_i E[W_i,ac] D_ij,c, `(axes a, axes c, …)`
            column = one.matrices[0] * derivatives[0][j]
            for i in (1, 2):
                column = multiply_add(column, one.matrices[i], derivatives[i][j])
            for c in range(self.axes):
                left, right = column[:, c].unsqueeze(1), two.matrices[j][:, c].unsqueeze(0)
                total = left * right if total is None else multiply_add(total, left, right)
        assert total is not None
        total = total + contract(self.stiffness.dyads, self._spread(x1, x2, one, two, derivatives, diag))
        if diag:
            # Of the pairs of axes a sample's own: `(axes, …, n)`.
            return rows_of(total.diagonal(dim1=0, dim2=1).movedim(-1, 0))
        return _interleaved(total)

    def _spread(
        self, x1: Tensor, x2: Tensor, one: _Side, two: _Side, derivatives: Derivatives, diag: bool
    ) -> Tensor:
        """Σ_j V_jr (Σ_c a_rc² D_jj,c + (a_r·ē_j)(a_r·ē_j')), `(terms, …)`."""
        total: Tensor | None = None
        for j, process in enumerate(self.processes):
            k = process.gaussian_covariance(x1, x2, diag)
            variance = one.terms[j] * two.terms[j] * torch.expm1(k)
            product = contract(process.shares, derivatives[j][j])
            if one.errors is not None and two.errors is not None:
                ahead, behind = (contract(process.directions, e[j]) for e in (one.errors, two.errors))
                product = multiply_add(product, ahead, behind)
            total = variance * product if total is None else multiply_add(total, variance, product)
        assert total is not None
        return total

    def _side(self, x: Tensor) -> _Side:
        terms = [process.expectations(x) for process in self.processes]
        matrices = [
            contract(process.dyads, term) for process, term in zip(self.processes, terms, strict=True)
        ]
        return _Side(matrices, terms, self._errors(x))

    def _errors(self, x: Tensor) -> list[Tensor] | None:
        """ē_0, ē_1, ē_2, `(axes, *batch, n, 1)` each; None where they vanish."""
        if not self.errors:
            return None
        return [torch.stack([x[..., [columns[j]]] for columns in self.errors]) for j in range(3)]

    def trajectory_covariance(
        self, x1: Tensor, x2: Tensor, order: int, derivatives: Derivatives | None = None
    ) -> Tensor:
        """Cov[u_a, x_d,c⁽ʳ⁾'] = Σ_i E[W_i,ac] D_ir,c, r = `order`, `(*batch, n1 · axes, n2 · axes)` [N m/sʳ]."""
        derivatives = self.derivatives(x1, x2) if derivatives is None else derivatives
        total = self.processes[0].mean_matrices(x1) * derivatives[0][order]
        for i, process in enumerate(self.processes[1:], start=1):
            total = multiply_add(total, process.mean_matrices(x1), derivatives[i][order])
        return _interleaved(total)

    def trajectory_variance(self, x: Tensor, order: int, derivatives: Derivatives | None = None) -> Tensor:
        """Prior variance of x_d⁽ʳ⁾, r = `order`, `(*batch, n · axes)` [m²/s²ʳ]."""
        derivatives = self.derivatives(x, x, diag=True) if derivatives is None else derivatives
        return rows_of(derivatives[order][order])

    def loading(self, x: Tensor, order: int) -> Tensor:
        """∂E[u_a | g]/∂g_jr at the mean, a_ra (a_r·ē_j) E[e^{g_jr}], j = `order`, `(axes, terms, *batch, n, 1)` [N]."""
        process = self.processes[order]
        expected = process.expectations(x)
        errors = self._errors(x)
        if errors is None:
            batch = torch.broadcast_shapes(x.shape[:-2], self.batch_shape)
            return x.new_zeros(self.axes, len(process.shares), *batch, x.shape[-2], 1)
        along = contract(process.directions, errors[order]) * expected
        return process.directions.mT.reshape(self.axes, -1, *[1] * (along.ndim - 1)) * along

    def row_loading(self, x: Tensor, order: int, weights: Tensor | float = 1.0) -> Tensor:
        """`loading` times `weights` `(terms, *batch, n, 1)`, rows as in a covariance: `(*batch, n · axes, terms)`."""
        blocks = (self.loading(x, order) * weights)[..., 0]
        return blocks.movedim(1, -1).movedim(0, -2).flatten(-3, -2)

    def impedance_covariance(self, x1: Tensor, x2: Tensor, order: int) -> Tensor:
        """Cov[u_a, g_jr'], j = `order`: `loading` times k_r, `(*batch, n1 · axes, n2 · terms)` [N]."""
        product = self.loading(x1, order) * self.processes[order].gaussian_covariance(x1, x2)
        return _interleaved(product.expand(*product.shape[:-1], x2.shape[-2]))

    def _check_dtype(self, *inputs: Tensor) -> None:
        for x in inputs:
            if x.dtype != self.dtype:
                raise TypeError(
                    f"expected inputs of the dtype {self.dtype} of the coupled hyperparameters, got {x.dtype}: "
                    "convert both with .double()"
                )


class CoupledInteractionKernel(LatentCovariances):
    """Coupled impedance plus a residual force of each axis [N²], `(*batch, n1 · axes, n2 · axes)`.

    Args:
        impedance: covariance of the impedance force.
        residual: any gpytorch kernel for ũ, of batch shape `(axes, *batch)`; None for no residual.
        motion_noise: noise of the recorded motion, of batch shape `(axes, *batch)` and without processes; None where it
            is left out. Noise η̂_c of an axis acts through W_j as x_d,c does: its covariance is added to D_ij,c.
    """

    def __init__(
        self,
        impedance: CoupledImpedanceKernel,
        residual: Kernel | None = None,
        motion_noise: MotionNoiseKernel | None = None,
    ) -> None:
        super().__init__()
        self.impedance, self.residual, self.motion_noise = impedance, residual, motion_noise

    @property
    def batch_shape(self) -> torch.Size:
        """Batch of the covariance: that of the parts without their axes."""
        return self.impedance.batch_shape

    def num_outputs_per_input(self, x1: Tensor, x2: Tensor) -> int:
        """Forces of a sample: one an axis."""
        return self.impedance.axes

    def covariance(self, x1: Tensor, x2: Tensor, derivatives: Derivatives, diag: bool = False) -> Tensor:
        """Cov[u, u'] for `derivatives` of x_d alone, `(*batch, n1 · axes, n2 · axes)`, or `(*batch, n · axes)` [N²]."""
        if self.motion_noise is not None:
            variance = self.motion_noise.sd.square()
            smoothed = self.motion_noise.smoothed(x1, x2, diag)
            scale = variance[..., 0] if diag else variance
            derivatives = [
                [entry + scale * smoothed[..., i, j] for j, entry in enumerate(row)]
                for i, row in enumerate(derivatives)
            ]
        total = self.impedance.covariance(x1, x2, derivatives, diag)
        return total if self.residual is None else total + self.residual_covariance(x1, x2, diag)

    def residual_covariance(self, x1: Tensor, x2: Tensor, diag: bool = False) -> Tensor:
        """δ_ab k_ũ,a, zero between samples whose residual labels differ [N²]."""
        own = self.axis_residuals(x1, x2, diag)
        if diag:
            return rows_of(own)
        blocks = torch.diag_embed(own.movedim(0, -1), dim1=-3, dim2=-1)
        return blocks.flatten(-4, -3).flatten(-2)

    def axis_residuals(self, x1: Tensor, x2: Tensor, diag: bool = False) -> Tensor:
        """k_ũ of each axis, `(axes, *batch, n1, n2)` or `(axes, *batch, n)` [N²]."""
        batch = torch.broadcast_shapes(x1.shape[:-2], x2.shape[:-2], self.batch_shape)
        size = x1.shape[-2:-1] if diag else (x1.shape[-2], x2.shape[-2])
        shape = (self.impedance.axes, *batch, *size)
        if self.residual is None:
            return x1.new_zeros(shape)
        k = evaluate(self.residual, x1, x2, diag)
        shared = same_label(x1, x2, self.impedance.layout.residual, diag)
        return (k if shared is None else k * shared).expand(shape)
