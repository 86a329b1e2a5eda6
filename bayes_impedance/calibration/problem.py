"""What is calibrated: a configuration on given motion, from whose prior truth and recording are drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from bayes_impedance.config import Config
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import FeatureMap, Features, check_combination
from bayes_impedance.impedance_functions.function import choose_inducing
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import build_force_model
from bayes_impedance.sampling.density import JointDensity
from bayes_impedance.simulation.prior_predictive import check_loop, draw_recording
from bayes_impedance.trajectory_mean import TrajectoryMean

Array = NDArray[np.float64]


class Problem:
    """Prior draws, and posterior densities given what was drawn.

    `prior` is the density of the motion without any force: its parameters are those of every recording.

    Raises:
        ConfigurationError: impedance is integrated out, or moves with the force of a device; or no engine holds the
            processes.
        TooManySamplesError: dense is asked for, and the samples are too many.
    """

    def __init__(self, config: Config, motion: PreparedLog) -> None:
        if config.engine.impedance != "map":
            raise ConfigurationError(
                "engine.impedance: expected map, whose functions are sampled, found moments, which integrates them "
                "out; set engine.impedance=map"
            )
        check_combination(config, motion)
        check_loop(config, motion.axes)
        self.config, self.motion = config, motion
        still = replace(
            motion,
            trials=tuple(replace(trial, force=np.zeros_like(trial.position)) for trial in motion.trials),
        )
        self._map = FeatureMap(config, motion.axes)
        self._mean = TrajectoryMean.from_training(config.model.desired_trajectory, motion)
        features = self._map(still, self._mean)
        self._model = build_force_model(config, self._map)
        self._inducing = choose_inducing(config, self._model, features)
        self.prior = JointDensity(config, self._model, features, self._inducing)

    def draw(self, standard: Array, seed: int) -> PreparedLog:
        """A recording at coordinates `standard` `(size,)`, with its truth."""
        return draw_recording(self.prior, self.motion, standard, seed)

    def density(self, log: PreparedLog) -> JointDensity:
        """The posterior density given a drawn recording."""
        return JointDensity(self.config, self._model, self.features(log), self._inducing)

    def features(self, log: PreparedLog) -> Features:
        """Inputs and forces of a drawn recording."""
        return self._map(log, self._mean)


def seeds(seed: int, index: int) -> tuple[np.random.Generator, int, int]:
    """A generator of coordinates, and seeds of the recording and of the sampler, of draw number `index`."""
    sequence = np.random.SeedSequence((seed, index))
    recording, sampler = (int(word) for word in sequence.generate_state(2, np.uint32))
    return np.random.default_rng(sequence), recording, sampler


def one_of_prior(problem: Problem, generator: np.random.Generator) -> Array:
    """Coordinates drawn from the prior, N(0, I), `(size,)`."""
    return generator.standard_normal(problem.prior.size)


def rows_of(features: Features, rows: NDArray[np.int64]) -> Features:
    """`features` at some samples of each group, `rows` `(groups, m)`, without force."""
    index = torch.from_numpy(rows)[None, :, :, None]

    def taken(values: torch.Tensor) -> torch.Tensor:
        return values.gather(2, index.expand(len(values), -1, -1, values.shape[-1]))

    return replace(
        features,
        inputs=taken(features.inputs),
        trajectory_mean=taken(features.trajectory_mean),
        force=None,
        valid=None,
        rows=tuple(own[chosen] for own, chosen in zip(features.rows, rows, strict=True)),
        loop=None,
    )
