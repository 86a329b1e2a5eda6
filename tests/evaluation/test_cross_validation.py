"""Cross-validation: the same as a loop by hand, pooled by hand, and blind to what it holds out."""

import json
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from oracles import TRUTH

from bayes_impedance.baselines.naive import NaiveModel
from bayes_impedance.baselines.without_residual import without_residual
from bayes_impedance.config import parse_config
from bayes_impedance.errors import ConfigurationError, LogError, LogWarning, TooManySamplesError
from bayes_impedance.evaluation import contenders, cross_validation
from bayes_impedance.evaluation.cross_validation import as_json, cross_validate
from bayes_impedance.evaluation.held_out import evaluate
from bayes_impedance.evaluation.metrics import score
from bayes_impedance.features import FeatureMap
from bayes_impedance.log import InteractionLog
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.readers import read_log
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from bayes_impedance.trajectory_mean import TrajectoryMean

BASELINES = ("naive", "without-residual")
NAMES = ["impedance", "naive", "impedance_without_residual"]

#: Two hyperparameters to learn, in next to no time.
QUICK = parse_config(
    {
        "model": {
            "trajectory_input": "phase",
            "desired_trajectory": {
                "mean": "trial_average",
                "average_knots": 2,
                "sd": 0.02,
                "length_scale": {"phase": 0.15},
            },
            "stiffness": {"level": {"median": 300, "log_sd": 1}, "log_sd": 0.2},
            "damping": {"level": 20, "log_sd": 0.2},
            "mass": {"level": 1.5, "sd": 0.3},
            "residual": {"sd": 1.0, "input": ["position"], "length_scale": {"position": 0.1}},
            "noise_sd": {"median": 0.2, "log_sd": 1},
        },
        "training": {"restarts": 1, "max_iterations": 3},
    }
)

#: Nothing to learn: one trial has a sensor offset of up to 20 N, the next another one.
OFFSET = parse_config(
    {
        "model": {
            "trajectory_input": "time",
            "desired_trajectory": {"mean": "reference", "sd": 0.002, "length_scale": {"time": 0.3}},
            "stiffness": {"level": 150, "log_sd": 0.1},
            "damping": {"level": 12, "log_sd": 0.1},
            "mass": {"level": 1.2, "sd": 0.1},
            "residual": {
                "sd": 0.1,
                "input": ["time"],
                "length_scale": {"time": 0.3},
                "offset_sd": 20,
            },
            "noise_sd": 0.1,
        }
    }
)


@pytest.fixture(scope="module")
def pooled_log() -> PreparedLog:
    """Three repetitions of 30 samples."""
    return draw_force(parse_config(TRUTH), repeated_motion(3, 3.0, 10.0, seed=3), seed=3)


@pytest.fixture(scope="module")
def result(pooled_log):
    return cross_validate(ImpedanceModel(QUICK), pooled_log, "trials", BASELINES)


def without(log: PreparedLog, index: int) -> PreparedLog:
    return log.select([other for other in range(len(log.trials)) if other != index])


def changed(log: PreparedLog, index: int, samples: slice, by: float) -> PreparedLog:
    """`log` with another force at some samples of a trial."""
    force = log.trials[index].force.copy()
    force[samples] += by
    trials = [*log.trials]
    trials[index] = replace(trials[index], force=force)
    return PreparedLog(log.axes, tuple(trials))


@pytest.fixture
def predictions(monkeypatch):
    """Mean and SD of every prediction of every fold that is made from now on."""
    seen = []

    def recording(*arguments):
        found = predict(*arguments)
        seen.append({(axis, name): (p.mean, p.sd) for axis, row in found.items() for name, p in row.items()})
        return found

    predict = cross_validation.predict
    monkeypatch.setattr(cross_validation, "predict", recording)
    return seen


def assert_equal_bits(one, other):
    assert one.keys() == other.keys()
    for key in one:
        for a, b in zip(one[key], other[key], strict=True):
            assert a.tobytes() == b.tobytes()


# --- each trial in turn --------------------------------------------------------------------------


def test_leaving_one_trial_out_is_a_loop_of_fit_and_evaluate(pooled_log, result):
    assert [fold.held_out for fold in result.folds] == [
        ("memory, trial 0",),
        ("memory, trial 1",),
        ("memory, trial 2",),
    ]
    for index, fold in enumerate(result.folds):
        model = ImpedanceModel(QUICK).fit(without(pooled_log, index))
        assert fold.evaluation == evaluate(model, pooled_log.select([index]), BASELINES)


