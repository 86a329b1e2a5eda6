"""Bad input through the command line: one sentence that says what, where and how to mend it; nothing is written.

Each case is a function of a Bench (tiny logs, a trained model, an empty folder) that gives the arguments, and the
regular expressions that the sentence must match.
"""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bayes_impedance.errors import ConfigurationError, LogError
from bayes_impedance.log import InteractionLog
from bayes_impedance.persistence import METADATA
from bayes_impedance.readers import read_log
from conftest import Tiny

Arguments = list[object]


@dataclass(frozen=True)
class Bench:
    """What a case is built from."""

    log: Path
    other: Path
    trained: Path
    settings: list[str]
    folder: Path

    @property
    def out(self) -> Path:
        return self.folder / "out"

    def table(self) -> pd.DataFrame:
        return pd.read_csv(self.log)

    def write(self, table: pd.DataFrame, name: str = "bad.csv") -> Path:
        table.to_csv(self.folder / name, index=False)
        return self.folder / name

    def text(self, content: str | bytes, name: str = "bad.csv") -> Path:
        path = self.folder / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    def train(self, *logs: Path, settings: tuple[str, ...] = (), config: str | None = None) -> Arguments:
        """`train` on these logs, or on the good one."""
        chosen = self.settings if config is None else ["--config", config]
        changes = [part for item in settings for part in ("--set", item)]
        return ["train", *(logs or (self.log,)), *chosen, *changes, "--out", self.out]

    def infer(self, *logs: Path, model: Path | None = None, out: Path | None = None) -> Arguments:
        return [
            "infer",
            model or self.trained,
            *(logs or (self.other,)),
            "--out",
            out or self.folder / "out.csv",
        ]

    def evaluate(self, *arguments: object) -> Arguments:
        return ["evaluate", self.trained, *arguments, "--json", self.folder / "out.json"]

    def model(self) -> Path:
        """A model folder to spoil."""
        return Path(shutil.copytree(self.trained, self.folder / "model"))


@pytest.fixture
def bench(tiny, tmp_path):
    return Bench(tiny.log, tiny.other, tiny.model, tiny.settings, tmp_path)


def changed(**columns: object) -> Callable[[Bench], Arguments]:
    """Training on the good log with some columns replaced: a constant, or a function of the column."""

    def arrange(bench: Bench) -> Arguments:
        table = bench.table()
        for name, value in columns.items():
            table[name] = value(table[name].to_numpy(copy=True)) if callable(value) else value
        return bench.train(bench.write(table))

    return arrange


def put(value: float, *rows: int) -> Callable[[np.ndarray], np.ndarray]:
    """Function that puts `value` into these rows of a column."""

    def replace(column: np.ndarray) -> np.ndarray:
        column[list(rows)] = value
        return column

    return replace


def without(*names: str, settings: tuple[str, ...] = ()) -> Callable[[Bench], Arguments]:
    return lambda bench: bench.train(bench.write(bench.table().drop(columns=list(names))), settings=settings)


def text(content: str | bytes, name: str = "bad.csv") -> Callable[[Bench], Arguments]:
    return lambda bench: bench.train(bench.text(content, name))


def configured(*settings: str) -> Callable[[Bench], Arguments]:
    return lambda bench: bench.train(settings=settings)


def misspelt(bench: Bench) -> Arguments:
    table = bench.table().rename(columns={"position_x": "positon_x"})
    return bench.train(bench.write(table), settings=("log.axes=[x, y]",))


def decimal_comma(bench: Bench) -> Arguments:
    table = bench.table().astype({"force_x": str})
    table.loc[4, "force_x"] = "4,2"
    return bench.train(bench.write(table))


def other_axes(bench: Bench) -> Arguments:
    narrow = bench.write(bench.table().drop(columns=["position_y", "force_y", "reference_y"]), "narrow.csv")
    return bench.train(bench.log, narrow)


def fewer_axes(bench: Bench) -> Arguments:
    return bench.infer(bench.write(bench.table().drop(columns=["position_y", "force_y", "reference_y"])))


def one_sample(bench: Bench) -> Arguments:
    return bench.train(bench.write(bench.table().iloc[:1]))


def hole(bench: Bench) -> Arguments:
    table = bench.table()
    return bench.train(bench.write(table.drop(index=range(20, 60))))


