"""What the Markov engine cannot hold, and what it says instead."""

from dataclasses import replace

import pytest
import torch

from bayes_impedance.engines.markov import MarkovEngine, arrangement, unsupported
from bayes_impedance.errors import ConfigurationError, NotPositiveDefiniteError
from bayes_impedance.kernels.stationary import StationaryKernel
from tests.engines.given import NO_RESIDUAL, OVER_PHASE, OVER_TIME, given_problem

OTHER = "model.desired_trajectory.kernel="
RESIDUAL = "model.residual.kernel="


def refused(problem, processes=None, features=None):
    """The sentence, which the automatic choice of an engine gets as a text."""
    features = features or problem.features
    processes = processes or problem.processes
    with pytest.raises(ConfigurationError) as caught:
        MarkovEngine(features, processes, True)
    assert unsupported(processes, features, True) == str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("overrides", [NO_RESIDUAL, OVER_PHASE, OVER_TIME])
def test_nothing_is_said_against_what_it_can_hold(overrides):
    problem = given_problem(overrides=overrides)
    assert unsupported(problem.processes, problem.features, coupled=True) is None


def test_trajectory_over_position():
    sentence = refused(given_problem("position"))
    assert "a desired trajectory over one number (time, phase) with markov, found one over 2" in sentence
    assert "engine.name=dense or lowrank" in sentence


def test_periodic_trajectory():
    problem = given_problem()
    sentence = refused(problem, replace(problem.processes, periodic=True))
    assert "a desired trajectory whose ends are free with markov" in sentence
    assert "engine.name=lowrank" in sentence


@pytest.mark.parametrize(
    ("kernel", "name"), [("squared_exponential", "SquaredExponential"), ("matern72", "nu = 3.5")]
)
def test_trajectory_of_another_kernel(kernel, name):
    sentence = refused(given_problem(overrides=(*NO_RESIDUAL, OTHER + kernel)))
    assert "the kernel matern52 of the desired trajectory with markov" in sentence
    assert name in sentence and "model.desired_trajectory.kernel=matern52" in sentence


def test_residual_without_a_state_space():
    sentence = refused(given_problem(overrides=(*OVER_PHASE, RESIDUAL + "squared_exponential")))
    assert "a residual force of the kernel matern12, matern32 or matern52 with markov" in sentence
    assert "model.residual.kernel=matern32" in sentence


def test_residual_over_several_inputs():
    sentence = refused(given_problem(overrides=(*OVER_PHASE, "model.residual.input=[position]")))
    assert "a residual force over one input (time or phase) with markov, found 2" in sentence


def test_residual_over_every_column():
    problem = given_problem()
    kernel = StationaryKernel("matern32", num_dims=problem.features.inputs.shape[-1]).double()
    assert "found every one" in refused(problem, replace(problem.processes, residual=(kernel,)))


def test_residual_over_time_where_trials_hold_several_repetitions():
    problem = given_problem(overrides=OVER_TIME, rate=60.0)
    inputs = problem.features.inputs.clone()
    inputs[..., problem.processes.layout.residual] = 0.0
    sentence = refused(problem, features=replace(problem.features, inputs=inputs))
    assert "a residual force whose input never goes back where theta increases with markov" in sentence
    assert "preprocessing.segmentation" in sentence


def test_one_residual_over_time_for_all_repetitions():
    sentence = refused(given_problem(overrides=(*OVER_TIME, "shared.residual=true"), rate=60.0))
    assert "found input" in sentence and "to go back by" in sentence


def test_more_states_than_it_may_hold(monkeypatch):
    monkeypatch.setattr(arrangement, "LARGEST_STATE", 16)
    sentence = refused(given_problem(overrides=OVER_TIME))
    assert "expected at most 16 states with markov, found 18" in sentence
    assert "a residual force of 3 trials beside 1 desired trajectories" in sentence


def test_targets_that_go_back_in_time():
    problem = given_problem(overrides=OVER_TIME)
    engine = MarkovEngine(problem.features, problem.processes, True)
    column = int(problem.processes.residual[0].active_dims[0])
    inputs = problem.features.inputs.clone()
    inputs[..., column] = -inputs[..., column]
    target = replace(problem.features, inputs=inputs)
    with pytest.raises(ConfigurationError, match="whose input never goes back where theta increases"):
        engine.posterior(problem.processes, problem.impedance, target, problem.impedance)


@pytest.mark.parametrize("noise", [-1.0, float("nan")])
def test_no_positive_variance(noise):
    problem = given_problem()
    engine = MarkovEngine(problem.features, problem.processes, True)
    processes = replace(problem.processes, noise_variance=torch.full((2, 1, 1), noise, dtype=torch.float64))
    with pytest.raises(
        NotPositiveDefiniteError, match="in the order of theta, given those before it, is not positive"
    ):
        engine.log_likelihood_given_impedance(processes, problem.impedance)
