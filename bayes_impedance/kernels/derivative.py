"""Time derivatives of a stationary covariance along recorded paths θ(t), by the chain rule (docs/model.md §3).

∂_tⁱ ∂_t'ʲ k(θ(t), θ(t')) for i, j ≤ 2 is κ and its derivatives times bilinear forms of θ, a = dθ/dt and
b = d²θ/dt². The forms are thin matrix products; the rest is one pass over the n × n' entries.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from bayes_impedance.kernels.stationary import (
    Profile,
    Stationary,
    half_squared_distance,
    stack_columns,
)


class Path(NamedTuple):
    """θ, dθ/dt and d²θ/dt² at n samples, each `(..., n, p)`; `acceleration` None stands for zero."""

    theta: Tensor
    velocity: Tensor
    acceleration: Tensor | None


class Forms(NamedTuple):
    """s and its time derivatives s_ij = ∂_tⁱ ∂_t'ʲ s, each `(..., n1, n2)`; None stands for zero."""

    s: Any
    s10: Any
    s01: Any
    s11: Any
    s20: Any
    s02: Any
    s21: Any
    s12: Any
    s22: Any


#: Entries are tensors, floats where they are constant, or NumPy arrays in one-point prediction.
Table = list[list[Any]]


def derivative_table(
    kernel: Stationary, path1: Path, path2: Path, order: int = 2, diag: bool = False
) -> tuple[Tensor, Table]:
    """∂_tⁱ ∂_t'ʲ k = `common` · `table[i][j]` for i, j ≤ `order` ≤ 2.

    Entries are `(..., n1, n2)`, or `(..., n)` with `diag`, in [unit of k / sⁱ⁺ʲ]. The common factor is
    kept apart so that sums over i, j are formed before the one multiplication by it.
    """
    if (path1.acceleration is None) != (path2.acceleration is None):
        path1, path2 = _with_acceleration(path1), _with_acceleration(path2)
    forms = _forms_diagonal(kernel, path1, path2) if diag else _forms(kernel, path1, path2)
    variance = kernel.sd**2
    shape = kernel.shape
    if diag:
        variance = variance[..., 0]
        shape = None if shape is None else shape[..., 0]
    common, ratios = kernel.profile.derivatives(forms.s, shape)
    return variance * common, combine(kernel.profile, forms, ratios, order)


def _with_acceleration(path: Path) -> Path:
    return path if path.acceleration is not None else path._replace(acceleration=torch.zeros_like(path.theta))


def combine(profile: Profile, forms: Forms, ratios: tuple[Any, ...], order: int) -> Table:
    """The derivatives over the common factor, from the bilinear forms and the ratios κ⁽ⁿ⁾/κ̃."""
    if profile.is_exponential:
        return _table_exponential(forms, order)
    return _table(forms, ratios, order)


def multiply_add(total: Any, a: Any, b: Any, value: float = 1.0) -> Any:
    """`total` + `value` · a · b for tensors in one pass, and for NumPy arrays, which one-point prediction uses."""
    if isinstance(total, Tensor) and isinstance(a, Tensor) and isinstance(b, Tensor):
        return torch.addcmul(total, a, b, value=value)
    return total + a * b if value == 1.0 else total + value * (a * b)


def _table(forms: Forms, ratios: tuple[Any, ...], order: int) -> Table:
    """The nine derivatives over the common factor, from the ratios κ⁽ⁿ⁾/κ̃."""
    r0, r1, r2, r3, r4 = ratios
    s10, s01, s11 = forms.s10, forms.s01, forms.s11
    s10s01 = s10 * s01
    k00 = r0
    k10, k01 = r1 * s10, r1 * s01
    k11 = r2 * s10s01 + r1 * s11
    if order == 1:
        return [[k00, k01], [k10, k11]]
    s20, s02 = forms.s20, forms.s02
    s10s10, s01s01 = s10 * s10, s01 * s01
    # k20 = κ'' s10² + κ' s20
    k20 = r2 * s10s10 + r1 * s20
    k02 = r2 * s01s01 + r1 * s02
    # k21 = κ''' s10² s01 + κ'' (2 s10 s11 + s20 s01) + κ' s21
    k21 = r3 * (s10s10 * s01) + r2 * (2.0 * s10 * s11 + s20 * s01)
    k12 = r3 * (s01s01 * s10) + r2 * (2.0 * s01 * s11 + s02 * s10)
    # k22 = κ'''' s10² s01² + κ''' (s10² s02 + 4 s10 s01 s11 + s20 s01²)
    #       + κ'' (2 s10 s12 + 2 s01 s21 + 2 s11² + s20 s02) + κ' s22
    second = 2.0 * s11 * s11 + s20 * s02
    if forms.s21 is not None and forms.s12 is not None:
        second = second + 2.0 * (s10 * forms.s12 + s01 * forms.s21)
        k21 = k21 + r1 * forms.s21
        k12 = k12 + r1 * forms.s12
    third = s10s10 * s02 + 4.0 * s10s01 * s11 + s20 * s01s01
    k22 = r4 * (s10s10 * s01s01) + r3 * third + r2 * second
    if forms.s22 is not None:
        k22 = k22 + r1 * forms.s22
    return [[k00, k01, k02], [k10, k11, k12], [k20, k21, k22]]


