"""Learning and prediction, sample by sample, inside a control loop."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray

from bayes_impedance.engines.local.build import build_local, learn_log
from bayes_impedance.engines.local.model import Coverage, Snapshot
from bayes_impedance.errors import ConfigurationError, LogError
from bayes_impedance.features import FeatureMap
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.online.inputs import SampleInputs, fill, is_usable
from bayes_impedance.online.sample import Sample
from bayes_impedance.online.storage import read_state, state_of, write_state
from bayes_impedance.training import observations

Floats = NDArray[np.float64]


class Prediction(NamedTuple):
    """By axis, `(axes,)` each: force of a new measurement [N], desired position [m] and velocity [m/s], variances.

    Levels of stiffness, damping and mass count as known.

    `coverage` is `LEARNED` where the model has been near; else these are the prior's.
    """

    force: Floats
    force_variance: Floats
    desired_position: Floats
    desired_position_variance: Floats
    desired_velocity: Floats
    desired_velocity_variance: Floats
    coverage: Coverage


class PredictorSnapshot:
    """What a predictor knew at one instant; any thread may ask it while the predictor goes on learning."""

    def __init__(self, inputs: SampleInputs, known: Snapshot) -> None:
        self._inputs, self._known = inputs, known

    def predict(self, sample: Sample) -> Prediction:
        """Force and desired trajectory at a sample, whose own force is not looked at.

        Raises:
            LogError: the sample lacks what the configuration asks for.
        """
        inputs, means = self._inputs(sample)
        known = self._known
        moments = known.predict(inputs)
        force = moments.mean[:, 0] + known.numbers.prior_mean(inputs)
        position, velocity = means[:, 0] + moments.mean[:, 1], means[:, 1] + moments.mean[:, 2]
        variance = moments.variance
        return Prediction(
            force,
            variance[:, 0] + known.noise,
            position,
            variance[:, 1],
            velocity,
            variance[:, 2],
            moments.coverage,
        )


class OnlinePredictor:
    """Local sparse models of a trained model's force that learn every sample of a stream (docs/model.md §17).

    Hyperparameters, and the range of motion that cells lie in, are those of the training; `warm`: what the training log
    tells is known from the start. Memory is bounded by `engine.local.cells`; a sample outside of the range teaches
    nothing, and its prediction is the prior. One thread updates; any thread may predict, from here or from a snapshot.

    Example:
        >>> from bayes_impedance.simulation.generative import draw_force, repeated_motion
        >>> settings = ["shared.residual=true", "training.restarts=1", "training.max_iterations=1"]
        >>> model = ImpedanceModel.from_config("position_velocity", settings)
        >>> log = draw_force(model.config, repeated_motion(repetitions=1, duration=2.0, rate=10.0), seed=0)
        >>> predictor = OnlinePredictor(model.fit(log))
        >>> trial = log.trials[0]
        >>> motion = trial.position[3], trial.velocity[3]
        >>> one = Sample(9.0, *motion, trial.force[3], trial.acceleration[3], trial.jerk[3])
        >>> predictor.update(one).name, predictor.samples
        ('LEARNED', 21)
        >>> predictor.predict(one).force.shape
        (2,)

    Raises:
        ConfigurationError: the model is not fitted or of a kind that streams cannot have, or there is no such group.
    """

    def __init__(self, model: ImpedanceModel, group: str | None = None, warm: bool = True) -> None:
        log = model.fitted.log
        if model.config.engine.impedance == "map":
            raise ConfigurationError(
                "engine.impedance: expected moments to predict online, got map, whose functions are found anew from "
                "all samples; train with engine.impedance=moments"
            )
        if group not in log.groups and (group is not None or len(log.groups) > 1):
            raise ConfigurationError(
                f"group: expected one of {', '.join(log.groups)}, got {group}; name the one that holds the handle"
            )
        self.group = group or log.groups[0]
        feature_map = FeatureMap(model.config, log.axes)
        mean = model.trajectory_mean
        self._inputs = SampleInputs(feature_map, mean, self.group)
        force_model = model.force_model(log.axes)
        own = log.select([i for i, trial in enumerate(log.trials) if trial.group == self.group])
        features = feature_map(own, mean, observed=True)
        visited = features.inputs[:, 0].numpy()
        self._local = build_local(force_model, feature_map, model.config.engine.local, visited[0])
        # Which takes a minute where nothing was compiled yet: no loop must wait for it.
        self._local.compile(np.ascontiguousarray(visited[:, 0]))
        self._now = PredictorSnapshot(self._inputs, self._local.view)
        self._lock = threading.Lock()
        self._last = -np.inf
        #: Samples that were learned, those of the training log included.
        self.samples = 0
        if warm:
            with torch.no_grad():
                residual = observations(force_model, features).residual[:, 0].numpy()
            learn_log(self._local, visited, residual)
            self.samples = residual.shape[1]

    @property
    def needed(self) -> tuple[str, ...]:
        """Fields that every sample must have, by this configuration."""
        return self._inputs.needed

    @property
    def cells(self) -> int:
        """Cells in use."""
        return len(self._local.cells)

    def update(self, sample: Sample) -> Coverage:
        """Learn one sample with its force; what did not teach anything says why.

        Raises:
            LogError: it lacks something or is not finite, or is not later than the last; nothing is learned then.
        """
        inputs, _ = self._inputs(sample)
        force, time = self._force(sample), _time(sample)
        with self._lock:
            # Nothing is later than an infinite time, and no time than NaN.
            if not self._last < time < np.inf:
                raise LogError(
                    f"sample at {sample.time} s: expected one later than the last, at {self._last} s; leave it out, or "
                    "begin a new predictor for another recording"
                )
            coverage = self._local.learn(inputs, force - self._local.numbers.prior_mean(inputs))
            self._last = time
            self.samples += coverage is Coverage.LEARNED
        return coverage

    def predict(self, sample: Sample) -> Prediction:
        """As `PredictorSnapshot.predict`, from what is known now."""
        return self._now.predict(sample)

    def snapshot(self) -> PredictorSnapshot:
        """What is known now, for another thread."""
        return PredictorSnapshot(self._inputs, self._local.snapshot)

    def save(self, path: str | Path) -> None:
        """Write all that was learned; an update that is under way in another thread is in it whole.

        Raises:
            OutputError: the file cannot be written.
        """
        with self._lock:
            scalars = {"samples": np.array([self.samples]), "last": np.array([self._last])}
            state = state_of(self._local, scalars)
        # Learning waits for the copy, not for the disk.
        write_state(Path(path), state, self._local, self.group)

    @classmethod
    def resume(cls, path: str | Path, model: ImpedanceModel, group: str | None = None) -> Self:
        """The predictor that `save` wrote, of the same model and group; it predicts and learns the same, to the bit.

        Raises:
            OutputError: the file lacks, is damaged, or is of another model.
            ConfigurationError: as in the beginning.
        """
        predictor = cls(model, group, warm=False)
        scalars = read_state(Path(path), predictor._local, predictor.group)
        predictor.samples, predictor._last = int(scalars["samples"][0]), float(scalars["last"][0])
        return predictor

    @property
    def last(self) -> float:
        """Time of the last sample that was looked at [s]; −∞ before the first."""
        return self._last

    def _force(self, sample: Sample) -> Floats:
        force = np.empty(len(self._local.noise))
        if not fill(force, sample.force) or not is_usable(force):
            raise LogError(
                f"sample at {sample.time} s: expected a finite force for each axis to learn from, got "
                f"{sample.force!r}; predict it, and leave it out of what is learned"
            )
        return force


def _time(sample: Sample) -> float:
    try:
        return float(sample.time)
    except (TypeError, ValueError):
        return float("nan")
