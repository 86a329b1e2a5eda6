"""What configuration `arm` finds on a simulated arm whose axes couple: `make results` writes results/coupled.json.

Four repetitions of one round of a figure of eight, perturbed with 2 N, in a posture whose endpoint mass couples
strongly. Matrices and desired trajectory are compared with the arm's own; what coupling, mass that varies, and other
choices of the configuration are worth; the force of an unseen repetition; and data drawn from the model itself.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from numpy.typing import NDArray

from bayes_impedance import ImpedanceModel, InteractionLog, Latent, Posterior, load_config
from bayes_impedance.baselines.naive import NaiveModel
from bayes_impedance.evaluation.contenders import Predictor
from bayes_impedance.evaluation.held_out import predict, scored
from bayes_impedance.posterior import Marginal
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.simulation.tasks import CENTRE, FigureEight, Flower, Path
from benchmarks.drawn_impedance import AXES, CARRIED, PRIORS, QUANTITIES, WHOLE, draw
from benchmarks.results import Results, commit
from benchmarks.simulated_arm_results import session

Array = NDArray[np.float64]

#: Of the hand from the shoulder [m]: there the endpoint mass is [1.56 −.82; −.82 1.41] kg on average.
POSTURE = (0.03, 0.37)
EIGHT = FigureEight(POSTURE, width=0.12, height=0.08)
REPETITIONS, PACE, PERTURBATION = 4, 4.0, 2.0
#: Share of the phase in which the desired trajectory is known least.
START = 0.2
SEEDS, FEW = range(10), range(3)
INDEPENDENT = ("model.axes=independent",)

#: What the comments in configs/arm.yaml say is worse, and more inducing inputs.
LEARNED = "{median: 0.3, log_sd: 0.5}"
ALTERNATIVES: Mapping[str, tuple[str, ...]] = {
    "constant_mass": ("model.mass.input=[]",),
    "phase_alone": ("model.stiffness.input=[phase]", "model.damping.input=[phase]"),
    "learned_log_sd": (
        f"model.stiffness.log_sd={LEARNED}",
        f"model.damping.log_sd={LEARNED}",
        "model.mass.log_sd={median: 0.2, log_sd: 0.5}",
    ),
    "more_inducing": ("engine.inducing=32",),
}
#: Name → setting of the muscles, path, and time of a round [s].
ELSEWHERE: Mapping[str, tuple[str, Path, float]] = {
    "paper_posture": ("low", FigureEight(CENTRE, width=0.12, height=0.08), PACE),
    "paper_flower": ("low", Flower(), 10.0),
    "paper_flower_in_4_s": ("low", Flower(), PACE),
    "stiff_arm": ("high", EIGHT, PACE),
}


def recorded(seed: int, repetitions: int = REPETITIONS) -> InteractionLog:
    """The session that is studied."""
    return session("low", EIGHT, repetitions, 1, PACE, PERTURBATION, seed)


def fit(log: InteractionLog | PreparedLog, overrides: Sequence[str] = ()) -> tuple[ImpedanceModel, float]:
    """Configuration `arm`, fitted, and the seconds of one core that it took."""
    start = time.process_time()
    model = ImpedanceModel(load_config("arm", overrides)).fit(log)
    return model, time.process_time() - start


# --- one fit beside the truth --------------------------------------------------------------------


def compared(log: InteractionLog | PreparedLog, overrides: Sequence[str] = ()) -> Results:
    """A fit at its training samples: by entry of K, D and M what `entry_figures` says, desired trajectory, seconds."""
    model, seconds = fit(log, overrides)
    prepared = model.fitted.log
    posterior = model.posterior(prepared, latents=[*QUANTITIES, Latent.DESIRED_POSITION])
    return {
        "entries": {
            f"{quantity.value}_{entry}": entry_figures(marginal, column, truth(prepared, quantity, entry))
            for quantity in QUANTITIES
            for entry, marginal, column in entries(posterior, quantity)
        },
        "trajectory": {
            axis: trajectory_figures(posterior[Latent.DESIRED_POSITION], a, prepared)
            for a, axis in enumerate(AXES)
        },
        "seconds": round(seconds, 1),
    }


def entries(posterior: Posterior, quantity: Latent) -> list[tuple[str, Marginal, int]]:
    """Name, marginal and its column of each entry of a matrix that the posterior has."""
    listed = [("xx", posterior[quantity], 0), ("yy", posterior[quantity], 1)]
    if quantity in posterior.couplings:
        listed.append(("xy", posterior.couplings[quantity], 0))
    return listed


def truth(log: PreparedLog, quantity: Latent, entry: str) -> Array:
    """An entry of the arm's own matrix at every sample of `log`."""
    return np.concatenate([trial.truth[f"{quantity.value}_{entry}"] for trial in log.trials])


