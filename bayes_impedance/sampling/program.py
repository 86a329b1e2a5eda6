"""The model as an ordinary Pyro program, for anybody's guide or sampler."""

from __future__ import annotations

from collections.abc import Callable

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.sampling.density import JointDensity
from bayes_impedance.sampling.parameters import QUANTITIES, Parameter

#: ∂^j of the desired trajectory that each of K, D, M multiplies.
Program = Callable[[], dict[str, Tensor]]


def pyro_program(density: JointDensity) -> Program:
    """A Pyro model whose posterior is `density`: sites are its parameters, forces enter as the factor `force`.

    Deterministic sites `stiffness` [N/m], `damping` [Ns/m] and `mass` [kg] `(groups, n, axes, axes)` are those at the
    samples. Where no Cholesky factor is found, or the likelihood overflows, the factor is −∞, which a sampler counts as
    a divergence; NaN Pyro refuses.

    Example:
        >>> from bayes_impedance.config import load_config
        >>> callable(pyro_program)
        True
    """

    nowhere = torch.full((), -torch.inf, dtype=torch.float64)

    def program() -> dict[str, Tensor]:
        values = {p.name: pyro.sample(p.name, prior(p)) for p in density.parameters}
        impedance = density.impedance(values)
        for j, name in enumerate(QUANTITIES):
            pyro.deterministic(name, impedance[:, :, j])
        try:
            likelihood = density.log_likelihood(values)
        except NotPositiveDefiniteError:
            likelihood = nowhere
        pyro.factor("force", likelihood if bool(likelihood.isfinite()) else nowhere)
        return values

    return program


def prior(parameter: Parameter) -> dist.TorchDistribution:
    """Prior of a site: standard normal weights, log-normal hyperparameters."""
    shape = torch.Size(parameter.shape)
    if parameter.median is None or parameter.log_sd is None:
        zero = torch.zeros(shape, dtype=torch.float64)
        return dist.Normal(zero, 1.0).to_event(len(shape))
    location, scale = parameter.median.log().expand(shape), parameter.log_sd.expand(shape)
    return dist.LogNormal(location, scale).to_event(len(shape))
