"""Figures over time: force against prediction, desired against actual trajectory."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.plotting.panels import (
    MEASURED,
    TRUTH,
    chosen_trials,
    draw_band,
    finished,
    label_panel,
    panel_grid,
)
from bayes_impedance.posterior import Posterior
from bayes_impedance.preprocessing import PreparedTrial


def plot_force(
    posterior: Posterior, trials: Sequence[int] | None = None, title: str = "Interaction force"
) -> Figure:
    """Measured force and the posterior of a new measurement with its 90 % band, an axis a row, a trial a column."""
    marginal = posterior[Latent.FORCE]

    def draw(ax: Axes, trial: PreparedTrial, rows: slice, a: int) -> None:
        draw_band(ax, trial.time, marginal, rows, a, "new measurement")
        if trial.force is not None:
            ax.plot(trial.time, trial.force[:, a], ".", ms=2.5, color=MEASURED, label="measured")

    return _over_time(posterior, trials, draw, "force {axis} [N]", title)


def plot_desired_trajectory(posterior: Posterior, trials: Sequence[int] | None = None) -> Figure:
    """Hand and desired position with its 90 % band, an axis a row, a trial a column."""
    marginal = posterior[Latent.DESIRED_POSITION]

    def draw(ax: Axes, trial: PreparedTrial, rows: slice, a: int) -> None:
        draw_band(ax, trial.time, marginal, rows, a, "desired")
        ax.plot(trial.time, trial.position[:, a], color=MEASURED, lw=1.0, label="hand")
        truth = trial.truth.get(f"desired_position_{posterior.axes[a]}")
        if truth is not None:
            ax.plot(trial.time, truth, "--", color=TRUTH, lw=1.0, label="true desired")

    return _over_time(posterior, trials, draw, "position {axis} [m]", "Desired and actual trajectory")


def _over_time(
    posterior: Posterior,
    trials: Sequence[int] | None,
    draw: Callable[[Axes, PreparedTrial, slice, int], None],
    ylabel: str,
    title: str,
) -> Figure:
    """Panels over time, an axis a row and a trial a column, each filled by `draw`."""
    chosen = chosen_trials(posterior, trials)
    figure, grid = panel_grid(len(posterior.axes), len(chosen), sharex="col", sharey="row")
    for column, index in enumerate(chosen):
        trial, rows = posterior.log.trials[index], posterior.trial_slice(index)
        for a, axis in enumerate(posterior.axes):
            draw(grid[a][column], trial, rows, a)
            label_panel(grid[a][column], column, a, len(posterior.axes), ylabel.format(axis=axis), "time [s]")
        grid[0][column].set_title(f"trial {trial.name}", fontsize=9)
    return finished(figure, grid, title)
