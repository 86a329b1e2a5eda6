"""What drawn posteriors show: `make results` writes results/sampling.json.

Impedance and its intervals on data drawn from the model, on the simulated arm beside the mode of configuration `arm`,
on one recording of it that nothing perturbed, and on a robot whose equilibrium was recorded (left out where
../shared/data is absent); and that a seed gives the same draws again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from bayes_impedance import ImpedanceModel, Latent, load_config, read_log
from bayes_impedance.config import Config, SamplingConfig
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.sampling.density import weights
from bayes_impedance.sampling.drawn import DrawnPosterior
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from benchmarks.coupled_results import (
    EIGHT,
    PACE,
    QUANTITIES,
    entries,
    entry_figures,
    recorded,
    rounded,
    truth,
)
from benchmarks.recordings_results import FILES
from benchmarks.results import RECORDINGS, Results, commit, committed
from benchmarks.simulated_arm_results import session

Array = NDArray[np.float64]

#: Data drawn from the model: one axis, stiffness and damping functions of phase whose scales are known.
SEEDS = range(20)
REPETITIONS, DURATION, RATE, DISPLACEMENT_SD, NOISE_SD = 4, 4.0, 12.5, 0.02, 0.1
DRAWN = ("log.axes=[x]", "model.desired_trajectory.kernel=matern52", "model.residual=null")
SCALES_KNOWN = tuple(
    f"model.{quantity}.{scale}.fixed=true"
    for quantity in ("stiffness", "damping")
    for scale in ("log_sd", "length_scale.phase")
)
#: Iterations of each of four chains, as few as reach an R-hat of 1.01.
RECOVERY = {"warmup": 100, "draws": 700}
ARM = {"warmup": 150, "draws": 250}
UNPERTURBED = {"warmup": 100, "draws": 200}
#: At .8 one draw in forty diverges.
ROBOT = {"warmup": 150, "draws": 400, "target_acceptance": 0.95}
AGAIN = {"chains": 2, "warmup": 30, "draws": 50}
#: Draws that functions are compared at, at every sample of a log.
COMPARED = 300
#: Functions as inducing inputs carry them, and with the variation that these do not carry, as draws show them.
WAYS = ("carried", "nuts")
ROBOT_NAME = "iiwa_known_equilibrium"
#: Kernels that have a state-space form, so that a gradient costs a tenth.
MARKOV = (
    "model.desired_trajectory.kernel=matern52",
    "model.residual.kernel=matern32",
    "engine.impedance=map",
)
#: Nothing known of where the robot wanted to be.
NO_REFERENCE = (
    "model.desired_trajectory.mean=equilibrium",
    "model.desired_trajectory.sd={median: 0.02, log_sd: 1.0}",
)


def trustworthiness(drawn: DrawnPosterior) -> Results:
    """Draws, and the worst that diagnostics say of them."""
    found = drawn.diagnosis.as_dict()
    names = ("chains", "draws", "rhat_max", "ess_bulk_min", "ess_tail_min", "divergences", "findings")
    return {"parameters": drawn.density.size, "engine": drawn.engine.name} | {
        name: found[name] for name in names if name in found
    }


def verdict(drawn: DrawnPosterior, latent: Latent) -> Results:
    """What is claimed of each axis, and on what grounds."""
    return {
        one.verdict.axis: {
            "support": one.verdict.support.value,
            "sentence": one.verdict.sentence,
            "mean": one.verdict.mean,
            "interval": [one.verdict.q05, one.verdict.q95],
            "prior_interval": [one.verdict.prior_q05, one.verdict.prior_q95],
            "contraction": one.verdict.contraction,
            "correlation": None if np.isnan(one.correlation) else one.correlation,
            "sensitivity": one.sensitivity,
        }
        for one in drawn.verdicts
        if one.verdict.latent is latent
    }


# --- data drawn from the model -------------------------------------------------------------------


def drawn_data(seed: int) -> PreparedLog:
    """Four repetitions of fifty samples with force and truth."""
    motion = repeated_motion(REPETITIONS, DURATION, RATE, DISPLACEMENT_SD, axes=("x",), seed=seed)
    return draw_force(load_config("phase", [*DRAWN, f"model.noise_sd={NOISE_SD}"]), motion, seed)


def recovery_config() -> Config:
    """Configuration `phase` under which the data are drawn, noise and desired trajectory learned."""
    return load_config("phase", [*DRAWN, *SCALES_KNOWN])


def recovery(seed: int) -> Results:
    """Relative errors of posterior medians, and the share of the 90 % intervals along phase that hold the truth."""
    log = drawn_data(seed)
    drawn = ImpedanceModel(recovery_config()).sample(log, settings=SamplingConfig(seed=seed, **RECOVERY))
    phase, _ = drawn.abscissa(0)
    figures = trustworthiness(drawn)
    for latent in QUANTITIES:
        values = drawn.matrices(latent)[..., 0, 0].reshape(-1, len(phase))
        true = along_phase(log, f"{latent.value}_xx", phase)
        low, median, high = np.quantile(values, (0.05, 0.5, 0.95), axis=0)
        figures[latent.value] = {
            "error": float(np.median(np.abs(median / true - 1.0))),
            "coverage": float(np.mean((low <= true) & (true <= high))),
            "half_width": float(np.median((high - low) / (2.0 * true))),
        }
    return figures


def along_phase(log: PreparedLog, name: str, phase: Array) -> Array:
    """A function of phase, known at the samples of all repetitions, at other phases."""
    known = np.concatenate([trial.phase for trial in log.trials if trial.phase is not None])
    values = np.concatenate([trial.truth[name] for trial in log.trials])
    order = np.argsort(known)
    return np.interp(phase, known[order], values[order])


def over_seeds(seeds: Sequence[Results]) -> Results:
    """Lists over seeds, and what is required of them."""
    figures: Results = {
        latent.value: {
            "error_median": float(np.median([seed[latent.value]["error"] for seed in seeds])),
            "coverage_mean": float(np.mean([seed[latent.value]["coverage"] for seed in seeds])),
            **{name: [seed[latent.value][name] for seed in seeds] for name in seeds[0][latent.value]},
        }
        for latent in QUANTITIES
    }
    for name in ("rhat_max", "ess_bulk_min", "ess_tail_min", "divergences"):
        figures[name] = [seed[name] for seed in seeds]
    figures["largest_rhat"] = max(figures["rhat_max"])
    figures["seeds_without_divergences"] = sum(count == 0 for count in figures["divergences"])
    return {key: seeds[0][key] for key in ("parameters", "engine", "chains", "draws")} | figures


# --- the simulated arm ---------------------------------------------------------------------------


def arm(seed: int, warmup: int, draws: int) -> Results:
    """Entries of stiffness, damping and mass along the path: draws, and the mode with its curvature beside."""
    model = ImpedanceModel(load_config("arm")).fit(recorded(seed))
    log = model.fitted.log
    mode = model.posterior(log, latents=QUANTITIES)
    drawn = model.sample(log, settings=SamplingConfig(seed=seed, warmup=warmup, draws=draws))
    standard = drawn.draws.standard.reshape(-1, drawn.density.size)
    chosen = np.unique(np.linspace(0, len(standard) - 1, COMPARED).astype(int))
    after = {way: along_path(drawn, standard[chosen], way == "nuts") for way in WAYS}
    standard = np.random.default_rng(seed).standard_normal((COMPARED, drawn.density.size))
    before = {way: along_path(drawn, standard, way == "nuts") for way in WAYS}
    figures: Results = {"diagnosis": trustworthiness(drawn), "verdict": verdict(drawn, Latent.STIFFNESS)}
    for name, a, b in (("xx", 0, 0), ("yy", 1, 1), ("xy", 0, 1)):
        for j, quantity in enumerate(QUANTITIES):
            true = truth(log, quantity, name)
            columns = {entry: (marginal, column) for entry, marginal, column in entries(mode, quantity)}
            figures[f"{quantity.value}_{name}"] = {
                way: interval_figures(after[way][:, :, j, a, b], before[way][:, :, j, a, b], true)
                for way in WAYS
            } | {"mode": entry_figures(*columns[name], true)}
    figures["stiffness_coverage"] = {
        way: float(np.mean([figures[f"stiffness_{name}"][way]["coverage"] for name in ("xx", "yy", "xy")]))
        for way in (*WAYS, "mode")
    }
    return figures


def along_path(drawn: DrawnPosterior, standard: Array, whole: bool) -> Array:
    """K, D and M at the samples of the log, in its order, for each of the coordinates: `(draws, n, 3, axes, axes)`.

    `whole` adds to the matrix logarithm what inducing inputs do not carry, of its prior variance at each sample.
    """
    density = drawn.density
    inputs = density.features.inputs
    generator = torch.Generator().manual_seed(0)
    found = []
    with torch.no_grad():
        for row in standard:
            values = density.values(torch.from_numpy(row))
            matrices = []
            for function, own in zip(density.functions(values), weights(values), strict=True):
                design = function.design(inputs)
                logarithm = function.logarithm(design, own)
                if whole:
                    left_out = function.left_out(inputs, design).transpose(1, 2).sqrt()
                    noise = torch.randn(left_out.shape, generator=generator, dtype=torch.float64)
                    logarithm = logarithm + left_out * noise
                matrices.append(function.exponential(logarithm)[0].numpy())
            found.append(np.stack(matrices, axis=1))
    rows = density.features.rows[0]
    order = np.lexsort((rows[:, 1], rows[:, 0]))
    return np.stack(found)[:, order]


def interval_figures(draws: Array, prior: Array, true: Array) -> dict[str, float]:
    """As `entry_figures`, of draws `(draws, n)` and those of the prior."""
    low, high = np.quantile(draws, (0.05, 0.95), axis=0)
    prior_low, prior_high = np.quantile(prior, (0.05, 0.95), axis=0)
    mean = draws.mean(axis=0)
    return {
        "truth": float(true.mean()),
        "estimate": float(mean.mean()),
        "variation": float(true.std()),
        "rms_error": float(np.sqrt(np.mean((mean - true) ** 2))),
        "coverage": float(np.mean((low <= true) & (true <= high))),
        "width": float(np.mean(high - low)),
        "relative_width": float(np.mean((high - low) / (prior_high - prior_low))),
    }


def unperturbed(seed: int, warmup: int, draws: int) -> Results:
    """One round of the same path that the device left alone."""
    model = ImpedanceModel(load_config("arm"))
    log = model.prepare(session("low", EIGHT, 1, 1, PACE, 0.0, seed))
    drawn = model.sample(log, settings=SamplingConfig(seed=seed, warmup=warmup, draws=draws))
    return {"diagnosis": trustworthiness(drawn), "verdict": verdict(drawn, Latent.STIFFNESS)}


# --- a robot whose equilibrium was recorded ------------------------------------------------------


def robot(overrides: Sequence[str], **settings: float) -> Results:
    """Stiffness of the whole recording, beside the slope of a line through u and x_d - x."""
    config = load_config(f"recordings/{ROBOT_NAME}", overrides)
    model = ImpedanceModel(config)
    log = model.prepare(read_log(RECORDINGS / FILES[ROBOT_NAME], config.log))
    drawn = model.sample(log, settings=SamplingConfig(**settings))
    (trial,) = log.trials
    assert trial.reference is not None
    assert trial.force is not None
    slope, _ = np.polyfit((trial.reference - trial.position)[:, 0], trial.force[:, 0], 1)
    return {
        "samples": log.n_samples,
        "least_squares_stiffness": float(slope),
        "diagnosis": trustworthiness(drawn),
        "stiffness": verdict(drawn, Latent.STIFFNESS)["z"],
    }


# --- the same seed -------------------------------------------------------------------------------


def short_run(seed: int) -> Results:
    """Two short chains on the first data of the study: a digest of the draws, and their average stiffness."""
    settings = SamplingConfig(seed=seed, **AGAIN)
    drawn = ImpedanceModel(recovery_config()).sample(drawn_data(0), settings=settings)
    return {
        "digest": hashlib.sha256(drawn.draws.standard.tobytes()).hexdigest(),
        "stiffness": float(drawn.matrices(Latent.STIFFNESS).mean()),
    }


def main() -> None:
    """Compute everything and write the committed JSON."""
    recovered = []
    for seed in SEEDS:
        recovered.append(recovery(seed))
        print("recovery", seed, rounded(recovered[-1]), flush=True)
    figures: Results = {
        "recovery": over_seeds(recovered),
        "arm": arm(0, **ARM),
        "unperturbed": unperturbed(0, **UNPERTURBED),
        "again": {"first": short_run(0), "second": short_run(0), "other_seed": short_run(1)},
    }
    if (RECORDINGS / FILES[ROBOT_NAME]).is_file():
        figures["robot"] = {
            "reference": robot(MARKOV, **ROBOT),
            "no_reference": robot([*MARKOV, *NO_REFERENCE], **ROBOT),
        }
    elif "robot" in (before := committed("sampling")):
        print(f"skipped {ROBOT_NAME}: it is not in ../shared/data; the committed figures stay")
        figures["robot"] = before["robot"]
    commit("sampling", SEEDS[0], rounded(figures))


if __name__ == "__main__":
    main()
