"""Recursive least squares beside batch least squares of stacked, weighted rows."""

import math
from dataclasses import replace

import numpy as np
import pytest
from oracles import TRUTH, timeless

from bayes_impedance.baselines.phase_basis import PhaseBasis
from bayes_impedance.baselines.recursive import RecursiveLeastSquares
from bayes_impedance.config import load_config, parse_config
from bayes_impedance.errors import LogError
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.simulation.generative import draw_force, repeated_motion

CONFIG = load_config("phase")
#: A start that says nothing.
WIDE = load_config(
    "phase",
    [
        "model.stiffness.level={median: 1.0e+8, log_sd: 5}",
        "model.damping.level={median: 1.0e+7, log_sd: 5}",
        "model.mass.level={median: 1.0e+6, log_sd: 5}",
    ],
)
#: Medians of k, d, m, and SDs: log-SD of the level and of the process along the path.
LEVEL = np.array([300.0, 20.0, 1.5])
SD = LEVEL * np.hypot([1.0, 1.0, 0.7], [0.3, 0.3, 0.2])
NOISE_SD = 0.2


@pytest.fixture(scope="module")
def log():
    motion = repeated_motion(repetitions=4, duration=3.0, rate=15.0, seed=5)
    return draw_force(parse_config(TRUTH), motion, seed=5)


def rows_of(log: PreparedLog, axis: int, phased: bool):
    """Columns of c (splines, or one for each trial), −(x − middle), −ẋ, −ẍ; and forces."""
    middle = np.concatenate([trial.position[:, axis] for trial in log.trials]).mean()
    blocks, forces = [], []
    for i, trial in enumerate(log.trials):
        own = np.tile(np.eye(len(log.trials))[i], (trial.n_samples, 1))
        motion = [trial.position[:, axis] - middle, trial.velocity[:, axis], trial.acceleration[:, axis]]
        c = PhaseBasis(23)(trial.phase) if phased else own
        blocks.append(np.column_stack([c, *(-part for part in motion)]))
        forces.append(trial.force[:, axis])
    return np.concatenate(blocks), np.concatenate(forces)


def weights_of(log: PreparedLog, memory: float) -> np.ndarray:
    """exp(−age / memory) in the time that went by within trials."""
    spans = [trial.time - trial.time[0] for trial in log.trials]
    starts = np.cumsum([0.0, *(span[-1] for span in spans)])
    elapsed = np.concatenate([span + start for span, start in zip(spans, starts, strict=False)])
    return np.exp((elapsed - elapsed[-1]) / memory)


def batch(
    log: PreparedLog, axis: int, phased: bool, memory: float, noise_sd: float, until: int | None = None
):
    """Parameters after the first `until` samples, from their rows and, below them, rows of the start."""
    rows, force = rows_of(log, axis, phased)
    positions = np.concatenate([trial.position[:, axis] for trial in log.trials])
    offset_sd = np.sqrt((LEVEL[0] * positions.std()) ** 2 + np.mean(force**2))
    n_offsets = rows.shape[1] - 3
    sd = np.append(np.full(n_offsets, offset_sd), SD)
    weight = (np.sqrt(weights_of(log, memory)) / noise_sd)[:until]
    stacked = np.vstack([weight[:, None] * rows[:until], np.diag(1.0 / sd)])
    target = np.concatenate([weight * force[:until], np.zeros(n_offsets), LEVEL / SD])
    return np.linalg.lstsq(stacked, target, rcond=None)[0]


def left_over(log, axis, phased, memory, noise_sd):
    """SD of what the parameters at the end leave; offsets of trials are the average of those at the end of each."""
    rows, force = rows_of(log, axis, phased)
    parameters = batch(log, axis, phased, memory, noise_sd)
    if not phased:
        ends = np.cumsum([trial.n_samples for trial in log.trials])
        offsets = [batch(log, axis, phased, memory, noise_sd, end)[i] for i, end in enumerate(ends)]
        parameters[:-3] = np.mean(offsets)
    return np.sqrt(np.mean((force - rows @ parameters) ** 2))


