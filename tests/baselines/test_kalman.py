"""The filter beside dense Gaussian conditioning where it is linear, and beside a textbook loop where it is not."""

import math
from dataclasses import replace

import numpy as np
import pytest
from oracles import TRUTH, timeless

from bayes_impedance.baselines.kalman import ExtendedKalmanFilter
from bayes_impedance.baselines.phase_basis import PhaseBasis
from bayes_impedance.config import load_config, parse_config
from bayes_impedance.errors import LogError
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.simulation.generative import draw_force, repeated_motion

CONFIG = load_config("phase")
KNOWN = load_config(
    "phase",
    [
        "model.stiffness={level: 150, log_sd: 1.0e-9}",
        "model.damping={level: 12, log_sd: 1.0e-9}",
        "model.mass.level=1.3",
    ],
)


@pytest.fixture(scope="module")
def log():
    motion = repeated_motion(repetitions=4, duration=3.0, rate=15.0, seed=5)
    return draw_force(parse_config(TRUTH), motion, seed=5)


def hidden(trial, samples: slice):
    force = trial.force.copy()
    force[samples] = np.nan
    return replace(trial, force=force)


def walk_of(log: PreparedLog, axis: int) -> float:
    """Variance a second of a walk that goes as far as the hand."""
    squares = sum(np.sum(np.diff(trial.position[:, axis]) ** 2) for trial in log.trials)
    return squares / sum(trial.time[-1] - trial.time[0] for trial in log.trials)


def test_with_known_impedance_it_is_gaussian_conditioning(log):
    given = PreparedLog(log.axes, tuple(hidden(trial, slice(10, 14)) for trial in log.trials))
    tracks = ExtendedKalmanFilter(KNOWN, given).filter(given)
    for trial, track in zip(given.trials, tracks, strict=True):
        for a in range(2):
            elapsed = trial.time - trial.time[0]
            prior = 0.02**2 + walk_of(given, a) * np.minimum.outer(elapsed, elapsed)
            displacement = (
                trial.force[:, a] + 150 * trial.position[:, a] + 12 * trial.velocity[:, a]
                + 1.3 * trial.acceleration[:, a]
            )  # fmt: skip
            for i in (0, 7, 12, 44):
                past = np.flatnonzero(np.isfinite(trial.force[: i + 1, a]))
                gram = 150**2 * prior[np.ix_(past, past)] + 0.2**2 * np.eye(len(past))
                gain = np.linalg.solve(gram, 150 * prior[past, i])
                start = trial.position[0, a]
                mean = start + gain @ (displacement[past] - 150 * start)
                variance = prior[i, i] - gain @ (150 * prior[past, i])
                assert track.desired_position[i, a] == pytest.approx(mean, rel=1e-6, abs=1e-9)
                assert track.desired_position_sd[i, a] == pytest.approx(math.sqrt(variance), rel=1e-5)
    np.testing.assert_allclose(tracks[-1].stiffness, 150.0, rtol=1e-6)
    np.testing.assert_allclose(tracks[-1].damping_sd, 0.0, atol=1e-6)


def textbook(log: PreparedLog, axis: int, memory: float):
    """Mean and covariance after every sample: prediction, numerical Jacobian, gain, information form of the update."""
    q = np.diag([0.3**2 / memory, 0.3**2 / memory, walk_of(log, axis)])
    z = np.array([math.log(300.0), math.log(20.0), 0.0])
    p = np.diag([1.0 + 0.3**2, 1.0 + 0.3**2, 0.0])
    found = []
    for trial in log.trials:
        z[2] = trial.position[0, axis]
        p[2, :] = p[:, 2] = 0.0
        p[2, 2] = 0.02**2
        for i in range(trial.n_samples):
            if i:
                p = p + q * (trial.time[i] - trial.time[i - 1])
            x, v, acceleration = (
                part[i, axis] for part in (trial.position, trial.velocity, trial.acceleration)
            )

            def h(z, x=x, v=v, acceleration=acceleration):
                return math.exp(z[0]) * (z[2] - x) - math.exp(z[1]) * v - 1.5 * acceleration

            steps = 1e-6 * np.eye(3)
            slope = np.array([(h(z + step) - h(z - step)) / 2e-6 for step in steps])
            updated = np.linalg.inv(np.linalg.inv(p) + np.outer(slope, slope) / 0.2**2)
            z = z + updated @ slope * (trial.force[i, axis] - h(z)) / 0.2**2
            p = updated
            found.append((z.copy(), np.sqrt(p.diagonal())))
    return found


def test_with_unknown_impedance_it_is_the_textbook_loop(log):
    tracks = ExtendedKalmanFilter(CONFIG, log, memory=8.0).filter(log)
    for a in range(2):
        expected = textbook(log, a, 8.0)
        k, d = (np.concatenate([getattr(t, name)[:, a] for t in tracks]) for name in ("stiffness", "damping"))
        np.testing.assert_allclose(k, [math.exp(z[0]) for z, _ in expected], rtol=1e-4)
        np.testing.assert_allclose(d, [math.exp(z[1]) for z, _ in expected], rtol=1e-4)
        for name, order, scale in (
            ("stiffness_sd", 0, k),
            ("damping_sd", 1, d),
            ("desired_position_sd", 2, 1.0),
        ):
            found = np.concatenate([getattr(track, name)[:, a] for track in tracks])
            np.testing.assert_allclose(found, scale * np.array([sd[order] for _, sd in expected]), rtol=1e-4)


