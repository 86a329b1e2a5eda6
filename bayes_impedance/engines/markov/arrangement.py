"""Samples in the order in which a filter takes them, and what each of its steps moves and observes."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.engines.given_impedance import Processes
from bayes_impedance.engines.markov.recursions import Floats, Integers, Plan
from bayes_impedance.engines.markov.state_space import RATE
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import Features
from bayes_impedance.kernels.impedance import InputLayout
from bayes_impedance.kernels.stationary import Matern, Stationary

#: Most states that one filter may hold: its time grows with their square.
LARGEST_STATE = 128


@dataclass(frozen=True)
class Term:
    """A term of the residual force: how many states it has, and the column it is a function of; None for a constant."""

    size: int
    column: int | None


@dataclass(frozen=True)
class Structure:
    """All of the processes but their hyperparameters."""

    layout: InputLayout
    terms: tuple[Term, ...]

    @classmethod
    def of(cls, processes: Processes) -> Structure:
        """That of some processes.

        Raises:
            ConfigurationError: they have no state space of few dimensions.
        """
        count = len(processes.layout.theta)
        if count != 1:
            raise ConfigurationError(
                "engine.name: expected a desired trajectory over one number (time, phase) with markov, found one over "
                f"{count}; set engine.name=dense or lowrank, or model.trajectory_input=phase"
            )
        if processes.periodic:
            raise ConfigurationError(
                "engine.name: expected a desired trajectory whose ends are free with markov, found "
                "model.desired_trajectory.periodic=true; set engine.name=lowrank"
            )
        if _states(processes.trajectory) != 3:
            raise ConfigurationError(
                "engine.name: expected the kernel matern52 of the desired trajectory with markov, found another "
                f"({_name(processes.trajectory)}); set model.desired_trajectory.kernel=matern52, or engine.name=dense"
            )
        return cls(processes.layout, tuple(_term(kernel) for kernel in processes.residual))


@dataclass(frozen=True)
class Samples:
    """Samples of all groups in one row; labels are 0 where all samples of a group share a process.

    `group`, `row` `(n,)`: where they lie in features; `theta`, `velocity`, `acceleration` `(n,)`: θ [its unit] and its
    time derivatives; `own` `(n, terms)`: the input of each residual term, 0 for a constant; `observed` `(n,)`.
    """

    group: Integers
    row: Integers
    theta: Floats
    velocity: Tensor
    acceleration: Tensor
    own: Floats
    trajectory: Floats
    residual: Floats
    observed: NDArray[np.bool_]

    @classmethod
    def of(cls, features: Features, structure: Structure, observed: bool) -> Samples:
        """The valid samples of `features`; those without force are left out where they are to be `observed`."""
        layout = structure.layout
        keep = np.ones(tuple(features.inputs.shape[1:3]), dtype=bool)
        if features.valid is not None:
            keep &= features.valid.numpy()
        if observed:
            assert features.force is not None
            keep &= features.force.isfinite().all(0).numpy()
        group, row = np.nonzero(keep)
        # θ and inputs of one dimension are the same on every axis.
        x = features.inputs[0, torch.from_numpy(group), torch.from_numpy(row)]
        path = layout.path(x)
        zero = torch.zeros(len(group), dtype=x.dtype)
        labels = [zero if column is None else x[:, column] for column in (layout.trajectory, layout.residual)]
        own = [zero if term.column is None else x[:, term.column] for term in structure.terms]
        return cls(
            group,
            row,
            path.theta[:, 0].numpy(),
            path.velocity[:, 0],
            zero if path.acceleration is None else path.acceleration[:, 0],
            torch.stack(own, -1).numpy() if own else np.zeros((len(group), 0)),
            labels[0].numpy(),
            labels[1].numpy(),
            np.full(len(group), observed),
        )

    def followed_by(self, other: Samples) -> Samples:
        """These samples, then the others."""
        parts = {
            field.name: (getattr(self, field.name), getattr(other, field.name)) for field in fields(self)
        }
        joined: dict[str, Any] = {
            name: torch.cat(part) if isinstance(part[0], Tensor) else np.concatenate(part)
            for name, part in parts.items()
        }
        return replace(self, **joined)

    def in_order(self, order: Integers) -> Samples:
        """The same samples in another order."""
        return replace(self, **{field.name: getattr(self, field.name)[order] for field in fields(self)})


@dataclass(frozen=True)
class Sequences:
    """Samples in the order of θ, cut into sequences that are independent of each other.

    `order` `(n,)`: which sample each step takes; `group` `(sequences,)`; `steps` `(n, 1 + terms)`: how far the input
    of the trajectory and of each residual term moves, on the way from the sample before that shares it.
    """

    order: Integers
    group: Integers
    steps: Tensor
    plan: Plan


def arrange(samples: Samples, structure: Structure, axes: int) -> Sequences:
    """Sequences for filters that hold `axes` axes each.

    Raises:
        ConfigurationError: the input of a residual term goes back where θ does not, or there are too many states.
    """
    trajectory, residual, sequence = process_numbers(samples, structure)
    order = np.lexsort((*samples.own.T[::-1], samples.theta, sequence))
    sequence, trajectory, residual = sequence[order], trajectory[order], residual[order]
    observed = samples.observed[order]
    fresh = [_unobserved(process, observed) for process in (trajectory, residual)]
    columns = [increments(samples.theta[order], trajectory)]
    for own, term in zip(samples.own.T[:, order], structure.terms, strict=True):
        # Of a process that nothing is observed of only the prior is known, wherever it is.
        step = np.where(fresh[1], 0.0, increments(own, residual))
        _check_increasing(step, term, samples.theta[order])
        columns.append(step)
    starts = np.flatnonzero(np.diff(sequence, prepend=-1))
    sizes = np.array([term.size for term in structure.terms], dtype=np.int64)
    widths = (3 * axes, axes * int(sizes.sum()))
    places = [
        _places(process, unseen, starts)
        for process, unseen in zip((trajectory, residual), fresh, strict=True)
    ]
    counts = [np.maximum.reduceat(place, starts) + 1 for place in places]
    states = counts[0] * widths[0] + counts[1] * widths[1]
    if states.size and states.max() > LARGEST_STATE:
        raise ConfigurationError(
            f"engine.name: expected at most {LARGEST_STATE} states with markov, found {states.max()} (a residual force "
            f"of {counts[1].max()} trials beside {counts[0].max()} desired trajectories); set shared.residual=true or "
            "model.residual=null, or engine.name=dense"
        )
    at = np.stack(
        [places[0] * widths[0], (counts[0] * widths[0]).repeat(_lengths(starts, len(order)))], axis=-1
    )
    at[:, 1] += places[1] * widths[1]
    offsets = [3 * np.arange(axes), np.cumsum(np.tile(sizes, axes)) - np.tile(sizes, axes)]
    plan = Plan(
        np.append(starts, len(order)),
        states,
        at,
        observed,
        np.concatenate([np.full(axes, 3), np.tile(sizes, axes)]),
        np.concatenate(offsets),
    )
    return Sequences(order, samples.group[order][starts], torch.from_numpy(np.stack(columns, axis=-1)), plan)


def _states(kernel: Stationary) -> int:
    """Number of states; 0 where there is no finite one, or more than three."""
    if kernel.num_dims == 0:
        return 1
    profile = kernel.profile
    size = profile.degree + 1 if isinstance(profile, Matern) else 0
    return size if size in RATE else 0


def _name(kernel: Stationary) -> str:
    profile = kernel.profile
    return f"Matérn, nu = {profile.nu:g}" if isinstance(profile, Matern) else type(profile).__name__


def _term(kernel: Stationary) -> Term:
    if kernel.num_dims == 0:
        return Term(1, None)
    size = _states(kernel)
    if size == 0:
        raise ConfigurationError(
            "engine.name: expected a residual force of the kernel matern12, matern32 or matern52 with markov, found "
            f"{_name(kernel)}; set model.residual.kernel=matern32, or engine.name=dense"
        )
    columns = kernel.active_dims
    if columns is None or len(columns) != 1:
        count = "every one" if columns is None else str(len(columns))
        raise ConfigurationError(
            f"engine.name: expected a residual force over one input (time or phase) with markov, found {count}; set "
            "model.residual.input=[phase] or [time] or model.residual=null, or engine.name=dense"
        )
    return Term(size, int(columns[0]))


def process_numbers(samples: Samples, structure: Structure) -> tuple[Integers, Integers, Integers]:
    """Number of the trajectory, of the residual and of the sequence of each sample; equal numbers share it."""
    trajectory = _numbered(samples.group, samples.trajectory)
    residual = _numbered(samples.group, samples.residual)
    if structure.terms and np.unique(residual).size < np.unique(_numbered(residual, trajectory)).size:
        # One residual runs through several trajectories, so they are to be filtered together.
        return trajectory, residual, samples.group
    return trajectory, residual, trajectory


def _numbered(first: Integers, second: NDArray[np.generic]) -> Integers:
    """Numbers of pairs, in their order."""
    values, index = np.unique(second, return_inverse=True)
    numbers: Integers = np.unique(first * len(values) + index, return_inverse=True)[1]
    return numbers


def _unobserved(process: Integers, observed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Samples of processes that nothing is observed of."""
    return np.bincount(process, weights=observed)[process] == 0


