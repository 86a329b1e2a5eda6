"""Models whose impedance is a function: what they can be asked, what they refuse, files and the command line."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from safetensors.numpy import load_file, save_file

from bayes_impedance import cli, terminal
from bayes_impedance.config import load_config
from bayes_impedance.errors import ConfigurationError, ModelFolderError, OutputError
from bayes_impedance.evaluation.cross_validation import cross_validate
from bayes_impedance.evaluation.held_out import evaluate
from bayes_impedance.impedance_functions import conditioned, fit
from bayes_impedance.journal import open_journal
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.persistence import FILES, FUNCTIONS, METADATA, load_model, save_model
from bayes_impedance.posterior import draw_matrices
from bayes_impedance.sensitivity import prior_sensitivity
from bayes_impedance.simulation.arm import arm_with
from bayes_impedance.simulation.device import BandLimitedForce
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.generative import as_recording
from bayes_impedance.simulation.planning import plan
from bayes_impedance.simulation.subjects import Subject
from bayes_impedance.simulation.tasks import FigureEight, Pace
from bayes_impedance.writer import write_log
from tests.impedance_functions.problems import COUPLED, DISTINCT, KNOWN_VARIATION, drawn_log, map_config

SETTINGS = (*KNOWN_VARIATION, *DISTINCT, "training.max_iterations=40", "engine.inducing=3")
TIME = ("model.trajectory_input=time", "model.desired_trajectory.mean=reference")
POSITION = (
    "model.trajectory_input=position",
    "model.desired_trajectory.mean=reference",
    "model.desired_trajectory.kernel=squared_exponential",
    "model.desired_trajectory.length_scale={position: 0.1}",
)


@pytest.fixture(autouse=True)
def in_a_hurry(monkeypatch):
    """How good modes and variances are is looked at elsewhere."""
    monkeypatch.setattr(conditioned, "PAIRS", 2)
    monkeypatch.setattr(fit, "TURNS", 1)


@pytest.fixture(scope="module")
def fitted():
    """A coupled model of two repetitions, the log that it was trained on, and a third repetition."""
    config = map_config(*SETTINGS, COUPLED)
    log = drawn_log(config, 3, axes=("x", "y"))
    return ImpedanceModel(config).fit(log.select([0, 1])), log.select([0, 1]), log.select([2])


# --- what a model can be asked -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overrides", "axes", "engine"),
    [
        ((COUPLED,), ("x", "y"), "markov"),
        ((), ("x", "y"), "markov"),
        ((), ("y",), "markov"),
        (TIME, ("x",), "markov"),
        ((*TIME, "shared.desired_trajectory=true"), ("x",), "markov"),
        (POSITION, ("x", "y"), "dense"),
    ],
)
def test_fit_and_everything_after(overrides, axes, engine):
    config = map_config(*SETTINGS, "training.max_iterations=30", *overrides)
    log = drawn_log(config, 2, axes=axes, rate=6.0)
    model = ImpedanceModel(config).fit(log)
    assert model.engine.name == engine
    joined = "".join(axes)
    assert model.parts == (joined,)
    assert model.report.samples == 24
    (evidence,) = model.log_marginal_likelihood(log).values()
    # The mode of a climb that was cut short is found anew to the end.
    assert evidence == pytest.approx(model.report.log_likelihood[0], abs=0.5)
    posterior = model.posterior(log)
    table = posterior.table()
    assert np.isfinite(table.drop(columns="trial")).all(axis=None)
    pairs = ["xy"] if COUPLED in overrides else []
    matrices = {
        f"{name}_{e}" for name in ("stiffness", "damping", "mass") for e in [*(2 * a for a in axes), *pairs]
    }
    assert {f"{entry}_mean" for entry in matrices} <= set(table.columns)
    assert posterior.pairs == tuple(pairs)
    verdicts = model.verdicts()
    assert [(v.latent, v.axis) for v in verdicts] == [(latent, a) for latent in IMPEDANCE_ORDER for a in axes]
    for prior in (False, True):
        drawn = draw_matrices(posterior, 20, seed=0, prior=prior)
        assert drawn.shape == (20, 24, 3, len(axes), len(axes))
        assert (np.linalg.eigvalsh(drawn) > 0).all()
        np.testing.assert_allclose(drawn, drawn.swapaxes(-1, -2), rtol=1e-10)
        beside = drawn[..., ~np.eye(len(axes), dtype=bool)]
        assert (beside != 0.0).all() if pairs else (beside == 0.0).all()
    # Draws are of the law whose summary the table is.
    stiffness = draw_matrices(posterior, 400, seed=1)[:, :, 0].diagonal(axis1=-2, axis2=-1)
    low, high = (posterior["stiffness"].quantile(p) for p in (0.05, 0.95))
    assert ((low < stiffness) & (stiffness < high)).mean() == pytest.approx(0.9, abs=0.03)


def test_evaluation_and_folds(fitted):
    model, log, unseen = fitted
    scores = evaluate(model, unseen, ["naive"])
    for axis in "xy":
        assert scores.scores[axis]["impedance"].msll < scores.scores[axis]["naive"].msll
        assert scores.impedance_share[axis]["impedance"] > 0.8
    quick = ImpedanceModel(
        model.config.model_copy(
            update={"training": model.config.training.model_copy(update={"max_iterations": 20})}
        )
    )
    found = cross_validate(quick, log)
    assert len(found.folds) == 2
    assert all(found.pooled.scores[axis]["impedance"].n == 40 for axis in "xy")


def test_levels_are_shown_with_their_posterior(fitted, capsys):
    model = fitted[0]
    from rich.console import Console

    Console(width=200).print(terminal.hyperparameter_table(model))
    shown = capsys.readouterr().out
    for name in ("noise_sd", "mass.level"):
        spread = np.array(model.report.log_sd[name])
        assert spread.shape == (2, 1)
        entry = next(e for e in model.hyperparameters if e.name == name)
        low = float(entry.value[0, 0, 0, 0].detach()) * np.exp(-1.645 * spread[0, 0])
        row = next(line for line in shown.splitlines() if name in line)
        assert f"{low:.3g} …" in row
    assert "not determined" not in shown
    assert re.search(r"stiffness\.log_sd .*fixed", shown)


# --- what it refuses -----------------------------------------------------------------------------


def test_an_untrained_model_has_no_functions(fitted):
    _, log, _ = fitted
    model = ImpedanceModel(map_config(*SETTINGS))
    bare = replace(log, trials=tuple(replace(trial, force=None) for trial in log.trials))
    asked = (
        lambda: model.posterior(log),
        lambda: model.posterior(bare),
        lambda: model.log_marginal_likelihood(log),
        lambda: model.verdicts(),
        lambda: model.engine,
    )
    for question in asked:
        with pytest.raises(
            ConfigurationError, match=r"expected a fitted model, got an untrained one; call fit\(log\)"
        ):
            question()


def test_one_sample_at_a_time_is_of_moments(fitted):
    with pytest.raises(
        ConfigurationError, match=r"engine\.impedance: moments to predict one sample at a time, got map"
    ):
        fitted[0].point_predictor("x", "0")


def test_functions_are_found_anew(fitted, tmp_path):
    model, log, _ = fitted
    refusal = "expected none with engine.impedance: map, which finds functions anew each time, got one"
    with pytest.raises(ConfigurationError, match=f"start: {refusal}"):
        ImpedanceModel(model.config).fit(log, start=model)
    with (
        open_journal(tmp_path / "journal") as journal,
        pytest.raises(ConfigurationError, match=f"journal: {refusal}"),
    ):
        ImpedanceModel(model.config).fit(log, journal=journal)


def test_sensitivity_is_of_moments(fitted):
    with pytest.raises(
        ConfigurationError,
        match=r"expected engine\.impedance: moments for prior sensitivity, whose refits start at",
    ):
        prior_sensitivity(fitted[0])


def test_plans_are_of_moments(fitted):
    person = Subject("P", arm_with("low"), Pace(repetition=2.0))
    experiment = Experiment(
        [person], FigureEight(), repetitions=1, perturbation=BandLimitedForce(1.0), rate=100.0
    )
    for model in (fitted[0], ImpedanceModel(fitted[0].config)):
        with pytest.raises(
            ConfigurationError,
            match=r"expected engine\.impedance: moments to plan with, whose widths hardly depend",
        ):
            plan(experiment, model, [2], [1.0])


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        (
            ("model.mass.input=[position]", "engine.impedance=moments"),
            r"model\.mass\.input: expected no input with engine\.impedance: moments, .* got position; set engine",
        ),
        (
            ("model.desired_trajectory.periodic=true", "engine.impedance=moments"),
            r"model\.desired_trajectory\.periodic: expected false with engine\.impedance: moments, whose kernel has",
        ),
        (
            ("model.stiffness={level: 300, prior: gp, sd: 30}",),
            r"model\.stiffness\.prior: expected log_gp with engine\.impedance: map, which keeps impedance positive",
        ),
        (
            ("model.damping={level: 20, prior: gp, sd: 3}",),
            r"model\.damping\.prior: expected log_gp with engine\.impedance: map, .* set model\.damping\.prior=log_gp",
        ),
        (
            ("model.position_noise_sd=1e-5",),
            r"model\.position_noise_sd: expected null with engine\.impedance: map, which takes the recorded motion as",
        ),
        (
            ("engine.name=markov", "engine.impedance=moments"),
            r"engine: name: expected auto, dense or local with impedance: moments, got markov, which computes",
        ),
    ],
)
def test_configurations_that_are_refused(overrides, sentence):
    with pytest.raises(ConfigurationError, match=sentence):
        load_config("phase", ["engine.impedance=map", *overrides])


# --- files ---------------------------------------------------------------------------------------


@pytest.fixture
def folder(fitted, tmp_path):
    save_model(fitted[0], tmp_path / "model")
    return tmp_path / "model"


def accept(folder):
    """Bring the digest in line with the functions."""
    import hashlib

    metadata = json.loads((folder / METADATA).read_text())
    metadata["files"][FUNCTIONS] = hashlib.sha256((folder / FUNCTIONS).read_bytes()).hexdigest()
    (folder / METADATA).write_text(json.dumps(metadata))


def test_loaded_model_is_the_saved_one_to_the_last_bit(fitted, folder):
    model, log, unseen = fitted
    loaded = load_model(folder)
    mine, its = loaded.fitted.functions, model.fitted.functions
    assert (mine.groups, mine.engine) == (its.groups, its.engine)
    assert mine.point.tobytes() == its.point.tobytes()
    assert mine.covariance.tobytes() == its.covariance.tobytes()
    for one, two in zip(mine.inducing, its.inducing, strict=True):
        assert (one is None and two is None) or torch.equal(one, two)
    assert repr(loaded.report) == repr(model.report)
    for asked, given in ((log, "both"), (unseen, "training"), (unseen, "both")):
        pd.testing.assert_frame_equal(
            loaded.posterior(asked, given).table(), model.posterior(asked, given).table(), check_exact=True
        )
    assert loaded.log_marginal_likelihood(unseen) == model.log_marginal_likelihood(unseen)
    save_model(loaded, folder.with_name("again"))
    for name in (*FILES, FUNCTIONS, METADATA):
        assert (folder.with_name("again") / name).read_bytes() == (folder / name).read_bytes()


def test_functions_that_are_missing_or_changed(folder):
    content = (folder / FUNCTIONS).read_bytes()
    (folder / FUNCTIONS).write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(
        ModelFolderError, match=r"functions\.safetensors: expected the content that training wrote"
    ):
        load_model(folder)
    (folder / FUNCTIONS).unlink()
    with pytest.raises(
        ModelFolderError, match=r"expected the files .*, found no functions\.safetensors; copy the whole"
    ):
        load_model(folder)


@pytest.mark.parametrize("key", ["point", "covariance", "inducing.0"])
@pytest.mark.parametrize("change", ["missing", "shape", "type"])
def test_functions_of_another_model_with_a_matching_digest(folder, key, change):
    arrays = load_file(folder / FUNCTIONS)
    if change == "missing":
        del arrays[key]
    elif change == "shape":
        arrays[key] = np.ascontiguousarray(arrays[key][:-1])
    else:
        arrays[key] = arrays[key].astype(np.float32)
    save_file(arrays, folder / FUNCTIONS)
    accept(folder)
    with pytest.raises(ModelFolderError, match="found inconsistent content .*train again"):
        load_model(folder)


def test_functions_and_configuration_agree(folder, tiny, tmp_path):
    metadata = json.loads((folder / METADATA).read_text())
    (folder / METADATA).write_text(json.dumps({**metadata, "functions": None}))
    with pytest.raises(
        ModelFolderError, match="inconsistent content .*map without functions, or functions without it"
    ):
        load_model(folder)
    # Folders that were written before functions were do not know the key.
    old = Path(shutil.copytree(tiny.model, tmp_path / "old"))
    metadata = json.loads((old / METADATA).read_text())
    assert metadata.pop("functions") is None
    (old / METADATA).write_text(json.dumps(metadata))
    assert load_model(old).fitted.functions is None


# --- the command line ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Two trials to train on and a third, of a simulated arm on a device that perturbs it."""
    folder = tmp_path_factory.mktemp("recordings")
    person = Subject("P", arm_with("low"), Pace(repetition=2.0))
    template = Experiment(
        [person], FigureEight(), trials=3, repetitions=1, perturbation=BandLimitedForce(2.0), rate=100.0
    )
    log = simulate(template, 0)
    write_log(log.select([0, 1]), folder / "training.csv")
    write_log(log.select([2]), folder / "testing.csv")
    return folder


