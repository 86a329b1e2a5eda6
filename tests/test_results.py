"""One entry of each committed result is computed again."""

import json
from pathlib import Path

import pytest

from benchmarks.core_results import configuration_of, coverage_of, demo, known_equilibrium

COMMITTED = json.loads(
    (Path(__file__).resolve().parent.parent / "results" / "core.json").read_text(encoding="utf-8")
)


def test_provenance_is_stated() -> None:
    assert COMMITTED["command"] == "make results"
    assert "bayes-impedance" in COMMITTED["versions"]


def test_known_equilibrium(shared_data: Path) -> None:
    committed, now = COMMITTED["figures"]["known_equilibrium"], known_equilibrium()
    assert now["stiffness"]["mean"] == pytest.approx(committed["stiffness"]["mean"], rel=1e-3)
    assert abs(now["relative_difference"]) < 0.05
    assert now["log_likelihood"] > now["reference_one_second_late"]["log_likelihood"] + 10
    assert now["residual_rms"] < now["reference_one_second_late"]["residual_rms"]


def test_coverage() -> None:
    committed = COMMITTED["figures"]["coverage"]["time"]
    assert coverage_of(configuration_of("time"), range(committed["draws"]))["force"] == pytest.approx(
        committed["force"], abs=2e-3
    )


def test_demo() -> None:
    committed, now = COMMITTED["figures"]["demo"], demo()
    for name, error in committed["mean_relative_error"].items():
        assert now["mean_relative_error"][name] == pytest.approx(error, abs=0.01)
