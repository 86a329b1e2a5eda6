"""What a simulated arm shows: `make results` writes results/simulated_arm.json, which notebook 02 reads.

Table I and Fig. 3 of Medina, Endo, Hirche 2016; what identifies stiffness and what does not; the force of whole unseen
trials, beside the naive GP and the estimators of `bayes_impedance.baselines`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch

from bayes_impedance import ImpedanceModel, InteractionLog, Latent, evaluate, load_config
from bayes_impedance.baselines.ensemble import EnsembleModel
from bayes_impedance.baselines.kalman import ExtendedKalmanFilter
from bayes_impedance.baselines.naive import NaiveModel
from bayes_impedance.baselines.recursive import RecursiveLeastSquares
from bayes_impedance.config import Config
from bayes_impedance.evaluation.contenders import Baseline, Predictor
from bayes_impedance.evaluation.held_out import as_json, predict, scored
from bayes_impedance.evaluation.metrics import Scores
from bayes_impedance.features import FeatureMap
from bayes_impedance.identifiability import Support
from bayes_impedance.model import Fit
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import build_force_model
from bayes_impedance.simulation.arm import TABLE_I, arm_with
from bayes_impedance.simulation.device import Admittance, BandLimitedForce, Perturbation, Unperturbed
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.subjects import SUBJECTS, Subject, find_subject
from bayes_impedance.simulation.tasks import CENTRE, UNCOUPLED, FigureEight, Flower, Pace, Path
from benchmarks.results import Results, commit

SETTINGS = ("low", "high")
AXES = ("x", "y")


def session(
    setting: str,
    task: Path,
    trials: int,
    repetitions: int,
    pace: float,
    newton: float = 0.0,
    seed: int = 0,
    device: Admittance = Admittance(),
) -> InteractionLog:
    """Trials of one person with the paper's arm."""
    perturbation: Perturbation = BandLimitedForce(newton) if newton else Unperturbed()
    person = Subject(setting, arm_with(setting), Pace(pace))
    return simulate(Experiment([person], task, trials, repetitions, perturbation, device), seed)


# --- Table I -------------------------------------------------------------------------------------


def table_i(setting: str) -> Results:
    """Mean and SD over ten trials of the flower, three rounds of 10 s each, of the endpoint matrices' diagonals."""
    log = session(setting, Flower(), trials=10, repetitions=3, pace=10.0)
    figures: Results = {}
    for name, key in (
        ("stiffness", "muscle_stiffness"), ("stiffness_with_geometry", "stiffness"), ("damping", "damping"),
    ):  # fmt: skip
        values = [np.concatenate([trial.truth[f"{key}_{a}{a}"] for trial in log.trials]) for a in AXES]
        figures[name] = {"mean": [float(v.mean()) for v in values], "sd": [float(v.std()) for v in values]}
    paper = {name: list(values) for name, values in TABLE_I[setting].items()}
    figures["paper"] = paper
    figures["relative_difference"] = {
        name: [float(a / b - 1.0) for a, b in zip(figures[name]["mean"], paper[name], strict=True)]
        for name in paper
    }
    return figures


# --- Fig. 3 --------------------------------------------------------------------------------------

#: Grid of the surfaces: μ_k [N/m] and μ_d [Ns/m].
STIFFNESS = tuple(range(0, 1001, 100))
DAMPING = tuple(range(0, 51, 5))
#: The paper's text does not give them readably: training rate [Hz], σ_r² (that of the naive GP), and SD and length of
#: x_d [m], of which two are shown.
RATE = 10.0
INTENTIONS = {"wide": (0.02, 0.1), "narrow": (0.001, 0.03)}
#: Seeds of the sessions over which the surfaces are averaged: one trial trains, three test.
SESSIONS = range(3)
MASS = 3.0  # μ_m [kg], the paper's
#: SD and length of an x_d that can be any nearly linear function of position [m].
LOOSE = (0.1, 0.316)


