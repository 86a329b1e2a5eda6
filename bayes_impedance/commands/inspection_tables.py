"""An inspection as tables and sentences for a terminal."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bayes_impedance.inspection.inspect import Inspection
from bayes_impedance.log import InteractionLog
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.recording.clock import ONLY_CLOCK, ClockReport
from bayes_impedance.recording.device_law import DeviceLaw

#: Trials and topics beyond this many are counted and not listed.
LONGEST_TABLE = 12


def print_inspection(console: Console, inspection: Inspection) -> None:
    """Contents, clocks, quantities, trials, smoothing, then in sentences what was found."""
    _print_contents(console, inspection)
    if inspection.clocks:
        console.print(_clock_table(inspection))
    if inspection.log is not None:
        console.print(_quantity_table(inspection.log))
    if inspection.prepared is not None:
        console.print(_trial_table(inspection.prepared))
    if inspection.smoothing:
        console.print(_smoother_table(inspection))
    if inspection.law is not None and inspection.log is not None:
        _print_law(console, inspection.law, inspection.log.axes)
    _print_sentences(console, "Force", _of_force(inspection))
    _print_sentences(console, "Mended on reading", inspection.repairs, "yellow")
    wrong = [finding.sentence for finding in inspection.findings]
    _print_sentences(console, "What looks wrong", wrong, "yellow")
    if inspection.log is not None and not inspection.findings:
        console.print("Nothing looks wrong.", style="green")


def _print_contents(console: Console, inspection: Inspection) -> None:
    seen: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for table in inspection.tables:
        key = (table.source, tuple(compressed(table.columns)))
        seen.setdefault(key, []).append(table.trial or "")
    for (source, names), trials in seen.items():
        recordings = f", {len(trials)} recordings" if len(trials) > 1 else ""
        console.print(
            f"[bold]{escape(source)}[/bold]{recordings}: {escape(', '.join(names))}", highlight=False
        )


def compressed(names: Iterable[str]) -> list[str]:
    """Names with what they have in common said once: `a[0]`, `a[1]`, `a[2]` as `a[0…2]`, `/t.x`, `/t.y` as `/t.(x, y)`.

    Example:
        >>> compressed(["time", "/t.position[0]", "/t.position[1]", "/t.effort[0]"])
        ['time', '/t.(position[0…1], effort[0])']
    """
    ranges: dict[str, list[int]] = {}
    for name in names:
        match = re.fullmatch(r"(.*)\[(\d+)\]", name)
        ranges.setdefault(match[1] if match else name, []).append(int(match[2]) if match else -1)
    parts: dict[str, list[str]] = {}
    for name, indices in ranges.items():
        numbered = [index for index in indices if index >= 0]
        last = f"…{max(numbered)}" if len(numbered) > 1 else ""
        topic, point, rest = name.partition(".") if name.startswith("/") else ("", "", name)
        parts.setdefault(f"{topic}{point}", []).append(
            rest + (f"[{min(numbered)}{last}]" if numbered else "")
        )
    return [
        *parts.pop("", []),
        *(prefix + (own[0] if len(own) == 1 else f"({', '.join(own)})") for prefix, own in parts.items()),
    ]


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left")
    for index, name in enumerate(columns):
        table.add_column(escape(name), justify="left" if index == 0 else "right")
    return table


def _clock_table(inspection: Inspection) -> Table:
    table = _table(
        "Time stamps", "", "samples", "span [s]", "rate [Hz]", "jitter [ms]", "gaps", "equal", "clock"
    )
    for name, clock in list(inspection.clocks.items())[:LONGEST_TABLE]:
        offset = clock.against_recorder
        compared = "" if offset is None else f", {offset.offset:+.3f} s, {offset.drift:+.0f} ppm"
        table.add_row(
            escape(name), str(clock.n), f"{clock.span:.2f}", f"{clock.rate:.4g}", f"{1e3 * clock.jitter:.2g}",
            str(len(clock.gaps)), str(clock.duplicates), _clock_name(clock) + compared,
        )  # fmt: skip
    _count_rest(table, len(inspection.clocks))
    return table


def _clock_name(clock: ClockReport) -> str:
    # Two names for one clock would only puzzle.
    return "one" if clock.why == ONLY_CLOCK else clock.source


def _count_rest(table: Table, count: int) -> None:
    if count > LONGEST_TABLE:
        table.add_row(f"… and {count - LONGEST_TABLE} more")


def _quantity_table(log: InteractionLog) -> Table:
    table = _table("What was read", "axis", "position [m]", "speed [m/s]", "force, RMS [N]", "largest [N]")
    for a, axis in enumerate(log.axes):
        position = np.concatenate([trial.position[:, a] for trial in log.trials])
        speed = np.concatenate([np.abs(np.gradient(t.position[:, a], t.time)) for t in log.trials])
        force = [trial.force[:, a] for trial in log.trials if trial.force is not None]
        joined = np.concatenate(force) if force else np.array([])
        table.add_row(
            axis,
            f"{position.min():.4g} … {position.max():.4g}",
            f"{np.quantile(speed, 0.95):.3g}",
            f"{np.sqrt(np.mean(joined**2)):.3g}" if force else "none",
            f"{np.abs(joined).max():.3g}" if force else "",
        )
    table.caption = "speed: 95 % of samples are slower"
    return table


def _trial_table(prepared: PreparedLog) -> Table:
    table = _table(
        "What the model would see", "trial", "group", "samples", "duration [s]", "repetitions", "phase"
    )
    for trial in prepared.trials[:LONGEST_TABLE]:
        phase = "" if trial.phase is None else f"{_plain(trial.phase[0])} … {_plain(trial.phase[-1])}"
        table.add_row(
            escape(f"{trial.source}, {trial.name}"), escape(trial.group), str(trial.n_samples),
            f"{np.ptp(trial.time):.2f}", str(len(np.unique(trial.repetition))), phase,
        )  # fmt: skip
    _count_rest(table, len(prepared.trials))
    return table


def _plain(phase: float) -> str:
    # The smoother may leave it a hair under zero.
    return f"{abs(phase) if abs(phase) < 5e-4 else phase:.3f}"


def _smoother_table(inspection: Inspection) -> Table:
    """One row a window: what it passes, what it leaves of noise, and the force this makes at the priors' medians."""
    model = inspection.config.model
    medians = tuple(prior.level.median for prior in (model.stiffness, model.damping, model.mass))
    table = _table(
        "Smoother", "window [s]", "passes x, v, a to [Hz]", "noise of x [µm]", "of v [mm/s]", "of a [m/s²]",
        "of force [N]", "force removed",
    )  # fmt: skip
    smoother = inspection.config.preprocessing.smoother
    assert smoother is not None
    configured = min(inspection.smoothing, key=lambda effect: abs(effect.window - smoother.window))
    for effect in inspection.smoothing:
        x, v, a = effect.noise.max(axis=0)
        removed = "" if effect.removed is None else f"{effect.removed.max():.1%}"
        style = "bold" if effect is configured else None
        table.add_row(
            f"{effect.window:.3g}", ", ".join(f"{frequency:.3g}" for frequency in effect.bandwidth), f"{1e6 * x:.2g}",
            f"{1e3 * v:.2g}", f"{a:.2g}", f"{effect.force_noise(*medians).max():.2g}", removed, style=style,
        )  # fmt: skip
    listed = ", ".join(f"{value:.2g}" for value in 1e6 * configured.recorded_noise)
    table.caption = (
        f"noise of the recorded positions: {listed} µm by axis (model.position_noise_sd carries it). Bold: as "
        "configured; of the noisiest axis; force: k x + d v + m a at the priors' medians"
    )
    return table