def three_years(bench: Bench) -> Arguments:
    table = bench.table()
    table.loc[99, "time"] = 1e8
    return bench.train(bench.write(table), settings=("preprocessing.max_gap=1e9",))


def unseen_group(bench: Bench) -> Arguments:
    return bench.infer(bench.write(bench.table().assign(group="left arm")))


def no_force(given: str) -> Callable[[Bench], Arguments]:
    def arrange(bench: Bench) -> Arguments:
        bare = bench.write(bench.table().drop(columns=["force_x", "force_y"]))
        if given == "evaluate":
            return ["evaluate", bench.trained, bare, "--json", bench.folder / "out.json"]
        return [*bench.infer(bare), "--given", given]

    return arrange


def booleans(bench: Bench) -> Arguments:
    path = bench.folder / "bad.parquet"
    bench.table().assign(force_x=True).to_parquet(path)
    return bench.train(path)


def no_model(bench: Bench) -> Arguments:
    return bench.infer(model=bench.folder / "model")


def truncated_model(bench: Bench) -> Arguments:
    model = bench.model()
    (model / "data.safetensors").unlink()
    return bench.infer(model=model)


def truncated_metadata(bench: Bench) -> Arguments:
    metadata = bench.model() / METADATA
    metadata.write_bytes(metadata.read_bytes()[:100])
    return ["show", metadata.parent]


def newer_model(bench: Bench) -> Arguments:
    metadata = bench.model() / METADATA
    content = json.loads(metadata.read_text()) | {"schema_version": 2, "package_version": "3.0"}
    metadata.write_text(json.dumps(content))
    return bench.infer(model=metadata.parent)


def changed_model(bench: Bench) -> Arguments:
    path = bench.model() / "config.yaml"
    path.write_text(path.read_text().replace("max_samples: 4000", "max_samples: 9000"))
    return ["evaluate", path.parent, bench.other]


def other_folder(bench: Bench) -> Arguments:
    bench.out.mkdir()
    (bench.out / "thesis.tex").write_text("years of work")
    return bench.train()


def file_in_the_way(bench: Bench) -> Arguments:
    bench.out.write_text("mine")
    return bench.train()


def below_a_file(name: str) -> Callable[[Bench], Arguments]:
    def arrange(bench: Bench) -> Arguments:
        place = bench.text("", "file") / name
        if name == "scores.json":
            return ["evaluate", bench.trained, bench.other, "--json", place]
        if name == "figures":
            return [*bench.infer(), "--figures", place]
        if name == "demo":
            return ["demo", "--out", place]
        if name == "p.csv":
            return bench.infer(out=place)
        return [*bench.train()[:-1], place]

    return arrange


#: At rest and pushed evenly: samples that are all alike, with noise far below rounding.
SINGULAR = ("engine.jitter=0", "model.noise_sd=1e-9", "preprocessing.rate=50")

