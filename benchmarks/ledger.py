"""What a long computation has finished, kept so that one that was killed goes on from there."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.results import ROOT

#: What figures depend on; where any of it has changed nothing finished counts.
SOURCES = ("bayes_impedance/**/*.py", "configs/**/*.yaml", "benchmarks/*.py")


T = TypeVar("T")


class Ledger:
    """Figures of finished jobs by name, in a file of the folder for temporary files."""

    def __init__(self, name: str, folder: Path | None = None, digest: str | None = None) -> None:
        self.path = (folder or Path(tempfile.gettempdir())) / f"bayes_impedance-{name}.json"
        self._digest = digest or _digest()
        self._finished: dict[str, Any] = {}
        if self.path.is_file():
            record = json.loads(self.path.read_text(encoding="utf-8"))
            self._finished = record["finished"] if record["digest"] == self._digest else {}

    def run(self, name: str, job: Callable[[], T]) -> T:
        """Plain figures of a job, computed unless they are known."""
        if name not in self._finished:
            self._finished[name] = job()
            written = self.path.with_suffix(".new")
            record = {"digest": self._digest, "finished": self._finished}
            written.write_text(json.dumps(record), encoding="utf-8")
            written.replace(self.path)
            print(name, flush=True)
        figures: T = self._finished[name]
        return figures

    def close(self) -> None:
        """All is done: forget it."""
        self.path.unlink(missing_ok=True)


def _digest() -> str:
    digest = hashlib.sha256()
    for path in _sources():
        digest.update(path.relative_to(ROOT).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def _sources() -> Iterator[Path]:
    for pattern in SOURCES:
        yield from sorted(ROOT.glob(pattern))
