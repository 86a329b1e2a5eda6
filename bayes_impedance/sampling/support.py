"""What the data say of impedance, by exact posteriors: contraction, what it is confounded with, what the prior does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from arviz_stats.base import array_stats
from numpy.typing import NDArray

from bayes_impedance.config import Config
from bayes_impedance.identifiability import (
    OffDiagonal,
    Support,
    Verdict,
    classify,
    confounding,
    rounded,
    verdict_sentence,
)
from bayes_impedance.impedance_functions.symmetric import entries
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent

Array = NDArray[np.float64]

#: From this correlation on only the product of stiffness and of the scale of the desired trajectory is known.
CONFOUNDED = 0.8
#: Sensitivity to the power of a prior from which on it is worth a look (Kallioinen et al., *Detecting and diagnosing
#: prior and likelihood sensitivity with power-scaling*, Statistics and Computing 2024).
SENSITIVE = 0.05
#: Powers of a prior between which a posterior is compared.
POWERS = (0.8, 1.25)
#: The fewest draws that say anything of a variance, and of what a prior does.
FEWEST = 100
TOO_FEW = "{} draws are too few to tell what the data said, set sampling.draws higher"


@dataclass(frozen=True)
class ExactVerdict:
    """A `Verdict` from draws, with the correlation of log w with the logarithm of the SD of x_d, and how much the
    posterior moves with the power of the prior of its level. NaN where either is fixed, or the draws are too few.
    """  # fmt: skip

    verdict: Verdict
    correlation: float
    sensitivity: float


@dataclass(frozen=True)
class Evidence:
    """What verdicts are made of.

    `impedance` and `prior`: draws `(draws, places, axes, axes)` of K, D, M; `trajectory_sd` `(draws, axes)` [m], None
    where it is fixed; `log_prior` `(draws, axes)` of the levels of each of K, D, M [nats].
    """

    impedance: Mapping[Latent, Array]
    prior: Mapping[Latent, Array]
    trajectory_sd: Array | None
    log_prior: Mapping[Latent, Array]


def exact_verdicts(
    evidence: Evidence, config: Config, axes: Sequence[str], repetitions: int, perturbed: bool | None
) -> list[ExactVerdict]:
    """Verdicts on stiffness, damping and mass of each axis, averaged over places.

    As the verdicts on Gaussian posteriors (docs/model.md §6); besides, nothing is claimed of what goes with the SD of
    the desired trajectory, nor from fewer than 100 draws.
    """
    confounded = confounding(config, repetitions, perturbed)
    count = len(evidence.impedance[Latent.STIFFNESS])
    if count < FEWEST:
        confounded = TOO_FEW.format(count)
    return [
        _verdict(evidence, latent, a, axis, confounded)
        for latent in IMPEDANCE_ORDER
        for a, axis in enumerate(axes)
    ]


def _verdict(evidence: Evidence, latent: Latent, a: int, axis: str, confounded: str | None) -> ExactVerdict:
    draws, prior = evidence.impedance[latent][..., a, a], evidence.prior[latent][..., a, a]
    log_draws, log_prior = np.log(draws), np.log(prior)
    before = log_prior.var(axis=0).mean()
    is_fixed = bool(before < 1e-20)
    contraction = 0.0 if is_fixed else float(1.0 - log_draws.var(axis=0).mean() / before)
    average = log_draws.mean(axis=1)
    correlation = float("nan")
    sensitivity = float("nan")
    if len(draws) >= FEWEST and not is_fixed:
        sensitivity = _sensitivity(average, evidence.log_prior[latent][:, a])
        if evidence.trajectory_sd is not None:
            correlation = _correlation(average, np.log(evidence.trajectory_sd[:, a]))
    if confounded is None and abs(correlation) >= CONFOUNDED:
        confounded = (
            f"it goes with the SD of the desired trajectory (correlation {correlation:.2f}), and only their product is "
            "known"
        )
    support = classify(contraction) if confounded is None else Support.PRIOR_ONLY
    bands = _bands(draws, prior)
    sentence = verdict_sentence(latent, axis, contraction, support, confounded, is_fixed)
    if len(draws) < FEWEST and not is_fixed:
        sentence = f"{latent.value} {axis}{axis}: {support.value}; {confounded}."
    if sensitivity > SENSITIVE and support is not Support.PRIOR_ONLY:
        sentence += (
            f" It moves with its prior (sensitivity {rounded(sensitivity)}): look at another prior, too."
        )
    verdict = Verdict(latent, axis, float(draws.mean()), *bands, contraction, support, sentence)
    return ExactVerdict(verdict, correlation, sensitivity)


def exact_off_diagonals(evidence: Evidence, axes: Sequence[str]) -> list[OffDiagonal]:
    """What couples axes in stiffness, damping and mass, averaged over places."""
    listed = []
    for latent in IMPEDANCE_ORDER:
        for a, b in entries(len(axes), coupled=True)[len(axes) :]:
            draws, prior = (part[latent][..., a, b] for part in (evidence.impedance, evidence.prior))
            before = prior.var(axis=0).mean()
            contraction = float(1.0 - draws.var(axis=0).mean() / before) if before > 0.0 else 0.0
            mean = float(draws.mean())
            listed.append(OffDiagonal(latent, axes[a] + axes[b], mean, *_bands(draws, prior), contraction))
    return listed


def _bands(draws: Array, prior: Array) -> tuple[float, float, float, float]:
    """5 and 95 % quantiles of draws `(draws, places)` and of their prior, averaged over places."""
    low, high, prior_low, prior_high = (
        float(np.quantile(part, p, axis=0).mean()) for part in (draws, prior) for p in (0.05, 0.95)
    )
    return low, high, prior_low, prior_high


def _correlation(values: Array, others: Array) -> float:
    """NaN where one of them never moved."""
    if np.ptp(values) == 0.0 or np.ptp(others) == 0.0:
        return float("nan")
    return float(np.corrcoef(values, others)[0, 1])


def _sensitivity(values: Array, log_prior: Array) -> float:
    """How much the distribution of `values` `(draws,)` moves with the power of a prior, per doubling of it."""
    if np.ptp(log_prior) == 0.0 or np.ptp(values) == 0.0:
        return float("nan")
    lower, upper = (_weights(log_prior, power) for power in POWERS)
    parts = [part[None] for part in (values, lower, upper)]
    return float(array_stats.power_scale_sense(*parts, *POWERS))


def _weights(log_prior: Array, power: float) -> Array:
    """Weights of draws under a prior raised to a power, their tail smoothed."""
    with np.errstate(all="ignore"):
        log_weights = array_stats.power_scale_lw(log_prior, alpha=power)
    if not np.isfinite(log_weights).all():
        # Draws of an approximation come more than once, and ties fit no tail.
        log_weights = (power - 1.0) * log_prior
    weights: Array = np.exp(log_weights - log_weights.max())
    return weights / weights.sum()
