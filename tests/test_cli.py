"""The command line: the main job from log to figures, its tables and JSON, exit codes, and Ctrl-C."""

import json
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bayes_impedance import cli, demo, terminal, training
from bayes_impedance.baselines import naive
from bayes_impedance.config import dump_config, load_config
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.persistence import load_model, save_model
from bayes_impedance.posterior.results import UNITS
from bayes_impedance.readers import read_log

COMMANDS = ("demo", "plan", "train", "infer", "evaluate", "show")
STATISTICS = ("mean", "sd", "q05", "q95")
VECTORS = ("force", "desired_position", "desired_velocity", "desired_acceleration", "residual_force")
MATRICES = ("stiffness", "damping", "mass")


def columns(axes: str) -> set[str]:
    """Columns of a POSTERIOR table."""
    quantities = [f"{name}_{axis}" for name in VECTORS for axis in axes]
    quantities += [f"{name}_{axis}{axis}" for name in MATRICES for axis in axes]
    return {f"{quantity}_{statistic}" for quantity in quantities for statistic in STATISTICS}


def read(path: Path) -> pd.DataFrame:
    if path.suffix == ".parquet":
        return pd.read_parquet(path)
    return pd.read_csv(path, dtype={"trial": str, "group": str})


@pytest.fixture(autouse=True)
def wide_terminal(monkeypatch):
    """So that tables are not cut."""
    monkeypatch.setenv("COLUMNS", "200")


@pytest.fixture
def interrupting(monkeypatch):
    """Function that lets Ctrl-C come with the n-th progress of all trainings together."""

    def install(after: int) -> None:
        seen = 0

        @contextmanager
        def progress(*_: object):
            def hook(restart: int, iteration: int, objective: float) -> None:
                nonlocal seen
                seen += 1
                if seen == after:
                    raise KeyboardInterrupt

            yield hook

        monkeypatch.setattr(terminal, "training_progress", progress)

    return install


# --- the main job --------------------------------------------------------------------------------


def test_train_writes_the_model_and_says_what_the_data_support(command, tiny, tmp_path):
    done = command("train", tiny.log, *tiny.settings, "--out", tmp_path / "model")
    assert (done.code, done.err) == (0, "")
    assert "training on 40 samples of 2 trials, axes x, y" in done.out
    assert re.search(r"stiffness xx \[N/m\].*…", done.out)
    # Each parameter stands in exactly one sentence that ends in its verdict's reason.
    sentences = " ".join(done.out.split("contraction", 1)[1].split("└", 1)[1].split())
    for latent in ("stiffness", "damping", "mass"):
        for axis in "xy":
            assert sentences.count(f"{latent} {axis}{axis}") == 1
    assert re.search(r"stiffness yy[^:]*: (supported|weakly supported|prior only)", sentences)
    assert "Restarts of the optimiser" in done.out
    assert (
        f"wrote {tmp_path / 'model'}; look at it with: bayes-impedance show {tmp_path / 'model'}\n"
        in done.out
    )
    assert [path.name for path in tmp_path.iterdir()] == ["model"]
    # The same as in Python, to the last bit.
    mine, its = load_model(tmp_path / "model"), tiny.fitted
    for a, b in zip(mine.hyperparameters, its.hyperparameters, strict=True):
        assert a.raw.detach().numpy().tobytes() == b.raw.detach().numpy().tobytes()
    assert mine.config == tiny.config
    # And again over the old model, from several files.
    done = command("train", tiny.log, tiny.other, *tiny.settings, "--out", tmp_path / "model")
    assert (done.code, done.err) == (0, "")
    assert "60 samples of 3 trials" in done.out
    assert {trial.source for trial in load_model(tmp_path / "model").fitted.log.trials} == {
        "log.csv",
        "other.csv",
    }