def _table_exponential(forms: Forms, order: int) -> Table:
    """The same for κ⁽ⁿ⁾ = (−1)ⁿ κ, where the sums collapse; this is what training spends its time on."""
    s10, s01, s11 = forms.s10, forms.s01, forms.s11
    k00 = 1.0
    k10, k01 = -s10, -s01
    k11 = multiply_add(-s11, s10, s01)
    if order == 1:
        return [[k00, k01], [k10, k11]]
    k20 = multiply_add(-forms.s20, s10, s10)
    k02 = multiply_add(-forms.s02, s01, s01)
    # k21 = −s01 k20 + 2 s10 s11 − s21
    k21 = multiply_add(k01 * k20, s10, s11, value=2.0)
    k12 = multiply_add(k10 * k02, s01, s11, value=2.0)
    # k22 = k20 k02 + 2 s11 (s11 − 2 s10 s01) + 2 s10 s12 + 2 s01 s21 − s22
    k22 = multiply_add(k20 * k02, s11, multiply_add(s11, s10, s01, value=-2.0), value=2.0)
    if forms.s21 is not None and forms.s12 is not None and forms.s22 is not None:
        k21, k12 = k21 - forms.s21, k12 - forms.s12
        k22 = (
            multiply_add(multiply_add(k22, s10, forms.s12, value=2.0), s01, forms.s21, value=2.0) - forms.s22
        )
    return [[k00, k01, k02], [k10, k11, k12], [k20, k21, k22]]


def _forms(kernel: Stationary, path1: Path, path2: Path) -> Forms:
    theta1, a1, b1 = path1
    theta2, a2, b2 = path2
    p = theta1.shape[-1]
    weights = kernel.precision.expand(*kernel.precision.shape[:-1], p)
    a1w, a2w = a1 * weights, a2 * weights
    speed1 = (a1w * a1).sum(-1).unsqueeze(-1)  # A = aᵀPa
    speed2 = (a2w * a2).sum(-1).unsqueeze(-2)
    s11 = -(a1w @ a2.mT)
    b1w = None if b1 is None else b1 * weights
    b2w = None if b2 is None else b2 * weights
    if kernel.profile.exact_distance or p == 1:
        s, alpha1, alpha2, beta1, beta2 = _projections_exact(theta1, theta2, weights, a1w, a2w, b1w, b2w)
    else:
        s, alpha1, alpha2, beta1, beta2 = _projections(theta1, theta2, weights, a1w, a2w, b1w, b2w)
    s20 = speed1 if beta1 is None else speed1 + beta1
    s02 = speed2 if beta2 is None else speed2 - beta2
    s21 = s12 = s22 = None
    if b1 is not None and b1w is not None and b2 is not None:
        s21, s12, s22 = -(b1w @ a2.mT), -(a1w @ b2.mT), -(b1w @ b2.mT)
    return Forms(s, alpha1, -alpha2, s11, s20, s02, s21, s12, s22)


Projections = tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor | None]


def _projections(
    theta1: Tensor, theta2: Tensor, weights: Tensor,
    a1w: Tensor, a2w: Tensor, b1w: Tensor | None, b2w: Tensor | None,
) -> Projections:  # fmt: skip
    """s, α = aᵀPr, α' = a'ᵀPr, β, β' as matrix products; a column of ones carries the rank-one terms."""
    # Centring keeps the cancellation in θ − θ' small far from the origin.
    centre = theta1.mean(dim=-2, keepdim=True)
    theta1, theta2 = theta1 - centre, theta2 - centre
    one1, one2 = torch.ones_like(theta1[..., :1]), torch.ones_like(theta2[..., :1])
    left, right = stack_columns(theta1, -one1), stack_columns(-theta2, one2).mT

    def from_left(v: Tensor) -> Tensor:
        return stack_columns(v, (v * theta1).sum(-1, keepdim=True)) @ right

    def from_right(v: Tensor) -> Tensor:
        return left @ stack_columns(v, (v * theta2).sum(-1, keepdim=True)).mT

    s = half_squared_distance(theta1, theta2, weights, exact=False)
    beta1 = None if b1w is None else from_left(b1w)
    beta2 = None if b2w is None else from_right(b2w)
    return s, from_left(a1w), from_right(a2w), beta1, beta2


def _projections_exact(
    theta1: Tensor, theta2: Tensor, weights: Tensor,
    a1w: Tensor, a2w: Tensor, b1w: Tensor | None, b2w: Tensor | None,
) -> Projections:  # fmt: skip
    """The same from r = θ − θ' itself, one component after another."""
    columns = range(theta1.shape[-1])
    differences = [theta1[..., :, c].unsqueeze(-1) - theta2[..., :, c].unsqueeze(-2) for c in columns]

    def from_left(v: Tensor) -> Tensor:
        return _sum([v[..., c].unsqueeze(-1) * differences[c] for c in columns])

    def from_right(v: Tensor) -> Tensor:
        return _sum([v[..., c].unsqueeze(-2) * differences[c] for c in columns])

    s = _sum([(0.5 * weights[..., c].unsqueeze(-1)) * differences[c] ** 2 for c in columns])
    beta1 = None if b1w is None else from_left(b1w)
    beta2 = None if b2w is None else from_right(b2w)
    return s, from_left(a1w), from_right(a2w), beta1, beta2


def _forms_diagonal(kernel: Stationary, path1: Path, path2: Path) -> Forms:
    """The forms at θ = θ' sample by sample, `(..., n)`: r = 0, so α = β = 0."""
    _, a1, b1 = path1
    _, a2, b2 = path2
    weights = kernel.precision.expand(*kernel.precision.shape[:-1], a1.shape[-1])

    def dot(u: Tensor, v: Tensor) -> Tensor:
        return (u * weights * v).sum(-1)

    speed = dot(a1, a2)
    zero = torch.zeros_like(speed)
    s21 = s12 = s22 = None
    if b1 is not None and b2 is not None:
        s21, s12, s22 = -dot(b1, a2), -dot(a1, b2), -dot(b1, b2)
    return Forms(zero, zero, zero, -speed, dot(a1, a1), dot(a2, a2), s21, s12, s22)


def _sum(terms: list[Tensor]) -> Tensor:
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total
