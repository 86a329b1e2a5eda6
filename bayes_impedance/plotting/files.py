"""The figures of one posterior, as files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bayes_impedance.identifiability import Verdict
from bayes_impedance.plotting.ellipses import plot_ellipses
from bayes_impedance.plotting.impedance import plot_impedance
from bayes_impedance.plotting.over_time import plot_desired_trajectory, plot_force
from bayes_impedance.plotting.panels import chosen_trials, save_figure
from bayes_impedance.posterior import Posterior


def save_figures(
    posterior: Posterior, verdicts: Sequence[Verdict], folder: Path, trials: Sequence[int] | None = None
) -> list[Path]:
    """Write `force.png`, `desired_trajectory.png` and `impedance.png` into `folder`; of two or three axes
    `ellipses.png` too.

    Raises:
        OutputError: the folder cannot be written.
    """
    first = chosen_trials(posterior, trials)[0]
    figures = {
        "force.png": plot_force(posterior, trials),
        "desired_trajectory.png": plot_desired_trajectory(posterior, trials),
        "impedance.png": plot_impedance(posterior, verdicts, first),
    }
    if len(posterior.axes) > 1:
        figures["ellipses.png"] = plot_ellipses(posterior, verdicts, first)
    for name, figure in figures.items():
        save_figure(figure, folder / name)
    return [folder / name for name in figures]
