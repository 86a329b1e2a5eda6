"""What a plan expects of each design of an experiment."""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from bayes_impedance.identifiability import Support
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.plotting.panels import MEASURED, TRUTH, finished, label_panel, logarithmic, panel_grid
from bayes_impedance.simulation.planning import Plan

#: Markers of a plan.
MARKERS = {Support.SUPPORTED: "o", Support.WEAK: "^", Support.PRIOR_ONLY: "x"}


def plot_plan(plan: Plan, width: float | None = None, latent: Latent = Latent.STIFFNESS) -> Figure:
    """Expected relative width of the 90 % interval over repetitions, a line a perturbation, an axis a column.

    Markers show verdicts; `width` is drawn as the one wanted.

    Raises:
        SimulationError: the plan has no such impedance.
    """
    figure, grid = panel_grid(1, len(plan.axes), sharex="all", sharey="row", width=4.6, height=3.4)
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
        ax.set_xticks(plan.repetitions, [str(count) for count in plan.repetitions])
        ax.xaxis.set_minor_locator(NullLocator())
        logarithmic(ax)
        ax.set_title(f"{latent.value} {axis}{axis}", fontsize=9)
        label_panel(ax, a, 0, 1, "width of the 90 % interval / median", "repetitions")
    return finished(figure, grid, f"Expected intervals of {latent.value}, by perturbation")
