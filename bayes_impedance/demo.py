"""The main job from end to end: record, train, infer, evaluate, draw; the truth is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayes_impedance.config import Config, load_config, parse_config
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.simulation.generative import as_recording, draw_force, repeated_motion
from bayes_impedance.writer import write_log

REPETITIONS = 5

#: What the data are drawn from; the model that is trained starts elsewhere (`configs/phase.yaml`).
TRUTH: dict[str, object] = {
    "model": {
        "trajectory_input": "phase",
        "desired_trajectory": {"mean": "reference", "sd": 0.015, "length_scale": {"phase": 0.12}},
        "stiffness": {"level": 180, "log_sd": 0.3, "input": ["phase"], "length_scale": {"phase": 0.2}},
        "damping": {"level": 14, "log_sd": 0.3, "input": ["phase"], "length_scale": {"phase": 0.2}},
        "mass": {"level": 1.3, "sd": 0.2},
        "residual": {"sd": 0.4, "input": ["position", "velocity"]},
        "noise_sd": 0.1,
    }
}


@dataclass(frozen=True)
class Recording:
    """A simulated experiment: files for training and for testing, with the configuration that reads them."""

    training: Path
    testing: Path
    config: Config


def record(folder: Path, seed: int = 0) -> Recording:
    """Write `training.csv` (four repetitions) and `testing.csv` (a fifth) into `folder`.

    The motion is perturbed; force is drawn from the generative model, and the truth stands beside it.
    """
    motion = repeated_motion(
        repetitions=REPETITIONS, duration=4.0, rate=100.0, displacement_sd=0.012, seed=seed
    )
    log = as_recording(draw_force(parse_config(TRUTH), motion, seed))
    training, testing = folder / "training.csv", folder / "testing.csv"
    write_log(log.select(range(REPETITIONS - 1)), training)
    write_log(log.select([REPETITIONS - 1]), testing)
    # Half the usual rate: the displacements end at 2 Hz, and the demo should end within a minute.
    return Recording(training, testing, load_config("phase", ["preprocessing.rate=12.5"]))


def truth_errors(posterior_of: Callable[[str], np.ndarray], log: PreparedLog) -> dict[str, float]:
    """Mean relative error of stiffness, damping and mass against the truth in `log`, by parameter and axis."""
    errors = {}
    for name in ("stiffness", "damping", "mass"):
        estimate = posterior_of(name)
        for a, axis in enumerate(log.axes):
            key = f"{name}_{axis}{axis}"
            truth = np.concatenate([trial.truth[key] for trial in log.trials])
            errors[key] = float(np.mean(np.abs(estimate[:, a] - truth) / truth))
    return errors