def increments(value: Floats, process: Integers) -> Floats:
    """Those of `value` from sample to sample of a `process` `(n,)`, 0 at its first."""
    order = np.argsort(process, kind="stable")
    steps = np.zeros(len(value))
    same = np.diff(process[order]) == 0
    steps[order[1:]] = np.where(same, np.diff(value[order]), 0.0)
    return steps


def _check_increasing(steps: Floats, term: Term, theta: Floats) -> None:
    if steps.size and steps.min() < 0.0:
        worst = int(steps.argmin())
        raise ConfigurationError(
            "engine.name: expected a residual force whose input never goes back where theta increases with markov, "
            f"found input {term.column} to go back by {-steps[worst]:g} at theta = {theta[worst]:g}; set "
            "model.residual.input to that of the desired trajectory (with shared.residual=true for phase), or "
            "engine.name=dense, or make each repetition a trial of its own by preprocessing.segmentation"
        )


def _places(process: Integers, unseen: NDArray[np.bool_], starts: Integers) -> Integers:
    """Which process of its sequence each sample belongs to; those that nothing is observed of are the last one."""
    result = np.zeros(len(process), dtype=np.int64)
    for begin, length in zip(starts, _lengths(starts, len(process)), strict=True):
        part = slice(begin, begin + length)
        known = np.unique(process[part][~unseen[part]])
        result[part] = np.where(unseen[part], len(known), np.searchsorted(known, process[part]))
    return result


def _lengths(starts: Integers, total: int) -> Integers:
    return np.diff(np.append(starts, total))
