"""Noise of the recorded positions from the log to the posterior: filter, likelihood, posteriors, statistics."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from oracles import (
    IMPEDANCE,
    ForceOracle,
    Samples,
    condition,
    configuration,
    oracle_of,
    samples_of,
    truth_of,
)
from scipy.stats import multivariate_normal
from torch import Tensor

from bayes_impedance.baselines.naive import NaiveModel
from bayes_impedance.config import Config, parse_config
from bayes_impedance.engines.closed_loop import ApparentMass, jacobian, log_likelihood
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import FeatureMap
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.log import InteractionLog
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.persistence import load_model, save_model
from bayes_impedance.preprocessing import PreparedLog, prepare
from bayes_impedance.preprocessing.prepared import ARRAYS
from bayes_impedance.preprocessing.savitzky_golay import SavitzkyGolay, motion_weights
from bayes_impedance.priors import build_force_model
from bayes_impedance.simulation.generative import as_recording, draw_force, repeated_motion
from bayes_impedance.training import observations
from bayes_impedance.trajectory_mean import TrajectoryMean

NATIVE = 200.0
SMOOTH = SavitzkyGolay(21, 4, 1 / NATIVE)
NOISE = 1e-4
PREPROCESSING = {"smoother": {"window": 0.1, "polynomial_order": 4}, "rate": 25}


def carried(noise: object = NOISE, **model: object) -> Config:
    """The fixed configuration of the oracles, with noise of the positions and a smoother."""
    config = configuration([f"model.position_noise_sd={'null' if noise is None else noise}"], **model)
    return parse_config({**config.model_dump(mode="json"), "preprocessing": PREPROCESSING})


def recording(seed: int = 0, axes: tuple[str, ...] = ("x",)) -> InteractionLog:
    """Force from the model and positions with noise, as a logger would have written them."""
    motion = repeated_motion(2, duration=0.8, rate=NATIVE, axes=axes, seed=seed)
    drawn = as_recording(draw_force(configuration(), motion, seed), keep_reference=True)
    rng = np.random.default_rng(seed)
    noisy = [
        replace(trial, position=trial.position + NOISE * rng.normal(size=trial.position.shape))
        for trial in drawn.trials
    ]
    return InteractionLog(drawn.axes, tuple(noisy))


@pytest.fixture(scope="module")
def prepared() -> PreparedLog:
    return prepare(recording(), carried().preprocessing)


# --- what is kept of the filter ------------------------------------------------------------------


def test_the_prepared_motion_is_that_of_the_windows_that_it_names(prepared):
    raw = recording()
    for trial, recorded in zip(prepared.trials, raw.trials, strict=True):
        first, place, *rest = trial.smoothing.T
        length, order, step, from_positions = (column[0] for column in rest)
        assert (length, order, from_positions) == (21, 4, 3)
        assert step == pytest.approx(1 / NATIVE)
        weights = motion_weights(int(length), int(order), float(step))
        for derivative, name in enumerate(("position", "velocity", "acceleration")):
            expected = [
                weights[derivative, int(p)] @ recorded.position[int(f) : int(f) + 21]
                for f, p in zip(first, place, strict=True)
            ]
            np.testing.assert_allclose(getattr(trial, name), expected, rtol=1e-9, atol=1e-9)


def test_orders_that_the_robot_logs_do_not_come_from_positions():
    time = np.arange(60) / NATIVE
    position = 0.1 * np.sin(4 * time)

    def orders(**channels: np.ndarray) -> float:
        log = InteractionLog.from_arrays(time, position, np.cos(time), axes=["x"], **channels)
        return float(prepare(log, carried().preprocessing).trials[0].smoothing[0, -1])

    velocity, acceleration = 0.4 * np.cos(4 * time), -1.6 * np.sin(4 * time)
    assert orders() == 3
    assert orders(acceleration=acceleration) == 2
    assert orders(velocity=velocity) == 1
    assert orders(velocity=velocity, acceleration=acceleration) == 1


@pytest.mark.filterwarnings("ignore:axis x. expected motion that follows the device")
def test_acceleration_by_the_law_does_not_come_from_positions():
    device = {"mass": 2.0, "damping": 6.0, "acceleration": "law"}
    model = ImpedanceModel(parse_config({**carried().model_dump(mode="json"), "device": device}))
    for trial in model.prepare(recording()).trials:
        np.testing.assert_array_equal(trial.smoothing[:, -1], 2.0)


def test_motion_that_passed_no_smoother_is_refused():
    motion = repeated_motion(2, duration=0.8, rate=25.0, axes=("x",))
    log = draw_force(configuration(), motion, 0)
    with pytest.raises(
        ConfigurationError, match="expected motion from the smoother with model.position_noise_sd"
    ):
        ImpedanceModel(carried()).log_marginal_likelihood(log)


def test_around_the_hand_itself_the_noise_cancels():
    with pytest.raises(ConfigurationError, match="the position cancels from x_d − x, and its noise with it"):
        parse_config({"model": {"position_noise_sd": 1e-4}})


# --- not carried: nothing changes ----------------------------------------------------------------


def test_not_carried_nothing_of_the_filter_enters(prepared):
    model = ImpedanceModel(carried(None))
    bare = PreparedLog(prepared.axes, tuple(replace(trial, smoothing=None) for trial in prepared.trials))
    assert model.log_marginal_likelihood(prepared) == model.log_marginal_likelihood(bare)
    one, two = (model.posterior(log, given="log") for log in (prepared, bare))
    for latent in Latent:
        np.testing.assert_array_equal(one[latent].location, two[latent].location)
        np.testing.assert_array_equal(one[latent].scale, two[latent].scale)
    features = FeatureMap(model.config, prepared.axes)
    assert features.layout.smoothing == ()
    assert features.width == FeatureMap(carried(), prepared.axes).width - 7
    assert "position_noise_sd" not in [entry.name for entry in model.force_model(("x",)).entries]


# --- likelihood and posteriors against the oracle ------------------------------------------------


@dataclass(frozen=True)
class NoisyOracle(ForceOracle):
    """The oracle, and Σ_ij E[w_i w_j'] S_ij with S from the filter's own matrices; `xi["row"]` says which row."""

    matrix: np.ndarray | None = None

    def covariance(self, one: Samples, two: Samples) -> Tensor:
        """Cov[u, u'] with the noise of the recorded motion."""
        rows1, rows2 = (samples.xi["row"][:, 0].long().numpy() for samples in (one, two))
        total = super().covariance(one, two)
        for i, first in enumerate(self.processes):
            for j, second in enumerate(self.processes):
                weight = torch.tensor(first.expectation * second.expectation, dtype=torch.float64)
                if i == j:
                    weight = first.second_moment(*(self._inputs(samples, first) for samples in (one, two)))
                shared = self.matrix[i][rows1] @ self.matrix[j][rows2].T
                total = total + weight * NOISE**2 * torch.from_numpy(shared)
        return total

    @staticmethod
    def _inputs(samples: Samples, process: object) -> Tensor:
        return samples.xi[process.component] if process.lengthscale else samples.theta


def noisy_oracle(config: Config, log: PreparedLog) -> tuple[NoisyOracle, Samples]:
    plain, samples = oracle_of(config, len(log.axes)), samples_of(config, log, 0)
    every, n = 8, round(0.8 * NATIVE)
    one = np.stack([SMOOTH(np.eye(n), order)[::every] for order in range(3)])
    blocks = [np.kron(np.eye(len(log.trials)), one[order]) for order in range(3)]
    samples.xi["row"] = torch.arange(len(samples.theta), dtype=torch.float64)[:, None]
    return NoisyOracle(plain.trajectory, plain.processes, plain.residual, np.stack(blocks)), samples


@pytest.mark.parametrize("theta", ["phase", "time"])
def test_likelihood_and_posteriors_equal_those_of_the_oracle(prepared, theta):
    config = carried(trajectory_input=theta)
    oracle, samples = noisy_oracle(config, prepared)
    force = torch.from_numpy(np.concatenate([trial.force[:, 0] for trial in prepared.trials]))
    model = ImpedanceModel(config)
    sigma = config.model.noise_sd.median
    own = oracle.covariance(samples, samples)
    full = own + (sigma**2 + config.engine.jitter * own.diagonal().mean()) * torch.eye(len(force)).double()
    expected = multivariate_normal(oracle.mean(samples).numpy(), full.numpy()).logpdf(force.numpy())
    assert model.log_marginal_likelihood(prepared)["x"] == pytest.approx(expected, rel=1e-8)
    # Every third force is unknown: it is predicted beside those that are given.
    unknown = np.arange(len(force)) % 3 == 1
    lengths = np.cumsum([len(trial.time) for trial in prepared.trials])[:-1]
    hidden = [
        replace(trial, force=np.where(gap[:, None], np.nan, trial.force))
        for trial, gap in zip(prepared.trials, np.split(unknown, lengths), strict=True)
    ]
    posterior = model.posterior(PreparedLog(prepared.axes, tuple(hidden)), given="log")
    known = torch.from_numpy(np.flatnonzero(~unknown))
    for latent in Latent:
        location, variance = condition(
            oracle, samples[known], force[known], samples, latent.value, sigma**2, jitter=config.engine.jitter
        )
        marginal = posterior[latent]
        np.testing.assert_allclose(
            marginal.scale[:, 0], variance.sqrt().numpy(), rtol=1e-5, err_msg=latent.value
        )
        if latent.value not in IMPEDANCE[:2]:
            scale = float(location.abs().max())
            np.testing.assert_allclose(marginal.location[:, 0], location.numpy(), rtol=0, atol=1e-6 * scale)


def test_the_closed_loop_has_the_same_jacobian_and_the_wider_covariance(prepared):
    config = parse_config({**carried().model_dump(mode="json"), "device": {"mass": 2.0}})
    feature_map = FeatureMap(config, prepared.axes)
    features = feature_map(prepared, TrajectoryMean.from_training(config.model.desired_trajectory, prepared))
    model = build_force_model(config, feature_map)
    with torch.no_grad():
        given = observations(model, features)
        value = log_likelihood(model.kernel, given, features.loop, 0.0).reshape(())
        k = model.kernel(features.inputs).to_dense()[0, 0]
        k = k + model.noise_variance.reshape(()) * torch.eye(len(k), dtype=k.dtype)
        apparent = ApparentMass(model.kernel.impedance, given, features.loop)
        column, residual = apparent.covariance(given.inputs, Latent.FORCE)[0, 0], given.residual[0, 0]
        mean = apparent.mean[0, 0] + column @ torch.linalg.solve(k, residual)
        variance = apparent.variance[0, 0] - column @ torch.linalg.solve(k, column)
        factor = jacobian(mean, variance, torch.tensor(float(len(k))), torch.tensor(2.0)).log_expectation
    density = multivariate_normal(np.zeros(len(k)), k.numpy()).logpdf(residual.numpy())
    assert float(value) == pytest.approx(density + float(factor), rel=1e-8)


@pytest.mark.parametrize("device", [None, {"mass": 2.0}])
def test_one_point_equals_the_dense_posterior(device):
    config = parse_config(
        {
            # Each axis has a value of its own.
            **carried("{median: 1.0e-4, log_sd: 0.5}").model_dump(mode="json"),
            "device": device,
            "training": {"restarts": 1, "max_iterations": 2},
        }
    )
    model = ImpedanceModel(config).fit(recording(axes=("x", "y")))
    new = model.prepare(recording(seed=1, axes=("x", "y")))
    log = replace(model.fitted.log, trials=(*model.fitted.log.trials, replace(new.trials[0], name="new")))
    # Of the last trial nothing is known, and its noise is its own.
    expected = model.posterior(log, given="training")["force"]
    mean = TrajectoryMean.from_training(config.model.desired_trajectory, model.fitted.log)
    inputs = FeatureMap(config, log.axes)(log, mean).inputs[:, 0].numpy()
    for axis, name in enumerate(log.axes):
        predictor = model.point_predictor(name, "0")
        for row in (0, 7, 19, 39, 40, 50):
            value, variance = predictor.predict(inputs[axis, row])
            assert value == pytest.approx(expected.mean[row, axis], rel=1e-8, abs=1e-8)
            assert np.sqrt(variance) == pytest.approx(expected.sd[row, axis], rel=1e-6)


# --- as a hyperparameter -------------------------------------------------------------------------


def test_it_is_a_hyperparameter_in_metres_that_is_saved_and_loaded(prepared, tmp_path):
    config = parse_config(
        {
            **carried("{median: 1.0e-4, log_sd: 0.5}").model_dump(mode="json"),
            "training": {"restarts": 1, "max_iterations": 3},
        }
    )
    model = ImpedanceModel(config).fit(prepared)
    entry = next(entry for entry in model.hyperparameters if entry.name == "position_noise_sd")
    assert entry.units == ("m",)
    assert float(entry.value.detach()) != pytest.approx(1e-4, rel=1e-3)
    save_model(model, tmp_path / "model")
    loaded = load_model(tmp_path / "model")
    one, two = (m.posterior(recording(seed=1)) for m in (model, loaded))
    for latent in Latent:
        np.testing.assert_array_equal(one[latent].location, two[latent].location)
        np.testing.assert_array_equal(one[latent].scale, two[latent].scale)


def test_every_hyperprior_counts_once(prepared):
    spec = "{median: 1.0e-4, log_sd: 0.5}"
    with_noise, without = (
        build_force_model(config, FeatureMap(config, prepared.axes)).log_prior()
        for config in (carried(spec), carried(None))
    )
    # At its median the density of log σ_x is that of a normal variable of SD .5 at its mean.
    assert float((with_noise - without).detach()) == pytest.approx(
        -np.log(0.5 * np.sqrt(2 * np.pi)), rel=1e-9
    )


def test_a_naive_model_knows_nothing_of_it(prepared):
    values = [
        NaiveModel(config, prepared).predict(prepared)["force"].mean for config in (carried(), carried(None))
    ]
    np.testing.assert_array_equal(*values)


# --- statistics ----------------------------------------------------------------------------------

#: x_d is known to .3 mm; each level is known, k and d vary along the path.
KNOWN: dict[str, object] = {
    "desired_trajectory": {"mean": "reference", "sd": 3e-4, "length_scale": {"phase": 0.12}},
    "stiffness": {"level": 180, "log_sd": 0.3, "input": ["phase"], "length_scale": {"phase": 0.2}},
    "damping": {"level": 14, "log_sd": 0.3, "input": ["phase"], "length_scale": {"phase": 0.2}},
    "mass": {"level": 1.3, "sd": 0.2},
    "residual": {"sd": 0.1, "input": ["position", "velocity"]},
    "noise_sd": 0.1,
}
EVERY = 4


def drawn_beneath_noise(seed: int) -> PreparedLog:
    """Force drawn from the true motion; the motion that is known has the smoothed noise of its positions added."""
    motion = repeated_motion(3, duration=2.0, rate=NATIVE, axes=("x",), seed=seed)
    thinned = [
        replace(
            trial,
            **{name: getattr(trial, name)[::EVERY] for name in ARRAYS if getattr(trial, name) is not None},
        )
        for trial in motion.trials
    ]
    log = draw_force(configuration(**KNOWN), PreparedLog(motion.axes, tuple(thinned)), seed)
    rng, trials = np.random.default_rng(1000 + seed), []
    for trial in log.trials:
        n = EVERY * trial.n_samples
        noise = NOISE * rng.normal(size=(n, 1))
        first, place = SMOOTH.windows(n)
        columns = [
            first,
            place,
            *(np.full(n, value) for value in (SMOOTH.length, SMOOTH.order, SMOOTH.step, 3)),
        ]
        moved = {
            name: getattr(trial, name) + SMOOTH(noise, order)[::EVERY]
            for order, name in enumerate(("position", "velocity", "acceleration", "jerk"))
        }
        trials.append(replace(trial, **moved, smoothing=np.stack(columns, 1)[::EVERY].astype(np.float64)))
    return PreparedLog(log.axes, tuple(trials))


def test_coverage_with_the_noise_and_without_it():
    """90 % intervals of stiffness, and of the force of a repetition that is predicted, over forty draws.

    σ_x = .1 mm makes .24 N of force, where σ_r = .1 N. What carrying it does not mend: noisy regressors attenuate.
    """
    found: dict[str, list[list[float]]] = {"carried": [], "left out": []}
    for seed in range(40):
        log = drawn_beneath_noise(seed)
        last = log.trials[-1]
        known = replace(log, trials=(*log.trials[:-1], replace(last, force=np.full_like(last.force, np.nan))))
        stiffness, mass = truth_of(log, "stiffness"), truth_of(log, "mass")
        for name, noise in (("carried", NOISE), ("left out", None)):
            posterior = ImpedanceModel(carried(noise, **KNOWN)).posterior(known, given="log")
            k, u, m = (posterior[latent] for latent in ("stiffness", "force", "mass"))
            within = (stiffness >= k.quantile(0.05)) & (stiffness <= k.quantile(0.95))
            ahead = slice(-last.n_samples, None)
            predicted = (last.force >= u.quantile(0.05)[ahead]) & (last.force <= u.quantile(0.95)[ahead])
            low = [(value.quantile(0.5) / truth - 1).mean() for value, truth in ((k, stiffness), (m, mass))]
            found[name].append([within.mean(), predicted.mean(), *low])
    carried_k, carried_u, carried_low, carried_mass = np.mean(found["carried"], axis=0)
    left_k, left_u, left_low, left_mass = np.mean(found["left out"], axis=0)
    assert left_k < 0.3
    assert left_u < 0.5
    assert carried_k > 0.85
    assert 0.84 < carried_u < 0.95
    # Attenuation is less, for what is noisy counts less, but it is there.
    assert left_low < -0.15 < -0.06 < carried_low < -0.02
    assert left_mass < -0.25 < -0.12 < carried_mass < -0.04
