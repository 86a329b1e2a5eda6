"""Five thousand generated inputs through the commands: no traceback, no warning of a library, nothing half written.

Each case (tests/strategies.py) is a configuration, a recording to train on and another to infer and to score, some of
them valid, most of them mutilated. `make faults` writes what became of them to results/faults.json.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import multiprocessing
import re
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from unittest import mock

import pandas as pd
from hypothesis import HealthCheck, Phase, given, seed, settings

from bayes_impedance import cli
from bayes_impedance.errors import BayesImpedanceWarning
from tests.strategies import Case, cases

OUTPUT = Path(__file__).resolve().parent.parent / "results" / "faults.json"
COUNT, SEEDS = 5000, 20
#: A case that takes longer hangs [s].
PATIENCE = 60

#: So that an accepted case takes a blink.
QUICK = ("training.restarts=1", "training.max_iterations=1")


class Hang(BaseException):
    """A case did not end."""


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
        ]
        if not case.baseline:
            endings.append(checked(run("show", model), folder, None))
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


@dataclass
class Tally:
    """What became of the cases of one seed."""

    generated: int = 0
    commands: Counter[str] = field(default_factory=Counter)
    refusals: Counter[str] = field(default_factory=Counter)
    bugs: dict[str, int] = field(default_factory=Counter)
    slowest: float = 0.0

    def add(self, other: Tally) -> None:
        """Count the cases of another seed in."""
        self.generated += other.generated
        self.commands += other.commands
        self.refusals += other.refusals
        self.bugs = Counter(self.bugs) + Counter(other.bugs)
        self.slowest = max(self.slowest, other.slowest)


def tally(number: int, count: int) -> Tally:
    """Follow `count` cases that are generated from one seed."""
    total = Tally()

    @seed(number)
    @settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(cases())
    def every(case: Case) -> None:
        start = time.perf_counter()
        total.generated += 1
        try:
            with _patience():
                endings = follow(case)
        except (Exception, Hang):
            # A bug: all are counted, and the first of a kind is shown.
            place = traceback.extract_tb(sys.exc_info()[2])[-1]
            bug = f"{Path(place.filename).name}:{place.lineno} {sys.exc_info()[1]!r:.200}"
            if bug not in total.bugs:
                print(f"seed {number}:", traceback.format_exc()[-3000:], case, file=sys.stderr, flush=True)
            total.bugs[bug] += 1
            return
        total.slowest = max(total.slowest, time.perf_counter() - start)
        for ending in endings:
            total.commands[f"{ending.command} {'refused' if ending.code else 'accepted'}"] += 1
            if ending.error is not None:
                total.refusals[f"{ending.command}: {ending.error}"] += 1

    every()
    return total


def main() -> None:
    """Run them all, a process for each core, and write the committed JSON."""
    total, start = Tally(), time.perf_counter()
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        for part in as_completed([pool.submit(tally, number, COUNT // SEEDS) for number in range(SEEDS)]):
            total.add(part.result())
            print(
                f"{total.generated} in {time.perf_counter() - start:.0f} s: {dict(total.commands)}",
                flush=True,
            )
    for bug, times in total.bugs.items():
        print(f"{times} × {bug}", file=sys.stderr)
    if total.bugs:
        sys.exit(1)
    packages = ("bayes-impedance", "hypothesis", "numpy", "pandas", "torch")
    record = {
        "command": "make faults",
        "seeds": list(range(SEEDS)),
        "versions": {package: version(package) for package in packages},
        "generated": total.generated,
        "tracebacks": sum(total.bugs.values()),
        "commands": dict(sorted(total.commands.items())),
        "refusals": dict(sorted(total.refusals.items())),
        "slowest_seconds": round(total.slowest, 1),
    }
    OUTPUT.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(record, indent=2))


if __name__ == "__main__":
    main()
