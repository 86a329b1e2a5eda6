"""Verdict on every impedance estimate: do these data support it, or is it the prior (docs/model.md §6)?"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from bayes_impedance.config import Config
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.posterior import Marginal, Posterior
from bayes_impedance.posterior.results import UNITS
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial

#: A posterior SD of half the prior's, and of √¾ of it.
SUPPORTED, WEAK = 0.75, 0.25


class Support(Enum):
    """How far the data carry an estimate."""

    SUPPORTED = "supported by these data"
    WEAK = "weakly supported"
    PRIOR_ONLY = "prior only"


@dataclass(frozen=True)
class Verdict:
    """One impedance parameter on one axis: path averages in SI units, contraction, and a sentence."""

    latent: Latent
    axis: str
    mean: float
    q05: float
    q95: float
    prior_q05: float
    prior_q95: float
    contraction: float
    support: Support
    sentence: str

    @property
    def unit(self) -> str:
        """SI unit of the estimate."""
        return UNITS[self.latent]


@dataclass(frozen=True)
class OffDiagonal:
    """An entry of stiffness, damping or mass beside the diagonal, as path averages in SI units, with contraction.

    There is no verdict on it: its sign and size tell of themselves, beside its prior, which is centred at zero.
    """

    latent: Latent
    pair: str
    mean: float
    q05: float
    q95: float
    prior_q05: float
    prior_q95: float
    contraction: float

    @property
    def unit(self) -> str:
        """SI unit of the estimate."""
        return UNITS[self.latent]


def off_diagonals(posterior: Posterior) -> list[OffDiagonal]:
    """What couples axes in stiffness, damping and mass, averaged over samples; nothing where axes are independent."""
    listed = []
    for latent, marginal in posterior.couplings.items():
        for pair, average in zip(posterior.pairs, _path_averages(marginal), strict=True):
            listed.append(OffDiagonal(latent, pair, *average))
    return listed


def _path_averages(marginal: Marginal) -> list[tuple[float, float, float, float, float, float]]:
    """Mean, 5 and 95 % quantiles, those of the prior, and contraction: averages over samples, one for each column."""
    bands = [quantile(p) for quantile in (marginal.quantile, marginal.prior_quantile) for p in (0.05, 0.95)]
    columns = []
    for k, contraction in enumerate(marginal.contraction):
        mean, low, high, prior_low, prior_high = (
            float(part[:, k].mean()) for part in (marginal.mean, *bands)
        )
        columns.append((mean, low, high, prior_low, prior_high, float(contraction)))
    return columns


def assess(
    posterior: Posterior, config: Config, repetitions: int, perturbed: bool | None = None
) -> list[Verdict]:
    """Verdicts on stiffness, damping and mass of each axis, averaged over the samples of `posterior`.

    `repetitions` of one task in the forces given, of the group that has fewest; `perturbed` as `was_perturbed` has it.
    However much a posterior contracts, nothing is claimed where the design of the experiment cannot tell impedance
    from intention.
    """
    confounded = confounding(config, repetitions, perturbed)
    verdicts = []
    for latent in IMPEDANCE_ORDER:
        for axis, average in zip(posterior.axes, _path_averages(posterior[latent]), strict=True):
            contraction = average[-1]
            support = classify(contraction) if confounded is None else Support.PRIOR_ONLY
            prior_scale = posterior[latent].prior_scale[:, posterior.axes.index(axis)]
            is_fixed = bool(np.isclose(prior_scale, 0.0).all())
            sentence = verdict_sentence(latent, axis, contraction, support, confounded, is_fixed)
            verdicts.append(Verdict(latent, axis, *average, support, sentence))
    return verdicts


def classify(contraction: float) -> Support:
    """Support from contraction: at least .75 supported, at least .25 weak, below that the prior.

    Example:
        >>> classify(0.8).value, classify(0.1).value
        ('supported by these data', 'prior only')
    """
    if contraction >= SUPPORTED:
        return Support.SUPPORTED
    return Support.WEAK if contraction >= WEAK else Support.PRIOR_ONLY


def was_perturbed(trials: Iterable[PreparedTrial]) -> bool | None:
    """Whether a device perturbed any of `trials`; None where a trial has no perturbation column to tell."""
    recorded = [trial.perturbation for trial in trials]
    if any(perturbation is None for perturbation in recorded):
        return None
    return any(bool(np.any(perturbation)) for perturbation in recorded)


def confounding(config: Config, repetitions: int, perturbed: bool | None = None) -> str | None:
    """Why this design cannot tell impedance from the desired trajectory; None where it can (docs/model.md §6).

    It can where the desired trajectory is known (`reference`), or where several repetitions, displaced in
    different ways, share one as a function of phase or time. A function of position takes the value x + u/k for any
    k, and so does a desired trajectory that was seen once. Repetitions of which the log says that nothing perturbed
    them differ by the person alone, and return the law of the robot.
    """
    model = config.model
    mean, theta = model.desired_trajectory.mean, model.trajectory_input
    if mean == "reference":
        return None
    if mean == "equilibrium":
        return "with the equilibrium mean the force tells only the product of impedance and the SD of x_d"
    if theta in ("position", "position_velocity"):
        return f"a desired trajectory that is a function of {theta.replace('_', ' and ')} fits any stiffness"
    shared = config.shared.desired_trajectory
    if not (theta != "time" if shared is None else shared) or repetitions < 2:
        return (
            "each desired trajectory was seen once, and x_d = x + u/k fits any stiffness: repeat the motion"
        )
    if perturbed is False:
        return "the log says that nothing perturbed the hand, and then repetitions tell the robot's law, not the arm's"
    return None


def verdict_sentence(
    latent: Latent, axis: str, contraction: float, support: Support, confounded: str | None, is_fixed: bool
) -> str:
    """What a verdict says in words; `confounded` is why the design cannot tell, None where it can."""
    name = f"{latent.value} {axis}{axis}"
    if is_fixed:
        return f"{name}: fixed by the configuration, so the data had no say."
    share = f"the data removed {_percentage(contraction)} of the prior variance"
    if support is not Support.PRIOR_ONLY:
        return f"{name}: {support.value}; {share}."
    reason = confounded or "perturb the motion, repeat it, or give a reference"
    if contraction >= WEAK:
        share = f"the contraction of {rounded(contraction)} rests on the assumed desired trajectory, not on the data"
    return f"{name}: prior only; {share}: {reason}."


def caveat(verdicts: Iterable[Verdict], log: PreparedLog, config: Config) -> str | None:
    """What every claim above presupposes, where the log itself cannot show it; None where nothing is claimed."""
    claims = any(verdict.support is not Support.PRIOR_ONLY for verdict in verdicts)
    known = config.model.desired_trajectory.mean in ("reference", "equilibrium")
    if not claims or known:
        return None
    if was_perturbed(log.trials) is None:
        return (
            "These verdicts presume that something other than this person displaced the hand: the log has no "
            "perturbation column, and without perturbation the robot's own law can look like an arm."
        )
    if config.device is None:
        return (
            "These verdicts presume that the hand's acceleration does not answer force at once. On an admittance-"
            "controlled robot it does, and mass and stiffness come out low: name its virtual mass in `device`."
        )
    return None


def rounded(contraction: float) -> str:
    """Contraction with two digits, never rounded up to certainty.

    Example:
        >>> rounded(0.823), rounded(0.9999)
        ('0.82', '> 0.99')
    """
    return "> 0.99" if contraction > 0.99 else f"{contraction:.2f}"


def _percentage(contraction: float) -> str:
    """A share that never claims to be all of it."""
    return "over 99 %" if contraction > 0.99 else f"{max(contraction, 0.0):.0%}".replace("%", " %")


def summarise(
    verdicts: Iterable[Verdict], beside: Iterable[OffDiagonal] = ()
) -> dict[str, dict[str, float | str]]:
    """JSON-able mapping from stiffness_xx, damping_xx, … to estimate, interval, contraction and verdict.

    Those `beside` the diagonal, stiffness_xy, …, have no verdict.
    """
    summary: dict[str, dict[str, float | str]] = {
        f"{v.latent.value}_{v.axis}{v.axis}": {
            "mean": v.mean,
            "q05": v.q05,
            "q95": v.q95,
            "contraction": v.contraction,
            "verdict": v.support.value,
        }
        for v in verdicts
    }
    for c in beside:
        numbers = {"mean": c.mean, "q05": c.q05, "q95": c.q95, "contraction": c.contraction}
        summary[f"{c.latent.value}_{c.pair}"] = dict(numbers)
    return summary
