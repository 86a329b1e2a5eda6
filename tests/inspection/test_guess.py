"""Names and units as people write them."""

import numpy as np
import pytest
import scipy.io

from bayes_impedance.inspection.guess import (
    guess_columns,
    guess_length_unit,
    guess_sampling_rate,
    guess_time_unit,
)

VECTOR = ("x", "y", "z")


def spelled(template: str) -> list[str]:
    return [template.replace("{axis}", a).replace("{index}", str(i)) for i, a in enumerate(VECTOR)]


@pytest.mark.parametrize(
    ("templates", "alone"),
    [
        (
            {"position": "position_{axis}", "force": "force_{axis}", "reference": "reference_{axis}"},
            {"time": "time"},
        ),
        ({"position": "{axis}", "velocity": "v{axis}", "force": "F{axis}"}, {"time": "t"}),
        (
            {"position": "{axis}", "force": "f_{axis}", "reference": "{axis}0", "velocity": "d{axis}"},
            {"time": "time"},
        ),
        ({"position": "pos[{index}]", "velocity": "vel[{index}]", "force": "F[{index}]"}, {}),
        (
            {
                "position": "/pose.pose.position.{axis}",
                "force": "/ft.wrench.force.{axis}",
                "torque": "/ft.wrench.torque.{axis}",
                "velocity": "/twist.twist.linear.{axis}",
            },
            {},
        ),
        (
            {
                "position": "/robot_state.position[{index}]",
                "velocity": "/robot_state.velocity[{index}]",
                "force": "/robot_state.effort[{index}]",
            },
            {},
        ),
        (
            {"position": "robot/Pos_{axis}", "force": "sensor/Force_{axis}"},
            {"time": "robot/Time", "trial": "Trial", "group": "subject", "phase": "phase"},
        ),
        ({"position": "X_pos".replace("X", "{axis}"), "perturbation": "pert_{axis}"}, {"repetition": "rep"}),
    ],
)
def test_names_that_people_write_are_understood(templates, alone):
    names = [name for template in templates.values() for name in spelled(template)] + list(alone.values())
    for order in (names, names[::-1]):
        assert guess_columns(order) == templates | alone


def test_a_name_that_says_nothing_is_left_out():
    assert guess_columns(["alpha", "beta", "gamma_q"]) == {}
    assert guess_columns([]) == {}


@pytest.mark.parametrize(("unit", "factor"), [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
@pytest.mark.parametrize("rate", [20.0, 200.0, 1000.0])
def test_unit_of_time(unit, factor, rate):
    assert guess_time_unit(factor * np.arange(50) / rate) == unit


def test_unit_of_length():
    path = 0.2 * np.sin(np.linspace(0, 6, 100))[:, None]
    assert guess_length_unit(path) == "m"
    assert guess_length_unit(1000 * path) == "mm"


def test_rate_from_positions_and_velocities():
    rng = np.random.default_rng(0)
    time = np.arange(5000) / 250.0
    position = np.stack([0.1 * np.sin(time), 0.2 * np.cos(2 * time)], axis=1)
    velocity = np.stack([0.1 * np.cos(time), -0.4 * np.sin(2 * time)], axis=1)
    noisy = velocity + 0.05 * rng.normal(size=velocity.shape)
    assert guess_sampling_rate(position, noisy) == pytest.approx(250.0, rel=0.01)
    assert guess_sampling_rate(position, rng.normal(size=velocity.shape)) is None
    assert guess_sampling_rate(position, 0 * velocity) is None


def test_rate_of_a_recording_without_time(shared_data):
    """Its README says 1 kHz; its velocities say that six recordings have one rate, and that it is another."""
    data = scipy.io.loadmat(shared_data / "panda_comanipulation" / "symbol_17_data.mat")["symbol_data"]
    rates = [
        guess_sampling_rate(repetition["pos"][:2].T, repetition["vel"][:2].T) for repetition in data.ravel()
    ]
    np.testing.assert_allclose(rates, np.mean(rates), rtol=0.02)
    assert np.mean(rates) == pytest.approx(695, rel=0.02)
