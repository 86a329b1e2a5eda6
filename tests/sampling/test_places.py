"""Where draws are kept: the average motion of each group at equal phase, else samples of each trial."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_cases import CASES, PLACES, config_of, joined, motions

from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.preprocessing.prepared import ARRAYS
from bayes_impedance.sampling import places as module
from bayes_impedance.sampling.places import average_motion, choose_places, common_phase
from bayes_impedance.simulation.generative import repeated_motion

DIMENSIONS = {
    "groups": "phase",
    "inside one trial": "phase",
    "time": "time",
    "times": "place",
    "position": "place",
    "own trajectories": "place",
}


def cut(trial, low, high):
    """Samples of a trial from one phase to another."""
    rows = np.flatnonzero((trial.phase >= low) & (trial.phase <= high))
    arrays = {name: getattr(trial, name) for name in ARRAYS}
    return replace(trial, **{name: None if v is None else v[rows] for name, v in arrays.items()})


@pytest.mark.parametrize("case", CASES)
def test_layout_follows_the_desired_trajectory(case):
    log = motions(case)
    chosen = choose_places(config_of(case), log, PLACES)
    assert chosen.dimension == DIMENSIONS[case]
    lengths = {len(chosen.log.trials), len(chosen.samples), len(chosen.places), len(chosen.forces)}
    assert len(lengths) == 1
    averages = len(log.groups) if chosen.dimension == "phase" else 0
    assert chosen.log.trials[averages:] == log.trials and chosen.log.groups == log.groups
    names = [trial.name for trial in chosen.log.trials]
    assert len(set(names)) == len(names)
    for trial, samples, kept, forces in zip(
        chosen.log.trials, chosen.samples, chosen.places, chosen.forces, strict=True
    ):
        assert (np.diff(samples) > 0).all() and set(kept) | set(forces) == set(samples)
        is_average = trial.name == f"average motion of {trial.group}"
        np.testing.assert_array_equal(forces, np.arange(0 if is_average else trial.n_samples))
        if is_average or not averages:
            assert len(kept) == min(PLACES, trial.n_samples) and (kept[0], kept[-1]) == (0, trial.n_samples - 1)
        else:
            assert len(kept) == 0


def test_average_motion_is_the_mean_over_repetitions_at_equal_phase():
    log = motions("groups")
    low, high = common_phase(log)
    assert (low, high) == (
        max(trial.phase.min() for trial in log.trials),
        min(trial.phase.max() for trial in log.trials),
    )
    phase = np.linspace(low, high, 7)
    for group in log.groups:
        average = average_motion(log, group, phase)
        own = [trial for trial in log.trials if trial.group == group]
        np.testing.assert_array_equal(average.phase, phase)
        assert average.group == group and average.force is None and average.perturbation is None
        for name in ("position", "velocity", "acceleration", "reference_velocity"):
            expected = np.zeros((7, 2))
            for trial in own:
                for i, at in enumerate(phase):
                    for a in range(2):
                        expected[i, a] += np.interp(at, trial.phase, getattr(trial, name)[:, a]) / len(own)
            np.testing.assert_allclose(getattr(average, name), expected, atol=1e-12)
        rates = [np.interp(phase, trial.phase, trial.phase_velocity) for trial in own]
        np.testing.assert_allclose(average.phase_velocity, np.mean(rates, axis=0), rtol=1e-12)


def test_repetitions_inside_one_trial_are_those_of_as_many_trials():
    log = repeated_motion(3, 2.0, 8.0, axes=("x", "y"), seed=1)
    inside = joined(log)
    assert common_phase(inside) == common_phase(log)
    phase = np.linspace(*common_phase(log), 6)
    one, other = average_motion(inside, "g", phase), average_motion(log, "0", phase)
    for name in ("position", "velocity", "acceleration", "jerk", "phase_acceleration"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-12)


def test_what_was_broken_off_does_not_shorten_the_phase():
    log = repeated_motion(3, 2.0, 20.0, axes=("x",), seed=1)
    broken = [replace(cut(log.trials[0], 0.0, 0.3), name="early"), replace(cut(log.trials[1], 0.6, 1.0), name="late")]
    more = PreparedLog(log.axes, (*log.trials, *broken))
    assert common_phase(more) == common_phase(log)
    phase = np.linspace(*common_phase(log), 6)
    np.testing.assert_array_equal(
        average_motion(more, "0", phase).position, average_motion(log, "0", phase).position
    )
    # And a missing reference is none of the average.
    lacking = PreparedLog(log.axes, (*log.trials[:2], replace(log.trials[2], reference=None)))
    assert average_motion(lacking, "0", phase).reference is None


def test_phase_that_goes_back_for_a_sample_is_put_in_order():
    log = repeated_motion(2, 2.0, 20.0, axes=("x",), seed=1)
    swapped = np.arange(40)
    swapped[[10, 11]] = 11, 10
    arrays = {name: getattr(log.trials[0], name) for name in ARRAYS}
    trial = replace(log.trials[0], **{k: None if v is None else v[swapped] for k, v in arrays.items()})
    phase = np.linspace(*common_phase(log), 30)
    one = average_motion(PreparedLog(log.axes, (trial, log.trials[1])), "0", phase)
    np.testing.assert_allclose(one.position, average_motion(log, "0", phase).position, rtol=1e-12)


def test_groups_without_a_phase_in_common_are_kept_by_trial():
    log = repeated_motion(2, 2.0, 20.0, axes=("x",), seed=1)
    apart = (cut(log.trials[0], 0.0, 0.4), replace(cut(log.trials[1], 0.6, 1.0), group="other"))
    chosen = choose_places(config_of("groups"), PreparedLog(log.axes, apart), 5)
    assert chosen.dimension == "place" and [len(kept) for kept in chosen.places] == [5, 5]


@pytest.mark.parametrize(("most", "step"), [(56, 1), (55, 2), (20, 3)])
def test_forces_of_long_logs_are_thinned(monkeypatch, most, step):
    monkeypatch.setattr(module, "MOST_SAMPLES", most)
    log = repeated_motion(2, 2.0, 14.0, axes=("x",))
    assert log.n_samples == 56
    for case in ("groups", "times"):
        chosen = choose_places(config_of(case), log, 5)
        for trial, samples, kept, forces in zip(
            chosen.log.trials, chosen.samples, chosen.places, chosen.forces, strict=True
        ):
            if "average" not in trial.name:
                np.testing.assert_array_equal(forces, np.arange(0, 28, step))
                np.testing.assert_array_equal(samples, np.union1d(kept, forces))
