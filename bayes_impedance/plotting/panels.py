"""What every figure has in common: colours, grids of panels, bands, labels, files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from numpy.typing import NDArray

from bayes_impedance.outputs import whole_file
from bayes_impedance.posterior import Marginal, Posterior

Array = NDArray[np.float64]
Share = Literal["none", "all", "row", "col"]

POSTERIOR, PRIOR, MEASURED, TRUTH = "#0b6e99", "#9aa5ab", "#1a1a1a", "#c2410c"
#: Of x, y and z.
AXIS_COLOURS = ("#1a1a1a", "#c2410c", "#4d7c0f")


def chosen_trials(posterior: Posterior, trials: Sequence[int] | None) -> list[int]:
    """Four trials at most: more no longer fit on a page."""
    return list(range(len(posterior.log.trials)) if trials is None else trials)[:4]


def panel_grid(
    rows: int, columns: int, sharex: Share, sharey: Share, width: float = 3.2, height: float = 2.4
) -> tuple[Figure, list[list[Axes]]]:
    """A figure with `rows` × `columns` panels, each `width` × `height` inches."""
    figure = Figure(figsize=(max(6.0, width * columns), 0.7 + height * rows), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=sharex, sharey=sharey, squeeze=False)
    return figure, [list(row) for row in grid]


def draw_band(
    ax: Axes, abscissa: Array, marginal: Marginal, rows: slice | NDArray[np.int64], axis: int, name: str
) -> None:
    """Posterior median of one axis at the samples `rows`, with its 90 % band."""
    middle = marginal.quantile(0.5)[rows, axis]
    low, high = marginal.quantile(0.05)[rows, axis], marginal.quantile(0.95)[rows, axis]
    ax.fill_between(abscissa, low, high, color=POSTERIOR, alpha=0.3, lw=0)
    ax.plot(abscissa, middle, color=POSTERIOR, lw=1.2, label=f"{name}, 90 % band")


def label_panel(ax: Axes, column: int, row: int, rows: int, ylabel: str, xlabel: str) -> None:
    """Labels at the left and lower edge of a grid of panels."""
    ax.tick_params(labelsize=8, which="both")
    ax.grid(alpha=0.2)
    if column == 0:
        ax.set_ylabel(ylabel, fontsize=8)
    if row == rows - 1:
        ax.set_xlabel(xlabel, fontsize=8)


def finished(figure: Figure, grid: list[list[Axes]], title: str) -> Figure:
    """The figure under its title, with one legend for all of its panels."""
    figure.suptitle(title, fontsize=11)
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(handles), fontsize=8, frameon=False)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write one figure as PNG.

    Raises:
        OutputError: the file cannot be written.
    """
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=130)


def logarithmic(ax: Axes) -> None:
    """A logarithmic ordinate with plain numbers."""
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_locator(NullLocator())
