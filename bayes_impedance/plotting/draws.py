"""Figures of a posterior that was drawn: impedance, desired trajectory, force, and what stiffness goes with."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayes_impedance.identifiability import rounded
from bayes_impedance.impedance_functions.symmetric import entries
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.plotting.panels import (
    MEASURED,
    POSTERIOR,
    PRIOR,
    TRUTH,
    finished,
    label_panel,
    logarithmic,
    panel_grid,
    save_figure,
)
from bayes_impedance.posterior.results import UNITS
from bayes_impedance.sampling.drawn import DrawnPosterior

Array = NDArray[np.float64]

#: Draws of the prior behind the grey bands, and points of a scatter plot at most.
PRIOR_DRAWS, POINTS = 300, 1000
#: Trials of which forces are drawn at most.
TRIALS = 4


def save_draw_figures(posterior: DrawnPosterior, folder: Path) -> list[Path]:
    """Write `impedance.png`, `desired_trajectory.png`, `force.png`, and `confounding.png` where σ_xd was drawn.

    Raises:
        OutputError: the folder cannot be written.
    """
    figures = {
        "impedance.png": plot_drawn_impedance(posterior),
        "desired_trajectory.png": plot_drawn_trajectory(posterior),
        "force.png": plot_drawn_force(posterior),
    }
    if "desired_trajectory_sd" in posterior.values():
        figures["confounding.png"] = plot_confounding(posterior)
    for name, figure in figures.items():
        save_figure(figure, folder / name)
    return [folder / name for name in figures]


def plot_drawn_impedance(posterior: DrawnPosterior, group: int = 0) -> Figure:
    """K, D and M at the places of one group: prior and posterior 90 % bands, with the verdict; truth where known.

    An entry a column: the diagonal, then, where axes are coupled, what stands beside it, on a linear scale.
    """
    axes = posterior.axes
    shown = entries(len(axes), posterior.coupled)
    figure, grid = panel_grid(
        len(IMPEDANCE_ORDER),
        len(shown),
        sharex="all",
        sharey="none",
        width=4.6 if len(shown) < 3 else 4.0,
    )
    own = posterior.places_of(group)
    abscissa, name = posterior.abscissa(group)
    pieces = posterior.pieces(group)
    prior = posterior.prior_impedance(PRIOR_DRAWS)
    said = {(one.verdict.latent, one.verdict.axis): one.verdict for one in posterior.verdicts}
    for row, latent in enumerate(IMPEDANCE_ORDER):
        matrices = posterior.of_group(posterior.matrices(latent), group)
        for column, (a, b) in enumerate(shown):
            ax = grid[row][column]
            low, high = np.quantile(prior[latent][:, own, a, b], [0.05, 0.95], axis=0)
            for i, piece in enumerate(pieces):
                label = None if i else "prior, 90 %"
                ax.fill_between(
                    abscissa[piece], low[piece], high[piece], color=PRIOR, alpha=0.25, lw=0, label=label
                )
            _band(ax, abscissa, matrices[..., a, b], "posterior", pieces)
            entry = f"{axes[a]}{axes[b]}"
            _truth(ax, posterior, group, f"{latent.value}_{entry}")
            title = f"{latent.value} {entry}"
            if a == b:
                logarithmic(ax)
                verdict = said[latent, axes[a]]
                title += f": {verdict.support.value} (contraction {rounded(verdict.contraction)})"
            ax.set_title(title, fontsize=8)
            label_panel(ax, column, row, len(IMPEDANCE_ORDER), f"{latent.value} [{UNITS[latent]}]", name)
    return finished(figure, grid, _title("Impedance", posterior, group))


def plot_drawn_trajectory(posterior: DrawnPosterior, group: int = 0) -> Figure:
    """Desired position at the places of one group, with the positions of the hand; truth where known."""
    axes = posterior.axes
    figure, grid = panel_grid(1, len(axes), sharex="all", sharey="none", width=4.6)
    abscissa, name = posterior.abscissa(group)
    desired = posterior.of_group(posterior.at_places(Latent.DESIRED_POSITION), group)
    for a, axis in enumerate(axes):
        ax = grid[0][a]
        for i, (trial, rows, place) in enumerate(posterior.courses(group)):
            label = "hand" if i == 0 else None
            ax.plot(place, trial.position[rows, a], color=MEASURED, lw=0.6, alpha=0.6, label=label)
        _band(ax, abscissa, desired[..., a], "desired", posterior.pieces(group))
        _truth(ax, posterior, group, f"desired_position_{axis}")
        label_panel(ax, 0, 0, 1, f"{axis} [m]", name)
    return finished(figure, grid, _title("Desired trajectory", posterior, group))


def plot_drawn_force(posterior: DrawnPosterior) -> Figure:
    """Measured force of some trials, and the 90 % band of a new measurement there (posterior predictive)."""
    trials, rows = posterior.kept(posterior.places.forces)
    axes = posterior.axes
    shown = min(len(trials), TRIALS)
    figure, grid = panel_grid(len(axes), shown, sharex="none", sharey="row")
    predicted, measured = posterior.at_samples(Latent.FORCE), posterior.recorded("force")
    ends = np.cumsum([len(own) for own in rows])
    for column in range(shown):
        part = slice(ends[column] - len(rows[column]), ends[column])
        time = trials[column].time[rows[column]]
        for a, axis in enumerate(axes):
            ax = grid[a][column]
            _band(ax, time, predicted[:, :, part, a], "predicted", [slice(None)])
            if measured is not None:
                ax.plot(time, measured[part, a], ".", ms=2, color=MEASURED, label="measured")
            label_panel(ax, column, a, len(axes), f"force {axis} [N]", "time [s]")
            if a == 0:
                ax.set_title(f"trial {trials[column].name}", fontsize=8)
    return finished(figure, grid, f"Force, drawn by {posterior.draws.method}")


def plot_confounding(posterior: DrawnPosterior) -> Figure:
    """Stiffness of each axis against the SD of the desired trajectory, a point a draw: a line is a product.

    Data that know only k σ_xd leave the points on a line of slope −1; their prior is behind them.
    """
    axes = posterior.axes
    figure, grid = panel_grid(1, len(axes), sharex="all", sharey="all", width=4.6)
    step = int(-(-np.prod(posterior.draws.shape) // POINTS))
    parameter = next(p for p in posterior.parameters if p.name == "desired_trajectory_sd")
    sd = posterior.values()[parameter.name].reshape(-1, *parameter.shape)[::step, :, 0]
    matrices = posterior.matrices(Latent.STIFFNESS)
    matrices = matrices.reshape(np.prod(posterior.draws.shape), -1, len(axes), len(axes))[::step]
    generator = np.random.default_rng(0)
    prior = posterior.prior_impedance(PRIOR_DRAWS)[Latent.STIFFNESS]
    assert parameter.median is not None
    assert parameter.log_sd is not None
    before = parameter.median[0].item() * np.exp(
        parameter.log_sd[0].item() * generator.standard_normal(len(prior))
    )
    for a, one in zip(range(len(axes)), posterior.verdicts, strict=False):
        ax = grid[0][a]
        average = np.exp(np.log(matrices[..., a, a]).mean(axis=1))
        ax.plot(before, np.exp(np.log(prior[..., a, a]).mean(axis=1)), ".", ms=3, color=PRIOR, label="prior")
        ax.plot(sd[:, a], average, ".", ms=3, color=POSTERIOR, label="posterior")
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter("{x:g}")
        logarithmic(ax)
        known = "" if np.isnan(one.correlation) else f": correlation of logarithms {one.correlation:.2f}"
        ax.set_title(f"{axes[a]}{known}", fontsize=8)
        label_panel(ax, a, 0, 1, "stiffness, path average [N/m]", "SD of the desired trajectory [m]")
    return finished(figure, grid, "What stiffness goes with")


def _title(what: str, posterior: DrawnPosterior, group: int) -> str:
    named = f", group {posterior.groups[group]}" if len(posterior.groups) > 1 else ""
    return f"{what}{named}, drawn by {posterior.draws.method}"


def _band(ax: Axes, abscissa: Array, draws: Array, name: str, pieces: Sequence[slice]) -> None:
    """Median and 90 % band of draws `(chains, draws, places)`, broken off between `pieces`."""
    low, middle, high = np.quantile(draws, [0.05, 0.5, 0.95], axis=(0, 1))
    for i, piece in enumerate(pieces):
        label = None if i else f"{name}, 90 % band"
        ax.fill_between(abscissa[piece], low[piece], high[piece], color=POSTERIOR, alpha=0.3, lw=0)
        ax.plot(abscissa[piece], middle[piece], color=POSTERIOR, lw=1.2, label=label)


def _truth(ax: Axes, posterior: DrawnPosterior, group: int, name: str) -> None:
    for i, (trial, rows, place) in enumerate(posterior.courses(group)):
        if name in trial.truth:
            label = "truth" if i == 0 else None
            ax.plot(place, trial.truth[name][rows], "--", color=TRUTH, lw=0.8, label=label)
