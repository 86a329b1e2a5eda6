"""The command `sample`: draws of impedance, desired trajectory and force from their exact posterior."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from bayes_impedance import terminal
from bayes_impedance.config import Config, SamplingConfig, override_config
from bayes_impedance.errors import ConfigurationError, OutputError
from bayes_impedance.outputs import check_file, check_writable, prepare_folder
from bayes_impedance.persistence import load_model
from bayes_impedance.plotting.draws import save_draw_figures
from bayes_impedance.readers import read_log
from bayes_impedance.sampling.checkpoint import Checkpoint
from bayes_impedance.sampling.dataset import save_netcdf

SUFFIX = ".nc"


class Method(str, Enum):
    """How posteriors are drawn."""

    nuts = "nuts"
    svi = "svi"
    laplace = "laplace"


class Given(str, Enum):
    """Forces that are conditioned on."""

    both = "both"
    training = "training"
    log = "log"


def sample_command(
    model: Annotated[
        Path, typer.Argument(metavar="MODEL", help="Folder that train wrote.", show_default=False)
    ],
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG", help="Recordings; several may follow.", show_default=False),
    ],
    out: Annotated[Path, typer.Option(help="netCDF to write, in the schema of ArviZ: POSTERIOR.nc.")],
    given: Annotated[
        Given, typer.Option(help="Forces to condition on: those trained on, those of LOG, or both.")
    ] = Given.both,
    method: Annotated[
        Method | None,
        typer.Option(
            help="nuts is exact in the limit; svi and laplace approximate.  \\[default: sampling.method]",
            show_default=False,
        ),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Change one key of sampling, e.g. sampling.draws=1000; repeatable.",
        ),
    ] = None,
    figures: Annotated[Path | None, typer.Option(help="Folder for PNG figures.")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue a run that was killed or stopped.")
    ] = False,
) -> None:
    """Draw mass, damping, stiffness and desired trajectory from their posterior given the forces, by Pyro.

    The priors are those of MODEL's configuration; its hyperparameters are drawn, too. What chains have drawn is kept
    beside the netCDF until it is written: after Ctrl-C, a crash or a power cut the same command with --resume goes on,
    and ends with the same draws. Diagnostics are printed with advice, and kept in the file.
    """
    console = Console()
    unfinished = _unfinished(out, resume)
    trained = load_model(model)
    settings = _settings(trained.config, overrides or [], method)
    _check_method(settings, unfinished)
    log = read_log(logs, trained.config.log, require_force=given is Given.log)
    if figures is not None:
        prepare_folder(figures)
        check_writable(figures / "force.png")
    if resume and not unfinished.exists():
        console.print("nothing to resume: sampling from the start")
    try:
        with terminal.sampling_progress(console) as hook:
            posterior = trained.sample(log, given.value, settings, hook, unfinished)
    except KeyboardInterrupt:
        if unfinished.exists():
            console.print("sampling was stopped: to continue, add --resume to the same command")
        raise
    save_netcdf(posterior, out)
    Checkpoint(unfinished, {}).remove()
    console.print(str(posterior.engine), highlight=False, soft_wrap=True)
    terminal.print_diagnosis(console, posterior)
    terminal.print_exact_verdicts(console, posterior)
    console.print(f"wrote {out}", highlight=False, soft_wrap=True)
    if figures is not None:
        for path in save_draw_figures(posterior, figures):
            console.print(f"wrote {path}", highlight=False, soft_wrap=True)


def _unfinished(out: Path, resume: bool) -> Path:
    """Where chains are kept until `out` is written: beside it, on the same disk."""
    if out.suffix != SUFFIX:
        raise OutputError(
            f"{out}: expected a file name that ends in {SUFFIX} (netCDF), got {out.suffix!r}; name one"
        )
    check_file(out)
    unfinished = out.with_name(f"{out.name}.unfinished")
    if unfinished.exists() and not resume:
        raise OutputError(
            f"{unfinished}: expected no unfinished run of {out.name}, found one; add --resume to continue it, or "
            "delete the folder to start anew"
        )
    return unfinished


def _check_method(settings: SamplingConfig, unfinished: Path) -> None:
    """Only chains go on; what another method draws takes their place."""
    if settings.method != "nuts" and unfinished.exists():
        raise OutputError(
            f"{unfinished}: expected no unfinished chains where {settings.method} is to draw, found some; leave out "
            "--method and --set sampling.method to continue them, write to another --out, or delete the folder"
        )


def _settings(config: Config, overrides: list[str], method: Method | None) -> SamplingConfig:
    for assignment in overrides:
        if not assignment.strip().startswith("sampling."):
            raise ConfigurationError(
                f"--set: expected a key of sampling, such as sampling.draws=1000, got {assignment!r}, which is part "
                "of the model; train another one with it"
            )
    own = [] if method is None else [f"sampling.method={method.value}"]
    return override_config(config, [*overrides, *own]).sampling
