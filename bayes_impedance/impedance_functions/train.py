"""Training where impedance is a function: the best of some modes, and what a model has to keep of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.config import Config
from bayes_impedance.engines.choice import EngineChoice, build_engine, choose_engine
from bayes_impedance.engines.given_impedance import Processes
from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.features import Features
from bayes_impedance.impedance_functions.density import Density, beside_impedance
from bayes_impedance.impedance_functions.fit import Mode, find_mode
from bayes_impedance.impedance_functions.function import build_functions, choose_inducing
from bayes_impedance.impedance_functions.threads import one_thread
from bayes_impedance.priors import ForceModel
from bayes_impedance.training import Progress, RestartReport, TrainingReport

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FittedFunctions:
    """Mode and Laplace covariance of a `Density`, and all that it takes to build one again.

    `groups` of the training log; `point` `(size,)`; `covariance` `(free, free)`; `inducing` inputs of K, D and M,
    `(Z, D)` each, None for a constant; `engine` that computed the likelihood.
    """

    groups: tuple[str, ...]
    point: Array
    covariance: Array
    inducing: tuple[Tensor | None, ...]
    engine: EngineChoice


def build_density(
    config: Config,
    model: ForceModel,
    features: Features,
    inducing: tuple[Tensor | None, ...],
    engine: str,
) -> Density:
    """The density of functions and hyperparameters given the forces of `features`.

    Raises:
        ConfigurationError: the engine cannot hold the processes.
        TooManySamplesError: the engine is dense, and the samples are too many.
    """
    coupled = config.model.axes == "coupled"
    periodic = config.model.desired_trajectory.periodic
    processes = Processes.of(model, periodic)
    built = build_engine(engine, config.engine, processes, features, coupled)
    return Density(model, build_functions(config, model, inducing), built, features, coupled, periodic)


def expected_sizes(config: Config, model: ForceModel, fitted: FittedFunctions) -> tuple[int, int]:
    """Coordinates of the point that `fitted` should have, and those of them that are free."""
    functions = build_functions(config, model, fitted.inducing)
    weights = len(fitted.groups) * sum(len(function.places) * function.width for function in functions)
    entries = beside_impedance(model)
    size = weights + sum(entry.raw.numel() for entry in entries)
    free = weights + sum(len(entry.raw) * int(entry.free.sum()) for entry in entries)
    return size, free


@one_thread()
def train_functions(
    config: Config, model: ForceModel, features: Features, progress: Progress | None = None
) -> tuple[FittedFunctions, TrainingReport]:
    """Functions and hyperparameters of greatest evidence; `model` is left at them.

    Restart 0 starts at the hyperprior medians, the others at draws. Interrupting (Ctrl-C) after a restart keeps the
    best.

    Raises:
        NotPositiveDefiniteError: no restart found a finite likelihood.
        ConfigurationError: no engine holds the processes.
        TooManySamplesError: dense is asked for, and the samples are too many.
    """
    processes = Processes.of(model, config.model.desired_trajectory.periodic)
    choice = choose_engine(config.engine, processes, features, config.model.axes == "coupled")
    inducing = choose_inducing(config, model, features)
    initial = {entry.name: entry.raw.detach().clone() for entry in model.entries}
    search = _Search(config, progress)
    for restart in range(config.training.restarts):
        with torch.no_grad():
            for entry in model.entries:
                entry.raw.copy_(initial[entry.name])
        density = build_density(config, model, features, inducing, choice.name)
        if search.run(restart, density) == "interrupted":
            break
    best = search.best()
    with torch.no_grad():
        for entry in model.entries:
            entry.raw.copy_(best.raws[entry.name])
    fitted = FittedFunctions(features.groups, best.mode.point, best.mode.covariance, inducing, choice)
    samples = sum(len(rows) for rows in features.rows)
    return fitted, search.report(best, samples)


@dataclass(frozen=True)
class _Found:
    """A mode, with every hyperparameter, unconstrained, and what their posterior SDs are."""

    restart: int
    mode: Mode
    raws: dict[str, Tensor]
    log_sd: dict[str, list[list[float]]]


class _Search:
    """Restarts, and the best of them."""

    def __init__(self, config: Config, progress: Progress | None) -> None:
        self.training, self.progress = config.training, progress
        self.generator = np.random.default_rng(config.training.seed)
        self.found: list[_Found] = []
        self.reports: list[RestartReport] = []
        self.failure: NotPositiveDefiniteError | None = None

    def run(self, restart: int, density: Density) -> str:
        clock = time.perf_counter()
        start = self._start(restart, density)
        try:
            mode = find_mode(
                density, start, self.training.max_iterations, self.training.gradient_tolerance, self._hook(restart)
            )  # fmt: skip
        except NotPositiveDefiniteError as error:
            self.failure = error
            return self._failed(restart, f"stopped: {error}", clock)
        except KeyboardInterrupt:
            if not self.found:
                raise
            return self._failed(restart, "interrupted", clock)
        log_sd = _set_levels(density, mode) | _log_sds(density, mode)
        raws = {entry.name: entry.raw.detach().clone() for entry in density.model.entries}
        self.found.append(_Found(restart, mode, raws, log_sd))
        self._append(
            restart, mode.log_posterior, mode.log_evidence, mode.iterations, mode.evaluations, mode.outcome, clock
        )  # fmt: skip
        return mode.outcome

    def best(self) -> _Found:
        if not self.found:
            assert self.failure is not None
            raise self.failure
        return max(self.found, key=lambda one: one.mode.log_posterior)

    def report(self, best: _Found, samples: int) -> TrainingReport:
        return TrainingReport(
            restarts=tuple(self.reports),
            best=(best.restart,),
            log_likelihood=(best.mode.log_evidence,),
            objective=(best.mode.log_posterior,),
            log_sd=best.log_sd,
            interrupted=any(report.outcome == "interrupted" for report in self.reports),
            samples=samples,
        )

    def _start(self, restart: int, density: Density) -> Array:
        """Weights at their prior mean; hyperparameters at their medians, or drawn."""
        point = density.start()
        if restart:
            spreads = [np.tile(e.log_sds.numpy() / e.power, e.raw.shape[0]) for e in density.entries]
            spread = np.concatenate([np.zeros(density.weight_count), *spreads])
            point = point + spread * density.free * self.generator.standard_normal(point.shape)
        return point

    def _hook(self, restart: int) -> Callable[[int, float], None] | None:
        return None if self.progress is None else partial(self.progress, restart)

    def _failed(self, restart: int, outcome: str, clock: float) -> str:
        self._append(restart, -np.inf, -np.inf, 0, 0, outcome, clock)
        return outcome

    def _append(
        self, restart: int, objective: float, likelihood: float, iterations: int, evaluations: int, outcome: str,
        clock: float,
    ) -> None:  # fmt: skip
        seconds = time.perf_counter() - clock
        self.reports.append(
            RestartReport(restart, (objective,), (likelihood,), iterations, evaluations, seconds, outcome)
        )


def _set_levels(density: Density, mode: Mode) -> dict[str, list[list[float]]]:
    """Put the levels of the model's own priors where the functions are on average, for whoever reads them there.

    Averages of the diagonal of the logarithm, over the samples of all groups. Returns their Laplace SDs by name.
    """
    log_sd = {}
    processes = density.model.kernel.impedance.processes
    parts = zip(
        ("stiffness", "damping", "mass"), processes, density.functions, density.designs.designs, strict=True
    )
    entries = {entry.name: entry for entry in density.model.entries}
    share = _shares(density.features)
    start = 0
    for name, process, function, design in parts:
        groups, places, width = design.shape[0], design.shape[1], design.shape[3]
        count = groups * places * width
        if not entries[f"{name}.level"].specs[0].fixed:
            average = torch.einsum("genw,gn->gew", design, share).numpy()
            where = np.arange(start, start + count).reshape(groups, places, width)
            levels, spreads = [], []
            for e in range(function.axes):
                own, factor = where[:, e].reshape(-1), average[:, e].reshape(-1)
                levels.append(float(function.location[e]) + factor @ mode.point[own])
                spreads.append([float(np.sqrt(factor @ mode.covariance[np.ix_(own, own)] @ factor))])
            shape = process.raw_level.shape
            process.level = torch.tensor(levels, dtype=torch.float64).exp().reshape(shape)
            log_sd[f"{name}.level"] = spreads
        start += count
    return log_sd


def _shares(features: Features) -> Tensor:
    """What each sample has in an average over all, `(groups, n)`; zero on padding."""
    ones = features.inputs.new_ones(features.inputs.shape[1:3])
    counted = ones if features.valid is None else ones * features.valid
    return counted / counted.sum()


def _log_sds(density: Density, mode: Mode) -> dict[str, list[list[float]]]:
    """Laplace SD of the logarithm of each hyperparameter beside impedance; NaN where it is fixed."""
    spread = np.full(mode.point.shape, np.nan)
    spread[density.free] = np.sqrt(np.diag(mode.covariance))
    result, start = {}, density.weight_count
    for entry in density.entries:
        stop = start + entry.raw.numel()
        own = entry.power * spread[start:stop].reshape(entry.raw.shape[0], -1)
        result[entry.name] = own.tolist()
        start = stop
    return result
