"""Tables and logs as files, .csv or .parquet, which the reader of tables takes back."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from bayes_impedance.errors import OutputError
from bayes_impedance.log import VECTORS, InteractionLog
from bayes_impedance.outputs import whole_file


def check_table_name(path: Path) -> None:
    """Refuse a file name whose ending stands for no format.

    Raises:
        OutputError: it ends neither in .csv nor in .parquet.
    """
    if path.suffix not in (".csv", ".parquet"):
        raise OutputError(
            f"{path}: expected a file name ending in .csv or .parquet, got '{path.suffix}'; rename it"
        )


def write_table(table: pd.DataFrame, path: Path) -> None:
    """Write a table whole or not at all, in the format that its name ends in.

    Raises:
        OutputError: the name has another ending, or the file cannot be written.
    """
    check_table_name(path)
    with whole_file(path) as temporary:
        if path.suffix == ".csv":
            table.to_csv(temporary, index=False)
        else:
            table.to_parquet(temporary, index=False)


def write_log(log: InteractionLog, path: Path) -> None:
    """Write a log with the default column names, truth included.

    Raises:
        OutputError: as `write_table` does.
    """
    frames = []
    for trial in log.trials:
        columns: dict[str, object] = {"trial": trial.name, "group": trial.group, "time": trial.time}
        if trial.phase is not None:
            columns |= {"repetition": trial.repetition, "phase": trial.phase}
        for name in VECTORS:
            values = getattr(trial, name)
            if values is not None:
                columns |= {f"{name}_{axis}": values[:, a] for a, axis in enumerate(log.axes)}
        columns |= trial.truth
        frames.append(pd.DataFrame(columns))
    write_table(pd.concat(frames), path)
