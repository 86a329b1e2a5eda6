"""Stationary covariances κ(s), s = ½ (θ−θ')ᵀ P (θ−θ'), P = diag(1/ℓ²), and the derivatives of κ.

Each profile states κ and κ⁽ⁿ⁾/κ̃ for one pair, where κ̃ is a factor common to all orders (e^{−s}, say);
shapes, batches and hyperparameters live in `StationaryKernel`.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Self

import torch
from gpytorch import Module
from gpytorch.constraints import Interval, Positive
from gpytorch.kernels import Kernel
from gpytorch.priors import Prior
from torch import Tensor

Ratio = Tensor | float


class ProfileDerivatives(NamedTuple):
    """κ⁽ⁿ⁾(s) = `common` · `ratios[n]`, n = 0 … 4, for unit variance."""

    common: Tensor
    ratios: tuple[Ratio, Ratio, Ratio, Ratio, Ratio]


class Profile(ABC):
    """κ as a function of s, for unit variance."""

    #: True where κ or its derivatives have a square root in s: then θ−θ' is formed exactly rather than
    #: from |θ|² + |θ'|² − 2θᵀθ', whose rounding of 1e-16 in s would become 1e-8 in √s.
    exact_distance: ClassVar[bool] = False
    has_shape: ClassVar[bool] = False
    #: True where κ⁽ⁿ⁾ = (−1)ⁿ κ: the sums over derivatives then collapse.
    is_exponential: ClassVar[bool] = False

    @abstractmethod
    def value(self, s: Tensor, shape: Tensor | None = None) -> Tensor:
        """κ(s)."""

    @abstractmethod
    def derivatives(self, s: Tensor, shape: Tensor | None = None) -> ProfileDerivatives:
        """κ and its first four derivatives with respect to s."""


class SquaredExponential(Profile):
    """κ = e^{−s}, κ⁽ⁿ⁾ = (−1)ⁿ κ."""

    is_exponential: ClassVar[bool] = True

    def value(self, s: Tensor, shape: Tensor | None = None) -> Tensor:
        """κ(s) = e^{−s}."""
        return torch.exp(-s)

    def derivatives(self, s: Tensor, shape: Tensor | None = None) -> ProfileDerivatives:
        """Common factor e^{−s}, ratios ±1."""
        return ProfileDerivatives(torch.exp(-s), (1.0, -1.0, 1.0, -1.0, 1.0))


class RationalQuadratic(Profile):
    """κ = (1 + s/α)^{−α}, κ⁽ⁿ⁾ = (−1)ⁿ α(α+1)…(α+n−1)/αⁿ (1 + s/α)^{−α−n}; α is `shape`."""

    has_shape: ClassVar[bool] = True

    def value(self, s: Tensor, shape: Tensor | None = None) -> Tensor:
        """κ(s) = (1 + s/α)^{−α}."""
        assert shape is not None
        return torch.exp(-shape * torch.log1p(s / shape))

    def derivatives(self, s: Tensor, shape: Tensor | None = None) -> ProfileDerivatives:
        """Common factor κ, ratios by the recursion r_{n+1} = −r_n (1 + n/α) / (1 + s/α)."""
        assert shape is not None
        step = -1.0 / (1.0 + s / shape)
        r1 = step
        r2 = r1 * step * (1.0 + 1.0 / shape)
        r3 = r2 * step * (1.0 + 2.0 / shape)
        r4 = r3 * step * (1.0 + 3.0 / shape)
        return ProfileDerivatives(self.value(s, shape), (1.0, r1, r2, r3, r4))


def _bessel_polynomial(order: int, z: Tensor) -> Tensor | float:
    """z^ν K_ν(z) e^z √(2/π) at ν = order + ½, from ν = −3/2 up to 9/2."""
    match order:
        case -2:
            return (1.0 + z) / z**3
        case -1:
            return 1.0 / z
        case 0:
            return 1.0
        case 1:
            return 1.0 + z
        case 2:
            return 3.0 + z * (3.0 + z)
        case 3:
            return 15.0 + z * (15.0 + z * (6.0 + z))
        case _:
            return 105.0 + z * (105.0 + z * (45.0 + z * (10.0 + z)))


class Matern(Profile):
    """Matérn with ν = 1/2 … 9/2: κ⁽ⁿ⁾ = (−2ν)ⁿ G_{ν−n}(z) / G_ν(0), G_ν = z^ν K_ν(z), z = √(4νs).

    For ν = 5/2 the third and fourth derivative diverge as z → 0, yet every product in which
    they occur vanishes there; so z is kept off zero by 1e-12, where those products are below rounding.
    Below ν = 5/2 no desired trajectory has an acceleration: these are for residual forces.
    """

    exact_distance: ClassVar[bool] = True

    def __init__(self, nu: float) -> None:
        if nu not in (0.5, 1.5, 2.5, 3.5, 4.5):
            raise ValueError(f"nu: expected 0.5, 1.5, 2.5, 3.5 or 4.5, got {nu!r}")
        self.nu = nu
        self.degree = round(nu - 0.5)
        self.norm = (1.0, 1.0, 3.0, 15.0, 105.0)[self.degree]

    def _z(self, s: Tensor) -> Tensor:
        return torch.sqrt((4.0 * self.nu) * s.clamp_min(1e-24))

    def value(self, s: Tensor, shape: Tensor | None = None) -> Tensor:
        """κ(s)."""
        z = self._z(s)
        return torch.exp(-z) * _bessel_polynomial(self.degree, z) / self.norm

    def derivatives(self, s: Tensor, shape: Tensor | None = None) -> ProfileDerivatives:
        """Common factor e^{−z}.

        Raises:
            ValueError: ν < 5/2, where a process has no acceleration.
        """
        if self.degree < 2:
            raise ValueError(
                f"expected a Matérn profile with nu of 2.5 or more, whose process has an acceleration, got {self.nu}; "
                "take matern52"
            )
        z = self._z(s)
        ratios = [
            (-2.0 * self.nu) ** n / self.norm * _bessel_polynomial(self.degree - n, z) for n in range(5)
        ]
        return ProfileDerivatives(torch.exp(-z), (ratios[0], ratios[1], ratios[2], ratios[3], ratios[4]))


#: Profiles by the name that configurations give them.
PROFILES: dict[str, Profile] = {
    "squared_exponential": SquaredExponential(),
    "rational_quadratic": RationalQuadratic(),
    "matern12": Matern(0.5),
    "matern32": Matern(1.5),
    "matern52": Matern(2.5),
    "matern72": Matern(3.5),
    "matern92": Matern(4.5),
}


def log_positive() -> Positive:
    """Constraint whose unconstrained value is the logarithm: scales then enter the optimiser evenly."""
    return Positive(transform=torch.exp, inv_transform=torch.log)


class BatchedKernel(Kernel):
    """Base of our kernels: indexing and expanding the batch of a whole tree of kernels.

    gpytorch's own versions index the buffer `active_dims` as though it were a hyperparameter, and leave the
    batch shape of a kernel without hyperparameters of its own as it was.
    """

    def __getitem__(self, index: Any) -> Self:
        """Kernel of some entries of the batch."""
        if not self.batch_shape:
            return self
        index = index if isinstance(index, tuple) else (index,)
        return self._with_batch(lambda batch: torch.empty(batch)[index].shape, lambda p, _: p[index])

    def expand_batch(self, *sizes: Any) -> Self:
        """Kernel whose batch is broadcast to `sizes`."""
        shape = torch.Size(sizes[0] if len(sizes) == 1 and not isinstance(sizes[0], int) else sizes)
        if shape == self.batch_shape:
            return self
        return self._with_batch(lambda _: shape, lambda p, batch: p.expand(*shape, *p.shape[len(batch) :]))

    def _with_batch(
        self, shape: Callable[[torch.Size], torch.Size], change: Callable[[Tensor, torch.Size], Tensor]
    ) -> Self:
        new = copy.deepcopy(self)
        kernels = [module for module in new.modules() if isinstance(module, Kernel)]
        # Before any change: the batch of a kernel is that of its parts, too.
        for kernel, batch in [(kernel, kernel.batch_shape) for kernel in kernels]:
            for parameter in kernel.parameters(recurse=False):
                parameter.data = change(parameter.data, batch)
            kernel._batch_shape = shape(batch)
        return new


class StationaryKernel(BatchedKernel):
    """σ² κ(s) over the `active_dims` of the input; with no dimensions it is the constant σ².

    `sd` σ has shape `(*batch, 1, 1)` [unit of the process]; `lengthscale` ℓ has `(*batch, 1, p)` [unit of
    each input]; `shape` α, of the rational quadratic only, has `(*batch, 1, 1)`.

    Args:
        profile: name of a profile in `PROFILES`.
        num_dims: p, the number of active dimensions; 0 for a constant.
        ard: one length scale a dimension (True) or one for all.
        sd_prior, lengthscale_prior, shape_prior: priors of the hyperparameters.
        sd_constraint, lengthscale_constraint: constraints; default positive, on a log scale.

    Example:
        >>> kernel = StationaryKernel("matern52").double()
        >>> kernel.sd, kernel.lengthscale = 2.0, 0.3
        >>> time = torch.linspace(0.0, 1.0, 5, dtype=torch.float64).unsqueeze(-1)
        >>> covariance = kernel(time).to_dense()
        >>> tuple(covariance.shape), round(covariance[0, 0].item(), 6)
        ((5, 5), 4.0)

    Raises:
        ValueError: an unknown profile.
    """

    def __init__(
        self,
        profile: str = "squared_exponential",
        num_dims: int = 1,
        ard: bool = True,
        batch_shape: torch.Size | None = None,
        active_dims: tuple[int, ...] | None = None,
        sd_prior: Prior | None = None,
        sd_constraint: Interval | None = None,
        lengthscale_prior: Prior | None = None,
        lengthscale_constraint: Interval | None = None,
        shape_prior: Prior | None = None,
    ) -> None:
        if profile not in PROFILES:
            raise ValueError(f"profile: expected one of {', '.join(PROFILES)}, got {profile!r}")
        # gpytorch reads this flag off the instance while it registers the length scale.
        self.has_lengthscale = num_dims > 0
        super().__init__(
            ard_num_dims=num_dims if ard and num_dims > 0 else None,
            batch_shape=batch_shape,
            active_dims=active_dims,
            lengthscale_prior=lengthscale_prior if num_dims > 0 else None,
            lengthscale_constraint=lengthscale_constraint or log_positive(),
        )
        self.profile = PROFILES[profile]
        self.num_dims = num_dims
        register_positive(self, "sd", self.batch_shape, sd_prior, sd_constraint)
        if self.profile.has_shape:
            register_positive(self, "shape", self.batch_shape, shape_prior, None)

    @property
    def sd(self) -> Tensor:
        """σ, `(*batch, 1, 1)`."""
        return self.raw_sd_constraint.transform(self.raw_sd)

    @sd.setter
    def sd(self, value: Tensor | float) -> None:
        set_positive(self, "sd", value)

    @property
    def shape(self) -> Tensor | None:
        """α of the rational quadratic, `(*batch, 1, 1)`; None for the others."""
        return self.raw_shape_constraint.transform(self.raw_shape) if self.profile.has_shape else None

    @shape.setter
    def shape(self, value: Tensor | float) -> None:
        set_positive(self, "shape", value)

    def _set_lengthscale(self, value: Tensor | float) -> None:
        # As gpytorch does it, but not by way of single precision.
        super()._set_lengthscale(torch.as_tensor(value, dtype=self.raw_lengthscale.dtype))

    @property
    def precision(self) -> Tensor:
        """Diagonal of P = 1/ℓ², `(*batch, 1, p)` or `(*batch, 1, 1)`."""
        return self.lengthscale**-2

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: object) -> Tensor:
        """σ² κ(s), `(..., n1, n2)`, or `(..., n)` with `diag`."""
        return _covariance(self, x1, x2, diag)


@dataclass(frozen=True)
class StationaryCovariance:
    """What a `StationaryKernel` computes, with hyperparameters that are plain tensors of anybody's own.

    `sd`, `lengthscale`, `shape` as those of the kernel; `active_dims` `(p,)`, None for all columns. For inference that
    evaluates a covariance at thousands of hyperparameters: gradients reach wherever these came from, and no module is
    copied or changed.
    """

    profile: Profile
    num_dims: int
    active_dims: Tensor | None
    sd: Tensor
    lengthscale: Tensor
    shape: Tensor | None = None

    @classmethod
    def like(
        cls, kernel: Stationary, sd: Tensor, lengthscale: Tensor | None, shape: Tensor | None = None
    ) -> Self:
        """Profile and inputs of `kernel` with other hyperparameters; a constant has no `lengthscale`."""
        lengthscale = sd[..., :0] if lengthscale is None else lengthscale
        return cls(kernel.profile, kernel.num_dims, kernel.active_dims, sd, lengthscale, shape)

    @property
    def precision(self) -> Tensor:
        """Diagonal of P = 1/ℓ², `(*batch, 1, p)`."""
        return self.lengthscale**-2

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False) -> Tensor:
        """σ² κ(s), `(..., n1, n2)`, or `(..., n)` with `diag`."""
        return _covariance(self, x1, x2, diag)


#: A stationary covariance, as a gpytorch kernel or of plain tensors.
Stationary = StationaryKernel | StationaryCovariance


def _covariance(kernel: Stationary, x1: Tensor, x2: Tensor, diag: bool) -> Tensor:
    variance = kernel.sd**2
    if diag:
        return variance[..., 0].expand(torch.broadcast_shapes(x1.shape[:-1], (*variance.shape[:-2], 1)))
    if kernel.num_dims == 0:
        rows = torch.broadcast_shapes(x1.shape[:-2], x2.shape[:-2], variance.shape[:-2])
        return variance.expand(*rows, x1.shape[-2], x2.shape[-2])
    s = half_squared_distance(x1, x2, kernel.precision, kernel.profile.exact_distance)
    return variance * kernel.profile.value(s, kernel.shape)


def half_squared_distance(x1: Tensor, x2: Tensor, precision: Tensor, exact: bool) -> Tensor:
    """s = ½ (x−x')ᵀ P (x−x'), `(..., n1, n2)`."""
    p = x1.shape[-1]
    if exact or p == 1:
        weights = precision.expand(*precision.shape[:-1], p)
        total: Tensor | None = None
        for c in range(p):
            r = x1[..., :, c].unsqueeze(-1) - x2[..., :, c].unsqueeze(-2)
            term = r * r * (0.5 * weights[..., c].unsqueeze(-1))
            total = term if total is None else total + term
        assert total is not None
        return total
    # Centring keeps the cancellation in |x|² + |x'|² − 2xᵀx' small for inputs far from the origin.
    centre = x1.mean(dim=-2, keepdim=True)
    a, b = x1 - centre, x2 - centre
    aw = a * precision
    half_a = 0.5 * (aw * a).sum(-1, keepdim=True)
    half_b = 0.5 * (b * precision * b).sum(-1, keepdim=True)
    left = stack_columns(-aw, half_a, torch.ones_like(a[..., :1]))
    return left @ stack_columns(b, torch.ones_like(b[..., :1]), half_b).mT


def stack_columns(*parts: Tensor) -> Tensor:
    """Concatenate along the last dimension after broadcasting the batch dimensions."""
    batch = torch.broadcast_shapes(*(part.shape[:-2] for part in parts))
    return torch.cat([part.expand(*batch, *part.shape[-2:]) for part in parts], dim=-1)


def register_positive(
    module: Module, name: str, batch_shape: torch.Size, prior: Prior | None, constraint: Interval | None
) -> None:
    """Register a positive hyperparameter `name` of shape `(*batch, 1, 1)`, with its constraint and prior."""
    module.register_parameter(f"raw_{name}", torch.nn.Parameter(torch.zeros(*batch_shape, 1, 1)))
    module.register_constraint(f"raw_{name}", constraint or log_positive())
    if prior is not None:
        module.register_prior(f"{name}_prior", prior, name)


def set_positive(module: Module, name: str, value: Tensor | float) -> None:
    """Set hyperparameter `name` to `value` in its natural unit."""
    raw = getattr(module, f"raw_{name}")
    constraint = getattr(module, f"raw_{name}_constraint")
    # Through the dtype of the module: a Python number must not pass through single precision.
    value = torch.as_tensor(value, dtype=raw.dtype, device=raw.device).expand_as(raw)
    module.initialize(**{f"raw_{name}": constraint.inverse_transform(value)})


def lengthscale_from_paper(parameter: float) -> float:
    """ℓ = √(l/2) for the paper's σ² exp(−rᵀΛ⁻¹r), Λ = diag(l), which has no ½ and no square on l."""
    return math.sqrt(parameter / 2.0)