def test_scores_are_pooled_over_folds(pooled_log, result):
    forces, rows = [], {name: [] for name in NAMES}
    for index in range(3):
        training, test = without(pooled_log, index), pooled_log.select([index])
        predicted = {
            "impedance": ImpedanceModel(QUICK).fit(training).posterior(test, "training"),
            "naive": NaiveModel(QUICK, training).predict(test),
            "impedance_without_residual": ImpedanceModel(without_residual(QUICK))
            .fit(training)
            .posterior(test, "training"),
        }
        force = test.trials[0].force
        past = np.concatenate([trial.force for trial in training.trials])
        forces.append(force)
        for name, posterior in predicted.items():
            mean, sd = posterior["force"].mean, posterior["force"].sd
            loss = 0.5 * np.log(2 * np.pi * sd**2) + (force - mean) ** 2 / (2 * sd**2)
            trivial = 0.5 * np.log(2 * np.pi * past.var(0)) + (force - past.mean(0)) ** 2 / (2 * past.var(0))
            rows[name].append((force - mean, loss, loss - trivial, np.abs(force - mean) / sd < 1.6448536))
    variance = np.concatenate(forces).var(axis=0)
    assert list(result.pooled.scores) == ["x", "y"]
    for a, axis in enumerate("xy"):
        assert list(result[axis]) == NAMES
        for name, mine in result[axis].items():
            error, loss, gain, inside = (
                np.concatenate([row[i][:, a] for row in rows[name]]) for i in range(4)
            )
            assert mine.n == 90
            assert mine.smse == pytest.approx(np.mean(error**2) / variance[a])
            assert mine.nlpd == pytest.approx(loss.mean())
            assert mine.msll == pytest.approx(gain.mean())
            assert mine.coverage90 == pytest.approx(inside.mean())


def test_share_of_impedance_is_the_mean_over_folds(result):
    for axis in "xy":
        assert list(result.pooled.impedance_share[axis]) == ["impedance", "impedance_without_residual"]
        for name, share in result.pooled.impedance_share[axis].items():
            each = [fold.evaluation.impedance_share[axis][name] for fold in result.folds]
            assert share == pytest.approx(sum(each) / 3)
            assert len(set(each)) == 3


def test_a_fitted_model_gives_nothing_away_and_its_log_is_the_default(tiny):
    mine = cross_validate(tiny.fitted)
    its = cross_validate(ImpedanceModel(tiny.config), read_log(tiny.log, tiny.config.log))
    assert mine == its
    assert [fold.held_out for fold in mine.folds] == [("log.csv, trial 0",), ("log.csv, trial 1",)]


def test_held_out_trials_do_not_change_their_prediction(pooled_log, predictions):
    false = changed(pooled_log, 1, slice(None), 100.0)
    for log in (pooled_log, false):
        cross_validate(ImpedanceModel(QUICK), log, "trials", BASELINES)
    assert_equal_bits(predictions[1], predictions[3 + 1])
    for mine, its in ((predictions[0], predictions[3]), (predictions[2], predictions[5])):
        assert all((mine[key][0] != its[key][0]).any() for key in mine)


# --- the last third of every trial ---------------------------------------------------------------


@pytest.fixture(scope="module")
def offset_log() -> PreparedLog:
    return draw_force(OFFSET, repeated_motion(3, 3.0, 20.0, axes=("x",), seed=1), seed=2)


def test_the_last_third_goes_on_with_its_trial(offset_log):
    """What the first part told of the offset holds in the second; for a trial of its own it would be unknown."""
    result = cross_validate(ImpedanceModel(OFFSET), offset_log, "last-third")
    levels = [trial.force.mean() for trial in offset_log.trials]
    assert np.ptp(levels) > 10
    scores = result["x"]["impedance"]
    assert scores.n == 3 * 20
    assert scores.smse < 0.02

    first = PreparedLog(offset_log.axes, tuple(part(trial, slice(0, 38)) for trial in offset_log.trials))
    last = PreparedLog(offset_log.axes, tuple(part(trial, slice(40, 60)) for trial in offset_log.trials))
    apart = evaluate(ImpedanceModel(OFFSET).fit(first), last)["x"]["impedance"]
    assert apart.n == scores.n
    assert apart.smse > 20 * scores.smse
    assert apart.nlpd > scores.nlpd + 1


