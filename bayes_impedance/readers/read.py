"""From files to an interaction log: one function for all formats."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError
from bayes_impedance.log import InteractionLog
from bayes_impedance.readers.arrays.hdf5 import open_hdf5
from bayes_impedance.readers.arrays.matlab import open_mat
from bayes_impedance.readers.arrays.numpy_archive import open_npz
from bayes_impedance.readers.bags.messages import open_messages
from bayes_impedance.readers.cells import readable
from bayes_impedance.readers.parquet import open_parquet
from bayes_impedance.readers.table import Opened
from bayes_impedance.readers.text import open_text
from bayes_impedance.readers.trials import Reading, read_trials

#: How a file of each ending opens.
OPENERS: dict[str, Callable[[Path, str, LogConfig], Opened]] = {
    **dict.fromkeys((".csv", ".tsv", ".txt"), open_text),
    **dict.fromkeys((".parquet", ".pq"), open_parquet),
    **dict.fromkeys((".bag", ".db3", ".mcap"), open_messages),
    **dict.fromkeys((".h5", ".hdf5"), open_hdf5),
    ".mat": open_mat,
    ".npz": open_npz,
}


def read_log(
    paths: str | Path | Sequence[str | Path], config: LogConfig | None = None, *, require_force: bool = True
) -> InteractionLog:
    """Interaction log of one or several files, mapped by `config` (default: `LogConfig()`) to SI.

    Without `require_force` a file may lack force.

    Example:
        >>> import pandas as pd
        >>> cells = {"time": [0, 10, 20], "position_x": [0.10, 0.11, 0.13], "force_x": [1.5, 1.6, 1.4]}
        >>> pd.DataFrame(cells).to_csv("log.csv", index=False)
        >>> log = read_log("log.csv", LogConfig.model_validate({"units": {"time": "ms"}}))
        >>> log.trials[0].time.tolist()
        [0.0, 0.01, 0.02]

    Raises:
        LogError: names file, column and row.
    """
    config = LogConfig() if config is None else config
    files = [Path(path) for path in ([paths] if isinstance(paths, (str, Path)) else paths)]
    return as_log(
        [reading for opened in open_files(files, config) for reading in read_tables(opened, require_force)]
    )


def open_files(files: Sequence[Path], config: LogConfig) -> Iterator[Opened]:
    """Each file opened as far as the names of its columns.

    Raises:
        LogError: as `open_file` does, or a file is named twice.
    """
    if not files:
        raise LogError("expected at least one file to read, found none; name a recording")
    for file, source in zip(files, _sources(files), strict=True):
        yield open_file(file, source, config)


def read_tables(opened: Opened, require_force: bool = True) -> list[Reading]:
    """The recordings of a file, read.

    Raises:
        LogError: names file, column and row.
    """
    return [read_trials(table, opened.config, require_force) for table in opened.tables]


def as_log(readings: Sequence[Reading]) -> InteractionLog:
    """All trials of several recordings.

    Raises:
        LogError: their axes differ, or a trial is not a valid recording.
    """
    first = readings[0]
    for other in readings:
        if other.axes != first.axes:
            raise LogError(
                "expected the same axes in every file, found axes that differ between files: "
                f"{', '.join(first.axes)} in {first.source} and {', '.join(other.axes)} in {other.source}; "
                "set log.axes to those they have in common"
            )
    return InteractionLog(first.axes, tuple(trial for reading in readings for trial in reading.trials))


def _sources(files: Sequence[Path]) -> list[str]:
    """File names, with as many parent folders as it takes to tell files of one name apart."""
    resolved = [file.resolve() for file in files]
    repeated = [file for index, file in enumerate(files) if resolved[index] in resolved[:index]]
    if repeated:
        raise LogError(f"{repeated[0]}: expected each file once, found it twice; name it once")
    parts = [file.absolute().parts for file in files]
    sources = []
    for path in parts:
        namesakes = [other for other in parts if other[-1:] == path[-1:]]
        depth = 1
        while len({other[-depth:] for other in namesakes}) < len(namesakes):
            depth += 1
        sources.append("/".join(path[-depth:]))
    return sources


def open_file(file: Path, source: str, config: LogConfig) -> Opened:
    """A file opened as far as the names of its columns; errors call it `source`.

    Raises:
        LogError: it is missing, unreadable, or of no known format.
    """
    # ROS 2 records into a folder.
    recorded = file.is_dir() and (file / "metadata.yaml").is_file()
    if file.is_dir() and not recorded:
        raise LogError(f"{source}: expected a file, found a folder; name the recordings in it")
    if not file.exists():
        raise LogError(f"{source}: expected a recording, found no such file at '{file}'; check the path")
    ending = file.suffix.lower()
    if ending not in OPENERS and not recorded:
        *others, last = OPENERS
        raise LogError(
            f"{source}: expected a file that ends in {', '.join(others)} or {last}, found "
            f"{repr(file.suffix) if ending else 'no ending'}; convert it, or rename it if it is one of these"
        )
    with readable(source):
        return (open_messages if recorded else OPENERS[ending])(file, source, config)