@pytest.mark.parametrize("given", [None, "both", "training", "log"])
def test_infer_writes_the_posterior(command, tiny, tmp_path, given):
    out = tmp_path / "posterior.csv"
    chosen = () if given is None else ("--given", given)
    done = command("infer", tiny.model, tiny.other, "--out", out, *chosen)
    assert (done.code, done.err) == (0, "")
    assert done.out.endswith(f"wrote {out}\n")
    log = read_log(tiny.other, tiny.config.log)
    expected = tiny.fitted.posterior(log, given or "both").table()
    pd.testing.assert_frame_equal(read(out), expected, check_exact=True, check_dtype=False)
    assert [path.name for path in tmp_path.iterdir()] == ["posterior.csv"]


def test_given_makes_a_difference(tiny):
    log = read_log(tiny.other, tiny.config.log)
    sd = {
        given: tiny.fitted.posterior(log, given)["force"].sd.mean() for given in ("both", "training", "log")
    }
    assert sd["both"] < sd["training"]
    assert sd["both"] < sd["log"]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_posterior_table(command, tiny, tmp_path, suffix):
    out = tmp_path / f"posterior{suffix}"
    assert command("infer", tiny.model, tiny.other, "--out", out).code == 0
    table = read(out)
    assert list(table.columns[:2]) == ["trial", "time"]
    assert set(table.columns) == {"trial", "time"} | columns("xy")
    assert set(table["trial"]) == {"2"}
    assert len(table) == 20
    assert np.isfinite(table.drop(columns="trial")).all(axis=None)
    for name in sorted(columns("xy")):
        if name.endswith("_sd"):
            assert (table[name] >= 0).all()
        if name.endswith("_q05"):
            assert (table[name] < table[name.replace("_q05", "_q95")]).all()
    assert (table["stiffness_xx_q05"] > 0).all()


def test_posterior_table_of_several_files_says_which(command, tiny, tmp_path):
    out = tmp_path / "posterior.parquet"
    assert command("infer", tiny.model, tiny.log, tiny.other, "--out", out).code == 0
    table = read(out)
    assert list(table.columns[:3]) == ["source", "trial", "time"]
    assert list(table.groupby(["source", "trial"], sort=False).size().items()) == [
        (("log.csv", "0"), 20),
        (("log.csv", "1"), 20),
        (("other.csv", "2"), 20),
    ]


def test_posterior_of_a_log_without_force(command, tiny, tmp_path):
    bare = tmp_path / "bare.csv"
    pd.read_csv(tiny.other).drop(columns=["force_x", "force_y"]).to_csv(bare, index=False)
    done = command("infer", tiny.model, bare, "--out", tmp_path / "posterior.csv")
    assert (done.code, done.err) == (0, "")
    expected = tiny.fitted.posterior(read_log(tiny.other, tiny.config.log), "training").table()
    pd.testing.assert_frame_equal(read(tmp_path / "posterior.csv"), expected, check_dtype=False, rtol=1e-9)


def test_infer_draws_figures(command, tiny, tmp_path):
    figures = tmp_path / "new" / "figures"
    done = command("infer", tiny.model, tiny.other, "--out", tmp_path / "p.csv", "--figures", figures)
    assert (done.code, done.err) == (0, "")
    names = ["desired_trajectory.png", "ellipses.png", "force.png", "impedance.png"]
    assert sorted(path.name for path in figures.iterdir()) == names
    for name in names:
        assert f"wrote {figures / name}\n" in done.out
        assert (figures / name).read_bytes().startswith(b"\x89PNG")


def test_evaluate_prints_and_writes_scores(command, tiny, tmp_path):
    file = tmp_path / "scores.json"
    done = command("evaluate", tiny.model, tiny.other, "--baseline", "naive", "--json", file)
    assert (done.code, done.err) == (0, "")
    scores = json.loads(file.read_text())
    assert set(scores) == {"axes"}
    assert set(scores["axes"]) == {"x", "y"}
    for models in scores["axes"].values():
        assert set(models) == {"impedance", "naive"}
        for values in models.values():
            assert set(values) == {"smse", "msll", "nlpd", "coverage90", "n"}
            assert values["n"] == 20
            assert 0 <= values["coverage90"] <= 1
            assert f"{values['smse']:.4f}" in done.out
            assert f"{values['nlpd']:.3f}" in done.out
    for heading in ("SMSE", "MSLL", "NLPD", "coverage of 90 % band"):
        assert heading in done.out
    assert f"wrote {file}\n" in done.out