@pytest.mark.parametrize("memory", [math.inf, 5.0])
@pytest.mark.parametrize("phased", [True, False])
def test_the_end_is_batch_least_squares(log, phased, memory):
    given = log if phased else timeless(log)
    if not phased and math.isfinite(memory):
        # What was integrated out is not forgotten apart: take a single trial.
        given = given.select([0])
    model = RecursiveLeastSquares(CONFIG, given, memory)
    last = model.filter(given)[-1]
    for a in range(2):
        expected = batch(given, a, phased, memory, left_over(given, a, phased, memory, NOISE_SD))
        assert last.stiffness[-1, a] == pytest.approx(expected[-3], rel=1e-6)
        assert last.damping[-1, a] == pytest.approx(expected[-2], rel=1e-6)


def test_without_a_start_or_forgetting_it_is_plain_least_squares(log):
    last = RecursiveLeastSquares(WIDE, timeless(log), math.inf).filter(timeless(log))[-1]
    for a in range(2):
        rows, force = rows_of(log, a, phased=False)
        expected = np.linalg.lstsq(rows, force, rcond=None)[0]
        assert last.stiffness[-1, a] == pytest.approx(expected[-3], rel=1e-4)
        assert last.damping[-1, a] == pytest.approx(expected[-2], rel=1e-4)


def test_spread_is_that_of_least_squares(log):
    given = timeless(log).select([0])
    last = RecursiveLeastSquares(WIDE, given, math.inf).filter(given)[-1]
    for a in range(2):
        rows, force = rows_of(given, a, phased=False)
        expected = np.linalg.lstsq(rows, force, rcond=None)[0]
        variance = np.mean((force - rows @ expected) ** 2) * np.linalg.inv(rows.T @ rows)
        assert last.stiffness_sd[-1, a] == pytest.approx(np.sqrt(variance[-3, -3]), rel=1e-2)
        assert last.damping_sd[-1, a] == pytest.approx(np.sqrt(variance[-2, -2]), rel=1e-2)
        # x_d = c / k by the propagation of errors.
        c, k = expected[0], expected[1]
        slope = np.array([1 / k, -c / k**2])
        assert last.desired_position_sd[-1, a] == pytest.approx(
            np.sqrt(slope @ variance[:2, :2] @ slope), rel=1e-2
        )
        middle = given.trials[0].position[:, a].mean()
        assert last.desired_position[-1, a] == pytest.approx(middle + c / k, rel=1e-3)


def test_a_resting_target_and_a_constant_arm_are_found():
    motion = timeless(repeated_motion(repetitions=3, duration=4.0, rate=20.0, axes=("x",), seed=2))
    generator = np.random.default_rng(0)
    trials = [
        replace(
            trial,
            force=150.0 * (0.03 * i - trial.position) - 12.0 * trial.velocity - 1.1 * trial.acceleration
            + 0.1 * generator.standard_normal((80, 1)),
        )
        for i, trial in enumerate(motion.trials)
    ]  # fmt: skip
    log = PreparedLog(motion.axes, tuple(trials))
    for i, track in enumerate(RecursiveLeastSquares(CONFIG, log, math.inf).filter(log)):
        assert track.time.shape == (80,) and track.stiffness.shape == track.damping_sd.shape == (80, 1)
        assert track.stiffness[-1, 0] == pytest.approx(150.0, rel=0.02)
        assert track.damping[-1, 0] == pytest.approx(12.0, rel=0.02)
        assert track.desired_position[-1, 0] == pytest.approx(0.03 * i, abs=1e-3)