def fixed_impedance(mass: float = MASS) -> Config:
    """θ = position, equilibrium mean, constant k, d, m known exactly, one residual function for all trials."""
    return load_config(
        "position",
        [
            f"preprocessing.rate={RATE}",
            "training.restarts=1",
            "shared.residual=true",
            f"model.mass={{level: {mass}, sd: 1e-6}}",
            "model.stiffness={prior: gp, level: 1, sd: 1e-6}",
            "model.damping={prior: gp, level: 1, sd: 1e-6}",
            "model.desired_trajectory.sd=0.02",
            "model.desired_trajectory.length_scale.position=0.1",
        ],
    )


@dataclass(frozen=True)
class Competition:
    """Fixed impedances against a naive GP: trained on one trial of three rounds, scored on three others."""

    config: Config
    training: PreparedLog
    test: PreparedLog
    naive: NaiveModel

    @classmethod
    def of(
        cls, setting: str, mass: float = MASS, device: Admittance = Admittance(), seed: int = 0
    ) -> Competition:
        """The paper's flower without perturbation."""
        config = fixed_impedance(mass)
        log = ImpedanceModel(config).prepare(session(setting, Flower(), 4, 3, 10.0, seed=seed, device=device))
        training = log.select([0])
        return cls(config, training, log.select([1, 2, 3]), NaiveModel(config, training))

    def naive_scores(self) -> list[Scores]:
        """Scores of the naive GP, one an axis."""
        return self._scores(Predictor(lambda log: self.naive.predict(log)[Latent.FORCE]))

    def arm(self, stiffness: float, damping: float, intention: tuple[float, float]) -> ImpedanceModel:
        """The model at one μ_k and μ_d; residual and noise are those of the naive GP."""
        model = build_force_model(self.config, FeatureMap(self.config, self.training.axes))
        entries = {entry.name: entry for entry in model.entries}
        sd, length = intention
        chosen = {
            "desired_trajectory.sd": [sd],
            "desired_trajectory.length_scale": [length, length],
            # A level is positive.
            "stiffness.level": [max(stiffness, 1e-9)],
            "damping.level": [max(damping, 1e-9)],
        }
        with torch.no_grad():
            for entry in self.naive.hyperparameters:
                entries[entry.name].raw.copy_(entry.raw)
            for name, values in chosen.items():
                value = torch.tensor(values, dtype=torch.float64)
                entries[name].raw.copy_(entries[name].inverse(value))
        return ImpedanceModel(self.config, Fit(model, self.training, self.naive.report))

    def scores(self, stiffness: float, damping: float, intention: tuple[float, float]) -> list[Scores]:
        """Scores at one μ_k and μ_d, one an axis."""
        return self._scores(Predictor.of(self.arm(stiffness, damping, intention)))

    def _scores(self, predictor: Predictor) -> list[Scores]:
        predictions = predict({"": predictor}, self.training, self.test, self.test)
        return [models[""] for models in scored([predictions]).values()]


def surfaces(setting: str, intention: str) -> Results:
    """Fig. 3: SMSE and MSLL over the grid beside those of the naive GP, averaged over sessions."""
    prior = INTENTIONS[intention]
    competitions = [Competition.of(setting, seed=seed) for seed in SESSIONS]
    naive = [competition.naive_scores() for competition in competitions]
    scores = [
        [[competition.scores(k, d, prior) for d in DAMPING] for k in STIFFNESS]
        for competition in competitions
    ]
    figures: Results = {"samples": competitions[0].training.n_samples, "sessions": len(SESSIONS)}
    for name in ("smse", "msll"):
        values = np.array(
            [[[[getattr(s, name) for s in cell] for cell in row] for row in each] for each in scores]
        )
        rivals = np.array([[getattr(s, name) for s in each] for each in naive])
        surface, rival = values.mean(0), rivals.mean(0)
        figures[name] = {"naive": rival.tolist()}
        for a, axis in enumerate(AXES):
            k, d = np.unravel_index(surface[:, :, a].argmin(), surface.shape[:2])
            figures[name][axis] = {
                "surface": np.round(surface[:, :, a], 5).tolist(),
                "minimum_at": [STIFFNESS[k], DAMPING[d]],
                "share_below_naive": float((surface[:, :, a] < rival[a]).mean()),
                "share_below_naive_by_session": [
                    float((each[:, :, a] < r[a]).mean()) for each, r in zip(values, rivals, strict=True)
                ],
            }
    return figures


