"""Scores: pooled over trials, from the training forces alone, beside a naive GP that gpytorch agrees with."""

import json
from contextlib import contextmanager
from dataclasses import replace

import gpytorch
import numpy as np
import pandas as pd
import pytest
import torch
from scipy.stats import norm

from bayes_impedance.baselines.naive import NaiveModel, naive_config
from bayes_impedance.config import Config, load_config, parse_config
from bayes_impedance.errors import ConfigurationError, LogError, LogWarning
from bayes_impedance.evaluation.explained import EXPLAINING, impedance_share
from bayes_impedance.evaluation.held_out import as_json, evaluate
from bayes_impedance.log import InteractionLog
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.readers import read_log


@pytest.fixture(scope="module")
def other(tiny):
    return tiny.fitted.prepare(read_log(tiny.other, tiny.config.log))


class GPyTorch(gpytorch.models.ExactGP):
    """The same GP, written as gpytorch's own tutorial does."""

    def __init__(self, x, y, likelihood):
        super().__init__(x, y, likelihood)
        self.mean_module = gpytorch.means.ZeroMean()
        self.covar_module = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel(ard_num_dims=x.shape[-1]))

    def forward(self, x):
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


def inputs(log: PreparedLog) -> torch.Tensor:
    """Phase, position and velocity of every sample."""
    parts = [np.column_stack([trial.phase, trial.position, trial.velocity]) for trial in log.trials]
    return torch.from_numpy(np.concatenate(parts))


def force(log: PreparedLog, axis: int) -> np.ndarray:
    return np.concatenate([trial.force[:, axis] for trial in log.trials])


def force_of(log: PreparedLog) -> np.ndarray:
    return np.concatenate([trial.force for trial in log.trials])


