"""Figures: force against prediction, desired against actual trajectory, impedance prior and posterior, a plan.

Each function returns a matplotlib figure and shows nothing by itself. Every impedance curve carries its
verdict, so that no stiffness is looked at without it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator
from numpy.typing import NDArray

from bayes_impedance.identifiability import Support, Verdict, rounded
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.log import InteractionLog, Trial
from bayes_impedance.outputs import whole_file
from bayes_impedance.posterior import UNITS, Marginal, Posterior
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial
from bayes_impedance.simulation.planning import Plan

Array = NDArray[np.float64]
Share = Literal["all", "row", "col"]

POSTERIOR, PRIOR, MEASURED, TRUTH = "#0b6e99", "#9aa5ab", "#1a1a1a", "#c2410c"
#: Of x, y and z.
AXIS_COLOURS = ("#1a1a1a", "#c2410c", "#4d7c0f")
#: Points of a trial that are drawn.
MOST_POINTS = 20_000
#: Markers of a plan.
MARKERS = {Support.SUPPORTED: "o", Support.WEAK: "^", Support.PRIOR_ONLY: "x"}


def plot_force(
    posterior: Posterior, trials: Sequence[int] | None = None, title: str = "Interaction force"
) -> Figure:
    """Measured force and the posterior of a new measurement with its 90 % band, an axis a row, a trial a column."""
    marginal = posterior[Latent.FORCE]

    def draw(ax: Axes, trial: PreparedTrial, rows: slice, a: int) -> None:
        _band(ax, trial.time, marginal, rows, a, "new measurement")
        if trial.force is not None:
            ax.plot(trial.time, trial.force[:, a], ".", ms=2.5, color=MEASURED, label="measured")

    return _over_time(posterior, trials, draw, "force {axis} [N]", title)


def plot_desired_trajectory(posterior: Posterior, trials: Sequence[int] | None = None) -> Figure:
    """Hand and desired position with its 90 % band, an axis a row, a trial a column."""
    marginal = posterior[Latent.DESIRED_POSITION]

    def draw(ax: Axes, trial: PreparedTrial, rows: slice, a: int) -> None:
        _band(ax, trial.time, marginal, rows, a, "desired")
        ax.plot(trial.time, trial.position[:, a], color=MEASURED, lw=1.0, label="hand")
        truth = trial.truth.get(f"desired_position_{posterior.axes[a]}")
        if truth is not None:
            ax.plot(trial.time, truth, "--", color=TRUTH, lw=1.0, label="true desired")

    return _over_time(posterior, trials, draw, "position {axis} [m]", "Desired and actual trajectory")


def plot_impedance(posterior: Posterior, verdicts: Iterable[Verdict], trial: int = 0) -> Figure:
    """Stiffness, damping and mass along one trial: prior and posterior 90 % bands, with the verdict."""
    figure, grid = _grid(len(IMPEDANCE_ORDER), len(posterior.axes), sharex="all", sharey="row", width=4.6)
    said = {(verdict.latent, verdict.axis): verdict for verdict in verdicts}
    record, rows = posterior.log.trials[trial], posterior.trial_slice(trial)
    by_phase = record.phase is not None
    abscissa = record.phase if record.phase is not None else record.time
    order = np.argsort(abscissa)
    for row, latent in enumerate(IMPEDANCE_ORDER):
        marginal = posterior[latent]
        for a, axis in enumerate(posterior.axes):
            ax = grid[row][a]
            low, high = (marginal.prior_quantile(p)[rows, a][order] for p in (0.05, 0.95))
            ax.fill_between(abscissa[order], low, high, color=PRIOR, alpha=0.25, lw=0, label="prior, 90 %")
            _band(ax, abscissa[order], marginal, np.arange(rows.start, rows.stop)[order], a, "posterior")
            name = f"{latent.value}_{axis}{axis}"
            if name in record.truth:
                ax.plot(abscissa[order], record.truth[name][order], "--", color=TRUTH, lw=1.2, label="truth")
            if marginal.warped:
                ax.set_yscale("log")
            verdict = said[latent, axis]
            ax.set_title(
                f"{latent.value} {axis}{axis}: {verdict.support.value} (contraction {rounded(verdict.contraction)})",
                fontsize=8,
            )
            unit = f"{latent.value} [{UNITS[latent]}]"
            _label(ax, a, row, len(IMPEDANCE_ORDER), unit, "phase" if by_phase else "time [s]")
    return _finished(figure, grid, f"Impedance along trial {record.name}, axes {', '.join(posterior.axes)}")


def plot_plan(plan: Plan, width: float | None = None, latent: Latent = Latent.STIFFNESS) -> Figure:
    """Expected relative width of the 90 % interval over repetitions, a line a perturbation, an axis a column.

    Markers show verdicts; `width` is drawn as the one wanted.

    Raises:
        SimulationError: the plan has no such impedance.
    """
    figure, grid = _grid(1, len(plan.axes), sharex="all", sharey="row", width=4.6, height=3.4)
    shades = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.85, len(plan.perturbations)))
    for a, axis in enumerate(plan.axes):
        ax = grid[0][a]
        for perturbation, colour in zip(plan.perturbations, shades, strict=True):
            line = plan.along(latent, axis, perturbation)
            label = f"{perturbation:g} {plan.unit}"
            ax.plot([entry.repetitions for entry in line], [e.width for e in line], color=colour, label=label)
            for support, marker in MARKERS.items():
                found = [entry for entry in line if entry.support is support]
                ax.plot([e.repetitions for e in found], [e.width for e in found], marker, color=colour, ms=5)
        for support, marker in MARKERS.items():
            ax.plot([], [], marker, color=MEASURED, ms=5, label=support.value)
        if width is not None:
            ax.axhline(width, color=TRUTH, ls="--", lw=1.2, label="wanted")
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.set_xticks(plan.repetitions, [str(count) for count in plan.repetitions])
        ax.xaxis.set_minor_locator(NullLocator())
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_locator(NullLocator())
        ax.set_title(f"{latent.value} {axis}{axis}", fontsize=9)
        _label(ax, a, 0, 1, "width of the 90 % interval / median", "repetitions")
    return _finished(figure, grid, f"Expected intervals of {latent.value}, by perturbation")


def save_figures(
    posterior: Posterior, verdicts: Sequence[Verdict], folder: Path, trials: Sequence[int] | None = None
) -> list[Path]:
    """Write `force.png`, `desired_trajectory.png` and `impedance.png` into `folder`.

    Raises:
        OutputError: the folder cannot be written.
    """
    figures = {
        "force.png": plot_force(posterior, trials),
        "desired_trajectory.png": plot_desired_trajectory(posterior, trials),
        "impedance.png": plot_impedance(posterior, verdicts, _chosen(posterior, trials)[0]),
    }
    for name, figure in figures.items():
        save_figure(figure, folder / name)
    return [folder / name for name in figures]


def save_figure(figure: Figure, path: Path) -> None:
    """Write one figure as PNG.

    Raises:
        OutputError: the file cannot be written.
    """
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=130)


def _over_time(
    posterior: Posterior,
    trials: Sequence[int] | None,
    draw: Callable[[Axes, PreparedTrial, slice, int], None],
    ylabel: str,
    title: str,
) -> Figure:
    """Panels over time, an axis a row and a trial a column, each filled by `draw`."""
    chosen = _chosen(posterior, trials)
    figure, grid = _grid(len(posterior.axes), len(chosen), sharex="col", sharey="row")
    for column, index in enumerate(chosen):
        trial, rows = posterior.log.trials[index], posterior.trial_slice(index)
        for a, axis in enumerate(posterior.axes):
            draw(grid[a][column], trial, rows, a)
            _label(grid[a][column], column, a, len(posterior.axes), ylabel.format(axis=axis), "time [s]")
        grid[0][column].set_title(f"trial {trial.name}", fontsize=9)
    return _finished(figure, grid, title)


def plot_recording(log: InteractionLog, prepared: PreparedLog | None) -> Figure:
    """Position, force and speed over time as logged, what the model sees of them on top, and the path."""
    figure = Figure(figsize=(11.0, 7.5), layout="constrained")
    phased = prepared is not None and any(trial.phase is not None for trial in prepared.trials)
    # A letter a panel: of nested lists the types cannot be told.
    letters = {"a": "position", "b": "force", "c": "speed", "d": "path", "e": "phase"}
    mosaic = figure.subplot_mosaic("ad;bd;ce" if phased else "ad;bd;cd", width_ratios=[2, 1])
    panels = {letters[letter]: panel for letter, panel in mosaic.items()}
    start = 0.0
    for trial in log.trials:
        _draw_trial(panels, trial, log.axes, start)
        for seen in () if prepared is None else prepared.trials:
            if seen.source == trial.source and seen.name.split(".")[0] == trial.name:
                _draw_seen(panels, seen, start + seen.time - trial.time[0])
        start += float(np.ptp(trial.time)) * 1.02
    for name, label in (("position", "position [m]"), ("force", "force [N]"), ("speed", "speed [m/s]")):
        _label(panels[name], 0, 0 if name != "speed" else 2, 3, label, "time, trials in a row [s]")
    _label(panels["path"], 0, 0, 1, f"{log.axes[min(1, len(log.axes) - 1)]} [m]", f"{log.axes[0]} [m]")
    if phased:
        _label(panels["phase"], 0, 0, 1, "phase", "time in the repetition [s]")
    if len(log.axes) > 1:
        panels["path"].set_aspect("equal", adjustable="datalim")
    colours = (*AXIS_COLOURS[: len(log.axes)], POSTERIOR)
    named = zip((*log.axes, "what the model sees"), colours, strict=True)
    handles = [Line2D([], [], color=colour, label=label) for label, colour in named]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8, frameon=False)
    figure.suptitle(", ".join(dict.fromkeys(trial.source for trial in log.trials)), fontsize=11)
    return figure


def _draw_trial(panels: dict[str, Axes], trial: Trial, axes: Sequence[str], start: float) -> None:
    # More points than a page has dots make files slow and tell nothing.
    every = max(1, trial.n_samples // MOST_POINTS)
    time = start + trial.time[::every] - trial.time[0]
    position = trial.position[::every]
    speed = np.linalg.norm(np.gradient(position, trial.time[::every], axis=0), axis=1)
    for a in range(len(axes)):
        panels["position"].plot(time, position[:, a], color=AXIS_COLOURS[a], lw=1.0)
        if trial.force is not None:
            panels["force"].plot(time, trial.force[::every, a], color=AXIS_COLOURS[a], lw=0.6)
    panels["speed"].plot(time, speed, color=PRIOR, lw=0.6)
    panels["path"].plot(position[:, 0], position[:, min(1, len(axes) - 1)], color=PRIOR, lw=0.8)


def _draw_seen(panels: dict[str, Axes], trial: PreparedTrial, time: Array) -> None:
    panels["speed"].plot(time, np.linalg.norm(trial.velocity, axis=1), color=POSTERIOR, lw=1.0)
    panels["position"].axvspan(time[0], time[-1], color=POSTERIOR, alpha=0.08, lw=0)
    last = min(1, trial.position.shape[1] - 1)
    panels["path"].plot(trial.position[:, 0], trial.position[:, last], color=POSTERIOR, lw=1.0)
    if trial.phase is None:
        return
    for label in np.unique(trial.repetition):
        part = trial.repetition == label
        panels["phase"].plot(
            trial.time[part] - trial.time[part][0], trial.phase[part], color=POSTERIOR, lw=0.8
        )


def _chosen(posterior: Posterior, trials: Sequence[int] | None) -> list[int]:
    """Four trials at most: more no longer fit on a page."""
    return list(range(len(posterior.log.trials)) if trials is None else trials)[:4]


def _grid(
    rows: int, columns: int, sharex: Share, sharey: Share, width: float = 3.2, height: float = 2.4
) -> tuple[Figure, list[list[Axes]]]:
    figure = Figure(figsize=(max(6.0, width * columns), 0.7 + height * rows), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=sharex, sharey=sharey, squeeze=False)
    return figure, [list(row) for row in grid]


def _band(
    ax: Axes, abscissa: Array, marginal: Marginal, rows: slice | NDArray[np.int64], axis: int, name: str
) -> None:
    middle = marginal.quantile(0.5)[rows, axis]
    low, high = marginal.quantile(0.05)[rows, axis], marginal.quantile(0.95)[rows, axis]
    ax.fill_between(abscissa, low, high, color=POSTERIOR, alpha=0.3, lw=0)
    ax.plot(abscissa, middle, color=POSTERIOR, lw=1.2, label=f"{name}, 90 % band")


def _label(ax: Axes, column: int, row: int, rows: int, ylabel: str, xlabel: str) -> None:
    ax.tick_params(labelsize=8)
    ax.grid(alpha=0.2)
    if column == 0:
        ax.set_ylabel(ylabel, fontsize=8)
    if row == rows - 1:
        ax.set_xlabel(xlabel, fontsize=8)


def _finished(figure: Figure, grid: list[list[Axes]], title: str) -> Figure:
    figure.suptitle(title, fontsize=11)
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(handles), fontsize=8, frameon=False)
    return figure
