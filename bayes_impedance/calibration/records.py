"""What is kept of each draw: a line of JSON, appended to a file whose first line says what it is of."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bayes_impedance.config import Config
from bayes_impedance.errors import OutputError
from bayes_impedance.log import digest
from bayes_impedance.outputs import prepare_folder
from bayes_impedance.preprocessing import PreparedLog

FILE = "ranks.jsonl"


@dataclass(frozen=True)
class Record:
    """One prior draw and what sampling made of it.

    By quantity: `truth`, its `rank` among thinned draws, `z` = (truth − mean)/SD. `unsound`: what speaks against the
    draws; `failure`: why there are none.
    """

    draw: int
    truth: Mapping[str, float] = field(default_factory=dict)
    rank: Mapping[str, int] = field(default_factory=dict)
    z: Mapping[str, float] = field(default_factory=dict)
    unsound: tuple[str, ...] = ()
    failure: str | None = None


def fingerprint(config: Config, motion: PreparedLog, seed: int, thinned: int) -> dict[str, Any]:
    """All that the record of a draw depends on beside its number, as plain JSON."""
    return {
        "calibration": 1,
        "version": version("bayes-impedance"),
        "method": config.sampling.method,
        "seed": seed,
        "draws of a rank": thinned,
        "configuration": hashlib.sha256(config.model_dump_json().encode()).hexdigest(),
        "motion": digest(motion.header(), motion.arrays()),
    }


class Ledger:
    """Records in `folder`/ranks.jsonl, those of an earlier run included; without a folder they are kept in memory.

    Raises:
        OutputError: the file is of another calibration, is none, or cannot be used.
    """

    def __init__(self, folder: Path | None, identity: Mapping[str, Any]) -> None:
        self.records: dict[int, Record] = {}
        self.path = None if folder is None else folder / FILE
        if folder is None or self.path is None:
            return
        prepare_folder(folder)
        first = json.dumps(identity)
        try:
            content = self.path.read_bytes() if self.path.exists() else b""
            # What a kill tore off the end is dropped.
            whole = content[: content.rfind(b"\n") + 1]
            if not whole:
                self.path.write_text(first + "\n", encoding="utf-8")
                return
            self._read(whole.decode("utf-8", errors="replace").splitlines(), identity)
            if whole != content:
                self.path.write_bytes(whole)
        except OSError as error:
            raise _unusable(self.path, error) from error

    def keep(self, record: Record) -> None:
        """Append one.

        Raises:
            OutputError: the file takes no more.
        """
        self.records.setdefault(record.draw, record)
        if self.path is None:
            return
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(record)) + "\n")
        except OSError as error:
            raise _unusable(self.path, error) from error

    def _read(self, lines: list[str], identity: Mapping[str, Any]) -> None:
        try:
            theirs = json.loads(lines[0])
            records = [json.loads(line) for line in lines[1:]]
            for content in records:
                record = Record(**content | {"unsound": tuple(content["unsound"])})
                self.records.setdefault(record.draw, record)
            differing = [key for key in {**theirs, **identity} if theirs.get(key) != identity.get(key)]
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise OutputError(
                f"{self.path}: expected the records of a calibration, found another file ({error}); choose another "
                "--out"
            ) from error
        if differing:
            raise OutputError(
                f"{self.path}: expected the records of this calibration, found those of one with another "
                f"{' and '.join(differing)}; choose another --out, or delete the file to start anew"
            )


def _unusable(path: Path, error: OSError) -> OutputError:
    return OutputError(
        f"{path}: records of the calibration could not be kept: {error.strerror or error}; choose another --out"
    )
