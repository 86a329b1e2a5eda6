"""Training where impedance is a function: the best of some modes, and what a model has to keep of it."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.config import Config
from bayes_impedance.engines.choice import EngineChoice, build_engine, choose_engine
from bayes_impedance.engines.given_impedance import Processes
from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.features import Features
from bayes_impedance.impedance_functions.density import Density
from bayes_impedance.impedance_functions.fit import Mode, find_mode
from bayes_impedance.impedance_functions.function import build_functions, choose_inducing
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
    """
    coupled = config.model.axes == "coupled"
    periodic = config.model.desired_trajectory.periodic
    processes = Processes.of(model, periodic)
    built = build_engine(engine, config.engine, processes, features, coupled)
    return Density(model, build_functions(config, model, inducing), built, features, coupled, periodic)


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
    start_of_variation = {entry.name: entry.raw.detach().clone() for entry in model.entries}
    search = _Search(config, progress)
    for restart in range(config.training.restarts):
        with torch.no_grad():
            for entry in model.entries:
                entry.raw.copy_(start_of_variation[entry.name])
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
    likelihood: float
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
        _level_at_average(density, mode.point)
        likelihood = mode.log_evidence - float(density.log_hyperpriors().detach())
        raws = {entry.name: entry.raw.detach().clone() for entry in density.model.entries}
        self.found.append(_Found(restart, mode, likelihood, raws, _log_sds(density, mode)))
        self._append(
            restart, mode.log_evidence, likelihood, mode.iterations, mode.evaluations, mode.outcome, clock
        )
        return mode.outcome

    def best(self) -> _Found:
        if not self.found:
            assert self.failure is not None
            raise self.failure
        return max(self.found, key=lambda one: one.mode.log_evidence)

    def report(self, best: _Found, samples: int) -> TrainingReport:
        return TrainingReport(
            restarts=tuple(self.reports),
            best=(best.restart,),
            log_likelihood=(best.likelihood,),
            objective=(best.mode.log_evidence,),
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

    def _hook(self, restart: int):  # type: ignore[no-untyped-def] # a closure of one line
        progress = self.progress
        return None if progress is None else lambda iteration, value: progress(restart, iteration, value)

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


def _level_at_average(density: Density, point: Array) -> None:
    """Put the levels of the model's own priors where the functions are on average, for whoever reads them there."""
    weights = density.weights(torch.from_numpy(point))
    parts = zip(density.functions, density.designs.designs, weights, strict=True)
    for entry_name, (function, design, own) in zip(("stiffness", "damping", "mass"), parts, strict=True):
        entry = next(e for e in density.model.entries if e.name == f"{entry_name}.level")
        if entry.specs[0].fixed:
            continue
        with torch.no_grad():
            diagonal = function.logarithm(design, own)[..., : function.axes].mean((0, 1)).exp()
            function.process.level = diagonal.reshape(function.process.raw_level.shape)


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
