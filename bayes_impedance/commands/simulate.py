"""The command `simulate`: what a user can set of an experiment, and its log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from bayes_impedance.errors import SimulationError
from bayes_impedance.outputs import check_writable
from bayes_impedance.simulation.arm import arm_with
from bayes_impedance.simulation.device import (
    Admittance,
    BandLimitedForce,
    ForcePulses,
    Perturbation,
    PositionDisplacement,
    Sensor,
    Sensors,
    Unperturbed,
)
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.subjects import SUBJECTS, Subject, find_subject
from bayes_impedance.simulation.tasks import CENTRE, TASKS
from bayes_impedance.terminal import simulation_progress
from bayes_impedance.writer import check_table_name, write_log

ARM, DEVICE, SENSORS = "Arm", "Device", "Sensors"


class Setting(str, Enum):
    """Stiffness of the muscles."""

    low = "low"
    high = "high"


class Task(str, Enum):
    """What is traced."""

    flower = "flower"
    figure_eight = "figure-eight"
    reaches = "reaches"


class Kind(str, Enum):
    """Shape of a perturbing force."""

    band_limited = "band-limited"
    pulses = "pulses"


KINDS: Mapping[Kind, type[BandLimitedForce] | type[ForcePulses]] = {
    Kind.band_limited: BandLimitedForce,
    Kind.pulses: ForcePulses,
}


def simulate_command(
    out: Annotated[Path, typer.Option(metavar="LOG", help="Log to write: .csv or .parquet.")],
    stiffness: Annotated[
        Setting | None,
        typer.Option(help="Muscle stiffness, 3 360 or 16 800 N/m; low by default.", rich_help_panel=ARM),
    ] = None,
    subject: Annotated[
        list[str] | None,
        typer.Option(
            metavar="|".join(SUBJECTS),
            help="A synthetic person instead, with their own stiffness and pace; repeatable.",
            rich_help_panel=ARM,
            show_default=False,
        ),
    ] = None,
    trials: Annotated[int, typer.Option(help="Trials of each person.")] = 10,
    repetitions: Annotated[int, typer.Option(help="Rounds of the path in a trial.")] = 3,
    duration: Annotated[
        float | None,
        typer.Option(help="Of a round \\[s]; 10, or that of the subject, by default.", show_default=False),
    ] = None,
    task: Annotated[Task, typer.Option(help="Path to trace.")] = Task.flower,
    centre: Annotated[
        tuple[float, float], typer.Option(help="Of the path, from the shoulder \\[m].")
    ] = CENTRE,
    muscle_noise: Annotated[
        float | None,
        typer.Option(
            help="SD of muscle tension as a share of it; .1, or that of the subject, by default.",
            rich_help_panel=ARM,
            show_default=False,
        ),
    ] = None,
    reflex_gain: Annotated[
        float, typer.Option(help="Stretch reflex as a share of muscle impedance.", rich_help_panel=ARM)
    ] = 0.0,
    reflex_delay: Annotated[
        float, typer.Option(help="Delay of the reflex \\[s].", rich_help_panel=ARM)
    ] = 0.03,
    perturbation: Annotated[
        float,
        typer.Option(
            help="Force that the device adds \\[N]: SD, or amplitude of pulses.", rich_help_panel=DEVICE
        ),
    ] = 0.0,
    kind: Annotated[
        Kind, typer.Option(help="Shape of that force.", rich_help_panel=DEVICE)
    ] = Kind.band_limited,
    displacement: Annotated[
        float,
        typer.Option(
            help="Position displacements by a servo instead, as in ensemble methods \\[m].",
            rich_help_panel=DEVICE,
        ),
    ] = 0.0,
    virtual_mass: Annotated[float, typer.Option(help="M_r \\[kg].", rich_help_panel=DEVICE)] = 2.0,
    virtual_damping: Annotated[float, typer.Option(help="D_r \\[Ns/m].", rich_help_panel=DEVICE)] = 6.0,
    force_noise: Annotated[float, typer.Option(help="SD \\[N].", rich_help_panel=SENSORS)] = 0.05,
    force_resolution: Annotated[float, typer.Option(help="\\[N]", rich_help_panel=SENSORS)] = 0.0,
    force_bias: Annotated[float, typer.Option(help="\\[N]", rich_help_panel=SENSORS)] = 0.0,
    force_latency: Annotated[float, typer.Option(help="\\[s]", rich_help_panel=SENSORS)] = 0.0,
    position_noise: Annotated[float, typer.Option(help="SD \\[m].", rich_help_panel=SENSORS)] = 0.0,
    position_resolution: Annotated[float, typer.Option(help="\\[m]", rich_help_panel=SENSORS)] = 1e-6,
    position_bias: Annotated[float, typer.Option(help="\\[m]", rich_help_panel=SENSORS)] = 0.0,
    position_latency: Annotated[float, typer.Option(help="\\[s]", rich_help_panel=SENSORS)] = 0.0,
    rate: Annotated[float, typer.Option(help="Samples a second of the log \\[Hz].")] = 200.0,
    step: Annotated[float, typer.Option(help="Of integration and controller \\[s].")] = 1e-3,
    seed: Annotated[int, typer.Option(min=0, help="Of all noise; the same seed, the same log.")] = 0,
) -> None:
    """Simulate people who trace a path with a device in their hand; the log carries the truth.

    A planar arm of two links and six muscles holds an admittance-controlled device. What each sample truly was stands
    beside it: desired position, endpoint stiffness, damping, mass.
    """
    check_table_name(out)
    check_writable(out)
    people = find_people(stiffness, subject or [])
    arm_changes: dict[str, float] = {"reflex_gain": reflex_gain, "reflex_delay": reflex_delay}
    if muscle_noise is not None:
        arm_changes["noise"] = muscle_noise
    pace_changes = {} if duration is None else {"repetition": duration}
    people = [
        replace(person, arm=replace(person.arm, **arm_changes), pace=replace(person.pace, **pace_changes))  # type: ignore[arg-type]  # all of these are scalars
        for person in people
    ]
    experiment = Experiment(
        people,
        TASKS[task.value](centre=centre),
        trials,
        repetitions,
        _perturbation(perturbation, kind, displacement),
        Admittance(virtual_mass, virtual_damping),
        Sensors(
            Sensor(force_noise, force_resolution, force_bias, force_latency),
            Sensor(position_noise, position_resolution, position_bias, position_latency),
        ),
        rate,
        step,
    )
    console = Console()
    with simulation_progress(console, len(people) * trials) as progress:
        log = simulate(experiment, seed, progress)
    with console.status(f"writing {out.name}"):
        write_log(log, out)
    console.print(
        f"wrote {out}: {len(log.trials)} trials, {log.n_samples} samples, truth included",
        highlight=False, soft_wrap=True,
    )  # fmt: skip


def find_people(stiffness: Setting | None, subjects: Sequence[str]) -> list[Subject]:
    """Synthetic subjects by name, or somebody with the default arm in one of its settings.

    Raises:
        SimulationError: both are given, or there is no subject of a name.
    """
    if stiffness is not None and subjects:
        raise SimulationError(
            "expected --stiffness or --subject, got both, and a subject has a stiffness of their own; leave one out"
        )
    if subjects:
        return [find_subject(name) for name in dict.fromkeys(subjects)]
    setting = (stiffness or Setting.low).value
    return [Subject(setting, arm_with(setting))]


def _perturbation(force: float, kind: Kind, displacement: float) -> Perturbation:
    if force and displacement:
        raise SimulationError(
            "expected --perturbation or --displacement, got both; choose whether the device adds a force or moves the "
            "hand"
        )
    if displacement:
        return PositionDisplacement(displacement)
    return KINDS[kind](force) if force else Unperturbed()
