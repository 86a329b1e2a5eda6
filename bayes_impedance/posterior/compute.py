"""Gaussian posteriors of every latent, given forces (docs/model.md §4).

The covariance between the force and another process is the primitive: predicting x_d is the same code as
predicting u. Warped impedance is conditioned in the logarithm, so its quantiles are positive.

The conditioning itself is in `posterior.independent` or, where axes are coupled, in `posterior.coupled`.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from bayes_impedance.engines.closed_loop import ANCHORS
from bayes_impedance.features import Features, LogFeatures
from bayes_impedance.kernels.coupled import CoupledInteractionKernel
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, InteractionKernel, Latent
from bayes_impedance.posterior.batches import Progress, plan
from bayes_impedance.posterior.collected import Collected, MomentsAt, axes_last, collect
from bayes_impedance.posterior.conditioning import pieces, select_groups, targets_at_once
from bayes_impedance.posterior.coupled import CoupledConditioner, CoupledPrior
from bayes_impedance.posterior.independent import IndependentConditioner, IndependentPrior, is_warped
from bayes_impedance.posterior.results import Posterior, matrix_marginals
from bayes_impedance.posterior.terms import LogTerms
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import ForceModel


def compute_posterior(
    model: ForceModel,
    log: PreparedLog,
    target: Features,
    given: Features | None,
    jitter: float,
    latents: Sequence[Latent] | None = None,
) -> Posterior:
    """Posteriors at `target`, the features of `log`, given the forces of `given`; the prior where it is None.

    Groups of `target` without a namesake in `given` keep their prior. All groups are one batch: see `infer_log`.

    Raises:
        NotPositiveDefiniteError: the covariance of the given forces does not factorise.
    """
    latents = _latents_of(model) if latents is None else latents
    known = [] if given is None else [g for g in target.groups if g in given.groups]
    unknown = [g for g in target.groups if g not in known]
    conditionings = _Conditionings(model, jitter, latents)
    collected = Collected(log)
    with torch.no_grad():
        for chosen, condition in ((known, given), (unknown, None)):
            if chosen:
                evidence = None if condition is None else select_groups(condition, chosen)
                moments = conditionings.given(evidence)
                rows = 0 if evidence is None else evidence.inputs[..., 0].numel()
                for piece in pieces(select_groups(target, chosen), targets_at_once(rows)):
                    collected.put(piece, moments(piece))
    return _posterior(model, collected, latents)


def infer_log(
    model: ForceModel,
    target: LogFeatures,
    given: LogFeatures | None,
    jitter: float,
    latents: Sequence[Latent] | None = None,
    progress: Progress | None = None,
) -> Posterior:
    """Posteriors at every sample of the log of `target`, given all forces of that of `given`.

    As `compute_posterior`, but in batches of groups of similar length, on as many threads as torch has. Numbers do not
    depend on threads (but for the rounding of a single large group). Memory beyond logs and results is that of the
    batches at work, whatever their number and the length of the log: see `conditioning.ENTRIES`.

    Raises:
        NotPositiveDefiniteError: the covariance of the given forces does not factorise.
    """
    latents = _latents_of(model) if latents is None else latents
    log = target.log
    conditionings = _Conditionings(model, jitter, latents)
    # The anchors of an apparent mass are as many as the samples, padding counted in, where these are few.
    alike_below = 0 if target.feature_map.device is None else ANCHORS
    batches = plan(log, None if given is None else given.log, model.is_coupled, alike_below)
    collected = collect(target, given, batches, conditionings.given, progress)
    return _posterior(model, collected, latents)


def _latents_of(model: ForceModel) -> list[Latent]:
    has_impedance = isinstance(model.kernel, (InteractionKernel, CoupledInteractionKernel))
    return list(Latent) if has_impedance else [Latent.FORCE]


class _Conditionings:
    """Forces of some groups at a time to moments of latents; what all have in common is computed once."""

    def __init__(self, model: ForceModel, jitter: float, latents: Sequence[Latent]) -> None:
        self._jitter, self._latents = jitter, latents
        self._prior: CoupledPrior | IndependentPrior
        with torch.no_grad():
            self._prior = CoupledPrior(model) if model.is_coupled else IndependentPrior(model)

    def given(self, evidence: Features | None) -> MomentsAt:
        """Moments given the forces of `evidence`, or those of the prior."""
        latents = self._latents
        if isinstance(self._prior, CoupledPrior):
            coupled = CoupledConditioner(self._prior, evidence, self._jitter)
            return lambda target: {
                **axes_last(coupled.moments(target, latents)),
                **coupled.terms(target, latents),
            }
        source = self._prior
        if evidence is None:
            return lambda target: axes_last(source.moments(target, latents))
        independent = IndependentConditioner(source, evidence, self._jitter)
        return lambda target: axes_last(independent.moments(target, latents))


def _posterior(model: ForceModel, collected: Collected, latents: Sequence[Latent]) -> Posterior:
    marginals, couplings, matrices = {}, {}, {}
    for latent in latents:
        if model.is_coupled and latent in IMPEDANCE_ORDER:
            matrices[latent] = LogTerms(len(collected.log.axes), *collected.take(latent))
            marginals[latent], couplings[latent] = matrix_marginals(latent, matrices[latent])
        else:
            marginals[latent] = collected.marginal(latent, is_warped(model, latent))
    return Posterior(collected.log, marginals, couplings, matrices)
