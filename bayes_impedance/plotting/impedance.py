"""Stiffness, damping and mass along a trial, each with its verdict."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayes_impedance.identifiability import Verdict, rounded
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER
from bayes_impedance.plotting.panels import (
    MEASURED,
    PRIOR,
    TRUTH,
    draw_band,
    finished,
    label_panel,
    logarithmic,
    panel_grid,
)
from bayes_impedance.posterior import Marginal, Posterior
from bayes_impedance.posterior.results import UNITS


def plot_impedance(posterior: Posterior, verdicts: Iterable[Verdict], trial: int = 0) -> Figure:
    """Stiffness, damping and mass along one trial: prior and posterior 90 % bands, with the verdict.

    An entry a column: the diagonal, then, where axes are coupled, what stands beside it, on a linear scale.
    """
    axes, pairs = posterior.axes, posterior.pairs
    columns = len(axes) + len(pairs)
    width = 4.6 if columns < 3 else 4.0
    figure, grid = panel_grid(len(IMPEDANCE_ORDER), columns, sharex="all", sharey="none", width=width)
    said = {(verdict.latent, verdict.axis): verdict for verdict in verdicts}
    record, rows = posterior.log.trials[trial], posterior.trial_slice(trial)
    abscissa = record.time if record.phase is None else record.phase
    order = np.argsort(abscissa)
    samples = np.arange(rows.start, rows.stop)[order]

    def draw(ax: Axes, marginal: Marginal, entry: int, name: str) -> None:
        low, high = (marginal.prior_quantile(p)[samples, entry] for p in (0.05, 0.95))
        ax.fill_between(abscissa[order], low, high, color=PRIOR, alpha=0.25, lw=0, label="prior, 90 %")
        draw_band(ax, abscissa[order], marginal, samples, entry, "posterior")
        if name in record.truth:
            ax.plot(abscissa[order], record.truth[name][order], "--", color=TRUTH, lw=1.2, label="truth")

    for row, latent in enumerate(IMPEDANCE_ORDER):
        for a, axis in enumerate(axes):
            ax = grid[row][a]
            draw(ax, posterior[latent], a, f"{latent.value}_{axis}{axis}")
            if posterior[latent].warped:
                logarithmic(ax)
            if a:
                ax.sharey(grid[row][0])
                ax.tick_params(labelleft=False)
            verdict = said[latent, axis]
            ax.set_title(
                f"{latent.value} {axis}{axis}: {verdict.support.value} (contraction {rounded(verdict.contraction)})",
                fontsize=8,
            )
        for k, pair in enumerate(pairs):
            ax, marginal = grid[row][len(axes) + k], posterior.couplings[latent]
            draw(ax, marginal, k, f"{latent.value}_{pair}")
            ax.axhline(0.0, color=MEASURED, lw=0.6, zorder=0)
            contraction = rounded(float(marginal.contraction[k]))
            ax.set_title(f"{latent.value} {pair} (contraction {contraction})", fontsize=8)
        for column, ax in enumerate(grid[row]):
            unit = f"{latent.value} [{UNITS[latent]}]"
            name = "time [s]" if record.phase is None else "phase"
            label_panel(ax, column, row, len(IMPEDANCE_ORDER), unit, name)
    return finished(figure, grid, f"Impedance along trial {record.name}, axes {', '.join(axes)}")
