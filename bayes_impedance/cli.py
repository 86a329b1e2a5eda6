"""The command line: demo, simulate, inspect, plan, train, infer, sample, evaluate, show."""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Sequence
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
import typer.core
from rich.console import Console
from rich.markup import escape

from bayes_impedance import terminal
from bayes_impedance.commands.calibrate import calibrate_command
from bayes_impedance.commands.inspect import inspect_command
from bayes_impedance.commands.plan import plan_command
from bayes_impedance.commands.sample import Given, sample_command
from bayes_impedance.commands.simulate import simulate_command
from bayes_impedance.config import load_config, shipped_configurations
from bayes_impedance.demo import coupling_errors, record, truth_errors
from bayes_impedance.errors import (
    BayesImpedanceError,
    BayesImpedanceWarning,
    ConfigurationError,
    LogError,
    OutputError,
)
from bayes_impedance.evaluation.contenders import Baseline
from bayes_impedance.evaluation.cross_validation import as_json as folds_as_json
from bayes_impedance.evaluation.cross_validation import cross_validate
from bayes_impedance.evaluation.held_out import as_json, evaluate
from bayes_impedance.identifiability import off_diagonals, summarise
from bayes_impedance.journal import open_journal
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.outputs import check_replaceable, check_writable, prepare_folder, write_json
from bayes_impedance.persistence import METADATA, load_model, save_model
from bayes_impedance.plotting import plot_force, save_figure, save_figures
from bayes_impedance.posterior.results import UNITS
from bayes_impedance.readers import read_log
from bayes_impedance.sensitivity import Sensitivity, prior_sensitivity
from bayes_impedance.writer import check_table_name, write_table

BAD_INPUT, INTERRUPTED = 2, 130
#: Beside "nothing to resume".
KEEPS_NOTHING = (
    ", for engine.impedance: map finds functions anew and keeps nothing of a training that was stopped"
)


