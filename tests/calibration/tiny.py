"""Problems of a few coordinates, and stand-ins for samplers that take milliseconds."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import torch
from scipy.optimize import minimize

from bayes_impedance.calibration.draw import Settings
from bayes_impedance.config import Config, parse_config
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.sampling.draws import Draws
from bayes_impedance.simulation.generative import repeated_motion

LEARNED = {"median": 0.03, "log_sd": 0.7}


def configuration(sampling: dict[str, object] | None = None, **sections: object) -> Config:
    """Constant stiffness, damping and mass, noise, and the SD of x_d about a reference: five coordinates."""
    model = {
        "trajectory_input": "phase",
        "desired_trajectory": {
            "mean": "reference",
            "kernel": "squared_exponential",
            "sd": LEARNED,
            "length_scale": {"phase": 0.2},
        },
        "stiffness": {"level": {"median": 150, "log_sd": 0.5}, "log_sd": 1e-3},
        "damping": {"level": {"median": 10, "log_sd": 0.5}, "log_sd": 1e-3},
        "mass": {"level": {"median": 1.5, "log_sd": 0.5}, "sd": 1e-3},
        "residual": None,
        "noise_sd": {"median": 0.3, "log_sd": 0.5},
    }
    content = {
        "model": model | sections.pop("model", {}),
        "engine": {"impedance": "map", "name": "dense", "inducing": 3},
        "training": {"max_iterations": 30, "gradient_tolerance": 0.1},
        "sampling": {"method": "laplace", "chains": 1, "draws": 300} | (sampling or {}),
    }
    return parse_config(content | sections)


def importance(density, config):
    """Draws from a Gaussian about the mode, as wide as the curvature there says and half more, by their importance."""
    generator = np.random.default_rng(config.sampling.seed)
    count, wide = 1500, 1.5
    found = minimize(lambda z: [-part for part in density.joint(z)], np.zeros(density.size), jac=True)
    values, vectors = np.linalg.eigh(curvature(density, found.x))
    steps = generator.standard_normal((count, density.size))
    points = found.x + wide * (steps / np.sqrt(np.maximum(values, 1.0))) @ vectors.T
    log = at_once(density.log_density, points).numpy()
    ratio = log + 0.5 * (steps**2).sum(1)
    weights = np.exp(ratio - ratio.max())
    kept = generator.choice(count, config.sampling.draws, p=weights / weights.sum())
    return Draws("laplace", points[kept][None], {"lp": log[kept][None]}, pareto_k=0.0)


def curvature(density, point: np.ndarray) -> np.ndarray:
    """Of the negative log density, from central differences of it."""
    step, unit = 1e-3, np.eye(len(point))
    pairs = [(i, j) for i in range(len(point)) for j in range(len(point))]
    corners = [point + step * (s * unit[i] + t * unit[j]) for i, j in pairs for s in (1, -1) for t in (1, -1)]
    values = at_once(density.log_density, np.array(corners)).numpy().reshape(-1, 4)
    second = (values @ np.array([1.0, -1.0, -1.0, 1.0])) / (4.0 * step**2)
    return -second.reshape(len(point), len(point))


def marginal_latents(density, standard, target, seed):
    """Desired positions from their marginals; impedance is a constant."""

    def moments(point):
        values = density.values(point)
        impedance = density.impedance(values)
        there = impedance[:, :1].expand(-1, target.inputs.shape[2], -1, -1, -1)
        posterior = density.engine.posterior(density.processes(values), impedance, target, there)
        return torch.stack(posterior[Latent.DESIRED_POSITION])

    mean, variance = at_once(moments, standard).numpy().swapaxes(0, 1)
    steps = np.random.default_rng(seed).standard_normal(mean.shape)
    return {Latent.DESIRED_POSITION: mean + np.sqrt(variance) * steps}


def at_once(function, points: np.ndarray) -> torch.Tensor:
    """`function` of the dense engine at every point, in one go: some hundred times as fast as a loop."""
    plain = torch.linalg.cholesky_ex

    def factored(matrix):
        return plain(matrix)[0], torch.zeros(())

    with torch.no_grad(), patch.object(torch.linalg, "cholesky_ex", factored):
        return torch.vmap(function)(torch.from_numpy(points))


def settings(config: Config, motion=None, sampler=importance, seed: int = 0, thinned: int = 99) -> Settings:
    motion = repeated_motion(2, 3.0, 2.5, axes=("x",)) if motion is None else motion
    return Settings(config, motion, sampler, marginal_latents, seed, thinned)
