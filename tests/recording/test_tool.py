"""The tool: what is recovered, how sure, and what is refused by name."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from bayes_impedance.errors import LogError
from bayes_impedance.recording.least_squares import fit, mean
from bayes_impedance.recording.tool import Tool, identify_tool, torque_without_tool, without_tool

TOOL = Tool(1.8, np.array([0.02, -0.01, 0.07]), np.array([2.0, -3.0, 4.0]), np.array([0.1, -0.05, 0.15]))
GRAVITY = np.array([0.0, 0.0, -9.81])


def turning(n: int = 1500, degrees: float = 40.0, axes: int = 3) -> Rotation:
    """Orientations that swing by ± `degrees` about some axes, from a sensor that points down."""
    phase = np.linspace(0.0, 6 * np.pi, n)[:, None] * np.array([1.0, 1.7, 0.6])
    angles = np.deg2rad(degrees) * np.sin(phase) * (np.arange(3) < axes)
    return Rotation.from_euler("x", np.pi) * Rotation.from_euler("XYZ", angles)


def sensed(rotation: Rotation, human=0.0, tool=TOOL, acceleration=None) -> tuple[np.ndarray, np.ndarray]:
    """Force and torque sample by sample; the human pulls at the origin of the sensor."""
    force, torque = [], []
    for t, matrix in enumerate(rotation.as_matrix()):
        a = np.zeros(3) if acceleration is None else acceleration[t]
        pull = tool.mass * matrix.T @ (GRAVITY - a)
        force.append(pull + tool.bias)
        torque.append(np.cross(tool.center_of_mass, pull) + tool.torque_bias)
    return np.array(force) + human, np.array(torque)


@pytest.mark.parametrize("seed", range(3))
def test_mass_centre_and_bias_are_recovered(seed):
    generator, rotation = np.random.default_rng(seed), turning()
    force, torque = sensed(rotation)
    force = force + 0.2 * generator.standard_normal(force.shape)
    torque = torque + 0.02 * generator.standard_normal(torque.shape)
    found = identify_tool(force, torque, rotation)
    assert found.tool.mass == pytest.approx(1.8, rel=0.01)
    np.testing.assert_allclose(found.tool.center_of_mass, TOOL.center_of_mass, rtol=0.1)
    np.testing.assert_allclose(found.tool.bias, TOOL.bias, rtol=0.03)
    np.testing.assert_allclose(found.tool.torque_bias, TOOL.torque_bias, rtol=0.1)
    assert found.force_rms == pytest.approx(0.2, rel=0.05)
    assert found.torque_rms == pytest.approx(0.02, rel=0.05)
    assert found.explained > 0.9
    assert "tool of 1.8" in found.sentence and "centre of mass (0.0" in found.sentence


def test_without_noise_everything_goes_round():
    rotation, generator = turning(), np.random.default_rng(0)
    acceleration = 3.0 * generator.standard_normal((len(rotation), 3))
    human = 10.0 * generator.standard_normal((len(rotation), 3))
    quiet, torque = sensed(rotation, acceleration=acceleration)
    found = identify_tool(quiet, torque, rotation, acceleration)
    assert found.tool.mass == pytest.approx(TOOL.mass, rel=1e-9)
    force, _ = sensed(rotation, human, acceleration=acceleration)
    np.testing.assert_allclose(without_tool(force, rotation, found.tool, acceleration), human, atol=1e-9)
    np.testing.assert_allclose(torque_without_tool(torque, rotation, found.tool, acceleration), 0, atol=1e-9)


def test_without_inertia_the_weight_alone_is_taken_off():
    rotation = turning(50)
    acceleration = np.tile([1.0, 2.0, 3.0], (50, 1))
    force, _ = sensed(rotation, acceleration=acceleration)
    left = rotation.apply(without_tool(force, rotation, TOOL))
    np.testing.assert_allclose(left, -1.8 * acceleration, atol=1e-12)


def test_gravity_may_point_elsewhere():
    sideways, rotation = np.array([9.81, 0.0, 0.0]), turning()
    force = 1.8 * rotation.inv().apply(np.tile(sideways, (len(rotation), 1))) + TOOL.bias
    assert identify_tool(force, None, rotation, gravity=sideways).tool.mass == pytest.approx(1.8, rel=1e-9)


def test_standard_errors_are_those_of_repeated_recordings():
    """Noise remembers: SD of the estimates over a hundred draws."""
    rotation, generator = turning(800), np.random.default_rng(5)
    force, torque = sensed(rotation)
    runs = []
    for _ in range(100):
        noise = lfilter([1.0], [1.0, -0.8], generator.standard_normal((800, 6)), axis=0)
        runs.append(identify_tool(force + 0.2 * noise[:, :3], torque + 0.02 * noise[:, 3:], rotation))
    for value, error in (
        (lambda run: run.tool.mass, lambda run: run.mass_error),
        (lambda run: run.tool.bias, lambda run: run.bias_error),
        (lambda run: run.tool.center_of_mass, lambda run: run.center_of_mass_error),
        (lambda run: run.tool.torque_bias, lambda run: run.torque_bias_error),
    ):
        spread = np.std([value(run) for run in runs], axis=0)
        # An SD of a hundred draws is uncertain by 7 %.
        np.testing.assert_allclose(np.mean([error(run) for run in runs], axis=0), spread, rtol=0.25)


def test_standard_error_of_a_mean_of_independent_values():
    values = np.random.default_rng(1).standard_normal(4000)
    assert mean(values)[0] == pytest.approx(values.mean())
    assert mean(values)[1] == pytest.approx(1 / np.sqrt(4000), rel=0.1)


def test_least_squares_is_that_of_numpy():
    generator = np.random.default_rng(2)
    design, target = generator.standard_normal((60, 2, 3)), generator.standard_normal((60, 2))
    expected = np.linalg.lstsq(design.reshape(120, 3), target.ravel(), rcond=None)[0]
    np.testing.assert_allclose(fit(design, target).coefficients, expected, rtol=1e-12)


# --- what cannot be told, and what is wrong ------------------------------------------------------


def test_reversed_sign_is_named():
    rotation = turning()
    force, _ = sensed(rotation)
    noise = 0.2 * np.random.default_rng(0).standard_normal(force.shape)
    with pytest.raises(
        LogError, match="found -1.8 .* kg: the force is probably of reversed sign; check log.force"
    ):
        identify_tool(noise - force, None, rotation)


@pytest.mark.parametrize("degrees", [0.0, 1.0])
def test_a_tool_that_does_not_turn_is_named(degrees):
    rotation = turning(degrees=degrees)
    force, _ = sensed(rotation)
    with pytest.raises(
        LogError, match="whose orientation hardly varies.*turn the tool about at least two axes"
    ):
        identify_tool(force, None, rotation)


def test_turning_about_the_vertical_tells_nothing():
    rotation = Rotation.from_euler("z", np.linspace(0.0, 6.0, 500)[:, None])
    with pytest.raises(LogError, match="so its mass and the bias of the sensor cannot be told apart"):
        identify_tool(sensed(rotation)[0], None, rotation)


def test_one_axis_tells_the_mass_but_not_the_centre():
    rotation = turning(degrees=10.0, axes=1)
    force, torque = sensed(rotation)
    found = identify_tool(force, torque, rotation)
    assert found.tool.mass == pytest.approx(1.8)
    assert found.tool.center_of_mass is None
    assert "centre of mass not determined" in found.sentence
    with pytest.raises(LogError, match="expected a centre of mass to take the weight off the torque"):
        torque_without_tool(torque, rotation, found.tool)


def test_a_few_samples_are_refused():
    rotation = turning(9)
    with pytest.raises(LogError, match="expected at least ten samples without contact, found 9"):
        identify_tool(sensed(rotation)[0], None, rotation)


def test_a_wrong_convention_explains_little():
    rotation = Rotation.from_euler("z", 1.2) * turning(degrees=60.0)
    force, _ = sensed(rotation)
    assert identify_tool(force, None, rotation).explained == pytest.approx(1.0)
    found = identify_tool(force, None, Rotation.from_euler("xyz", rotation.as_euler("XYZ")))
    assert found.explained < 0.5
    assert "check log.force.rotation" in found.sentence


def test_no_tool_at_all_is_a_bias():
    rotation, generator = turning(), np.random.default_rng(4)
    found = identify_tool(1.0 + 0.2 * generator.standard_normal((1500, 3)), None, rotation)
    assert abs(found.tool.mass) < 3 * found.mass_error
    np.testing.assert_allclose(found.tool.bias, 1.0, atol=0.2)
