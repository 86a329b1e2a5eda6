"""The command `simulate`: a log that reads back as simulated, the same bytes for a seed, one sentence for bad input."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from bayes_impedance.readers import read_log
from bayes_impedance.simulation.arm import arm_with
from bayes_impedance.simulation.device import (
    Admittance,
    BandLimitedForce,
    ForcePulses,
    PositionDisplacement,
    Sensor,
    Sensors,
)
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.subjects import SUBJECTS, Subject
from bayes_impedance.simulation.tasks import FigureEight, Flower, Pace, Reaches
from conftest import Outcome

Command = Callable[..., Outcome]

SHORT = ("--trials", 2, "--repetitions", 1, "--duration", 1.5)
LOW = Subject("low", arm_with("low"), Pace(1.5))


@pytest.mark.parametrize("name", ["log.csv", "log.parquet"])
def test_log_is_read_back_as_it_was_simulated(command: Command, tmp_path: Path, name: str) -> None:
    done = command("simulate", *SHORT, "--perturbation", 2, "--seed", 7, "--out", tmp_path / name)
    log = simulate(Experiment([LOW], Flower(), 2, 1, BandLimitedForce(2.0)), seed=7)
    assert (done.code, done.err) == (0, "")
    assert re.fullmatch(rf"wrote .*{name}: 2 trials, {log.n_samples} samples, truth included\n", done.out)
    assert read_log(tmp_path / name).fingerprint() == log.fingerprint()
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_columns_are_those_of_a_log_and_the_truth(command: Command, tmp_path: Path) -> None:
    command("simulate", *SHORT, "--out", tmp_path / "log.csv")
    table = pd.read_csv(tmp_path / "log.csv")
    vectors = ("position", "force", "reference", "perturbation", "desired_position", "desired_velocity")
    vectors += ("desired_acceleration", "residual_force")
    matrices = ("stiffness", "muscle_stiffness", "damping", "mass")
    assert set(table.columns) == {"trial", "group", "time", "repetition", "phase"} | {
        f"{name}_{axis}" for name in vectors for axis in "xy"
    } | {f"{name}_{axes}" for name in matrices for axes in ("xx", "xy", "yy")}
    assert set(table["trial"]) == {"low-0", "low-1"} and set(table["group"]) == {"low"}


@pytest.mark.parametrize("name", ["log.csv", "log.parquet"])
def test_same_seed_gives_the_same_bytes_and_another_seed_others(
    command: Command, tmp_path: Path, name: str
) -> None:
    written = []
    for folder, seed in (("one", 3), ("two", 3), ("three", 4)):
        (tmp_path / folder).mkdir()
        command("simulate", *SHORT, "--seed", seed, "--out", tmp_path / folder / name)
        written.append((tmp_path / folder / name).read_bytes())
    assert written[0] == written[1] != written[2]


def test_defaults_are_the_papers_simulation(command: Command, tmp_path: Path) -> None:
    command("simulate", "--out", tmp_path / "log.parquet")
    log = simulate(Experiment([Subject("low", arm_with("low"))], Flower()), seed=0)
    assert read_log(tmp_path / "log.parquet").fingerprint() == log.fingerprint()
    assert len(log.trials) == 10 and max(log.trials[0].repetition) == 2


EVERYTHING = replace(LOW, arm=arm_with("low", noise=0.3, reflex_gain=0.2, reflex_delay=0.04))
CHOICES = {
    "high": (
        ["--stiffness", "high"],
        Experiment([Subject("high", arm_with("high"), Pace(1.5))], Flower(), 2, 1),
    ),
    "arm": (
        ["--muscle-noise", 0.3, "--reflex-gain", 0.2, "--reflex-delay", 0.04],
        Experiment([EVERYTHING], Flower(), 2, 1),
    ),
    "figure-eight": (["--task", "figure-eight"], Experiment([LOW], FigureEight(), 2, 1)),
    "reaches": (
        ["--task", "reaches", "--centre", 0.25, 0.3],
        Experiment([LOW], Reaches(centre=(0.25, 0.3)), 2, 1),
    ),
    "pulses": (
        ["--perturbation", 3, "--kind", "pulses"],
        Experiment([LOW], Flower(), 2, 1, ForcePulses(3.0)),
    ),
    "displacement": (
        ["--displacement", 0.005],
        Experiment([LOW], Flower(), 2, 1, PositionDisplacement(0.005)),
    ),
    "device": (
        ["--virtual-mass", 3, "--virtual-damping", 9],
        Experiment([LOW], Flower(), 2, 1, device=Admittance(3.0, 9.0)),
    ),
    "sensors": (
        [
            *(
                "--force-noise",
                0.1,
                "--force-resolution",
                0.2,
                "--force-bias",
                -0.3,
                "--force-latency",
                0.004,
            ),
            *("--position-noise", 1e-5, "--position-resolution", 1e-4),
            *("--position-bias", 0.01, "--position-latency", 0.006),
        ],
        Experiment(
            [LOW],
            Flower(),
            2,
            1,
            sensors=Sensors(Sensor(0.1, 0.2, -0.3, 0.004), Sensor(1e-5, 1e-4, 0.01, 0.006)),
        ),
    ),
    "rate and step": (
        ["--rate", 100, "--step", 0.002],
        Experiment([LOW], Flower(), 2, 1, rate=100.0, step=0.002),
    ),
    "subjects": (
        ["--subject", "C", "--subject", "A", "--subject", "C"],
        Experiment(
            [replace(SUBJECTS[name], pace=replace(SUBJECTS[name].pace, repetition=1.5)) for name in "CA"],
            Flower(),
            2,
            1,
        ),
    ),
}


@pytest.mark.parametrize("choice", CHOICES)
def test_options_reach_the_experiment(command: Command, tmp_path: Path, choice: str) -> None:
    arguments, experiment = CHOICES[choice]
    done = command("simulate", *SHORT, *arguments, "--out", tmp_path / "log.csv")
    assert (done.code, done.err) == (0, "")
    assert read_log(tmp_path / "log.csv").fingerprint() == simulate(experiment, seed=0).fingerprint()


def test_subjects_keep_their_own_pace_and_are_groups(command: Command, tmp_path: Path) -> None:
    command(
        "simulate", "--subject", "A", "--subject", "B", "--trials", 1, "--repetitions", 1,
        "--out", tmp_path / "log.csv",
    )  # fmt: skip
    log = read_log(tmp_path / "log.csv")
    assert log.groups == ("A", "B")
    slow, medium = (trial.time[-1] for trial in log.trials)
    assert slow > 11.0 and medium < 11.0


def test_help_shows_units(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    out = command("simulate", "--help").out
    for option, unit in {
        "--duration": "s", "--centre": "m", "--reflex-delay": "s", "--perturbation": "N", "--displacement": "m",
        "--virtual-mass": "kg", "--virtual-damping": "Ns/m", "--force-noise": "N", "--force-resolution": "N",
        "--force-bias": "N", "--force-latency": "s", "--position-noise": "m", "--position-resolution": "m",
        "--position-bias": "m", "--position-latency": "s", "--rate": "Hz", "--step": "s",
    }.items():  # fmt: skip
        assert re.search(rf"{option} .*\[{unit}\]", out), option


# --- bad input -----------------------------------------------------------------------------------

BAD: dict[str, tuple[list[object], str]] = {
    "unreachable path": (
        ["--centre", 0.6, 0.4],
        r"path: expected positions between 0\.023 and 0\.657 m from the shoulder, got .*; move or shrink the path",
    ),
    "centre that is no number": (["--centre", "nan", 0.3], r"path: expected positions .* got \(nan, "),
    "negative mass": (
        ["--virtual-mass", -1],
        "device.mass: expected a finite value >= 0, got -1.0; choose one",
    ),
    "negative damping": (["--virtual-damping", -1], "device.damping: expected a finite value >= 0, got -1.0"),
    "huge mass": (["--virtual-mass", 1e308], "expected the hand between|within the range of numbers"),
    "negative force noise": (
        ["--force-noise", -0.1],
        "sensor.noise_sd: expected a finite value >= 0, got -0.1",
    ),
    "negative resolution": (["--position-resolution", -1], "sensor.resolution: expected a finite value >= 0"),
    "tiny resolution": (["--force-resolution", 1e-320], "column force_x: expected finite numbers"),
    "infinite bias": (["--force-bias", "inf"], "sensor.bias: expected a finite value, got inf"),
    "negative latency": (["--force-latency", -1], "sensor.latency: expected a finite value >= 0"),
    "huge bias": (["--position-bias", 1e200], "expected motion along axis x, found position_x"),
    "negative muscle noise": (["--muscle-noise", -1], "arm.noise: expected 1 finite value >= 0, got -1.0"),
    "wild muscle noise": (["--muscle-noise", 1e6], "trial low-0: expected the hand between"),
    "negative reflex": (["--reflex-gain", -1], "arm.reflex_gain: expected 1 finite value >= 0"),
    "reflex within a step": (
        ["--reflex-gain", 0.1, "--reflex-delay", 1e-4],
        r"step: expected at most the reflex delay of 0\.0001 s, got 0\.001 s; choose a smaller step",
    ),
    "unstable reflex": (
        ["--stiffness", "high", "--reflex-gain", 20, "--reflex-delay", 0.1, "--duration", 10],
        "trial high-0: expected the hand between .* make perturbation, noise or reflex smaller",
    ),
    "step too large": (
        ["--stiffness", "high", "--step", 0.1, "--rate", 10],
        r"step: expected at most \S+ s, for the fastest mode of arm and device changes at \S+ 1/s, got 0\.1 s",
    ),
    "step that vanishes": (["--step", 1e-320, "--rate", 1e-10], "expected a whole number of steps of"),
    "negative step": (["--step", -1], "step: expected a finite value > 0, got -1; choose one"),
    "rate that is no divisor": (
        ["--rate", 333],
        r"rate: expected a whole number of steps of 0\.001 s between samples, got 333 Hz; choose a divisor of 1000 Hz",
    ),
    "rate of zero": (["--rate", 0], "rate: expected a finite value > 0, got 0; choose one"),
    "rate that vanishes": (["--rate", 1e-320], "rate: expected a whole number of steps"),
    "stiffness of a subject": (
        ["--stiffness", "low", "--subject", "A"],
        "expected --stiffness or --subject, got both, and a subject has a stiffness of their own; leave one out",
    ),
    "unknown subject": (["--subject", "Z"], "subject: expected one of A, B, C, got 'Z'; choose one of them"),
    "perturbation too large": (
        ["--perturbation", 300],
        r"trial low-0: expected the hand between 0\.023 and 0\.657 m from the shoulder, found it elsewhere at",
    ),
    "perturbation beyond all numbers": (["--perturbation", 1e300], "trial low-0: expected the hand between"),
    "negative perturbation": (
        ["--perturbation", -1],
        "perturbation.sd: expected a finite value >= 0, got -1.0",
    ),
    "negative pulses": (
        ["--perturbation", -1, "--kind", "pulses"],
        "perturbation.amplitude: expected a finite value >= 0, got -1.0",
    ),
    "perturbation that is no number": (["--perturbation", "nan"], "perturbation.sd: expected a finite value"),
    "negative displacement": (
        ["--displacement", -0.01],
        "displacement.amplitude: expected a finite value >= 0, got -0.01; choose one",
    ),
    "force and displacement": (
        ["--perturbation", 1, "--displacement", 0.01],
        "expected --perturbation or --displacement, got both; choose whether the device adds a force or moves the hand",
    ),
    "no trials": (["--trials", 0], "trials: expected at least 1, got 0; ask for more"),
    "endless trials": (["--trials", 10**15], "expected at most 10000000 samples in a log"),
    "no repetitions": (["--repetitions", 0], "repetitions: expected at least 1, got 0; ask for more"),
    "no duration": (["--duration", 0], "pace.repetition: expected a finite value > 0, got 0; choose one"),
    "short duration": (
        ["--duration", 1e-300],
        "expected trials of at least two samples, got one of 1e-300 s",
    ),
    "endless duration": (["--duration", 1e12], "expected trials of at most 1000000 steps"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_ends_in_one_sentence_and_writes_nothing(
    command: Command, tmp_path: Path, case: str
) -> None:
    arguments, sentence = BAD[case]
    done = command("simulate", *SHORT, *arguments, "--out", tmp_path / "log.csv")
    assert done.code == 2
    assert re.search(sentence, done.err), done.err
    assert done.err.startswith("error: ") and done.err.count("\n") == 1 and "Traceback" not in done.err
    assert done.out == ""
    assert list(tmp_path.iterdir()) == []


def test_wrong_suffix_is_refused(command: Command, tmp_path: Path) -> None:
    done = command("simulate", *SHORT, "--out", tmp_path / "log.xlsx")
    assert done.code == 2
    assert "log.xlsx: expected a file name ending in .csv or .parquet, got '.xlsx'; rename it" in done.err
    assert list(tmp_path.iterdir()) == []


def test_missing_folder_is_refused(command: Command, tmp_path: Path) -> None:
    done = command("simulate", *SHORT, "--out", tmp_path / "absent" / "log.csv")
    assert done.code == 2
    assert re.search(r"expected an existing folder .*absent to write into, found none; create it", done.err)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--stiffness", "medium"], "'medium' is not one of"),
        (["--task", "spiral"], "'spiral' is not one of"),
        (["--seed", -1], "--seed"),
        (["--trials", "many"], "--trials"),
    ],
)
def test_values_of_another_kind_are_refused(
    command: Command, tmp_path: Path, arguments: list[object], told: str
) -> None:
    done = command("simulate", *arguments, "--out", tmp_path / "log.csv")
    assert done.code == 2
    assert told in done.err
    assert list(tmp_path.iterdir()) == []


def test_log_that_cannot_be_written_leaves_nothing(command: Command, tmp_path: Path, full_disk) -> None:
    with full_disk():
        done = command("simulate", *SHORT, "--out", tmp_path / "log.csv")
    assert done.code == 2
    assert "log.csv: could not be written" in done.err
    assert list(tmp_path.iterdir()) == []
