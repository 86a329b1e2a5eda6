"""Posteriors of every latent where impedance is a function."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from bayes_impedance.config import Config
from bayes_impedance.features import Features
from bayes_impedance.impedance_functions.conditioned import Conditioned
from bayes_impedance.impedance_functions.density import Density
from bayes_impedance.impedance_functions.fit import Mode, find_weights
from bayes_impedance.impedance_functions.function import build_functions
from bayes_impedance.impedance_functions.log_matrix import LogMatrix
from bayes_impedance.impedance_functions.threads import one_thread
from bayes_impedance.impedance_functions.train import FittedFunctions, build_density
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.posterior import Marginal, Posterior
from bayes_impedance.posterior.collected import Collected, axes_last
from bayes_impedance.posterior.conditioning import Moments, select_groups
from bayes_impedance.posterior.independent import IndependentPrior
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import ForceModel

Array = NDArray[np.float64]


@one_thread()
def condition(
    config: Config, model: ForceModel, fitted: FittedFunctions, given: Features, trained_on: bool
) -> Conditioned:
    """What the forces of `given` tell of the functions, at the hyperparameters that were fitted.

    Where these are forces that the functions were `trained_on`, of some of its groups, that is known already;
    hyperparameters are then uncertain, too.

    Raises:
        NotPositiveDefiniteError: the likelihood is not finite.
        ConfigurationError: the engine cannot hold the processes at these samples.
        TooManySamplesError: the engine is dense, and the samples are too many.
    """
    density = build_density(config, model, given, fitted.inducing, fitted.engine.name)
    if trained_on:
        first = len(fitted.point) - (len(density.free) - density.weight_count)
        own = np.concatenate([_weights_of(density, fitted), np.arange(first, len(fitted.point))])
        learned = np.concatenate([np.ones(first, dtype=bool), density.free[density.weight_count :]])
        kept = (np.cumsum(learned) - 1)[own[density.free]]
        return Conditioned(density, fitted.point[own], fitted.covariance[np.ix_(kept, kept)], density.free)
    mode = _mode_of_weights(config, density, fitted)
    return Conditioned(density, mode.point, mode.covariance, density.free)


@one_thread()
def function_evidence(config: Config, model: ForceModel, fitted: FittedFunctions, given: Features) -> float:
    """log p(forces of `given`) at the hyperparameters, the functions integrated out by Laplace's method [nats].

    Raises:
        NotPositiveDefiniteError: the likelihood is not finite.
        ConfigurationError: the engine cannot hold the processes at these samples.
        TooManySamplesError: the engine is dense, and the samples are too many.
    """
    density = build_density(config, model, given, fitted.inducing, fitted.engine.name)
    return _mode_of_weights(config, density, fitted).log_evidence


def _mode_of_weights(config: Config, density: Density, fitted: FittedFunctions) -> Mode:
    """Functions given the density's forces, at the fitted hyperparameters."""
    weights = _weights_of(density, fitted)
    start, scale = density.start(), None
    if len(weights):
        start[: density.weight_count] = fitted.point[weights]
        scale = fitted.covariance[np.ix_(weights, weights)]
    return find_weights(
        density, start, scale, config.training.max_iterations, config.training.gradient_tolerance
    )


@one_thread()
def compute_function_posterior(
    config: Config,
    model: ForceModel,
    fitted: FittedFunctions,
    log: PreparedLog,
    target: Features,
    conditioned: Conditioned | None,
    latents: Sequence[Latent] | None = None,
) -> Posterior:
    """Posteriors at `target`, the features of `log`; the prior for groups that `conditioned` knows no forces of."""
    wanted = list(Latent) if latents is None else list(latents)
    # In the order of the forces given, which that of `target` need not be.
    given = () if conditioned is None else conditioned.density.features.groups
    known = [g for g in given if g in target.groups]
    unknown = [g for g in target.groups if g not in known]
    others = [latent for latent in wanted if latent not in IMPEDANCE_ORDER]
    orders = {latent: IMPEDANCE_ORDER[latent] for latent in wanted if latent in IMPEDANCE_ORDER}
    functions = build_functions(config, model, fitted.inducing)
    collected = Collected(log)
    with torch.no_grad():
        if known:
            assert conditioned is not None
            own = select_groups(target, known)
            collected.put(own, axes_last(_known_others(model, conditioned, own, others)))
            collected.put(own, {latent: conditioned.logarithm(own, j) for latent, j in orders.items()})
        if unknown:
            own = select_groups(target, unknown)
            collected.put(own, axes_last(IndependentPrior(model).moments(own, others)))
            x = own.inputs
            before = {latent: functions[j].prior(x, functions[j].design(x)) for latent, j in orders.items()}
            collected.put(own, before)
    marginals = {latent: collected.marginal(latent, warped=False) for latent in others}
    couplings, laws = {}, {}
    for latent, j in orders.items():
        law = LogMatrix(functions[j].places, *collected.take(latent))
        laws[latent] = law
        marginals[latent] = Marginal(latent, True, *law.diagonal(), *law.diagonal(prior=True))
        if law.is_coupled:
            couplings[latent] = Marginal(latent, False, *law.beside(), *law.beside(prior=True))
    return Posterior(log, {latent: marginals[latent] for latent in wanted}, couplings, laws)


def _known_others(
    model: ForceModel, conditioned: Conditioned, target: Features, latents: Sequence[Latent]
) -> dict[Latent, Moments]:
    if not latents:
        return {}
    found = conditioned.others(target)
    priors = IndependentPrior(model).moments(target, latents)
    result = {}
    for latent, (_, _, prior_location, prior_variance) in priors.items():
        location, variance = found[latent]
        if latent is Latent.FORCE:
            variance = variance + model.noise_variance
        result[latent] = (location, variance, prior_location, prior_variance)
    return result


def _weights_of(density: Density, fitted: FittedFunctions) -> NDArray[np.int64]:
    """Where in the fitted point the weights of the density's groups are; none where a group is new."""
    groups = density.features.groups
    if any(group not in fitted.groups for group in groups):
        return np.zeros(0, dtype=np.int64)
    chosen = [fitted.groups.index(group) for group in groups]
    start, places = 0, []
    for _, entries, width in density.shapes:
        count = len(fitted.groups) * entries * width
        own = np.arange(start, start + count).reshape(len(fitted.groups), -1)
        places.append(own[chosen].reshape(-1))
        start += count
    return np.concatenate(places)
