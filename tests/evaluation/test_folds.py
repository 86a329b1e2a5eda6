"""What a cross-validation holds out, and that nothing of it reaches what trains."""

from dataclasses import replace

import numpy as np
import pytest

from bayes_impedance.config import load_config, parse_config
from bayes_impedance.errors import ConfigurationError, LogError, LogWarning, TooManySamplesError
from bayes_impedance.evaluation.folds import split
from bayes_impedance.features import FeatureMap
from bayes_impedance.log import InteractionLog
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.preprocessing import PreparedLog, prepare
from bayes_impedance.simulation.generative import draw_force, repeated_motion

#: Nothing to learn, so that fitting is computing.
FIXED = parse_config(
    {
        "model": {
            "trajectory_input": "phase",
            "desired_trajectory": {"mean": "reference", "sd": 0.01, "length_scale": {"phase": 0.1}},
            "stiffness": {"level": 150, "log_sd": 0.1},
            "damping": {"level": 12, "log_sd": 0.1},
            "mass": {"level": 1.2, "sd": 0.2},
            "residual": {"sd": 0.3, "input": ["position"], "length_scale": {"position": 0.1}},
            "noise_sd": 0.1,
        }
    }
)


def config_with(*overrides: str):
    return parse_config(FIXED.model_dump(mode="json"), overrides=overrides)


@pytest.fixture(scope="module")
def log() -> PreparedLog:
    """Three trials of 60 samples, 20 a second."""
    return draw_force(FIXED, repeated_motion(3, 3.0, 20.0, axes=("x",), seed=1), seed=1)


def grouped(log: PreparedLog, *groups: str) -> PreparedLog:
    return PreparedLog(
        log.axes, tuple(replace(trial, group=group) for trial, group in zip(log.trials, groups, strict=True))
    )


# --- trials --------------------------------------------------------------------------------------


def test_each_trial_is_left_out_once(log):
    folds = split(log, FIXED, "trials")
    assert [fold.held_out for fold in folds] == [(f"memory, trial {index}",) for index in range(3)]
    for index, fold in enumerate(folds):
        assert fold.test.trials == fold.target.trials == (log.trials[index],)
        assert fold.training.trials == tuple(trial for trial in log.trials if trial is not log.trials[index])


def test_a_trial_that_stands_in_the_log_twice_counts_once(log):
    copy = replace(log.trials[0], source="elsewhere")
    folds = split(PreparedLog(log.axes, (*log.trials, copy)), FIXED, "trials")
    assert len(folds) == 3
    assert all(len(fold.training.trials) == 2 for fold in folds)


def test_a_group_may_be_predicted_from_others(log):
    folds = split(grouped(log, "a", "a", "b"), FIXED, "trials")
    assert folds[2].training.groups == ("a",)
    assert folds[2].test.groups == ("b",)


# --- last third ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overrides", "known"),
    [
        (["preprocessing.smoother=null"], 40),
        # Samples are .05 s apart, and one at a distance of exactly a window is left out.
        (["preprocessing.smoother.window=0.07"], 39),
        (["preprocessing.smoother.window=0.1"], 38),
        (["preprocessing.smoother.window=0.5"], 30),
    ],
)
def test_the_last_third_is_held_out_and_one_window_before_it_unused(log, overrides, known):
    (fold,) = split(log, config_with("model.trajectory_input=time", *overrides), "last-third")
    assert fold.held_out == tuple(f"memory, trial {index}, from 2 s" for index in range(3))
    for training, target, test, trial in zip(
        fold.training.trials, fold.target.trials, fold.test.trials, log.trials, strict=True
    ):
        assert np.flatnonzero(training.observed).tolist() == list(range(known))
        assert np.flatnonzero(test.observed).tolist() == list(range(40, 60))
        np.testing.assert_array_equal(training.force[training.observed], trial.force[training.observed])
        np.testing.assert_array_equal(test.force[test.observed], trial.force[test.observed])
        assert target is training


@pytest.mark.parametrize("window", [0.09, 0.1, 0.3])
def test_no_raw_force_enters_both_what_trains_and_what_is_held_out(window):
    config = config_with("model.trajectory_input=time", f"preprocessing.smoother.window={window}")
    time = np.arange(0.0, 3.0, 0.01)
    position, force = np.sin(time), np.cos(3.0 * time)

    def divided(force):
        raw = InteractionLog.from_arrays(time, position, force, axes="x")
        (fold,) = split(prepare(raw, config.preprocessing), config, "last-third")
        return [log.trials[0].force[log.trials[0].observed] for log in (fold.training, fold.test)]

    honest = divided(force)
    for sample in range(150, 230):
        lying = force.copy()
        lying[sample] += 100.0
        changed = [not np.array_equal(a, b) for a, b in zip(honest, divided(lying), strict=True)]
        assert not all(changed)
    assert changed == [False, True]