CASES: dict[str, tuple[Callable[[Bench], Arguments], tuple[str, ...]]] = {
    # --- columns
    "missing column": (
        without("force_x", settings=("log.axes=[x, y]",)),
        (r"bad\.csv: expected column 'force_x', found none", "nearest is 'force_y'", r"set log\.columns\.force "),
    ),
    "missing columns": (
        without("force_x", "force_y"),
        (r"bad\.csv: expected column 'force_x', found none", r"set log\.columns\.force to the name in the file"),
    ),
    "misspelt column": (
        misspelt,
        (r"bad\.csv: expected column 'position_x'", "the nearest is 'positon_x'", r"set log\.columns\.position"),
    ),
    "missing time": (without("time"), (r"bad\.csv: expected column 'time'", r"set log\.columns\.time")),
    # --- files
    "no file": (
        lambda bench: bench.train(bench.folder / "nothing.csv"),
        (r"nothing\.csv: expected a recording, found no such file at '.*nothing\.csv'; check the path",),
    ),
    "folder": (lambda bench: bench.train(bench.folder), ("expected a file, found a folder; name the recordings",)),
    "name too long": (lambda bench: bench.train(Path("a" * 300 + ".csv")), ("a{300}.csv: .*File name too long",)),
    "unknown ending": (
        text("time", "bad.xlsx"),
        (r"bad\.xlsx: expected a file that ends in .*, found '\.xlsx'; convert",),
    ),
    "same file twice": (
        lambda bench: bench.train(bench.log, bench.log),
        (r"log\.csv: .*found it twice; name it once",),
    ),
    "empty file": (text(""), (r"bad\.csv: expected a header line and samples, found an empty file; record",)),
    "header only": (
        text("time,position_x,force_x\n"),
        (r"bad\.csv: expected samples below the header line, found none; record or export",),
    ),
    "binary file": (
        text(bytes(range(256))),
        (r"bad\.csv: expected text in UTF-8, found byte 0x80 at position 128; save it as UTF-8, or rename it",),
    ),
    "binary file with zeros": (text(b"PK\0\0\0"), (r"bad\.csv: expected text, found binary data; rename",)),
    "not a Parquet file": (
        text("time,position_x\n", "bad.parquet"),
        (
            r"bad\.parquet: expected a Parquet file",
            r"found one that is truncated or something else \(.*\); write it anew",
        ),
    ),
    # --- samples
    "NaN": (
        changed(force_x=put(np.nan, 3, 17)),
        (
            r"bad\.csv, column 'force_x': expected finite numbers",
            r"found nan or an empty cell at lines 5, 19; fill or",
        ),
    ),
    "many NaN": (
        changed(position_y=put(np.nan, *range(10, 30))),
        (r"column 'position_y': .* at lines 12, 13, 14 and 17 more; fill or remove these samples",),
    ),
    "infinity": (
        changed(position_x=put(np.inf, 0)),
        (r"bad\.csv, column 'position_x': expected finite numbers, found inf .* at line 2; fill or remove",),
    ),
    "text for a number": (
        decimal_comma,
        (r"bad\.csv, column 'force_x': expected numbers, found '4,2' at line 6; write decimals with a point",),
    ),
    "time going back": (
        changed(time=put(0.5, 40)),
        (
            r"bad\.csv, trial '0', column time: expected time to increase",
            r"but time goes back at line 42 \(from 0\.78 to 0\.5 s\); sort the rows",
        ),
    ),
    "duplicate stamps": (
        changed(time=put(0.78, 40)),
        (
            r"bad\.csv, trial '0', column time: .*found duplicate time stamps at line 42 \(0\.78 s\)",
            r"keep one sample",
        ),
    ),
    "one sample": (
        one_sample,
        (r"bad\.csv, trial '0': expected at least two samples, found one sample; leave the trial out",),
    ),
    "too short for the smoother": (
        lambda bench: bench.train(bench.write(bench.table().iloc[:5])),
        (
            r"bad\.csv, trial '0': expected at least 7 samples, one window of the smoother \(0\.14 s\)",
            r"found 5; shorten preproc",
        ),
    ),
    "constant position": (
        changed(position_y=0.25),
        (
            r"bad\.csv: expected motion along axis y",
            r"found position_y = 0\.25 m throughout: .*; drop y from log\.axes",
        ),
    ),
    "no force felt": (
        changed(force_x=0.0),
        (
            r"bad\.csv: expected interaction force along axis x",
            r"found force_x = 0 throughout; check log\.columns\.force",
        ),
    ),
    "gap": (
        hole,
        (
            r"bad\.csv, trial '0': expected steps of at most 0\.5 s, found a gap of 0\.82 s from 0\.38 to 1\.2 s",
            r"cut there with log\.window, or raise preprocessing\.max_gap",
        ),
    ),
    "gap of three years that is allowed": (
        three_years,
        (
            r"bad\.csv, trial '0': expected a log without long gaps, found 100 samples that would have to be",
            r"filled up to 5e\+09 at steps of 0\.02 s; cut the gaps with log\.window, or lower preprocessing\.max_gap",
        ),
    ),
    "rate above the native one": (
        configured("preprocessing.rate=500"),
        (
            r"log\.csv, trial '0': expected preprocessing\.rate of at most the native rate, 50 Hz",
            r"found 500 Hz; lower it",
        ),
    ),
    "window of the smoother beyond all time": (
        configured("preprocessing.smoother.window=1e300"),
        (r"log\.csv, trial '0': expected at least 2000000001 samples, one window of the smoother \(4e\+07 s\)",),
    ),
    "rate that leaves one sample": (
        configured("preprocessing.rate=1e-320", "model.desired_trajectory.average_knots=1"),
        (r"group '0': expected samples between any two of the 1 knots of the trial average", "among 2 samples"),
    ),
    "nothing in the window": (
        configured("log.window.start=100"),
        (r"log\.csv: expected samples within log\.window \(start 100.*spans 0 to 1\.98 s; change log\.window",),
    ),
    "phase out of range": (
        changed(phase=lambda phase: 100 * phase),
        (r"bad\.csv, trial '0', column phase: expected values between 0 and 1, found 1\.\d+ at lines", "divide by"),
    ),
    "phase that rests": (
        changed(phase=put(0.2, 30, 31)),
        (
            r"bad\.csv, trial '0', column phase: expected phase to increase strictly within a repetition",
            r"found 0\.2 .*; label repetitions .*, and cut pauses",
        ),
    ),
    "booleans for numbers": (
        booleans,
        (r"bad\.parquet, column 'force_x': expected numbers, found 'True' at row 1, of type bool; convert the column",),
    ),
    "forces beyond all numbers": (
        changed(force_x=lambda force: 1e200 * force),
        (r"expected a finite likelihood of the forces, found one that overflows, .*; check log\.units, and that",),
    ),
    # --- axes and columns that the model needs
    "axes that differ between files": (
        other_axes,
        (r"found axes that differ between files: x, y in log\.csv and x in narrow\.csv; set log\.axes to those",),
    ),
    "axes that differ from the model's": (
        fewer_axes,
        ("expected a log with axes x, y, on which the model was trained, got x; set log.axes",),
    ),
    "no phase": (
        without("phase"),
        (
            r"bad\.csv, trial 0: expected a phase column, found none",
            r"name it in log\.columns\.phase, set preprocessing\.phase\.source to path or warping, or choose another",
        ),
    ),
    "no reference": (
        without("reference_x", "reference_y", settings=("model.desired_trajectory.mean=reference",)),
        (
            r"bad\.csv, trial 0: expected a reference column for desired_trajectory\.mean: reference",
            r"found none; name it",
        ),
    ),
    "equilibrium over repetitions": (
        configured("model.desired_trajectory.mean=equilibrium"),
        (
            r"desired_trajectory\.mean: expected trial_average, reference or constant with trajectory_input: phase",
            r"got equilibrium with 2 repetitions in group '0'",
            r"set model\.desired_trajectory\.mean=trial_average",
        ),
    ),
    "group that was not trained on": (
        unseen_group,
        (
            r"bad\.csv, trial 0: expected a group among the training groups \(0\), .*, got group 'left arm'",
            r"train on a trial",
        ),
    ),
    "constant without an axis": (
        configured("model.desired_trajectory.mean=constant", "model.desired_trajectory.value={x: 0.1}"),
        (r"desired_trajectory\.value: expected a position \[m\] for each of x, y, found none for y; add it",),
    ),
    "more knots than samples": (
        configured("model.desired_trajectory.average_knots=500"),
        (
            r"group '0': expected samples between any two of the 500 knots of the trial average over phase",
            r"found an empty stretch among 40 samples; lower desired_trajectory\.average_knots",
        ),
    ),
    "no force to condition on": (no_force("log"), (r"bad\.csv: expected column 'force_x', found none",)),
    "no force to score": (no_force("evaluate"), (r"bad\.csv: expected column 'force_x'", r"set log\.columns\.force")),
    # --- configuration
    "unknown configuration": (
        lambda bench: bench.train(config="fase"),
        ("found neither at 'fase'; did you mean 'phase'",),
    ),
    "unknown key": (
        configured("training.restart=2"),
        (r"--set training\.restart=2: unknown key 'training\.restart'; did you mean 'restarts'\?",),
    ),
    "unknown key in a file": (
        lambda bench: bench.train(config=str(bench.text("model:\n  stifness: {level: 300}\n", "mine.yaml"))),
        (r"mine\.yaml: unknown key 'model\.stifness'; did you mean 'stiffness'\?",),
    ),
    "broken file": (
        lambda bench: bench.train(config=str(bench.text("model: [", "mine.yaml"))),
        (r"mine\.yaml: expected YAML, got: .*line 1, column 9",),
    ),
    "value out of range": (
        configured("training.restarts=0"),
        (r"training\.restarts: expected a valid value \(input should be greater than or equal to 1\), got 0",),
    ),
    "median beyond any unit": (
        configured("model.noise_sd=1e300"),
        (r"model\.noise_sd: median: expected between 1e-30 and 1e\+30, got 1e\+300; check its unit",),
    ),
    "too wide a log-normal": (
        configured("model.stiffness.log_sd=2"),
        (r"model\.stiffness: log_sd: expected at most 0\.5 .*widen the hyperprior of level instead\), got 2",),
    ),
    "override of a wrong form": (
        configured("training.restarts"),
        (r"--set: expected KEY=VALUE such as training\.restarts=5",),
    ),
    # --- engine
    "too many samples": (
        configured("engine.max_samples=30"),
        (
            r"group '0': expected at most engine\.max_samples = 30 samples .*, got 40,",
            r"would need about [\d.]+ GB and [\d.]+ s an evaluation",
            r"set preprocessing\.rate to thin the log, cut it with log\.window, or raise engine\.max_samples",
        ),
    ),
    "covariance that is not positive definite": (
        configured(*SINGULAR),
        (
            r"the covariance of 200 forces is not positive definite at row \d+",
            r"with jitter 0 of the mean prior variance; raise",
            r"raise engine\.jitter .*, or model\.noise_sd, or thin the log with preprocessing\.rate",
        ),
    ),
    # --- model folders
    "no model": (
        no_model,
        (r"model: expected a model folder, found nothing; name the folder that `bayes-impedance train",),
    ),
    "file for a model": (
        lambda bench: bench.infer(model=bench.log),
        (r"log\.csv: expected a model folder, found a file; name the folder",),
    ),
    "truncated model": (
        truncated_model,
        (r"model: expected the files .*, found no data\.safetensors; copy the whole folder",),
    ),
    "truncated metadata": (
        truncated_metadata,
        (r"model.metadata\.json: .*found it truncated or changed .*; copy the whole",),
    ),
    "model of a newer schema": (
        newer_model,
        (
            r"model: expected a model of schema 1 or older",
            r"found schema 2, written by bayes_impedance 3\.0; update bayes_impedance",
        ),
    ),
    "model with a changed file": (
        changed_model,
        (
            r"model.config\.yaml: expected the content that training wrote",
            r"found it changed; restore it, or train again",
        ),
    ),
    # --- comparisons
    "nothing to score on": (
        lambda bench: bench.evaluate(),
        ("expected a LOG to score on, found none; name one, or cross-validate .* with --folds",),
    ),
    "unknown competitor": (
        lambda bench: bench.evaluate(bench.other, "--against", "fase"),
        (
            "--against: expected a model folder, a YAML file or the name of a shipped configuration, found none",
            "at 'fase'; shipped are admittance, arm, coupled, phase, ",
        ),
    ),
    "competitor that is no model folder": (
        lambda bench: bench.evaluate(bench.other, "--against", bench.folder),
        (r"expected a model folder with metadata\.json, found none",),
    ),
    "competitor with another smoother": (
        lambda bench: bench.evaluate(bench.other, "--against", "phase"),
        (
            r"phase: expected the same preprocessing\.smoother as the model that it is compared with "
            r"\(\{window: 0\.14, polynomial_order: 4\}\)",
            "got {window: 0.1, polynomial_order: 4}; set it alike",
        ),
    ),
    "competitor in a broken file": (
        lambda bench: bench.evaluate("--folds", "trials", "--against", bench.text("model: [", "mine.yaml")),
        (r"mine\.yaml: expected YAML, got: ",),
    ),
    "competitor that would take a baseline's name": (
        lambda bench: bench.evaluate(bench.other, "--against", bench.text("", "naive.yaml")),
        ("expected names other than impedance, naive, .*, got 'naive'; rename that model",),
    ),
    "one trial to cross-validate on": (
        lambda bench: bench.evaluate(bench.other, "--folds", "trials"),
        (r"other\.csv, trial 2: expected at least two trials to leave one out, found one; give more recordings",),
    ),
    "group of a single trial": (
        lambda bench: bench.evaluate(
            bench.log, bench.write(bench.table().query("trial == 0").assign(group="left")), "--folds", "trials"
        ),
        (r"bad\.csv, trial 0: expected at least two trials in group 'left' to leave one out, .* found one; give",),
    ),
    "folds without force": (
        lambda bench: bench.evaluate(
            bench.write(bench.table().drop(columns=["force_x", "force_y"])), "--folds", "last-third"
        ),
        (r"bad\.csv: expected column 'force_x'", r"set log\.columns\.force"),
    ),
    "trial too short for a last third": (
        lambda bench: bench.evaluate(bench.write(bench.table().iloc[:8]), "--folds", "last-third"),
        (r"bad\.csv, trial 0: expected samples before its last third and one window .* a trial of 2 samples; leave",),
    ),
    # --- outputs
    "posterior of another format": (
        lambda bench: bench.infer(out=bench.folder / "out.xlsx"),
        (r"out\.xlsx: expected a file name ending in \.csv or \.parquet, got '\.xlsx'; rename it",),
    ),
    "model below a file": (
        below_a_file("model"),
        (r"file.model: expected an existing folder .*file to write into, found none",),
    ),
    "posterior below a file": (below_a_file("p.csv"), (r"file.p\.csv: expected an existing folder .*; create it",)),
    "scores below a file": (
        below_a_file("scores.json"),
        (r"scores\.json: expected an existing folder .*; create it",),
    ),
    "figures below a file": (
        below_a_file("figures"),
        (r"figures: could not be created: Not a directory; choose another place",),
    ),
    "demo below a file": (
        below_a_file("demo"),
        (r"demo: could not be created: Not a directory; choose another place",),
    ),
    "folder that takes no files": (
        lambda bench: bench.infer(out=Path("/proc/out.csv")),
        (r"/proc/out\.csv: expected a writable folder /proc, got: .*; choose another place",),
    ),
    "model in a folder that takes none": (
        lambda bench: [*bench.train()[:-1], Path("/proc/model")],
        (r"/proc/model: expected a writable folder /proc, got: .*; choose another place",),
    ),
    "file in place of the journal": (
        lambda bench: [*bench.train(), "--resume"] if bench.text("mine", "out.journal") else [],
        (r"out\.journal: expected the journal of a training, found another file; rename it, or train with another",),
    ),
    "folder of somebody else": (
        other_folder,
        (r"out: expected a new folder.*found a folder with other content; choose another",),
    ),
    "file in place of a model": (
        file_in_the_way,
        (r"out: expected a new folder name, found a file; choose another name",),
    ),
}  # fmt: skip