def test_absurd_forces_leave_finite_estimates(log):
    forces = [np.full((45, 2), 1e6 * (-1) ** i) for i in range(4)]
    wild = PreparedLog(
        log.axes, tuple(replace(trial, force=force) for trial, force in zip(log.trials, forces, strict=True))
    )
    model = ExtendedKalmanFilter(CONFIG, wild)
    for track in model.filter(wild):
        assert np.isfinite(track.stiffness_sd).all()
        # Five SDs of the start, and no further.
        assert np.abs(np.log(track.stiffness / 300.0)).max() <= 5 * math.hypot(1.0, 0.3) * (1 + 1e-9)
    assert np.isfinite(model.predict(wild).mean).all()


def test_x_d_begins_each_trial_anew_and_impedance_goes_on(log):
    model = ExtendedKalmanFilter(CONFIG, log)
    tracks, first = model.filter(log), model.filter(log.select([1]))[0]
    unknown = PreparedLog(log.axes, (log.trials[0], hidden(log.trials[1], slice(None))))
    blind = model.filter(unknown)[1]
    np.testing.assert_array_equal(blind.desired_position[0], log.trials[1].position[0])
    np.testing.assert_allclose(blind.desired_position_sd[0], 0.02)
    np.testing.assert_array_equal(blind.stiffness[0], tracks[0].stiffness[-1])
    assert (first.stiffness_sd[0] > 1.5 * tracks[1].stiffness_sd[0]).all()


def test_groups_know_nothing_of_each_other(log):
    trials = tuple(replace(trial, group="ab"[i % 2]) for i, trial in enumerate(log.trials))
    both = PreparedLog(log.axes, trials)
    together = ExtendedKalmanFilter(CONFIG, both)
    for group in range(2):
        own = both.select([group, group + 2])
        alone = ExtendedKalmanFilter(CONFIG, own)
        np.testing.assert_array_equal(together.predict(own).mean, alone.predict(own).mean)
        np.testing.assert_array_equal(together.filter(both)[group].stiffness, alone.filter(own)[0].stiffness)


# --- prediction ----------------------------------------------------------------------------------


def test_prediction_takes_x_d_from_other_repetitions_at_equal_phase(log):
    training, test = log.select([0, 1, 2]), log.trials[3]
    model = ExtendedKalmanFilter(CONFIG, training)
    tracks = model.filter(training)
    predicted = model.predict(log.select([3]))
    phase = np.concatenate([trial.phase for trial in training.trials])
    inside = (test.phase >= phase.min()) & (test.phase <= phase.max())
    splines = PhaseBasis(23)
    for a in range(2):
        desired = np.concatenate([track.desired_position[:, a] for track in tracks])
        average = splines(test.phase) @ np.linalg.lstsq(splines(phase), desired, rcond=None)[0]
        k, d = tracks[-1].stiffness[-1, a], tracks[-1].damping[-1, a]
        expected = (
            k * (average - test.position[:, a]) - d * test.velocity[:, a] - 1.5 * test.acceleration[:, a]
        )
        np.testing.assert_allclose(predicted.mean[inside, a], expected[inside], atol=0.05)


@pytest.mark.parametrize("phased", [True, False])
def test_where_x_d_is_unknown_it_is_the_hand(log, phased):
    """No phase at all, or phases beyond those of training."""
    given = PreparedLog(log.axes, tuple(hidden(trial, slice(25, None)) for trial in log.trials))
    given = given if phased else timeless(given)
    predicted = ExtendedKalmanFilter(CONFIG, given).predict(given)
    phase = np.concatenate([trial.phase for trial in log.trials])
    known = np.concatenate([trial.force[:25] for trial in log.trials])
    last = max(trial.phase[24] for trial in log.trials)
    away = phase > last if phased else np.ones(phase.size, dtype=bool)
    assert away.sum() > 40
    assert not predicted.mean[away].any()
    np.testing.assert_allclose(
        predicted.sd[away], np.tile(np.sqrt(np.mean(known**2, axis=0)), (away.sum(), 1))
    )
    if phased:
        assert predicted.mean[~away].all()


def test_bands_hold_unseen_repetitions():
    shares = []
    for seed in range(12):
        motion = repeated_motion(repetitions=6, duration=3.0, rate=15.0, displacement_sd=0.012, seed=seed)
        log = draw_force(parse_config(TRUTH), motion, seed)
        predicted = ExtendedKalmanFilter(CONFIG, log.select(range(5))).predict(log.select([5]))
        shares.append(np.mean(np.abs(predicted.mean - log.trials[5].force) < 1.6448536 * predicted.sd))
    assert np.mean(shares) == pytest.approx(0.9, abs=3 * np.std(shares, ddof=1) / np.sqrt(12) + 0.05)


def test_a_single_repetition_predicts_itself(log):
    predicted = ExtendedKalmanFilter(CONFIG, log.select([0])).predict(log.select([0]))
    assert np.isfinite(predicted.mean).all()
    assert (predicted.sd > 0).all()


def test_refusals(log):
    model = ExtendedKalmanFilter(CONFIG, log)
    with pytest.raises(LogError, match="expected a log with force to train on, found none; name"):
        ExtendedKalmanFilter(CONFIG, PreparedLog(log.axes, (replace(log.trials[0], force=None),)))
    with pytest.raises(
        LogError, match="trial 0: expected a phase column, for this estimate knows the force of"
    ):
        model.predict(timeless(log))
    stranger = PreparedLog(log.axes, (replace(log.trials[0], group="left"),))
    for use in (model.predict, model.filter):
        with pytest.raises(
            LogError, match=r"whose impedance was estimated \(0\), got group 'left'; train on"
        ):
            use(stranger)