def test_evaluate_without_baseline_and_on_training_data(command, tiny, tmp_path):
    done = command("evaluate", tiny.model, tiny.log)
    assert done.code == 0
    assert "naive" not in done.out
    assert done.err == (
        "warning: some of these trials were trained on, so their scores tell how well they are remembered, not "
        "predicted\n"
    )


def test_evaluate_puts_several_models_in_one_table(command, tiny, tmp_path):
    config = tmp_path / "bare.yaml"
    bare = tiny.config.model_copy(update={"model": tiny.config.model.model_copy(update={"residual": None})})
    config.write_text(dump_config(bare), encoding="utf-8")
    (tmp_path / "elsewhere").mkdir()
    for place in (tmp_path / "bare", tmp_path / "elsewhere" / "bare"):
        save_model(ImpedanceModel(bare).fit(tiny.fitted.fitted.log), place)
    others = [config, tmp_path / "bare", tmp_path / "elsewhere" / "bare"]
    arguments = [part for other in others for part in ("--against", other)]
    arguments += ["--baseline", "without-residual", "--baseline", "naive", "--json", tmp_path / "s.json"]
    done = command("evaluate", tiny.model, tiny.other, *arguments)
    assert (done.code, done.err) == (0, "")
    content = json.loads((tmp_path / "s.json").read_text())
    assert list(content) == ["axes"]
    for axis in "xy":
        rows = content["axes"][axis]
        assert list(rows) == [
            "impedance",
            "impedance_without_residual",
            "naive",
            "bare",
            "bare (2)",
            "bare (3)",
        ]
        # Trained here or before, on the same log.
        assert rows["bare"] == rows["bare (2)"] == rows["bare (3)"] == rows["impedance_without_residual"]
        for name, values in rows.items():
            share = r"\s+(0\.\d{3})? │" if name != "naive" else r"\s+│"
            row = rf"│ {axis}\s+│ {re.escape(name)}\s+│\s+{values['smse']:.4f} │.*│\s+20 │{share}"
            assert re.search(row, done.out), row
    assert "share of impedance" in done.out


@pytest.mark.parametrize("logs", [True, False])
def test_evaluate_cross_validates(command, tiny, tmp_path, logs):
    """Over the trials of LOG, or without one those of the training log."""
    file = tmp_path / "scores.json"
    given = [tiny.log, tiny.other] if logs else []
    done = command("evaluate", tiny.model, *given, "--folds", "trials", "--baseline", "naive", "--json", file)
    assert (done.code, done.err) == (0, "")
    content = json.loads(file.read_text())
    sources = ["log.csv, trial 0", "log.csv, trial 1", "other.csv, trial 2"][: 3 if logs else 2]
    assert [fold["held_out"] for fold in content["folds"]] == [[source] for source in sources]
    assert f"Predicted force of each trial, left out in turn, {len(sources)} folds" in done.out
    for axis in "xy":
        assert list(content["axes"][axis]) == ["impedance", "naive"]
        assert list(content["impedance_share"][axis]) == ["impedance"]
        for values in content["axes"][axis].values():
            assert values["n"] == 20 * len(sources)
            assert f"{values['smse']:.4f}" in done.out
        assert f"{content['impedance_share'][axis]['impedance']:.3f}" in done.out


def test_evaluate_holds_out_last_thirds(command, tiny, tmp_path):
    file = tmp_path / "scores.json"
    done = command("evaluate", tiny.model, "--folds", "last-third", "--json", file)
    assert done.code == 0
    assert done.err.startswith("warning: ")
    assert "phases that no training sample has" in done.err
    assert done.err.count("\n") == 1
    assert "Predicted force of the last third of each trial, 1 fold " in done.out
    (fold,) = json.loads(file.read_text())["folds"]
    assert [held_out.split(", from ")[0] for held_out in fold["held_out"]] == [
        "log.csv, trial 0",
        "log.csv, trial 1",
    ]
    assert fold["axes"]["x"]["impedance"]["n"] == 12


