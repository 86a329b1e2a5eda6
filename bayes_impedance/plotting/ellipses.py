"""Ellipses of stiffness, damping and mass along the path of the hand, each with its verdict."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayes_impedance.errors import LogError
from bayes_impedance.identifiability import Verdict, rounded
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.plotting.panels import (
    MEASURED,
    POSTERIOR,
    PRIOR,
    TRUTH,
    finished,
    label_panel,
    panel_grid,
)
from bayes_impedance.posterior import Posterior, draw_matrices
from bayes_impedance.posterior.results import UNITS
from bayes_impedance.preprocessing import PreparedTrial

Array = NDArray[np.float64]

#: Directions in which the radius of an ellipse is drawn, the last being the first again.
ANGLES = np.linspace(0.0, 2.0 * np.pi, 121)
#: Greatest radius of an ellipse, as a share of the extent of the path.
LARGEST_RADIUS = 0.12


def plot_ellipses(
    posterior: Posterior,
    verdicts: Iterable[Verdict],
    trial: int = 0,
    planes: Sequence[str] | None = None,
    count: int = 10,
    draws: int = 200,
    seed: int = 0,
) -> Figure:
    """Ellipses {W e : |e| = 1} of W = K, D and M along one trial, a matrix a column and a plane a row.

    The force within the plane that answers a displacement of 1 m, a velocity of 1 m/s and an acceleration of 1 m/s² in
    each direction, at `count` evenly spaced phases, or times where there is no phase. The line is the ellipse of
    the median of each entry, the band the 90 % interval of the radius in each direction, from `draws` draws of the
    matrices; the truth is dashed where the log has it. Below the path stand a scale and the median ellipse of the
    prior. `planes` such as `["xy"]`; all by default.

    Raises:
        LogError: the log has but one axis, or no such plane.
    """
    chosen = _checked(posterior.axes, planes)
    verdicts = list(verdicts)
    record, rows = posterior.log.trials[trial], posterior.trial_slice(trial)
    places = evenly_spaced(record.time if record.phase is None else record.phase, count)
    drawn = draw_matrices(posterior, draws, seed)[:, rows.start + places]
    prior = draw_matrices(posterior, draws, seed, prior=True)[:, rows].reshape(-1, *drawn.shape[2:])
    figure, grid = panel_grid(
        len(chosen), len(IMPEDANCE_ORDER), sharex="none", sharey="none", width=4.0, height=4.0
    )
    for row, plane in enumerate(chosen):
        first, second = (posterior.axes.index(axis) for axis in plane)
        for latent, column in IMPEDANCE_ORDER.items():
            ax = grid[row][column]
            blocks, before = (_block(part[..., column, :, :], first, second) for part in (drawn, prior))
            hand = record.position[:, (first, second)]
            truth = _true_matrices(record, latent, plane)
            shown = _Ellipses(blocks, before, None if truth is None else truth[places])
            _draw_panel(ax, hand, hand[places], shown, UNITS[latent])
            ax.set_title(_said(verdicts, latent, plane), fontsize=8)
            label_panel(ax, column, row, len(chosen), f"{plane[1]} [m]", f"{plane[0]} [m]")
            ax.set_xlabel(f"{plane[0]} [m]", fontsize=8)
    title = f"Force for a unit displacement, velocity and acceleration along trial {record.name}"
    return finished(figure, grid, title)


def evenly_spaced(abscissa: Array, count: int) -> NDArray[np.int64]:
    """Samples next to the middles of `count` equal parts of the range of `abscissa`, `(samples,)`; none twice.

    Example:
        >>> evenly_spaced(np.linspace(0.0, 1.0, 101), 4).tolist()
        [12, 37, 62, 87]
    """
    low, high = abscissa.min(), abscissa.max()
    middles = low + (high - low) * (np.arange(count) + 0.5) / count
    nearest = np.abs(abscissa - middles[:, None]).argmin(axis=1)
    return np.asarray(list(dict.fromkeys(nearest.tolist())), dtype=np.int64)


def ellipse_radii(matrices: Array) -> Array:
    """Radius of {W e : |e| = 1} in the directions `ANGLES`, `(…, angles)` [unit of W], of symmetric W `(…, 2, 2)`.

    r(φ) = |det W| / |adj(W) n(φ)|, with n the unit vector at φ.

    Example:
        >>> ellipse_radii(np.diag([3.0, 2.0]))[[0, 30]].round(6).tolist()
        [3.0, 2.0]
    """
    xx, xy, yy = (matrices[..., i, j, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    c, s = np.cos(ANGLES), np.sin(ANGLES)
    return np.asarray(np.abs(xx * yy - xy**2) / np.hypot(yy * c - xy * s, xx * s - xy * c))


def _checked(axes: Sequence[str], planes: Sequence[str] | None) -> list[str]:
    known = ["".join(pair) for pair in combinations(axes, 2)]
    if not known:
        raise LogError(
            f"expected a log of two or three axes for ellipses, found one, {axes[0]}; draw it with plot_impedance"
        )
    for plane in planes or ():
        if plane not in known:
            raise LogError(
                f"planes: expected some of {', '.join(known)}, the planes of this log's axes, got {plane!r}; choose "
                "among these"
            )
    return known if planes is None else list(planes)


@dataclass(frozen=True)
class _Ellipses:
    """What one panel shows: draws `(draws, places, 2, 2)`, prior `(draws, 2, 2)`, truth `(places, 2, 2)`."""

    drawn: Array
    prior: Array
    truth: Array | None


def _draw_panel(ax: Axes, path: Array, centres: Array, shown: _Ellipses, unit: str) -> None:
    """Ellipses at `centres` of a path `(samples, 2)` [m]."""
    low, high = np.quantile(ellipse_radii(shown.drawn), (0.05, 0.95), axis=0)
    middle = ellipse_radii(np.median(shown.drawn, axis=0))
    extent = float(np.hypot(*np.ptp(path, axis=0))) or 1.0
    scale = LARGEST_RADIUS * extent / float(high.max())
    ax.plot(*path.T, color=PRIOR, lw=1.0, label="hand")
    for k, centre in enumerate(centres):
        outer, inner = (_outline(centre, scale * edge[k]) for edge in (high, low))
        ax.fill(*np.hstack([outer, inner[:, ::-1]]), color=POSTERIOR, alpha=0.3, lw=0)
        (line,) = ax.plot(*_outline(centre, scale * middle[k]), color=POSTERIOR, lw=1.2)
        if k == 0:
            line.set_label("posterior, 90 % band")
        ax.plot(*centre, ".", ms=3, color=MEASURED)
    if shown.truth is not None:
        for k, (centre, radii) in enumerate(zip(centres, ellipse_radii(shown.truth), strict=True)):
            (line,) = ax.plot(*_outline(centre, scale * radii), "--", color=TRUTH, lw=1.2)
            if k == 0:
                line.set_label("truth")
    prior = ellipse_radii(np.median(shown.prior, axis=0))
    _draw_key(ax, scale, prior, float(middle.max()), unit)
    ax.set_aspect("equal", adjustable="datalim")
    ax.locator_params(nbins=6)


def _draw_key(ax: Axes, scale: float, prior: Array, largest: float, unit: str) -> None:
    """A bar of `scale` [m per unit] and the ellipse of the prior, below what has been drawn."""
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    size = scale * float(prior.max())
    height = bottom - size - 0.03 * (top - bottom)
    ax.fill(
        *_outline(np.array([right - size, height]), scale * prior), color=PRIOR, alpha=0.25, lw=0, label="prior, median"
    )  # fmt: skip
    length = _round_number(largest)
    ax.plot([left, left + scale * length], [height] * 2, color=MEASURED, lw=2, solid_capstyle="butt")
    ax.annotate(
        f"{length:g} {unit}", (left, height), (0, 4), textcoords="offset points", fontsize=8, va="bottom"
    )


def _outline(centre: Array, radii: Array) -> Array:
    """Points `(2, angles)` at `radii` `(angles,)` from `centre`."""
    return np.asarray(centre[:, None] + radii * np.stack([np.cos(ANGLES), np.sin(ANGLES)]))


def _round_number(value: float) -> float:
    """The greatest of 1, 2, 5, 10, … that is not above `value`."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * max(digit for digit in (1.0, 2.0, 5.0) if digit * power <= value)


