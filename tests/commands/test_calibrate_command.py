"""The command `calibrate`, as a user types it."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from bayes_impedance.calibration.draw import Settings
from bayes_impedance.calibration.records import FILE
from bayes_impedance.cli import app
from bayes_impedance.commands import calibrate as calibrate_module
from bayes_impedance.commands.calibrate import recorded_motion, synthetic_motion
from bayes_impedance.config import load_config
from bayes_impedance.errors import ConfigurationError, OutputError
from bayes_impedance.sampling.draws import Draws
from bayes_impedance.simulation.generative import as_recording, draw_force, repeated_motion
from bayes_impedance.writer import write_log

#: A problem of four coordinates.
SMALL = [
    "engine.impedance=map", "model.desired_trajectory.mean=reference", "model.residual=null",
    "model.desired_trajectory.kernel=matern52", "model.desired_trajectory.sd=0.02",
    "model.desired_trajectory.length_scale.phase=0.2", "model.stiffness.input=[]", "model.damping.input=[]",
    "training.gradient_tolerance=0.1", "training.max_iterations=20", "sampling.chains=1", "sampling.draws=50",
]  # fmt: skip


def run(*arguments: str, changes: list[str] = SMALL):
    settings = [part for change in changes for part in ("--set", change)]
    return CliRunner().invoke(app, ["calibrate", "--config", "phase", *settings, *arguments])


def of_prior(density, config):
    """Draws of the prior, which take no time."""
    generator = np.random.default_rng(config.sampling.seed)
    return Draws("laplace", generator.standard_normal((1, 50, density.size)), {}, pareto_k=0.0)


def test_table_figures_and_json(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(calibrate_module, "Settings", partial(Settings, sampler=of_prior))
    arguments = [
        "--draws", "20", "--method", "laplace", "--samples", "6", "--thinned", "19", "--processes", "1",
        "--out", str(tmp_path / "runs"), "--json", str(tmp_path / "ranks.json"),
    ]  # fmt: skip
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    printed = " ".join(result.output.split())
    assert "Ranks of 20 truths among draws of laplace" in printed
    assert "log stiffness x" in printed and "desired position x" in printed
    for name in ("rank_histograms.png", "ecdf_differences.png", FILE):
        assert (tmp_path / "runs" / name).stat().st_size > 1000
    content = json.loads((tmp_path / "ranks.json").read_text())
    assert content["method"] == "laplace" and content["draws"] == 20
    assert all(len(found["ranks"]) == 20 for found in content["quantities"].values())
    # Once more: nothing is drawn anew.
    before = (tmp_path / "runs" / FILE).read_bytes()
    assert run(*arguments).exit_code == 0
    assert (tmp_path / "runs" / FILE).read_bytes() == before


def test_bad_input_is_refused_before_anything_is_drawn(tmp_path: Path) -> None:
    assert isinstance(run("--json", str(tmp_path / "no" / "ranks.json")).exception, OutputError)
    result = run("--draws", "5")
    assert isinstance(result.exception, ConfigurationError)
    assert "--draws: expected at least 20 draws" in str(result.exception)
    assert run("--method", "gibbs").exit_code == 2
    # On synthetic motion the hand is not a function of phase, either.
    refused = run(changes=["model.desired_trajectory.mean=equilibrium"]).exception
    assert isinstance(refused, ConfigurationError) and "desired_trajectory.mean" in str(refused)


def test_motion_of_a_recording(tmp_path: Path) -> None:
    config = load_config("phase", [*SMALL, "preprocessing.rate=10", "preprocessing.smoother.window=0.14"])
    drawn = draw_force(config, repeated_motion(2, 2.0, 50.0, axes=("x",)), seed=0)
    write_log(as_recording(drawn, keep_reference=True), tmp_path / "log.csv")
    motion = recorded_motion(config, tmp_path / "log.csv")
    assert motion.axes == ("x",) and len(motion.trials) == 2
    assert motion.trials[0].position.shape == (20, 1)
    assert motion.trials[0].position[5:10, 0] == pytest.approx(drawn.trials[0].position[25:50:5, 0], abs=2e-3)


def test_synthetic_motion_has_the_axes_of_the_configuration() -> None:
    motion = synthetic_motion(load_config("phase", ["log.axes=[y, z]"]), 3, 7)
    assert motion.axes == ("y", "z") and [trial.n_samples for trial in motion.trials] == [7, 7, 7]
    assert synthetic_motion(load_config("phase"), 1, 7).axes == ("x",)
