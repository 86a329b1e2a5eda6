"""The command `plan`: which repetitions and perturbations an interval of a wanted width needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, TypeVar

import typer
from rich.console import Console

from bayes_impedance.commands.simulate import KINDS, Kind, Setting, Task, find_people
from bayes_impedance.config import load_config, shipped_configurations
from bayes_impedance.errors import SimulationError
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.outputs import check_writable, write_json
from bayes_impedance.persistence import load_model
from bayes_impedance.plotting import plot_plan, save_figure
from bayes_impedance.simulation.experiment import Experiment
from bayes_impedance.simulation.planning import Plan, check_width, plan
from bayes_impedance.simulation.subjects import SUBJECTS
from bayes_impedance.simulation.tasks import TASKS
from bayes_impedance.terminal import planning_progress, planning_table

Number = TypeVar("Number", int, float)

CAVEAT = (
    "A width is how far estimates scatter, not how far they may be off: on the simulated arm, whose axes are coupled, "
    "a model without coupling errs by one to three times as much."
)


def plan_command(
    repetitions: Annotated[str, typer.Option(help="Numbers of rounds to compare.")] = "2,4,8",
    perturbations: Annotated[
        str, typer.Option(help="Forces of the device to compare \\[N]: SD, or amplitude of pulses.")
    ] = "1,2,5",
    width: Annotated[
        float, typer.Option(help="Wanted width of the 90 % interval of stiffness, as a share of its median.")
    ] = 0.3,
    config: Annotated[
        str,
        typer.Option(help=f"YAML file, or a shipped configuration: {', '.join(shipped_configurations())}."),
    ] = "admittance",
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Change one key, e.g. preprocessing.rate=12.5; repeatable."
        ),
    ] = None,
    pilot: Annotated[
        Path | None,
        typer.Option(
            metavar="MODEL",
            help="Folder that train wrote from a pilot recording, in place of --config and simulated pilots.",
            show_default=False,
        ),
    ] = None,
    stiffness: Annotated[
        Setting | None,
        typer.Option(help="Muscle stiffness, 3 360 or 16 800 N/m; low by default.", show_default=False),
    ] = None,
    subject: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(SUBJECTS),
            help="A synthetic person instead, with their own stiffness.",
            show_default=False,
        ),
    ] = None,
    task: Annotated[Task, typer.Option(help="Path to trace, one round a trial.")] = Task.figure_eight,
    duration: Annotated[float, typer.Option(help="Of a round \\[s].")] = 4.0,
    kind: Annotated[Kind, typer.Option(help="Shape of the perturbing force.")] = Kind.band_limited,
    motions: Annotated[int, typer.Option(help="Simulated sessions to average over.")] = 3,
    figure: Annotated[Path | None, typer.Option(help="PNG to draw widths over repetitions into.")] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write every expectation to this file.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the first session.")] = 0,
) -> None:
    """Plan an experiment: how many repetitions and how much perturbation give a narrow interval of stiffness.

    Simulated sessions of each design are looked at with hyperparameters from a pilot: four repetitions of each, or
    MODEL. Some minutes by default.
    """
    for path in (figure, json_file):
        if path is not None:
            check_writable(path)
    check_width(width)
    counts = _numbers("repetitions", repetitions, int)
    forces = _numbers("perturbations", perturbations, float)
    model = ImpedanceModel(load_config(config, overrides or [])) if pilot is None else load_model(pilot)
    (person,) = find_people(stiffness, [] if subject is None else [subject])
    person = replace(person, pace=replace(person.pace, repetition=duration))
    experiment = Experiment([person], TASKS[task.value](), repetitions=1, perturbation=KINDS[kind](1.0))
    console = Console()
    with planning_progress(console) as progress:
        planned = plan(experiment, model, counts, forces, seed, motions, progress=progress)
    console.print(planning_table(planned))
    console.print(f"An interval of {width:g} of the median along every axis needs:", highlight=False)
    for sentence in planned.sentences(width):
        console.print(f"  {sentence}", highlight=False)
    console.print(f"  {CAVEAT}", style="yellow", highlight=False)
    if figure is not None:
        save_figure(plot_plan(planned, width), figure)
        console.print(f"wrote {figure}", highlight=False, soft_wrap=True)
    if json_file is not None:
        write_json(_as_json(planned, width), json_file)
        console.print(f"wrote {json_file}", highlight=False, soft_wrap=True)


def _numbers(option: str, text: str, kind: Callable[[str], Number]) -> list[Number]:
    try:
        return [kind(part) for part in text.split(",")]
    except ValueError:
        raise SimulationError(
            f"--{option}: expected numbers with commas between, such as 2,4,8, got {text!r}; mend it"
        ) from None


def _as_json(planned: Plan, width: float) -> dict[str, object]:
    smallest = planned.smallest(width)
    return {
        "wanted_width": width,
        "unit": planned.unit,
        "smallest": {f"{perturbation:g}": count for perturbation, count in smallest.items()},
        "designs": planned.table().to_dict(orient="records"),
    }