def part(trial, samples: slice):
    arrays = {
        name: value[samples]
        for name in trial.__slots__
        if isinstance(value := getattr(trial, name), np.ndarray)
    }
    return replace(trial, **arrays, truth={})


def test_the_last_third_is_the_posterior_of_the_trial_given_its_beginning(offset_log):
    """By conditioning by hand on rows of the covariance of the whole log."""
    result = cross_validate(ImpedanceModel(OFFSET), offset_log, "last-third")
    model = ImpedanceModel(OFFSET).force_model(("x",))
    mean = TrajectoryMean.from_training(OFFSET.model.desired_trajectory, offset_log)
    features = FeatureMap(OFFSET, offset_log.axes)(offset_log, mean)
    prior = model.kernel(features.inputs)[0, 0].to_dense().detach().numpy()
    residual = (features.force - model.prior_mean(features.inputs)).detach().numpy()[0, 0]
    noise = float(model.noise_variance[0, 0])
    sample = np.tile(np.arange(60), 3)
    given, held = sample < 38, sample >= 40
    gram = prior[np.ix_(given, given)] + noise * np.eye(given.sum())
    cross = prior[np.ix_(held, given)]
    mean = cross @ np.linalg.solve(gram, residual[given])
    variance = prior.diagonal()[held] - np.einsum("ij,ji->i", cross, np.linalg.solve(gram, cross.T)) + noise
    force = np.concatenate([trial.force[:, 0] for trial in offset_log.trials])
    expected = score(mean, np.sqrt(variance), residual[held], residual[given])
    mine = result["x"]["impedance"]
    scale = np.var(residual[held]) / np.var(force[held])
    assert mine.smse == pytest.approx(expected.smse * scale, rel=1e-5)
    assert mine.nlpd == pytest.approx(expected.nlpd, rel=1e-6)


def test_equal_motions_keep_their_own_offsets(offset_log):
    """A robot that plays one motion again and again: only force tells its trials apart."""
    copies = [
        replace(offset_log.trials[0], name=str(i), force=offset_log.trials[0].force + offset)
        for i, offset in enumerate((-15.0, 0.0, 15.0))
    ]
    log = PreparedLog(offset_log.axes, tuple(copies))
    assert cross_validate(ImpedanceModel(OFFSET), log, "last-third")["x"]["impedance"].smse < 0.02


def test_held_out_thirds_do_not_change_their_prediction(pooled_log, predictions):
    """Nor do the samples in between, which the smoother mixes."""
    false = changed(pooled_log, 1, slice(19, None), 100.0)
    for log in (pooled_log, false):
        with pytest.warns(LogWarning, match="phases that no training sample has"):
            cross_validate(ImpedanceModel(QUICK), log, "last-third", BASELINES)
    assert [len(mean) for mean, _ in predictions[0].values()] == [30] * 6
    assert_equal_bits(*predictions)


# --- several models ------------------------------------------------------------------------------


def test_other_models_are_trained_on_the_same_folds(pooled_log, result):
    bare = QUICK.model_copy(update={"model": QUICK.model.model_copy(update={"residual": None})})
    against = {"bare": ImpedanceModel(bare), "fitted": ImpedanceModel(QUICK).fit(pooled_log)}
    mine = cross_validate(ImpedanceModel(QUICK), pooled_log, "trials", against=against)
    for axis in "xy":
        assert list(mine[axis]) == ["impedance", "bare", "fitted"]
        assert mine[axis]["bare"] == result[axis]["impedance_without_residual"]
        # Not as it was fitted, which would be on trials that are held out.
        assert mine[axis]["fitted"] == mine[axis]["impedance"] == result[axis]["impedance"]


def test_a_model_of_other_samples_is_refused_before_anything_is_trained(pooled_log, monkeypatch):
    monkeypatch.setattr(contenders.Contender, "train", lambda *_: pytest.fail("too late"))
    against = {"other": ImpedanceModel.from_config("phase")}
    with pytest.raises(ConfigurationError, match=r"^other: expected the same preprocessing\.rate as"):
        cross_validate(ImpedanceModel(QUICK), pooled_log, against=against)


# --- JSON ----------------------------------------------------------------------------------------


