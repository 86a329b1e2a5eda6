"""What looks wrong with the channels of a recording, one sentence each, and how to mend it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bayes_impedance.errors import LogError
from bayes_impedance.log import AXES, Array
from bayes_impedance.readers.samples import Samples
from bayes_impedance.readers.trials import Reading
from bayes_impedance.recording.clock import ClockReport
from bayes_impedance.recording.plausibility import Sign, sign_check, unit_check, velocity_mismatch
from bayes_impedance.recording.quality import (
    Finding,
    dead_band,
    force_at_rest,
    held_samples,
    saturation,
)

#: Samples of a recording that are looked at, from its middle: more tell nothing new.
ENOUGH = 200_000
#: A hand that moves less [m], or for a shorter time [s], does nothing to learn from.
LEAST_REACH, SHORTEST = 1e-3, 1.0
#: Gaps that are listed, the longest first.
LISTED = 3


@dataclass(frozen=True)
class Remark:
    """Something that looks wrong and has no number."""

    sentence: str


def look_at(reading: Reading) -> list[Finding]:
    """Findings on everything that was read of a table.

    Example:
        >>> import pandas as pd
        >>> from pathlib import Path
        >>> from bayes_impedance.config import LogConfig
        >>> from bayes_impedance.readers.read import open_file, read_tables
        >>> time = np.arange(400) / 100.0
        >>> force = np.clip(8 * np.sin(9 * time), -5, 5)
        >>> table = pd.DataFrame({"time": time, "position_x": 0.1 * np.sin(time), "force_x": force})
        >>> table.to_csv("log.csv", index=False)
        >>> (reading,) = read_tables(open_file(Path("log.csv"), "log.csv", LogConfig()))
        >>> [finding.sentence.split(":")[0] for finding in look_at(reading)]
        ['force_x']
    """
    samples = reading.sensed.at(middle(len(reading.sensed.time)))
    found: list[Finding] = []
    for key in ("position", "velocity", "acceleration", "force"):
        if key in samples.values:
            found += _of_quantity(key, samples.values[key], reading.axes)
    found += _of_motion(samples, reading.axes)
    found += _of_trial(reading)
    return found


@dataclass(frozen=True)
class InRecording:
    """What looks wrong with one of several recordings, `first`, and with `count` of them alike."""

    first: Finding
    source: str
    count: int

    @property
    def sentence(self) -> str:
        """In which recording, and in how many."""
        others = f", and so in {self.count} recordings" if self.count > 1 else ""
        return f"{self.source}{others}: {self.first.sentence}"


def gathered(by_recording: Sequence[tuple[str, Sequence[Finding]]]) -> list[Finding]:
    """Findings of several recordings, each with its source, of one kind and channel only once."""
    alike: dict[tuple[type, str], list[tuple[str, Finding]]] = {}
    for source, findings in by_recording:
        for finding in findings:
            # A sentence without a channel names its recording itself.
            channel = getattr(finding, "channel", None) or finding.sentence
            alike.setdefault((type(finding), channel), []).append((source, finding))
    if len(by_recording) == 1:
        return [own[0][1] for own in alike.values()]
    return [
        own[0][1] if isinstance(own[0][1], Remark) else InRecording(own[0][1], own[0][0], len(own))
        for own in alike.values()
    ]


def middle(n: int) -> slice:
    """At most ENOUGH of `n` samples, from the middle."""
    surplus = max(0, n - ENOUGH)
    return slice(surplus // 2, n - (surplus - surplus // 2))


def _of_quantity(key: str, values: Array, axes: Sequence[str]) -> Iterator[Finding]:
    names = [f"{key}_{axis}" for axis in (axes if values.shape[1] == len(axes) else AXES)]
    for name, channel in zip(names, values.T, strict=True):
        # A position comes to rest, and stops there.
        limits = [] if key == "position" else [saturation]
        for check in (*limits, held_samples, *([dead_band] if key == "force" else [])):
            finding = check(channel, name)
            if finding is not None:
                yield finding
    if values.shape[1] > 1 and key == "velocity":
        # Some controllers limit the speed and not its components.
        limited = saturation(np.linalg.norm(values, axis=1), "speed")
        if limited is not None:
            yield limited
    suspicion = unit_check(key, values) if key != "acceleration" else None
    if suspicion is not None:
        yield suspicion


def _of_motion(samples: Samples, axes: Sequence[str]) -> Iterator[Finding]:
    position, velocity = samples.values["position"], samples.values.get("velocity")
    if velocity is None or position.shape[1] != velocity.shape[1]:
        return
    for axis, x, v in zip(axes, position.T, velocity.T, strict=True):
        try:
            mismatch = velocity_mismatch(samples.time, x, v, f"velocity_{axis}")
        except LogError:
            # Too short to tell.
            return
        if mismatch is not None:
            yield mismatch


def _of_trial(reading: Reading) -> Iterator[Finding]:
    """Trials without motion or duration; sign of the force, and force at rest, in the first."""
    for trial in reading.trials:
        reach = float(np.ptp(trial.position, axis=0).max())
        if reach < LEAST_REACH:
            yield Remark(
                f"{trial.source}, trial {trial.name}: the hand moves by {1e3 * reach:.2g} mm; leave the trial out, or "
                "check log.units.position"
            )
        if np.ptp(trial.time) < SHORTEST:
            yield Remark(
                f"{trial.source}, trial {trial.name}: {trial.n_samples} samples in {np.ptp(trial.time):.2g} s are too "
                "few to learn from; leave the trial out, or check log.units.time"
            )
    for trial in reading.trials[:1]:
        if trial.force is None or trial.n_samples < 10:
            continue
        part = slice(0, ENOUGH)
        velocity = (
            trial.velocity if trial.velocity is not None else np.gradient(trial.position, trial.time, axis=0)
        )
        added = None if trial.perturbation is None else trial.perturbation[part]
        check = sign_check(trial.force[part], velocity[part], added)
        if check.sign is Sign.REVERSED:
            yield check
        speed = np.linalg.norm(velocity[part], axis=1)
        for axis, force in zip(reading.axes, trial.force[part].T, strict=True):
            rest = force_at_rest(trial.time[part], force, speed, f"force_{axis}")
            if rest is not None:
                yield rest


def of_clock(name: str, clock: ClockReport) -> Iterator[Finding]:
    """What is wrong with the time stamps of a stream or trial."""
    if clock.gaps:
        longest = sorted(clock.gaps, key=lambda gap: -gap[1])[:LISTED]
        listed = ", ".join(f"{length:.3g} s at {start:.6g} s" for start, length in longest)
        count = f"{len(clock.gaps)} gap{'s' if len(clock.gaps) > 1 else ''}"
        which = "" if len(clock.gaps) <= LISTED else "the longest of "
        yield Remark(f"{name}: {count} in the time stamps, {which}{listed}")
    if clock.duplicates:
        yield Remark(
            f"{name}: {clock.duplicates} time stamps equal to the one before; set log.clock.duplicates=drop"
        )
    if clock.backwards:
        yield Remark(f"{name}: {clock.backwards} time stamps earlier than the one before")
    if clock.source == "record":
        yield Remark(f"{name}: times are those of arrival, for {clock.why}")