def entry_figures(marginal: Marginal, column: int, true: Array) -> dict[str, float]:
    """Averages along the path, error along it, and what the 90 % band does there.

    `relative_width` is that of the band over the prior's 90 % band, `variation` the SD of the truth along the path.
    """
    mean = marginal.mean[:, column]
    low, high = marginal.quantile(0.05)[:, column], marginal.quantile(0.95)[:, column]
    prior = marginal.prior_quantile(0.95)[:, column] - marginal.prior_quantile(0.05)[:, column]
    return {
        "truth": float(true.mean()),
        "estimate": float(mean.mean()),
        "variation": float(true.std()),
        "rms_error": root_mean_square(mean - true),
        "coverage": float(np.mean((low <= true) & (true <= high))),
        "width": float(np.mean(high - low)),
        "relative_width": float(np.mean((high - low) / prior)),
    }


def trajectory_figures(desired: Marginal, axis: int, log: PreparedLog) -> dict[str, float]:
    """Error of the desired position of an axis, beside the hand's distance from it [mm], and coverage of its band.

    `rms_error_later` leaves out the first fifth of the phase. There x_d is known but for a solution of
    M ë + D ė + K e = 0 that fades, which exerts no force.
    """
    true = np.concatenate([trial.truth[f"desired_position_{AXES[axis]}"] for trial in log.trials])
    hand = np.concatenate([trial.position[:, axis] for trial in log.trials])
    later = np.concatenate([trial.phase >= START for trial in log.trials if trial.phase is not None])
    error = desired.mean[:, axis] - true
    low, high = desired.quantile(0.05)[:, axis], desired.quantile(0.95)[:, axis]
    return {
        "rms_error": 1e3 * root_mean_square(error),
        "rms_error_later": 1e3 * root_mean_square(error[later]),
        "hand": 1e3 * root_mean_square(hand - true),
        "coverage": float(np.mean((low <= true) & (true <= high))),
    }


