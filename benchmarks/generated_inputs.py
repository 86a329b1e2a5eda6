"""Five thousand generated inputs through the commands: no traceback, no warning of a library, nothing half written.

Each case (tests/strategies.py) is a configuration, a recording to train on and another to infer and to score, some of
them valid, most of them mutilated. `make faults` writes what became of them to results/faults.json.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import re
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from unittest import mock

import pandas as pd
from hypothesis import HealthCheck, Phase, given, seed, settings

from bayes_impedance import cli
from bayes_impedance.errors import BayesImpedanceWarning
from tests.strategies import Case, cases

OUTPUT = Path(__file__).resolve().parent.parent / "results" / "faults.json"
COUNT, SEED = 5000, 0
#: A command that takes longer hangs [s].
PATIENCE = 60

#: So that an accepted case takes a blink.
QUICK = ("training.restarts=1", "training.max_iterations=1")


class Hang(BaseException):
    """A command did not end."""


@dataclass(frozen=True)
class Ending:
    """How a command ended: exit code, what it said, and the class of the error that it refused with."""

    command: str
    code: int
    out: str
    err: str
    error: str | None


def run(*arguments: object) -> Ending:
    """A command in this process; warnings that are not ours are errors."""
    out, err = io.StringIO(), io.StringIO()
    error: str | None = None
    refuse = cli._refuse

    def noted(message: str) -> None:
        nonlocal error
        error = type(sys.exception()).__name__
        refuse(message)

    code = 0
    show = warnings.showwarning
    with (
        mock.patch.object(sys, "argv", ["bayes-impedance", *map(str, arguments)]),
        mock.patch.object(cli, "_refuse", noted),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        warnings.catch_warnings(),
        _patience(),
    ):
        warnings.simplefilter("error")
        warnings.simplefilter("default", BayesImpedanceWarning)
        try:
            cli.main()
        except SystemExit as exit_:
            code = int(exit_.code or 0)
        finally:
            warnings.showwarning = show
    return Ending(str(arguments[0]), code, out.getvalue(), err.getvalue(), error)


@contextlib.contextmanager
def _patience() -> Iterator[None]:
    def ring(*_: object) -> None:
        raise Hang

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(PATIENCE)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def follow(case: Case) -> list[Ending]:
    """Train, and where that goes well infer, evaluate and show; every ending is checked."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config, log, other = folder / "mine.yaml", folder / case.log.name, folder / f"other-{case.other.name}"
        for path, content in (
            (config, case.config),
            (log, case.log.content),
            (other, case.other.content),
        ):
            path.write_bytes(content)
        model, posterior, scores = folder / "model", folder / "posterior.csv", folder / "scores.json"
        changes = [part for item in (*case.overrides, *QUICK) for part in ("--set", item)]
        endings = [checked(run("train", log, "--config", config, *changes, "--out", model), folder, model)]
        if endings[0].code:
            return endings
        baseline = ["--baseline", "naive"] if case.baseline else []
        endings += [
            checked(run("infer", model, other, "--out", posterior), folder, posterior),
            checked(run("evaluate", model, other, "--json", scores, *baseline), folder, scores),
            checked(run("show", model), folder, None),
        ]
        if posterior.exists():
            numbers = pd.read_csv(posterior, dtype={"trial": str, "group": str}).select_dtypes("number")
            assert numbers.map(math.isfinite).all(axis=None), "a posterior that is not finite"
        if scores.exists():
            json.loads(scores.read_text(encoding="utf-8"), parse_constant=_no_number)
        return endings


def _no_number(text: str) -> float:
    raise AssertionError(f"a score is {text}")


def checked(ending: Ending, folder: Path, output: Path | None) -> Ending:
    """Exit code 0 with output, or 2 with one sentence and none."""
    assert "Traceback" not in ending.err, ending
    assert ending.code in (0, 2), ending
    said = [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in ending.err.splitlines()]
    refusals = [line for line in said if not line.startswith("warning: ")]
    if ending.code:
        assert len(refusals) == 1, ending
        assert refusals[0].startswith("error: "), ending
        assert output is None or not output.exists(), ending
    else:
        assert not refusals, ending
        assert output is None or output.exists(), ending
    assert {
        path.name for path in folder.iterdir() if path.name.startswith(".") or ".journal" in path.name
    } == set()
    return ending


def main() -> None:
    """Run them all and write the committed JSON."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else COUNT
    endings: Counter[str] = Counter()
    errors: Counter[str] = Counter()
    bugs: Counter[str] = Counter()
    slowest = 0.0
    start = time.perf_counter()

    @seed(SEED)
    @settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(cases())
    def every(case: Case) -> None:
        nonlocal slowest
        begun = time.perf_counter()
        endings["generated"] += 1
        try:
            found = follow(case)
        except (Exception, Hang):
            # Each is a bug; all are counted, and one of each kind is shown.
            where = traceback.extract_tb(sys.exc_info()[2])[-1]
            bugs[f"{where.filename}:{where.lineno} {sys.exc_info()[1]!r:.200}"] += 1
            if bugs.total() == len(bugs):
                traceback.print_exc()
            return
        slowest = max(slowest, time.perf_counter() - begun)
        for ending in found:
            endings[f"{ending.command} {'refused' if ending.code else 'accepted'}"] += 1
            if ending.error is not None:
                errors[f"{ending.command}: {ending.error}"] += 1
        if endings["generated"] % 100 == 0:
            print(
                f"{endings['generated']} in {time.perf_counter() - start:.0f} s: {dict(endings)}", flush=True
            )

    every()
    packages = ("bayes-impedance", "hypothesis", "numpy", "pandas", "torch")
    record = {
        "command": "make faults",
        "seed": SEED,
        "versions": {package: version(package) for package in packages},
        "generated": endings.pop("generated"),
        "tracebacks": bugs.total(),
        "commands": dict(sorted(endings.items())),
        "refusals": dict(sorted(errors.items())),
        "slowest_seconds": round(slowest, 1),
    }
    if bugs:
        print(*(f"{count} × {bug}" for bug, count in bugs.most_common()), sep="\n", file=sys.stderr)
        sys.exit(1)
    OUTPUT.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(record, indent=2))


if __name__ == "__main__":
    main()
