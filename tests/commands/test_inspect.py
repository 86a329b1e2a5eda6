"""The command `inspect`: on tables whose columns must be guessed, on damaged and on real recordings."""

import re

import numpy as np
import pandas as pd
import pytest
import yaml

from bayes_impedance.commands.inspection_tables import compressed
from bayes_impedance.config import load_config
from bayes_impedance.readers import read_log

TIME = np.arange(1200) / 100.0


@pytest.fixture
def passive():
    """A person who moves a robot of 3 kg and 12 Ns/m along two axes; every 200 samples of `table` a trial."""
    rng = np.random.default_rng(0)
    table = {"t": TIME}
    for axis, rate in (("x", 1.3), ("y", 2.1)):
        angle = rate * TIME + 0.6 * np.sin(5 * TIME)
        turn = rate + 3.0 * np.cos(5 * TIME)
        velocity = 0.1 * turn * np.cos(angle)
        acceleration = 0.1 * (-15.0 * np.sin(5 * TIME) * np.cos(angle) - turn**2 * np.sin(angle))
        table[axis] = 0.1 * np.sin(angle)
        table[f"v{axis}"] = velocity
        table[f"F{axis}"] = 3.0 * acceleration + 12.0 * velocity + 0.05 * rng.normal(size=len(TIME))
    return pd.DataFrame(table)


def test_a_table_of_unknown_columns_is_guessed_and_its_draft_reads_it(command, tmp_path, passive):
    log, draft, figure = tmp_path / "log.csv", tmp_path / "draft.yaml", tmp_path / "log.png"
    (1000 * passive).assign(Fx=passive.Fx, Fy=passive.Fy).to_csv(log, index=False)
    outcome = command("inspect", log, "--write-config", draft, "--figure", figure)
    assert outcome.code == 0, outcome.err
    assert "Nothing looks wrong" in outcome.out
    assert figure.stat().st_size > 10_000
    content = yaml.safe_load(draft.read_text(encoding="utf-8"))
    assert content["log"]["columns"] == {
        "position": "{axis}", "force": "F{axis}", "velocity": "v{axis}", "time": "t",
    }  # fmt: skip
    assert content["log"]["units"] == {"position": "mm", "time": "ms", "velocity": "mm/s"}
    read = read_log(log, load_config(draft).log)
    np.testing.assert_allclose(read.trials[0].position, passive[["x", "y"]], atol=1e-12)
    np.testing.assert_allclose(read.trials[0].time, passive.t, atol=1e-9)
    np.testing.assert_allclose(read.trials[0].force, passive[["Fx", "Fy"]], atol=1e-9)


def test_the_law_of_the_robot_is_shown_and_proposed(command, tmp_path, passive):
    log, draft = tmp_path / "log.csv", tmp_path / "draft.yaml"
    passive.to_csv(log, index=False)
    outcome = command("inspect", log, "--write-config", draft)
    assert "R² over all axes: 0.99" in outcome.out or "R² over all axes: 1.00" in outcome.out
    (line,) = [line for line in draft.read_text(encoding="utf-8").splitlines() if line.startswith("# device")]
    device = yaml.safe_load(line.removeprefix("# "))["device"]
    assert device["mass"] == pytest.approx({"x": 3.0, "y": 3.0}, rel=0.1)
    assert device["damping"] == pytest.approx({"x": 12.0, "y": 12.0}, rel=0.1)


def test_what_looks_wrong_is_said_and_stands_in_the_draft(command, tmp_path, passive):
    faulty = passive.assign(Fx=-passive.Fx, Fy=-passive.Fy, vx=2.0 * passive.vx, vy=2.0 * passive.vy)
    faulty.loc[500:, "t"] += 0.9
    faulty = pd.concat([faulty[:300], faulty[299:]])
    log, draft = tmp_path / "log.csv", tmp_path / "draft.yaml"
    faulty.to_csv(log, index=False)
    outcome = command("inspect", log, "--write-config", draft)
    assert outcome.code == 0, outcome.err
    said = " ".join(outcome.out.split())
    for expected in (
        "sign of the force looks reversed",
        "velocity_x: velocity is 2.00 times the derivative of position",
        "1 gap in the time stamps, 0.91 s at 4.99 s",
    ):
        assert expected in said
    text = draft.read_text(encoding="utf-8")
    content = yaml.safe_load(text)
    assert "# - sign of the force looks reversed" in text
    assert content["log"]["clock"] == {"duplicates": "drop"}
    assert content["log"]["columns"]["velocity"] is None
    assert content["preprocessing"]["segmentation"] == {"gaps": "split", "trim_rest": True}
    # The draft reads what the defaults refuse.
    assert command("inspect", log, "--config", draft).code == 0


def test_a_configuration_that_cannot_read_ends_in_its_sentence(command, tmp_path, passive):
    log = tmp_path / "log.csv"
    passive.to_csv(log, index=False)
    outcome = command("inspect", log, "--config", "phase")
    assert outcome.code == 2
    assert "log.csv: t, x, vx, Fx" in outcome.out
    assert "expected column 'position_x', found none of that name" in " ".join(outcome.err.split())


