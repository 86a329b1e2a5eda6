"""Many draws, in one process or several, and what their ranks show."""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections import Counter
from collections.abc import Callable, Generator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.calibration.draw import Settings, Trials
from bayes_impedance.calibration.records import Ledger, Record, fingerprint
from bayes_impedance.calibration.uniformity import (
    LEVEL,
    Uniformity,
    assess_uniformity,
    bins_for,
    ecdf_band,
)
from bayes_impedance.errors import SimulationError

Array = NDArray[np.float64]

#: Called as progress(draws done, draws planned, what the last one came to).
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Calibration:
    """Records of all draws by `method`, in their order, with ranks on 0 … `thinned`."""

    method: str
    thinned: int
    records: tuple[Record, ...]

    @property
    def sampled(self) -> tuple[Record, ...]:
        """Records of draws that have a posterior, sound or not."""
        return tuple(record for record in self.records if record.failure is None)

    @property
    def names(self) -> tuple[str, ...]:
        """Ranked quantities."""
        return tuple(self.sampled[0].rank) if self.sampled else ()

    def ranks(self, name: str) -> NDArray[np.int64]:
        """Of one quantity, `(sampled,)`."""
        return np.array([record.rank[name] for record in self.sampled], dtype=np.int64)

    def deviations(self, name: str) -> Array:
        """z = (truth − mean)/SD of one quantity, `(sampled,)`."""
        return np.array([record.z[name] for record in self.sampled])

    @property
    def level(self) -> float:
        """Level of the tests of one quantity."""
        return LEVEL / max(1, len(self.names))

    @cached_property
    def band(self) -> tuple[Array, Array]:
        """Band of the difference of an ECDF, at that level."""
        return ecdf_band(len(self.sampled), self.thinned, 1.0 - self.level)

    @cached_property
    def uniformity(self) -> tuple[Uniformity, ...]:
        """What the ranks of each quantity show.

        Raises:
            ConfigurationError: too few draws have a posterior.
        """
        bins_for(len(self.sampled), self.thinned)
        return tuple(
            assess_uniformity(
                name, self.ranks(name), self.deviations(name), self.thinned, self.band, self.level
            )
            for name in self.names
        )

    def remarks(self) -> list[str]:
        """How many draws failed, or are doubtful and why, in sentences."""
        total = len(self.records)
        failures = Counter(record.failure for record in self.records if record.failure is not None)
        doubts = Counter(doubt for record in self.records for doubt in record.unsound)
        return [
            *(
                f"{count} of {total} draws have no posterior and no rank: {why}"
                for why, count in failures.items()
            ),
            *(f"{count} of {total} draws, ranked as they are: {why}." for why, count in doubts.items()),
        ]

    def as_json(self) -> dict[str, Any]:
        """Tests and verdicts by quantity, with ranks and z, and remarks, as plain JSON."""
        return {
            "method": self.method,
            "draws": len(self.records),
            "draws of a rank": self.thinned,
            "level": self.level,
            "remarks": self.remarks(),
            "quantities": {
                found.name: {
                    "p": found.p,
                    "bins": found.bins,
                    "inside_band": found.inside,
                    "mean_z": found.shift,
                    "sd_z": found.spread,
                    "verdict": found.verdict,
                    "ranks": self.ranks(found.name).tolist(),
                }
                for found in self.uniformity
            },
        }


def calibrate(
    settings: Settings,
    draws: int,
    folder: Path | None = None,
    processes: int = 1,
    progress: Progress | None = None,
) -> Calibration:
    """Draws number 0 … `draws` − 1; those that `folder` has are not made again.

    Interrupting (Ctrl-C) keeps in `folder` what is done.

    Raises:
        ConfigurationError: see `Trials`, or too few draws are asked for.
        OutputError: `folder` holds another calibration, or cannot be written.
        SimulationError: a process died.
    """
    bins_for(draws, settings.thinned)
    trials = Trials(settings)
    identity = fingerprint(settings.config, settings.motion, settings.seed, settings.thinned)
    ledger = Ledger(folder, identity)
    missing = [index for index in range(draws) if index not in ledger.records]
    done = draws - len(missing)
    with closing(_records(trials, missing, min(processes, len(missing)))) as records:
        for record in records:
            ledger.keep(record)
            done += 1
            if progress is not None:
                progress(done, draws, record.failure or ", ".join(record.unsound) or "sound")
    return Calibration(
        settings.config.sampling.method,
        settings.thinned,
        tuple(ledger.records[index] for index in range(draws)),
    )


def _records(trials: Trials, missing: list[int], processes: int) -> Generator[Record, None, None]:
    """Records as they come."""
    if processes <= 1:
        yield from map(trials, missing)
        return
    others = set(multiprocessing.active_children())
    # A fork would share locks of threads that are gone in it.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, _begin, (trials.settings,)) as pool:
        try:
            for future in as_completed([pool.submit(_one, index) for index in missing]):
                yield future.result()
        except BrokenProcessPool as error:
            raise SimulationError(
                "expected every process of the calibration to live, found that one died, perhaps for want of memory; "
                "the same command continues with --out, and with --processes 1 needs less"
            ) from error
        except BaseException:
            # Ctrl-C: draws that are not done are made again by whoever continues.
            pool.shutdown(wait=False, cancel_futures=True)
            mine = set(multiprocessing.active_children()) - others
            for process in mine:
                process.terminate()
            # A thread of the pool may be the one to hear of their end, and then a join here returns before it is noted.
            while mine & set(multiprocessing.active_children()):
                time.sleep(0.01)
            raise


#: Trials of a worker process.
_own: list[Trials] = []


def _begin(settings: Settings) -> None:
    # Ctrl-C reaches all processes of a terminal; the one that waits ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _own[:] = [Trials(settings)]


def _one(index: int) -> Record:
    return _own[0](index)
