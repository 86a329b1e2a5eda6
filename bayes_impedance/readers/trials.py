"""A table as trials, one for each label."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError
from bayes_impedance.log import TRUTH_COLUMN, VECTORS, RowNumbers, Trial
from bayes_impedance.readers.columns import axes_of, wanted_columns
from bayes_impedance.readers.force import Preparation, prepare_force
from bayes_impedance.readers.samples import Samples, read_samples
from bayes_impedance.readers.table import Table


@dataclass(frozen=True)
class Reading:
    """A table as it was read: `sensed`, its samples before force was prepared, what was found then, and its trials."""

    source: str
    axes: tuple[str, ...]
    sensed: Samples
    preparation: Preparation
    trials: tuple[Trial, ...]


def read_trials(table: Table, config: LogConfig, require_force: bool) -> Reading:
    """The trials of a table in SI units.

    Raises:
        LogError: names file, column and row.
    """
    axes = axes_of(table, config, require_force)
    sensed = read_samples(table, wanted_columns(table, config, axes, require_force), config)
    samples, preparation = prepare_force(sensed, config, axes, table.source)
    return Reading(table.source, axes, sensed, preparation, tuple(_trials(table, samples, config)))


def _trials(table: Table, samples: Samples, config: LogConfig) -> list[Trial]:
    """One trial for each label, its samples in the order of the file even where they lie apart."""
    everything = np.full(len(samples.time), table.trial or "0", dtype=object)
    codes, names = pd.factorize(samples.labels.get("trial", everything))
    trials = []
    for code, name in enumerate(names):
        own: Any = np.flatnonzero(codes == code) if len(names) > 1 else slice(None)
        if config.clock.duplicates == "drop":
            new = np.diff(samples.time[own], prepend=-np.inf) != 0
            own = np.arange(len(samples.time))[own][new]
        groups = list(dict.fromkeys(samples.labels["group"][own])) if "group" in samples.labels else ["0"]
        if len(groups) > 1:
            raise LogError(
                f"{table.source}, trial {name!r}: expected one group a trial, found {groups[0]!r} and "
                f"{groups[1]!r}; label trials so that no two groups share one"
            )
        # Labels as integers: an array of objects sorts and compares slowly.
        labelled = samples.labels.get("repetition")
        repetition = None if labelled is None else pd.factorize(labelled[own])[0]
        optional: dict[str, Any] = {key: samples.values[key][own] for key in VECTORS if key in samples.values}
        if "phase" in samples.values:
            optional["phase"] = samples.values["phase"][own, 0]
        truth = {key: value[own, 0] for key, value in samples.values.items() if TRUTH_COLUMN.fullmatch(key)}
        trials.append(
            Trial(
                name=str(name),
                group=str(groups[0]),
                source=table.source,
                time=samples.time[own],
                repetition=repetition,  # type: ignore[arg-type]
                truth=truth,
                rows=RowNumbers(samples.rows.word, samples.rows.numbers[own]),
                **optional,
            )
        )
    return trials
