"""Who is compared in an evaluation: the impedance model, its baselines, and other models on the same samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Literal, get_args

from bayes_impedance.baselines.naive import NaiveModel
from bayes_impedance.baselines.without_residual import without_residual
from bayes_impedance.config import Config, DeviceConfig, TrainingConfig
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.posterior import Posterior
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.training import Progress

Baseline = Literal["naive", "without-residual"]
IMPEDANCE = "impedance"
#: Names of the baselines in tables and JSON.
BASELINES: Mapping[Baseline, str] = {"naive": "naive", "without-residual": "impedance_without_residual"}

Predictor = ImpedanceModel | NaiveModel

#: Opened around each training with its settings and what is trained ("fold 2 of 5: naive"); gives its progress.
Watch = Callable[[TrainingConfig, str], AbstractContextManager[Progress]]


@dataclass(frozen=True)
class Contender:
    """A row of the table that can be trained: a configuration, or the naive GP under it."""

    name: str
    config: Config
    naive: bool = False

    def train(self, log: PreparedLog, watch: Watch | None = None, where: str = "") -> Predictor:
        """A predictor trained on `log`; `where` precedes its name in the progress.

        Raises:
            KeyboardInterrupt: the user stopped it; half trained it would be no fair competitor.
        """
        opened = nullcontext() if watch is None else watch(self.config.training, f"{where}{self.name}")
        with opened as progress:
            predictor: Predictor
            if self.naive:
                predictor = NaiveModel(self.config, log, progress)
            else:
                predictor = ImpedanceModel(self.config).fit(log, progress)
        if predictor.report.interrupted:
            raise KeyboardInterrupt
        return predictor


def predict_force(predictor: Predictor, log: PreparedLog) -> Posterior:
    """Force of `log` given the training forces alone."""
    if isinstance(predictor, NaiveModel):
        return predictor.predict(log)
    return predictor.posterior(log, given="training", latents=[Latent.FORCE])


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
        naive = baseline == "naive"
        contenders.append(
            Contender(BASELINES[baseline], config if naive else without_residual(config), naive)
        )
    return contenders


def check_comparable(config: Config, against: Mapping[str, ImpedanceModel]) -> None:
    """Refuse other models that are not of the same samples as `config`: sections `log` and `preprocessing` are equal.

    So is `device`, where a model takes the acceleration from its law.

    Raises:
        ConfigurationError: they differ, or a name is taken.
    """
    for name, model in against.items():
        taken = (IMPEDANCE, *BASELINES.values())
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
