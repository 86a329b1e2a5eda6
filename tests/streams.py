"""Models without a training, and samples of their logs as a stream brings them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from bayes_impedance.config import load_config
from bayes_impedance.features import FeatureMap
from bayes_impedance.model import Fit, ImpedanceModel
from bayes_impedance.online import OnlinePredictor, Sample
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial
from bayes_impedance.priors import build_force_model
from bayes_impedance.simulation.generative import draw_force, repeated_motion

SHARED = "shared.residual=true"
#: Every field that a prepared trial has at a sample.
MOTION = (
    "position", "velocity", "acceleration", "jerk", "phase", "phase_velocity", "phase_acceleration", "reference",
    "reference_velocity", "reference_acceleration",
)  # fmt: skip


def model_of(
    name: str, overrides: Sequence[str] = (), groups: Sequence[str] = ("0",), seed: int = 0, n: int = 40
) -> ImpedanceModel:
    """A shipped configuration "fitted": hyperparameters near their medians, other ones along each axis."""
    config = load_config(name, overrides)
    motions = [
        repeated_motion(2, duration=2.0, rate=n / 4.0, seed=seed + i, group=group)
        for i, group in enumerate(groups)
    ]
    trials = tuple(
        replace(trial, name=f"{trial.group}-{trial.name}") for motion in motions for trial in motion.trials
    )
    log = draw_force(config, PreparedLog(motions[0].axes, trials), seed=seed)
    model = build_force_model(config, FeatureMap(config, log.axes))
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.kernel.parameters():
            parameter += 0.2 * torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype)
    return ImpedanceModel(config, Fit(model, log, report=cast(Any, None)))


def samples(trial: PreparedTrial, start: float = 0.0, with_force: bool = True) -> list[Sample]:
    """Every sample of a trial, from `start` on."""
    found = []
    for t, time in enumerate(trial.time):
        fields: dict[str, Any] = {
            name: None if (values := getattr(trial, name)) is None else values[t] for name in MOTION
        }
        force = trial.force[t] if with_force and trial.force is not None else None
        found.append(Sample(time=start + float(time), force=force, **fields))
    return found


def stream(model: ImpedanceModel, seed: int = 5, n: int = 40) -> list[Sample]:
    """New repetitions of the motion, with force, one after the other."""
    motion = repeated_motion(2, duration=2.0, rate=n / 4.0, seed=seed)
    log = draw_force(model.config, motion, seed=seed)
    return [sample for i, trial in enumerate(log.trials) for sample in samples(trial, start=10.0 * (i + 1))]


def state(predictor: OnlinePredictor) -> list[NDArray[Any]]:
    """All that an update may change."""
    local = predictor._local
    arrays = [
        array.copy() for code in sorted(local.cells) for array in (*local.cells[code], *local.sums[code])
    ]
    return [*arrays, np.array([predictor.samples, predictor.last, len(local.cells), len(local.sums)])]


def same(one: Any, other: Any) -> bool:
    """Whether two predictions agree to the bit."""
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))
