"""Posteriors against naive conditioning, coverage of the generative model, and training."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles import (
    IMPEDANCE,
    MODEL,
    TRAJECTORY,
    condition,
    configuration,
    feature_map,
    oracle_of,
    samples_of,
    some_rows,
    truth_of,
)
from torch import Tensor

from bayes_impedance import training
from bayes_impedance.config import Config
from bayes_impedance.engines.dense import log_marginal_likelihood
from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.features import trial_key
from bayes_impedance.kernels import Latent
from bayes_impedance.model import Fit, ImpedanceModel
from bayes_impedance.posterior import Posterior, compute_posterior
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import build_force_model
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from bayes_impedance.training import TrainingReport, observations, train
from bayes_impedance.trajectory_mean import TrajectoryMean

LATENTS = ("force", "residual_force", *TRAJECTORY, *IMPEDANCE)
LEARNED = {
    "stiffness": {**MODEL["stiffness"], "level": {"median": 100, "log_sd": 0.6}},
    "damping": {
        **MODEL["damping"],
        "prior": "gp",
        "log_sd": None,
        "sd": 2,
        "level": {"median": 9, "log_sd": 0.5},
    },
    "mass": {"level": {"median": 1.2, "log_sd": 0.4}, "sd": 0.2},
}


def group_log(
    config: Config, seed: int, group: str = "0", repetitions: int = 2, rate: float = 8.0
) -> PreparedLog:
    motion = repeated_motion(repetitions, duration=3.0, rate=rate, seed=seed, group=group)
    return draw_force(config, motion, seed)


def join(*logs: PreparedLog) -> PreparedLog:
    return PreparedLog(logs[0].axes, tuple(trial for log in logs for trial in log.trials))


def without_force(log: PreparedLog) -> PreparedLog:
    return PreparedLog(log.axes, tuple(replace(trial, force=None) for trial in log.trials))


def force_of(log: PreparedLog) -> np.ndarray:
    return np.concatenate([trial.force for trial in log.trials if trial.force is not None])


def moments(posterior: Posterior, latent: str) -> tuple[np.ndarray, np.ndarray]:
    marginal = posterior[latent]
    return marginal.location, np.square(marginal.scale)


def assert_equal_posteriors(
    one: Posterior, two: Posterior, rows: slice = slice(None), rtol: float = 1e-9
) -> None:
    for latent in one.marginals:
        for left, right in (
            (one[latent].location, two[latent].location[rows]),
            (one[latent].scale, two[latent].scale[rows]),
            (one[latent].prior_location, two[latent].prior_location[rows]),
            (one[latent].prior_scale, two[latent].prior_scale[rows]),
        ):
            scale = np.abs(right).max(initial=1e-12)
            np.testing.assert_allclose(left, right, rtol=rtol, atol=rtol * scale, err_msg=str(latent))


# --- against naive conditioning ----------------------------------------------------------------------


DESIGNS = {
    "phase": {"trajectory_input": "phase"},
    "time": {"trajectory_input": "time"},
    "position_velocity": {"trajectory_input": "position_velocity"},
    "equilibrium": {
        "trajectory_input": "position",
        "desired_trajectory": {**MODEL["desired_trajectory"], "mean": "equilibrium"},
    },
    "levels_learned": {"trajectory_input": "phase", **LEARNED},
    "levels_learned_equilibrium": {
        "trajectory_input": "position",
        "desired_trajectory": {**MODEL["desired_trajectory"], "mean": "equilibrium"},
        **LEARNED,
    },
    "offset_and_shared_residual": {
        "trajectory_input": "phase",
        "residual": {**MODEL["residual"], "offset_sd": 0.4},
    },
    "no_residual": {"trajectory_input": "phase", "residual": None},
}


def level_variances(config: Config) -> list[float]:
    """Var[b_j]: a log-normal hyperprior of the level as a Gaussian offset of w, or of log w."""
    variances = []
    for name in IMPEDANCE:
        prior = getattr(config.model, name)
        unit = 1.0 if getattr(prior, "prior", "gp") == "log_gp" else prior.level.median
        variances.append(0.0 if prior.level.fixed else (unit * prior.level.log_sd) ** 2)
    return variances


def second_order(mean: Tensor, variance: Tensor, prior_mean: Tensor, prior_variance: Tensor) -> Tensor:
    """E[log w] of the log-normal whose mean is E[w] (1 + a) and whose log-variance is that of the linear estimate."""
    locations = []
    for linear, known, before, own in zip(mean, variance, prior_mean, prior_variance, strict=True):
        a = float(linear - before)
        log = np.log1p(a) if a > 0 else a - 0.5 * a**2
        locations.append(float(before + 0.5 * own) + log - 0.5 * float(known))
    return torch.tensor(locations, dtype=torch.float64)


@pytest.mark.parametrize("name", DESIGNS)
def test_posterior_equals_naive_conditioning(name: str) -> None:
    config = configuration(**DESIGNS[name])
    if name == "offset_and_shared_residual":
        config = config.model_copy(update={"shared": config.shared.model_copy(update={"residual": True})})
    log = group_log(config, seed=3)
    given_rows = np.arange(0, log.n_samples, 2)
    mapping = feature_map(config, log)
    features = mapping(log, TrajectoryMean.from_training(config.model.desired_trajectory, log))
    posterior = compute_posterior(
        build_force_model(config, mapping), log, features, some_rows(features, given_rows), jitter=1e-10
    )
    oracle = oracle_of(config, axes=2)
    for a in range(2):
        samples = samples_of(config, log, axis=a)
        force = torch.from_numpy(force_of(log)[given_rows, a].copy())
        for latent in LATENTS:
            given = samples[torch.from_numpy(given_rows)]
            noise = config.model.noise_sd.median**2
            # The mean is the one at the fitted level; the variance is that of b drawn with everything else.
            mean, known = condition(oracle, given, force, samples, latent, noise, jitter=1e-10)
            if posterior[latent].warped:
                own_prior = oracle.own(samples, latent).diagonal()
                mean = second_order(mean, known, oracle.location(samples, latent), own_prior)
            _, variance = condition(
                oracle, given, force, samples, latent, noise, level_variances(config), jitter=1e-10
            )
            own, own_variance = moments(posterior, latent)
            prior_sd = max(float(posterior[latent].prior_scale[:, a].max()), 1e-12)
            np.testing.assert_allclose(own[:, a], mean, rtol=1e-8, atol=1e-8 * prior_sd, err_msg=latent)
            np.testing.assert_allclose(
                own_variance[:, a], variance, rtol=1e-8, atol=1e-8 * prior_sd**2, err_msg=latent
            )


def test_prior_moments_with_learned_levels() -> None:
    config = configuration(**DESIGNS["levels_learned"])
    log = group_log(config, seed=3)
    posterior = ImpedanceModel(config).posterior(without_force(log))
    oracle, samples = oracle_of(config, axes=2), samples_of(config, log, axis=1)
    variances = torch.diag(torch.tensor(level_variances(config), dtype=torch.float64))
    for latent in LATENTS:
        loading = oracle.level_loading(samples, latent)
        variance = oracle.own(samples, latent).diagonal() + (loading @ variances @ loading.T).diagonal()
        if latent == "force":
            variance = variance + config.model.noise_sd.median**2
        marginal = posterior[latent]
        np.testing.assert_allclose(np.square(marginal.prior_scale[:, 1]), variance, rtol=1e-9, atol=1e-14)
        np.testing.assert_allclose(
            marginal.prior_location[:, 1], oracle.location(samples, latent), rtol=1e-12, atol=1e-14
        )
        # Nothing was given.
        np.testing.assert_allclose(marginal.location, marginal.prior_location, rtol=1e-14)
        np.testing.assert_array_equal(marginal.scale, marginal.prior_scale)


@pytest.mark.parametrize("true", [120.0, 150.0, 157.0, 200.0, 250.0])
def test_stiffness_that_the_data_know_is_the_true_one_wherever_its_median_stands(true: float) -> None:
    """To first order in log k it would be low by half the prior variance, .045, where E[k] = 157 N/m is the truth."""
    known: dict[str, object] = {
        "trajectory_input": "time",
        "desired_trajectory": {**MODEL["desired_trajectory"], "sd": 1e-5},
        "damping": {"level": 9, "log_sd": 1e-3},
        "mass": {"level": 1.2, "sd": 1e-3},
        "residual": None,
        "noise_sd": 0.05,
    }
    truth = configuration(**known, stiffness={"level": true, "log_sd": 1e-4})
    log = draw_force(truth, repeated_motion(2, duration=2.0, rate=20.0, displacement_sd=0.03), seed=2)
    model = ImpedanceModel(configuration(**known, stiffness={"level": 150, "log_sd": 0.3}))
    stiffness = model.posterior(log)["stiffness"]
    np.testing.assert_allclose(stiffness.location, np.log(true), atol=0.025)


@pytest.mark.parametrize("name", ["equilibrium", "levels_learned_equilibrium"])
def test_under_the_equilibrium_mean_impedance_keeps_its_prior(name: str) -> None:
    config = configuration(**DESIGNS[name])
    posterior = ImpedanceModel(config).posterior(group_log(config, seed=3))
    for latent in IMPEDANCE:
        marginal = posterior[latent]
        np.testing.assert_allclose(marginal.location, marginal.prior_location, rtol=1e-14)
        np.testing.assert_allclose(marginal.scale, marginal.prior_scale, rtol=1e-14)
        np.testing.assert_allclose(marginal.contraction, 0.0, atol=1e-14)
    assert (posterior["desired_position"].contraction > 0.1).all()


def test_a_reference_teaches_impedance() -> None:
    config = configuration(**DESIGNS["levels_learned"])
    posterior = ImpedanceModel(config).posterior(group_log(config, seed=3))
    for latent in ("stiffness", "damping"):
        assert (posterior[latent].contraction > 0.2).all()
        assert (posterior[latent].scale <= posterior[latent].prior_scale * (1 + 1e-12)).all()


def test_warped_impedance_is_positive_and_gaussian_is_not_warped() -> None:
    config = configuration(**LEARNED)
    posterior = ImpedanceModel(config).posterior(group_log(config, seed=3))
    stiffness, damping = posterior["stiffness"], posterior[Latent.DAMPING]
    assert stiffness.warped
    assert not damping.warped
    for probability in (1e-9, 0.05, 0.5, 0.95):
        assert (stiffness.quantile(probability) > 0).all()
        assert (stiffness.prior_quantile(probability) > 0).all()
    np.testing.assert_allclose(stiffness.quantile(0.5), np.exp(stiffness.location))
    # Moments of a log-normal, and of a Gaussian.
    draws = np.random.default_rng(0).standard_normal(200_000)
    sample = np.exp(stiffness.location[0, 0] + stiffness.scale[0, 0] * draws)
    assert stiffness.mean[0, 0] == pytest.approx(sample.mean(), rel=5e-3)
    assert stiffness.sd[0, 0] == pytest.approx(sample.std(), rel=1e-2)
    np.testing.assert_array_equal(damping.mean, damping.location)
    np.testing.assert_array_equal(damping.sd, damping.scale)


def test_a_latent_fixed_by_the_configuration_has_contraction_nought() -> None:
    config = configuration(residual=None)
    marginal = ImpedanceModel(config).posterior(group_log(config, seed=3))["residual_force"]
    np.testing.assert_array_equal(marginal.contraction, [0.0, 0.0])
    assert not marginal.scale.any()


# --- batches -----------------------------------------------------------------------------------------


def test_groups_of_unequal_length_equal_one_at_a_time() -> None:
    config = configuration(**DESIGNS["levels_learned"])
    logs = [group_log(config, seed=5, group="a"), group_log(config, seed=6, group="b", repetitions=3)]
    mixed = PreparedLog(logs[0].axes, tuple(logs[1].trials[:1] + logs[0].trials + logs[1].trials[1:]))
    model = ImpedanceModel(config)
    together = model.posterior(mixed)
    n = len(logs[0].trials[0].time)
    own = {"a": slice(n, 3 * n), "b": np.r_[0:n, 3 * n : 5 * n]}
    for log in logs:
        # Padding dilutes the jitter, which is relative to a mean: 1e-10 of the variance at most.
        assert_equal_posteriors(model.posterior(log), together, own[log.groups[0]], rtol=1e-6)
    likelihood = [model.log_marginal_likelihood(log) for log in logs]
    for axis, value in model.log_marginal_likelihood(mixed).items():
        assert value == pytest.approx(sum(part[axis] for part in likelihood), abs=1e-6)


def test_eight_groups_and_two_axes_equal_a_loop() -> None:
    config = configuration()
    logs = [group_log(config, seed=s, group=str(s), rate=4.0) for s in range(8)]
    model = ImpedanceModel(config)
    together = model.posterior(join(*logs))
    n = logs[0].n_samples
    for g, log in enumerate(logs):
        alone = model.posterior(log)
        assert_equal_posteriors(alone, together, slice(g * n, (g + 1) * n), rtol=1e-9)


def only_axis(log: PreparedLog, a: int) -> PreparedLog:
    vectors = ("position", "velocity", "acceleration", "jerk", "force")
    vectors += ("reference", "reference_velocity", "reference_acceleration")
    trials = tuple(
        replace(trial, **{name: getattr(trial, name)[:, [a]] for name in vectors}) for trial in log.trials
    )
    return PreparedLog((log.axes[a],), trials)


def test_two_axes_together_equal_each_alone() -> None:
    # ξ = phase, so that an axis does not see the other's position.
    config = configuration(
        stiffness={"level": 100, "log_sd": 0.3, "input": ["phase"], "length_scale": {"phase": 0.3}},
        damping={"level": 9, "log_sd": 0.2},
        residual={"sd": 0.3, "input": ["time"], "length_scale": {"time": 0.3}},
    )
    log = group_log(config, seed=5)
    together, likelihood = (
        ImpedanceModel(config).posterior(log),
        ImpedanceModel(config).log_marginal_likelihood(log),
    )
    for a, axis in enumerate(log.axes):
        alone = ImpedanceModel(config).posterior(only_axis(log, a))
        for latent in LATENTS:
            np.testing.assert_allclose(
                alone[latent].location[:, 0], together[latent].location[:, a], rtol=1e-9, atol=1e-12
            )
            np.testing.assert_allclose(
                alone[latent].scale[:, 0], together[latent].scale[:, a], rtol=1e-9, atol=1e-12
            )
        assert ImpedanceModel(config).log_marginal_likelihood(only_axis(log, a))[axis] == pytest.approx(
            likelihood[axis]
        )


def test_long_targets_are_taken_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    config = configuration(**DESIGNS["levels_learned"])
    log = group_log(config, seed=5)
    whole = ImpedanceModel(config).posterior(log)
    monkeypatch.setattr("bayes_impedance.posterior.conditioning.CHUNK", 7)
    assert_equal_posteriors(ImpedanceModel(config).posterior(log), whole, rtol=1e-10)


# --- what is given -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def two_logs() -> tuple[Config, PreparedLog, PreparedLog]:
    """Training and test trials of one person, whose x_d(phase), k and d are shared."""
    config = configuration(("training.restarts=1",))
    motion = repeated_motion(repetitions=4, duration=3.0, rate=8.0, seed=9)
    log = draw_force(config, motion, seed=9)
    return config, log.select([0, 1]), log.select([2, 3])


def fitted(config: Config, log: PreparedLog) -> ImpedanceModel:
    """What fitting leaves where every hyperparameter is fixed: the log is kept."""
    report = TrainingReport((), (0, 0), (0.0, 0.0), (0.0, 0.0), {}, False, log.n_samples)
    return ImpedanceModel(config, Fit(build_force_model(config, feature_map(config, log)), log, report))


def test_given_chooses_the_evidence(two_logs: tuple[Config, PreparedLog, PreparedLog]) -> None:
    config, first, second = two_logs
    model, bare = fitted(config, first), ImpedanceModel(config)
    n = first.n_samples
    # Training forces and those of the log, as though all were one log.
    assert_equal_posteriors(model.posterior(second), bare.posterior(join(first, second)), slice(n, None))
    assert_equal_posteriors(model.posterior(second, given="log"), bare.posterior(second))
    only_training = bare.posterior(join(first, without_force(second)))
    assert_equal_posteriors(model.posterior(second, given="training"), only_training, slice(n, None))
    # A log without force can only be predicted from training.
    assert_equal_posteriors(model.posterior(without_force(second)), only_training, slice(n, None))


def test_a_trial_in_both_logs_counts_once(two_logs: tuple[Config, PreparedLog, PreparedLog]) -> None:
    config, first, second = two_logs
    model, bare = fitted(config, first), ImpedanceModel(config)
    expected = bare.posterior(join(first, second))
    assert_equal_posteriors(model.posterior(first), bare.posterior(first))
    assert_equal_posteriors(model.posterior(join(first, second)), expected)
    # Given by training and asked for without force, a trial keeps its own residual.
    assert_equal_posteriors(model.posterior(without_force(first)), bare.posterior(first))
    renamed = PreparedLog(
        first.axes, tuple(replace(t, name="other", source="file.csv") for t in first.trials)
    )
    assert_equal_posteriors(model.posterior(renamed), bare.posterior(first))


def test_two_trials_with_the_same_motion_both_count() -> None:
    # A stiff robot moves the hand alike in two trials: the forces differ, and both are evidence.
    config = configuration(("training.restarts=1",))
    motion = repeated_motion(repetitions=1, duration=3.0, rate=8.0, seed=9)
    twice = PreparedLog(motion.axes, (motion.trials[0], replace(motion.trials[0], name="1", source="second")))
    log = draw_force(config, twice, seed=1)
    first, second = log.select([0]), log.select([1])
    one, both = ImpedanceModel(config).posterior(second), fitted(config, first).posterior(second)
    assert (both["desired_position"].scale < one["desired_position"].scale * (1 - 1e-6)).all()


def test_groups_without_evidence_keep_the_prior(two_logs: tuple[Config, PreparedLog, PreparedLog]) -> None:
    config, first, second = two_logs
    stranger = PreparedLog(second.axes, tuple(replace(trial, group="stranger") for trial in second.trials))
    model = fitted(config, first)
    posterior = model.posterior(join(first, without_force(stranger)))
    n = first.n_samples
    assert_equal_posteriors(ImpedanceModel(config).posterior(first), posterior, slice(0, n))
    prior = ImpedanceModel(config).posterior(without_force(stranger))
    assert_equal_posteriors(prior, posterior, slice(n, None))
    np.testing.assert_array_equal(posterior["force"].location[n:], posterior["force"].prior_location[n:])
    for marginal in prior.marginals.values():
        np.testing.assert_array_equal(marginal.contraction, [0.0, 0.0])


def test_trial_keys_tell_group_and_motion_apart(two_logs: tuple[Config, PreparedLog, PreparedLog]) -> None:
    _, first, second = two_logs
    keys = [trial_key(trial) for trial in join(first, second).trials]
    assert len(set(keys)) == 4
    assert trial_key(replace(first.trials[0], group="other")) not in keys


def test_only_the_latents_asked_for(two_logs: tuple[Config, PreparedLog, PreparedLog]) -> None:
    config, first, _ = two_logs
    posterior = ImpedanceModel(config).posterior(first, latents=[Latent.FORCE, Latent.STIFFNESS])
    assert list(posterior.marginals) == [Latent.FORCE, Latent.STIFFNESS]
    assert_equal_posteriors(posterior, ImpedanceModel(config).posterior(first))


# --- table -------------------------------------------------------------------------------------------


def test_table_of_the_posterior(two_logs: tuple[Config, PreparedLog, PreparedLog]) -> None:
    config, first, _ = two_logs
    posterior = ImpedanceModel(config).posterior(first)
    table = posterior.table()
    vectors = ("force", *TRAJECTORY, "residual_force")
    expected = [f"{q}_{axis}_{end}" for q in vectors for axis in "xy" for end in ("mean", "sd", "q05", "q95")]
    expected += [f"{q}_{a}{a}_{end}" for q in IMPEDANCE for a in "xy" for end in ("mean", "sd", "q05", "q95")]
    assert list(table.columns) == ["trial", "time", *expected]
    assert len(table) == first.n_samples
    assert table["trial"].tolist() == [trial.name for trial in first.trials for _ in trial.time]
    np.testing.assert_array_equal(table["time"], np.concatenate([trial.time for trial in first.trials]))
    np.testing.assert_array_equal(table["stiffness_yy_q95"], posterior["stiffness"].quantile(0.95)[:, 1])
    np.testing.assert_array_equal(table["force_x_mean"], posterior["force"].mean[:, 0])
    np.testing.assert_array_equal(table["desired_velocity_x_sd"], posterior["desired_velocity"].sd[:, 0])
    assert posterior.trial_slice(1) == slice(len(first.trials[0].time), first.n_samples)


def test_table_names_source_and_group_where_they_differ() -> None:
    config = configuration()
    a, b = group_log(config, seed=5, group="a"), group_log(config, seed=6, group="b")
    b = PreparedLog(b.axes, tuple(replace(trial, source="other.csv") for trial in b.trials))
    table = ImpedanceModel(config).posterior(join(a, b)).table()
    assert list(table.columns[:4]) == ["source", "group", "trial", "time"]
    assert table["group"].tolist() == ["a"] * a.n_samples + ["b"] * b.n_samples


# --- coverage ----------------------------------------------------------------------------------------

COVERAGE = {
    "phase": {"trajectory_input": "phase"},
    "position": {
        "trajectory_input": "position",
        "desired_trajectory": {**MODEL["desired_trajectory"], "mean": "equilibrium"},
    },
    "time": {"trajectory_input": "time"},
}
DRAWS = 50


def share_inside(posterior: Posterior, latent: str, truth: np.ndarray, rows: np.ndarray) -> float:
    marginal = posterior[latent]
    inside = (truth >= marginal.quantile(0.05)) & (truth <= marginal.quantile(0.95))
    return float(inside[rows].mean())


@pytest.mark.parametrize("name", COVERAGE)
def test_bands_of_ninety_per_cent_cover_true_products(name: str) -> None:
    config = configuration(damping={**MODEL["damping"], "log_sd": 0.3}, **COVERAGE[name])
    shares: dict[str, list[float]] = {"force": [], "desired_position": []}
    for seed in range(DRAWS):
        motion = repeated_motion(repetitions=3, duration=4.0, rate=10.0, seed=seed)
        log = draw_force(config, motion, seed)
        mapping = feature_map(config, log)
        features = mapping(log, TrajectoryMean.from_training(config.model.desired_trajectory, log))
        n = log.n_samples
        given, held_out = np.arange(0, n, 2), np.arange(1, n, 2)
        posterior = compute_posterior(
            build_force_model(config, mapping), log, features, some_rows(features, given), 1e-10,
            [Latent.FORCE, Latent.DESIRED_POSITION],
        )  # fmt: skip
        # A held-out force is a new measurement, noise and all.
        shares["force"].append(share_inside(posterior, "force", force_of(log), held_out))
        truth = truth_of(log, "desired_position")
        shares["desired_position"].append(share_inside(posterior, "desired_position", truth, held_out))
    for latent, values in shares.items():
        assert 0.85 <= np.mean(values) <= 0.95, latent


# --- training ----------------------------------------------------------------------------------------


def learned(median: float, log_sd: float = 1.0) -> dict[str, float]:
    return {"median": median, "log_sd": log_sd}


def user_model(**replaced: object) -> dict[str, object]:
    """What a user might assume: medians off by a factor of 1.5 to 2, and wide hyperpriors."""
    model = {
        "desired_trajectory": {
            "mean": "reference",
            "sd": learned(0.035),
            "length_scale": {"time": learned(0.5), "phase": learned(0.17), "position": learned(0.1)},
        },
        "stiffness": {
            **MODEL["stiffness"], "level": learned(180), "log_sd": learned(0.2, 0.5),
            "length_scale": {"position": learned(0.17)},
        },
        "damping": {
            **MODEL["damping"], "level": learned(5), "log_sd": learned(0.3, 0.5),
            "length_scale": {"position": learned(0.1)},
        },
        "mass": {"level": learned(0.8, 0.7), "sd": 0.2},
        "residual": {"sd": learned(0.6), "input": ["position"], "length_scale": {"position": learned(0.17)}},
        "noise_sd": learned(0.35),
    }  # fmt: skip
    return {**model, **replaced}


TRAINING = {
    "phase": ({"trajectory_input": "phase"}, {"trajectory_input": "phase"}),
    "time": ({"trajectory_input": "time"}, {"trajectory_input": "time"}),
    "position": (
        COVERAGE["position"],
        {
            "trajectory_input": "position",
            "desired_trajectory": {**user_model()["desired_trajectory"], "mean": "equilibrium"},
        },
    ),
}


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", TRAINING)
def test_training_reaches_the_likelihood_of_the_truth(name: str, seed: int) -> None:
    true_model, assumed_model = TRAINING[name]
    truth = configuration(**true_model)
    assumed = configuration(("training.restarts=2",), **user_model(**assumed_model))
    log = draw_force(truth, repeated_motion(repetitions=3, duration=4.0, rate=8.0, seed=seed), seed)
    model = ImpedanceModel(assumed).fit(log)
    reached, expected = model.log_marginal_likelihood(log), ImpedanceModel(truth).log_marginal_likelihood(log)
    for axis, reported in zip(log.axes, model.report.log_likelihood, strict=True):
        assert reached[axis] == pytest.approx(reported, abs=1e-8)
        assert reached[axis] >= expected[axis] - 1.0


@pytest.fixture(scope="module")
def small() -> tuple[Config, PreparedLog]:
    """A problem that trains within a second."""
    config = configuration(
        ("training.restarts=3", "training.max_iterations=15"), **user_model(**TRAINING["phase"][1])
    )
    log = draw_force(configuration(), repeated_motion(repetitions=2, duration=3.0, rate=8.0, seed=4), seed=4)
    return config, log


def values_of(model: ImpedanceModel) -> list[list[float]]:
    return [entry.value.detach().reshape(-1).tolist() for entry in model.hyperparameters]


def test_training_is_deterministic_and_its_report_complete(small: tuple[Config, PreparedLog]) -> None:
    config, log = small
    calls: list[tuple[int, int, float]] = []
    one = ImpedanceModel(config).fit(log, progress=lambda *call: calls.append(call))
    two = ImpedanceModel(config).fit(log)
    assert values_of(one) == values_of(two)
    report = one.report
    assert report.samples == log.n_samples
    assert not report.interrupted
    assert [restart.restart for restart in report.restarts] == [0, 1, 2]
    for restart in report.restarts:
        assert restart.iterations >= 1
        assert restart.evaluations > restart.iterations
        assert restart.seconds > 0
        assert restart.outcome
        own = [call for call in calls if call[0] == restart.restart]
        assert [iteration for _, iteration, _ in own] == list(range(1, restart.iterations + 1))
        assert own[-1][2] == pytest.approx(sum(restart.objective))
    for a in range(2):
        best = max(report.restarts, key=lambda restart, a=a: restart.objective[a])
        assert report.best[a] == best.restart
        assert report.objective[a] == best.objective[a]
        assert report.log_likelihood[a] == best.log_likelihood[a]
    other = ImpedanceModel(
        config.model_copy(update={"training": config.training.model_copy(update={"seed": 1})})
    )
    assert other.fit(log).report.restarts[1].objective != report.restarts[1].objective


def test_laplace_standard_deviations(small: tuple[Config, PreparedLog]) -> None:
    config, log = small
    model = ImpedanceModel(config).fit(log)
    for entry in model.hyperparameters:
        if not bool(entry.free.any()):
            assert entry.name not in model.report.log_sd
            continue
        spread = np.array(model.report.log_sd[entry.name])
        assert spread.shape == (2, len(entry.specs))
        fixed = ~entry.free.numpy()
        assert np.isnan(spread[:, fixed]).all()


def objective_of(model: ImpedanceModel, log: PreparedLog) -> np.ndarray:
    """Log posterior density of the hyperparameters, `(axes,)`, from its parts."""
    mapping = feature_map(model.config, log)
    features = mapping(log, TrajectoryMean.from_training(model.config.model.desired_trajectory, log))
    force_model = model.fitted.force_model
    with torch.no_grad():
        likelihood = log_marginal_likelihood(
            force_model.kernel, observations(force_model, features), model.config.engine.jitter
        ).sum(-1)
        prior = torch.zeros(2, dtype=torch.float64)
        for entry in force_model.entries:
            for c, spec in enumerate(entry.specs):
                if not spec.fixed:
                    value = entry.value[:, 0, 0, c].log()
                    scale = torch.tensor(spec.log_sd, dtype=torch.float64)
                    prior = prior + torch.distributions.Normal(np.log(spec.median), scale).log_prob(value)
    return (likelihood + prior).numpy()


def test_objective_is_likelihood_plus_log_normal_hyperpriors(small: tuple[Config, PreparedLog]) -> None:
    _, log = small
    one, two = (
        ImpedanceModel(
            configuration((f"training.max_iterations={n}", "training.restarts=1"), **user_model())
        ).fit(log)
        for n in (1, 8)
    )
    # Fixed hyperparameters and the parametrisation of noise add constants only.
    gained = np.subtract(two.report.objective, one.report.objective)
    np.testing.assert_allclose(gained, objective_of(two, log) - objective_of(one, log), rtol=1e-8)
    assert (gained > 0).all()


def test_interrupting_keeps_the_best_so_far(small: tuple[Config, PreparedLog]) -> None:
    config, log = small

    def interrupt(restart: int, iteration: int, _: float) -> None:
        if restart == 1 and iteration == 3:
            raise KeyboardInterrupt

    model = ImpedanceModel(config).fit(log, progress=interrupt)
    report = model.report
    assert report.interrupted
    assert [restart.outcome == "interrupted" for restart in report.restarts] == [False, True]
    assert report.restarts[1].iterations == 3
    for a in range(2):
        assert report.objective[a] == max(restart.objective[a] for restart in report.restarts)
    likelihood = model.log_marginal_likelihood(log)
    assert [likelihood[axis] for axis in log.axes] == pytest.approx(list(report.log_likelihood), abs=1e-8)


Objective = Callable[..., tuple[torch.Tensor, torch.Tensor]]


def failing(original: Objective, calls: Sequence[int] | None) -> Objective:
    """`original`, which fails at the calls of these numbers, or at every one (None)."""
    count = 0

    def objective(*args: object) -> tuple[torch.Tensor, torch.Tensor]:
        nonlocal count
        count += 1
        if calls is None or count in calls:
            raise NotPositiveDefiniteError("not positive definite, for a test")
        return original(*args)

    return objective


def train_small(small: tuple[Config, PreparedLog]) -> TrainingReport:
    config, log = small
    mapping = feature_map(config, log)
    features = mapping(log, TrajectoryMean.from_training(config.model.desired_trajectory, log))
    return train(build_force_model(config, mapping), features, config.training, config.engine.jitter)


def test_a_failing_restart_is_reported(
    small: tuple[Config, PreparedLog], monkeypatch: pytest.MonkeyPatch
) -> None:
    untroubled = train_small(small)
    first = untroubled.restarts[0].evaluations
    # The second evaluation of restart 1.
    monkeypatch.setattr(training, "objective", failing(training.objective, [first + 2]))
    report = train_small(small)
    assert [restart.outcome.startswith("stopped:") for restart in report.restarts] == [False, True, False]
    assert "not positive definite, for a test" in report.restarts[1].outcome
    assert report.restarts[0].objective == untroubled.restarts[0].objective
    assert report.restarts[2].objective == untroubled.restarts[2].objective


def test_a_restart_that_fails_at_once_does_not_spoil_the_report(
    small: tuple[Config, PreparedLog], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "objective", failing(training.objective, [1]))
    report = train_small(small)
    assert report.restarts[0].evaluations == 0
    assert report.restarts[0].outcome.startswith("stopped:")
    assert set(report.best) <= {1, 2}
    assert np.isfinite(report.objective).all()


def test_training_fails_where_every_restart_does(
    small: tuple[Config, PreparedLog], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "objective", failing(training.objective, None))
    with pytest.raises(NotPositiveDefiniteError, match="for a test"):
        train_small(small)


def test_training_of_the_noise_alone() -> None:
    config = configuration(("training.restarts=1",), noise_sd=learned(0.5))
    log = draw_force(configuration(), repeated_motion(repetitions=2, duration=3.0, rate=8.0, seed=4), seed=4)
    (noise,) = (
        entry for entry in ImpedanceModel(config).fit(log).hyperparameters if entry.name == "noise_sd"
    )
    assert noise.value.reshape(-1).tolist() == pytest.approx([0.2, 0.2], rel=0.4)


def test_nothing_to_train_keeps_every_value() -> None:
    config = configuration(("training.restarts=1",))
    log = group_log(config, seed=3)
    model = ImpedanceModel(config).fit(log)
    assert model.is_fitted
    for entry in model.hyperparameters:
        np.testing.assert_allclose(
            entry.value.detach().reshape(2, -1), entry.medians.expand(2, -1), rtol=1e-12, err_msg=entry.name
        )
    expected = ImpedanceModel(config).log_marginal_likelihood(log)
    assert list(model.report.log_likelihood) == pytest.approx(list(expected.values()))
