"""Ensemble least squares: what it recovers, with and without instrument, and how sure it is."""

from dataclasses import replace

import numpy as np
import pytest

from bayes_impedance.baselines.ensemble import ENOUGH_REPETITIONS, PATH, EnsembleModel
from bayes_impedance.baselines.phase_basis import PhaseBasis
from bayes_impedance.config import load_config
from bayes_impedance.errors import LogError
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.simulation.device import Admittance
from bayes_impedance.simulation.generative import repeated_motion
from bayes_impedance.simulation.one_axis import ConstantImpedance, held_device

CONFIG = load_config("phase")
K = np.array([[120.0, -15.0], [-5.0, 90.0]])
D = np.array([[9.0, 0.5], [-0.8, 11.0]])
M = np.array([[1.4, -0.6], [-0.3, 1.1]])


def offset(phase: np.ndarray) -> np.ndarray:
    """A function of the splines of c, `(n, 2)` [N]."""
    coefficients = np.random.default_rng(1).standard_normal((23, 2)).cumsum(axis=0)
    return PhaseBasis(23)(phase) @ coefficients


def linear(trial, k=K, d=D, m=M) -> np.ndarray:
    """c(φ) − K x − D ẋ − M ẍ."""
    return offset(trial.phase) - trial.position @ k.T - trial.velocity @ d.T - trial.acceleration @ m.T


def with_force(log: PreparedLog, force) -> PreparedLog:
    return PreparedLog(log.axes, tuple(replace(trial, force=force(trial)) for trial in log.trials))


@pytest.fixture(scope="module")
def motion():
    return repeated_motion(repetitions=5, duration=3.0, rate=20.0, seed=1)


@pytest.fixture(scope="module")
def noisy(motion):
    generator = np.random.default_rng(2)
    return with_force(motion, lambda trial: linear(trial) + 0.2 * generator.standard_normal((60, 2)))


def test_coupled_impedance_is_recovered_exactly_beside_a_straight_offset(motion):
    """Nothing of it is penalised."""
    log = with_force(
        motion,
        lambda trial: linear(trial) - offset(trial.phase) + np.outer(trial.phase, [4.0, -2.0]) + 1.0,
    )
    for found, truth in zip(EnsembleModel(CONFIG, log).groups["0"].averages(), (K, D, M), strict=True):
        assert found.value.shape == found.standard_error.shape == (1, 2, 2)
        np.testing.assert_allclose(found.value[0], truth, rtol=1e-5)


def test_coupled_impedance_is_recovered_beside_a_winding_offset(motion):
    """Its second differences are penalised, by next to nothing."""
    estimate = EnsembleModel(CONFIG, with_force(motion, linear)).groups["0"]
    for found, truth in zip(estimate.averages(), (K, D, M), strict=True):
        np.testing.assert_allclose(found.value[0], truth, rtol=2e-3)
    phase = np.linspace(0.1, 0.9, 7)
    np.testing.assert_allclose(estimate.stiffness(phase).value, np.tile(K, (7, 1, 1)), rtol=1e-2)
    np.testing.assert_array_equal(estimate.mass(phase).value[0], estimate.mass().value[-1])


def test_unseen_repetition_of_linear_data_is_predicted(motion):
    log = with_force(motion, linear)
    predicted = EnsembleModel(CONFIG, log.select(range(4))).predict(log.select([4]))
    force = log.trials[4].force
    assert np.abs(predicted.mean - force).max() < 1e-2 * force.std()


def test_impedance_along_the_path_is_recovered(motion):
    def force(trial):
        k = 100.0 + 40.0 * np.sin(2 * np.pi * trial.phase)[:, None]
        d = 10.0 - 4.0 * trial.phase[:, None]
        return offset(trial.phase) - k * trial.position - d * trial.velocity - 1.2 * trial.acceleration

    estimate = EnsembleModel(CONFIG, with_force(motion, force), coupled=False).groups["0"]
    inner = PATH[20:-20]
    for a in range(2):
        stiffness = 100.0 + 40.0 * np.sin(2 * np.pi * inner)
        np.testing.assert_allclose(estimate.stiffness(inner).value[:, a, a], stiffness, atol=4.0)
        np.testing.assert_allclose(estimate.damping(inner).value[:, a, a], 10.0 - 4.0 * inner, atol=0.5)


