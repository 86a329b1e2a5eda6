"""Estimators in the table of the impedance model: the same samples, the same scores, refused before anything trains."""

import json
from dataclasses import replace

import numpy as np
import pytest

from bayes_impedance.baselines.ensemble import EnsembleModel
from bayes_impedance.baselines.kalman import ExtendedKalmanFilter
from bayes_impedance.baselines.recursive import RecursiveLeastSquares
from bayes_impedance.errors import LogError
from bayes_impedance.evaluation import contenders
from bayes_impedance.evaluation.cross_validation import as_json as folds_as_json
from bayes_impedance.evaluation.cross_validation import cross_validate
from bayes_impedance.evaluation.folds import split
from bayes_impedance.evaluation.held_out import as_json, evaluate
from bayes_impedance.evaluation.metrics import score
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.persistence import save_model
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.readers import read_log

ESTIMATORS = {
    "ensemble": ("ensemble_coupled", EnsembleModel),
    "ensemble-diagonal": ("ensemble_diagonal", lambda config, log: EnsembleModel(config, log, coupled=False)),
    "rls": ("recursive_least_squares", RecursiveLeastSquares),
    "ekf": ("extended_kalman_filter", ExtendedKalmanFilter),
}
NAMES = [name for name, _ in ESTIMATORS.values()]


@pytest.fixture(scope="module")
def other(tiny):
    return tiny.fitted.prepare(read_log(tiny.other, tiny.config.log))


@pytest.fixture(scope="module")
def three(tiny):
    """The three repetitions in one log."""
    return ImpedanceModel(tiny.config).prepare(read_log([tiny.log, tiny.other], tiny.config.log))


def own_score(predicted, test, training, axis):
    force, past = (np.concatenate([trial.force[:, axis] for trial in log.trials]) for log in (test, training))
    return score(predicted.mean[:, axis], predicted.sd[:, axis], force, past)


def test_rows_are_the_scores_of_the_estimators_on_the_model_s_samples(tiny, other):
    training = tiny.fitted.fitted.log
    scores = evaluate(tiny.fitted, other, list(ESTIMATORS))
    for a, axis in enumerate("xy"):
        assert list(scores[axis]) == ["impedance", *NAMES]
        for name, estimator in ESTIMATORS.values():
            expected = own_score(estimator(tiny.config, training).predict(other), other, training, a)
            assert scores[axis][name] == expected
        # They have no posterior of the impedance's force.
        assert list(scores.impedance_share[axis]) == ["impedance"]
    content = json.loads(json.dumps(as_json(scores)))
    assert [list(rows) for rows in content["axes"].values()] == [["impedance", *NAMES]] * 2


@pytest.mark.parametrize("folds", ["trials", "last-third"])
@pytest.mark.filterwarnings("ignore:.*phases that no training sample has")
def test_folds_train_estimators_anew(tiny, three, folds):
    result = cross_validate(ImpedanceModel(tiny.config), three, folds, list(ESTIMATORS))
    for fold, found in zip(split(three, tiny.config, folds), result.folds, strict=True):
        known = np.concatenate([trial.observed for trial in fold.test.trials])
        force, past = (
            np.concatenate([trial.force[trial.observed] for trial in log.trials])
            for log in (fold.test, fold.training)
        )
        for name, estimator in ESTIMATORS.values():
            predicted = estimator(tiny.config, fold.training).predict(fold.target)
            for a, axis in enumerate("xy"):
                mean, sd = predicted.mean[known, a], predicted.sd[known, a]
                assert found.evaluation[axis][name] == score(mean, sd, force[:, a], past[:, a])
    content = json.loads(json.dumps(folds_as_json(result), allow_nan=False))
    for level in (content, *content["folds"]):
        assert [list(rows) for rows in level["axes"].values()] == [["impedance", *NAMES]] * 2


def test_forces_of_the_tested_log_do_not_change_a_prediction(tiny, other):
    false = PreparedLog(other.axes, tuple(replace(trial, force=trial.force + 100) for trial in other.trials))
    for _, estimator in ESTIMATORS.values():
        model = estimator(tiny.config, tiny.fitted.fitted.log)
        np.testing.assert_array_equal(model.predict(other).mean, model.predict(false).mean)


def without_phase(log: PreparedLog) -> PreparedLog:
    return PreparedLog(
        log.axes,
        tuple(
            replace(trial, phase=None, phase_velocity=None, phase_acceleration=None) for trial in log.trials
        ),
    )


