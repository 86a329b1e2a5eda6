"""Virtual mass and damping of a robot: recovered where they are known, plausible where they are not."""

from dataclasses import replace

import numpy as np
import pytest
from real_recordings import read_bag
from scipy.signal import lfilter

from bayes_impedance.errors import LogError
from bayes_impedance.recording.device_law import fit_device_law
from bayes_impedance.recording.plausibility import Sign
from bayes_impedance.simulation.device import Admittance, BandLimitedForce, ForcePulses, Unperturbed
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.subjects import Subject
from bayes_impedance.simulation.tasks import FigureEight, Pace

PERSON = Subject("P", pace=Pace(6.0))


def guided(n=4000, step=0.005, noise=0.0, seed=0):
    """Time, position, velocity, force of a robot of 3 kg, 20 Ns/m along x and 5 kg, 40 Ns/m along y."""
    generator, time = np.random.default_rng(seed), step * np.arange(n)
    mass, damping = np.array([3.0, 5.0]), np.array([20.0, 40.0])
    rates, shifts = np.array([1.0, 2.3, 5.1]), generator.uniform(0, 6, (2, 3))
    angle = time[:, None, None] * rates + shifts
    position = 0.1 * np.sin(angle).sum(axis=2)
    velocity = 0.1 * (rates * np.cos(angle)).sum(axis=2)
    acceleration = -0.1 * (rates**2 * np.sin(angle)).sum(axis=2)
    coloured = lfilter([1.0], [1.0, -0.95], generator.standard_normal((n, 2)), axis=0)
    return time, position, velocity, mass * acceleration + damping * velocity + noise * coloured


@pytest.mark.parametrize("recorded", ["velocity", "position"])
def test_a_law_without_noise_is_recovered(recorded):
    time, position, velocity, force = guided()
    law = (
        fit_device_law(time, velocity, force)
        if recorded == "velocity"
        else fit_device_law(time, None, force, position=position)
    )
    np.testing.assert_allclose(law.mass, [3.0, 5.0], rtol=2e-3)
    np.testing.assert_allclose(law.damping, [20.0, 40.0], rtol=2e-3)
    assert law.mass_determined.all() and law.pooled > 0.99999 and law.sign is Sign.EXPECTED
    assert law.sentence(1, "y").startswith("y: the robot follows mass 5 ±")


def test_shares_are_pooled_over_axes():
    time, _, velocity, force = guided(noise=0.5)
    force[:, 1] = 0.1 * np.random.default_rng(1).standard_normal(len(time)).cumsum()
    law = fit_device_law(time, velocity, force)
    one, other = (fit_device_law(time, velocity[:, [k]], force[:, [k]]) for k in (0, 1))
    np.testing.assert_allclose(law.r_squared, [one.pooled, other.pooled])
    assert min(law.r_squared) < law.pooled < max(law.r_squared)


def test_standard_errors_are_those_of_repeated_recordings():
    laws = []
    for seed in range(100):
        time, _, velocity, force = guided(n=2000, seed=0)
        coloured = lfilter(
            [1.0], [1.0, -0.9], np.random.default_rng(seed).standard_normal(force.shape), axis=0
        )
        laws.append(fit_device_law(time, velocity, force + 0.3 * coloured))
    for name in ("mass", "damping"):
        spread = np.std([getattr(law, name) for law in laws], axis=0)
        error = np.mean([getattr(law, f"{name}_error") for law in laws], axis=0)
        # An SD of a hundred draws is uncertain by 7 %; the sandwich is known to be somewhat short.
        np.testing.assert_allclose(error, spread, rtol=0.35)


def test_reversed_force_has_the_damping_of_a_robot_that_drives_itself():
    time, _, velocity, force = guided(noise=0.2)
    assert fit_device_law(time, velocity, -force).sign is Sign.REVERSED


def test_mass_is_not_determined_where_nothing_accelerates():
    generator, time = np.random.default_rng(3), 0.01 * np.arange(3000)
    velocity = (0.05 + 0.02 * np.sin(0.2 * time))[:, None]
    force = 50.0 * velocity + lfilter([1.0], [1.0, -0.9], 0.1 * generator.standard_normal((3000, 1)), axis=0)
    law = fit_device_law(time, velocity, force)
    assert law.damping[0] == pytest.approx(50.0, rel=0.05)
    assert not law.mass_determined[0]
    assert "a mass that the motion does not determine" in law.sentence(0, "x")


def test_a_gap_is_left_out():
    time, _, velocity, force = guided()
    gone = (time > 8.0) & (time < 9.0)
    law = fit_device_law(time[~gone], velocity[~gone], force[~gone])
    np.testing.assert_allclose(law.mass, [3.0, 5.0], rtol=2e-3)


def test_a_short_recording_is_refused():
    time, _, velocity, force = guided(n=100)
    with pytest.raises(LogError, match=r"expected a recording of at least three windows of 0\.3 s"):
        fit_device_law(time, velocity, force)


@pytest.mark.parametrize("perturbation", [Unperturbed(), BandLimitedForce(2.0), ForcePulses(5.0)])
@pytest.mark.parametrize("device", [Admittance(), Admittance(5.0, 30.0)])
def test_the_device_of_a_simulated_recording_is_recovered(perturbation, device):
    experiment = Experiment(
        [PERSON], FigureEight(), trials=1, repetitions=2, perturbation=perturbation, device=device
    )
    (trial,) = simulate(experiment, seed=2).trials
    law = fit_device_law(trial.time, None, trial.force, trial.perturbation, position=trial.position)
    # Ten per cent is asked for; with a noise of .05 N one is enough.
    np.testing.assert_allclose(law.mass, device.mass, rtol=0.02)
    np.testing.assert_allclose(law.damping, device.damping, rtol=0.02)
    assert law.mass_determined.all() and law.sign is Sign.EXPECTED
    reversed_ = fit_device_law(trial.time, None, -trial.force, trial.perturbation, position=trial.position)
    assert reversed_.sign is not Sign.EXPECTED


def test_the_perturbation_belongs_to_the_law():
    experiment = Experiment([PERSON], FigureEight(), trials=1, perturbation=BandLimitedForce(2.0))
    (trial,) = simulate(replace(experiment, repetitions=2), seed=2).trials
    without = fit_device_law(trial.time, None, trial.force, position=trial.position)
    assert without.pooled < 0.9 or np.abs(without.mass / 2.0 - 1.0).max() > 0.1


@pytest.mark.parametrize("run", ["1", "2", "3"])
def test_a_real_admittance_follows_its_law(shared_data, run):
    """Pooled over axes; an axis that hardly moves has little to explain."""
    pytest.importorskip("rosbags")
    recording = read_bag(shared_data / "gp_mpc" / "rail" / f"{run}.bag")
    law = fit_device_law(recording.time, recording.velocity, recording.force)
    assert law.pooled >= 0.75
    assert law.sign is Sign.EXPECTED
    assert (law.damping > 100).all()
    # The sign of the wrench and its frame are those of the data's README.
    assert fit_device_law(recording.time, recording.velocity, -recording.force).sign is Sign.REVERSED
    unturned = fit_device_law(recording.time, recording.velocity, -recording.sensed)
    assert unturned.pooled < law.pooled and unturned.sign is not Sign.EXPECTED
