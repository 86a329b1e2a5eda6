"""A Gaussian guide fitted to the posterior by Pyro, and draws of it with their importance weights."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from numpy.typing import NDArray
from pyro.infer import SVI, Trace_ELBO
from pyro.infer.autoguide import AutoContinuous, AutoLowRankMultivariateNormal, AutoMultivariateNormal
from pyro.infer.autoguide.initialization import init_to_value
from pyro.optim import ClippedAdam
from torch import Tensor

from bayes_impedance.config import SamplingConfig
from bayes_impedance.config.inference import Guide
from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.impedance_functions.threads import one_thread
from bayes_impedance.sampling.density import SampledDensity
from bayes_impedance.sampling.draws import Draws, Progress
from bayes_impedance.sampling.importance import approximate_draws
from bayes_impedance.sampling.start import Start

Array = NDArray[np.float64]

#: First rate of Adam, in SDs of Laplace's approximation, and the share of it at the last step.
RATE, LAST = 0.03, 0.1
#: Columns of a low-rank guide begin this small, next to a diagonal of one: at zero their gradient is, too.
SMALL = 0.1
#: A rise of the ELBO that is too small to count [nats], one that its own noise explains, in standard errors, and noise
#: beyond which no rise could be seen [nats].
RISE, ERRORS, SCATTER = 0.1, 3.0, 2.0
#: Steps between lines of progress, and the share of steps that may fail unsaid.
REPORTED, FAILING = 50, 0.1


@dataclass(frozen=True)
class Fitted:
    """A Gaussian approximation, its `start` in the place of Laplace's, and the ELBO at each step [nats].

    The ELBO is up to a constant; NaN marks steps that were skipped because the density was not finite there.
    """

    start: Start
    elbo: Array

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a reader should know of the fit; nothing where it settled."""
        return tuple(line for line in (_failures(self.elbo), _unsettled(self.elbo)) if line is not None)


def svi_draws(
    density: SampledDensity, start: Start, settings: SamplingConfig, progress: Progress | None = None
) -> Draws:
    """Draws of a guide that is fitted in `settings.steps` steps, see `fit_guide` and `approximate_draws`.

    Raises:
        NotPositiveDefiniteError: the posterior is finite hardly anywhere about the guide.
    """
    fitted = fit_guide(density, start, settings, progress)
    return approximate_draws("svi", density, fitted.start, settings, progress, fitted.remarks)


def fit_guide(
    density: SampledDensity, start: Start, settings: SamplingConfig, progress: Progress | None = None
) -> Fitted:
    """Maximise the ELBO over Gaussians from Laplace's approximation `start` on, in coordinates where that is N(0, I).

    Adam at a rate that falls geometrically. Steps at whose draw the density or its gradient is not finite change
    nothing. Neither Pyro's parameters nor the state of torch's generator are touched.
    """
    root = torch.from_numpy(start.root)
    flat = torch.zeros(density.size, dtype=torch.float64)

    def steps() -> Tensor:
        # Without a density of its own: the factor has everything.
        return pyro.sample("y", dist.Normal(flat, 1.0).to_event(1).mask(False))

    def model() -> None:
        y = steps()
        value, gradient = density.joint(start.at(y.detach().numpy()))
        slope = torch.from_numpy(gradient) @ root
        pyro.factor("posterior", value + (slope * (y - y.detach())).sum())

    elbo = np.full(settings.steps, np.nan)
    with _apart(settings.seed), one_thread():
        guide = _guide(settings.guide, steps, flat)
        fall = LAST ** (1.0 / settings.steps)
        svi = SVI(model, guide, ClippedAdam({"lr": RATE, "lrd": fall}), Trace_ELBO())
        for step in range(settings.steps):
            # The density raises before any gradient is found.
            with contextlib.suppress(NotPositiveDefiniteError):
                elbo[step] = -svi.step()
            if progress is not None and (step + 1) % REPORTED == 0:
                progress(0, step + 1, settings.steps, _line(elbo[: step + 1]))
        point, factor = _moments(guide)
    outcome = _unsettled(elbo) or "the ELBO has settled"
    return Fitted(Start(start.at(point), start.root @ factor, outcome), elbo)


@contextlib.contextmanager
def _apart(seed: int) -> Iterator[None]:
    """Parameters and random numbers of one's own."""
    with torch.random.fork_rng(devices=[]), pyro.get_param_store().scope():
        torch.manual_seed(seed)
        yield


def _guide(name: Guide, sites: Callable[[], Tensor], zero: Tensor) -> AutoContinuous:
    """A guide to `sites` that begins at N(0, I)."""
    at_mode = init_to_value(values={"y": zero})
    if name == "multivariate_normal":
        guide = AutoMultivariateNormal(sites, init_loc_fn=at_mode, init_scale=1.0)
        guide()
        return guide
    guide = AutoLowRankMultivariateNormal(sites, init_loc_fn=at_mode, init_scale=1.0)
    guide()
    with torch.no_grad():
        guide.cov_factor.mul_(SMALL)
        guide.scale = torch.ones_like(zero)
    return guide


def _moments(guide: AutoContinuous) -> tuple[Array, Array]:
    """Mean of a guide, and a root of its covariance."""
    with torch.no_grad():
        gaussian: dist.TorchDistribution = guide.get_posterior()
        covariance: Tensor = gaussian.covariance_matrix
        return gaussian.mean.numpy().copy(), torch.linalg.cholesky(covariance).numpy()


def _line(elbo: Array) -> str:
    recent = elbo[-REPORTED:]
    recent = recent[np.isfinite(recent)]
    return (
        f"ELBO {recent.mean():.2f}" if len(recent) else "the density is not finite at any draw of the guide"
    )


def _failures(elbo: Array) -> str | None:
    failed = int(np.isnan(elbo).sum())
    if failed <= FAILING * len(elbo):
        return None
    return (
        f"the density was not finite at {failed} of the {len(elbo)} steps of the fit, which were skipped, so that "
        "the guide avoids places it should weigh; use sampling.method=nuts"
    )


def _unsettled(elbo: Array) -> str | None:
    """Why the fit cannot be taken for finished: its last quarter against the one before; None where it can."""
    quarter = len(elbo) // 4
    before, last = (part[np.isfinite(part)] for part in (elbo[-2 * quarter : -quarter], elbo[-quarter:]))
    if quarter < 2 or min(len(before), len(last)) < 2:
        return f"{len(elbo)} steps of a fit are too few to say whether it settled; set sampling.steps to 1000 or more"
    rise = float(last.mean() - before.mean())
    error = ERRORS * float(np.sqrt(before.var(ddof=1) / len(before) + last.var(ddof=1) / len(last)))
    if rise > max(RISE, error):
        return (
            f"the fit of the guide has not settled: its ELBO still rose by {rise:.2g} nats in the last quarter of "
            f"{len(elbo)} steps; set sampling.steps to {2 * len(elbo)}"
        )
    if error > SCATTER:
        return (
            f"the ELBO scatters by {last.std(ddof=1):.2g} nats from step to step, too much to say whether the fit "
            f"of the guide has settled; set sampling.steps to {2 * len(elbo)}, or use sampling.method=nuts"
        )
    return None
