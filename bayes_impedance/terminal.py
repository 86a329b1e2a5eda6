"""What the commands print: tables and progress, for people, on a terminal."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from bayes_impedance.config import TrainingConfig
from bayes_impedance.evaluation.held_out import Evaluation
from bayes_impedance.identifiability import OffDiagonal, Support, Verdict, caveat, off_diagonals, rounded
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.posterior import Posterior
from bayes_impedance.posterior.batches import Progress as InferenceHook
from bayes_impedance.priors import Entry
from bayes_impedance.sampling.drawn import DrawnPosterior
from bayes_impedance.sampling.sample import Hook as SamplingHook
from bayes_impedance.sensitivity import Effect, Refit, Sensitivity, in_sds
from bayes_impedance.sensitivity import Progress as SensitivityHook
from bayes_impedance.simulation.planning import Plan
from bayes_impedance.simulation.planning import Progress as PlanningHook
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


@contextmanager
def sensitivity_progress(console: Console) -> Iterator[SensitivityHook]:
    """A bar over changes of priors; hidden where the output is no terminal."""
    with _step_progress(console, "prior sensitivity") as hook:
        yield hook


@contextmanager
def planning_progress(console: Console) -> Iterator[PlanningHook]:
    """A bar over simulated sessions; hidden where the output is no terminal."""
    with _step_progress(console, "planning") as hook:
        yield hook


@contextmanager
def sampling_progress(console: Console) -> Iterator[SamplingHook]:
    """A bar for the climb to the mode, each chain and the latents; hidden where the output is no terminal."""
    columns = (
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"), TimeElapsedColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
        tasks: dict[str, TaskID] = {}

        def hook(what: str, done: int, total: int, state: str) -> None:
            if what not in tasks:
                # What came before has ended, but for other chains.
                for name, task in tasks.items():
                    bar.update(task, visible=name.startswith("chain") and what.startswith("chain"))
                tasks[what] = bar.add_task(what, total=None, state="")
            bar.update(tasks[what], completed=done, total=total or None, state=state)

        yield hook


@contextmanager
def inference_progress(console: Console) -> Iterator[InferenceHook]:
    """A bar over samples; hidden where the output is no terminal."""
    columns = (
        TextColumn("inferring"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("samples"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@contextmanager
def _step_progress(console: Console, what: str) -> Iterator[Callable[[int, int, str], None]]:
    columns = (TextColumn(what), BarColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task("", total=None)

        def hook(done: int, planned: int, step: str) -> None:
            bar.update(task, completed=done, total=planned, description=f"{done + 1}/{planned} {step}")

        yield hook


@contextmanager
def simulation_progress(console: Console, trials: int) -> Iterator[Callable[[int], None]]:
    """A bar over trials; hidden where the output is no terminal."""
    columns = (TextColumn("simulating"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task("", total=trials)
        yield lambda done: bar.update(task, completed=done)


def verdict_table(verdicts: Sequence[Verdict], beside: Sequence[OffDiagonal] = ()) -> Table:
    """Path averages of stiffness, damping and mass, each beside its verdict; then what couples axes, without one."""
    table = Table(title="Impedance, averaged over the samples", title_justify="left")
    table.add_column("")
    for name in ("mean", "90 % interval", "prior 90 %", "contraction"):
        table.add_column(name, justify="right")
    table.add_column("verdict")
    for v in verdicts:
        colour = COLOURS[v.support]
        table.add_row(*_estimate_cells(v, 2 * v.axis), f"[{colour}]{_short(v.support)}[/{colour}]")
    table.add_section()
    for c in beside:
        table.add_row(*_estimate_cells(c, c.pair), "")
    return table


def _estimate_cells(e: Verdict | OffDiagonal, entry: str) -> list[str]:
    """Name, mean, interval, prior interval and contraction of an entry of K, D or M."""
    return [
        f"{e.latent.value} {entry} [{e.unit}]".replace("[", "\\["), f"{e.mean:.4g}",
        f"{e.q05:.4g} … {e.q95:.4g}", f"{e.prior_q05:.3g} … {e.prior_q95:.3g}", rounded(e.contraction),
    ]  # fmt: skip


def planning_table(plan: Plan, latent: Latent = Latent.STIFFNESS) -> Table:
    """Expected relative widths of one impedance, a row a design and a column an axis, coloured by verdict."""
    title = f"Width of the 90 % interval of {latent.value}, over its median"
    table = Table(title=title, title_justify="left")
    for name in ("perturbation", "repetitions", *(f"{latent.value} {axis}{axis}" for axis in plan.axes)):
        table.add_column(name, justify="right")
    for perturbation in plan.perturbations:
        lines = [plan.along(latent, axis, perturbation) for axis in plan.axes]
        for design in zip(*lines, strict=True):
            cells = [
                f"{entry.width:.2f} [{COLOURS[entry.support]}]{_short(entry.support)}[/{COLOURS[entry.support]}]"
                for entry in design
            ]
            table.add_row(f"{perturbation:g} {plan.unit}", str(design[0].repetitions), *cells)
        table.add_section()
    return table


def _short(support: Support) -> str:
    return support.name.lower().replace("_", " ")


def print_verdicts(console: Console, model: ImpedanceModel, posterior: Posterior) -> list[Verdict]:
    """The table, then the sentences, then what they all presuppose."""
    verdicts = model.verdicts(posterior)
    console.print(verdict_table(verdicts, off_diagonals(posterior)))
    _print_sentences(console, verdicts, caveat(verdicts, posterior.log, model.config))
    return verdicts


def print_exact_verdicts(console: Console, posterior: DrawnPosterior) -> None:
    """The same of a posterior that was drawn, with what each stiffness goes with."""
    verdicts = [one.verdict for one in posterior.verdicts]
    console.print(verdict_table(verdicts, posterior.off_diagonals))
    _print_sentences(console, verdicts, caveat(verdicts, posterior.log, posterior.config))
    for one in posterior.verdicts:
        known = [
            f"{name} {value:.2f}"
            for name, value in (
                ("correlation with the SD of the desired trajectory", one.correlation),
                ("sensitivity to its prior", one.sensitivity),
            )
            if not np.isnan(value)
        ]
        if one.verdict.latent is Latent.STIFFNESS and known:
            console.print(f"  stiffness {2 * one.verdict.axis}: {', '.join(known)}", highlight=False)


def print_diagnosis(console: Console, posterior: DrawnPosterior) -> None:
    """What draws are worth, and what to do where they are not."""
    diagnosis = posterior.diagnosis
    console.print(diagnosis.summary, highlight=False, markup=False)
    for finding in diagnosis.findings:
        # What chains died of may stand in brackets.
        console.print(f"  {finding}", style="yellow", highlight=False, markup=False)


def _print_sentences(console: Console, verdicts: Sequence[Verdict], remark: str | None) -> None:
    # Parameters of which the same is to be said share a line.
    said: dict[str, list[str]] = {}
    for verdict in verdicts:
        name, _, rest = verdict.sentence.partition(": ")
        said.setdefault(rest, []).append(name)
    for rest, names in said.items():
        console.print(f"  {', '.join(names)}: {rest}", highlight=False)
    if remark:
        console.print(f"  {remark}", style="yellow", highlight=False)


def hyperparameter_table(model: ImpedanceModel) -> Table:
    """Hyperparameters in SI units: hyperprior against posterior, 90 % intervals."""
    axes = model.fitted.log.axes
    table = Table(title="Hyperparameters: prior against posterior (Laplace)", title_justify="left")
    for name in ("", "axis", "prior median", "prior 90 %", "posterior", "posterior 90 %", "unit"):
        table.add_column(name, justify="left" if name in ("", "axis", "unit") else "right")
    for entry in model.hyperparameters:
        for c, label in enumerate(entry.labels):
            for a, axis in enumerate(entry.members or axes):
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
        best = [part for part, index in zip(model.parts, report.best, strict=True) if index == r.restart]
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
    table.add_column("axis")
    # Names of baselines share their beginnings: a narrow terminal breaks them, and does not cut them off.
    table.add_column("model", overflow="fold")
    for name in headings:
        table.add_column(name, justify="right")
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


def sensitivity_table(sensitivity: Sensitivity) -> Table:
    """Changes of one prior that move a conclusion, or that could not be fitted; the largest shift first."""
    table = Table(
        title="Prior sensitivity: changes of one prior that move a conclusion", title_justify="left"
    )
    table.add_column("prior and its change", no_wrap=True)
    table.add_column("conclusion")
    table.add_column("median before → after")
    table.add_column("shift", justify="right", no_wrap=True)
    shown = [refit for refit in sensitivity.refits if refit.failure or any(e.moved for e in refit.effects)]
    for refit in sorted(shown, key=_alarm, reverse=True):
        unfinished = "" if refit.converged or refit.failure else "\n  (not converged)"
        # Long keys take two lines, so that 80 columns hold the table.
        key = re.sub(r"\.(length_scale\.)", r".\n  \1", refit.change.key)
        change = f"{key}\n  {refit.change.description}{unfinished}"
        cells = [_effect_cells(effect) for effect in refit.effects if effect.moved]
        for row in cells or [("", f"no refit: {escape(refit.failure or '')}", "")]:
            table.add_row(change, *row)
            change = ""
        table.add_section()
    return table


def _alarm(refit: Refit) -> tuple[float, float]:
    """Largest shift of a conclusion that claims to be more than its prior, then of any."""
    moved = [effect for effect in refit.effects if effect.moved]
    carried = [effect.shift for effect in moved if effect.support is not Support.PRIOR_ONLY]
    return max(carried, default=0.0), max((effect.shift for effect in moved), default=0.0)


def _effect_cells(effect: Effect) -> tuple[str, str, str]:
    values = f"{effect.before:.4g} → {effect.after:.4g} {effect.unit}"
    if effect.support is None or effect.support_after is None:
        values = f"by {effect.difference:.2g} {effect.unit} rms"
    elif effect.reversed:
        values += f" ({_short(effect.support)} → {_short(effect.support_after)})"
    elif effect.support is Support.PRIOR_ONLY:
        values += f" ({_short(effect.support)})"
    # What only its prior knows moves with it: no news.
    style = "dim" if effect.support is Support.PRIOR_ONLY else "yellow"
    return effect.name, values, f"[{style}]{in_sds(effect.shift)}[/{style}]"


def print_sensitivity(console: Console, sensitivity: Sensitivity) -> None:
    """The table where something moves, then a sentence for each conclusion, then what limits them."""
    table = sensitivity_table(sensitivity)
    if table.row_count:
        console.print(table)
    for sentence in sensitivity.sentences:
        console.print(f"  {sentence}", highlight=False)
    for remark in sensitivity.remarks:
        console.print(f"  {remark}", style="yellow", highlight=False)
