"""Small problems of impedance functions: densities at points that are no mode, and forces of known matrices."""

from dataclasses import replace

import numpy as np

from bayes_impedance.config import Config, load_config
from bayes_impedance.impedance_functions.density import Density
from bayes_impedance.impedance_functions.function import choose_inducing
from bayes_impedance.impedance_functions.train import build_density
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from tests.engines.given import NO_RESIDUAL, GivenProblem, given_problem

#: With few knots, so that a handful of samples has an average path.
MAP = (
    "engine.impedance=map",
    "engine.inducing=4",
    "training.restarts=1",
    "model.desired_trajectory.average_knots=2",
)
COUPLED = "model.axes=coupled"
DEVICE = ("device.mass=2.0", "device.damping=6.0")
#: A desired trajectory that the Markov engine holds, and nothing beside it.
MARKOV = ("model.desired_trajectory.kernel=matern52", *NO_RESIDUAL)
KNOWN_VARIATION = tuple(
    f"model.{name}.{key}"
    for name in ("stiffness", "damping")
    for key in ("log_sd=0.3", "length_scale={phase: {median: 0.15, fixed: true}}")
)


#: A smooth desired trajectory and coarse noise, which few samples tell apart.
DISTINCT = (
    "model.desired_trajectory.length_scale={phase: {median: 0.4, log_sd: 0.5}}",
    "model.noise_sd={median: 0.5, log_sd: 1.0}",
)


def small_problem(*overrides: str, **settings: object) -> GivenProblem:
    """`given_problem` under `engine.impedance: map`."""
    chosen = {"repetitions": 2, "rate": 5.0, **settings}
    return given_problem(overrides=(*NO_RESIDUAL, *MAP, *overrides), **chosen)


def density_of(problem: GivenProblem, engine: str = "dense") -> Density:
    """The density of functions and hyperparameters given the forces of `problem`."""
    inducing = choose_inducing(problem.config, problem.model, problem.features)
    return build_density(problem.config, problem.model, problem.features, inducing, engine)


def somewhere(density: Density, seed: int = 0, scale: float = 0.3) -> np.ndarray:
    """A point that is no mode."""
    generator = np.random.default_rng(seed)
    return density.start() + scale * density.free * generator.standard_normal(len(density.free))


def map_config(*overrides: str, name: str = "phase") -> Config:
    return load_config(name, [*MARKOV, *MAP, *overrides])


def drawn_log(config: Config, repetitions: int = 3, seed: int = 0, **settings: object) -> PreparedLog:
    """Repeated motion with force drawn from the model that integrates impedance out."""
    chosen = {"duration": 2.0, "rate": 10.0, "axes": ("x",), **settings}
    return draw_force(config, repeated_motion(repetitions, seed=seed, **chosen), seed)


def forced(log: PreparedLog, matrices: np.ndarray, noise_sd: float, seed: int = 0) -> PreparedLog:
    """`log` with the force of the same desired trajectories under known `matrices` `(3, axes, axes)`."""
    generator = np.random.default_rng(seed)
    trials = []
    for trial in log.trials:
        desired = (
            np.stack([trial.truth[f"desired_{name}_{axis}"] for axis in log.axes], axis=1)
            for name in ("position", "velocity", "acceleration")
        )
        hand = trial.position, trial.velocity, trial.acceleration
        force = sum(
            (d - x) @ w for d, x, w in zip(desired, hand, matrices, strict=True)
        ) + noise_sd * generator.standard_normal(trial.position.shape)
        trials.append(replace(trial, force=force))
    return PreparedLog(log.axes, tuple(trials))
