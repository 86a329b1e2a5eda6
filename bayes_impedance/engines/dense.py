"""Exact inference with dense covariance matrices, formed in row blocks (docs/model.md §7).

Plain autograd keeps every intermediate n × n matrix of the kernel. Here the covariance is filled block
by block without a graph, and the backward pass forms each block again, with one, to contract it with
∂ log p/∂K; only the lower triangle is ever formed. Memory is a few n × n matrices whatever the kernel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from gpytorch.kernels import Kernel
from torch import Tensor

from bayes_impedance.errors import NotPositiveDefiniteError, TooManySamplesError
from bayes_impedance.kernels.warped import evaluate

#: Entries of a block: large enough to hide the cost of a call, small enough to stay in the cache.
BLOCK_ENTRIES = 2**17


@dataclass(frozen=True)
class Observations:
    """What the dense engine conditions on.

    `inputs` `(*batch, n, D)`; `residual` u − E[u] `(*batch, n)` [N]; `noise_variance` σ_r² `(*batch, 1)`
    [N²]; `valid` `(*batch, n)` is False where a sample only pads a batch of groups of unequal length. Of a kernel with
    q outputs an input, which has q rows a sample, `residual`, `valid` and `noise_variance` are `(*batch, n · q)`.
    """

    inputs: Tensor
    residual: Tensor
    noise_variance: Tensor
    valid: Tensor | None = None

    @property
    def count(self) -> Tensor:
        """Samples of each batch entry, padding left out."""
        n = self.residual.shape[-1]
        return self.residual.new_tensor(n) if self.valid is None else self.valid.sum(-1).to(self.residual)


def log_marginal_likelihood(kernel: Kernel, observations: Observations, jitter: float = 0.0) -> Tensor:
    """log N(u; E[u], K + σ_r² I), `(*batch,)` [nats], differentiable in kernel, residual and noise.

    `jitter` is added to the diagonal relative to the mean prior variance.

    Raises:
        NotPositiveDefiniteError: no Cholesky factor at this jitter.
    """
    forms, log_det = quadratic_forms(kernel, observations, observations.residual.unsqueeze(-1), jitter)
    return log_density(forms[..., 0, 0], log_det, observations)


def quadratic_forms(
    kernel: Kernel, observations: Observations, columns: Tensor, jitter: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Bᵀ (K + σ_r² I)⁻¹ B and log det (K + σ_r² I) for `columns` B `(*batch, n, c)`: `(*batch, c, c)`, `(*batch,)`.

    Differentiable in kernel, noise and columns; `jitter` as in `log_marginal_likelihood`.

    Raises:
        NotPositiveDefiniteError: no Cholesky factor at this jitter.
    """
    parameters = [p for p in kernel.parameters() if p.requires_grad]
    forms, log_det = _QuadraticForms.apply(
        kernel, observations, jitter, columns, observations.noise_variance, *parameters
    )
    return forms, log_det


def log_density(form: Tensor, log_det: Tensor, observations: Observations) -> Tensor:
    """log N(u; E[u], K + σ_r² I) from `form` rᵀ(K + σ_r² I)⁻¹r and the log determinant, `(*batch,)` [nats]."""
    return -0.5 * (form + log_det + observations.count * math.log(2.0 * math.pi))


class Factor:
    """Cholesky factor L of K + σ_r² I and α = (K + σ_r² I)⁻¹ (u − E[u]), computed once and kept.

    Raises:
        NotPositiveDefiniteError: no Cholesky factor at this jitter.
    """

    def __init__(self, kernel: Kernel, observations: Observations, jitter: float = 0.0) -> None:
        with torch.no_grad():
            self.cholesky = _cholesky(kernel, observations, jitter)
            residual = _masked(observations.residual, observations.valid)
            self.valid = observations.valid
            self.alpha = torch.cholesky_solve(residual.unsqueeze(-1), self.cholesky).squeeze(-1)

    def whiten(self, columns: Tensor) -> Tensor:
        """L⁻¹ `columns`, `(*batch, n, m)`; products of two such are inner products in (K + σ_r² I)⁻¹."""
        return torch.linalg.solve_triangular(self.cholesky, _masked_rows(columns, self.valid), upper=False)


def check_capacity(n: int, limit: int, where: str) -> None:
    """Refuse more samples than the engine may hold, with what they would cost.

    Raises:
        TooManySamplesError: n > limit.
    """
    if n > limit:
        gigabytes = 4 * 8 * n**2 / 1e9
        # Measured on two cores: forming the entries, and factor and inverse.
        seconds = 1.2e-7 * n**2 + 2.5e-11 * n**3
        raise TooManySamplesError(
            f"{where}: expected at most engine.max_samples = {limit} samples in a group for the dense engine, "
            f"got {n}, which would need about {gigabytes:.1f} GB and {seconds:.1f} s an evaluation; "
            f"set preprocessing.rate to thin the log, cut it with log.window, or raise engine.max_samples"
        )