def test_show(command, tiny):
    done = command("show", tiny.model)
    assert (done.code, done.err) == (0, "")
    assert "trained on log.csv: 40 samples, 2 trials, groups 0, axes x, y\n" in done.out
    for entry in tiny.fitted.hyperparameters:
        assert entry.name in done.out
    assert re.search(r"stiffness\.level\s+│ x\s+│\s+300 │ 57\.9 … 1\.55e\+03 │.*│ N/m", done.out)
    assert re.search(r"mass\.sd\s+│ x\s+│\s+0\.3 │\s+fixed │\s+0\.3 │\s+fixed │ kg", done.out)
    assert "mass yy: " in done.out
    assert re.search(r"best for x, y", done.out)


def test_show_as_json(command, tiny):
    done = command("show", tiny.model, "--json")
    assert (done.code, done.err) == (0, "")
    shown = json.loads(done.out)
    assert set(shown) == {f"{name}_{axis}{axis}" for name in MATRICES for axis in "xy"}
    for estimate in shown.values():
        assert set(estimate) == {"mean", "q05", "q95", "contraction", "verdict"}
        assert estimate["verdict"] in ("supported by these data", "weakly supported", "prior only")
        assert estimate["q05"] < estimate["mean"] < estimate["q95"]


def test_units_are_known_for_every_quantity():
    assert {latent.value for latent in UNITS} == {*VECTORS, *MATRICES}


# --- demo ----------------------------------------------------------------------------------------


def test_demo_does_the_main_job_and_meets_the_truth(command, tmp_path, monkeypatch):
    monkeypatch.setattr(
        demo,
        "load_config",
        lambda name, overrides: load_config(
            name, [*overrides, "training.restarts=1", "training.max_iterations=10"]
        ),
    )
    out = tmp_path / "results" / "demo"
    done = command("demo", "--out", out)
    assert (done.code, done.err) == (0, "")
    assert sorted(path.name for path in out.iterdir()) == [
        "desired_trajectory.png",
        "ellipses.png",
        "force.png",
        "impedance.png",
        "model",
        "posterior.csv",
        "predicted_force.png",
        "testing.csv",
        "training.csv",
    ]
    found = re.search(r"Mean relative error against the truth: (.*)", done.out)
    assert found is not None
    errors = dict(item.split(" ") for item in found[1].split(", "))
    assert set(errors) == {f"{name}_{axis}{axis}" for name in MATRICES for axis in "xy"}
    # Ten iterations already come this close.
    assert max(float(error.rstrip("%")) for error in errors.values()) < 25
    coupled = re.search(r"Mean absolute error of what couples the axes: (.*)", done.out)
    assert coupled is not None
    errors = {item.split(" ")[0]: item.split(" ", 1)[1].split(" ") for item in coupled[1].split(", ")}
    assert {name: unit for name, (_, unit) in errors.items()} == {
        "stiffness_xy": "N/m",
        "damping_xy": "Ns/m",
        "mass_xy": "kg",
    }
    # Of −.8 kg.
    assert float(errors["mass_xy"][0]) < 0.2
    assert "engine markov: exact" in done.out
    # Four repetitions train, the fifth tests.
    assert len(load_model(out / "model").fitted.log.trials) == 4
    assert set(pd.read_csv(out / "testing.csv")["trial"]) == {"0-4"}
    scores = {
        (match[1], match[2]): float(match[3])
        for match in re.finditer(r"│ (x|y)\s+│ (impedance|naive)\s+│\s+\S+ │\s+(\S+) │", done.out)
    }
    for axis in "xy":
        assert scores[axis, "impedance"] < scores[axis, "naive"]