def test_columns_that_say_nothing(command, tmp_path):
    log = tmp_path / "log.csv"
    pd.DataFrame({"alpha": TIME, "beta": TIME**2}).to_csv(log, index=False)
    outcome = command("inspect", log)
    assert outcome.code == 2
    assert "expected names such as position_x, x or pos, found none that looks like a position" in " ".join(
        outcome.err.split()
    )


def test_a_table_without_time_gets_a_placeholder(command, tmp_path, passive):
    log, draft = tmp_path / "log.csv", tmp_path / "draft.yaml"
    passive[["x", "y", "Fx", "Fy"]].to_csv(log, index=False)
    assert command("inspect", log, "--write-config", draft).code == 0
    assert "log.sampling_rate is a placeholder" in draft.read_text(encoding="utf-8")
    passive.drop(columns="t").to_csv(log, index=False)
    assert command("inspect", log, "--write-config", draft).code == 0
    assert yaml.safe_load(draft.read_text(encoding="utf-8"))["log"]["sampling_rate"] == pytest.approx(
        100, rel=0.01
    )


def test_trials_are_compared_by_phase(command, tmp_path, passive):
    log, draft = tmp_path / "log.csv", tmp_path / "draft.yaml"
    passive.assign(trial=np.arange(1200) // 200).to_csv(log, index=False)
    assert command("inspect", log, "--write-config", draft).code == 0
    content = yaml.safe_load(draft.read_text(encoding="utf-8"))
    assert content["extends"] == "phase"
    assert content["preprocessing"]["phase"] == {"source": "path"}
    outcome = command(
        "inspect", log, "--config", draft, "--set", "preprocessing.segmentation.trim_rest=false"
    )
    assert outcome.code == 0, outcome.err
    assert "0.000 … 1.000" in outcome.out


def test_a_known_configuration_is_written_with_what_was_set(command, tmp_path, tiny):
    written = tmp_path / "own.yaml"
    outcome = command("inspect", tiny.log, *tiny.settings, "--write-config", written)
    assert outcome.code == 0, outcome.err
    assert load_config(written) == tiny.config


def test_nothing_is_written_where_it_cannot_be(command, tmp_path, passive):
    log = tmp_path / "log.csv"
    passive.to_csv(log, index=False)
    outcome = command("inspect", log, "--write-config", tmp_path / "no" / "draft.yaml")
    assert outcome.code == 2
    assert "expected an existing folder" in " ".join(outcome.err.split())
    assert command("inspect", tmp_path / "absent.csv").code == 2


def test_names_are_said_once():
    names = ["t", "a[0]", "a[1]", "a[2]", "/b.c.x", "/b.c.y", "/b.d[0]", "/e.f"]
    assert compressed(names) == ["t", "a[0…2]", "/b.(c.x, c.y, d[0])", "/e.f"]


# --- real recordings -----------------------------------------------------------------------------


@pytest.mark.parametrize("run", [1, 2, 3])
def test_the_law_of_a_real_robot(command, shared_data, run):
    outcome = command(
        "inspect", shared_data / "gp_mpc" / "rail" / f"{run}.bag", "--config", "recordings/gp_mpc"
    )
    assert outcome.code == 0, outcome.err
    (line,) = [line for line in outcome.out.splitlines() if "R² over all axes" in line]
    assert float(line.split(":")[1]) >= 0.75


def test_a_file_of_six_tracings(command, shared_data, tmp_path):
    recording = shared_data / "panda_comanipulation" / "symbol_17_data.mat"
    draft = tmp_path / "draft.yaml"
    outcome = command("inspect", recording, "--write-config", draft)
    assert outcome.code == 0, outcome.err
    assert "6 recordings: pos[0…2], vel[0…2], F[0…2]" in outcome.out
    assert load_config(draft).log.sampling_rate == pytest.approx(695, rel=0.01)
    outcome = command("inspect", recording, "--config", "recordings/panda_comanipulation")
    phases = re.findall(r"0\.000 … (\d\.\d+)", outcome.out)
    assert len(phases) == 6
    # Thinned to 10 Hz a trace ends within a tenth of a second of its end.
    assert min(map(float, phases)) > 0.98


def test_a_bag_without_pose_and_wrench(command, shared_data):
    outcome = command("inspect", shared_data / "kuka_jointstate_only" / "test.bag")
    assert outcome.code == 2
    said = " ".join(outcome.err.split())
    assert "expected a pose" in said
    assert "and a wrench" in said
    assert "/joint_states (sensor_msgs/JointState)" in said


def test_velocities_that_go_another_way(command, shared_data):
    (file,) = (shared_data / "iiwa_known_equilibrium").glob("*.txt")
    outcome = command("inspect", file)
    assert "velocity_x: velocity goes another way than the derivative of position" in " ".join(
        outcome.out.split()
    )


def test_a_third_of_a_second_is_refused(command, shared_data):
    short = shared_data / "gp_mpc" / "loader_edge_cases" / "polish_flat2_2_only31msgs.bag"
    outcome = command("inspect", short, "--config", "recordings/gp_mpc")
    assert outcome.code == 2
    assert "31 samples in 0.3 s are too few to learn from" in " ".join(outcome.out.split())
    assert "expected 0.5 s without gap, found at most 0.303096 s" in " ".join(outcome.err.split())