class _QuadraticForms(torch.autograd.Function):
    """Bᵀ K⁻¹ B, log det K and their gradients; that of K is contracted block by block."""

    @staticmethod
    def forward(
        ctx: Any, kernel: Kernel, observations: Observations, jitter: float,
        columns: Tensor, noise_variance: Tensor, *parameters: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        cholesky = _cholesky(kernel, observations, jitter)
        masked = _masked_rows(columns, observations.valid)
        solved = torch.cholesky_solve(masked, cholesky)
        log_det = 2.0 * cholesky.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        ctx.kernel, ctx.observations, ctx.shape = kernel, observations, columns.shape
        ctx.save_for_backward(cholesky, solved)
        return masked.mT @ solved, log_det

    @staticmethod
    def backward(ctx: Any, grad_forms: Tensor, grad_log_det: Tensor) -> tuple[Any, ...]:
        kernel, observations = ctx.kernel, ctx.observations
        cholesky, solved = ctx.saved_tensors
        valid = observations.valid
        # d(BᵀK⁻¹B) = dBᵀA + AᵀdB − AᵀdK A with A = K⁻¹B, d log det K = tr K⁻¹dK
        symmetric = grad_forms + grad_forms.mT
        column_gradient = _sum_to(_masked_rows(solved @ symmetric, valid), ctx.shape)
        weight = torch.cholesky_inverse(cholesky).mul_(grad_log_det[..., None, None])
        weight.sub_(0.5 * (solved @ symmetric) @ solved.mT)
        diagonal = weight.diagonal(dim1=-2, dim2=-1)
        noise_gradient = _masked(diagonal, valid)
        if observations.noise_variance.shape[-1] == 1:
            noise_gradient = noise_gradient.sum(-1, keepdim=True)
        noise_gradient = _sum_to(noise_gradient, observations.noise_variance.shape)

        parameters = [p for p in kernel.parameters() if p.requires_grad]
        gradients = [torch.zeros_like(p) for p in parameters]
        outputs = _outputs(kernel, observations.inputs)
        for start, stop in _blocks(observations.inputs, outputs) if parameters else ():
            first, last = start * outputs, stop * outputs
            block_weight = _masked_block(weight[..., first:last, :last], valid, first, last)
            # Below the diagonal each entry stands for itself and for its mirror image.
            block_weight[..., :first].mul_(2.0)
            with torch.enable_grad():
                block = _block(kernel, observations.inputs, start, stop)
                parts = torch.autograd.grad(
                    block, parameters, block_weight.expand_as(block), allow_unused=True
                )
            for total, part in zip(gradients, parts, strict=True):
                if part is not None:
                    total.add_(part)
        return (None, None, None, column_gradient, noise_gradient, *gradients)


def _cholesky(kernel: Kernel, observations: Observations, jitter: float) -> Tensor:
    inputs, valid = observations.inputs, observations.valid
    outputs = _outputs(kernel, inputs)
    n = inputs.shape[-2] * outputs
    batch = torch.broadcast_shapes(inputs.shape[:-2], kernel.batch_shape, observations.residual.shape[:-1])
    covariance = inputs.new_zeros(*batch, n, n)
    for start, stop in _blocks(inputs, outputs):
        first, last = start * outputs, stop * outputs
        block = _block(kernel, inputs, start, stop)
        covariance[..., first:last, :last] = _masked_block(block, valid, first, last)
    diagonal = covariance.diagonal(dim1=-2, dim2=-1)
    count = n if valid is None else valid.sum(-1, keepdim=True)
    added = jitter * diagonal.sum(-1, keepdim=True) / count + observations.noise_variance
    diagonal.add_(added if valid is None else torch.where(valid, added, 1.0))
    cholesky, info = torch.linalg.cholesky_ex(covariance)
    if bool(info.any()):
        row = int(info.max())
        raise NotPositiveDefiniteError(
            f"the covariance of {n} forces is not positive definite at row {row} with jitter {jitter:g} of the "
            "mean prior variance; raise engine.jitter tenfold, or model.noise_sd, or thin the log with "
            "preprocessing.rate"
        )
    return cholesky


def _block(kernel: Kernel, inputs: Tensor, start: int, stop: int) -> Tensor:
    return evaluate(kernel, inputs[..., start:stop, :], inputs[..., :stop, :])


def _outputs(kernel: Kernel, inputs: Tensor) -> int:
    """Rows of the covariance that belong to one input."""
    return int(kernel.num_outputs_per_input(inputs, inputs))


def _blocks(inputs: Tensor, outputs: int) -> Iterator[tuple[int, int]]:
    n = inputs.shape[-2]
    rows = max(16, BLOCK_ENTRIES // max(1, n * outputs**2 * math.prod(inputs.shape[:-2])))
    for start in range(0, n, rows):
        yield start, min(start + rows, n)


def _masked(values: Tensor, valid: Tensor | None) -> Tensor:
    return values if valid is None else values * valid


def _masked_rows(columns: Tensor, valid: Tensor | None) -> Tensor:
    return columns if valid is None else columns * valid.unsqueeze(-1)


def _masked_block(block: Tensor, valid: Tensor | None, start: int, stop: int) -> Tensor:
    """The block with the rows and columns of padding at zero; always a copy that may be written to."""
    if valid is None:
        return block.clone() if block.requires_grad is False else block
    return block * valid[..., start:stop, None] * valid[..., None, :stop]


def _sum_to(values: Tensor, shape: torch.Size) -> Tensor:
    """Sum over the dimensions along which `shape` was broadcast."""
    return values.sum_to_size(shape) if values.shape != shape else values
