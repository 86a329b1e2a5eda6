"""Modes and training: recovery, the noise that a joint mode underestimates, failures, interruption."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.features import FeatureMap
from bayes_impedance.impedance_functions import fit, laplace, train
from bayes_impedance.impedance_functions.fit import find_mode, find_weights
from bayes_impedance.impedance_functions.threads import one_thread
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.priors import build_force_model
from bayes_impedance.trajectory_mean import TrajectoryMean
from tests.impedance_functions.problems import (
    COUPLED,
    DISTINCT,
    KNOWN_VARIATION,
    MARKOV,
    density_of,
    drawn_log,
    forced,
    map_config,
    small_problem,
)

QUICK = (*KNOWN_VARIATION, *DISTINCT, "engine.inducing=6")
ITERATIONS, TOLERANCE = 200, 1e-3


def value(model, name):
    return next(e for e in model.hyperparameters if e.name == name).value.detach().reshape(-1).numpy()


@pytest.fixture(scope="module")
def quick():
    """A model of two short repetitions, and what it was trained on."""
    config = map_config(*QUICK)
    log = drawn_log(config, 2)
    return ImpedanceModel(config).fit(log), log


# --- recovery ------------------------------------------------------------------------------------


def test_noise_and_trajectory_are_recovered_where_the_joint_mode_is_not(monkeypatch):
    # Inducing inputs closer than a length scale: what they leave out is taken for noise.
    config = map_config(*QUICK, "engine.inducing=12")
    log = drawn_log(config, 6, rate=15.0, axes=("x", "y", "z"), seed=1)
    model = ImpedanceModel(config).fit(log)
    assert model.report.restarts[0].converged
    noise = value(model, "noise_sd")
    # Of 180 samples √(1/2n) is 5 %.
    np.testing.assert_allclose(noise, 0.5, rtol=0.2)
    for name, truth in (("desired_trajectory.sd", 0.02), ("desired_trajectory.length_scale", 0.4)):
        found, sd = value(model, name), np.array(model.report.log_sd[name])[:, 0]
        assert (np.abs(np.log(found / truth)) < 3.0 * sd).all()
    monkeypatch.setattr(fit, "occam", lambda _, mode, __: np.zeros_like(mode))
    joint = ImpedanceModel(config).fit(log)
    # The functions follow some ten samples of each axis.
    assert (value(joint, "noise_sd") < 0.97 * noise).all()
    assert value(joint, "noise_sd").mean() < 0.48 < noise.mean()
    assert joint.report.log_likelihood[0] < model.report.log_likelihood[0]


def test_known_matrices_are_found():
    config = map_config(
        COUPLED,
        *(f"model.{name}.input=[]" for name in ("stiffness", "damping")),
        "model.desired_trajectory.sd=0.01",
        "model.desired_trajectory.length_scale={phase: {median: 0.15, fixed: true}}",
        "model.noise_sd=0.05",
    )
    truth = np.array(
        [[[250.0, -90.0], [-90.0, 400.0]], [[18.0, 4.0], [4.0, 25.0]], [[1.4, -0.5], [-0.5, 1.8]]]
    )
    log = forced(drawn_log(config, 4, axes=("x", "y")), truth, 0.05)
    model = ImpedanceModel(config).fit(log)
    posterior = model.posterior(log)
    for latent, matrix in zip(("stiffness", "damping", "mass"), truth, strict=True):
        found, beside = posterior[latent], posterior.couplings[posterior[latent].latent]
        error = (found.location[0] - np.log(np.diag(matrix))) / found.scale[0]
        assert (np.abs(error) < 4.0).all()
        assert abs(beside.location[0, 0] - matrix[0, 1]) < 4.0 * beside.scale[0, 0]
        assert (found.scale[0] < 0.2).all()
        # Levels stand where the functions are: of a constant at the diagonal of its logarithm.
        values, vectors = np.linalg.eigh(matrix)
        logarithm = (vectors * np.log(values)) @ vectors.T
        level, sd = value(model, f"{latent}.level"), np.array(model.report.log_sd[f"{latent}.level"])[:, 0]
        assert (np.abs(np.log(level) - np.diag(logarithm)) < 4.0 * sd).all()
        assert (sd < 0.2).all()


# --- the mode ------------------------------------------------------------------------------------


def test_mode_is_stationary_and_its_covariance_that_of_the_density(quick):
    model, log = quick
    functions = model.fitted.functions
    feature_map = FeatureMap(model.config, log.axes)
    mean = TrajectoryMean.from_training(model.config.model.desired_trajectory, log)
    features = feature_map(log, mean, observed=True)
    density = train.build_density(
        model.config, model.force_model(log.axes), features, functions.inducing, functions.engine.name
    )
    gradient = density.joint(functions.point)[1]
    precision = laplace.precision(lambda at: density.joint(at)[1], functions.point, density.free)
    count = density.weight_count
    # Over the weights Newton's method has nowhere to go, in posterior SDs.
    inner = precision[:count, :count]
    step = np.linalg.solve(inner, gradient[:count])
    assert step @ inner @ step < 1e-3
    np.testing.assert_allclose(functions.covariance @ precision, np.eye(len(precision)), atol=1e-4)
    assert model.report.log_likelihood[0] == pytest.approx(
        density.joint(functions.point)[0]
        - float(density.log_hyperpriors().detach())
        - 0.5 * np.linalg.slogdet(precision[: density.weight_count, : density.weight_count])[1],
        rel=1e-9,
    )
    # Without a tilt no hyperparameter is where the joint density is greatest: there is a gradient left.
    assert np.abs(gradient[density.weight_count :]).max() > 0.1


def test_what_data_do_not_tell_keeps_its_hyperprior():
    """The cost of steps away from the anchor is no knowledge."""
    never = "model.residual={kernel: matern32, input: [time], sd: {median: 1.0e-6, log_sd: 0.7}}"
    density = density_of(small_problem(*MARKOV, *QUICK, never, axes=("x",)), "markov")
    mode = find_mode(density, density.start(), ITERATIONS, TOLERANCE)
    place = density.weight_count + sum(
        e.raw.numel() for e in density.entries[: [e.name for e in density.entries].index("residual.sd")]
    )
    assert np.sqrt(mode.covariance[place, place]) == pytest.approx(0.7, rel=1e-3)


def test_evidence_of_constants_is_quadrature():
    """Two constants are few enough to integrate over on a grid."""
    problem = small_problem(
        *MARKOV,
        "model.stiffness={level: {median: 300, log_sd: 0.3}, input: [], log_sd: 0.1}",
        "model.damping={level: {median: 20, log_sd: 0.3}, input: [], log_sd: 0.1}",
        "model.mass={level: 1.5, sd: 1.0e-6}",
        axes=("x",),
        repetitions=3,
    )
    density = density_of(problem, "markov")
    mode = find_weights(density, density.start(), None, ITERATIONS, TOLERANCE)
    centre, root = mode.point[:2], np.linalg.cholesky(mode.covariance[:2, :2])
    nodes, factors = np.polynomial.hermite_e.hermegauss(15)
    total = 0.0
    for x, p in zip(nodes, factors, strict=True):
        for y, q in zip(nodes, factors, strict=True):
            point = mode.point.copy()
            point[:2] = centre + root @ [x, y]
            joint = density.joint(point)[0] - mode.log_evidence
            total += p * q * np.exp(joint + 0.5 * (x**2 + y**2) - float(density.log_hyperpriors().detach()))
    # Both have the prior's √2π of each weight, Gauss-Hermite in its factors.
    expected = np.log(total * np.linalg.det(root) / (2.0 * np.pi))
    assert abs(expected) < 0.05


def test_turns_that_do_not_settle_say_so(monkeypatch, quick):
    model, log = quick
    assert model.report.restarts[0].converged
    monkeypatch.setattr(fit, "TURNS", 1)
    hurried = ImpedanceModel(model.config).fit(log)
    assert hurried.report.restarts[0].outcome == "STOP: 1 TURNS OF MODE AND EVIDENCE HAVE NOT SETTLED"
    assert not hurried.report.restarts[0].converged


def test_training_is_deterministic(quick):
    model, log = quick
    again = ImpedanceModel(model.config).fit(log)
    assert again.fitted.functions.point.tobytes() == model.fitted.functions.point.tobytes()
    assert again.fitted.functions.covariance.tobytes() == model.fitted.functions.covariance.tobytes()
    assert again.report.log_sd == model.report.log_sd
    for mine, its in zip(again.hyperparameters, model.hyperparameters, strict=True):
        assert torch.equal(mine.raw, its.raw)


def test_levels_are_averages_over_samples_without_padding():
    config = map_config(*QUICK, "model.stiffness.level={median: 200, log_sd: 1.0}")
    long, short = drawn_log(config, 2), drawn_log(config, 1, group="1", seed=3)
    model = ImpedanceModel(config).fit(replace(long, trials=(*long.trials, *short.trials)))
    posterior = model.posterior(model.fitted.log)
    for name in ("stiffness", "damping", "mass"):
        expected = np.exp(posterior[name].location.mean())
        assert value(model, f"{name}.level") == pytest.approx([expected], rel=1e-9)


# --- restarts ------------------------------------------------------------------------------------


def scripted(monkeypatch, *outcomes):
    """Restarts that end as told: by an error, or in the true mode with so much added to its log posterior."""
    asked = []
    true_mode = train.find_mode

    def told(density, start, *rest):
        asked.append(start)
        outcome = outcomes[len(asked) - 1]
        if isinstance(outcome, BaseException):
            raise outcome
        mode = true_mode(density, start, *rest)
        return replace(mode, log_posterior=mode.log_posterior + outcome)

    monkeypatch.setattr(train, "find_mode", told)
    return asked


def restarting(log, restarts):
    return ImpedanceModel(map_config(*QUICK, f"training.restarts={restarts}")).fit(log)


def test_best_restart_is_kept(monkeypatch, quick):
    starts = scripted(monkeypatch, 0.0, 1e3, -1e3)
    model = restarting(quick[1], 3)
    report = model.report
    assert report.best == (1,)
    assert [r.restart for r in report.restarts] == [0, 1, 2]
    assert report.objective == report.restarts[1].objective
    free = [model.fitted.functions.point.shape == start.shape for start in starts]
    assert all(free)
    # Weights start at their prior mean; the first at the medians, each other at draws of its own.
    assert not np.allclose(starts[1], starts[0])
    assert not np.allclose(starts[2], starts[1])
    fresh = build_force_model(model.config, FeatureMap(model.config, ("x",)))
    medians = np.concatenate([e.raw.detach().reshape(-1).numpy() for e in fresh.entries if e.name in report.log_sd
                              and not e.name.endswith(".level")])  # fmt: skip
    np.testing.assert_array_equal(starts[0][-len(medians) :], medians)
    weights = len(starts[0]) - len(medians)
    assert all((start[:weights] == 0.0).all() for start in starts)


def test_a_restart_that_fails_is_told_of_and_left(monkeypatch, quick):
    scripted(monkeypatch, NotPositiveDefiniteError("too stiff"), 0.0)
    model = restarting(quick[1], 2)
    assert model.report.best == (1,)
    assert model.report.restarts[0].outcome == "stopped: too stiff"
    assert model.report.restarts[0].objective == (-np.inf,)
    assert not model.report.interrupted


def test_no_restart_succeeds(quick):
    huge = [replace(trial, force=1e200 * trial.force) for trial in quick[1].trials]
    with pytest.raises(
        NotPositiveDefiniteError, match="finite likelihood of the forces given impedance, found one that"
    ):
        ImpedanceModel(map_config(*QUICK)).fit(replace(quick[1], trials=tuple(huge)))


def test_a_step_into_overflow_is_taken_back(monkeypatch, quick):
    model, log = quick
    density_call = fit.Density.joint
    counted = []

    def overflows_once(density, point):
        counted.append(point)
        if len(counted) == 5:
            raise NotPositiveDefiniteError("beyond")
        return density_call(density, point)

    monkeypatch.setattr(fit.Density, "joint", overflows_once)
    found = ImpedanceModel(model.config).fit(log)
    np.testing.assert_allclose(found.report.objective, model.report.objective, atol=0.01)


def interrupting(restart, iteration):
    def progress(at, step, _):
        if (at, step) == (restart, iteration):
            raise KeyboardInterrupt

    return progress


def test_ctrl_c_in_the_first_restart_keeps_nothing(quick):
    with pytest.raises(KeyboardInterrupt):
        ImpedanceModel(quick[0].config).fit(quick[1], interrupting(0, 3))


def test_ctrl_c_in_the_second_restart_keeps_the_first(quick):
    config = map_config(*QUICK, "training.restarts=3")
    found = ImpedanceModel(config).fit(quick[1], interrupting(1, 3))
    assert found.report.interrupted
    assert [r.outcome for r in found.report.restarts][1:] == ["interrupted"]
    assert found.report.best == (0,)
    assert found.fitted.functions.point.tobytes() == quick[0].fitted.functions.point.tobytes()
    for mine, its in zip(found.hyperparameters, quick[0].hyperparameters, strict=True):
        assert torch.equal(mine.raw, its.raw)


def test_threads_are_one_within_and_as_many_as_before_after():
    before = torch.get_num_threads()
    with pytest.raises(KeyboardInterrupt), one_thread():
        assert torch.get_num_threads() == 1
        raise KeyboardInterrupt
    assert torch.get_num_threads() == before
