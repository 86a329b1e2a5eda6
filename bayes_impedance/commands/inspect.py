"""The command `inspect`: what is in a recording, what is wrong with it, and the configuration that would read it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from bayes_impedance.commands.inspection_tables import print_inspection
from bayes_impedance.config import load_config, shipped_configurations
from bayes_impedance.inspection.draft import draft
from bayes_impedance.inspection.inspect import inspect_recordings
from bayes_impedance.outputs import check_writable, whole_file
from bayes_impedance.plotting import plot_recording, save_figure


def inspect_command(
    logs: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOG",
            help="Recordings: tables, arrays or bags; several may follow.",
            show_default=False,
        ),
    ],
    config: Annotated[
        str | None,
        typer.Option(
            help="YAML file, or a shipped configuration, that reads them; without, columns are guessed: "
            f"{', '.join(shipped_configurations())}.",
            show_default=False,
        ),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change one key, e.g. log.axes=[x,y]; repeatable."),
    ] = None,
    write_config: Annotated[
        Path | None,
        typer.Option(
            help="Write the configuration that would read them: a draft to check.", show_default=False
        ),
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Draw the recording to this PNG.", show_default=False)
    ] = None,
) -> None:
    """Show what is in LOG: columns or topics, clocks, units, what looks wrong, the smoother's effect, trials, phase.

    The virtual mass and damping of a robot that answers force, and the lag between force and motion, are estimated.
    """
    console = Console()
    for path in (write_config, figure):
        if path is not None:
            check_writable(path)
    known = None if config is None else inspect_recordings(logs, load_config(config, overrides or []))
    first = draft(logs, overrides or [], known)
    inspection = first.inspection
    print_inspection(console, inspection)
    if write_config is not None:
        with whole_file(write_config) as temporary:
            temporary.write_text(first.text, encoding="utf-8")
        console.print(
            f"wrote {write_config}; check it, then: --config {write_config}", highlight=False, soft_wrap=True
        )
    if figure is not None and inspection.log is not None:
        save_figure(plot_recording(inspection.log, inspection.prepared), figure)
        console.print(f"wrote {figure}", highlight=False, soft_wrap=True)
    if inspection.refusal is not None:
        raise inspection.refusal
