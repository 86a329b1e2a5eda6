"""Forces drawn from the exact model have the mean and the covariance of the engines given impedance."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bayes_impedance.calibration.problem import Problem
from bayes_impedance.config import Config, parse_config
from bayes_impedance.engines.choice import build_engine
from bayes_impedance.engines.given_impedance import mean_force
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import Features
from bayes_impedance.impedance_functions.density import log_jacobian
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.simulation.generative import repeated_motion
from bayes_impedance.simulation.interaction import device_answer
from bayes_impedance.simulation.prior_predictive import check_loop, force_model_at

RESIDUAL = {"sd": {"median": 0.5, "log_sd": 0.5}, "input": ["position"], "offset_sd": 0.4}
#: By axis, so that mixed up axes show.
DEVICE = {"mass": {"x": 1.5, "y": 3.0}, "damping": {"x": 4.0, "y": 8.0}}


def configuration(engine: str = "dense", device: dict | None = None, **model: object) -> Config:
    defaults = {
        "trajectory_input": "phase",
        "desired_trajectory": {"mean": "reference", "sd": {"median": 0.02, "log_sd": 0.5}},
        "stiffness": {
            "level": {"median": 150, "log_sd": 0.4},
            "log_sd": {"median": 0.3, "log_sd": 0.3},
            "input": ["phase"],
        },
        "damping": {"level": {"median": 10, "log_sd": 0.4}, "log_sd": 0.2, "input": ["position"]},
        "mass": {"level": {"median": 1.5, "log_sd": 0.4}, "sd": 0.2},
        "residual": RESIDUAL,
        "noise_sd": {"median": 0.3, "log_sd": 0.5},
    }
    engine_section = {"impedance": "map", "name": engine, "inducing": 4}
    return parse_config({"model": defaults | model, "engine": engine_section, "device": device})


CONFIGURATIONS = {
    "phase": configuration(),
    "coupled": configuration(axes="coupled"),
    "time": configuration(
        trajectory_input="time",
        desired_trajectory={"mean": "constant", "kernel": "matern52", "sd": {"median": 0.02, "log_sd": 0.5}},
    ),
    "answered": configuration(device=DEVICE),
    "answered, coupled": configuration(device=DEVICE, axes="coupled"),
    "periodic": configuration(
        engine="lowrank",
        residual=None,
        desired_trajectory={"mean": "reference", "sd": 0.02, "periodic": True},
    ),
}


def motion() -> PreparedLog:
    """Two groups of unequal length, so that one is padded."""
    long = repeated_motion(2, 1.0, 5.0, seed=1, group="a")
    short = repeated_motion(1, 1.0, 6.0, seed=2, group="b")
    return PreparedLog(long.axes, (*long.trials, *short.trials))


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_forces_scatter_as_the_likelihood_says(name: str) -> None:
    # 2 (log p at the mean − log p) ~ χ² with as many degrees of freedom as there are forces.
    config = CONFIGURATIONS[name]
    problem, draws = Problem(config, motion()), 50
    point = 0.7 * np.random.default_rng(3).standard_normal(problem.prior.size)
    with torch.no_grad():
        values = problem.prior.values(torch.from_numpy(point))
        impedance, processes = problem.prior.impedance(values), problem.prior.processes(values)

        def likelihood(features: Features) -> float:
            engine = build_engine(
                config.engine.name, config.engine, processes, features, problem.prior.coupled
            )
            return float(engine.log_likelihood_given_impedance(processes, impedance).sum())

        features = problem.prior.features
        at_mean = likelihood(replace(features, force=mean_force(processes.layout, features, impedance)))
        logs = [problem.draw(point, seed) for seed in range(draws)]
        found = [2.0 * (at_mean - likelihood(problem.features(log))) for log in logs]
    forces = 2 * motion().n_samples
    assert np.mean(found) == pytest.approx(forces, abs=4.0 * np.sqrt(2.0 * forces / draws))
    assert np.var(found) == pytest.approx(2.0 * forces, rel=5.0 * np.sqrt((2.0 + 12.0 / forces) / draws))


@pytest.mark.parametrize("name", ["phase", "coupled"])
def test_moments_are_those_of_the_dense_engine(name: str) -> None:
    problem, draws = Problem(CONFIGURATIONS[name], motion().select([0, 1])), 120
    point = 0.7 * np.random.default_rng(4).standard_normal(problem.prior.size)
    with torch.no_grad():
        values = problem.prior.values(torch.from_numpy(point))
        impedance, processes = problem.prior.impedance(values), problem.prior.processes(values)
        cholesky, _ = problem.prior.engine._factor(processes, impedance)
        middle = mean_force(processes.layout, problem.prior.features, impedance)
        white = []
        for seed in range(draws):
            force = problem.features(problem.draw(point, seed)).force
            deviation = problem.prior.engine._rows(force - middle).unsqueeze(-1)
            white.append(torch.linalg.solve_triangular(cholesky, deviation, upper=False).reshape(-1))
    white = torch.stack(white)
    n = white.shape[1]
    # Standard errors 1/√draws, √2/√draws on the diagonal; 4.5 of them for some hundred entries.
    assert white.mean(0).abs().max() < 4.5 / np.sqrt(draws)
    assert (white.T @ white / draws - torch.eye(n)).abs().max() < 4.5 * np.sqrt(2.0 / draws)


@pytest.mark.parametrize("name", ["answered", "answered, coupled"])
def test_the_device_answers_as_the_jacobian_presumes(name: str) -> None:
    config = CONFIGURATIONS[name]
    problem = Problem(config, motion())
    point = 0.5 * np.random.default_rng(5).standard_normal(problem.prior.size)
    log = problem.draw(point, seed=0)
    masses, dampings = (np.array([DEVICE[key][axis] for axis in "xy"]) for key in ("mass", "damping"))
    for before, after in zip(motion().trials, log.trials, strict=True):
        step = 0.2 if before.group == "a" else 1.0 / 6.0
        kick = 0.5 * step * after.force / masses
        np.testing.assert_allclose(after.velocity, before.velocity + kick, rtol=0, atol=1e-12)
        push = (after.force - dampings * kick) / masses
        np.testing.assert_allclose(after.acceleration, before.acceleration + push, rtol=0, atol=1e-11)
        np.testing.assert_array_equal(after.position, before.position)
    with torch.no_grad():
        impedance = problem.prior.impedance(problem.prior.values(torch.from_numpy(point)))
        loop = problem.prior.features.loop
        claimed = log_jacobian(loop, impedance, problem.prior.features.valid, problem.prior.coupled).sum()
    total = 0.0
    for g in range(2):
        answer = device_answer(loop, g)
        for n in range(len(problem.prior.features.rows[g])):
            # y(u) = u − Σ_j W_j e⁽ʲ⁾(u), and e moves against the hand.
            matrix = np.eye(2) + np.einsum("jac,cj->ac", impedance[g, n].numpy(), answer)
            if not problem.prior.coupled:
                matrix = np.diag(np.diag(matrix))
            total += np.linalg.slogdet(matrix)[1]
    assert float(claimed) == pytest.approx(total, rel=1e-12)


def test_hyperparameters_reach_the_modules() -> None:
    problem = Problem(CONFIGURATIONS["phase"], motion())
    values = problem.prior.values(torch.linspace(-1.0, 1.0, problem.prior.size, dtype=torch.float64))
    model = force_model_at(problem.config, ("x", "y"), values)
    entries = {entry.name: entry for entry in model.entries}
    for name in ("noise_sd", "residual.sd", "desired_trajectory.sd"):
        got = entries[name].value[:, 0, 0]
        torch.testing.assert_close(got.detach(), values[name.replace(".", "_")], rtol=1e-12, atol=0)
    # What is fixed stays.
    assert entries["residual.offset_sd"].value.flatten().tolist() == pytest.approx([0.4, 0.4])


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"trajectory_input": "position"}, "trajectory_input: position, which the force"),
        ({"residual": {"sd": 0.5, "input": ["velocity"]}}, "found velocity as an input, which the force"),
    ],
)
def test_a_device_may_not_move_what_the_model_depends_on(change: dict, found: str) -> None:
    with pytest.raises(
        ConfigurationError, match="device: expected a model of time, phase or place alone"
    ) as error:
        check_loop(configuration(device=DEVICE, **change), ("x", "y"))
    assert found in str(error.value)
    check_loop(configuration(**change), ("x", "y"))
