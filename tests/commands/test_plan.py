"""The command `plan`: its table, figure and JSON, what it takes, and what it refuses."""

import io
import json

import pytest
from rich.console import Console

from bayes_impedance import load_config, terminal
from bayes_impedance.commands import plan as plan_command
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.persistence import load_model, save_model
from bayes_impedance.simulation.arm import arm_with
from bayes_impedance.simulation.device import BandLimitedForce, ForcePulses
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.planning import plan
from bayes_impedance.simulation.subjects import SUBJECTS, Subject
from bayes_impedance.simulation.tasks import FigureEight, Pace, Reaches

SETTINGS = (
    "preprocessing.rate=10",
    "model.desired_trajectory.average_knots=2",
    "training.max_iterations=2",
)
PERSON = Subject("low", arm_with("low"), Pace(repetition=2.0))
EXPERIMENT = Experiment([PERSON], FigureEight(), repetitions=1, perturbation=BandLimitedForce(1.0))
SMALL = ("plan", "--duration", "2", "--repetitions", "4,2", "--perturbations", "5,0", "--motions", "1")


@pytest.fixture
def small():
    """Arguments of a plan that takes a blink."""
    return [*SMALL, *(argument for setting in SETTINGS for argument in ("--set", setting))]


def test_plan_prints_draws_and_writes(command, small, tmp_path):
    figure, file = tmp_path / "plan.png", tmp_path / "plan.json"
    done = command(*small, "--width", "1.5", "--figure", figure, "--json", file)
    assert (done.code, done.err) == (0, "")
    said = " ".join(done.out.split())
    assert "Width of the 90 % interval of stiffness, over its median" in said
    assert (
        "An interval of 1.5 of the median along every axis needs: stiffness, 0 N: none of the numbers" in said
    )
    assert "A width is how far estimates scatter, not how far they may be off" in said
    assert said.endswith(f"wrote {figure} wrote {file}")
    assert figure.read_bytes().startswith(b"\x89PNG")
    planned = plan(
        EXPERIMENT, ImpedanceModel(load_config("admittance", SETTINGS)), [2, 4], [0.0, 5.0], motions=1
    )
    assert json.loads(file.read_text(encoding="utf-8")) == {
        "wanted_width": 1.5,
        "unit": "N",
        "smallest": {f"{force:g}": count for force, count in planned.smallest(1.5).items()},
        "designs": planned.table().to_dict(orient="records"),
    }
    for axis in planned.axes:
        for entry in planned.along("stiffness", axis, 5.0):
            verdict = entry.support.name.lower().replace("_", " ")
            assert f"{entry.width:.2f} {verdict}" in said


@pytest.mark.parametrize(
    ("options", "experiment"),
    [
        ((), ("low", arm_with("low"), FigureEight(), BandLimitedForce)),
        (("--stiffness", "high"), ("high", arm_with("high"), FigureEight(), BandLimitedForce)),
        (("--subject", "C"), ("C", SUBJECTS["C"].arm, FigureEight(), BandLimitedForce)),
        (("--task", "reaches", "--kind", "pulses"), ("low", arm_with("low"), Reaches(), ForcePulses)),
    ],
)
def test_options_make_the_experiment(command, small, monkeypatch, options, experiment):
    seen = []

    def planned(*arguments, **_):
        seen.append(arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(plan_command, "plan", planned)
    done = command(*small, *options, "--seed", "7")
    assert (done.code, done.out, done.err) == (130, "", "interrupted; no file was left half written\n")
    ((template, model, counts, forces, seed, motions),) = seen
    (person,) = template.subjects
    assert (person.name, person.arm, template.task, type(template.perturbation)) == experiment
    assert (person.pace.repetition, template.repetitions) == (2.0, 1)
    assert (counts, forces, seed, motions) == ([4, 2], [5.0, 0.0], 7, 1)
    assert (model.is_fitted, model.config) == (False, load_config("admittance", SETTINGS))


def test_a_model_of_a_pilot_recording_brings_its_hyperparameters(command, tmp_path):
    model = ImpedanceModel(load_config("admittance", [*SETTINGS, "training.restarts=1"]))
    save_model(model.fit(simulate(EXPERIMENT, seed=9)), tmp_path / "pilot")
    file = tmp_path / "plan.json"
    done = command(*SMALL, "--pilot", tmp_path / "pilot", "--json", file)
    assert (done.code, done.err) == (0, "")
    planned = plan(EXPERIMENT, load_model(tmp_path / "pilot"), [2, 4], [0.0, 5.0], motions=1)
    written = json.loads(file.read_text(encoding="utf-8"))["designs"]
    assert written == planned.table().to_dict(orient="records")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--repetitions", "2;4"), "--repetitions: expected numbers with commas between, such as 2,4,8, got '2;4'"),
        (("--repetitions", "2.5"), "--repetitions: expected numbers with commas between"),
        (("--repetitions", ""), "--repetitions: expected numbers with commas between, such as 2,4,8, got ''"),
        (("--perturbations", "one"), "--perturbations: expected numbers with commas between"),
        (("--perturbations", "nan"), "perturbations: expected finite values >= 0, got nan"),
        (("--width", "0"), "width: expected a finite value > 0, got 0; .2 asks for an interval of a fifth"),
        (("--stiffness", "low", "--subject", "A"), "expected --stiffness or --subject, got both"),
        (("--duration", "0"), "pace.repetition: expected a finite value > 0, got 0"),
        (("--figure", "missing/plan.png"), "expected an existing folder"),
    ],
)  # fmt: skip
def test_what_is_refused(command, tmp_path, monkeypatch, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    done = command("plan", *arguments)
    assert (done.code, done.out) == (2, "")
    assert sentence in " ".join(done.err.split())
    assert list(tmp_path.iterdir()) == []


def test_progress_counts_sessions():
    stream = io.StringIO()
    with terminal.planning_progress(Console(file=stream, force_terminal=True, width=100)) as hook:
        hook(2, 9, "5 N")
    assert "planning" in stream.getvalue()
    assert "3/9 5 N" in stream.getvalue()
