"""One chain of NUTS, an iteration at a time; what it has drawn and how it goes on are plain arrays."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.config import SamplingConfig
from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.sampling.density import SampledDensity
from bayes_impedance.sampling.kernel import Kernel, State
from bayes_impedance.sampling.start import Start

Array = NDArray[np.float64]

#: What is noted of every draw, and as what.
STATISTICS: dict[str, type[np.generic]] = {
    "lp": np.float64,
    "diverging": np.bool_,
    "n_steps": np.int64,
    "acceptance_rate": np.float64,
    "step_size": np.float64,
    "energy": np.float64,
}
#: How often a start is taken nearer to the mode, by half each time, where the density is not finite.
HALVINGS = 20


class Chain:
    """Chain `number` of NUTS from a draw of Laplace's approximation `start`.

    `done` of `total` iterations, the warm-up among them; `stats` by name `(draws,)`, of which those drawn so far hold:
    `lp` log density of the coordinates [nats], whether `diverging`, `n_steps` gradients, mean `acceptance_rate` along
    the trajectory, `step_size`, and `energy` [nats] once the momentum was drawn. Random numbers follow from
    `settings.seed` and `number` alone; torch's own are left as they were.

    Raises:
        NotPositiveDefiniteError: the density is finite neither there nor at the mode.
    """

    def __init__(
        self,
        density: SampledDensity,
        start: Start,
        settings: SamplingConfig,
        number: int,
        state: Mapping[str, NDArray[np.generic]] | None = None,
    ) -> None:
        if state is not None:
            start = Start(np.array(state["point"]), np.array(state["root"]), start.outcome)
        self.start, self.warmup, self.total = start, settings.warmup, settings.warmup + settings.draws
        self.done = 0
        self._drawn = np.empty((settings.draws, density.size))
        self.stats = {name: np.zeros(settings.draws, dtype) for name, dtype in STATISTICS.items()}
        self._kernel = Kernel(density, start, settings)
        if state is not None:
            self._restore(state)
            return
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed_of(settings.seed, number))
            self._kernel.begin(_beginning(density, start))
            self._random = torch.get_rng_state()

    @property
    def standard(self) -> Array:
        """Coordinates of the draws so far, `(draws, size)`."""
        return self._drawn[: max(self.done - self.warmup, 0)]

    @property
    def line(self) -> str:
        """How it goes."""
        step = f"step size {self._kernel.step_size:.2g}"
        if self.done <= self.warmup:
            return f"warm-up, {step}"
        count = int(self.stats["diverging"].sum())
        return f"{step}, {count} divergence{'' if count == 1 else 's'}"

    def advance(self) -> None:
        """One iteration."""
        with torch.random.fork_rng(devices=[]):
            torch.set_rng_state(self._random)
            self._kernel.advance()
            self._random = torch.get_rng_state()
        draw = self.done - self.warmup
        self.done += 1
        if draw < 0:
            return
        self._drawn[draw] = self._kernel.standard
        trajectory = self._kernel.trajectory
        noted = {
            "lp": self._kernel.log_density,
            "diverging": trajectory.diverging,
            "n_steps": trajectory.n_steps,
            "acceptance_rate": trajectory.acceptance / trajectory.n_steps,
            "step_size": self._kernel.step_size,
            "energy": trajectory.energy,
        }
        for name, value in noted.items():
            self.stats[name][draw] = value

    def state(self) -> State:
        """All that it has drawn and that draws to come depend on: give it to a new one, and that goes on from here."""
        return {
            **self._kernel.state(),
            "done": np.array(self.done),
            "random": self._random.numpy().copy(),
            "point": self.start.point,
            "root": np.ascontiguousarray(self.start.root),
            "standard": self.standard.copy(),
            **{f"stats.{name}": values[: len(self.standard)].copy() for name, values in self.stats.items()},
        }

    def _restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        with torch.random.fork_rng(devices=[]):
            self._kernel.restore(state)
        self._random = torch.from_numpy(np.array(state["random"]))
        self.done = int(state["done"])
        self.standard[:] = state["standard"]
        for name, values in self.stats.items():
            values[: len(self.standard)] = state[f"stats.{name}"]


def seed_of(seed: int, number: int) -> int:
    """Seed of chain `number`: chains share no random numbers, whichever seeds are neighbours."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)[0] >> np.uint64(1))


def _beginning(density: SampledDensity, start: Start) -> Tensor:
    """A standard normal draw, or a point between it and the mode where the density and its gradient are finite."""
    drawn = torch.randn(density.size, dtype=torch.float64)
    for _ in range(HALVINGS):
        try:
            density.joint(start.at(drawn.numpy()))
        except NotPositiveDefiniteError:
            drawn = drawn / 2.0
        else:
            return drawn
    density.joint(start.point)
    return torch.zeros_like(drawn)