def snapshot(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


@pytest.mark.parametrize("name", CASES)
def test_bad_input(name, bench, command):
    arrange, expected = CASES[name]
    arguments = arrange(bench)
    before = snapshot(bench.folder)
    done = command(*arguments)
    assert done.code == 2, done
    # One sentence on one line, whatever the width of the terminal.
    assert done.err.startswith("error: ")
    assert done.err.count("error:") == 1
    assert done.err.count("\n") == 1, done.err
    assert "Traceback" not in done.err
    for pattern in expected:
        assert re.search(pattern, done.err), done.err
    # Nothing was written, nothing was changed.
    assert snapshot(bench.folder) == before


@pytest.mark.parametrize(("factor", "said"), [(1e5, "kilometres"), (1e3, "that far")])
def test_unit_that_moves_a_hand_too_far_is_a_warning(bench, command, factor, said):
    columns = [f"{name}_{axis}" for name in ("position", "reference") for axis in "xy"]
    table = bench.table()
    table[columns] *= factor
    done = command(*bench.train(bench.write(table), settings=("training.max_iterations=1",)))
    assert done.code == 0, done
    for line, axis in zip(done.err.splitlines(), "xy", strict=True):
        assert line.startswith(f"warning: bad.csv: position_{axis} spans ")
        assert line.endswith(f"units that make a hand move {said}; check log.units.position")
    assert (bench.out / METADATA).is_file()


# --- in Python -----------------------------------------------------------------------------------


def bare(tiny: Tiny) -> InteractionLog:
    log = read_log(tiny.other, tiny.config.log)
    return InteractionLog(log.axes, tuple(replace(trial, force=None) for trial in log.trials))


@pytest.mark.parametrize(
    ("call", "error", "expected"),
    [
        (
            lambda tiny: tiny.fitted.point_predictor("z", "0"),
            ConfigurationError,
            "expected an axis among x, y and a group among 0, got axis 'z' and group '0'",
        ),
        (
            lambda tiny: tiny.fitted.log_marginal_likelihood(bare(tiny)),
            LogError,
            r"expected a log with force, found none; name log\.columns\.force",
        ),
        (
            lambda tiny: InteractionLog.from_arrays(
                [0, 1, 2], [0, 1, 2], [1, 2, 3], axes=["x"], phase=[0, 1]
            ),
            LogError,
            r"column phase: expected shape \(3,\), as many rows as time has, found \(2,\); give one value a sample",
        ),
    ],
)
def test_bad_input_in_python(tiny, call, error, expected):
    with pytest.raises(error, match=expected):
        call(tiny)