def test_demo_does_not_touch_a_folder_of_somebody_else(command, tmp_path, monkeypatch):
    (tmp_path / "demo" / "model").mkdir(parents=True)
    (tmp_path / "demo" / "model" / "aeroplane.stl").write_text("")
    monkeypatch.setattr(cli, "record", lambda *_: pytest.fail("too late"))
    done = command("demo", "--out", tmp_path / "demo")
    assert done.code == 2
    assert "found a folder with other content" in done.err


# --- help and usage ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "mentions"),
    [
        ("demo", ("--out", "--seed")),
        (
            "train",
            (
                "LOG",
                "--config",
                "--out",
                "--set",
                "KEY=VALUE",
                "Ctrl-C",
                *sorted(cli.shipped_configurations()),
            ),
        ),
        ("infer", ("MODEL", "LOG", "--out", "--given", "both", "training", "log", "--figures", ".parquet")),
        (
            "evaluate",
            (
                "MODEL",
                "LOG",
                "--baseline",
                "naive",
                "without-residual",
                "--against",
                "--folds",
                "last-third",
                "--json",
            ),
        ),
        (
            "plan",
            (
                "--repetitions",
                "2,4,8",
                "--perturbations",
                "--width",
                "--config",
                "admittance",
                "--set",
                "--pilot",
                "MODEL",
                "--stiffness",
                "--subject",
                "--figure",
                "--json",
            ),
        ),
        ("show", ("MODEL", "--json")),
    ],
)
def test_help_of_every_command_mentions_its_arguments(command, name, mentions):
    done = command(name, "--help")
    assert (done.code, done.err) == (0, "")
    for mention in mentions:
        assert mention in done.out


def test_help_mentions_every_command(command):
    done = command("--help")
    assert (done.code, done.err) == (0, "")
    for name in COMMANDS:
        assert re.search(rf"│ {name}\s+\S", done.out)
    assert command().out.strip() == done.out.strip()


def test_version(command):
    done = command("--version")
    assert (done.code, done.out.strip(), done.err) == (0, version("bayes-impedance"), "")


@pytest.mark.parametrize(
    ("arguments", "mention"),
    [
        (("train",), "Missing"),
        (("trian",), "No such command 'trian'"),
        (("train", "log.csv", "--config", "time", "--out", "m", "--fast"), "No such option"),
        (("infer", "model", "log.csv", "--out", "p.csv", "--given", "nothing"), "is not one of"),
        (("evaluate", "model", "log.csv", "--baseline", "kalman"), "is not|Choose from"),
        (("evaluate", "model", "--folds", "thirds"), "is not one of"),
        (("demo", "--seed", "-1"), "Invalid value for '--seed'"),
    ],
)
def test_wrong_usage(command, arguments, mention):
    done = command(*arguments)
    assert done.code == 2
    assert done.out == ""
    assert re.search(mention, done.err)


def test_module_is_the_command():
    done = subprocess.run(
        [sys.executable, "-m", "bayes_impedance", "--version"], capture_output=True, text=True, check=True
    )
    assert (done.stdout.strip(), done.stderr) == (version("bayes-impedance"), "")


def test_script_ends_in_one_sentence(tmp_path):
    script = Path(sys.executable).with_name("bayes-impedance")
    done = subprocess.run(
        [script, "show", str(tmp_path / "nothing")], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"error: {tmp_path / 'nothing'}: expected a model folder, found nothing")
    assert done.stderr.count("\n") == 1


# --- warnings ------------------------------------------------------------------------------------


