"""Committed results: what computed them, with which seed and versions."""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

Results = dict[str, Any]

ROOT = Path(__file__).resolve().parent.parent
#: Real recordings; absent on most machines.
RECORDINGS = ROOT.parent / "shared" / "data"


def committed(name: str) -> Results:
    """The figures of `results/<name>.json`; none where there is no such file yet."""
    path = ROOT / "results" / f"{name}.json"
    figures: Results = json.loads(path.read_text(encoding="utf-8"))["figures"] if path.is_file() else {}
    return figures


def commit(name: str, seed: int, figures: Results) -> None:
    """Write `figures` to `results/<name>.json`, with command, seed and versions."""
    versions = {
        package: version(package) for package in ("bayes-impedance", "torch", "gpytorch", "pyro-ppl", "numpy")
    }
    record = {"command": "make results", "seed": seed, "versions": versions, "figures": figures}
    path = ROOT / "results" / f"{name}.json"
    path.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    print(f"wrote {path.relative_to(ROOT)}")
