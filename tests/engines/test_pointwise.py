"""One-point prediction equals the dense posterior, for every profile and input of the desired trajectory."""

import numpy as np
import pytest
import torch

from bayes_impedance.config import parse_config
from bayes_impedance.engines.dense import Observations
from bayes_impedance.engines.pointwise import PointPredictor
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import FeatureMap
from bayes_impedance.kernels import (
    ImpedanceKernel,
    ImpedanceProcess,
    InputLayout,
    InteractionKernel,
    StationaryKernel,
)
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from bayes_impedance.trajectory_mean import TrajectoryMean


def configuration(theta, profile, **model):
    mean = "equilibrium" if theta.startswith("position") else "reference"
    return parse_config(
        {
            "model": {
                "trajectory_input": theta,
                "desired_trajectory": {"mean": mean, "kernel": profile},
                # Fixed levels: the dense posterior then has no uncertainty of theirs to add.
                "stiffness": {"level": 150, "input": ["position"]},
                "damping": {"level": 12, "input": ["position", "velocity"]},
                "mass": {"level": 1.2},
                "residual": {"input": ["position", "velocity"], "offset_sd": 0.5},
                **model,
            },
            "training": {"restarts": 1, "max_iterations": 1},
        }
    )


@pytest.mark.parametrize("theta", ["time", "phase", "position", "position_velocity"])
@pytest.mark.parametrize("profile", ["squared_exponential", "rational_quadratic", "matern52", "matern72"])
def test_equals_the_dense_posterior(theta, profile):
    config = configuration(theta, profile)
    log = draw_force(config, repeated_motion(2, duration=1.0, rate=10.0), seed=1)
    model = ImpedanceModel(config).fit(log)
    expected = model.posterior(log, given="training")["force"]
    feature_map = FeatureMap(config, log.axes)
    features = feature_map(log, TrajectoryMean.from_training(config.model.desired_trajectory, log))
    for a, axis in enumerate(log.axes):
        predictor = model.point_predictor(axis, "0")
        for row in (0, 7, 15):
            mean, variance = predictor.predict(features.inputs[a, 0, row].numpy())
            assert mean == pytest.approx(expected.mean[row, a], rel=1e-8, abs=1e-8)
            assert np.sqrt(variance) == pytest.approx(expected.sd[row, a], rel=1e-6)


def test_unknown_axis_or_group_is_named():
    config = configuration("time", "squared_exponential")
    log = draw_force(config, repeated_motion(1, duration=2.0, rate=10.0), seed=1)
    model = ImpedanceModel(config).fit(log)
    with pytest.raises(ConfigurationError, match="axis among x, y and a group among 0, got axis 'z'"):
        model.point_predictor("z", "0")


def test_other_covariances_are_refused():
    import gpytorch

    layout = InputLayout((0,), (1,))
    process = ImpedanceProcess(gpytorch.kernels.ConstantKernel(), law="gaussian")
    kernel = InteractionKernel(
        ImpedanceKernel(layout, StationaryKernel(), process, process, process)
    ).double()
    x = torch.linspace(0, 1, 5, dtype=torch.float64).unsqueeze(-1).repeat(1, 2)
    with pytest.raises(TypeError, match="expected covariances of class StationaryKernel, got ConstantKernel"):
        PointPredictor(kernel, Observations(x, x[:, 0], torch.ones(1, dtype=torch.float64)))