def _print_law(console: Console, law: DeviceLaw, axes: Sequence[str]) -> None:
    """Virtual mass and damping of the robot, an axis a row; a sentence where it has none."""
    if not law.holds:
        console.print(
            f"The robot does not answer force by a mass and a damping: R² of u + p = M a + B v is {law.pooled:.2f} "
            "over all axes",
            highlight=False,
        )
        return
    table = _table("The robot's law, u + p = M a + B v", "axis", "M [kg]", "B [Ns/m]", "R²")
    for a, axis in enumerate(axes):
        mass = f"{law.mass[a]:.3g} ± {law.mass_error[a]:.2g}" if law.mass_determined[a] else "not determined"
        damping = f"{law.damping[a]:.4g} ± {law.damping_error[a]:.2g}"
        table.add_row(axis, mass, damping, f"{law.r_squared[a]:.2f}")
    table.caption = f"R² over all axes: {law.pooled:.3f}"
    console.print(table)


def _of_force(inspection: Inspection) -> list[str]:
    """The tool and the lag."""
    sentences = [
        f"{source}: {preparation.tool.sentence}"
        for source, preparation in inspection.preparations.items()
        if preparation.tool is not None
    ]
    lag = inspection.lag
    if lag is not None:
        sentences.append(
            f"force lags behind motion by {1e3 * lag.lag:.1f} ± {1e3 * lag.standard_error:.1f} ms; set log.force.lag "
            "if that is more than a sample"
            if lag.determined
            else f"the lag between force and motion cannot be told: {lag.reason}"
        )
    return sentences


def _print_sentences(
    console: Console, title: str, sentences: Iterable[str], style: str | None = None
) -> None:
    listed = list(sentences)
    if listed:
        console.print(title, style="bold")
    for sentence in listed:
        console.print(f"  {escape(sentence)}", highlight=False, style=style)
