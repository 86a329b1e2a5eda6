"""The figures that the README quotes: `make results` writes them to results/core.json.

Known equilibrium: stiffness of a KUKA iiwa's controller from a real recording (skipped, and the committed figures
kept, where ../shared/data is absent). Demo: errors against the truth and held-out scores. Coverage: bands of
force and desired trajectory on data drawn from the model.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from bayes_impedance import ImpedanceModel, InteractionLog, Latent, evaluate, load_config, read_log
from bayes_impedance.config import Config, parse_config
from bayes_impedance.demo import coupling_errors, record, truth_errors
from bayes_impedance.evaluation.held_out import as_json
from bayes_impedance.features import FeatureMap, Features
from bayes_impedance.posterior import compute_posterior
from bayes_impedance.priors import build_force_model
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from bayes_impedance.trajectory_mean import TrajectoryMean
from benchmarks.results import RECORDINGS, Results, commit, committed

RECORDING = RECORDINGS / "iiwa_known_equilibrium/RobotData_Circle_2025-03-25_14-19-22.txt"
SHIFT_SAMPLES = 200  # one second at 200 Hz
DRAWS = 50


def known_equilibrium() -> Results:
    """Stiffness against a least-squares line with offset; the same with the reference a second late."""
    config = load_config("recordings/iiwa_known_equilibrium")
    log = read_log(RECORDING, config.log)
    right, wrong = ImpedanceModel(config).fit(log), ImpedanceModel(config).fit(_late(log))
    trial = right.fitted.log.trials[0]
    assert trial.reference is not None
    assert trial.force is not None
    design = np.column_stack([trial.reference[:, 0] - trial.position[:, 0], np.ones(len(trial.time))])
    line = np.linalg.lstsq(design, trial.force[:, 0], rcond=None)[0]
    verdict = right.verdicts()[0]
    return {
        "recording": RECORDING.name,
        "samples": right.report.samples,
        "least_squares_stiffness": float(line[0]),
        "stiffness": {"mean": verdict.mean, "q05": verdict.q05, "q95": verdict.q95},
        "relative_difference": float(verdict.mean / line[0] - 1.0),
        "contraction": verdict.contraction,
        "log_likelihood": right.report.log_likelihood[0],
        "residual_rms": _residual_rms(right),
        "reference_one_second_late": {
            "log_likelihood": wrong.report.log_likelihood[0],
            "residual_rms": _residual_rms(wrong),
        },
    }


def demo() -> Results:
    """What `make demo` prints."""
    with tempfile.TemporaryDirectory() as folder:
        recording = record(Path(folder), seed=0)
        model = ImpedanceModel(recording.config).fit(read_log(recording.training, recording.config.log))
        test = read_log(recording.testing, recording.config.log)
        scores = as_json(evaluate(model, test, ["naive"]))
    posterior = model.posterior(model.fitted.log)
    return {
        "seed": 0,
        "engine": model.engine.name,
        "mean_relative_error": truth_errors(posterior),
        "mean_absolute_error": coupling_errors(posterior),
        "scores": scores,
    }


def coverage() -> Results:
    """Share of held-out forces and desired positions inside their 90 % bands, by what θ is."""
    return {
        theta: coverage_of(configuration_of(theta), range(DRAWS)) for theta in ("time", "phase", "position")
    }


def configuration_of(theta: str) -> Config:
    """Fixed hyperparameters, log-SD .3: data are drawn from the model that then infers."""
    mean = "equilibrium" if theta == "position" else "reference"
    return parse_config(
        {
            "model": {
                "trajectory_input": theta,
                "desired_trajectory": {
                    "mean": mean,
                    "sd": 0.01,
                    "length_scale": {"time": 0.4, "phase": 0.15, "position": 0.08},
                },
                "stiffness": {
                    "level": 150,
                    "log_sd": 0.3,
                    "input": ["position"],
                    "length_scale": {"position": 0.1},
                },
                "damping": {
                    "level": 12,
                    "log_sd": 0.3,
                    "input": ["position"],
                    "length_scale": {"position": 0.1},
                },
                "mass": {"level": 1.2, "sd": 0.2},
                "residual": {
                    "sd": 0.3,
                    "input": ["position", "velocity"],
                    "length_scale": {"position": 0.1, "velocity": 0.3},
                },
                "noise_sd": 0.1,
            }
        }
    )


def coverage_of(config: Config, seeds: range) -> Results:
    """Coverage over draws of true products: every second sample is given, the others are predicted."""
    shares: dict[Latent, list[float]] = {Latent.FORCE: [], Latent.DESIRED_POSITION: []}
    for seed in seeds:
        motion = repeated_motion(repetitions=3, duration=4.0, rate=10.0, displacement_sd=0.015, seed=seed)
        log = draw_force(config, motion, seed)
        feature_map = FeatureMap(config, log.axes)
        features = feature_map(log, TrajectoryMean.from_training(config.model.desired_trajectory, log))
        given = slice(0, None, 2)
        posterior = compute_posterior(
            build_force_model(config, feature_map),
            log,
            features,
            _thinned(features, given),
            config.engine.jitter,
            list(shares),
        )
        names = [f"desired_position_{axis}" for axis in log.axes]
        truth = {
            Latent.FORCE: np.concatenate([trial.force for trial in log.trials if trial.force is not None]),
            Latent.DESIRED_POSITION: np.concatenate(
                [np.stack([trial.truth[name] for name in names], axis=1) for trial in log.trials]
            ),
        }
        for latent, values in truth.items():
            marginal = posterior[latent]
            inside = (values >= marginal.quantile(0.05)) & (values <= marginal.quantile(0.95))
            shares[latent].append(float(inside[1::2].mean()))
    return {latent.value: float(np.mean(values)) for latent, values in shares.items()} | {"draws": len(seeds)}


def _thinned(features: Features, rows: slice) -> Features:
    assert features.force is not None
    return replace(
        features,
        inputs=features.inputs[:, :, rows],
        force=features.force[:, :, rows],
        trajectory_mean=features.trajectory_mean[:, :, rows],
        rows=tuple(part[rows] for part in features.rows),
    )


def _late(log: InteractionLog) -> InteractionLog:
    """The reference a second late, its first value before."""
    trial = log.trials[0]
    assert trial.reference is not None
    start = np.repeat(trial.reference[:1], SHIFT_SAMPLES, axis=0)
    late = np.concatenate([start, trial.reference[:-SHIFT_SAMPLES]])
    return InteractionLog(log.axes, (replace(trial, reference=late),))


def _residual_rms(model: ImpedanceModel) -> float:
    """Root mean square of the force [N] that impedance leaves to the residual."""
    residual = model.posterior(model.fitted.log, latents=[Latent.RESIDUAL_FORCE])[Latent.RESIDUAL_FORCE]
    return float(np.sqrt(np.mean(residual.mean**2)))


def main() -> None:
    """Compute everything and write the committed JSON."""
    parts: dict[str, Callable[[], Results]] = {
        "known_equilibrium": known_equilibrium,
        "demo": demo,
        "coverage": coverage,
    }
    if not RECORDING.is_file():
        print(f"skipped known_equilibrium: no {RECORDING.name} in ../shared/data; its committed figures stay")
        del parts["known_equilibrium"]
    figures = committed("core")
    for name, compute in parts.items():
        figures[name] = compute()
        print(name, json.dumps(figures[name], indent=2))
    commit("core", 0, figures)


if __name__ == "__main__":
    main()