def in_group(log: PreparedLog, group: str) -> PreparedLog:
    return PreparedLog(log.axes, tuple(replace(trial, group=group) for trial in log.trials))


@pytest.fixture
def timeless(tiny):
    """A model of time, which a log without phase can serve."""
    changed = tiny.config.model.model_copy(
        update={
            "trajectory_input": "time",
            "desired_trajectory": tiny.config.model.desired_trajectory.model_copy(
                update={"mean": "equilibrium"}
            ),
            "stiffness": tiny.config.model.stiffness.model_copy(update={"input": ()}),
            "damping": tiny.config.model.damping.model_copy(update={"input": ()}),
        }
    )
    return ImpedanceModel(tiny.config.model_copy(update={"model": changed}))


@pytest.mark.parametrize("baseline", ["ensemble", "ensemble-diagonal"])
def test_a_log_that_an_ensemble_can_do_nothing_with_is_refused_before_anything_is_trained(
    timeless, three, other, monkeypatch, baseline
):
    log = without_phase(three)
    model = timeless.fit(log.select([0, 1]))
    monkeypatch.setattr(contenders.Contender, "train", lambda *_: pytest.fail("too late"))
    with pytest.raises(
        LogError, match="trial 0: expected a phase column, for this estimate knows the force of"
    ):
        evaluate(model, without_phase(other), ["naive", baseline])
    with pytest.raises(LogError, match="expected a phase column, for this estimate knows the force of"):
        cross_validate(timeless, log, baselines=[baseline])
    pair = three.select([0, 1])
    with pytest.raises(
        LogError, match="^group '0': expected at least two repetitions of known force, .* found 1"
    ):
        cross_validate(timeless, pair, baselines=[baseline])


@pytest.mark.parametrize("baseline", ESTIMATORS)
def test_a_group_that_was_not_trained_on_is_refused_before_anything_is_trained(
    timeless, three, other, monkeypatch, baseline
):
    model = timeless.fit(three.select([0, 1]))
    monkeypatch.setattr(contenders.Contender, "train", lambda *_: pytest.fail("too late"))
    with pytest.raises(
        LogError, match=r"trial 2: expected a group whose impedance was estimated \(0\), got group 'b'"
    ):
        evaluate(model, in_group(other, "b"), [baseline])


@pytest.mark.parametrize("baseline", ["rls", "ekf"])
def test_recursive_estimators_need_no_phase(timeless, three, baseline):
    log = without_phase(three)
    scores = evaluate(timeless.fit(log.select([0, 1])), log.select([2]), [baseline])
    for axis in "xy":
        row = scores[axis][ESTIMATORS[baseline][0]]
        assert np.isfinite([row.smse, row.msll]).all()


def test_command_prints_and_writes_every_row(command, tiny, tmp_path):
    """Names are whole on a narrow terminal too: broken, not cut off."""
    file = tmp_path / "scores.json"
    baselines = [part for baseline in ESTIMATORS for part in ("--baseline", baseline)]
    done = command("evaluate", tiny.model, tiny.other, *baselines, "--json", file)
    assert (done.code, done.err) == (0, "")
    content = json.loads(file.read_text())
    for axis in "xy":
        rows = content["axes"][axis]
        assert list(rows) == ["impedance", *NAMES]
        for name in NAMES:
            assert f"{rows[name]['smse']:.4f}" in done.out
    cells = [line.split("│")[2].strip() for line in done.out.splitlines() if line.startswith("│")]
    for name in NAMES:
        assert "".join(cells).count(name) == 2


def test_command_refuses_in_one_sentence(command, timeless, three, tmp_path):
    save_model(timeless.fit(three.select([0, 1])), tmp_path / "model")
    log = tmp_path / "log.csv"
    rows = [f"{i / 50},{np.sin(i / 9)},{i % 7},{np.cos(i / 9)},{i % 5}" for i in range(60)]
    log.write_text("\n".join(["time,position_x,force_x,position_y,force_y", *rows]), encoding="utf-8")
    done = command("evaluate", tmp_path / "model", log, "--baseline", "rls")
    assert (done.code, done.out.count("│")) == (2, 0)
    assert done.err.startswith("error: log.csv, trial 0: expected a phase column, for this estimate knows")