def test_diagonal_has_nothing_beside_the_diagonal(noisy):
    for found in EnsembleModel(CONFIG, noisy, coupled=False).groups["0"].averages():
        for matrix in (found.value, found.standard_error):
            assert matrix[0, 0, 1] == matrix[0, 1, 0] == 0.0
            assert (matrix[0].diagonal() > 0).all()


def test_origin_of_positions_has_no_part(noisy):
    far = PreparedLog(
        noisy.axes, tuple(replace(trial, position=trial.position + 5.0) for trial in noisy.trials)
    )
    near, shifted = (EnsembleModel(CONFIG, log).predict(log) for log in (noisy, far))
    np.testing.assert_allclose(near.mean, shifted.mean, atol=1e-6)
    np.testing.assert_allclose(near.sd, shifted.sd, rtol=1e-6)


def test_samples_of_unknown_force_have_no_part(noisy):
    def partly(trial):
        force = trial.force.copy()
        force[40:] = np.nan
        return force

    def cut(trial):
        arrays = {
            name: value[:40]
            for name in trial.__slots__
            if isinstance(value := getattr(trial, name), np.ndarray)
        }
        return replace(trial, **arrays)

    shorter = PreparedLog(noisy.axes, tuple(cut(trial) for trial in noisy.trials))
    hidden = EnsembleModel(CONFIG, with_force(noisy, partly)).groups["0"]
    for mine, its in zip(
        hidden.regressions, EnsembleModel(CONFIG, shorter).groups["0"].regressions, strict=True
    ):
        # Only their positions count, for the middle of the motion.
        assert mine.residual_variance == pytest.approx(its.residual_variance, rel=1e-9)


def test_forces_of_the_predicted_log_are_not_looked_at(noisy):
    model = EnsembleModel(CONFIG, noisy)
    lied = model.predict(with_force(noisy, lambda trial: trial.force + 100.0))
    honest = model.predict(with_force(noisy, lambda trial: None))
    np.testing.assert_array_equal(lied.mean, honest.mean)


# --- how sure ------------------------------------------------------------------------------------


def test_standard_errors_are_the_scatter_over_experiments():
    """Residuals that are constant over a quarter of a second: independent ones would be thought to tell more."""
    generator = np.random.default_rng(3)
    values, errors, naive = [], [], []
    for seed in range(40):
        motion = repeated_motion(repetitions=6, duration=3.0, rate=20.0, axes=("x",), seed=seed)

        def force(trial):
            residual = np.repeat(generator.standard_normal(12), 5)[:, None]
            return (
                10.0 * np.sin(6 * trial.phase)[:, None] - 100 * trial.position - 9 * trial.velocity
                - 1.2 * trial.acceleration + residual
            )  # fmt: skip

        estimate = EnsembleModel(CONFIG, with_force(motion, force), impedance_splines=1).groups["0"]
        assert estimate.clustered
        found = estimate.averages()
        values.append([part.value[0, 0, 0] for part in found])
        errors.append([part.standard_error[0, 0, 0] for part in found])
        independent = replace(estimate, repetitions=ENOUGH_REPETITIONS - 1).averages()
        naive.append([part.standard_error[0, 0, 0] for part in independent])
    scatter = np.std(values, axis=0, ddof=1)
    # An SD of 40 values is known to a ninth; the jackknife errs on the side of caution.
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / scatter
    assert (ratio > 0.8).all() and (ratio < 1.8).all()
    assert np.sqrt(np.mean(np.square(naive), axis=0))[0] < 0.8 * scatter[0]
    bias = np.mean(values, axis=0) - [100.0, 9.0, 1.2]
    assert (np.abs(bias) < 4 * scatter / np.sqrt(40)).all()


def test_bands_hold_unseen_repetitions():
    inside = []
    for seed in range(30):
        noise = np.random.default_rng(seed).normal(scale=0.3, size=(6, 60, 2))
        motion = repeated_motion(repetitions=6, duration=3.0, rate=20.0, seed=seed)
        trials = [
            replace(trial, force=linear(trial) + added)
            for trial, added in zip(motion.trials, noise, strict=True)
        ]
        log = PreparedLog(motion.axes, tuple(trials))
        predicted = EnsembleModel(CONFIG, log.select(range(5))).predict(log.select([5]))
        inside.append(np.mean(np.abs(predicted.mean - log.trials[5].force) < 1.6448536 * predicted.sd))
    # Wide of .9 on the safe side: what is left of five repetitions counts parameters of four as noise.
    assert 0.89 < np.mean(inside) < 0.97