def test_naive_gp_predicts_what_gpytorch_predicts(tiny, other):
    training = tiny.fitted.fitted.log
    model = NaiveModel(tiny.config, training)
    predicted = model.predict(other)["force"]
    values = {entry.name: entry for entry in model._model.entries}
    assert set(values) == {"residual.sd", "residual.length_scale", "noise_sd"}
    assert values["residual.length_scale"].labels == (
        "phase",
        "position_x",
        "position_y",
        "velocity_x",
        "velocity_y",
    )
    for a in range(2):
        likelihood = gpytorch.likelihoods.GaussianLikelihood().double()
        theirs = GPyTorch(inputs(training), torch.from_numpy(force(training, a)), likelihood).double()
        with torch.no_grad():
            theirs.covar_module.outputscale = values["residual.sd"].value[a, 0, 0, 0] ** 2
            theirs.covar_module.base_kernel.lengthscale = values["residual.length_scale"].value[a, 0]
            likelihood.noise = values["noise_sd"].value[a, 0, 0] ** 2
        theirs.eval()
        likelihood.eval()
        with torch.no_grad(), gpytorch.settings.fast_computations(False, False, False):
            expected = likelihood(theirs(inputs(other)))
        # Jitter of 1e-10 of the prior variance is all the difference.
        np.testing.assert_allclose(predicted.mean[:, a], expected.mean.numpy(), rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(predicted.sd[:, a], expected.stddev.numpy(), rtol=1e-6)


@pytest.mark.parametrize(
    ("overrides", "components"),
    [
        ([], ("phase", "position", "velocity")),
        (["model.residual=null"], ("phase",)),
        (["model.stiffness.input=[time]"], ("phase", "time", "position", "velocity")),
        (["baseline.input=[position]"], ("position",)),
    ],
)
def test_naive_gp_sees_what_the_impedance_model_sees(overrides, components):
    config = naive_config(load_config("phase", overrides))
    assert config.model.residual is not None
    assert config.model.residual.input == components
    assert config.model.residual.offset_sd is None
    assert config.training == load_config("phase").training


def test_naive_gp_trains(tiny):
    report = NaiveModel(tiny.config, tiny.fitted.fitted.log).report
    assert report.samples == 40
    assert report.restarts[0].iterations == 3
    start = load_config("phase", ["training.max_iterations=1"]).training
    less = NaiveModel(tiny.config.model_copy(update={"training": start}), tiny.fitted.fitted.log).report
    assert np.sum(report.objective) > np.sum(less.objective)


def test_naive_gp_given_other_forces(tiny, other):
    """Hyperparameters stay, forces change, and what was trained is left as it was."""
    training = tiny.fitted.fitted.log
    model = NaiveModel(tiny.config, training)
    before = model.predict(other)["force"]
    informed = model.given(other)
    assert informed.hyperparameters == model.hyperparameters
    assert informed.report == model.report
    error, less = (
        np.abs(predicted.mean - force_of(other)) for predicted in (before, informed.predict(other)["force"])
    )
    assert less.mean() < error.mean()
    np.testing.assert_array_equal(model.predict(other)["force"].mean, before.mean)
    np.testing.assert_array_equal(model.given(training).predict(other)["force"].sd, before.sd)


def test_scores_are_pooled_over_trials(tiny, tmp_path):
    """Trials of different length count by their samples."""
    training = tiny.fitted.fitted.log
    pd.read_csv(tiny.other).iloc[:45].to_csv(tmp_path / "cut.csv", index=False)
    cut = tiny.fitted.prepare(read_log([tiny.log, tmp_path / "cut.csv"], tiny.config.log))
    assert [trial.n_samples for trial in cut.trials] == [20, 20, 9]
    with pytest.warns(LogWarning, match="some of these trials were trained on"):
        scores = evaluate(tiny.fitted, cut)
    total = {"x": [0.0] * 5, "y": [0.0] * 5}
    for trial in cut.trials:
        posterior = tiny.fitted.posterior(PreparedLog(cut.axes, (trial,)), given="training")["force"]
        for a, axis in enumerate(cut.axes):
            for i in range(trial.n_samples):
                mean, sd, u = posterior.mean[i, a], posterior.sd[i, a], trial.force[i, a]
                past = force(training, a)
                loss = -norm.logpdf(u, mean, sd)
                total[axis][0] += 1
                total[axis][1] += (u - mean) ** 2
                total[axis][2] += loss
                total[axis][3] += loss + norm.logpdf(u, past.mean(), past.std())
                total[axis][4] += norm.ppf(0.05) <= (u - mean) / sd <= norm.ppf(0.95)
    for a, axis in enumerate(cut.axes):
        n, squares, loss, difference, inside = total[axis]
        mine = scores[axis]["impedance"]
        assert mine.n == n == 49
        assert mine.smse == pytest.approx(squares / n / np.var(force(cut, a)))
        assert mine.nlpd == pytest.approx(loss / n)
        assert mine.msll == pytest.approx(difference / n)
        assert mine.coverage90 == pytest.approx(inside / n)


def test_forces_of_the_tested_log_are_not_conditioned_on(tiny, other):
    """Lying about them changes the scores, but no prediction."""
    false = PreparedLog(other.axes, tuple(replace(trial, force=trial.force + 100) for trial in other.trials))
    honest, lied = evaluate(tiny.fitted, other), evaluate(tiny.fitted, false)
    for axis in other.axes:
        assert lied[axis]["impedance"].smse > 100 * honest[axis]["impedance"].smse
    given = [tiny.fitted.posterior(log, given="training")["force"].mean for log in (other, false)]
    np.testing.assert_array_equal(*given)


def test_raw_and_prepared_logs_score_alike(tiny, other):
    assert evaluate(tiny.fitted, read_log(tiny.other, tiny.config.log)) == evaluate(tiny.fitted, other)


def test_no_warning_for_unseen_trials(tiny, other, recwarn):
    evaluate(tiny.fitted, other)
    assert [str(warning.message) for warning in recwarn if warning.category is LogWarning] == []


def test_json(tiny, other):
    seen = []

    @contextmanager
    def watch(config, what):
        seen.append((config, what))
        yield lambda *step: seen.append(step[:2])

    scores = evaluate(tiny.fitted, other, ["naive"], progress=watch)
    content = json.loads(json.dumps(as_json(scores)))
    assert content == {
        "axes": {
            axis: {name: values.as_dict() for name, values in models.items()}
            for axis, models in scores.scores.items()
        }
    }
    for axis in "xy":
        assert list(content["axes"][axis]) == ["impedance", "naive"]
        for values in content["axes"][axis].values():
            assert list(values) == ["smse", "msll", "nlpd", "coverage90", "n"]
    # The progress is that of the baseline's training.
    assert seen == [(tiny.config.training, "naive"), (0, 1), (0, 2), (0, 3)]


def changed(config: Config, *overrides: str) -> Config:
    return parse_config(config.model_dump(mode="json"), overrides=overrides)


@pytest.fixture(scope="module")
def bare(tiny) -> ImpedanceModel:
    """The tiny configuration without residual, not fitted."""
    return ImpedanceModel(changed(tiny.config, "model.residual=null"))


def test_without_residual_is_the_same_configuration_without_one(tiny, other, bare):
    training = tiny.fitted.fitted.log
    scores = evaluate(tiny.fitted, other, ["without-residual", "naive", "naive"])
    expected = evaluate(bare.fit(training), other)
    for axis in "xy":
        assert list(scores[axis]) == ["impedance", "impedance_without_residual", "naive"]
        assert scores[axis]["impedance_without_residual"] == expected[axis]["impedance"]
        share = scores.impedance_share[axis]
        assert list(share) == ["impedance", "impedance_without_residual"]
        assert share["impedance_without_residual"] == expected.impedance_share[axis]["impedance"]
    its_own = tiny.fitted.posterior(training, latents=EXPLAINING)
    assert [scores.impedance_share[axis]["impedance"] for axis in "xy"] == impedance_share(its_own).tolist()


def test_a_configuration_is_trained_and_a_fitted_model_counts_as_it_is(tiny, other, bare):
    training = tiny.fitted.fitted.log
    fitted = bare.fit(training)
    scores = evaluate(tiny.fitted, other, against={"fitted": fitted, "config": bare})
    for axis in "xy":
        assert list(scores[axis]) == ["impedance", "fitted", "config"]
        assert scores[axis]["config"] == scores[axis]["fitted"]
        # One yardstick for the whole column.
        rows = scores[axis]
        difference = rows["fitted"].msll - rows["impedance"].msll
        assert difference == pytest.approx(rows["fitted"].nlpd - rows["impedance"].nlpd)


def test_a_competitor_with_other_training_is_questioned(tiny, other, bare):
    better = bare.fit(PreparedLog(other.axes, (*tiny.fitted.fitted.log.trials, *other.trials)))
    with pytest.warns(LogWarning) as caught:
        evaluate(tiny.fitted, other, against={"better": better})
    assert [str(warning.message).split(", so")[0] for warning in caught] == [
        "better was trained on some of these trials",
        "better was trained on other trials than the model it is compared with",
    ]


@pytest.mark.parametrize(
    ("name", "overrides", "message"),
    [
        (
            "other",
            ["preprocessing.rate=20"],
            r"^other: expected the same preprocessing\.rate .* \(10\.0\), .*, got 20",
        ),
        (
            "other",
            ["preprocessing.smoother.window=0.2"],
            r"same preprocessing\.smoother .* \(\{window: 0\.14, polynomial_order: 4\}\), .* got \{window: 0\.2, ",
        ),
        (
            "other",
            ["log.axes=[x]"],
            r"^other: expected the same log\.axes .* \(null\), .*, got \['x'\]; set it alike$",
        ),
        (
            "other",
            ["device={mass: 2, damping: 6, acceleration: law}"],
            r"^other: expected the same device as the model .* set it alike, or device\.acceleration: measured in both",
        ),
        (
            "naive",
            [],
            "^against: expected names other than impedance, naive, .*, got 'naive'; rename that model",
        ),
        (
            "impedance",
            [],
            "^against: expected names other than impedance, .*, got 'impedance'; rename that model",
        ),
    ],
)
def test_models_that_cannot_stand_in_the_same_table(tiny, other, name, overrides, message):
    model = ImpedanceModel(changed(tiny.config, *overrides))
    with pytest.raises(ConfigurationError, match=message):
        evaluate(tiny.fitted, other, against={name: model})


def test_fitted_competitor_on_other_axes(tiny, other):
    motion = PreparedLog(("x",), tuple(one_axis(trial) for trial in tiny.fitted.fitted.log.trials))
    with pytest.raises(
        LogError, match="^expected a log with axes x, on which the model was trained, got x, y"
    ):
        evaluate(tiny.fitted, other, against={"other": ImpedanceModel(tiny.config).fit(motion)})


def one_axis(trial):
    arrays = {
        name: value[:, :1]
        for name in trial.__slots__
        if isinstance(value := getattr(trial, name), np.ndarray) and value.ndim == 2
    }
    return replace(trial, **arrays)


@pytest.mark.parametrize(
    ("config", "baselines", "message"),
    [
        (
            [],
            ["kalman"],
            "^baselines: expected some of naive, without-residual, ensemble, ensemble-diagonal, rls, ekf, "
            "got 'kalman'; choose",
        ),
        (
            ["model.residual=null"],
            ["without-residual"],
            "^baseline without-residual: .* found model.residual: null; leave",
        ),
    ],
)
def test_baselines_that_are_none(tiny, other, config, baselines, message):
    model = ImpedanceModel(changed(tiny.config, *config)).fit(tiny.fitted.fitted.log)
    with pytest.raises(ConfigurationError, match=message):
        evaluate(model, other, baselines)


def test_log_without_force(tiny):
    trial = read_log(tiny.other, tiny.config.log).trials[0]
    log = InteractionLog.from_arrays(trial.time, trial.position, None, axes="xy", phase=trial.phase)
    with pytest.raises(LogError, match="expected a log with force to score against, found none; name"):
        evaluate(tiny.fitted, log)
    with pytest.raises(LogError, match="expected a log with force to train on, found none; name"):
        NaiveModel(tiny.config, tiny.fitted.prepare(log))


def test_log_with_constant_force(tiny):
    """SMSE divides by the variance of the force."""
    trial = read_log(tiny.other, tiny.config.log).trials[0]
    even = trial.force.copy()
    even[:, 1] = 3.0
    log = InteractionLog.from_arrays(trial.time, trial.position, even, axes="xy", phase=trial.phase)
    with pytest.raises(LogError, match="expected force that varies along axis y .*, found 3 N throughout"):
        evaluate(tiny.fitted, log)


def test_untrained_model(tiny, other):
    with pytest.raises(Exception, match="expected a fitted model"):
        evaluate(ImpedanceModel(tiny.config), other)
