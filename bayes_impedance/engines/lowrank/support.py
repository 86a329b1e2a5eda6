"""What features can hold, and in which words the rest is refused."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from bayes_impedance.engines.given_impedance import Processes
from bayes_impedance.engines.lowrank.columns import columns_of
from bayes_impedance.engines.lowrank.hilbert import Accuracy, Extent, chosen, counts, products
from bayes_impedance.engines.lowrank.periodic import harmonics
from bayes_impedance.features import Features
from bayes_impedance.kernels.stationary import PROFILES, Profile, SquaredExponential, Stationary

#: Features of one regression: its factor then takes 32 MB, and half a second.
MAX_FEATURES = 2000
MAX_TRAJECTORY_DIMS, MAX_RESIDUAL_DIMS = 3, 2


def unsupported(
    processes: Processes,
    features: Features,
    coupled: bool = False,
    accuracy: Accuracy | None = None,
    target: Features | None = None,
) -> str | None:
    """Why features cannot hold these processes at the samples of `features` and `target`; None where they can.

    The number of features depends on the length scales, so the answer may change while these are learned.
    """
    return (
        _trajectory_kind(processes)
        or _residual_kind(processes)
        or _labels(processes, features)
        or _number(processes, [features] if target is None else [features, target], coupled, accuracy)
    )


def own_column(processes: Processes) -> int | None:
    """The column of labels of blocks that have features of their own; None where groups share all."""
    layout = processes.layout
    return layout.trajectory if layout.trajectory is not None or not processes.residual else layout.residual


def _trajectory_kind(processes: Processes) -> str | None:
    profile, dims = processes.trajectory.profile, len(processes.layout.theta)
    if not isinstance(profile, SquaredExponential):
        return (
            "expected model.desired_trajectory.kernel=squared_exponential, whose accelerations few features carry, got "
            f"{_name(profile)}; take squared_exponential, or engine.name=dense, or for matern52 over time or phase "
            "(not periodic) engine.name=markov"
        )
    if dims > MAX_TRAJECTORY_DIMS:
        return (
            f"expected a desired trajectory over at most {MAX_TRAJECTORY_DIMS} inputs, got {dims}, whose features "
            "multiply; take model.trajectory_input=phase or time, or engine.name=dense"
        )
    if processes.periodic and dims > 1:
        return (
            f"expected a scalar phase with model.desired_trajectory.periodic=true, got {dims} inputs; take "
            "model.trajectory_input=phase"
        )
    return None


def _residual_kind(processes: Processes) -> str | None:
    for term in processes.residual:
        if not isinstance(term, Stationary):
            return (
                f"expected a residual force of stationary kernels, got {type(term).__name__}; take "
                "model.residual.kernel=squared_exponential, or engine.name=dense"
            )
        if term.num_dims and not isinstance(term.profile, SquaredExponential):
            return (
                f"expected model.residual.kernel=squared_exponential, got {_name(term.profile)}; take "
                "squared_exponential, or model.residual=null, or engine.name=dense"
            )
        if term.num_dims > MAX_RESIDUAL_DIMS:
            return (
                f"expected a residual force over at most {MAX_RESIDUAL_DIMS} inputs, got {term.num_dims}, whose "
                "features multiply; take model.residual.input=[phase] or [time], or model.residual=null, or "
                "engine.name=dense"
            )
    return None


def _labels(processes: Processes, features: Features) -> str | None:
    trajectory, residual = processes.layout.trajectory, processes.layout.residual
    if trajectory is None or residual is None or not processes.residual:
        return None
    valid = slice(None) if features.valid is None else features.valid
    first, second = (features.inputs[0, ..., column][valid] for column in (trajectory, residual))
    if torch.equal(first, second):
        return None
    return (
        "expected desired trajectory and residual force of their own for the same trials, got labels of the two that "
        "differ; share one of them by shared.desired_trajectory or shared.residual, or take engine.name=dense"
    )


def _number(
    processes: Processes, logs: Sequence[Features], coupled: bool, accuracy: Accuracy | None
) -> str | None:
    layout, axes = processes.layout, logs[0].inputs.shape[0]
    rule = chosen(accuracy, len(layout.theta))
    if processes.periodic:
        number = 2 * harmonics(processes.trajectory, axes, rule) + 1
    else:
        number = _size(processes.trajectory, layout.theta, logs, rule)
    residual = sum(
        _size(term, columns_of(term), logs, chosen(accuracy, term.num_dims, derivatives=False))
        for term in processes.residual
    )
    together = (layout.trajectory is None) == (layout.residual is None)
    largest = (number + residual if together else max(number, residual)) * (axes if coupled else 1)
    if largest <= MAX_FEATURES:
        return None
    return (
        f"expected at most {MAX_FEATURES} features, found that {largest} are needed ({number} of the desired "
        f"trajectory and {residual} of the residual force{f', for each of {axes} coupled axes' if coupled else ''}) "
        "for length scales so short beside what the samples cover; expect longer ones, cut the recording, or take "
        "engine.name=dense"
    )


def _size(kernel: Stationary, columns: Sequence[int], logs: Sequence[Features], accuracy: Accuracy) -> int:
    if not kernel.num_dims:
        return 1
    extents = [Extent.of(logs, column) for column in columns]
    axes = logs[0].inputs.shape[0]
    number = math.prod(counts(kernel, extents, axes, accuracy))
    # A third of the products at least are kept: so many more than the limit need not be listed.
    if number > 4 * MAX_FEATURES:
        return number
    kept = products(kernel, extents, axes, accuracy)
    return number if kept is None else len(kept)


def _name(profile: Profile) -> str:
    return next(name for name, known in PROFILES.items() if known is profile)
