"""One draw of a calibration: truth from the prior, a recording, its posterior, ranks of the truth in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.calibration.problem import Problem, one_of_prior, seeds
from bayes_impedance.calibration.quantities import DrawLatents, Ranked
from bayes_impedance.calibration.records import Record
from bayes_impedance.config import Config
from bayes_impedance.errors import BayesImpedanceError, ConfigurationError
from bayes_impedance.impedance_functions.threads import one_thread
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.sampling.density import JointDensity
from bayes_impedance.sampling.diagnostics import diagnose
from bayes_impedance.sampling.draws import Draws
from bayes_impedance.sampling.importance import TRUSTED_K
from bayes_impedance.sampling.latents import draw_latents
from bayes_impedance.sampling.sample import draw

Array = NDArray[np.float64]

#: Draws of a posterior by what a configuration says of sampling.
Sampler = Callable[[JointDensity, Config], Draws]

#: R-hat of half a chain above which draws are not to be trusted.
LARGEST_RHAT = 1.05


def posterior_draws(density: JointDensity, config: Config) -> Draws:
    """Draws as `sample` makes them, in this process: draws of a calibration are what runs side by side.

    Raises:
        NotPositiveDefiniteError: the density is not finite about its mode.
        SamplingError: every chain died.
    """
    return draw(density, config.training, config.sampling, processes=1)


@dataclass(frozen=True)
class Settings:
    """All that a draw depends on beside its number: `thinned` draws L that a rank is taken among, `seed` of all."""

    config: Config
    motion: PreparedLog
    sampler: Sampler = posterior_draws
    draw_latents: DrawLatents = draw_latents
    seed: int = 0
    thinned: int = 99


class Trials:
    """Draws of a calibration, by number, in any order and in any process the same.

    Raises:
        ConfigurationError: see `Problem`; or there are fewer draws of a posterior than ranks need.
    """

    def __init__(self, settings: Settings) -> None:
        sampling = settings.config.sampling
        available = sampling.chains * sampling.draws
        if available < settings.thinned:
            raise ConfigurationError(
                f"sampling.draws: expected at least {settings.thinned} draws over all chains, among which the truth is "
                f"ranked, got {available}; set sampling.draws or sampling.chains higher"
            )
        self.settings = settings
        self.problem = Problem(settings.config, settings.motion)
        self.ranked = Ranked(self.problem)

    @one_thread()
    def __call__(self, index: int) -> Record:
        """The record of draw number `index`; where sampling fails it says how."""
        generator, recording_seed, sampler_seed = seeds(self.settings.seed, index)
        point = one_of_prior(self.problem, generator)
        try:
            log = self.problem.draw(point, recording_seed)
            density = self.problem.density(log)
            draws = self.settings.sampler(density, _seeded(self.settings.config, sampler_seed))
            chosen = thinned(draws.standard, self.settings.thinned)
            truth = self.ranked.truth(point, log)
            values = self.ranked.draws(density, chosen, self.settings.draw_latents, sampler_seed)
        except (BayesImpedanceError, RuntimeError, np.linalg.LinAlgError) as error:
            # torch says RuntimeError of a factorisation that fails.
            return Record(index, failure=f"{type(error).__name__}: {error}")
        still = [name for name in truth if not np.ptp(values[name]) > 0.0]
        if still:
            return Record(index, failure=f"all draws are the same: {', '.join(still)}")
        return Record(
            index,
            truth,
            {name: int((values[name] < true).sum()) for name, true in truth.items()},
            {name: float((true - values[name].mean()) / values[name].std()) for name, true in truth.items()},
            doubts(draws, self.settings.thinned),
        )


def _seeded(config: Config, seed: int) -> Config:
    return config.model_copy(update={"sampling": config.sampling.model_copy(update={"seed": seed})})


def thinned(standard: Array, count: int) -> Array:
    """`count` of the draws of all chains `(chains, draws, size)`, as far apart as they can be, `(count, size)`.

    Raises:
        ConfigurationError: there are not so many.
    """
    flat = standard.reshape(-1, standard.shape[-1])
    if len(flat) < count:
        raise ConfigurationError(
            f"expected {count} draws of the posterior, among which the truth is ranked, found {len(flat)} that chains "
            "came to; sample more"
        )
    return flat[np.linspace(0, len(flat) - 1, count).round().astype(np.int64)]


def doubts(draws: Draws, wanted: int) -> tuple[str, ...]:
    """What speaks against draws of which `wanted` are to be nearly independent, a few words each."""
    found = []
    if draws.lost:
        found.append("a chain was lost")
    if "diverging" in draws.stats and bool(np.any(draws.stats["diverging"])):
        found.append("divergences")
    if draws.pareto_k is not None and not draws.pareto_k <= TRUSTED_K:
        found.append(f"Pareto k above {TRUSTED_K:g}")
    # Halves, so that one chain can be compared with itself; what did not move has no R-hat, which is doubtful, too.
    halved = replace(draws, standard=_halves(draws.standard))
    diagnosis = diagnose(halved, [str(c) for c in range(draws.standard.shape[-1])])
    if draws.method == "nuts" and not all(
        rhat is not None and rhat <= LARGEST_RHAT for rhat in diagnosis.rhat
    ):
        found.append(f"R-hat above {LARGEST_RHAT:g}")
    if not all(effective is not None and effective >= wanted for effective in diagnosis.ess_bulk):
        found.append(f"fewer than {wanted} effective draws")
    return tuple(found)


def _halves(chains: Array) -> Array:
    """The first and the second half of each of `(chains, draws, size)`, as chains."""
    half = chains.shape[1] // 2
    return np.concatenate([chains[:, :half], chains[:, -half:]])
