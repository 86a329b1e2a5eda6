"""Fixtures for every test."""

import re
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from oracles import TRUTH

from bayes_impedance.config import Config, load_config, parse_config
from bayes_impedance.errors import BayesImpedanceWarning
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.persistence import save_model
from bayes_impedance.readers import read_log
from bayes_impedance.simulation.generative import as_recording, draw_force, repeated_motion
from bayes_impedance.writer import write_log

#: `phase` with so little of everything that training takes a blink.
TINY = (
    "preprocessing.smoother.window=0.14",
    "preprocessing.rate=10",
    "model.desired_trajectory.average_knots=2",
    "training.restarts=1",
    "training.max_iterations=3",
)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real recordings; skips where they are absent."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real recordings are not at hand: no folder {folder}")
    return folder


@pytest.fixture
def full_disk() -> Callable[..., AbstractContextManager[None]]:
    """Within `with full_disk():` no file grows beyond 4 kB, or what is asked for; that stands in for a full disk."""
    resource = pytest.importorskip("resource", reason="limits of file size are for Unix")

    @contextmanager
    def limited(size: int = 4096) -> Iterator[None]:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        # Python ignores the signal that comes with it.
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    return limited


@dataclass(frozen=True)
class Tiny:
    """A tiny experiment: two repetitions in `log`, a third in `other`, and a model of the first two.

    Shared by all tests: copy what you want to change.
    """

    log: Path
    other: Path
    model: Path
    config: Config
    fitted: ImpedanceModel

    @property
    def settings(self) -> list[str]:
        """Arguments that make `train` fast."""
        return ["--config", "phase", *(argument for item in TINY for argument in ("--set", item))]


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Tiny:
    """Logs and model of a tiny experiment, axes x and y, truth included."""
    folder = tmp_path_factory.mktemp("tiny")
    motion = repeated_motion(repetitions=3, duration=2.0, rate=50.0, seed=3)
    log = as_recording(draw_force(parse_config(TRUTH), motion, seed=3), keep_reference=True)
    write_log(log.select([0, 1]), folder / "log.csv")
    write_log(log.select([2]), folder / "other.csv")
    config = load_config("phase", TINY)
    fitted = ImpedanceModel(config).fit(read_log(folder / "log.csv", config.log))
    save_model(fitted, folder / "model")
    return Tiny(folder / "log.csv", folder / "other.csv", folder / "model", config, fitted)


@dataclass(frozen=True)
class Outcome:
    """How a command ended."""

    code: int
    out: str
    err: str


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """The command line in this process: `command("train", log, …)` gives code, stdout and stderr."""
    from bayes_impedance.cli import main

    # Colours and a terminal that pytest may run in are none of our business.
    for name in ("FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)

    def run(*arguments: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["bayes-impedance", *map(str, arguments)])
        capsys.readouterr()
        code = 0
        with warnings.catch_warnings():
            # A command prints our warnings; elsewhere in the tests they are errors like any other.
            warnings.simplefilter("default", BayesImpedanceWarning)
            try:
                main()
            except SystemExit as exit_:
                code = int(exit_.code or 0)
        captured = capsys.readouterr()
        out, err = (re.sub(r"\x1b\[[0-9;]*m", "", text) for text in captured)
        return Outcome(code, out, err)

    return run
