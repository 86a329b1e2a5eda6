"""What looks wrong is said once, of the recording it is in; what is right is not mentioned."""

import numpy as np
import pandas as pd
import pytest

from bayes_impedance.config import parse_config
from bayes_impedance.errors import LogError
from bayes_impedance.inspection.inspect import inspect_recordings
from bayes_impedance.simulation.device import BandLimitedForce
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.subjects import SUBJECTS
from bayes_impedance.simulation.tasks import FigureEight
from bayes_impedance.writer import write_log

TIME = np.arange(1000) / 100.0
CONFIG = parse_config({})


def table(seed: int, **changes: np.ndarray) -> pd.DataFrame:
    rng = np.random.default_rng(seed)
    angle = 1.7 * TIME + seed
    columns = {
        "time": TIME,
        "position_x": 0.1 * np.sin(angle),
        "velocity_x": 0.17 * np.cos(angle),
        "force_x": 4.0 * np.cos(angle) + 0.1 * rng.normal(size=len(TIME)),
    }
    return pd.DataFrame(columns | changes)


def written(folder, name, frame):
    frame.to_csv(folder / name, index=False)
    return folder / name


def sentences(files, config=CONFIG):
    return [finding.sentence for finding in inspect_recordings(files, config).findings]


def test_a_clean_recording_has_no_findings(tmp_path):
    assert sentences([written(tmp_path, "a.csv", table(0))]) == []


def test_a_simulated_recording_has_no_findings(tmp_path):
    person = next(iter(SUBJECTS.values()))
    log = simulate(Experiment([person], FigureEight(), trials=1, perturbation=BandLimitedForce(2.0)))
    write_log(log, tmp_path / "a.csv")
    inspection = inspect_recordings([tmp_path / "a.csv"], CONFIG)
    assert inspection.findings == ()
    assert inspection.law is not None
    np.testing.assert_allclose(inspection.law.mass, 2.0, rtol=0.02)
    np.testing.assert_allclose(inspection.law.damping, 6.0, rtol=0.02)


def test_what_is_wrong_with_several_recordings_is_said_once(tmp_path):
    held = np.repeat(table(1)["force_x"].to_numpy()[::2], 2)
    files = [
        written(tmp_path, "a.csv", table(0)),
        written(tmp_path, "b.csv", table(1, force_x=held)),
        written(tmp_path, "c.csv", table(2, force_x=held)),
    ]
    (sentence,) = sentences(files)
    assert sentence.startswith("b.csv, and so in 2 recordings: force_x: 50 % of samples repeat")


def test_a_single_recording_need_not_be_named(tmp_path):
    held = np.repeat(table(1)["force_x"].to_numpy()[::2], 2)
    (sentence,) = sentences([written(tmp_path, "b.csv", table(1, force_x=held))])
    assert sentence.startswith("force_x: 50 % of samples repeat")


def test_a_hand_that_rests_and_a_moment_of_motion(tmp_path):
    still = written(
        tmp_path, "still.csv", table(0, position_x=1e-5 * np.sin(TIME)).drop(columns="velocity_x")
    )
    assert any(
        "the hand moves by 0.02 mm; leave the trial out" in sentence for sentence in sentences([still])
    )
    short = written(tmp_path, "short.csv", table(0)[:60])
    assert any(
        "60 samples in 0.59 s are too few to learn from" in sentence for sentence in sentences([short])
    )


def test_gaps_are_listed_the_longest_first(tmp_path):
    time = TIME.copy()
    for row, gap in ((100, 0.1), (300, 0.4), (500, 0.2), (700, 0.3)):
        time[row:] += gap
    (sentence,) = sentences([written(tmp_path, "a.csv", table(0, time=time).drop(columns="velocity_x"))])
    assert sentence.startswith(
        "a.csv, trial 0: 4 gaps in the time stamps, the longest of 0.41 s at 3.09 s, 0.31 s"
    )


def test_a_refusal_keeps_what_was_found_before_it(tmp_path):
    time = TIME.copy()
    time[500:] += 2.0
    inspection = inspect_recordings([written(tmp_path, "a.csv", table(0, time=time))], CONFIG)
    assert isinstance(inspection.refusal, LogError)
    assert inspection.log is not None
    assert inspection.prepared is None
    assert "1 gap" in inspection.findings[0].sentence
    with pytest.raises(LogError, match="no such file"):
        inspect_recordings([tmp_path / "absent.csv"], CONFIG)


def test_windows_are_compared_with_the_one_that_is_configured(tmp_path):
    inspection = inspect_recordings([written(tmp_path, "a.csv", table(0))], CONFIG)
    windows = [effect.window for effect in inspection.smoothing]
    np.testing.assert_allclose(windows, [0.07, 0.11, 0.21])
    assert [effect.bandwidth[0] for effect in inspection.smoothing] == sorted(
        (effect.bandwidth[0] for effect in inspection.smoothing), reverse=True
    )