def device_law(mass: float, damping: float) -> Results:
    """Where the SMSE of an arm without stiffness is least over μ_d: at D_r μ_m / M_r, the device's law."""
    device = Admittance(damping=damping)
    fine = np.arange(0.0, 30.5, 0.5)
    competition = Competition.of("high", mass, device)
    scores = [competition.scores(0.0, d, LOOSE) for d in fine.tolist()]
    best = [float(fine[np.argmin([cell[a].smse for cell in scores])]) for a in range(len(AXES))]
    return {"mass": mass, "device_damping": damping, "minimum_at": best, "law": damping * mass / device.mass}


# --- what identifies stiffness -------------------------------------------------------------------

#: Name → trials and perturbation [N].
DESIGNS = {
    "one recording": (1, 2.0),
    "repetitions": (6, 0.0),
    "repetitions, 1 N": (6, 1.0),
    "repetitions, 2 N": (6, 2.0),
    "repetitions, 5 N": (6, 5.0),
}
POSTURES = {"uncoupled": UNCOUPLED, "paper": CENTRE}
SEEDS = (0, 1)


def identification(setting: str, posture: str, design: str, seed: int) -> Results:
    """Path averages with verdict and truth, by parameter: configuration `admittance`, a figure of eight of 4 s."""
    trials, newton = DESIGNS[design]
    log = session(setting, FigureEight(POSTURES[posture], 0.12, 0.08), trials, 1, 4.0, newton, seed)
    model = ImpedanceModel(load_config("admittance", ["training.restarts=1", "preprocessing.rate=12.5"])).fit(
        log
    )
    return beside_truth(model)


def beside_truth(model: ImpedanceModel) -> Results:
    """Path averages of a fitted model by parameter: mean, 90 % interval, verdict and truth."""
    figures: Results = {}
    for verdict in model.verdicts():
        key = f"{verdict.latent.value}_{verdict.axis}{verdict.axis}"
        figures[key] = {
            "mean": verdict.mean,
            "q05": verdict.q05,
            "q95": verdict.q95,
            "truth": true_average(model.fitted.log, key),
            "verdict": verdict.support.value,
            "claimed": verdict.support is not Support.PRIOR_ONLY,
        }
    return figures


def true_average(log: PreparedLog, key: str) -> float:
    """Mean of a truth column over the samples of a log."""
    return float(np.concatenate([trial.truth[key] for trial in log.trials]).mean())


def estimators(setting: str, posture: str) -> Results:
    """Stiffness [N/m] from `repetitions, 2 N`, seed 0: matrices (xx, xy, yx, yy), or xx and yy at the end."""
    trials, newton = DESIGNS["repetitions, 2 N"]
    log = session(setting, FigureEight(POSTURES[posture], 0.12, 0.08), trials, 1, 4.0, newton)
    model = ImpedanceModel(load_config("admittance", ["preprocessing.rate=12.5"]))
    prepared = model.prepare(log)
    figures: Results = {"truth": [true_average(prepared, f"stiffness_{c}") for c in ("xx", "xy", "xy", "yy")]}
    for name, coupled in (("ensemble_coupled", True), ("ensemble_diagonal", False)):
        (ensemble,) = EnsembleModel(model.config, prepared, coupled).groups.values()
        k = ensemble.averages()[0]
        figures[name] = {
            "value": k.value[0].ravel().tolist(),
            "standard_error": k.standard_error[0].ravel().tolist(),
        }
    for name, recursive in (
        ("recursive_least_squares", RecursiveLeastSquares), ("extended_kalman_filter", ExtendedKalmanFilter),
    ):  # fmt: skip
        track = recursive(model.config, prepared).filter(prepared)[-1]
        figures[name] = {
            "value": track.stiffness[-1].tolist(),
            "standard_error": track.stiffness_sd[-1].tolist(),
        }
    return figures


