"""Draws of all processes before any force, at every sample of a row."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.engines.markov.arrangement import (
    Samples,
    Structure,
    increments,
    process_numbers,
)
from bayes_impedance.engines.markov.observation import Scales
from bayes_impedance.engines.markov.recursions import Floats, Integers
from bayes_impedance.engines.markov.simulate import simulate


@dataclass(frozen=True)
class Chain:
    """Samples along the input of a process: one realisation after another, each from where it is `fresh`.

    `order` `(n,)`: which sample is next; `steps` `(n,)`: how far it is beyond the one before it.
    """

    order: Integers
    steps: Floats
    fresh: NDArray[np.bool_]

    @classmethod
    def of(cls, process: Integers, value: Floats) -> Self:
        """That of processes numbered by `process` `(n,)` over `value` `(n,)`."""
        order = np.lexsort((value, process))
        return cls(order, increments(value[order], process[order]), np.diff(process[order], prepend=-1) != 0)


def chains_of(samples: Samples, structure: Structure) -> tuple[Chain, ...]:
    """That of the trajectory, then those of the terms of the residual.

    Unlike `arrange` they take samples of each process in the order of its own input, and trials that nothing is
    observed of one by one.
    """
    trajectory, residual, _ = process_numbers(samples, structure)
    own = [Chain.of(residual, values) for values in samples.own.T]
    return Chain.of(trajectory, samples.theta), *own


def draw_states(
    chains: tuple[Chain, ...], scales: Scales, structure: Structure, generator: torch.Generator
) -> Tensor:
    """States of every axis at every sample, `(n, axes, states)`: those of the trajectory, then those of each term."""
    sizes = [3, *(term.size for term in structure.terms)]
    rates = [scales.rate, *scales.residual_rate.T]
    shape = (len(chains[0].order), len(scales.rate), sum(sizes))
    states = torch.randn(shape, generator=generator, dtype=torch.float64)
    first = 0
    for chain, size, rate in zip(chains, sizes, rates, strict=True):
        simulate(
            size,
            first,
            rate.detach().contiguous().numpy(),
            chain.steps,
            chain.fresh,
            chain.order,
            states.numpy(),
        )
        first += size
    return states
