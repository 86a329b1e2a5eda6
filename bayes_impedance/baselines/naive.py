"""The naive GP: a squared exponential over the same inputs, with nothing known of arms."""

from __future__ import annotations

import copy

from bayes_impedance.config import Config, DesiredTrajectoryPrior, ResidualPrior
from bayes_impedance.errors import LogError
from bayes_impedance.features import (
    FeatureMap,
    LogFeatures,
    baseline_components,
    label_trials,
    labels_of,
)
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.posterior import Posterior, infer_log
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import Entry, ForceModel, build_naive_model
from bayes_impedance.training import Progress, TrainingReport, train
from bayes_impedance.trajectory_mean import TrajectoryMean


class NaiveModel:
    """u ~ GP(0, SE(ξ)) + noise, one function a group, trained with the same care as the impedance model.

    Hyperpriors are those of the impedance model's residual and noise; optimiser and restarts are the same.

    Raises:
        LogError: the training log has no force.
    """

    def __init__(self, config: Config, log: PreparedLog, progress: Progress | None = None) -> None:
        self._config = naive_config(config)
        self._log = log
        self._map = FeatureMap(self._config, log.axes)
        features = self._map(log, self._mean(log), observed=True)
        if features.force is None:
            raise LogError("expected a log with force to train on, found none; name log.columns.force")
        self._model: ForceModel = build_naive_model(self._config, self._map)
        self.report: TrainingReport = train(
            self._model, features, config.training, config.engine.jitter, progress
        )

    @property
    def hyperparameters(self) -> tuple[Entry, ...]:
        """Hyperparameters with unit, hyperprior and value `(axes, 1, 1, components)`."""
        return self._model.entries

    def given(self, log: PreparedLog) -> NaiveModel:
        """The same hyperparameters, given the forces of `log` in the place of those that trained them."""
        other = copy.copy(self)
        other._log = log
        return other

    def predict(self, log: PreparedLog) -> Posterior:
        """Force of `log` given the training forces; only the marginal of `Latent.FORCE`."""
        labels = label_trials(self._log, log)
        target, given = (
            LogFeatures(self._map, one, self._mean(one), labels_of(one, labels)) for one in (log, self._log)
        )
        return infer_log(self._model, target, given, self._config.engine.jitter, [Latent.FORCE])

    def _mean(self, log: PreparedLog) -> TrajectoryMean:
        return TrajectoryMean.from_training(self._config.model.desired_trajectory, log)


def naive_config(config: Config) -> Config:
    """`config` with the baseline's inputs as those of the residual, and no prior mean; its axes are independent."""
    residual = config.model.residual or ResidualPrior()
    components = baseline_components(config)
    model = config.model.model_copy(
        update={
            "axes": "independent",
            "desired_trajectory": DesiredTrajectoryPrior(mean="equilibrium"),
            "residual": residual.model_copy(update={"input": components, "offset_sd": None}),
        }
    )
    baseline = config.baseline.model_copy(update={"input": components})
    return config.model_copy(update={"model": model, "baseline": baseline})
