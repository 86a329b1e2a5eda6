"""Ranks of a calibration: histograms, and differences of empirical distribution functions."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bayes_impedance.calibration.run import Calibration
from bayes_impedance.calibration.uniformity import (
    BAND,
    Uniformity,
    ecdf_difference,
    histogram,
    histogram_band,
)
from bayes_impedance.plotting.panels import (
    MEASURED,
    POSTERIOR,
    PRIOR,
    TRUTH,
    finished,
    label_panel,
    panel_grid,
    save_figure,
)

#: Panels in a row of a figure.
COLUMNS = 4


def plot_rank_histograms(calibration: Calibration) -> Figure:
    """Ranks of each quantity in bins of equal width, a panel each, with the band that uniform ranks stay in.

    Raises:
        ConfigurationError: too few draws have a posterior.
    """

    def draw(ax: Axes, found: Uniformity) -> None:
        ranks = calibration.ranks(found.name)
        counts = histogram(ranks, calibration.thinned)
        low, high = histogram_band(found.count, found.bins)
        edges = np.linspace(0.0, 1.0, found.bins + 1)
        ax.axhspan(low, high, color=PRIOR, alpha=0.3, lw=0, label=f"{BAND:g} of uniform ranks, in a bin")
        ax.stairs(counts, edges, fill=True, color=POSTERIOR, alpha=0.7, label="ranks of the truth")
        ax.axhline(found.count / found.bins, color=MEASURED, lw=0.8)
        ax.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=5))

    title = f"Ranks of the truth among draws of {calibration.method}"
    return _panels(calibration, draw, title, "draws in a bin", "rank, as a share")


def plot_ecdf_differences(calibration: Calibration) -> Figure:
    """Share of ranks below a place less that of uniform ones, a panel a quantity, with its simultaneous band.

    Raises:
        ConfigurationError: too few draws have a posterior.
    """

    def draw(ax: Axes, found: Uniformity) -> None:
        at, difference = ecdf_difference(calibration.ranks(found.name), calibration.thinned)
        low, high = (np.concatenate([[0.0], edge, [0.0]]) for edge in calibration.band)
        everywhere = np.concatenate([[0.0], at, [1.0]])
        chance = f"{1.0 - calibration.level:.4g} of uniform ranks, everywhere"
        ax.fill_between(everywhere, low, high, color=PRIOR, alpha=0.3, lw=0, label=chance)
        ax.plot(
            everywhere, np.concatenate([[0.0], difference, [0.0]]), color=POSTERIOR, lw=1.2, label="ranks"
        )
        ax.axhline(0.0, color=MEASURED, lw=0.8)

    title = f"Distribution of the ranks less the uniform one, draws of {calibration.method}"
    return _panels(calibration, draw, title, "difference of shares", "rank, as a share")


def save_calibration_figures(calibration: Calibration, folder: Path) -> list[Path]:
    """Write `rank_histograms.png` and `ecdf_differences.png` into `folder`.

    Raises:
        ConfigurationError: too few draws have a posterior.
        OutputError: the folder cannot be written.
    """
    figures = {
        "rank_histograms.png": plot_rank_histograms(calibration),
        "ecdf_differences.png": plot_ecdf_differences(calibration),
    }
    for name, figure in figures.items():
        save_figure(figure, folder / name)
    return [folder / name for name in figures]


def _panels(
    calibration: Calibration, draw: Callable[[Axes, Uniformity], None], title: str, ylabel: str, xlabel: str
) -> Figure:
    columns = min(COLUMNS, len(calibration.uniformity))
    rows = math.ceil(len(calibration.uniformity) / columns)
    figure, grid = panel_grid(rows, columns, sharex="all", sharey="all", width=2.9, height=2.2)
    panels = [(ax, row, column) for row, line in enumerate(grid) for column, ax in enumerate(line)]
    for (ax, row, column), found in zip(panels, calibration.uniformity, strict=False):
        draw(ax, found)
        colour = MEASURED if found.verdict == "uniform" else TRUTH
        ax.set_title(f"{found.name}\nχ² p = {found.p:.2g}", fontsize=8, color=colour)
        label_panel(ax, column, row, rows, ylabel, xlabel)
    for ax, _, _ in panels[len(calibration.uniformity) :]:
        ax.set_visible(False)
    return finished(figure, grid, title)
