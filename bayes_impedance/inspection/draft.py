"""The first draft of a configuration that would read a recording, for a person to check."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bayes_impedance.config import LogConfig, as_yaml, parse_config
from bayes_impedance.errors import LogError
from bayes_impedance.inspection.findings import InRecording
from bayes_impedance.inspection.guess import (
    guess_columns,
    guess_length_unit,
    guess_sampling_rate,
    guess_time_unit,
)
from bayes_impedance.inspection.inspect import Inspection, inspect_recordings
from bayes_impedance.log import AXES, Array
from bayes_impedance.readers.columns import of_axis
from bayes_impedance.readers.read import open_files
from bayes_impedance.readers.table import Opened, Table
from bayes_impedance.recording.plausibility import VelocityMismatch, VelocityUnrelated

#: Taken where nothing tells how far samples are apart [Hz].
PLACEHOLDER_RATE = 100.0


@dataclass(frozen=True)
class Draft:
    """`text`: the configuration as YAML, with what looks wrong as comments; `inspection`: what it rests on."""

    text: str
    inspection: Inspection


def draft(files: Sequence[Path], overrides: Sequence[str] = (), known: Inspection | None = None) -> Draft:
    """A configuration for some recordings: that of `known` where they have been inspected with one, else a guess.

    Raises:
        LogError: a file is missing, unreadable, or nothing in it looks like a position.
        ConfigurationError: an override is none.
    """
    if known is not None:
        stated = known.config.model_dump(mode="json", exclude_defaults=True)
        return Draft(_text(files, stated, known, guessed=False), known)
    log, remarks = _guessed_log(files)
    content: dict[str, Any] = {"log": log}
    # To look at, whatever has to be mended is mended; what of it was needed goes into the draft.
    mended = {**log, "clock": {"duplicates": "drop"}}
    lenient = {"log": mended, "preprocessing": {"segmentation": {"gaps": "split"}}}
    inspection = inspect_recordings(files, parse_config(lenient, "draft", overrides))
    _add_repairs(content, inspection)
    return Draft(_text(files, content, inspection, guessed=True, remarks=remarks), inspection)


# --- guesses -------------------------------------------------------------------------------------


def _guessed_log(files: Sequence[Path]) -> tuple[dict[str, Any], list[str]]:
    """The section `log` from names and values of the first file, and what could not be told."""
    (opened,) = open_files(files[:1], LogConfig())
    found = _relative(guess_columns(_candidates(opened)))
    if "position" not in found:
        table = opened.tables[0]
        # Formats that know what they sought say so.
        raise next(iter(table.absent.values()), _nameless(table))
    # What opening found on its own need not be stated.
    stated = {key: name for key, name in found.items() if name != getattr(opened.config.columns, key)}
    log: dict[str, Any] = {"columns": stated} if stated else {}
    (opened,) = open_files(
        files[:1], LogConfig.model_validate({"columns": stated, "sampling_rate": PLACEHOLDER_RATE})
    )
    table = opened.tables[0]
    values = _arrays(table, {key: found[key] for key in ("position", "velocity", "time") if key in found})
    position = values["position"]
    remarks = []
    units = {"position": guess_length_unit(position)}
    if "time" in found:
        units["time"] = guess_time_unit(values["time"][:, 0])
    elif not table.timed:
        rate = guess_sampling_rate(position, values["velocity"]) if "velocity" in values else None
        log["columns"] = {"time": None} | stated
        log["sampling_rate"] = round(PLACEHOLDER_RATE if rate is None else rate, 1)
        remarks.append(
            "no column of time was found: log.sampling_rate is a placeholder, set it"
            if rate is None
            else "no column of time was found: log.sampling_rate is that at which positions and velocities agree"
        )
    if "[{index}]" in found.get("force", "") and found["force"].startswith("/"):
        remarks.append(
            "a wrench hidden in a JointState is often in the frame of the tool: if it is, set log.force.frame to tool, "
            "log.columns.orientation to the columns of the angles, and log.force.rotation to their axes"
        )
    if units["position"] != "m" and "velocity" in found:
        units["velocity"] = f"{units['position']}/s"
    plain = {"position": "m", "time": "s"}
    changed = {key: unit for key, unit in units.items() if unit != plain.get(key)}
    return log | ({"units": changed} if changed else {}), remarks


def _candidates(opened: Opened) -> list[str]:
    """Names that may be of use: messages have times of their own, and joints no place in space."""
    names = [name for table in opened.tables for name in table.columns]
    if opened.tables[0].timed:
        names = [
            name for name in names if ".header." not in name and "joint" not in name.split(".")[0].lower()
        ]
    return list(dict.fromkeys(names))


def _nameless(table: Table) -> LogError:
    return LogError(
        f"{table.source}: expected names such as position_x, x or pos, found none that looks like a position; name the "
        "columns in a configuration"
    )


def _relative(found: Mapping[str, str]) -> dict[str, str]:
    """Paths of arrays as they are within a recording: without the groups that position and force share."""
    if not {"position", "force"} <= found.keys() or found["position"].startswith("/"):
        return dict(found)
    parents = [found[key].split("/")[:-1] for key in ("position", "force")]
    shared = 0
    while all(len(parent) > shared for parent in parents) and parents[0][shared] == parents[1][shared]:
        shared += 1
    prefix = "/".join(parents[0][:shared]) + "/" if shared else ""
    return {key: name.removeprefix(prefix) for key, name in found.items() if name.startswith(prefix)}


def _arrays(table: Table, templates: Mapping[str, str]) -> dict[str, Array]:
    """Numbers of the columns that templates name, `(n, c)` each, read at once, without rows that hold what is none."""
    names = {
        key: list(dict.fromkeys(name for axis in AXES if (name := of_axis(template, axis)) in table.columns))
        for key, template in templates.items()
    }
    wanted = list(dict.fromkeys(name for own in names.values() for name in own))
    series = {name: column for stream in table.load(wanted, ()) for name, column in stream.columns.items()}
    arrays = {}
    for key, own in names.items():
        numbers = [pd.to_numeric(series[name], errors="coerce").to_numpy(dtype=np.float64) for name in own]
        together = np.stack(numbers, axis=1)
        arrays[key] = together[np.isfinite(together).all(axis=1)]
    return arrays


def _add_repairs(content: dict[str, Any], inspection: Inspection) -> None:
    """What had to be mended, and the way in which trials are best compared."""
    log = content["log"]
    if any(clock.duplicates for clock in inspection.clocks.values()):
        log["clock"] = {"duplicates": "drop"}
    found = [f.first if isinstance(f, InRecording) else f for f in inspection.findings]
    if any(isinstance(finding, (VelocityMismatch, VelocityUnrelated)) for finding in found):
        log["columns"] = {**log.get("columns", {}), "velocity": None}
    preprocessing: dict[str, Any] = {}
    longest = inspection.config.preprocessing.max_gap
    if any(length > longest for clock in inspection.clocks.values() for _, length in clock.gaps):
        preprocessing["segmentation"] = {"gaps": "split"}
    several = inspection.prepared is not None and sum(
        len(np.unique(trial.repetition)) for trial in inspection.prepared.trials
    ) > 1  # fmt: skip
    content["extends"] = "phase" if several else "time"
    phased = inspection.log is not None and all(trial.phase is not None for trial in inspection.log.trials)
    if several and not phased:
        preprocessing["phase"] = {"source": "path"}
        preprocessing["segmentation"] = {"trim_rest": True} | preprocessing.get("segmentation", {})
    if preprocessing:
        content["preprocessing"] = preprocessing


# --- text ----------------------------------------------------------------------------------------


def _text(
    files: Sequence[Path],
    content: Mapping[str, Any],
    inspection: Inspection,
    guessed: bool,
    remarks: Sequence[str] = (),
) -> str:
    doubt = "Names and units are guesses: check them." if guessed else "As the recording was read."
    lines = [f"Draft by bayes-impedance inspect, for {', '.join(file.name for file in files[:3])}. {doubt}"]
    listed = [*remarks, *inspection.repairs, *(finding.sentence for finding in inspection.findings)]
    lines += ["", "What looks wrong:", *(f"- {sentence}" for sentence in listed)] if listed else []
    head = "\n".join(f"# {line}".rstrip() for line in lines)
    ordered = {key: content[key] for key in ("extends", "log", "preprocessing") if content.get(key)}
    ordered |= {key: value for key, value in content.items() if value and key not in ordered}
    body = as_yaml(ordered) if ordered else "{}\n"
    return f"{head}\n\n{body}{_device(inspection)}"


def _device(inspection: Inspection) -> str:
    """The robot's law as a comment: to switch it on is for a person to decide."""
    law, log = inspection.law, inspection.log
    if law is None or log is None or inspection.config.device is not None:
        return ""
    if not law.holds or not law.mass_determined.all():
        return ""
    mass = ", ".join(f"{axis}: {value:.3g}" for axis, value in zip(log.axes, law.mass, strict=True))
    damping = ", ".join(f"{axis}: {value:.3g}" for axis, value in zip(log.axes, law.damping, strict=True))
    return (
        f"\n# The robot seems to answer force (the law explains {law.pooled:.0%} of it); if it does, by design:\n"
        f"# device: {{mass: {{{mass}}}, damping: {{{damping}}}}}\n"
    )