def _block(matrices: Array, first: int, second: int) -> Array:
    """Rows and columns `first` and `second` of matrices, `(…, 2, 2)`."""
    return matrices[..., (first, second), :][..., (first, second)]


def _true_matrices(record: PreparedTrial, latent: Latent, plane: str) -> Array | None:
    """True matrices in a plane, `(samples, 2, 2)`; None where the log does not have all of their entries."""
    a, b = tuple(plane)
    names = [f"{latent.value}_{entry}" for entry in (a + a, a + b, a + b, b + b)]
    if not set(names) <= set(record.truth):
        return None
    return np.stack([record.truth[name] for name in names], axis=-1).reshape(-1, 2, 2)


def _said(verdicts: Sequence[Verdict], latent: Latent, plane: str) -> str:
    """The verdicts on the two axes of a plane, in one where they agree, and the lesser contraction."""
    found = {verdict.axis: verdict for verdict in verdicts if verdict.latent is latent}
    first, second = (found[axis] for axis in plane)
    said = first.support.value
    if first.support is not second.support:
        # In two lines, for a panel is not wide enough for both.
        said = ",\n".join(f"{v.axis}{v.axis} {v.support.value}" for v in (first, second))
    least = rounded(min(first.contraction, second.contraction))
    sign = "" if least.startswith(">") else "≥ "
    return f"{latent.value}: {said} (contraction {sign}{least})"
