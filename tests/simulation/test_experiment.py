"""Whole recordings: the paper's table, the truth beside the samples, seeds, subjects."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm_oracles import Array

from bayes_impedance.errors import LogError, SimulationError
from bayes_impedance.log import InteractionLog, Trial
from bayes_impedance.simulation.arm import TABLE_I, Arm, arm_with
from bayes_impedance.simulation.device import (
    IDEAL,
    Admittance,
    BandLimitedForce,
    ForcePulses,
    PositionDisplacement,
)
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.subjects import SUBJECTS, Subject, find_subject, scaled_arm
from bayes_impedance.simulation.tasks import FigureEight, Flower, Pace, Reaches
from bayes_impedance.simulation.tasks import Path as TaskPath

QUICK = Pace(2.0)
DOCUMENT = Path(__file__).parents[2] / "docs" / "model.md"
DEVICE = Admittance()


def quick(*people: Subject, **changes: object) -> Experiment:
    """Two trials of one round of two seconds for each person."""
    subjects = [replace(person, pace=QUICK) for person in people or (Subject("P"),)]
    settings: dict[str, object] = {"trials": 2, "repetitions": 1, "perturbation": BandLimitedForce(2.0)}
    return Experiment(subjects, FigureEight(), **(settings | changes))


def matrix(trial: Trial, name: str) -> Array:
    xx, xy, yy = (trial.truth[f"{name}_{axes}"] for axes in ("xx", "xy", "yy"))
    return np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)


def vector(trial: Trial, name: str) -> Array:
    return np.stack([trial.truth[f"{name}_{axis}"] for axis in "xy"], -1)


def bits(log: InteractionLog) -> str:
    return log.fingerprint()


# --- the paper's simulation ----------------------------------------------------------------------


@pytest.mark.parametrize("setting", TABLE_I)
def test_averages_along_the_flower_are_those_of_table_1(setting: str) -> None:
    log = simulate(Experiment([Subject(setting, arm_with(setting))], Flower()), seed=0)
    written = DOCUMENT.read_text(encoding="utf-8")
    for name, paper in (("damping", "damping"), ("muscle_stiffness", "stiffness")):
        both = [
            np.concatenate([trial.truth[f"{name}_{axes}"] for trial in log.trials]) for axes in ("xx", "yy")
        ]
        np.testing.assert_allclose([values.mean() for values in both], TABLE_I[setting][paper], rtol=0.08)
        assert ", ".join(f"{values.mean():.1f} ({values.std():.1f})" for values in both) in written
    for trial in log.trials:
        np.testing.assert_allclose(
            12.0 * matrix(trial, "damping"), matrix(trial, "muscle_stiffness"), rtol=0, atol=1e-9
        )


# --- truth ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fine() -> Trial:
    """Perturbed and noisy motion at every step, seen by perfect sensors."""
    return simulate(quick(rate=1000.0, sensors=IDEAL), seed=3).trials[0]


def differentiated(trial: Trial) -> tuple[Array, Array]:
    """Velocity and acceleration of the recorded positions, without the first and last sample."""
    step = trial.time[1] - trial.time[0]
    velocity = (trial.position[2:] - trial.position[:-2]) / (2 * step)
    return velocity, np.diff(trial.position, 2, axis=0) / step**2


def test_device_obeys_its_law(fine: Trial) -> None:
    velocity, acceleration = differentiated(fine)
    # Noise of the muscles is held over a step, so that differences see the mean of two.
    law = fine.force + fine.perturbation
    felt = 0.25 * (law[2:] + 2 * law[1:-1] + law[:-2])
    np.testing.assert_allclose(DEVICE.mass * acceleration + DEVICE.damping * velocity, felt, atol=0.05)


def test_force_is_impedance_times_error_and_a_residual(fine: Trial) -> None:
    velocity, acceleration = differentiated(fine)
    inside = slice(1, -1)
    recovered = vector(fine, "residual_force")[inside].copy()
    for name, wanted, had in (
        ("stiffness", "desired_position", fine.position[inside]),
        ("damping", "desired_velocity", velocity),
        ("mass", "desired_acceleration", acceleration),
    ):
        error = vector(fine, wanted)[inside] - had
        recovered += np.einsum("nij,nj->ni", matrix(fine, name)[inside], error)
    np.testing.assert_allclose(recovered, fine.force[inside], atol=0.05)


def share_of_residual(path: TaskPath, pace: Pace, sd: float, **arm: float) -> float:
    """‖residual‖ / ‖force‖ of one round without noise."""
    person = Subject("P", arm_with("low", noise=0.0, **arm), pace)
    trial = simulate(Experiment([person], path, 1, 1, BandLimitedForce(sd), sensors=IDEAL), seed=1).trials[0]
    return float(np.linalg.norm(vector(trial, "residual_force")) / np.linalg.norm(trial.force))


def test_residual_around_a_posture_vanishes_with_the_square_of_the_error() -> None:
    still = Reaches(distance=1e-9)
    large, small, smaller = (share_of_residual(still, QUICK, sd) for sd in (2.0, 0.2, 0.02))
    assert large < 0.1
    np.testing.assert_allclose([large / small, small / smaller], 10.0, rtol=0.3)


@pytest.mark.parametrize(("duration", "largest"), [(10.0, 0.15), (20.0, 0.075), (40.0, 0.0375)])
def test_residual_of_slow_motion_is_small_against_force(duration: float, largest: float) -> None:
    assert share_of_residual(Flower(), Pace(duration), sd=0.0) < largest


def test_residual_is_what_the_person_anticipates_of_the_device() -> None:
    person = Subject("P", arm_with("low", noise=0.0, anticipation=0.7))
    trial = simulate(quick(person, perturbation=BandLimitedForce(0.0), sensors=IDEAL), seed=1).trials[0]
    unplanned = replace(person, arm=arm_with("low", noise=0.0))
    without = simulate(quick(unplanned, perturbation=BandLimitedForce(0.0), sensors=IDEAL), 1).trials[0]
    load = DEVICE.mass * vector(trial, "desired_acceleration") + DEVICE.damping * vector(
        trial, "desired_velocity"
    )
    gained = np.linalg.norm(vector(trial, "residual_force") - 0.7 * load)
    assert gained < np.linalg.norm(vector(without, "residual_force"))


def test_desired_trajectory_is_the_displayed_path_and_its_derivatives(fine: Trial) -> None:
    np.testing.assert_array_equal(vector(fine, "desired_position"), fine.reference)
    step = fine.time[1] - fine.time[0]
    for lower, higher in (
        ("desired_position", "desired_velocity"),
        ("desired_velocity", "desired_acceleration"),
    ):
        differences = np.gradient(vector(fine, lower), step, axis=0)[1:-1]
        scale = np.abs(vector(fine, higher)).max()
        np.testing.assert_allclose(differences, vector(fine, higher)[1:-1], atol=1e-4 * scale)


def test_truth_has_the_columns_of_the_design(fine: Trial) -> None:
    vectors = ("desired_position", "desired_velocity", "desired_acceleration", "residual_force")
    matrices = ("stiffness", "muscle_stiffness", "damping", "mass")
    assert set(fine.truth) == {f"{name}_{axis}" for name in vectors for axis in "xy"} | {
        f"{name}_{axes}" for name in matrices for axes in ("xx", "xy", "yy")
    }


def test_impedance_of_the_truth_is_positive_definite(fine: Trial) -> None:
    for name in ("stiffness", "damping", "mass"):
        assert (np.linalg.eigvalsh(matrix(fine, name)) > 0).all()


def test_muscle_noise_has_the_deviation_and_correlation_time_of_the_arm() -> None:
    """With nothing but co-contraction to multiply, noise of tension is a random torque of known variance."""
    arm = Arm(noise=0.1, noise_time=0.05, co_contraction=40.0, muscle_stiffness=3e5)
    person = Subject("P", arm, Pace(400.0, spread=0.0))
    still = Reaches(distance=1e-9, targets=1)
    trial = simulate(
        Experiment([person], still, 1, 1, device=Admittance(5e3, 0.0), sensors=IDEAL), seed=0
    ).trials[0]
    # So stiff and so heavy that the hand hardly moves: the force of the hand is torque of the muscles.
    jacobian = arm.jacobian(arm.posture(np.array([still.centre])))[0]
    error = vector(trial, "desired_position") - trial.position
    spring = np.einsum("nij,nj->ni", matrix(trial, "stiffness"), error)
    torque = (trial.force - spring) @ jacobian
    expected = 2.0 * (0.1 * 40.0) ** 2 * arm.pair_arms.T @ arm.pair_arms
    np.testing.assert_allclose(np.cov(torque.T), expected, rtol=0.15)
    lag = round(0.05 * 200)
    correlation = (torque[lag:] * torque[:-lag]).mean(0) / (torque**2).mean(0)
    np.testing.assert_allclose(correlation, np.exp(-1.0), atol=0.06)


def test_anticipation_brings_the_hand_closer_to_where_the_person_wants_it() -> None:
    errors = []
    for share in (0.0, 1.0):
        person = Subject("P", arm_with("low", noise=0.0, anticipation=share))
        trial = simulate(quick(person, sensors=IDEAL, perturbation=BandLimitedForce(0.0)), 0).trials[0]
        errors.append(np.abs(trial.position - trial.reference).max())
    # What is known of the device beforehand is all there is.
    assert errors[0] > 0.01 and errors[1] < 1e-6


# --- sampling ------------------------------------------------------------------------------------


def test_lower_rate_keeps_every_so_many_steps() -> None:
    whole, tenth = (simulate(quick(rate=rate), seed=2).trials[0] for rate in (1000.0, 100.0))
    assert tenth.n_samples == -(-whole.n_samples // 10)
    for name in ("time", "position", "force", "perturbation", "phase"):
        np.testing.assert_array_equal(getattr(tenth, name), getattr(whole, name)[::10])
    np.testing.assert_array_equal(tenth.truth["stiffness_xy"], whole.truth["stiffness_xy"][::10])


def test_trial_holds_its_repetitions_with_phase() -> None:
    trial = simulate(quick(repetitions=3), seed=0).trials[0]
    assert set(trial.repetition) == {0, 1, 2}
    starts = np.flatnonzero(np.diff(trial.repetition, prepend=-1))
    assert (trial.phase[starts] < 0.01).all()
    assert trial.time[0] == 0.0 and 5.0 < trial.time[-1] < 7.0


# --- seeds ---------------------------------------------------------------------------------------


def test_seed_decides_every_bit() -> None:
    experiment = quick()
    assert bits(simulate(experiment, seed=5)) == bits(simulate(experiment, seed=5))
    assert bits(simulate(experiment, seed=5)) != bits(simulate(experiment, seed=6))


def test_trials_of_a_seed_differ() -> None:
    first, second = simulate(quick(), seed=0).trials
    assert first.n_samples != second.n_samples
    assert (first.perturbation[:100] != second.perturbation[:100]).all()


def test_number_of_threads_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    experiment = quick(trials=5)
    fingerprints = set()
    for cores in (1, 2, 7):
        monkeypatch.setattr(os, "cpu_count", lambda cores=cores: cores)
        fingerprints.add(bits(simulate(experiment, seed=1)))
    assert len(fingerprints) == 1


PROGRAM = """
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.subjects import Subject
from bayes_impedance.simulation.tasks import Flower, Pace
print(simulate(Experiment([Subject("P", pace=Pace(9.0))], Flower(), 2), seed=1).fingerprint())
"""


def test_threads_of_linear_algebra_change_no_bit() -> None:
    printed = {
        subprocess.run(
            [sys.executable, "-c", PROGRAM],
            env=os.environ | {"OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads},
            check=True,
            capture_output=True,
        ).stdout
        for threads in ("1", "4")
    }
    assert len(printed) == 1


def test_first_trials_are_those_of_a_longer_experiment() -> None:
    short, long = simulate(quick(trials=2), seed=3), simulate(quick(trials=4), seed=3)
    assert bits(long.select([0, 1])) == bits(short)


@pytest.mark.parametrize("name", SUBJECTS)
def test_trials_of_a_subject_are_the_same_alone_and_among_others(name: str) -> None:
    everyone = simulate(quick(*SUBJECTS.values()), seed=4)
    alone = simulate(quick(SUBJECTS[name]), seed=4)
    assert bits(everyone.select(lambda trial: trial.group == name)) == bits(alone)


def test_progress_counts_trials() -> None:
    seen: list[int] = []
    simulate(quick(trials=3), seed=0, progress=seen.append)
    assert seen == [1, 2, 3]


# --- subjects ------------------------------------------------------------------------------------


def test_three_subjects_of_ten_repetitions_are_three_groups() -> None:
    log = simulate(Experiment(list(SUBJECTS.values()), Flower(), trials=1, repetitions=10, rate=50.0), seed=0)
    assert log.groups == ("A", "B", "C")
    assert [trial.name for trial in log.trials] == ["A-0", "B-0", "C-0"]
    assert all(len(np.unique(trial.repetition)) == 10 for trial in log.trials)


def test_subjects_differ_in_size_strength_pace_and_noise() -> None:
    a, b, c = (SUBJECTS[name] for name in "ABC")
    assert b.arm.lengths == Arm().lengths and b.arm.masses == Arm().masses
    for quantity in (
        lambda s: s.arm.lengths[0],
        lambda s: s.arm.masses[0],
        lambda s: s.arm.muscle_stiffness,
        lambda s: s.arm.noise,
        lambda s: s.arm.co_contraction,
        lambda s: 1.0 / s.pace.repetition,
        lambda s: s.pace.spread,
        lambda s: s.pace.unevenness,
    ):
        assert quantity(a) < quantity(b) < quantity(c)
    log = simulate(quick(a, b, c), seed=0)
    stiffness, mass = (
        [
            np.mean([trial.truth[f"{name}_xx"].mean() for trial in log.trials if trial.group == group])
            for group in "ABC"
        ]
        for name in ("muscle_stiffness", "mass")
    )
    assert stiffness == sorted(stiffness) and mass == sorted(mass)


def test_scaled_arm_keeps_its_proportions() -> None:
    arm, scaled = Arm(), scaled_arm(1.1, 1.3, noise=0.2)
    q = arm.posture(np.array([0.3, 0.3]))
    np.testing.assert_allclose(scaled.hand(q), 1.1 * arm.hand(q), rtol=1e-14)
    # Mass × length² throughout, and so the mass of the hand goes with mass alone.
    np.testing.assert_allclose(scaled.endpoint_mass(q), 1.3 * arm.endpoint_mass(q), rtol=1e-12)
    assert scaled.noise == 0.2 and scaled.muscle_stiffness == arm.muscle_stiffness


def test_subject_is_found_by_name_or_refused() -> None:
    assert find_subject("C") is SUBJECTS["C"]
    with pytest.raises(
        SimulationError, match="subject: expected one of A, B, C, got 'D'; choose one of them"
    ):
        find_subject("D")


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arrange", "sentence"),
    [
        (
            lambda: Experiment([], Flower()),
            "subjects: expected at least one, got none; name one or more",
        ),
        (
            lambda: Experiment([Subject("P"), Subject("Q"), Subject("P")], Flower()),
            "subjects: expected names that differ, got 'P' 2 times; rename them",
        ),
        (lambda: quick(trials=0), "trials: expected at least 1, got 0; ask for more"),
        (lambda: quick(repetitions=-1), "repetitions: expected at least 1, got -1; ask for more"),
        (lambda: quick(rate=0.0), "rate: expected a finite value > 0, got 0; choose one"),
        (lambda: quick(step=np.nan), "step: expected a finite value > 0, got nan; choose one"),
        (
            lambda: quick(rate=300.0),
            "rate: expected a whole number of steps of 0.001 s between samples, got 300 Hz; choose a divisor of 1000 "
            "Hz",
        ),
        (lambda: quick(rate=2000.0), "got 2000 Hz; choose a divisor of 1000 Hz"),
        (lambda: quick(rate=1e-320), "got 9.99989e-321 Hz; choose a divisor of 1000 Hz"),
        (
            lambda: quick(rate=0.5),
            "expected trials of at least two samples, got one of 2 s at 0.5 Hz; make duration or rate larger",
        ),
        (
            lambda: quick(repetitions=1000),
            "expected trials of at most 1000000 steps, got one of 2000 s in steps of 0.001 s; make duration or "
            "repetitions smaller",
        ),
        (
            lambda: quick(trials=10**12),
            "expected at most 10000000 samples in a log, got 4e+14; make trials or rate smaller, or simulate several "
            "logs",
        ),
    ],
)
def test_experiment_that_cannot_be_done_is_refused(arrange: Callable[[], Experiment], sentence: str) -> None:
    with pytest.raises(SimulationError) as caught:
        arrange()
    assert str(caught.value).endswith(sentence)


@pytest.mark.parametrize(
    "change",
    [
        {"perturbation": BandLimitedForce(300.0)},
        {"perturbation": ForcePulses(1e300)},
        {"perturbation": PositionDisplacement(0.5)},
        {"device": Admittance(1e300, 6.0)},
    ],
    ids=["force", "overflow", "displacement", "device"],
)
def test_hand_that_is_thrown_out_of_reach_is_refused_with_its_time(change: dict[str, object]) -> None:
    with pytest.raises(
        SimulationError,
        match=r"^trial P-0: expected the hand between 0\.023 and 0\.657 m from the shoulder, found it elsewhere at "
        r"\d\.\d{3} s; make perturbation, noise or reflex smaller, or the arm stiffer$",
    ):
        simulate(quick(**change), seed=0)


def test_trial_that_ends_before_its_second_sample_is_refused() -> None:
    hasty = replace(Subject("P"), pace=Pace(2.0, spread=0.49))
    experiment = Experiment([hasty], FigureEight(), 60, 1, rate=1.0)
    with pytest.raises(LogError, match="expected at least two samples"):
        simulate(experiment, seed=0)
