"""Collects what each benchmark measured, prints it, and writes benchmarks/results.json."""

from __future__ import annotations

import json
import platform
from importlib.metadata import version
from pathlib import Path

import pytest

FIGURES: dict[str, dict[str, float]] = {}


@pytest.fixture
def figures() -> dict[str, dict[str, float]]:
    """Name of a comparison → what was measured."""
    return FIGURES


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for name, values in FIGURES.items():
        listed = ", ".join(f"{key} {value:.4g}" for key, value in values.items())
        terminalreporter.write_line(f"{name}: {listed}")


def pytest_sessionfinish(exitstatus: int) -> None:
    if exitstatus != 0 or not FIGURES:
        return
    path = Path(__file__).with_name("results.json")
    earlier = json.loads(path.read_text(encoding="utf-8"))["figures"] if path.is_file() else {}
    record = {
        "command": "make bench",
        "versions": {name: version(name) for name in ("bayes-impedance", "torch", "gpytorch", "numpy")},
        "machine": {"processor": platform.machine(), "python": platform.python_version()},
        "figures": earlier | FIGURES,
    }
    path.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
