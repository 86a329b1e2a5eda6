"""Posteriors of functions and of what they leave to others: oracles, groups, forces given, calibration."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bayes_impedance.engines.choice import EngineChoice
from bayes_impedance.engines.given_impedance import LATENTS
from bayes_impedance.errors import TooManySamplesError
from bayes_impedance.features import FeatureMap
from bayes_impedance.impedance_functions import conditioned
from bayes_impedance.impedance_functions.conditioned import Conditioned
from bayes_impedance.impedance_functions.density import Designs
from bayes_impedance.impedance_functions.posterior import condition
from bayes_impedance.impedance_functions.train import FittedFunctions
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.posterior.conditioning import select_groups
from bayes_impedance.trajectory_mean import TrajectoryMean
from tests.impedance_functions.problems import (
    COUPLED,
    DISTINCT,
    KNOWN_VARIATION,
    MARKOV,
    density_of,
    drawn_log,
    map_config,
    small_problem,
    somewhere,
)

SETTINGS = (*KNOWN_VARIATION, *DISTINCT, "model.stiffness.level={median: 300, log_sd: 0.5}")
IMPEDANCE = (Latent.STIFFNESS, Latent.DAMPING, Latent.MASS)


@pytest.fixture(scope="module")
def two_groups():
    """A model of groups a (two repetitions) and b (three), and those it never saw: more of a, and c."""
    # A trial average would not be known of a group that was not trained on.
    config = map_config(*SETTINGS, "model.desired_trajectory.mean=reference")
    a, b, c = (named(drawn_log(config, 3, group=group, seed=s)) for s, group in enumerate("abc"))
    training = join(a.select([0, 1]), b)
    return ImpedanceModel(config).fit(training), training, a.select([2]), c


def named(log):
    trials = [replace(trial, name=f"{trial.group}{trial.name}") for trial in log.trials]
    return replace(log, trials=tuple(trials))


def join(*logs):
    return replace(logs[0], trials=tuple(trial for log in logs for trial in log.trials))


def features_of(model, log):
    mean = TrajectoryMean.from_training(model.config.model.desired_trajectory, model.fitted.log)
    return FeatureMap(model.config, log.axes)(log, mean, observed=True)


def rows(posterior, group):
    lengths = [trial.n_samples for trial in posterior.log.trials]
    return np.repeat([trial.group == group for trial in posterior.log.trials], lengths)


# --- moments, given a Gaussian of weights --------------------------------------------------------


@pytest.mark.parametrize("overrides", [(), (COUPLED,)])
def test_logarithm_is_the_gaussian_of_the_weights(overrides):
    problem = small_problem(*MARKOV, *overrides, groups=2)
    density = density_of(problem, "markov")
    count, generator = density.weight_count, np.random.default_rng(0)
    root = 0.3 * generator.standard_normal((count, count)) / np.sqrt(count)
    point = somewhere(density)
    uncertain = np.arange(len(point)) < count
    known = Conditioned(density, point, root @ root.T, uncertain)
    draws = generator.standard_normal((4000, count)) @ root.T + point[:count]
    start = 0
    for j, function in enumerate(density.functions):
        size = int(np.prod(density.shapes[j]))
        with torch.no_grad():
            design = function.design(problem.features.inputs)
            expected = function.prior(problem.features.inputs, design)
            left_out = function.left_out(problem.features.inputs, design)
        own = torch.from_numpy(draws[:, start : start + size]).reshape(-1, *density.shapes[j])
        start += size
        samples = torch.einsum("genw,dgew->dgne", design, own) + function.location
        location, covariance, prior_location, prior_covariance = known.logarithm(problem.features, j)
        torch.testing.assert_close(samples.mean(0), location, rtol=0, atol=0.04)
        centred = samples - location
        spread = torch.einsum("dgne,dgnf->gnef", centred, centred) / len(draws)
        spread += torch.diag_embed(left_out.transpose(1, 2))
        # Of 4000 draws a variance is good to √(2/4000) = 2 %.
        torch.testing.assert_close(spread, covariance, rtol=0.15, atol=0.08 * float(covariance.max()))
        torch.testing.assert_close((prior_location, prior_covariance), expected[2:], rtol=0, atol=0)


@pytest.mark.parametrize("overrides", [(), (COUPLED,)])
def test_others_are_the_engines_where_nothing_is_uncertain(overrides):
    problem = small_problem(*MARKOV, *overrides, groups=2)
    density = density_of(problem, "markov")
    point = somewhere(density)
    uncertain = np.arange(len(point)) < density.weight_count
    known = Conditioned(density, point, np.zeros((density.weight_count,) * 2), uncertain)
    found = known.others(problem.features)
    density.set_hyperparameters(point)
    impedance = density.designs.matrices(density.weights(torch.from_numpy(point)))
    expected = density.engine.posterior(density.processes, impedance, problem.features, impedance)
    for latent in LATENTS:
        torch.testing.assert_close(found[latent][0], expected[latent][0], rtol=0, atol=0)
        torch.testing.assert_close(found[latent][1], expected[latent][1], rtol=1e-10, atol=1e-18)


def test_others_average_over_functions_and_hyperparameters(monkeypatch):
    density = density_of(small_problem(*MARKOV, repetitions=3, axes=("x",)), "markov")
    problem = small_problem(*MARKOV, repetitions=3, axes=("x",))
    point = somewhere(density)
    covariance = 0.15**2 * np.eye(len(point))
    monkeypatch.setattr(conditioned, "PAIRS", 150)
    found = Conditioned(density, point, covariance, density.free).others(problem.features)
    # The density is left where it was.
    np.testing.assert_array_equal(density.start()[density.weight_count :], point[density.weight_count :])
    generator = np.random.default_rng(5)
    designs = Designs.at(density.functions, problem.features.inputs)
    means, variances = [], []
    for _ in range(300):
        drawn = point + 0.15 * generator.standard_normal(len(point))
        density.set_hyperparameters(drawn)
        impedance = designs.matrices(density.weights(torch.from_numpy(drawn)))
        moments = density.engine.posterior(density.processes, impedance, problem.features, impedance)
        means.append(moments[Latent.DESIRED_POSITION][0])
        variances.append(moments[Latent.DESIRED_POSITION][1])
    mean, variance = found[Latent.DESIRED_POSITION]
    spread = (torch.stack(means) - mean).square().mean(0)
    # Impedance adds as much as it has to, and 300 draws tell a mean square to √(2/300) = 8 %, theirs and ours.
    assert float(spread.mean()) > 0.1 * float(variance.mean())
    expected = torch.stack(variances).mean(0) + spread
    assert float(variance.mean()) == pytest.approx(float(expected.mean()), rel=0.15)


# --- groups, and forces given --------------------------------------------------------------------


def test_groups_keep_what_is_theirs_in_any_order(two_groups):
    model, training, _, _ = two_groups
    expected = model.posterior(training)
    for order in ([2, 3, 4, 0, 1], [4, 0, 2, 1, 3]):
        turned = training.select(order)
        assert turned.groups == ("b", "a")
        for given in ("training", "both"):
            found = model.posterior(turned, given)
            for group in "ab":
                mine, its = (np.sort(p["stiffness"].location[rows(p, group)], 0) for p in (found, expected))
                np.testing.assert_allclose(mine, its, rtol=1e-9)
                mine, its = (np.sort(p["force"].mean[rows(p, group)], 0) for p in (found, expected))
                np.testing.assert_allclose(mine, its, rtol=1e-6, atol=1e-6)
    a, b = (expected["stiffness"].location[rows(expected, group)].mean() for group in "ab")
    assert abs(a - b) > 0.01


def test_some_groups_alone_are_what_they_were(two_groups):
    model, training, _, _ = two_groups
    whole = model.posterior(training)
    for group, chosen in (("a", [0, 1]), ("b", [2, 3, 4])):
        alone = model.posterior(training.select(chosen))
        for latent in IMPEDANCE:
            for name in ("location", "scale", "prior_location", "prior_scale"):
                mine, its = getattr(alone[latent], name), getattr(whole[latent], name)[rows(whole, group)]
                np.testing.assert_allclose(mine, its, rtol=1e-9)
        np.testing.assert_allclose(
            alone["force"].mean, whole["force"].mean[rows(whole, group)], rtol=1e-6, atol=1e-6
        )


def test_what_was_trained_on_is_what_is_found_again(two_groups):
    model, training, _, _ = two_groups
    functions = model.fitted.functions
    features = features_of(model, training)
    known, found = (
        condition(model.config, model.force_model(training.axes), functions, features, trained_on)
        for trained_on in (True, False)
    )
    for j in range(3):
        one, two = (c.logarithm(features, j) for c in (known, found))
        sd = one[1].diagonal(dim1=-2, dim2=-1).sqrt()
        # Climbs end where a step gains a thousandth of a nat or so.
        assert float(((one[0] - two[0]).abs() / sd).max()) < 0.1
        # Known hyperparameters leave no more open than uncertain ones.
        assert (two[1].diagonal(dim1=-2, dim2=-1).sqrt() < sd * 1.02).all()
        assert float((two[1].diagonal(dim1=-2, dim2=-1).sqrt() / sd).mean()) > 0.8


def test_forces_given(two_groups):
    model, _, more, _ = two_groups
    found = {given: model.posterior(more, given) for given in ("training", "log", "both")}
    sd = {given: posterior["stiffness"].scale.mean() for given, posterior in found.items()}
    prior = found["log"]["stiffness"].prior_scale.mean()
    assert sd["both"] < sd["training"] < prior
    assert sd["both"] < sd["log"] < prior
    assert found["both"]["force"].sd.mean() < found["training"]["force"].sd.mean()
    # Without its force a log has what training tells of it.
    bare = replace(more, trials=tuple(replace(trial, force=None) for trial in more.trials))
    for latent in IMPEDANCE:
        np.testing.assert_allclose(
            model.posterior(bare)[latent].location, found["training"][latent].location, rtol=1e-12
        )


def test_a_group_that_was_not_trained_on(two_groups):
    model, training, _, new = two_groups
    prior = model.posterior(new, "training")
    for latent, median in zip(IMPEDANCE, (300.0, 20.0, 1.5), strict=True):
        np.testing.assert_allclose(np.exp(prior[latent].location), median, rtol=1e-12)
        np.testing.assert_array_equal(prior[latent].scale, prior[latent].prior_scale)
        assert (prior[latent].contraction == 0.0).all()
    # Its own forces tell of it, and nothing of the others.
    alone = model.posterior(new, "log")
    assert alone["stiffness"].contraction[0] > 0.3
    both = model.posterior(join(new, training), "both")
    np.testing.assert_allclose(
        both["stiffness"].location[rows(both, "c")], alone["stiffness"].location, atol=0.02
    )
    mixed = model.posterior(join(new, training), "training")
    np.testing.assert_array_equal(mixed["stiffness"].location[rows(mixed, "c")], prior["stiffness"].location)
    trained = model.posterior(training)
    np.testing.assert_allclose(
        mixed["stiffness"].location[~rows(mixed, "c")], trained["stiffness"].location, rtol=1e-9
    )


def test_latents_that_are_asked_for(two_groups):
    model, training, _, _ = two_groups
    every = model.posterior(training)
    assert set(every.marginals) == set(Latent)
    for latent in (Latent.FORCE, Latent.DAMPING):
        alone = model.posterior(training, latents=[latent])
        assert set(alone.marginals) == {latent}
        np.testing.assert_array_equal(alone[latent].location, every[latent].location)
        np.testing.assert_array_equal(alone[latent].scale, every[latent].scale)


def test_evidence_of_the_training_log_is_the_reports(two_groups):
    model, training, _, new = two_groups
    (value,) = model.log_marginal_likelihood(training).values()
    assert value == pytest.approx(model.report.log_likelihood[0], abs=0.01)
    # Groups are independent given hyperparameters.
    (together,) = model.log_marginal_likelihood(join(training, new)).values()
    (alone,) = model.log_marginal_likelihood(new).values()
    assert together == pytest.approx(value + alone, abs=0.05)


def test_dense_engine_refuses_more_forces_than_it_may_hold():
    config = map_config(*SETTINGS, "engine.name=dense", "engine.max_samples=45")
    log = drawn_log(config, 3)
    model = ImpedanceModel(config).fit(log.select([0, 1]))
    model.posterior(log.select([2]), "log")
    with pytest.raises(
        TooManySamplesError, match=r"impedance: map: expected at most engine\.max_samples = 45"
    ):
        model.posterior(log.select([2]))


def test_select_groups_is_what_targets_are_given_as(two_groups):
    """Weights belong to groups by their order: see `compute_function_posterior`."""
    model, training, _, _ = two_groups
    features = features_of(model, training)
    known = condition(model.config, model.force_model(training.axes), model.fitted.functions, features, True)
    turned = select_groups(features, ["b", "a"])
    right = known.logarithm(features, 0)[0]
    assert not torch.allclose(known.logarithm(turned, 0)[0][0], right[1])


# --- calibration ---------------------------------------------------------------------------------


def test_bands_cover_what_was_drawn():
    settings = (
        *(
            f"model.{name}.length_scale={{phase: {{median: 0.3, fixed: true}}}}"
            for name in ("stiffness", "damping")
        ),
        "model.stiffness.log_sd=0.3",
        "model.damping.log_sd=0.3",
        "model.stiffness.level=300",
        "model.damping.level=20",
        "model.mass={level: 1.5, sd: 0.2}",
        "model.desired_trajectory.sd=0.02",
        "model.desired_trajectory.length_scale={phase: {median: 0.3, fixed: true}}",
        "model.noise_sd=0.3",
        "engine.inducing=6",
    )
    config = map_config(*settings)
    hits = []
    for seed in range(20):
        log = drawn_log(config, 2, seed=seed)
        posterior = ImpedanceModel(config).fit(log).posterior(log)
        for name in ("stiffness", "damping", "desired_position"):
            key = f"{name}_{'x' if name == 'desired_position' else 'xx'}"
            truth = np.concatenate([trial.truth[key] for trial in log.trials])
            low, high = (posterior[name].quantile(p)[:, 0] for p in (0.05, 0.95))
            # One sample of each function a draw, or they would not be independent.
            hits.append(bool(low[5] < truth[5] < high[5]))
    # Of 60 bands at 90 %: three standard errors of a share are √(.09 / 60) · 3 = .116.
    assert np.mean(hits) > 0.9 - 0.116


def test_fitted_functions_say_what_they_are(two_groups):
    functions = two_groups[0].fitted.functions
    assert isinstance(functions, FittedFunctions)
    assert functions.groups == ("a", "b")
    assert isinstance(functions.engine, EngineChoice)
    assert str(functions.engine) == "engine markov: exact, at a cost that grows with the number of samples"
    assert [inducing is None for inducing in functions.inducing] == [False, False, True]
