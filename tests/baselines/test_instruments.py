"""Motion that a perturbation causes on its own, beside a differential equation solved step by step."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bayes_impedance.baselines.instruments import perturbed_motion, perturbs_every_axis
from bayes_impedance.config import load_config
from bayes_impedance.simulation.generative import repeated_motion

TIME = np.arange(0, 3, 0.04)
PERTURBATION = np.stack([np.sin(3 * TIME), 2 * np.cos(5 * TIME) * TIME], axis=1)


@pytest.fixture
def trial():
    motion = repeated_motion(repetitions=1, duration=3.0, rate=25.0).trials[0]
    return replace(motion, time=TIME + 7.0, perturbation=PERTURBATION)


@pytest.mark.parametrize(
    ("device", "mass", "damping"),
    [
        ("null", (1.5, 1.5), (20.0, 20.0)),
        ("{mass: {x: 2, y: 3}, damping: 6}", (3.5, 4.5), (26.0, 26.0)),
        ("{mass: 2}", (3.5, 3.5), (20.0, 20.0)),
    ],
)
def test_motion_solves_the_equation_of_device_and_nominal_arm(trial, device, mass, damping):
    found = perturbed_motion(trial, ("x", "y"), load_config("phase", [f"device={device}"]))
    for a in range(2):

        def law(t, state, a=a):
            p = np.interp(t, TIME, PERTURBATION[:, a])
            return [state[1], (p - damping[a] * state[1] - 300.0 * state[0]) / mass[a]]

        solved = solve_ivp(law, (0, TIME[-1]), [0, 0], t_eval=TIME, rtol=1e-9, atol=1e-12, max_step=0.01).y
        acceleration = [law(t, state)[1] for t, state in zip(TIME, solved.T, strict=True)]
        expected = np.column_stack([*solved, acceleration])
        np.testing.assert_allclose(found[:, a], expected, atol=1e-6 * np.abs(expected).max())


def test_force_and_motion_have_no_part(trial):
    config = load_config("phase")
    other = replace(trial, position=-trial.position, force=np.ones_like(PERTURBATION))
    np.testing.assert_array_equal(*(perturbed_motion(t, ("x", "y"), config) for t in (trial, other)))


def test_uneven_samples_are_the_same_motion(trial):
    config = load_config("phase")
    kept = np.sort(np.random.default_rng(0).permutation(TIME.size)[:60])
    kept = np.union1d(kept, [0, TIME.size - 1])
    smooth = np.stack([np.sin(2 * TIME), np.cos(TIME) - 1], axis=1)
    even = perturbed_motion(replace(trial, perturbation=smooth), ("x", "y"), config)[kept]
    arrays = {
        name: value[kept] for name in trial.__slots__ if isinstance(value := getattr(trial, name), np.ndarray)
    }
    uneven = replace(trial, **arrays | {"perturbation": smooth[kept]})
    found = perturbed_motion(uneven, ("x", "y"), config)
    np.testing.assert_allclose(found[..., 0], even[..., 0], atol=0.05 * np.abs(even[..., 0]).max())


def test_a_single_sample_rests(trial):
    arrays = {
        name: value[:1] for name in trial.__slots__ if isinstance(value := getattr(trial, name), np.ndarray)
    }
    assert not perturbed_motion(replace(trial, **arrays), ("x", "y"), load_config("phase")).any()


def test_every_trial_has_to_record_and_every_axis_to_be_perturbed(trial):
    still, silent = PERTURBATION * [1.0, 0.0], replace(trial, perturbation=None)
    half = replace(trial, perturbation=still)
    assert perturbs_every_axis([trial, half])
    assert not perturbs_every_axis([half, half])
    assert not perturbs_every_axis([trial, silent])
