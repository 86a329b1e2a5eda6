"""The command `calibrate`: whether a method of sampling draws from the posterior of a configuration."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from bayes_impedance.calibration.draw import Settings
from bayes_impedance.calibration.run import Calibration, calibrate
from bayes_impedance.calibration.run import Progress as Hook
from bayes_impedance.commands.sample import Method
from bayes_impedance.config import Config, as_functions, load_config, shipped_configurations
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.outputs import check_writable, write_json
from bayes_impedance.plotting.calibration import save_calibration_figures
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.readers import read_log
from bayes_impedance.simulation.generative import repeated_motion

#: Of a repetition of synthetic motion [s].
DURATION = 4.0
MOTION = "Motion"


def calibrate_command(
    config: Annotated[
        str,
        typer.Option(help=f"YAML file, or a shipped configuration: {', '.join(shipped_configurations())}."),
    ],
    draws: Annotated[int, typer.Option(help="Truths drawn from the prior, each with a posterior.")] = 200,
    method: Annotated[
        Method | None, typer.Option(help="Of sampling; sampling.method by default.", show_default=False)
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Change one key, e.g. sampling.chains=1; repeatable."
        ),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(
            metavar="LOG",
            help="Recording whose motion is taken; synthetic motion by default.",
            show_default=False,
            rich_help_panel=MOTION,
        ),
    ] = None,
    repetitions: Annotated[int, typer.Option(min=1, help="Of synthetic motion.", rich_help_panel=MOTION)] = 2,
    samples: Annotated[
        int, typer.Option(min=4, help="Of each repetition, which takes 4 s.", rich_help_panel=MOTION)
    ] = 20,
    thinned: Annotated[
        int, typer.Option(min=9, help="Draws of a posterior among which its truth is ranked.")
    ] = 99,
    processes: Annotated[int, typer.Option(min=1, help="Draws at work side by side.")] = 2,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="For ranks and figures; a run that was stopped continues from it."
        ),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write tests, verdicts and ranks to this file.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of all draws; the same seed, the same ranks.")] = 0,
) -> None:
    """Calibrate a method of sampling: draw truths from the prior, recordings, posteriors; rank the truths in them.

    Where the draws are those of the posterior, ranks are uniform. Hours for some configurations: with --out, what is
    done stays, and the same command continues.
    """
    for path in (out, json_file):
        if path is not None:
            check_writable(path)
    changes = [*(overrides or []), *([] if method is None else [f"sampling.method={method.value}"])]
    chosen = as_functions(load_config(config, changes))
    motion = (
        recorded_motion(chosen, log) if log is not None else synthetic_motion(chosen, repetitions, samples)
    )
    console = Console()
    settings = Settings(chosen, motion, seed=seed, thinned=thinned)
    with _progress(console) as progress:
        calibration = calibrate(settings, draws, out, processes, progress)
    console.print(calibration_table(calibration))
    for remark in calibration.remarks():
        console.print(f"  {remark}", style="yellow", highlight=False, markup=False)
    if out is not None:
        for figure in save_calibration_figures(calibration, out):
            console.print(f"wrote {figure}", highlight=False, soft_wrap=True)
    if json_file is not None:
        write_json(calibration.as_json(), json_file)
        console.print(f"wrote {json_file}", highlight=False, soft_wrap=True)


def synthetic_motion(config: Config, repetitions: int, samples: int) -> PreparedLog:
    """A figure of eight, along the axes of the configuration, or x where it leaves them open."""
    return repeated_motion(repetitions, DURATION, samples / DURATION, axes=tuple(config.log.axes or ("x",)))


def recorded_motion(config: Config, path: Path) -> PreparedLog:
    """The motion of a recording, prepared."""
    return ImpedanceModel(config).prepare(read_log(path, config.log))


def calibration_table(calibration: Calibration) -> Table:
    """Test and verdict of each quantity."""
    title = (
        f"Ranks of {len(calibration.sampled)} truths among draws of {calibration.method}, "
        f"uniform where p exceeds {calibration.level:.2g} and the ECDF stays in its band"
    )
    table = Table(title=title, title_justify="left")
    table.add_column("quantity", overflow="fold")
    table.add_column("χ² p", justify="right")
    table.add_column("verdict", overflow="fold")
    for found in calibration.uniformity:
        colour = "green" if found.verdict == "uniform" else "red"
        table.add_row(found.name, f"{found.p:.3g}", f"[{colour}]{found.verdict}[/{colour}]")
    return table


@contextmanager
def _progress(console: Console) -> Iterator[Hook]:
    """A bar over draws; hidden where the output is no terminal."""
    columns = (
        TextColumn("calibrating"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"),
        TimeElapsedColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task("", total=None)

        def hook(done: int, planned: int, state: str) -> None:
            bar.update(task, completed=done, total=planned, description=state.splitlines()[0][:60])

        yield hook
