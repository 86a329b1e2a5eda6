"""A recording as it was logged, and what the model sees of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from bayes_impedance.log import InteractionLog, Trial
from bayes_impedance.plotting.panels import AXIS_COLOURS, POSTERIOR, PRIOR, label_panel
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial

Array = NDArray[np.float64]

#: Points of a trial that are drawn.
MOST_POINTS = 20_000


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
        label_panel(panels[name], 0, 0 if name != "speed" else 2, 3, label, "time, trials in a row [s]")
    label_panel(panels["path"], 0, 0, 1, f"{log.axes[min(1, len(log.axes) - 1)]} [m]", f"{log.axes[0]} [m]")
    if phased:
        label_panel(panels["phase"], 0, 0, 1, "phase", "time in the repetition [s]")
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