ARM = (
    "--config", "arm", "--set", "engine.inducing=2", "--set", "training.max_iterations=8",
    "--set", "model.desired_trajectory.average_knots=3",
)  # fmt: skip


def test_commands_with_the_shipped_configuration(command, recordings, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    model = tmp_path / "model"
    done = command("train", recordings / "training.csv", *ARM, "--out", model)
    assert (done.code, done.err) == (0, "")
    assert "engine markov: exact, at a cost that grows with the number of samples\n" in done.out
    assert [path.name for path in tmp_path.iterdir()] == ["model"]
    done = command("show", model)
    assert (done.code, done.err) == (0, "")
    assert re.search(r"stiffness\.level +│ x .* …", done.out)
    assert re.search(r"stiffness xy \[N/m\]", done.out)
    assert re.search("best for xy", done.out)
    done = command("infer", model, recordings / "testing.csv", "--out", tmp_path / "p.csv")
    assert (done.code, done.err) == (0, "")
    table = pd.read_csv(tmp_path / "p.csv")
    assert np.isfinite(table["stiffness_xy_mean"]).all()
    assert (table["mass_xx_q05"] > 0).all()
    done = command("evaluate", model, recordings / "testing.csv", "--json", tmp_path / "s.json")
    assert (done.code, done.err) == (0, "")
    assert json.loads((tmp_path / "s.json").read_text())["axes"]["x"]["impedance"]["smse"] < 0.5
    done = command("show", model, "--sensitivity", "--json")
    assert done.code == 2
    assert "expected engine.impedance: moments for prior sensitivity" in done.err


@pytest.fixture
def small_log(tmp_path):
    """A recording with settings under which training takes a blink."""
    log = drawn_log(map_config(*SETTINGS), 2, rate=50.0)
    write_log(as_recording(log), tmp_path / "log.csv")
    overrides = (
        "engine.impedance=map", "engine.inducing=3", "training.max_iterations=3", "model.residual=null",
        "preprocessing.smoother.window=0.14", "preprocessing.rate=10", "model.desired_trajectory.average_knots=2",
        "log.axes=[x]", "training.restarts=2",
    )  # fmt: skip
    arguments = [part for item in overrides for part in ("--set", item)]
    return [tmp_path / "log.csv", "--config", "phase", *arguments, "--out", tmp_path / "model"]


def test_resume_says_that_nothing_is_kept(command, small_log, tmp_path):
    done = command("train", *small_log, "--resume")
    assert (done.code, done.err) == (0, "")
    assert " ".join(cli.KEEPS_NOTHING.split()) in " ".join(done.out.split())
    assert {path.name for path in tmp_path.iterdir()} == {"log.csv", "model"}


@pytest.mark.parametrize("resume", [(), ("--resume",)])
def test_journal_of_another_training_is_not_touched(command, small_log, tmp_path, resume):
    with open_journal(tmp_path / "model.journal") as journal:
        journal.begin({"training": "of moments"})
        journal.keep(np.ones(2), np.ones(3))
    before = (tmp_path / "model.journal").read_bytes()
    done = command("train", *small_log, *resume)
    assert done.code == 2
    assert (
        "which engine.impedance: map could not continue, found one with 1 evaluations; delete the file"
        in done.err
    )
    assert OutputError.__name__ not in done.err
    assert (tmp_path / "model.journal").read_bytes() == before
    assert not (tmp_path / "model").exists()


@pytest.mark.parametrize("restart", [0, 1])
def test_ctrl_c(command, small_log, tmp_path, monkeypatch, restart):
    from contextlib import contextmanager

    @contextmanager
    def progress(*_):
        def hook(at, *_):
            if at == restart:
                raise KeyboardInterrupt

        yield hook

    monkeypatch.setattr(terminal, "training_progress", progress)
    done = command("train", *small_log)
    assert done.code == 130
    if restart == 0:
        assert done.err == "interrupted; no file was left half written\n"
        assert [path.name for path in tmp_path.iterdir()] == ["log.csv"]
        return
    assert "training was interrupted" in done.out
    assert "repeat the same command" in " ".join(done.out.split())
    assert "--resume" not in done.out
    assert {path.name for path in tmp_path.iterdir()} == {"log.csv", "model"}
    assert load_model(tmp_path / "model").report.interrupted


def test_latents_by_name(fitted):
    assert fitted[0].posterior(fitted[1], latents=[Latent.MASS])["mass"].latent is Latent.MASS