def test_the_last_third_of_a_task_that_was_seen_before_is_no_matter_of_warning(log, recwarn):
    """Three repetitions a trial, the last of which is held out."""
    motion = log.trials[0]
    repetition = np.repeat(np.arange(3), 20)
    phase = np.tile(np.linspace(0.02, 0.98, 20), 3)
    trial = replace(motion, repetition=repetition, phase=phase)
    split(PreparedLog(log.axes, (trial,)), FIXED, "last-third")
    assert not recwarn.list


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["model.trajectory_input=time", "model.stiffness.input=[phase]"],
        ["model.trajectory_input=time", "model.residual.input=[phase]"],
    ],
)
def test_phases_that_nobody_trained_on_are_noticed(log, overrides):
    with pytest.warns(
        LogWarning, match=r"^9\d % of the held-out samples lie at phases that no training sample has"
    ):
        split(log, config_with(*overrides), "last-third")


def test_phases_do_not_matter_to_a_function_of_time(log, recwarn):
    split(log, config_with("model.trajectory_input=time"), "last-third")
    assert not recwarn.list


# --- unknown force -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def masked(log) -> PreparedLog:
    """The second trial's force is known in its first 40 samples only."""
    force = log.trials[1].force.copy()
    force[40:] = np.nan
    return PreparedLog(log.axes, (log.trials[0], replace(log.trials[1], force=force), log.trials[2]))


@pytest.fixture(scope="module")
def shortened(log) -> PreparedLog:
    """The second trial ends after 40 samples."""
    trial = log.trials[1]
    arrays = {
        name: value[:40] for name in trial.__slots__ if isinstance(value := getattr(trial, name), np.ndarray)
    }
    return PreparedLog(log.axes, (log.trials[0], replace(trial, **arrays, truth={}), log.trials[2]))


@pytest.mark.parametrize("groups", ["aaa", "aba"])
def test_samples_without_force_do_not_count(masked, shortened, groups):
    """The reference is the prior mean, so that the motion alone says nothing."""
    masked, shortened = (grouped(log, *groups) for log in (masked, shortened))
    mine, its = (ImpedanceModel(FIXED).fit(log) for log in (masked, shortened))
    assert mine.report.samples == its.report.samples == 160
    assert mine.report.log_likelihood == its.report.log_likelihood
    assert mine.log_marginal_likelihood(masked) == its.log_marginal_likelihood(shortened)
    for given in ("training", "log", "both"):
        a = mine.posterior(masked, given)
        b = its.posterior(shortened, given)
        rows = np.concatenate([np.arange(100), np.arange(120, 180)])
        for latent in a.marginals:
            np.testing.assert_allclose(a[latent].mean[rows], b[latent].mean, rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(a[latent].sd[rows], b[latent].sd, rtol=1e-9, atol=1e-12)
            assert np.isfinite(a[latent].mean).all()
    inputs = FeatureMap(FIXED, masked.axes)(masked, mine._mean(masked)).inputs[0, 0, 7].numpy()
    mine_at, its_at = (model.point_predictor("x", "a").predict(inputs) for model in (mine, its))
    assert mine_at == pytest.approx(its_at, rel=1e-9)


def test_capacity_counts_known_forces(masked):
    ImpedanceModel(config_with("engine.max_samples=160")).fit(masked)
    with pytest.raises(TooManySamplesError):
        ImpedanceModel(config_with("engine.max_samples=159")).fit(masked)


# --- refusals ------------------------------------------------------------------------------------


def cut(log: PreparedLog, n: int) -> PreparedLog:
    trial = log.trials[0]
    arrays = {
        name: value[:n] for name in trial.__slots__ if isinstance(value := getattr(trial, name), np.ndarray)
    }
    return PreparedLog(log.axes, (replace(trial, **arrays, truth={}),))


@pytest.mark.parametrize(
    ("arrange", "overrides", "folds", "message"),
    [
        (
            lambda log: log.select([1]),
            [],
            "trials",
            r"^memory, trial 1: expected at least two trials to leave one out, found one; give more recordings, or",
        ),
        *(
            (
                lambda log: grouped(log, "a", "b", "a"),
                [f"model.desired_trajectory.mean={mean}"],
                "trials",
                rf"^memory, trial 1: expected at least two trials in group 'b' .* its {mean.replace('_', ' ')} comes",
            )
            for mean in ("trial_average", "constant")
        ),
        *(
            (
                lambda log, n=n: cut(log, n),
                [f"preprocessing.smoother.window={window}"],
                "last-third",
                rf"^memory, trial 0: expected samples before its last third and one window.* \({window:g} s\), found",
            )
            for n, window in ((60, 2.0), (2, 0.1), (1, 0.1))
        ),
        (
            lambda log: PreparedLog(log.axes, (replace(log.trials[0], force=None), *log.trials[1:])),
            [],
            "trials",
            "^expected a log with force to cross-validate on, found none; name",
        ),
    ],
)
def test_logs_that_cannot_be_split(log, arrange, overrides, folds, message):
    with pytest.raises(LogError, match=message):
        split(arrange(log), config_with(*overrides), folds)


def test_unknown_folds(log):
    with pytest.raises(
        ConfigurationError, match=r"^folds: expected trials or last-third, got 'thirds'; choose"
    ):
        split(log, load_config("phase"), "thirds")
