"""What a recorded perturbation would do to the hand on its own: motion that owes nothing to the person."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import cont2discrete, dlsim

from bayes_impedance.config import Config
from bayes_impedance.preprocessing import PreparedTrial

Array = NDArray[np.float64]


def perturbs_every_axis(trials: Sequence[PreparedTrial]) -> bool:
    """Whether each trial records a perturbation, and each axis has some among them."""
    recorded = [trial.perturbation for trial in trials if trial.perturbation is not None]
    return len(recorded) == len(trials) and bool(np.concatenate(recorded).any(axis=0).all())


def perturbed_motion(trial: PreparedTrial, axes: tuple[str, ...], config: Config) -> Array:
    """Position, velocity and acceleration that the perturbation p causes from rest, `(n, axes, 3)` [m, m/s, m/s²].

        (M_r + m) ẍ + (D_r + d) ẋ + k x = p

    with k, d, m at the medians of the configuration and the device where it is known. A wrong filter makes the
    instrument weaker, not wrong: its output depends on p alone.
    """
    assert trial.perturbation is not None
    if trial.n_samples < 2:
        return np.zeros((trial.n_samples, len(axes), 3))
    model = config.model
    mass = np.full(len(axes), model.mass.level.median)
    damping = np.full(len(axes), model.damping.level.median)
    if config.device is not None:
        mass = mass + config.device.masses(axes)
        known = config.device.dampings(axes)
        damping = damping if known is None else damping + known
    step = float(np.median(np.diff(trial.time)))
    even = np.arange(trial.time[0], trial.time[-1] + 0.5 * step, step)
    columns = []
    for p, m, d in zip(trial.perturbation.T, mass, damping, strict=True):
        response = _response(np.interp(even, trial.time, p), step, m, d, model.stiffness.level.median)
        columns.append(np.stack([np.interp(trial.time, even, order) for order in response.T], axis=-1))
    return np.stack(columns, axis=1)


def _response(force: Array, step: float, mass: float, damping: float, stiffness: float) -> Array:
    """Position, velocity and acceleration `(n, 3)` under `force` `(n,)` that is linear between samples."""
    acceleration = np.array([[-stiffness, -damping]]) / mass
    a = np.vstack([[[0.0, 1.0]], acceleration])
    b = np.array([[0.0], [1.0 / mass]])
    c = np.vstack([np.eye(2), acceleration])
    d = np.array([[0.0], [0.0], [1.0 / mass]])
    discrete = cont2discrete((a, b, c, d), step, method="foh")
    return np.asarray(dlsim(discrete, force)[1])
