"""What a smoother passes and what it leaves of noise, against sinusoids and Monte Carlo."""

import numpy as np
import pytest

from bayes_impedance.config import Smoother
from bayes_impedance.errors import LogError
from bayes_impedance.log import InteractionLog
from bayes_impedance.preprocessing.bandwidth import (
    bandwidth,
    noise_covariance,
    sample_noise,
    smoother_effect,
)
from bayes_impedance.preprocessing.savitzky_golay import SavitzkyGolay

FILTERS = [SavitzkyGolay(11, 4, 0.01), SavitzkyGolay(51, 3, 0.005), SavitzkyGolay(7, 5, 0.02)]


@pytest.mark.parametrize("smooth", FILTERS)
@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_a_sinusoid_at_the_bandwidth_comes_out_by_the_root_of_a_half(smooth, derivative):
    """Amplitude of the filtered derivative of a sinusoid, fitted to the middle of a long record."""
    frequency = bandwidth(smooth, derivative)
    time = smooth.step * np.arange(4000)
    angle = 2 * np.pi * frequency * time
    filtered = smooth(np.sin(angle), derivative)[200:-200]
    basis = np.stack([np.sin(angle), np.cos(angle)], axis=1)[200:-200]
    amplitude = np.linalg.norm(np.linalg.lstsq(basis, filtered, rcond=None)[0])
    passed = amplitude / (2 * np.pi * frequency) ** derivative
    if frequency < 0.5 / smooth.step:
        assert passed == pytest.approx(np.sqrt(0.5), rel=1e-6)
    else:
        assert passed >= np.sqrt(0.5) - 1e-9


def test_a_longer_window_passes_less():
    short, long = SavitzkyGolay(11, 4, 0.01), SavitzkyGolay(21, 4, 0.01)
    for derivative in range(3):
        assert bandwidth(long, derivative) < bandwidth(short, derivative)


@pytest.mark.parametrize("smooth", FILTERS)
def test_covariance_of_motion_is_that_of_filtered_noise(smooth):
    noise = np.random.default_rng(0).normal(size=200_000)
    motion = np.stack([smooth(noise, order)[smooth.length :: smooth.length] for order in range(3)])
    expected = noise_covariance(smooth)
    scale = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    # Samples a window apart are independent: standard errors of 1/√n and less.
    assert np.abs((np.cov(motion) - expected) / scale).max() < 5 / np.sqrt(motion.shape[1])


def test_noise_of_the_samples_is_found_beside_the_motion():
    rng = np.random.default_rng(1)
    time = np.arange(20_000) / 200.0
    motion = np.stack([0.1 * np.sin(2 * time), 0.05 * np.cos(3 * time)], axis=1)
    deviation = np.array([1e-4, 3e-5])
    found = sample_noise(motion + deviation * rng.normal(size=motion.shape), SavitzkyGolay(21, 4, 0.005))
    np.testing.assert_allclose(found, deviation, rtol=0.05)


def test_force_from_noise_is_that_of_the_filtered_positions():
    rng = np.random.default_rng(2)
    time = np.arange(50_000) / 200.0
    still = 1e-4 * rng.normal(size=(len(time), 1))
    log = InteractionLog.from_arrays(time, still, np.sin(40 * time), axes=["x"])
    smoother = Smoother(window=0.1, polynomial_order=4)
    effect = smoother_effect(log.trials[0], smoother)
    smooth = SavitzkyGolay(21, 4, 0.005)
    weights = (200.0, 15.0, 1.5)
    force = sum(weight * smooth(still, order) for order, weight in enumerate(weights))
    assert effect.window == pytest.approx(0.105)
    np.testing.assert_allclose(effect.recorded_noise, 1e-4, rtol=0.05)
    np.testing.assert_allclose(effect.force_noise(*weights), force.std(), rtol=0.05)
    np.testing.assert_allclose(effect.noise[0], [smooth(still, order).std() for order in range(3)], rtol=0.05)
    # 6.4 Hz lies under the bandwidth, and hardly anything of it is removed.
    assert effect.bandwidth[0] > 6.4
    assert effect.removed is not None
    assert effect.removed[0] < 0.01


def test_without_force_nothing_of_it_is_removed():
    time = np.arange(100) / 100.0
    log = InteractionLog.from_arrays(time, np.sin(time), None, axes=["x"])
    assert smoother_effect(log.trials[0], Smoother()).removed is None
    with pytest.raises(LogError, match="one window of the smoother"):
        smoother_effect(log.trials[0], Smoother(window=5.0))