def test_json(result):
    content = json.loads(json.dumps(as_json(result), allow_nan=False))
    assert list(content) == ["axes", "impedance_share", "folds"]
    assert [fold["held_out"] for fold in content["folds"]] == [list(fold.held_out) for fold in result.folds]
    for level in (content, *content["folds"]):
        for axis in "xy":
            assert list(level["axes"][axis]) == NAMES
            for values in level["axes"][axis].values():
                assert list(values) == ["smse", "msll", "nlpd", "coverage90", "n"]
            assert list(level["impedance_share"][axis]) == ["impedance", "impedance_without_residual"]
    assert content["axes"]["x"]["naive"] == result["x"]["naive"].as_dict()
    for fold in content["folds"]:
        assert list(fold) == ["held_out", "axes", "impedance_share"]
        assert fold["axes"]["x"]["naive"]["n"] == 30


def test_a_trial_without_contact_has_no_smse_of_its_own(offset_log):
    idle = replace(offset_log.trials[1], force=np.zeros_like(offset_log.trials[1].force))
    log = PreparedLog(offset_log.axes, (offset_log.trials[0], idle, offset_log.trials[2]))
    result = cross_validate(ImpedanceModel(OFFSET), log)
    content = json.loads(json.dumps(as_json(result), allow_nan=False))
    assert [fold["axes"]["x"]["impedance"]["smse"] is None for fold in content["folds"]] == [
        False,
        True,
        False,
    ]
    assert content["axes"]["x"]["impedance"]["smse"] > 0


# --- progress, interruption, limits ----------------------------------------------------------------


def test_progress_names_fold_and_model(pooled_log):
    seen = []

    @contextmanager
    def watch(config, what):
        assert config == QUICK.training
        seen.append(what)
        yield lambda *_: None

    cross_validate(ImpedanceModel(QUICK), pooled_log, "trials", BASELINES, progress=watch)
    assert seen == [f"fold {index} of 3: {name}" for index in (1, 2, 3) for name in NAMES]


@pytest.mark.parametrize("which", NAMES)
def test_an_interrupted_training_gives_no_scores(pooled_log, which):
    @contextmanager
    def watch(_, what):
        def hook(*_):
            if what == f"fold 2 of 3: {which}":
                raise KeyboardInterrupt

        yield hook

    with pytest.raises(KeyboardInterrupt):
        cross_validate(ImpedanceModel(QUICK), pooled_log, "trials", BASELINES, progress=watch)


def test_capacity_is_that_of_a_fold(offset_log):
    def limited(samples: int) -> ImpedanceModel:
        return ImpedanceModel(
            parse_config(OFFSET.model_dump(mode="json"), overrides=[f"engine.max_samples={samples}"])
        )

    cross_validate(limited(120), offset_log)
    cross_validate(limited(3 * 38), offset_log, "last-third")
    with pytest.raises(TooManySamplesError):
        cross_validate(limited(119), offset_log)
    with pytest.raises(TooManySamplesError):
        cross_validate(limited(3 * 38 - 1), offset_log, "last-third")


def test_force_that_rests_is_refused_before_anything_is_trained(offset_log, monkeypatch):
    monkeypatch.setattr(contenders.Contender, "train", lambda *_: pytest.fail("too late"))
    trials = [replace(trial, force=np.full_like(trial.force, 3.0)) for trial in offset_log.trials]
    still = PreparedLog(offset_log.axes, tuple(trials))
    with pytest.raises(
        LogError, match="^expected force that varies along axis x to score against, found 3 N"
    ):
        cross_validate(ImpedanceModel(OFFSET), still)
    once = PreparedLog(offset_log.axes, (offset_log.trials[0], *trials[1:]))
    with pytest.raises(LogError, match="^expected force that varies along axis x to train on, found 3 N"):
        cross_validate(ImpedanceModel(OFFSET), once)


def test_log_without_force(tiny):
    trials = [replace(trial, force=None) for trial in read_log(tiny.log, tiny.config.log).trials]
    with pytest.raises(LogError, match="^expected a log with force to cross-validate on, found none; name"):
        cross_validate(tiny.fitted, InteractionLog(("x", "y"), tuple(trials)))


def test_untrained_model_without_log(tiny):
    with pytest.raises(ConfigurationError, match="expected a fitted model"):
        cross_validate(ImpedanceModel(QUICK))