def test_estimates_know_only_the_past_and_skip_unknown_forces(log):
    model = RecursiveLeastSquares(CONFIG, log)
    force = log.trials[1].force.copy()
    force[20:] += 50.0
    force[5:9] = np.nan
    other = PreparedLog(log.axes, (log.trials[0], replace(log.trials[1], force=force), *log.trials[2:]))
    honest, changed = model.filter(log), model.filter(other)
    np.testing.assert_array_equal(honest[0].stiffness, changed[0].stiffness)
    np.testing.assert_array_equal(honest[1].stiffness[:5], changed[1].stiffness[:5])
    steps = np.abs(np.diff(changed[1].damping_sd, axis=0))
    assert (changed[1].stiffness[20:] != honest[1].stiffness[20:]).all()
    # Nothing is learned while force is unknown: a little is forgotten.
    assert (np.diff(changed[1].damping_sd[4:9], axis=0) >= 0).all() and steps.max() > 0


def test_groups_know_nothing_of_each_other(log):
    trials = tuple(
        replace(trial, group="ab"[i % 2], force=trial.force * (1 + i % 2))
        for i, trial in enumerate(log.trials)
    )
    both = PreparedLog(log.axes, trials)
    together = RecursiveLeastSquares(CONFIG, both)
    for group in range(2):
        own = both.select([group, group + 2])
        alone = RecursiveLeastSquares(CONFIG, own)
        np.testing.assert_array_equal(together.predict(own).mean, alone.predict(own).mean)
        tracks = together.filter(both)
        for mine, its in zip((tracks[group], tracks[group + 2]), alone.filter(own), strict=True):
            np.testing.assert_array_equal(mine.stiffness, its.stiffness)


@pytest.mark.parametrize("phased", [True, False])
def test_prediction_is_that_of_the_parameters_at_the_end(log, phased):
    given = log if phased else timeless(log)
    predicted = RecursiveLeastSquares(CONFIG, given, math.inf).predict(given)
    left = predicted.mean - np.concatenate([trial.force for trial in log.trials])
    for a in range(2):
        noise_sd = left_over(given, a, phased, math.inf, NOISE_SD)
        sd = left_over(given, a, phased, math.inf, noise_sd)
        assert np.sqrt(np.mean(left[:, a] ** 2)) == pytest.approx(sd, rel=1e-6)
        assert (predicted.sd[:, a] >= sd * (1 - 1e-9)).all()


def test_bands_hold_unseen_repetitions():
    shares = []
    for seed in range(12):
        motion = repeated_motion(repetitions=6, duration=3.0, rate=15.0, displacement_sd=0.012, seed=seed)
        log = draw_force(parse_config(TRUTH), motion, seed)
        predicted = RecursiveLeastSquares(CONFIG, log.select(range(5))).predict(log.select([5]))
        shares.append(np.mean(np.abs(predicted.mean - log.trials[5].force) < 1.6448536 * predicted.sd))
    # Impedance that varies along the path is an error that lasts, so one draw tells little.
    assert np.mean(shares) == pytest.approx(0.9, abs=3 * np.std(shares, ddof=1) / np.sqrt(12) + 0.03)


def test_linear_data_without_noise_are_no_division_by_nought():
    motion = repeated_motion(repetitions=3, duration=3.0, rate=15.0, seed=1)
    log = PreparedLog(
        motion.axes,
        tuple(
            replace(
                trial,
                force=-100.0 * trial.position - 9.0 * trial.velocity - 1.2 * trial.acceleration,
            )
            for trial in motion.trials
        ),
    )
    last = RecursiveLeastSquares(CONFIG, log, math.inf).filter(log)[-1]
    np.testing.assert_allclose(last.stiffness[-1], 100.0, rtol=1e-2)
    np.testing.assert_allclose(last.damping[-1], 9.0, rtol=1e-2)


def test_refusals(log):
    model = RecursiveLeastSquares(CONFIG, log)
    with pytest.raises(LogError, match="expected a log with force to train on, found none; name"):
        RecursiveLeastSquares(CONFIG, PreparedLog(log.axes, (replace(log.trials[0], force=None),)))
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