def test_warning_is_one_sentence(command, tiny, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    short = [*tiny.settings, "--set", "preprocessing.smoother.window=0.1"]
    done = command("train", tiny.log, *short, "--out", tmp_path / "model")
    assert done.code == 0
    # Once, though it concerns both trials.
    assert done.err == (
        "warning: a smoother of 0.1 s is too short for order 4 at 50 Hz, so its window is 0.14 s (7 samples); raise "
        "preprocessing.smoother.window or lower polynomial_order\n"
    )


def test_brackets_in_a_message_are_no_markup(command, tmp_path):
    done = command("train", tmp_path / "[red]log[/red].csv", "--config", "time", "--out", tmp_path / "model")
    assert done.code == 2
    assert "[red]log[/red].csv" in done.err


# --- Ctrl-C --------------------------------------------------------------------------------------


def test_ctrl_c_keeps_the_best_so_far(command, tiny, tmp_path, interrupting):
    interrupting(after=2)
    done = command("train", tiny.log, *tiny.settings, "--out", tmp_path / "model")
    assert (done.code, done.err) == (130, "")
    assert "training was interrupted: the model holds the best hyperparameters found until then" in done.out
    model = load_model(tmp_path / "model")
    assert model.report.interrupted
    assert model.report.restarts[0].iterations == 2
    assert model.report.restarts[0].outcome == "interrupted"
    start = load_config("phase").model.noise_sd.median
    noise = next(entry for entry in model.hyperparameters if entry.name == "noise_sd")
    assert (noise.value != start).all()
    shown = command("show", tmp_path / "model")
    assert shown.code == 0
    assert "; interrupted" in shown.out
    assert "not determined" in shown.out


def test_ctrl_c_before_anything_was_found_writes_nothing(command, tiny, tmp_path, monkeypatch):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "objective", interrupted)
    done = command("train", tiny.log, *tiny.settings, "--out", tmp_path / "model")
    assert (done.code, done.err) == (130, "interrupted; no file was left half written\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["infer", "show"])
def test_ctrl_c_of_other_commands(command, tiny, tmp_path, monkeypatch, name):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "load_model", interrupted)
    arguments = (tiny.other, "--out", tmp_path / "p.csv") if name == "infer" else ()
    done = command(name, tiny.model, *arguments)
    assert (done.code, done.out, done.err) == (130, "", "interrupted; no file was left half written\n")
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_within_infer_writes_nothing(command, tiny, tmp_path, monkeypatch):
    @contextmanager
    def progress(*_: object):
        def hook(done: int, total: int) -> None:
            assert 0 < done <= total
            raise KeyboardInterrupt

        yield hook

    monkeypatch.setattr(terminal, "inference_progress", progress)
    done = command("infer", tiny.model, tiny.other, "--out", tmp_path / "p.csv")
    assert (done.code, done.out, done.err) == (130, "", "interrupted; no file was left half written\n")
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_while_the_baseline_trains_gives_no_scores(command, tiny, tmp_path, interrupting):
    """A baseline that is half trained would be no fair competitor."""
    interrupting(after=1)
    done = command("evaluate", tiny.model, tiny.other, "--baseline", "naive", "--json", tmp_path / "s.json")
    assert (done.code, done.out, done.err) == (130, "", "interrupted; no file was left half written\n")
    assert list(tmp_path.iterdir()) == []
    assert naive.NaiveModel.__doc__ is not None
    assert "the same care" in naive.NaiveModel.__doc__


@pytest.mark.parametrize("after", [1, 4, 9])
def test_ctrl_c_in_any_fold_gives_no_scores(command, tiny, tmp_path, interrupting, after):
    interrupting(after)
    file = tmp_path / "s.json"
    done = command("evaluate", tiny.model, "--folds", "trials", "--baseline", "naive", "--json", file)
    assert (done.code, done.out, done.err) == (130, "", "interrupted; no file was left half written\n")
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_on_a_terminal(tiny, tmp_path):
    """The real signal, to a process in the middle of a training that would take hours."""
    endless = ["training.restarts=100", "training.max_iterations=100000", "training.gradient_tolerance=1e-30"]
    arguments = [
        *("train", str(tiny.log), "--config", "phase", "--out", str(tmp_path / "model")),
        *(part for item in (*endless, "preprocessing.smoother.window=0.14") for part in ("--set", item)),
    ]
    process = subprocess.Popen(
        [sys.executable, "-m", "bayes_impedance", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert "training on" in process.stdout.readline()
    time.sleep(1.5)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (130, "")
    assert "training was interrupted" in out
    assert load_model(tmp_path / "model").report.interrupted