def root_mean_square(values: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def listed(seeds: Sequence[Results], *names: str) -> Results:
    """Figures `names` of each entry as lists over seeds, entry → name → list; entry → list where there is one name."""
    found: Results = {}
    for entry in seeds[0]["entries"]:
        lists = {name: [seed["entries"][entry][name] for seed in seeds] for name in names}
        found[entry] = lists[names[0]] if len(names) == 1 else lists
    return found


def over_seeds(seeds: Sequence[Results]) -> Results:
    """All that a study of some seeds shows."""
    return {
        "entries": listed(seeds, *next(iter(seeds[0]["entries"].values()))),
        "trajectory": trajectories(seeds),
        "seconds": [seed["seconds"] for seed in seeds],
    }


def trajectories(seeds: Sequence[Results]) -> Results:
    """Figures of the desired trajectory as lists over seeds, axis → name → list."""
    return {
        axis: {name: [seed["trajectory"][axis][name] for seed in seeds] for name in figures}
        for axis, figures in seeds[0]["trajectory"].items()
    }


def identified(seed: int, overrides: Sequence[str] = ()) -> Results:
    """One session of the study, by configuration `arm` with `overrides`."""
    return compared(recorded(seed), overrides)


def elsewhere(name: str, seed: int) -> Results:
    """One session in another posture, on another path, or with stiffer muscles."""
    setting, path, pace = ELSEWHERE[name]
    return compared(session(setting, path, REPETITIONS, 1, pace, PERTURBATION, seed))


# --- force of an unseen repetition ---------------------------------------------------------------

#: Hyperpriors that suit a naive GP: those of the residual of `arm`, which it takes else, are for the little force that
#: impedance leaves.
NAIVE = (
    "model.residual.sd={median: 0.5, log_sd: 1.0}",
    "model.residual.length_scale={time: {median: 0.1, log_sd: 1.0}}",
)
MOMENTS = ("preprocessing.rate=12.5", "training.restarts=1")


def unseen_force(seed: int) -> Results:
    """Scores on a fifth repetition given the forces of four, axis → model → scores."""
    log = recorded(seed, REPETITIONS + 1)
    arm, _ = fit(log.select(range(REPETITIONS)))
    training, test = arm.fitted.log, arm.prepare(log).select([REPETITIONS])
    independent, _ = fit(training, INDEPENDENT)
    moments = ImpedanceModel(load_config("admittance", MOMENTS)).fit(training)
    naive = NaiveModel(load_config("arm", NAIVE), training)
    handicapped = NaiveModel(load_config("arm"), training)
    predictors = {
        "arm": Predictor.of(arm),
        "arm_independent": Predictor.of(independent),
        "admittance": Predictor.of(moments),
        "naive": Predictor(lambda target: naive.predict(target)[Latent.FORCE]),
        "naive_under_arm": Predictor(lambda target: handicapped.predict(target)[Latent.FORCE]),
    }
    rows = scored([predict(predictors, training, test, test)])
    return {
        axis: {name: scores.as_dict() for name, scores in models.items()} for axis, models in rows.items()
    }


# --- data drawn from the model -------------------------------------------------------------------

#: Name → intention (None: drawn, too), and inducing inputs that matrices are drawn with.
DRAWN: Mapping[str, tuple[Path | None, int]] = {
    "as_carried": (None, CARRIED),
    "whole_functions": (None, WHOLE),
    "intention_of_arm": (EIGHT, WHOLE),
}


def well_specified(name: str, seed: int) -> Results:
    """A fit to drawn data under the priors that their matrices were drawn from."""
    intention, inducing = DRAWN[name]
    motion = ImpedanceModel(load_config("arm")).prepare(recorded(seed))
    return compared(draw(motion, seed, intention, inducing), PRIORS)


# --- all of it -----------------------------------------------------------------------------------


def rounded(figures: Results) -> Results:
    """The same with six significant digits, so that files stay small and rounding of other machines out of them."""

    def of(value: object) -> object:
        if isinstance(value, dict):
            return {key: of(inner) for key, inner in value.items()}
        if isinstance(value, list):
            return [of(inner) for inner in value]
        return float(f"{value:.6g}") if isinstance(value, float) else value

    return {key: of(value) for key, value in figures.items()}


def warm_up() -> None:
    """Compile in this process what a fit calls, so that its seconds are those of the fit."""
    fit(recorded(0), ["preprocessing.rate=5", "engine.inducing=2", "training.max_iterations=1"])


def main() -> None:
    """Compute everything and write the committed JSON."""
    jobs: dict[tuple[str, int], tuple[Callable[..., Results], tuple[object, ...]]] = {}
    for seed in SEEDS:
        jobs["coupled", seed] = (identified, (seed,))
        jobs["independent", seed] = (identified, (seed, INDEPENDENT))
        for name in DRAWN:
            jobs[name, seed] = (well_specified, (name, seed))
    for seed in FEW:
        jobs["force", seed] = (unseen_force, (seed,))
        for name in ELSEWHERE:
            jobs[name, seed] = (elsewhere, (name, seed))
    for name, overrides in ALTERNATIVES.items():
        for seed in FEW:
            jobs[name, seed] = (identified, (seed, overrides))
    found: dict[str, list[Results]] = {}
    with ProcessPoolExecutor(max_workers=os.cpu_count(), initializer=warm_up) as pool:
        running = {where: pool.submit(function, *arguments) for where, (function, arguments) in jobs.items()}
        for (name, seed), result in running.items():
            found.setdefault(name, []).append(result.result())
            print(name, seed, flush=True)
    coupled, independent = found["coupled"], found["independent"]
    figures: Results = {
        "identification": {
            "coupled": listed(coupled, "truth", "estimate"),
            "independent": listed(independent, "truth", "estimate"),
        },
        "coverage": listed(coupled, "coverage"),
        "relative_width": listed(coupled, "relative_width"),
        "seconds": {
            "coupled": [seed["seconds"] for seed in coupled],
            "independent": [seed["seconds"] for seed in independent],
        },
        "along_path": {
            "coupled": listed(coupled, "variation", "rms_error", "width"),
            "independent": listed(independent, "variation", "rms_error", "width", "coverage"),
        },
        "trajectory": {"coupled": trajectories(coupled), "independent": trajectories(independent)},
        "elsewhere": {name: over_seeds(found[name]) for name in ELSEWHERE},
        "alternatives": {name: over_seeds(found[name]) for name in ALTERNATIVES},
        "force": {str(seed): scores for seed, scores in zip(FEW, found["force"], strict=True)},
        "well_specified": {name: over_seeds(found[name]) for name in DRAWN},
    }
    commit("coupled", SEEDS[0], rounded(figures))


if __name__ == "__main__":
    main()
