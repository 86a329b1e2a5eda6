"""From forces to a drawn posterior: density, start, draws, and what they say."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.config import Config, SamplingConfig, TrainingConfig
from bayes_impedance.errors import LogError
from bayes_impedance.features import FeatureMap, count_repetitions, label_trials
from bayes_impedance.identifiability import was_perturbed
from bayes_impedance.impedance_functions.function import choose_inducing
from bayes_impedance.impedance_functions.threads import one_thread
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import build_force_model
from bayes_impedance.sampling.chains import checked, sample_nuts
from bayes_impedance.sampling.checkpoint import Checkpoint
from bayes_impedance.sampling.dataset import names_of_coordinates
from bayes_impedance.sampling.density import JointDensity
from bayes_impedance.sampling.diagnostics import diagnose
from bayes_impedance.sampling.drawn import DrawnPosterior
from bayes_impedance.sampling.draws import Draws, Progress
from bayes_impedance.sampling.impedance_draws import draw_impedance
from bayes_impedance.sampling.importance import laplace_draws
from bayes_impedance.sampling.latents import draw_latents
from bayes_impedance.sampling.parameters import QUANTITIES
from bayes_impedance.sampling.places import choose_places
from bayes_impedance.sampling.start import find_start
from bayes_impedance.sampling.support import Evidence, exact_off_diagonals, exact_verdicts
from bayes_impedance.sampling.transport import TransportedDensity
from bayes_impedance.sampling.variational import svi_draws
from bayes_impedance.trajectory_mean import TrajectoryMean

Array = NDArray[np.float64]

#: Called with what is being done ("mode", "chain 2", "latents"), how much of it, of how much, and a line about it.
Hook = Callable[[str, int, int, str], None]

#: Draws of the prior that verdicts compare with.
PRIOR_DRAWS = 500


@dataclass(frozen=True)
class Problem:
    """What is sampled: the forces of `evidence`, latents at the samples of `log`, the prior mean of x_d.

    `inducing` inputs of K, D and M, where a training chose them.
    """

    config: Config
    evidence: PreparedLog
    log: PreparedLog
    mean: TrajectoryMean
    inducing: tuple[Tensor | None, ...] | None = None


@one_thread()
def sample_posterior(
    problem: Problem, settings: SamplingConfig, hook: Hook | None = None, checkpoint: Path | None = None
) -> DrawnPosterior:
    """Draw impedance and hyperparameters given the forces, then all else given those.

    `checkpoint` is a folder that keeps what chains have drawn: a run that was stopped continues from it.

    Raises:
        LogError: a group has no forces.
        ConfigurationError: no engine holds the processes.
        TooManySamplesError: dense is asked for, and the samples are too many.
        NotPositiveDefiniteError: the density is not finite about its mode.
        SamplingError: every chain died.
        OutputError: the checkpoint is of another posterior, or cannot be written.
    """
    config, log = problem.config, problem.log
    _check_forces(problem)
    # Engines take the groups of both in one order.
    trials = sorted(problem.evidence.trials, key=lambda trial: log.groups.index(trial.group))
    evidence = replace(problem.evidence, trials=tuple(trials))
    feature_map = FeatureMap(config, log.axes)
    places = choose_places(config, log, settings.places)
    labels = label_trials(places.log, evidence)
    given = feature_map(evidence, problem.mean, labels, observed=True)
    target = feature_map(places.log, problem.mean, labels, samples=places.samples)
    model = build_force_model(config, feature_map)
    inducing = problem.inducing or choose_inducing(config, model, given)
    density = JointDensity(config, model, given, inducing)
    kept = None if checkpoint is None else Checkpoint(checkpoint, _fingerprint(problem, inducing))
    draws = draw(density, config.training, settings, hook, kept)
    standard = draws.standard.reshape(-1, density.size)
    latents = draw_latents(density, standard, target, settings.seed, _drawing(hook))
    latents |= draw_impedance(density, standard, target, settings.seed)
    diagnosis = diagnose(draws, names_of_coordinates(density.parameters, log.axes), settings.max_tree_depth)
    unsaid = DrawnPosterior(config, density, draws, places, target, latents, diagnosis, ())
    return _with_verdicts(unsaid, problem)


def draw(
    density: JointDensity,
    training: TrainingConfig,
    settings: SamplingConfig,
    hook: Hook | None = None,
    checkpoint: Checkpoint | None = None,
    processes: int | None = None,
) -> Draws:
    """Draws of the density by the method that is set, from the mode of greatest evidence on.

    Chains run in as many `processes` at a time, or one for each core. Samplers move in the coordinates of
    `TransportedDensity`; `lp` is the density of those.

    Raises:
        NotPositiveDefiniteError: the density is not finite about its mode.
        SamplingError: every chain died.
        OutputError: the checkpoint is of another posterior, or cannot be written.
    """
    if checkpoint is not None and settings.method == "nuts":
        # Before the climb, which may take minutes.
        checked(checkpoint, settings)
    transported = TransportedDensity(density)
    start = find_start(transported, training, progress=_climbing(hook))
    if settings.method == "svi":
        found = svi_draws(transported, start, settings, _sampling(hook))
    elif settings.method == "laplace":
        found = laplace_draws(transported, start, settings, _sampling(hook))
    else:
        found = sample_nuts(transported, start, settings, _sampling(hook), checkpoint, processes)
    return replace(found, standard=transported.all_standard(found.standard))


def _fingerprint(problem: Problem, inducing: tuple[Tensor | None, ...]) -> dict[str, str]:
    """What draws depend on beside the settings of sampling."""
    described = problem.config.model_dump(mode="json", exclude={"sampling", "baseline", "log"})
    means = [problem.mean.derivatives(trial).tobytes() for trial in problem.evidence.trials]
    inputs = [b"" if inputs is None else inputs.numpy().tobytes() for inputs in inducing]
    return {
        "model": hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()[:16],
        "recordings": problem.evidence.fingerprint()[:16],
        # Those of a model that was trained on another log are others.
        "choice of inducing inputs": hashlib.sha256(b"".join(inputs)).hexdigest()[:16],
        "prior mean of the desired trajectory": hashlib.sha256(b"".join(means)).hexdigest()[:16],
        # Those of torch and Pyro are among what chains depend on.
        "bayes_impedance": version("bayes-impedance"),
    }


def _check_forces(problem: Problem) -> None:
    known = {trial.group for trial in problem.evidence.trials}
    lacking = [group for group in problem.log.groups if group not in known]
    if lacking:
        raise LogError(
            f"expected forces of every group to sample from, found none of group '{lacking[0]}'; name a log with "
            "force, or leave that group out"
        )


def _with_verdicts(drawn: DrawnPosterior, problem: Problem) -> DrawnPosterior:
    trials = (*problem.log.trials, *problem.evidence.trials)
    evidence = _evidence(drawn)
    verdicts = exact_verdicts(
        evidence,
        problem.config,
        drawn.axes,
        count_repetitions(problem.log, problem.evidence.trials),
        was_perturbed(trials),
    )
    beside = exact_off_diagonals(evidence, drawn.axes) if drawn.coupled else []
    return replace(drawn, verdicts=tuple(verdicts), off_diagonals=tuple(beside))


def _evidence(drawn: DrawnPosterior) -> Evidence:
    """Draws of K, D and M at the places, their prior, and what else verdicts need."""
    values = {name: value.reshape(-1, *value.shape[2:]) for name, value in drawn.values().items()}
    posterior, prior, log_prior = {}, {}, {}
    before = drawn.prior_impedance(PRIOR_DRAWS)
    for latent, j in IMPEDANCE_ORDER.items():
        posterior[latent] = _by_place(drawn.matrices(latent))
        prior[latent] = before[latent]
        weights = values[f"{QUANTITIES[j]}_weights"]
        # The first weight of an entry is that of its level; the first entries are those of the diagonal.
        levels = weights[..., : len(drawn.axes), 0]
        log_prior[latent] = -0.5 * np.square(levels).sum(axis=1)
    sd = values.get("desired_trajectory_sd")
    return Evidence(posterior, prior, None if sd is None else sd[..., 0], log_prior)


def _by_place(matrices: Array) -> Array:
    """`(chains, draws, …, axes, axes)` as `(all draws, places, axes, axes)`."""
    axes = matrices.shape[-1]
    return matrices.reshape(matrices.shape[0] * matrices.shape[1], -1, axes, axes)


def _climbing(hook: Hook | None) -> Callable[[int, float], None] | None:
    if hook is None:
        return None
    return lambda iteration, value: hook("mode", iteration, 0, f"log posterior {value:.2f}")


def _sampling(hook: Hook | None) -> Progress | None:
    if hook is None:
        return None
    return lambda chain, done, total, line: hook(f"chain {chain + 1}", done, total, line)


def _drawing(hook: Hook | None) -> Callable[[int, int], None] | None:
    if hook is None:
        return None
    return lambda done, total: hook("latents", done, total, "")
