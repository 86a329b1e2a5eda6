"""Groups in batches: of similar length, small enough for memory and cache, on every core.

Groups share nothing, so what is a batch is a matter of cost alone. A batch of all would pad each group to the longest
and hold every covariance at once; one of each would spend its time on the calls.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from threading import Event, Lock

import numpy as np
import torch
from numpy.typing import NDArray

from bayes_impedance.impedance_functions.threads import one_thread
from bayes_impedance.posterior import conditioning
from bayes_impedance.preprocessing import PreparedLog

#: Called with the samples that are done, and with all there are.
Progress = Callable[[int, int], None]

#: How much work padding may add to that of the groups themselves.
PADDING = 1.25
#: A batch has at most so many pieces of targets, or as many as its forces are worth: a long log is many batches.
PIECES = 16
#: Rows of a covariance from which on the factor gains from several threads; calls on smaller ones wait for each other.
LARGE = 1000

Samples = NDArray[np.int64]


@dataclass(frozen=True)
class Batch:
    """Groups that are inferred together.

    `given`, `target`: trials of the log of forces and of that of targets, by index, group after group in one order.
    `pieces`: samples of each target trial that are taken together, one piece after another. `size`: rows of the largest
    covariance.
    """

    given: tuple[int, ...]
    target: tuple[int, ...]
    pieces: tuple[tuple[Samples, ...], ...]
    size: int


@dataclass(frozen=True)
class _Group:
    """Trials of a group in both logs, and how many forces and targets it has."""

    given: tuple[int, ...]
    target: tuple[int, ...]
    forces: int
    targets: int


def plan(log: PreparedLog, given: PreparedLog | None, coupled: bool, alike_below: int = 0) -> list[Batch]:
    """Every group of `log` in one batch, or several where it has many samples, with its forces in `given`.

    Groups of fewer forces than `alike_below` share a batch with those of as many. The largest batches come first, so
    that no thread starts one when the others have ended.
    """
    axes = len(log.axes)
    # Entries of a covariance for each pair of a force and a target of a group.
    width = axes**2 if coupled else axes
    batches: list[tuple[float, Batch]] = []
    for groups in _alike(_groups(log, given), width, alike_below):
        forces, targets = max(g.forces for g in groups), max(g.targets for g in groups)
        step = conditioning.targets_at_once(len(groups) * width * forces)
        most = max(PIECES, -(-4 * forces // step)) * step
        for start in range(0, targets, most):
            stop = min(start + most, targets)
            size = forces * axes if coupled else forces
            batch = _batch(log, groups, range(start, stop, step), step, size)
            batches.append((len(groups) * _work(forces, stop - start), batch))
    batches.sort(key=lambda pair: -pair[0])
    return [batch for _, batch in batches]


def each_group(log: PreparedLog, given: PreparedLog | None) -> list[Batch]:
    """Every group of `log` as a batch of its own, with its forces in `given`."""
    return [
        _batch(log, [group], range(0, group.targets, conditioning.CHUNK), conditioning.CHUNK, 0)
        for group in _groups(log, given)
    ]


def for_each(
    work: Callable[[Batch], Iterator[int]],
    batches: Sequence[Batch],
    total: int,
    progress: Progress | None = None,
) -> None:
    """`work` on every batch, on as many threads as torch has; `progress` hears of each count that it yields.

    Each batch has one thread, but one that is alone and large has all. An exception, Ctrl-C included, ends them all.
    """
    workers = min(torch.get_num_threads(), len(batches))
    stopped, lock = Event(), Lock()
    done = 0

    def follow(batch: Batch) -> None:
        nonlocal done
        for count in work(batch):
            with lock:
                done += count
                if progress is not None:
                    progress(done, total)
            if stopped.is_set():
                return

    if len(batches) == 1 and batches[0].size >= LARGE:
        follow(batches[0])
        return
    # Threads of a pool take over the number of threads that torch has when they begin.
    with one_thread():
        if workers == 1:
            for batch in batches:
                follow(batch)
            return
        with ThreadPoolExecutor(workers) as pool:
            try:
                for future in as_completed([pool.submit(follow, batch) for batch in batches]):
                    future.result()
            except BaseException:
                stopped.set()
                pool.shutdown(wait=False, cancel_futures=True)
                raise


def _groups(log: PreparedLog, given: PreparedLog | None) -> list[_Group]:
    evidence = {} if given is None else given.by_group
    groups = []
    for name, target in log.by_group.items():
        own = evidence.get(name, [])
        forces = 0 if given is None else sum(int(given.trials[i].observed.sum()) for i in own)
        targets = sum(log.trials[i].n_samples for i in target)
        groups.append(_Group(tuple(own), tuple(target), forces, targets))
    return groups


def _work(forces: int, targets: int) -> float:
    """What a group costs, up to a factor."""
    return (forces + 1.0) * (forces + targets)


def _alike(groups: Sequence[_Group], width: int, alike_below: int) -> Iterator[list[_Group]]:
    """Groups of similar length together, as many as memory and padding allow."""
    batch: list[_Group] = []
    own = 0.0
    for group in sorted(groups, key=lambda g: (g.forces, g.targets)):
        forces, targets = group.forces, max(group.targets, *(g.targets for g in batch), 0)
        count = len(batch) + 1
        work = _work(forces, group.targets)
        entries = count * width * max(1, forces) * max(forces, min(targets, conditioning.CHUNK))
        # Priors alone and forces do not mix: a batch has forces of every group, or none.
        least = max(1, alike_below)
        apart = batch and min(batch[0].forces, least) != min(forces, least)
        if batch and (
            apart or entries > conditioning.ENTRIES or count * _work(forces, targets) > PADDING * (own + work)
        ):
            yield batch
            batch, own = [], 0.0
        batch.append(group)
        own += work
    if batch:
        yield batch


def _batch(log: PreparedLog, groups: Sequence[_Group], starts: range, step: int, size: int) -> Batch:
    cuts = [_pieces([log.trials[i].n_samples for i in group.target], starts, step) for group in groups]
    pieces = tuple(tuple(samples for one in piece for samples in one) for piece in zip(*cuts, strict=True))
    given = tuple(i for group in groups for i in group.given)
    return Batch(given, tuple(i for group in groups for i in group.target), pieces, size)


def _pieces(lengths: Sequence[int], starts: range, step: int) -> list[list[Samples]]:
    """Samples of each trial of a group that are among `step` of all its samples from each of `starts`."""
    firsts = np.cumsum([0, *lengths])
    return [
        [
            np.arange(*np.clip([start - first, min(start + step, starts.stop) - first], 0, length))
            for first, length in zip(firsts[:-1], lengths, strict=True)
        ]
        for start in starts
    ]