def test_phases_that_nobody_saw_are_uncertain(noisy):
    def early(trial):
        force = trial.force.copy()
        force[trial.phase > 0.6] = np.nan
        return force

    predicted = EnsembleModel(CONFIG, with_force(noisy, early)).predict(noisy)
    phase = np.concatenate([trial.phase for trial in noisy.trials])
    assert predicted.sd[phase > 0.8].min() > 3 * np.median(predicted.sd[phase < 0.5])


# --- instruments ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def loops():
    """(k, d, m) of ten simulated sessions at 1 N, `(10, 3)`, by whether the perturbation is known."""
    model = ImpedanceModel.from_config("admittance")
    found = {True: [], False: []}
    for seed in range(10):
        log = model.prepare(held_device(ConstantImpedance(), Admittance(), 1.0, seed=seed))
        blind = PreparedLog(log.axes, tuple(replace(trial, perturbation=None) for trial in log.trials))
        for known, given in ((True, log), (False, blind)):
            estimate = EnsembleModel(model.config, given).groups["0"]
            assert estimate.instrumented is known
            found[known].append([part.value[0, 0, 0] for part in estimate.averages()])
    return {known: np.array(values) for known, values in found.items()}


def test_the_perturbation_as_instrument_removes_the_bias_of_the_loop(loops):
    truth = np.array([ConstantImpedance().stiffness, ConstantImpedance().damping, ConstantImpedance().mass])
    blind, instrumented = (np.abs(loops[known].mean(axis=0) / truth - 1.0) for known in (False, True))
    assert (blind > [0.15, 0.2, 0.25]).all()
    assert (instrumented < 0.35 * blind).all()
    within = np.abs(loops[True].mean(axis=0) - truth) / (loops[True].std(axis=0, ddof=1) / np.sqrt(10))
    assert (within < 3).all()


# --- refusals ------------------------------------------------------------------------------------


def test_log_without_force(motion):
    with pytest.raises(
        LogError, match="^expected a log with force to train on, found none; name log.columns.force$"
    ):
        EnsembleModel(CONFIG, motion)


def test_log_without_phase(noisy):
    log = PreparedLog(noisy.axes, (noisy.trials[0], replace(noisy.trials[1], phase=None)))
    with pytest.raises(
        LogError,
        match=r"^memory, trial 1: expected a phase column, for this estimate knows the force of a repetition by its "
        r"phase, found none; name it in log\.columns\.phase, or leave this baseline out$",
    ):
        EnsembleModel(CONFIG, log)


def test_a_single_repetition(noisy):
    other = replace(noisy.trials[2], group="other")
    with pytest.raises(
        LogError,
        match="^group 'other': expected at least two repetitions of known force, whose differences at equal phase tell "
        "of the arm, found 1; record more, or leave the ensemble out$",
    ):
        EnsembleModel(CONFIG, PreparedLog(noisy.axes, (*noisy.trials[:2], other)))


def test_repetitions_of_one_trial_count(noisy):
    """A trial may hold several."""
    first, second = noisy.trials[:2]
    arrays = {
        name: np.concatenate([value, getattr(second, name)])
        for name in first.__slots__
        if isinstance(value := getattr(first, name), np.ndarray)
    }
    arrays |= {"time": np.arange(120) / 20.0, "repetition": np.repeat([0, 1], 60)}
    whole = EnsembleModel(CONFIG, PreparedLog(noisy.axes, (replace(first, **arrays),))).groups["0"]
    apart = EnsembleModel(CONFIG, noisy.select([0, 1])).groups["0"]
    assert whole.repetitions == apart.repetitions == 2
    assert not whole.clustered
    for mine, its in zip(whole.regressions, apart.regressions, strict=True):
        np.testing.assert_allclose(mine.coefficients, its.coefficients)


def test_group_that_was_not_trained_on(noisy):
    stranger = PreparedLog(noisy.axes, (replace(noisy.trials[0], group="left arm"),))
    with pytest.raises(
        LogError,
        match=r"^memory, trial 0: expected a group whose impedance was estimated \(0\), got group 'left arm'; train on "
        "a trial of that group too, or leave the estimators out$",
    ):
        EnsembleModel(CONFIG, noisy).predict(stranger)