def subject(name: str) -> Results:
    """Path averages for one of the synthetic subjects: ten repetitions of the flower at their own pace, 2 N."""
    log = simulate(Experiment([find_subject(name)], Flower(), 10, 1, BandLimitedForce(2.0)))
    config = load_config("admittance", ["training.restarts=1", "preprocessing.rate=6.25"])
    return beside_truth(ImpedanceModel(config).fit(log))


# --- force of unseen trials ----------------------------------------------------------------------

BASELINES: tuple[Baseline, ...] = ("naive", "ensemble", "ensemble-diagonal", "rls", "ekf")
#: Path and time of a round [s].
FORCE_TASKS: dict[str, tuple[Path, float]] = {
    "flower": (Flower(), 10.0),
    "figure_eight": (FigureEight(), 4.0),
}
CONFIGURATIONS = {"phase": "admittance", "position": "position", "position_velocity": "position_velocity"}


def unseen_force(setting: str, task: str, theta: str) -> Results:
    """Scores on two whole trials of one round, after four, perturbed with 2 N."""
    path, pace = FORCE_TASKS[task]
    log = session(setting, path, 6, 1, pace, 2.0)
    config = load_config(CONFIGURATIONS[theta], ["training.restarts=1", "preprocessing.rate=12.5"])
    model = ImpedanceModel(config).fit(log.select(range(4)))
    return as_json(evaluate(model, log.select([4, 5]), BASELINES))


def main() -> None:
    """Compute everything and write the committed JSON."""
    jobs: dict[tuple[str, ...], tuple[Callable[..., Results], tuple[object, ...]]] = {}
    for setting in SETTINGS:
        jobs["table_i", setting] = (table_i, (setting,))
        for intention in INTENTIONS:
            jobs["fig_3", setting, intention] = (surfaces, (setting, intention))
        for task in FORCE_TASKS:
            for theta in CONFIGURATIONS:
                jobs["force", setting, task, theta] = (unseen_force, (setting, task, theta))
        for posture in POSTURES:
            jobs["estimators", setting, posture] = (estimators, (setting, posture))
            for design in DESIGNS:
                for seed in SEEDS:
                    where = ("identification", setting, posture, design, str(seed))
                    jobs[where] = (identification, (setting, posture, design, seed))
    for name in SUBJECTS:
        jobs["subjects", name] = (subject, (name,))
    for mass, damping in ((3.0, 6.0), (1.5, 6.0), (3.0, 12.0)):
        jobs["device_law", f"{mass:g} kg, {damping:g} Ns/m"] = (device_law, (mass, damping))
    figures: Results = {}
    with ProcessPoolExecutor(max_workers=os.cpu_count()) as pool:
        running = {where: pool.submit(function, *arguments) for where, (function, arguments) in jobs.items()}
        for where, result in running.items():
            place = figures
            for name in where[:-1]:
                place = place.setdefault(name, {})
            place[where[-1]] = result.result()
            print(*where, flush=True)
    figures["grid"] = {"stiffness": list(STIFFNESS), "damping": list(DAMPING), "rate": RATE, "mass": MASS}
    figures["grid"]["intentions"] = {name: list(values) for name, values in INTENTIONS.items()}
    commit("simulated_arm", 0, figures)


if __name__ == "__main__":
    main()
