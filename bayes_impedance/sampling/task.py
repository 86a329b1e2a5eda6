"""The work of one chain from its checkpoint to its end, in whatever process that is."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyro
import torch

from bayes_impedance.config import SamplingConfig
from bayes_impedance.errors import OutputError
from bayes_impedance.sampling.checkpoint import Checkpoint
from bayes_impedance.sampling.density import SampledDensity
from bayes_impedance.sampling.nuts import Chain
from bayes_impedance.sampling.start import Start

#: Between two reports [s].
REPORTED = 0.25


@dataclass(frozen=True)
class Task:
    """What a chain needs to know."""

    density: SampledDensity
    start: Start
    settings: SamplingConfig
    checkpoint: Checkpoint | None

    def run(
        self,
        number: int,
        report: Callable[[int, int, str], None],
        warn: Callable[[str], None],
        stopped: Callable[[], bool] = lambda: False,
    ) -> Chain:
        """Chain `number` to its end, or until `stopped`, from its checkpoint on; with reports and checkpoints."""
        state = None if self.checkpoint is None else self.checkpoint.read(number)
        chain = Chain(self.density, self.start, self.settings, number, state)
        reported = kept = -np.inf
        keeping = self.checkpoint
        while chain.done < chain.total and not stopped():
            if time.monotonic() - reported >= REPORTED:
                report(chain.done, chain.total, chain.line)
                reported = time.monotonic()
            if keeping is not None and time.monotonic() - kept >= keeping.every:
                keeping = _keep(keeping, number, chain, warn)
                kept = time.monotonic()
            chain.advance()
        if keeping is not None:
            _keep(keeping, number, chain, warn)
        report(chain.done, chain.total, chain.line)
        return chain


def fingerprint(settings: SamplingConfig) -> dict[str, str]:
    """What the draws of a chain depend on beside model and data; how many chains there are is none of it."""
    named = {
        f"sampling.{name}": str(getattr(settings, name))
        for name in ("seed", "warmup", "draws", "target_acceptance", "max_tree_depth")
    }
    return {**named, "version of torch": torch.__version__, "version of pyro": pyro.__version__}


def _keep(
    checkpoint: Checkpoint, number: int, chain: Chain, warn: Callable[[str], None]
) -> Checkpoint | None:
    """Write a checkpoint; None where that failed and is not to be tried again."""
    try:
        checkpoint.write(number, chain.state())
    except OutputError as error:
        warn(f"{error}; sampling goes on, but if it is killed, chain {number + 1} is not kept from here on")
        return None
    return checkpoint
