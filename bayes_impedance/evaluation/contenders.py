"""Who is compared in an evaluation: the impedance model, its baselines, and other models on the same samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.baselines.ensemble import EnsembleModel, check_repetitions
from bayes_impedance.baselines.kalman import ExtendedKalmanFilter
from bayes_impedance.baselines.naive import NaiveModel
from bayes_impedance.baselines.recursive import RecursiveLeastSquares
from bayes_impedance.baselines.samples import check_force, check_groups
from bayes_impedance.baselines.without_residual import without_residual
from bayes_impedance.config import Config, DeviceConfig, TrainingConfig
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.training import Progress, TrainingReport

Array = NDArray[np.float64]

Baseline = Literal["naive", "without-residual", "ensemble", "ensemble-diagonal", "rls", "ekf"]
IMPEDANCE = "impedance"

#: Opened around each training with its settings and what is trained ("fold 2 of 5: naive"); gives its progress.
Watch = Callable[[TrainingConfig, str], AbstractContextManager[Progress]]


class ForcePrediction(Protocol):
    """Mean and SD of a new measurement of force at each sample, `(samples, axes)` [N]."""

    @property
    def mean(self) -> Array:
        """Mean [N]."""

    @property
    def sd(self) -> Array:
        """SD [N]."""


@dataclass(frozen=True)
class Predictor:
    """What training makes of a contender: force of a log given the training forces alone.

    `model` is the impedance model behind it, None where a baseline is no such model.
    """

    predict: Callable[[PreparedLog], ForcePrediction]
    model: ImpedanceModel | None = None

    @classmethod
    def of(cls, model: ImpedanceModel) -> Predictor:
        """The predictor that a fitted model is."""

        def predict(log: PreparedLog) -> ForcePrediction:
            return model.posterior(log, given="training", latents=[Latent.FORCE])[Latent.FORCE]

        return cls(predict, model)


Trainer = Callable[[Config, PreparedLog, Progress | None], Predictor]

#: Refuses training and target logs, in this order, that a contender can do nothing with.
Check = Callable[[PreparedLog, PreparedLog], None]


def train_impedance(config: Config, log: PreparedLog, progress: Progress | None) -> Predictor:
    """An impedance model, fitted.

    Raises:
        KeyboardInterrupt: the user stopped it.
    """
    model = ImpedanceModel(config).fit(log, progress)
    _check_finished(model.report)
    return Predictor.of(model)


def _naive(config: Config, log: PreparedLog, progress: Progress | None) -> Predictor:
    model = NaiveModel(config, log, progress)
    _check_finished(model.report)
    return Predictor(lambda target: model.predict(target)[Latent.FORCE])


def _check_finished(report: TrainingReport) -> None:
    if report.interrupted:
        raise KeyboardInterrupt


def _ensemble(config: Config, log: PreparedLog, _: Progress | None, *, coupled: bool) -> Predictor:
    return Predictor(EnsembleModel(config, log, coupled).predict)


def _recursive(config: Config, log: PreparedLog, _: Progress | None) -> Predictor:
    return Predictor(RecursiveLeastSquares(config, log).predict)


def _kalman(config: Config, log: PreparedLog, _: Progress | None) -> Predictor:
    return Predictor(ExtendedKalmanFilter(config, log).predict)


def accept(training: PreparedLog, target: PreparedLog) -> None:
    """What models refuse they refuse on their own."""


def _check_estimable(training: PreparedLog, target: PreparedLog) -> None:
    check_force(training)
    check_groups(training.groups, target)


def _check_ensemble(training: PreparedLog, target: PreparedLog) -> None:
    check_repetitions(training)
    check_groups(training.groups, target)


@dataclass(frozen=True)
class _Kind:
    """A kind of baseline: its name in tables and JSON, what trains it, and what refuses logs before that."""

    name: str
    trainer: Trainer
    check: Check = accept


_KINDS: Mapping[Baseline, _Kind] = {
    "naive": _Kind("naive", _naive),
    "without-residual": _Kind("impedance_without_residual", train_impedance),
    "ensemble": _Kind("ensemble_coupled", partial(_ensemble, coupled=True), _check_ensemble),
    "ensemble-diagonal": _Kind("ensemble_diagonal", partial(_ensemble, coupled=False), _check_ensemble),
    "rls": _Kind("recursive_least_squares", _recursive, _check_estimable),
    "ekf": _Kind("extended_kalman_filter", _kalman, _check_estimable),
}


@dataclass(frozen=True)
class Contender:
    """A row of the table that can be trained: a configuration, and what trains under it.

    `check` tells before anything is trained whether it can be.
    """

    name: str
    config: Config
    trainer: Trainer = train_impedance
    check: Check = accept

    def train(self, log: PreparedLog, watch: Watch | None = None, where: str = "") -> Predictor:
        """A predictor trained on `log`; `where` precedes its name in the progress.

        Raises:
            KeyboardInterrupt: the user stopped it; half trained it would be no fair competitor.
        """
        opened = nullcontext() if watch is None else watch(self.config.training, f"{where}{self.name}")
        with opened as progress:
            return self.trainer(self.config, log, progress)


def baseline_contenders(config: Config, baselines: Sequence[Baseline]) -> list[Contender]:
    """The baselines of a configuration, each once.

    Raises:
        ConfigurationError: a baseline is unknown, or does not differ from the model.
    """
    contenders = []
    for baseline in dict.fromkeys(baselines):
        if baseline not in get_args(Baseline):
            raise ConfigurationError(
                f"baselines: expected some of {', '.join(get_args(Baseline))}, got {baseline!r}; choose among them"
            )
        its = without_residual(config) if baseline == "without-residual" else config
        kind = _KINDS[baseline]
        contenders.append(Contender(kind.name, its, kind.trainer, kind.check))
    return contenders


def check_comparable(config: Config, against: Mapping[str, ImpedanceModel]) -> None:
    """Refuse other models that are not of the same samples as `config`: sections `log` and `preprocessing` are equal.

    So is `device`, where a model takes the acceleration from its law.

    Raises:
        ConfigurationError: they differ, or a name is taken.
    """
    for name, model in against.items():
        taken = (IMPEDANCE, *(kind.name for kind in _KINDS.values()))
        if name in taken:
            raise ConfigurationError(
                f"against: expected names other than {', '.join(taken)}, got {name!r}; rename that model"
            )
        for section in ("log", "preprocessing"):
            mine, its = (getattr(c, section).model_dump(mode="json") for c in (config, model.config))
            for key, value in mine.items():
                if its[key] != value:
                    raise ConfigurationError(
                        f"{name}: expected the same {section}.{key} as the model that it is compared with "
                        f"({_shown(value)}), so that both see the same samples, got {_shown(its[key])}; set it alike"
                    )
        if _law(config) != _law(model.config):
            raise ConfigurationError(
                f"{name}: expected the same device as the model that it is compared with, for one of them takes the "
                "acceleration from its law, so that both see the same samples; set it alike, or device.acceleration: "
                "measured in both"
            )


def _law(config: Config) -> DeviceConfig | None:
    """The device whose law gives the acceleration."""
    return config.device if config.device is not None and config.device.acceleration == "law" else None


def _shown(value: object) -> str:
    """A setting as YAML's flow style has it, near enough to be copied."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_shown(inner)}" for key, inner in value.items()) + "}"
    return "null" if value is None else str(value)
