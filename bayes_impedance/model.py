"""The high level: configure, fit, posterior, evaluate."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import torch

from bayes_impedance.config import Config, SamplingConfig, as_functions, load_config
from bayes_impedance.device import follow_law
from bayes_impedance.engines.choice import LOCAL, MOMENTS, EngineChoice
from bayes_impedance.engines.dense import Observations, check_capacity
from bayes_impedance.engines.pointwise import PointPredictor
from bayes_impedance.errors import ConfigurationError, LogError
from bayes_impedance.features import (
    FeatureMap,
    LogFeatures,
    check_combination,
    count_repetitions,
    label_trials,
    labels_of,
    trial_key,
)
from bayes_impedance.identifiability import Verdict, assess, was_perturbed
from bayes_impedance.impedance_functions.posterior import (
    compute_function_posterior,
    condition,
    function_evidence,
)
from bayes_impedance.impedance_functions.train import FittedFunctions, train_functions
from bayes_impedance.journal import Journal
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.log import InteractionLog
from bayes_impedance.posterior import Posterior, infer_log
from bayes_impedance.posterior.batches import Progress as InferenceProgress
from bayes_impedance.posterior.local import infer_local
from bayes_impedance.preprocessing import PreparedLog, prepare
from bayes_impedance.priors import Entry, ForceModel, build_force_model
from bayes_impedance.sampling.drawn import DrawnPosterior
from bayes_impedance.sampling.sample import Hook as SamplingProgress
from bayes_impedance.sampling.sample import Problem, sample_posterior
from bayes_impedance.training import Progress, TrainingReport, log_evidence, observations, train
from bayes_impedance.trajectory_mean import TrajectoryMean

#: Forces that a posterior conditions on: of the training log, of the log at hand, or of both.
Given = Literal["both", "training", "log"]


@dataclass(frozen=True)
class Fit:
    """What a model knows after training: hyperparameters, the prepared log that gave them, and how.

    And the functions, where impedance is one (`engine.impedance: map`).
    """

    force_model: ForceModel
    log: PreparedLog
    report: TrainingReport
    functions: FittedFunctions | None = None


class ImpedanceModel:
    """Arm impedance and desired trajectory from motion and interaction force.

    Immutable: `fit` returns a new model. Without a fit the hyperparameters stand at their medians.

    Example:
        >>> from bayes_impedance.simulation.generative import draw_force, repeated_motion
        >>> motion = repeated_motion(repetitions=2, duration=2.0, rate=10.0, axes=("x",))
        >>> model = ImpedanceModel.from_config("phase", ["training.restarts=1", "training.max_iterations=5"])
        >>> model = model.fit(draw_force(model.config, motion, seed=0))
        >>> stiffness = model.posterior(motion)["stiffness"]
        >>> stiffness.mean.shape, bool((stiffness.quantile(0.05) > 0).all())
        ((40, 1), True)
    """

    def __init__(self, config: Config, fit: Fit | None = None) -> None:
        self.config = config
        self._fit = fit
        self._trained_mean: TrajectoryMean | None = None

    @classmethod
    def from_config(cls, source: str | Path | Config, overrides: Iterable[str] = ()) -> ImpedanceModel:
        """Model from a configuration file, the name of a shipped one, or a `Config`.

        Raises:
            ConfigurationError: see `load_config`.
        """
        return cls(source if isinstance(source, Config) else load_config(source, overrides))

    @property
    def is_fitted(self) -> bool:
        """Whether `fit` made this model."""
        return self._fit is not None

    @property
    def fitted(self) -> Fit:
        """What training found.

        Raises:
            ConfigurationError: the model was not fitted.
        """
        if self._fit is None:
            raise ConfigurationError("expected a fitted model, got an untrained one; call fit(log) first")
        return self._fit

    @property
    def report(self) -> TrainingReport:
        """How training went."""
        return self.fitted.report

    @property
    def parts(self) -> tuple[str, ...]:
        """What has a likelihood of its own, in the order of the report: each axis, or all, "xy".

        They have one together where they are coupled, or impedance is a function.
        """
        return self._parts(self.fitted.log.axes)

    @property
    def trajectory_mean(self) -> TrajectoryMean:
        """Prior mean of the desired trajectory, as learned from the training log."""
        return self._mean(self.fitted.log)

    @property
    def hyperparameters(self) -> tuple[Entry, ...]:
        """Hyperparameters with unit, hyperprior and value `(axes, 1, 1, components)`."""
        return self.fitted.force_model.entries

    def prepare(self, log: InteractionLog | PreparedLog) -> PreparedLog:
        """Smoothed, differentiated, resampled log, checked against the configuration.

        Raises:
            LogError, ConfigurationError: the log cannot serve this configuration.
        """
        prepared = log if isinstance(log, PreparedLog) else self._prepared(log)
        check_combination(self.config, prepared)
        if self._fit is not None and prepared.axes != self._fit.log.axes:
            raise LogError(
                f"expected a log with axes {', '.join(self._fit.log.axes)}, on which the model was trained, got "
                f"{', '.join(prepared.axes)}; set log.axes"
            )
        return prepared

    def fit(
        self,
        log: InteractionLog | PreparedLog,
        progress: Progress | None = None,
        start: ImpedanceModel | None = None,
        journal: Journal | None = None,
    ) -> ImpedanceModel:
        """A new model with hyperparameters trained on `log` (MAP of the marginal likelihood).

        The first restart begins at the values of `start`, a fitted model with the same hyperparameters, where one is
        given; such a refit has no Laplace approximation. `journal` keeps every evaluation, and a training that was
        killed continues from it to the same bits. Where impedance is a function there is neither.

        Raises:
            LogError, ConfigurationError, TooManySamplesError, NotPositiveDefiniteError.
            OutputError: the journal is of another training, or cannot be written.
        """
        prepared = ImpedanceModel(self.config).prepare(log)
        feature_map = FeatureMap(self.config, prepared.axes)
        features = feature_map(prepared, self._mean(prepared), observed=True)
        if features.force is None:
            raise LogError("expected a log with force to train on, found none; name log.columns.force")
        force_model = build_force_model(self.config, feature_map)
        if self._is_function:
            _check_anew(start, journal)
            functions, report = train_functions(self.config, force_model, features, progress)
            return ImpedanceModel(self.config, Fit(force_model, prepared, report, functions))
        self._check_capacity(prepared)
        if start is not None:
            force_model.start_at(start.hyperparameters)
        if journal is not None:
            journal.begin(self._objective_of(prepared))
        report = train(
            force_model,
            features,
            self.config.training,
            self.config.engine.jitter,
            progress,
            warm=start is not None,
            laplace=start is None,
            journal=journal,
        )
        return ImpedanceModel(self.config, Fit(force_model, prepared, report))

    def posterior(
        self,
        log: InteractionLog | PreparedLog,
        given: Given = "both",
        latents: Sequence[Latent] | None = None,
        progress: InferenceProgress | None = None,
    ) -> Posterior:
        """Posterior of every latent at every sample of `log`.

        `given`: the forces conditioned on: those of the training log ("training"), those of `log`
        itself ("log"), or both, a trial that stands in both counting once. `progress` hears how many samples are done,
        of how many; not where impedance is a function, which is found for all groups together.

        Raises:
            LogError, ConfigurationError, TooManySamplesError, NotPositiveDefiniteError.
        """
        prepared = self.prepare(log)
        evidence = self._evidence(prepared, given)
        functions = self._functions if self._is_function else None
        feature_map = FeatureMap(self.config, prepared.axes)
        mean = self._mean(prepared)
        # One labelling for both, so that a trial that is target and evidence keeps its own x_d and ũ.
        labels = label_trials(*([prepared] if evidence is None else [prepared, evidence]))
        target = LogFeatures(feature_map, prepared, mean, labels_of(prepared, labels))
        given_forces = None
        if evidence is not None:
            given_forces = LogFeatures(feature_map, evidence, mean, labels_of(evidence, labels))
        model = self._force_model(feature_map)
        if self._is_local:
            return infer_local(model, target, given_forces, self.config.engine.local, latents, progress)
        if functions is None:
            if evidence is not None:
                self._check_capacity(evidence)
            return infer_log(model, target, given_forces, self.config.engine.jitter, latents, progress)
        conditioned = None
        if evidence is not None and given_forces is not None:
            forces = given_forces(observed=True)
            conditioned = condition(self.config, model, functions, forces, self._is_training(evidence))
        return compute_function_posterior(
            self.config, model, functions, prepared, target(), conditioned, latents
        )

    def sample(
        self,
        log: InteractionLog | PreparedLog,
        given: Given = "both",
        settings: SamplingConfig | None = None,
        progress: SamplingProgress | None = None,
        checkpoint: Path | None = None,
    ) -> DrawnPosterior:
        """Draws of impedance, hyperparameters, desired trajectory and force from their exact posterior.

        The priors are those of the configuration: of a fitted model only the log counts, as far as `given` says (see
        `posterior`). `settings` in place of those of the configuration; `checkpoint`: a folder that keeps what was
        drawn, from which a run that was stopped continues.

        Raises:
            LogError, ConfigurationError, TooManySamplesError, NotPositiveDefiniteError, SamplingError.
            OutputError: the checkpoint is of another posterior, or cannot be written.
        """
        config = as_functions(self.config)
        prepared = self.prepare(log)
        evidence = self._evidence(prepared, given)
        if evidence is None:
            raise LogError("expected a log with force to sample from, found none; name log.columns.force")
        inducing = None if self._fit is None or self._fit.functions is None else self._fit.functions.inducing
        problem = Problem(config, evidence, prepared, self._mean(prepared), inducing)
        return sample_posterior(problem, settings or config.sampling, progress, checkpoint)

    def point_predictor(self, axis: str, group: str) -> PointPredictor:
        """Force at one sample at a time, given the training forces of a group: some .1 ms a call.

        Inputs of a sample are rows of `FeatureMap(config, axes)`, the columns that the kernels read.

        Raises:
            ConfigurationError: the model is not fitted, knows no such axis or group, or its axes are coupled.
        """
        log = self.fitted.log
        if self._is_function:
            raise ConfigurationError(
                "expected engine.impedance: moments to predict one sample at a time, got map; call posterior(log, "
                "latents=[Latent.FORCE])"
            )
        if self.config.model.axes == "coupled":
            raise ConfigurationError(
                "expected model.axes: independent to predict one sample of one axis at a time, got coupled; call "
                "posterior(log, latents=[Latent.FORCE]), or train with model.axes=independent"
            )
        if axis not in log.axes or group not in log.groups:
            raise ConfigurationError(
                f"expected an axis among {', '.join(log.axes)} and a group among {', '.join(log.groups)}, got "
                f"axis {axis!r} and group {group!r}"
            )
        feature_map = FeatureMap(self.config, log.axes)
        features = feature_map(log, self._mean(log), observed=True)
        a, g = log.axes.index(axis), features.groups.index(group)
        n = len(features.rows[g])
        model = self._force_model(feature_map)
        with torch.no_grad():
            given = observations(model, features)
            one = Observations(given.inputs[a, g, :n], given.residual[a, g, :n], given.noise_variance[a, 0])
        loop = None if features.loop is None else features.loop.one(a, g)
        return PointPredictor(model.kernel[a, 0], one, self.config.engine.jitter, loop)

    def log_marginal_likelihood(self, log: InteractionLog | PreparedLog) -> dict[str, float]:
        """log p(force of `log`) at the model's hyperparameters, by axis, summed over groups [nats].

        Coupled axes have one, under their joined names: "xy"; so have functions, integrated out by Laplace's method.

        Raises:
            LogError, ConfigurationError, TooManySamplesError, NotPositiveDefiniteError.
        """
        prepared = self.prepare(log)
        feature_map = FeatureMap(self.config, prepared.axes)
        features = feature_map(prepared, self._mean(prepared), observed=True)
        if features.force is None:
            raise LogError("expected a log with force, found none; name log.columns.force")
        model = self._force_model(feature_map)
        if self._is_function:
            evidence = function_evidence(self.config, model, self._functions, features)
            return {self._parts(prepared.axes)[0]: evidence}
        self._check_capacity(prepared)
        with torch.no_grad():
            value = log_evidence(model, features, self.config.engine.jitter)
        return dict(zip(self._parts(prepared.axes), value.tolist(), strict=True))

    def verdicts(self, posterior: Posterior | None = None) -> list[Verdict]:
        """What the data say of stiffness, damping and mass; by default at the training samples.

        Raises:
            ConfigurationError: levels are to be learned and the model is not fitted: its posterior would be
                centred wherever the hyperprior happens to be.
        """
        model = self.config.model
        impedance = (model.stiffness, model.damping, model.mass)
        levels = [prior.level for prior in impedance]
        levels += [prior.coupling for prior in impedance] if model.axes == "coupled" else []
        if not all(level.fixed for level in levels):
            _ = self.fitted
        if posterior is None:
            posterior = self.posterior(self.fitted.log)
        known = () if self._fit is None else self._fit.log.trials
        every = (*posterior.log.trials, *known)
        return assess(posterior, self.config, count_repetitions(posterior.log, known), was_perturbed(every))

    def force_model(self, axes: tuple[str, ...]) -> ForceModel:
        """The gpytorch kernel, mean and likelihood underneath, to take into one's own code."""
        return self._force_model(FeatureMap(self.config, axes))

    @property
    def engine(self) -> EngineChoice:
        """The engine that computes the likelihood, and why it.

        Raises:
            ConfigurationError: impedance is a function, and the model is not fitted: the log decides.
        """
        if not self._is_function:
            if self._is_local:
                return EngineChoice("local", LOCAL)
            return EngineChoice("dense", MOMENTS)
        return self._functions.engine

    @property
    def _functions(self) -> FittedFunctions:
        functions = self.fitted.functions
        assert functions is not None
        return functions

    @property
    def _is_local(self) -> bool:
        return self.config.engine.name == "local"

    @property
    def _is_function(self) -> bool:
        return self.config.engine.impedance == "map"

    def _is_training(self, evidence: PreparedLog) -> bool:
        """Whether these are all the forces of some of the groups that the model was trained on."""
        groups = set(evidence.groups)
        trained = [trial_key(trial) for trial in self.fitted.log.trials if trial.group in groups]
        return sorted(trained) == sorted(trial_key(trial) for trial in evidence.trials)

    def _parts(self, axes: tuple[str, ...]) -> tuple[str, ...]:
        joint = self.config.model.axes == "coupled" or self._is_function
        return ("".join(axes),) if joint else axes

    def _prepared(self, log: InteractionLog) -> PreparedLog:
        # Phase means the same in every log only if all are aligned to the repetition that the training log was.
        reference = None if self._fit is None else self._fit.log
        prepared = prepare(log, self.config.preprocessing, reference)
        return prepared if self.config.device is None else follow_law(prepared, self.config.device)

    def _force_model(self, feature_map: FeatureMap) -> ForceModel:
        # A copy, so that nobody changes a fitted model from outside.
        if self._fit is not None:
            return copy.deepcopy(self._fit.force_model)
        return build_force_model(self.config, feature_map)

    def _objective_of(self, log: PreparedLog) -> dict[str, object]:
        """All that the objective of training depends on; `training` says only where it is evaluated."""
        return {
            "bayes_impedance": version("bayes-impedance"),
            "torch": version("torch"),
            "configuration": self.config.model_dump(
                mode="json", exclude={"training", "sampling", "baseline"}
            ),
            "recordings": log.fingerprint()[:16],
        }

    def _mean(self, log: PreparedLog) -> TrajectoryMean:
        """Prior mean of x_d, learned from the training log where there is one, else from `log` itself."""
        prior = self.config.model.desired_trajectory
        if self._fit is None:
            return TrajectoryMean.from_training(prior, log)
        if self._trained_mean is None:
            self._trained_mean = TrajectoryMean.from_training(prior, self._fit.log)
        return self._trained_mean

    def _evidence(self, log: PreparedLog, given: Given) -> PreparedLog | None:
        """Trials whose forces are conditioned on: of the groups of `log`, each motion once."""
        trials = []
        if given in ("both", "log"):
            trials += [trial for trial in log.trials if trial.force is not None]
        if given in ("both", "training") and self._fit is not None:
            seen = {trial_key(trial) for trial in trials}
            groups = set(log.groups)
            trials += [
                trial
                for trial in self._fit.log.trials
                if trial.group in groups and trial_key(trial) not in seen
            ]
        return replace(log, trials=tuple(trials)) if trials else None

    def _check_capacity(self, log: PreparedLog) -> None:
        # Coupled axes stand in one covariance.
        coupled = len(log.axes) if self.config.model.axes == "coupled" else 1
        counted = f", each counted once for every of {coupled} coupled axes" if coupled > 1 else ""
        for group, members in log.by_group.items():
            n = sum(int(log.trials[i].observed.sum()) for i in members)
            check_capacity(coupled * n, self.config.engine.max_samples, f"group '{group}'{counted}")


def _check_anew(start: ImpedanceModel | None, journal: Journal | None) -> None:
    """Functions are found from their prior mean, every time."""
    for name, given in (("start", start), ("journal", journal)):
        if given is not None:
            raise ConfigurationError(
                f"{name}: expected none with engine.impedance: map, which finds functions anew each time, got one; "
                "leave it out, or set engine.impedance=moments"
            )
