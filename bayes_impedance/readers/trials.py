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
    samples, preparation = prepare_force(_trial_by_trial(sensed, config), config, axes, table.source)
    return Reading(table.source, axes, sensed, preparation, tuple(_trials(table, samples)))


def _trial_by_trial(samples: Samples, config: LogConfig) -> Samples:
    """Samples of each trial in a row, in the order of the file, where it says so without those of equal stamps."""
    codes = np.zeros(len(samples.time), dtype=np.int64)
    if "trial" in samples.labels:
        codes = pd.factorize(samples.labels["trial"])[0]
        if (np.diff(codes) < 0).any():
            order = np.argsort(codes, kind="stable")
            samples, codes = samples.at(order), codes[order]
    if config.clock.duplicates == "drop":
        same = (np.diff(samples.time, prepend=-np.inf) == 0) & (np.diff(codes, prepend=-1) == 0)
        samples = samples.at(~same) if same.any() else samples
    return samples


def _trials(table: Table, samples: Samples) -> list[Trial]:
    """One trial for each label."""
    everything = np.full(len(samples.time), table.trial or "0", dtype=object)
    codes, names = pd.factorize(samples.labels.get("trial", everything))
    trials = []
    for code, name in enumerate(names):
        own: Any = np.flatnonzero(codes == code) if len(names) > 1 else slice(None)
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
