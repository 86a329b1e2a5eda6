"""The command `sample`: draws, diagnosis, verdicts and figures; what it refuses; Ctrl-C and --resume."""

import io
import re
import shutil
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
import xarray
from rich.console import Console

from bayes_impedance import terminal
from bayes_impedance.config import load_config
from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.impedance_functions import fit
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.persistence import save_model
from bayes_impedance.readers import read_log
from bayes_impedance.sampling import chains, importance
from bayes_impedance.simulation.generative import as_recording, draw_force, repeated_motion
from bayes_impedance.writer import write_log
from tests.impedance_functions.problems import DISTINCT, KNOWN_VARIATION, MAP, MARKOV

SMALL = (*MARKOV, *KNOWN_VARIATION, *DISTINCT, *MAP, "engine.inducing=3", "preprocessing.rate=10")
SMALL = (*SMALL, "preprocessing.smoother.window=0.14")
FEW = ("sampling.chains=2", "sampling.warmup=20", "sampling.draws=4", "sampling.places=5")
FIGURES = ("impedance.png", "desired_trajectory.png", "force.png", "confounding.png")


@dataclass(frozen=True)
class Bench:
    log: Path
    bare: Path
    model: Path
    coupled: Path


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sample")
    motion = repeated_motion(repetitions=2, duration=2.0, rate=50.0, axes=("x", "y"), seed=3)
    log = as_recording(draw_force(load_config("phase", SMALL), motion, seed=3), keep_reference=True)
    write_log(log, folder / "log.csv")
    table = (folder / "log.csv").read_text(encoding="utf-8").splitlines()
    columns = [i for i, name in enumerate(table[0].split(",")) if not name.startswith("force")]
    lines = (",".join(line.split(",")[i] for i in columns) for line in table)
    (folder / "bare.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    for name, more in (("model", "log.axes=[x]"), ("coupled", "model.axes=coupled")):
        config = load_config("phase", [*SMALL, more])
        save_model(ImpedanceModel(config).fit(read_log(folder / "log.csv", config.log)), folder / name)
    return Bench(folder / "log.csv", folder / "bare.csv", folder / "model", folder / "coupled")


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Few proposals, chains one after another in this process, a terminal that cuts nothing."""
    monkeypatch.setattr(importance, "PROPOSALS", 150)
    monkeypatch.setattr(chains, "_cores", lambda: 1)
    monkeypatch.setenv("COLUMNS", "200")


def settings(*assignments):
    return [argument for item in assignments for argument in ("--set", item)]


def content(path):
    with xarray.open_datatree(path, engine="h5netcdf") as tree:
        return tree.load()


def interrupt_at(monkeypatch, what, place=0):
    """Ctrl-C once `what` is done so far."""

    @contextmanager
    def progress(_):
        def hook(now, done, total, line):
            if now == what and done >= place:
                raise KeyboardInterrupt

        yield hook

    monkeypatch.setattr(terminal, "sampling_progress", progress)


def test_laplace_writes_draws_figures_and_verdicts(command, bench, tmp_path):
    out, figures = tmp_path / "posterior.nc", tmp_path / "figures"
    arguments = ("sample", bench.model, bench.log, "--out", out, "--method", "laplace", "--figures", figures)
    done = command(*arguments, *settings("sampling.chains=1", "sampling.draws=200", "sampling.places=12"))
    assert (done.code, done.err) == (0, "")
    assert "laplace: 200 draws" in done.out and "Pareto k" in done.out
    assert "engine markov" in done.out
    for name in ("stiffness xx", "damping xx", "mass xx"):
        assert re.search(rf"{name}: (supported|weakly|prior)", done.out), done.out
    assert "correlation with the SD of the desired trajectory" in done.out
    assert f"wrote {out}" in done.out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["figures", "posterior.nc"]
    assert sorted(path.name for path in figures.iterdir()) == sorted(FIGURES)
    assert all((figures / name).read_bytes().startswith(b"\x89PNG") for name in FIGURES)
    tree = content(out)
    assert tree["posterior"]["stiffness"].shape == (1, 200, 1, 12, 1)
    assert tree.attrs["method"] == "laplace"


def test_coupled_axes_and_a_log_without_force(command, bench, tmp_path):
    out = tmp_path / "posterior.nc"
    arguments = ("sample", bench.coupled, bench.bare, "--out", out, "--figures", tmp_path / "figures")
    done = command(*arguments, "--method", "laplace", *settings("sampling.chains=1", "sampling.draws=100"))
    assert (done.code, done.err) == (0, "")
    assert "stiffness xy" in done.out
    tree = content(out)
    assert tree["posterior"]["stiffness"].dims[-2:] == ("axis", "axis_2")
    assert not tree["observed_data"].data_vars
    refused = command("sample", bench.coupled, bench.bare, "--out", out, "--given", "log")
    assert refused.code == 2 and "force" in refused.err


def test_too_few_draws_end_in_words(command, bench, tmp_path):
    for number, one in enumerate(("sampling.draws=2", "sampling.draws=1")):
        out, figures = tmp_path / f"{number}.nc", tmp_path / f"figures{number}"
        arguments = ("sample", bench.model, bench.log, "--out", out, "--figures", figures)
        done = command(*arguments, *settings(*FEW, one))
        assert (done.code, done.err) == (0, "")
        said = " ".join(done.out.split())
        assert "are too few for R-hat and ESS; set sampling.draws to 100 or more" in said
        assert "draws are too few to tell what the data said" in said
        assert "supported" not in said and "nan" not in said
        assert len(list(figures.iterdir())) == len(FIGURES)
    done = command(
        "sample", bench.model, bench.log, "--out", out, "--method", "laplace",
        *settings("sampling.chains=1", "sampling.draws=1"),
    )  # fmt: skip
    assert (done.code, done.err) == (0, "") and "1 draws are too few for any diagnostics" in done.out


def test_ctrl_c_and_resume_end_with_the_same_draws(command, bench, tmp_path, monkeypatch):
    expected, out = tmp_path / "expected.nc", tmp_path / "posterior.nc"
    arguments = ("sample", bench.model, bench.log, *settings(*FEW))
    done = command(*arguments, "--out", expected, "--resume")
    assert (done.code, done.err) == (0, "") and "nothing to resume: sampling from the start" in done.out
    assert "nuts: 2 chains of 4 draws" in done.out
    unfinished = tmp_path / "posterior.nc.unfinished"
    with monkeypatch.context() as patch:
        interrupt_at(patch, "chain 2")
        stopped = command(*arguments, "--out", out)
    assert (stopped.code, stopped.err) == (130, "interrupted; no file was left half written\n")
    assert "sampling was stopped: to continue, add --resume to the same command" in stopped.out
    assert [path.name for path in unfinished.iterdir()] == ["chain-1.safetensors"]
    assert not out.exists()
    refused = command(*arguments, "--out", out)
    assert (refused.code, refused.out) == (2, "")
    assert "expected no unfinished run of posterior.nc, found one; add --resume to continue it" in refused.err
    # Nothing but the same run goes on, and what was drawn stays.
    kept = (unfinished / "chain-1.safetensors").read_bytes()
    for more, sentence in (
        (("--set", "sampling.seed=5"), "found one of another sampling.seed (0, now 5)"),
        (("--method", "laplace"), "expected no unfinished chains where laplace is to draw, found some"),
        (("--set", "sampling.method=svi"), "expected no unfinished chains where svi is to draw, found some"),
    ):
        refused = command(*arguments, "--out", out, "--resume", *more)
        assert refused.code == 2 and sentence in refused.err and refused.err.count("\n") == 1
        assert (unfinished / "chain-1.safetensors").read_bytes() == kept
    other = command("sample", bench.coupled, bench.log, *settings(*FEW), "--out", out, "--resume")
    assert other.code == 2 and "found one of another model" in other.err
    spoilt = shutil.copytree(unfinished, tmp_path / "spoilt.nc.unfinished")
    (spoilt / "chain-1.safetensors").write_bytes(kept[:-9] + bytes(255 - byte for byte in kept[-9:]))
    damaged = command(*arguments, "--out", tmp_path / "spoilt.nc", "--resume")
    assert damaged.code == 2 and "found a damaged file; delete it" in damaged.err
    done = command(*arguments, "--out", out, "--resume")
    assert (done.code, done.err) == (0, "")
    assert not unfinished.exists()
    one, other = content(expected), content(out)
    for name, group in one.children.items():
        xarray.testing.assert_identical(group.to_dataset(), other[name].to_dataset())


@pytest.mark.parametrize("what", ["mode", "latents"])
def test_ctrl_c_while_nothing_is_kept_or_all_is(command, bench, tmp_path, monkeypatch, what):
    interrupt_at(monkeypatch, what)
    out = tmp_path / "posterior.nc"
    stopped = command("sample", bench.model, bench.log, *settings(*FEW), "--out", out)
    assert (stopped.code, stopped.err) == (130, "interrupted; no file was left half written\n")
    left = ["posterior.nc.unfinished"] if what == "latents" else []
    assert [path.name for path in tmp_path.iterdir()] == left
    assert ("add --resume" in stopped.out) is bool(left)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--out", "posterior.csv"), "expected a file name that ends in .nc (netCDF), got '.csv'; name one"),
        (("--out", "posterior"), "expected a file name that ends in .nc (netCDF), got ''"),
        (("--out", "missing/posterior.nc"), "expected an existing folder"),
        (("--out", "folder.nc"), "expected a file name to write to, found a folder"),
        (("--set", "model.noise_sd=1"), "such as sampling.draws=1000, got 'model.noise_sd=1', which is part of"),
        (("--set", "draws=10"), "expected a key of sampling, such as sampling.draws=1000, got 'draws=10'"),
        (("--set", "sampling.drawz=10"), "unknown key 'sampling.drawz'; did you mean 'draws'?"),
        (("--set", "sampling.draws=0"), "sampling.draws"),
        (("--set", "sampling.draws"), "expected KEY=VALUE"),
        (("--set", "sampling.method=gibbs"), "sampling.method"),
        (("--method", "gibbs"), "gibbs"),
        (("--given", "none"), "none"),
        (("--figures", "file"), "file: could not be created"),
    ],
)  # fmt: skip
def test_what_is_refused(command, bench, tmp_path, monkeypatch, options, sentence):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.nc").mkdir()
    (tmp_path / "file").write_text("", encoding="utf-8")
    done = command("sample", bench.model, bench.log, "--out", "posterior.nc", *options)
    assert (done.code, done.out) == (2, "")
    assert sentence in " ".join(done.err.split())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.nc"]


def test_logs_and_models_that_are_none(command, bench, tmp_path):
    out, figures = tmp_path / "posterior.nc", tmp_path / "figures"
    for arguments in (
        (tmp_path / "no", bench.log),
        (bench.model, tmp_path / "no.csv"),
        (bench.log, bench.model),
    ):
        done = command("sample", *arguments, "--out", out, "--figures", figures)
        assert (done.code, done.out) == (2, "") and "Traceback" not in done.err
        assert done.err.count("\n") == 1, done.err
    assert list(tmp_path.iterdir()) == []


def test_a_density_that_is_nowhere_finite_is_one_sentence(command, bench, tmp_path, monkeypatch):
    def fails(self, *_):
        raise NotPositiveDefiniteError("expected this, found that; mend it")

    monkeypatch.setattr(fit.Climb, "__call__", fails)
    done = command("sample", bench.model, bench.log, "--out", tmp_path / "posterior.nc")
    assert (done.code, done.out) == (2, "") and "expected this, found that" in done.err
    assert list(tmp_path.iterdir()) == []


def test_progress_shows_what_is_done_now():
    stream = io.StringIO()
    with terminal.sampling_progress(Console(file=stream, force_terminal=True, width=100)) as hook:
        hook("mode", 7, 0, "log posterior -3.10")
        hook("chain 1", 100, 1000, "warm-up, step size .1")
        hook("chain 2", 10, 1000, "warm-up, step size .2")
        hook("latents", 5, 10, "")
    shown = stream.getvalue()
    assert "latents" in shown
    # What was drawn last shows what is being done, and what has ended no longer.
    assert "mode" not in shown[shown.rindex("latents") :]


def test_what_chains_died_of_is_printed_as_it_is():
    class Posterior:
        class diagnosis:  # noqa: N801
            summary = "nuts: 1 chains [of] 2 draws"
            findings = ("chain 2 died of IndexError: [/bold] out of range",)

    console = Console(file=(stream := io.StringIO()), width=200)
    terminal.print_diagnosis(console, Posterior())
    assert "[/bold] out of range" in stream.getvalue() and "[of]" in stream.getvalue()
