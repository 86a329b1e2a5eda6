"""Chains of NUTS side by side, each in a process of its own: what becomes of one is no matter to the others."""

from __future__ import annotations

import copyreg
import io
import multiprocessing
import os
import signal
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bayes_impedance.config import SamplingConfig
from bayes_impedance.errors import JournalWarning, SamplingError
from bayes_impedance.impedance_functions.threads import one_thread
from bayes_impedance.sampling.checkpoint import Checkpoint
from bayes_impedance.sampling.density import SampledDensity
from bayes_impedance.sampling.draws import Draws, Progress
from bayes_impedance.sampling.start import Start
from bayes_impedance.sampling.task import Task, fingerprint

Statistics = dict[str, NDArray[np.generic]]

#: What a chain gets to put itself away when it is to stop [s].
PATIENCE = 10.0


@dataclass
class Fates:
    """What has become of chains so far: `drawn` coordinates and statistics by number, `lost` sentences by number."""

    drawn: dict[int, tuple[NDArray[np.float64], Statistics]] = field(default_factory=dict)
    lost: dict[int, str] = field(default_factory=dict)


def sample_nuts(
    density: SampledDensity,
    start: Start,
    settings: SamplingConfig,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
    processes: int | None = None,
) -> Draws:
    """Draws of `settings.chains` chains, as many at a time as there are cores, or `processes`.

    The same seed gives the same draws with any number of processes. With a `checkpoint` chains go on from where its
    files have them, and are kept in it every few seconds and at their end; to delete them is the caller's, once the
    draws are safe. A chain that dies is told of in `lost`. Ctrl-C stops all chains and leaves their checkpoints.

    Warns (JournalWarning) where a checkpoint takes no more: sampling goes on without it.

    Raises:
        SamplingError: every chain died.
        OutputError: a checkpoint is damaged, or of another model, other data or other settings.
    """
    if checkpoint is not None:
        checkpoint = checked(checkpoint, settings)
    task = Task(density, start, settings, checkpoint)
    workers = min(settings.chains, processes or _cores())
    report = progress or _say_nothing
    fates = _one_by_one(task, report) if workers == 1 else _side_by_side(task, report, workers)
    lost = tuple(sentence for _, sentence in sorted(fates.lost.items()))
    if not fates.drawn:
        raise SamplingError(
            f"expected draws of {settings.chains} chains, found that all of them died: {'; '.join(lost)}; mend what "
            "the first one met, or take sampling.method=laplace"
        )
    chains = [drawn for _, drawn in sorted(fates.drawn.items())]
    stats = {name: np.stack([own[name] for _, own in chains]) for name in chains[0][1]}
    return Draws("nuts", np.stack([standard for standard, _ in chains]), stats, lost=lost)


def checked(checkpoint: Checkpoint, settings: SamplingConfig) -> Checkpoint:
    """With the settings among what it is of; sooner than in a process of a chain, whose refusal would be a chain lost.

    Raises:
        OutputError: a checkpoint is damaged, or of another model, other data or other settings.
    """
    named = replace(checkpoint, fingerprint={**checkpoint.fingerprint, **fingerprint(settings)})
    for number in range(settings.chains):
        named.read(number)
    return named


def _one_by_one(task: Task, progress: Progress) -> Fates:
    fates = Fates()
    for number in range(task.settings.chains):

        def report(done: int, total: int, line: str, number: int = number) -> None:
            progress(number, done, total, line)

        try:
            with one_thread():
                chain = task.run(number, report, _warn)
        except Exception as error:
            fates.lost[number] = _died(number, error)
        else:
            fates.drawn[number] = chain.standard, chain.stats
    return fates


def _side_by_side(task: Task, progress: Progress, workers: int) -> Fates:
    fates = Fates()
    content = by_value(task)
    waiting = list(range(task.settings.chains))
    with _processes() as running:
        while waiting or running:
            while waiting and len(running) < workers:
                _launch(running, waiting.pop(0), content)
            for ready in wait(list(running)):
                assert isinstance(ready, Connection)
                number, process = running[ready]
                try:
                    kind, message = ready.recv()
                except (EOFError, OSError):
                    process.join(PATIENCE)
                    fates.lost[number] = _killed(number, process.exitcode)
                    kind = "end"
                if kind == "progress":
                    progress(number, *message)
                elif kind == "warning":
                    _warn(message)
                elif kind == "drawn":
                    fates.drawn[number] = message
                elif kind == "died":
                    fates.lost[number] = message
                if kind not in ("progress", "warning"):
                    del running[ready]
                    ready.close()
    return fates


Running = dict[Connection, tuple[int, BaseProcess]]


@contextmanager
def _processes() -> Iterator[Running]:
    """Processes by their connections; those that still run at the end are told to stop, and stopped."""
    running: Running = {}
    try:
        yield running
    finally:
        # A chain whose connection is closed puts itself away.
        for connection in running:
            connection.close()
        try:
            deadline = time.monotonic() + PATIENCE
            for _, process in running.values():
                process.join(max(deadline - time.monotonic(), 0.0))
        finally:
            for _, process in running.values():
                process.kill()


def _launch(running: Running, number: int, content: bytes) -> None:
    context = _context()
    here, there = context.Pipe()
    process = context.Process(
        target=_work, args=(there, number, content), name=f"chain {number + 1}", daemon=True
    )
    process.start()
    there.close()
    running[here] = number, process


def _context() -> ForkServerContext | SpawnContext:
    if sys.platform == "win32":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    # Once, rather than in each process.
    context.set_forkserver_preload([__name__])
    return context


def _work(connection: Connection, number: int, content: bytes) -> None:
    """The life of a process: one chain."""
    # Ctrl-C reaches all processes of a terminal; the one that waits for the chains tells them.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)

    def send(kind: str, message: Any) -> None:
        if not connection.poll():
            connection.send((kind, message))

    try:
        task: Task = ForkingPickler.loads(content)
        chain = task.run(
            number,
            lambda done, total, line: send("progress", (done, total, line)),
            lambda sentence: send("warning", sentence),
            # Nothing is ever sent here: what there is to read is the end.
            connection.poll,
        )
        send("drawn", (chain.standard, chain.stats))
    except (BrokenPipeError, ConnectionResetError):
        return
    except Exception as error:
        send("died", _died(number, error))


class _ByValue(ForkingPickler):
    """Tensors as numbers: torch would share their memory, at the cost of a file handle each, of which there are few."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        self.dispatch_table = copyreg.dispatch_table


def by_value(task: Task) -> bytes:
    """A task for a process that shares nothing with this one."""
    file = io.BytesIO()
    _ByValue(file).dump(task)
    return file.getvalue()


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def _say_nothing(chain: int, done: int, total: int, line: str) -> None:
    """No progress is wanted."""


def _warn(sentence: str) -> None:
    warnings.warn(sentence, JournalWarning, stacklevel=4)


def _died(number: int, error: Exception) -> str:
    return f"chain {number + 1} died of {type(error).__name__}: {error}"


def _killed(number: int, code: int | None) -> str:
    if code is not None and code < 0:
        memory = " (too little memory is the usual cause: take fewer chains)" if code == -9 else ""
        return f"chain {number + 1} was ended by signal {-code}, {signal.strsignal(-code)}{memory}"
    return (
        f"chain {number + 1} ended without a word (exit code {code}): its process did not come up, as where a script "
        "samples outside of `if __name__ == '__main__':`"
    )
