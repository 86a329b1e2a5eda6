"""What diagnostics found, in words, with what to do about it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from bayes_impedance.config.inference import SamplingMethod
from bayes_impedance.sampling.importance import TRUSTED_K

#: One number for each coordinate, or None where it has none.
Each = tuple[float | None, ...]

#: Beyond these a reader is told: R-hat, ESS for each chain and of an approximation, E-BFMI, and the share of iterations
#: at the largest tree depth.
LARGEST_RHAT, LEAST_ESS, LEAST_ESS_OF_APPROXIMATION, LEAST_E_BFMI, SATURATED = 1.01, 100, 400, 0.3, 0.05
#: The fewest draws of a chain that say anything.
FEWEST = 4
#: Coordinates that are named, the worst first.
NAMED = 3


@dataclass(frozen=True)
class Diagnosis:
    """Diagnostics of `draws` draws of each of `chains`, and what they mean in `findings`.

    `rhat`, `ess_bulk`, `ess_tail`: of each coordinate in `names`. None stands where something does not apply or cannot
    be told, of which `findings` speak. R-hat wants two chains; `divergences`, the share `saturated` of iterations at
    the largest tree depth, and `e_bfmi` of each chain are of nuts, `pareto_k` of approximations, whose ESS is
    their number where none are copies of one another.
    """

    method: SamplingMethod
    names: tuple[str, ...]
    chains: int
    draws: int
    rhat: Each
    ess_bulk: Each
    ess_tail: Each
    divergences: int | None
    saturated: float | None
    e_bfmi: Each
    pareto_k: float | None
    lost: tuple[str, ...]
    remarks: tuple[str, ...]
    max_tree_depth: int
    stuck: tuple[int, ...] = ()
    still: tuple[str, ...] = ()
    findings: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "findings", tuple(_sentences(self)))

    @property
    def is_sound(self) -> bool:
        """Whether nothing was found, and everything that applies could be told."""
        return not self.findings

    @property
    def summary(self) -> str:
        """One line: method, draws, and the worst of each diagnostic."""
        parts = [f"{self.method}: {self.draws} draws"]
        if self.method == "nuts":
            parts = [f"nuts: {self.chains} chains of {self.draws} draws"]
        if worst := self.worst(self.rhat):
            parts.append(f"R-hat at most {worst[0][1]:.3f}")
        if worst := self.worst(self.ess_bulk, largest=False) + self.worst(self.ess_tail, largest=False):
            parts.append(f"ESS at least {min(value for _, value in worst):.0f}")
        if self.divergences is not None:
            parts.append(f"{self.divergences or 'no'} divergences")
        if self.pareto_k is not None:
            parts.append(f"Pareto k {self.pareto_k:.2f}")
        return ", ".join(parts)

    @property
    def least_ess(self) -> int:
        """The ESS that quantiles want."""
        return LEAST_ESS * self.chains if self.method == "nuts" else LEAST_ESS_OF_APPROXIMATION

    def worst(self, values: Each, largest: bool = True) -> list[tuple[str, float]]:
        """Coordinates that have a value with it, the worst first."""
        known = [(name, value) for name, value in zip(self.names, values, strict=True) if value is not None]
        return sorted(known, key=lambda item: item[1], reverse=largest)

    def as_dict(self) -> dict[str, str | int | float | list[str]]:
        """Numbers and sentences for JSON, and for the attributes of a file; what does not apply is left out."""
        summary: dict[str, str | int | float | list[str]] = {
            "method": self.method,
            "chains": self.chains,
            "draws": self.draws,
            "is_sound": int(self.is_sound),
        }
        for key, values, largest in (
            ("rhat_max", self.rhat, True),
            ("ess_bulk_min", self.ess_bulk, False),
            ("ess_tail_min", self.ess_tail, False),
        ):
            if worst := self.worst(values, largest):
                summary[f"{key}_of"], summary[key] = worst[0]
        if energies := [value for value in self.e_bfmi if value is not None]:
            summary["e_bfmi_min"] = min(energies)
        for key, value in (
            ("divergences", self.divergences),
            ("largest_tree_depth_share", self.saturated),
            ("pareto_k", self.pareto_k),
        ):
            if value is not None:
                summary[key] = value
        for key, lines in (("lost_chains", self.lost), ("findings", self.findings)):
            if lines:
                summary[key] = list(lines)
        return summary


def _sentences(d: Diagnosis) -> Iterator[str]:
    """What a reader should know of draws, and do."""
    for reason in d.lost:
        yield f"a chain died ({reason}), and the draws are those of the others; sample again with another sampling.seed"
    if not d.chains:
        yield "no chain is left to say anything of; check the priors under model, or use sampling.method=svi"
        return
    yield from _of_exact(d) if d.method == "nuts" else _of_approximation(d)
    yield from d.remarks


def _of_exact(d: Diagnosis) -> Iterator[str]:
    """Of chains."""
    if d.draws < FEWEST:
        yield f"{d.draws} draws a chain are too few for R-hat and ESS; set sampling.draws to {LEAST_ESS} or more"
    if d.chains == 1:
        yield "one chain cannot be compared with others, which is what R-hat does; set sampling.chains to 4"
    for chain in d.stuck:
        yield (
            f"chain {chain} never moved; set sampling.target_acceptance nearer 1, sampling.warmup longer, or sample "
            "again with another sampling.seed"
        )
    if d.still and len(d.stuck) < d.chains:
        yield f"{_listed(list(d.still))} never moved in any chain; sample again with another sampling.seed"
    if bad := [(name, value) for name, value in d.worst(d.rhat) if value > LARGEST_RHAT]:
        yield (
            f"R-hat is {_valued(bad, '.3f')}, above {LARGEST_RHAT}: chains have not come to one posterior; set "
            "sampling.draws and sampling.warmup higher, and plot the chains: those that stay apart show several modes"
        )
    for part, values, use in (
        ("bulk", d.ess_bulk, "means and SDs"),
        ("tail", d.ess_tail, "5 and 95 % quantiles"),
    ):
        if bad := [(name, value) for name, value in d.worst(values, largest=False) if value < d.least_ess]:
            draws = int(np.ceil(d.least_ess / max(bad[0][1], 1.0))) * d.draws
            yield (
                f"{part} ESS is {_valued(bad, '.0f')}, below {d.least_ess} ({LEAST_ESS} a chain): {use} are not yet "
                f"exact; set sampling.draws to {draws}"
            )
    if d.divergences:
        yield (
            f"{d.divergences} of {d.chains * d.draws} draws diverged: the posterior has corners that the chains cannot "
            "enter, and the draws leave out; set sampling.target_acceptance nearer 1 (.95, then .99), and check that "
            "no prior under model is wider than what is known"
        )
    if d.saturated is not None and d.saturated > SATURATED:
        yield (
            f"{d.saturated:.0%} of iterations ended at the largest tree depth {d.max_tree_depth}: the posterior is "
            "longer in some direction than steps reach; set sampling.warmup higher, then sampling.max_tree_depth to "
            f"{d.max_tree_depth + 1}"
        )
    if bad := [(f"chain {c}", e) for c, e in enumerate(d.e_bfmi) if e is not None and e < LEAST_E_BFMI]:
        yield (
            f"E-BFMI is {_valued(sorted(bad, key=lambda item: item[1]), '.2f')}, below {LEAST_E_BFMI}: tails of the "
            "posterior are hardly visited; set sampling.warmup higher, and check that no prior under model is wider "
            "than what is known"
        )


def _of_approximation(d: Diagnosis) -> Iterator[str]:
    """Of an approximation with importance weights."""
    if d.pareto_k is not None and d.pareto_k > TRUSTED_K:
        yield (
            f"Pareto k is {d.pareto_k:.2f}, above {TRUSTED_K}: {d.method} is too far from the posterior to be "
            "corrected by weights, and its means, SDs and quantiles cannot be trusted; use sampling.method=nuts"
        )
    if d.still:
        yield f"{_listed(list(d.still))} are the same in all draws; set sampling.draws higher"
    effective = [value for value in d.ess_bulk if value is not None]
    if d.draws < FEWEST:
        yield f"{d.draws} draws are too few for any diagnostics; set sampling.draws to {LEAST_ESS} or more"
    elif effective and effective[0] < d.least_ess:
        yield (
            f"the {d.draws} draws are worth {effective[0]:.0f} independent ones, fewer than {d.least_ess}: copies of "
            "few proposals, or too few draws; set sampling.draws higher, and if that does not help sampling.method=nuts"
        )


def _valued(items: Sequence[tuple[str, float]], form: str) -> str:
    return _listed([f"{value:{form}} for {name}" for name, value in items])


def _listed(items: Sequence[str]) -> str:
    """The first of them, and how many more."""
    more = len(items) - NAMED
    return ", ".join(items[:NAMED]) + (f" and {more} more" if more > 0 else "")
