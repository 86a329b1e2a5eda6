"""What the commands print: tables and progress, for people, on a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from bayes_impedance.config import TrainingConfig
from bayes_impedance.evaluation import Evaluation
from bayes_impedance.identifiability import Support, Verdict, caveat, rounded
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.posterior import Posterior
from bayes_impedance.priors import Entry
from bayes_impedance.training import Progress as ProgressHook

COLOURS = {Support.SUPPORTED: "green", Support.WEAK: "yellow", Support.PRIOR_ONLY: "red"}


@contextmanager
def training_progress(console: Console, config: TrainingConfig, what: str) -> Iterator[ProgressHook]:
    """A bar over restarts and iterations; hidden where the output is no terminal."""
    total = config.restarts * config.max_iterations
    columns = (
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"), TimeElapsedColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task(what, total=total, state="")

        def hook(restart: int, iteration: int, objective: float) -> None:
            state = f"restart {restart + 1}/{config.restarts}, iteration {iteration}, log posterior {objective:.2f}"
            bar.update(task, completed=restart * config.max_iterations + iteration, state=state)

        yield hook


def verdict_table(verdicts: Sequence[Verdict]) -> Table:
    """Path averages of stiffness, damping and mass, each beside its verdict."""
    table = Table(title="Impedance, averaged over the samples", title_justify="left")
    table.add_column("")
    for name in ("mean", "90 % interval", "prior 90 %", "contraction"):
        table.add_column(name, justify="right")
    table.add_column("verdict")
    for v in verdicts:
        colour = COLOURS[v.support]
        table.add_row(
            f"{v.latent.value} {v.axis}{v.axis} [{v.unit}]".replace("[", "\\["), f"{v.mean:.4g}",
            f"{v.q05:.4g} … {v.q95:.4g}", f"{v.prior_q05:.3g} … {v.prior_q95:.3g}", rounded(v.contraction),
            f"[{colour}]{v.support.name.lower().replace('_', ' ')}[/{colour}]",
        )  # fmt: skip
    return table


def print_verdicts(console: Console, model: ImpedanceModel, posterior: Posterior) -> list[Verdict]:
    """The table, then the sentences, then what they all presuppose."""
    verdicts = model.verdicts(posterior)
    console.print(verdict_table(verdicts))
    # Parameters of which the same is to be said share a line.
    said: dict[str, list[str]] = {}
    for verdict in verdicts:
        name, _, rest = verdict.sentence.partition(": ")
        said.setdefault(rest, []).append(name)
    for rest, names in said.items():
        console.print(f"  {', '.join(names)}: {rest}", highlight=False)
    remark = caveat(verdicts, posterior, model.config)
    if remark:
        console.print(f"  {remark}", style="yellow", highlight=False)
    return verdicts


def hyperparameter_table(model: ImpedanceModel) -> Table:
    """Hyperparameters in SI units: hyperprior against posterior, 90 % intervals."""
    axes = model.fitted.log.axes
    table = Table(title="Hyperparameters: prior against posterior (Laplace)", title_justify="left")
    for name in ("", "axis", "prior median", "prior 90 %", "posterior", "posterior 90 %", "unit"):
        table.add_column(name, justify="left" if name in ("", "axis", "unit") else "right")
    for entry in model.hyperparameters:
        for c, label in enumerate(entry.labels):
            for a, axis in enumerate(axes):
                table.add_row(*_hyperparameter_row(entry, c, label, a, axis, model))
        table.add_section()
    return table


def _hyperparameter_row(
    entry: Entry, c: int, label: str, a: int, axis: str, model: ImpedanceModel
) -> list[str]:
    spec = entry.specs[c]
    name = f"{entry.name} {label}".strip()
    value = float(entry.value[a, 0, 0, c].detach())
    if spec.fixed:
        return [name, axis, f"{spec.median:.4g}", "fixed", f"{value:.4g}", "fixed", entry.units[c]]
    spread = model.report.log_sd.get(entry.name)
    log_sd = float("nan") if spread is None else spread[a][c]
    interval = "not determined" if np.isnan(log_sd) else _interval(value, log_sd)
    prior = _interval(spec.median, spec.log_sd)
    return [name, axis, f"{spec.median:.4g}", prior, f"{value:.4g}", interval, entry.units[c]]


def _interval(median: float, log_sd: float) -> str:
    low, high = median * np.exp(np.array([-1.645, 1.645]) * log_sd)
    return f"{low:.3g} … {high:.3g}"


def restart_table(model: ImpedanceModel) -> Table:
    """How every restart ended."""
    report = model.report
    table = Table(title="Restarts of the optimiser", title_justify="left")
    for name in (
        "restart",
        "log posterior",
        "log likelihood",
        "iterations",
        "evaluations",
        "seconds",
        "outcome",
    ):
        table.add_column(name, justify="left" if name == "outcome" else "right")
    for r in report.restarts:
        best = [
            axis for axis, index in zip(model.fitted.log.axes, report.best, strict=True) if index == r.restart
        ]
        outcome = r.outcome.lower() + (f"; best for {', '.join(best)}" if best else "")
        table.add_row(
            str(r.restart), _values(r.objective), _values(r.log_likelihood), str(r.iterations),
            str(r.evaluations), f"{r.seconds:.1f}", outcome,
        )  # fmt: skip
    return table


def _values(values: Sequence[float]) -> str:
    return " ".join(f"{value:.2f}" for value in values)


def evaluation_table(
    evaluation: Evaluation, title: str = "Predicted force, given the training forces only"
) -> Table:
    """Scores by axis and model, the best of each axis in bold, and the share of force that impedance explains."""
    table = Table(title=title, title_justify="left")
    headings = ("SMSE", "MSLL", "NLPD", "coverage of 90 % band", "samples", "share of impedance")
    for name in ("axis", "model", *headings):
        table.add_column(name, justify="left" if name in ("axis", "model") else "right")
    for axis, models in evaluation.scores.items():
        best = {score: min(getattr(s, score) for s in models.values()) for score in ("smse", "msll", "nlpd")}
        for name, s in models.items():
            losses = [
                _emphasised(f"{value:.{digits}f}", len(models) > 1 and value == best[score])
                for score, value, digits in (("smse", s.smse, 4), ("msll", s.msll, 3), ("nlpd", s.nlpd, 3))
            ]
            share = evaluation.impedance_share[axis].get(name)
            table.add_row(
                axis,
                escape(name),
                *losses,
                f"{s.coverage90:.3f}",
                str(s.n),
                "" if share is None else f"{share:.3f}",
            )
        table.add_section()
    return table


def _emphasised(text: str, emphasis: bool) -> str:
    return f"[bold]{text}[/bold]" if emphasis else text
