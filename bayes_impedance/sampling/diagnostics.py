"""Whether draws can be trusted.

Rank-normalised split R-hat, bulk and tail effective sample size (ESS) after Vehtari, Gelman, Simpson, Carpenter and
Bürkner 2021 (doi 10.1214/20-BA1221); E-BFMI after Betancourt 2016 (arXiv:1604.00695); Pareto k: see `weigh`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from arviz_stats.base import array_stats
from numpy.typing import NDArray

from bayes_impedance.sampling.diagnosis import FEWEST, Diagnosis, Each
from bayes_impedance.sampling.draws import Draws

Array = NDArray[np.float64]


def diagnose(draws: Draws, names: Sequence[str], max_tree_depth: int = 10) -> Diagnosis:
    """Diagnostics of draws whose coordinates have `names`; `max_tree_depth` is that they were drawn with."""
    chains, count = draws.shape
    exact = draws.method == "nuts"
    values = draws.standard
    moved: NDArray[np.bool_] = np.zeros((chains, len(names)), dtype=bool)
    if count:
        moved = np.asarray(np.ptp(values, axis=1) > 0.0)
    enough = bool(chains) and count >= FEWEST
    moving: NDArray[np.bool_] = np.asarray(moved.any(0) & enough)
    if exact:
        bulk = _each(lambda x: array_stats.ess(x, method="bulk"), values, moving)
        tail = _each(lambda x: array_stats.ess(x, method="tail", prob=(0.05, 0.95)), values, moving)
        compared = moving if chains > 1 else np.zeros_like(moving)
        rhat = _each(lambda x: array_stats.rhat(x, method="rank"), values, compared)
    else:
        bulk = tail = tuple(_effective(draws) if moves else None for moves in moving)
        rhat = (None,) * len(names)
    energy, depth = draws.stats.get("energy"), draws.stats.get("n_steps")
    diverging = draws.stats.get("diverging")
    return Diagnosis(
        method=draws.method,
        names=tuple(names),
        chains=chains,
        draws=count,
        rhat=rhat,
        ess_bulk=bulk,
        ess_tail=tail,
        divergences=None if diverging is None else int(np.sum(diverging)),
        saturated=None if depth is None or not depth.size else float(np.mean(depth >= 2**max_tree_depth - 1)),
        e_bfmi=() if energy is None else tuple(_e_bfmi(chain) for chain in energy),
        pareto_k=draws.pareto_k,
        lost=draws.lost,
        remarks=draws.remarks,
        max_tree_depth=max_tree_depth,
        stuck=tuple(c for c in range(chains) if enough and not moved[c].any()),
        still=tuple(name for name, moves in zip(names, moving, strict=True) if enough and not moves),
    )


def _each(diagnostic: Callable[[Array], float], values: Array, wanted: NDArray[np.bool_]) -> Each:
    """A diagnostic of every wanted coordinate of `(chains, draws, size)`."""
    with np.errstate(all="ignore"):
        found = [float(diagnostic(values[..., i])) if wanted[i] else np.nan for i in range(values.shape[-1])]
    return tuple(value if np.isfinite(value) else None for value in found)


def _effective(draws: Draws) -> float:
    """What draws are worth among which there are copies, (Σ n)² / Σ n²."""
    points = draws.standard.reshape(-1, draws.standard.shape[-1])
    _, copies = np.unique(points, axis=0, return_counts=True)
    return float(copies.sum() ** 2 / np.square(copies).sum())


def _e_bfmi(energy: NDArray[np.generic]) -> float | None:
    """How well the momentum explores the energies of one chain."""
    values = np.asarray(energy, dtype=np.float64)
    if len(values) < FEWEST or not np.all(np.isfinite(values)) or not np.ptp(values) > 0.0:
        return None
    return float(array_stats.bfmi(values[None])[0])