class _Commands(typer.core.TyperGroup):
    """Ctrl-C ends in a sentence, which typer leaves out."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            _errors().print("interrupted; no file was left half written", highlight=False)
            raise typer.Exit(INTERRUPTED) from None


app = typer.Typer(
    name="bayes-impedance",
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help=(
        "Infer what a person's arm is (mass, damping, stiffness) and where the person wants to go (the desired "
        "trajectory) from logged motion and interaction force, with uncertainty.\n\n"
        "A first round: [bold]bayes-impedance demo[/bold]. On your own log: [bold]inspect LOG[/bold], [bold]train LOG "
        "--config phase --out MODEL[/bold], then [bold]infer MODEL LOG --out POSTERIOR.csv --figures FIGURES[/bold], "
        "[bold]evaluate MODEL OTHER_LOG --baseline naive[/bold], [bold]show MODEL[/bold]."
    ),
)

Model = Annotated[Path, typer.Argument(metavar="MODEL", help="Folder that train wrote.", show_default=False)]
Logs = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG",
        help="Recordings: tables, arrays or bags (README); several may follow.",
        show_default=False,
    ),
]


class Competitor(str, Enum):
    """Baselines of evaluate."""

    naive = "naive"
    without_residual = "without-residual"
    ensemble = "ensemble"
    ensemble_diagonal = "ensemble-diagonal"
    rls = "rls"
    ekf = "ekf"


class Split(str, Enum):
    """Folds of evaluate."""

    trials = "trials"
    last_third = "last-third"


HELD_OUT = {Split.trials: "each trial, left out in turn", Split.last_third: "the last third of each trial"}


def main() -> None:
    """Entry point: bad input ends in one sentence and exit code 2, never in a traceback."""
    warnings.showwarning = _show_warning
    try:
        app()
    except BayesImpedanceError as error:
        _refuse(str(error))
    except OSError as error:
        _refuse(f"{error.filename or 'a file'}: could not be used: {error.strerror or error}")


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        from importlib.metadata import version as installed

        typer.echo(installed("bayes-impedance"))
        raise typer.Exit


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for logs, model, posterior and figures.")] = Path("demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated experiment.")] = 0,
) -> None:
    """Do the main job on a simulated experiment whose truth is known: train, infer, evaluate, draw.

    A simulated arm, in a posture that couples its axes, traces a figure of eight five times on a device that perturbs
    it; four repetitions train, the fifth tests. The configuration is `arm`: stiffness, damping and mass are matrices
    that vary along the path.
    """
    console = Console()
    check_replaceable(out / "model", METADATA)
    prepare_folder(out)
    recording = record(out, seed)
    console.print(
        f"wrote {recording.training} (4 repetitions) and {recording.testing} (a fifth), truth included"
    )
    model = ImpedanceModel(recording.config)
    with terminal.training_progress(console, recording.config.training, "training") as progress:
        model = model.fit(read_log(recording.training, recording.config.log), progress)
    console.print(str(model.engine), highlight=False, soft_wrap=True)
    save_model(model, out / "model")
    if model.report.interrupted:
        raise KeyboardInterrupt
    posterior = model.posterior(model.fitted.log)
    verdicts = terminal.print_verdicts(console, model, posterior)
    listed = ", ".join(f"{name} {error:.1%}" for name, error in truth_errors(posterior).items())
    console.print(f"Mean relative error against the truth: {listed}", highlight=False)
    listed = ", ".join(
        f"{name} {error:.2g} {UNITS[Latent(name.split('_')[0])]}"
        for name, error in coupling_errors(posterior).items()
    )
    console.print(f"Mean absolute error of what couples the axes: {listed}", highlight=False)
    unseen = model.prepare(read_log(recording.testing, recording.config.log))
    watch = partial(terminal.training_progress, console)
    scores = evaluate(model, unseen, ["naive"], progress=watch)
    console.print(terminal.evaluation_table(scores))
    write_table(posterior.table(), out / "posterior.csv")
    figures = [*save_figures(posterior, verdicts, out), out / "predicted_force.png"]
    predicted = model.posterior(unseen, given="training", latents=[Latent.FORCE])
    save_figure(plot_force(predicted, title="Force of an unseen repetition, predicted"), figures[-1])
    for path in (out / "model", out / "posterior.csv", *figures):
        console.print(f"wrote {path}")


app.command(name="simulate")(simulate_command)
app.command(name="inspect")(inspect_command)
app.command(name="plan")(plan_command)
app.command(name="sample")(sample_command)
app.command(name="calibrate")(calibrate_command)


@app.command()
def train(
    logs: Logs,
    config: Annotated[
        str,
        typer.Option(help=f"YAML file, or a shipped configuration: {', '.join(shipped_configurations())}."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the model; one that train wrote before is replaced.")],
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Change one key, e.g. training.restarts=5; repeatable."
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue a training that was killed or stopped.")
    ] = False,
) -> None:
    """Train hyperparameters on recordings (MAP of the marginal likelihood) and write the model.

    Ctrl-C stops early and keeps the best found so far. What was computed is kept beside the model until training has
    ended: after Ctrl-C, a crash or a power cut the same command with --resume continues, and ends with the same model.
    Where impedance is a function (engine.impedance: map) nothing is kept: Ctrl-C keeps the best restart that has ended.
    """
    console = Console()
    settings = load_config(config, overrides or [])
    anew = settings.engine.impedance == "map"
    check_writable(out)
    check_replaceable(out, METADATA)
    with open_journal(_journal_of(out)) as journal:
        if journal and not resume and not anew:
            raise OutputError(
                f"{journal.path}: expected no unfinished training of {out.name}, found one with {len(journal)} "
                "evaluations; add --resume to continue it, or delete the file to start anew"
            )
        if journal and anew:
            raise OutputError(
                f"{journal.path}: expected no unfinished training of {out.name}, which engine.impedance: map could not "
                f"continue, found one with {len(journal)} evaluations; delete the file, or train with another --out"
            )
        log = read_log(logs, settings.log)
        model = ImpedanceModel(settings)
        prepared = model.prepare(log)
        console.print(
            f"training on {prepared.n_samples} samples of {len(prepared.trials)} trials, axes "
            f"{', '.join(prepared.axes)}"
        )
        if resume:
            console.print(
                f"continuing after {len(journal)} evaluations"
                if journal
                else f"nothing to resume{KEEPS_NOTHING if anew else ''}: training from the start"
            )
        with terminal.training_progress(console, settings.training, "training") as progress:
            model = model.fit(prepared, progress, journal=None if anew else journal)
        console.print(str(model.engine), highlight=False, soft_wrap=True)
        save_model(model, out)
        if not model.report.interrupted:
            journal.remove()
    console.print(terminal.restart_table(model))
    terminal.print_verdicts(console, model, model.posterior(model.fitted.log))
    console.print(
        f"wrote {out}; look at it with: bayes-impedance show {out}", highlight=False, soft_wrap=True
    )
    if model.report.interrupted:
        console.print(
            "training was interrupted: the model holds the best hyperparameters found until then; "
            + (
                "to train in full, repeat the same command"
                if anew
                else "to continue, add --resume to the same command"
            ),
            soft_wrap=True,
        )
        raise typer.Exit(INTERRUPTED)


@app.command()
def infer(
    model: Model,
    logs: Logs,
    out: Annotated[Path, typer.Option(help="Table to write: .csv or .parquet.")],
    given: Annotated[
        Given, typer.Option(help="Forces to condition on: those trained on, those of LOG, or both.")
    ] = Given.both,
    figures: Annotated[Path | None, typer.Option(help="Folder for PNG figures.")] = None,
) -> None:
    """Infer force, desired trajectory, stiffness, damping and mass at every sample of LOG.

    Columns are <quantity>_<axis>_{mean,sd,q05,q95} in SI units. Without force in LOG nothing of it is conditioned on.
    """
    console = Console()
    check_table_name(out)
    check_writable(out)
    trained = load_model(model)
    log = read_log(logs, trained.config.log, require_force=given is Given.log)
    with terminal.inference_progress(console) as progress:
        posterior = trained.posterior(log, given.value, progress=progress)
    if figures is not None:
        prepare_folder(figures)
    write_table(posterior.table(), out)
    verdicts = terminal.print_verdicts(console, trained, posterior)
    console.print(f"wrote {out}", highlight=False, soft_wrap=True)
    if figures is not None:
        for path in save_figures(posterior, verdicts, figures):
            console.print(f"wrote {path}", highlight=False, soft_wrap=True)


@app.command(name="evaluate")
def evaluate_command(
    model: Model,
    logs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="LOG",
            help="Recordings to score on; with --folds they may be left out, for those of MODEL's training.",
            show_default=False,
        ),
    ] = None,
    baseline: Annotated[
        list[Competitor] | None,
        typer.Option(help="Competitor trained on the same data; repeatable.", show_default=False),
    ] = None,
    against: Annotated[
        list[str] | None,
        typer.Option(
            metavar="MODEL_OR_CONFIG",
            help="Another model folder, or a configuration to be trained on the same data; repeatable.",
            show_default=False,
        ),
    ] = None,
    folds: Annotated[
        Split | None,
        typer.Option(
            help="Cross-validate MODEL's configuration, trained anew: leave out each trial, or the last third of each.",
            show_default=False,
        ),
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the scores to this file.")] = None,
) -> None:
    """Score predicted force on LOG, given the training forces only: SMSE, MSLL, NLPD, coverage of the 90 % band.

    The share of impedance is how much of the variance of the training force it explains.
    """
    console = Console()
    if json_file is not None:
        check_writable(json_file)
    trained = load_model(model)
    others = _others(against or [])
    baselines: list[Baseline] = [option.value for option in baseline or []]
    log = read_log(logs, trained.config.log) if logs else None
    watch = partial(terminal.training_progress, console)
    if folds is not None:
        result = cross_validate(trained, log, folds.value, baselines, others, watch)
        count = len(result.folds)
        title = f"Predicted force of {HELD_OUT[folds]}, {count} fold{'s' if count > 1 else ''}"
        console.print(terminal.evaluation_table(result.pooled, title))
        content = folds_as_json(result)
    elif log is None:
        raise LogError(
            "expected a LOG to score on, found none; name one, or cross-validate on MODEL's training log with --folds"
        )
    else:
        scores = evaluate(trained, log, baselines, others, watch)
        console.print(terminal.evaluation_table(scores))
        content = as_json(scores)
    if json_file is not None:
        write_json(content, json_file)
        console.print(f"wrote {json_file}", highlight=False, soft_wrap=True)


@app.command()
def show(
    model: Model,
    json_output: Annotated[
        bool, typer.Option("--json", help="Print estimates and verdicts as JSON.")
    ] = False,
    sensitivity: Annotated[
        bool,
        typer.Option(
            "--sensitivity",
            help="Make every prior wider, narrower, higher and lower, and say which conclusions move: some 50 refits, "
            "about a minute at a few hundred samples, and growing with their cube.",
        ),
    ] = False,
) -> None:
    """Show hyperparameters in SI units, prior against posterior, the verdict on impedance, and what trained them."""
    console = Console()
    trained = load_model(model)
    posterior = trained.posterior(trained.fitted.log)
    if json_output:
        shown: dict[str, Any] = dict(summarise(trained.verdicts(posterior), off_diagonals(posterior)))
        if sensitivity:
            shown["sensitivity"] = _sensitivity(trained).as_json()
        typer.echo(json.dumps(shown, indent=2))
        return
    log, report = trained.fitted.log, trained.report
    sources = ", ".join(dict.fromkeys(trial.source for trial in log.trials))
    console.print(
        f"trained on {sources}: {report.samples} samples, {len(log.trials)} trials, groups {', '.join(log.groups)}, "
        f"axes {', '.join(log.axes)}{'; interrupted' if report.interrupted else ''}",
        highlight=False, soft_wrap=True,
    )  # fmt: skip
    console.print(terminal.hyperparameter_table(trained))
    console.print(terminal.restart_table(trained))
    terminal.print_verdicts(console, trained, posterior)
    if sensitivity:
        terminal.print_sensitivity(console, _sensitivity(trained))


def _sensitivity(model: ImpedanceModel) -> Sensitivity:
    # The bar is for people: standard output may be JSON.
    with terminal.sensitivity_progress(_errors()) as progress:
        return prior_sensitivity(model, progress)


def _others(sources: Sequence[str]) -> dict[str, ImpedanceModel]:
    """Models to compare with, by the last part of their folder's or file's name; a second of a name is numbered."""
    others: dict[str, ImpedanceModel] = {}
    for source in sources:
        path = Path(source)
        if path.is_dir():
            name, model = path.resolve().name, load_model(path)
        elif path.is_file() or source in shipped_configurations():
            name, model = path.name.removesuffix(".yaml"), ImpedanceModel(load_config(source))
        else:
            raise ConfigurationError(
                f"--against: expected a model folder, a YAML file or the name of a shipped configuration, found "
                f"none of them at '{source}'; shipped are {', '.join(shipped_configurations())}."
            )
        taken = sum(other == name or other.startswith(f"{name} (") for other in others)
        others[f"{name} ({taken + 1})" if taken else name] = model
    return others


def _journal_of(model: Path) -> Path:
    target = model.resolve()
    return target.with_name(f"{target.name}.journal")


def _refuse(message: str) -> NoReturn:
    _errors().print(f"[bold red]error:[/bold red] {escape(message)}", highlight=False, soft_wrap=True)
    sys.exit(BAD_INPUT)


def _errors() -> Console:
    return Console(stderr=True)


def _show_warning(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    """Our warnings in one sentence; those of libraries are no news to the user."""
    if issubclass(category, BayesImpedanceWarning):
        _errors().print(f"[yellow]warning:[/yellow] {escape(str(message))}", highlight=False, soft_wrap=True)
