"""Reading of real recordings: `make results` writes results/reading.json (nothing where ../shared/data is absent).

Every bag of gp_mpc under one configuration, with the law of the robot by axis; six tracings of a symbol, segmented,
given their phase in three ways, and predicted one from the others.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from bayes_impedance import ImpedanceModel, cross_validate, read_log
from bayes_impedance.errors import BayesImpedanceError, LogWarning
from bayes_impedance.evaluation.cross_validation import as_json
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.recording.device_law import fit_device_law
from benchmarks.results import RECORDINGS, Results, commit

BAGS = "gp_mpc"
TRACES = "panda_comanipulation/symbol_17_data.mat"
#: Values of phase at which traces are compared.
PLACES = np.linspace(0.0, 1.0, 201)
#: Of one optimisation in each fold: three restarts take three times as long and change no conclusion.
QUICK = ["training.restarts=1"]


def bag(path: Path) -> Results:
    """What a bag gives under the one configuration: samples, mended faults, the law of the robot, or the refusal."""
    model = ImpedanceModel.from_config("recordings/gp_mpc")
    found: Results = {}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", LogWarning)
        try:
            log = read_log(path, model.config.log)
            found |= {"samples": log.n_samples, "seconds": float(np.ptp(log.trials[0].time))}
            found["trials"] = len(model.prepare(log).trials)
            trial = log.trials[0]
            assert trial.force is not None
            law = fit_device_law(trial.time, trial.velocity, trial.force)
            found["law"] = {
                axis: {
                    "mass": float(law.mass[a]),
                    "mass_determined": bool(law.mass_determined[a]),
                    "damping": float(law.damping[a]),
                    "r_squared": float(law.r_squared[a]),
                }
                for a, axis in enumerate(log.axes)
            }
            found["pooled_r_squared"] = law.pooled
        except BayesImpedanceError as error:
            found["refused"] = str(error)
    said = [str(warning.message) for warning in caught if issubclass(warning.category, LogWarning)]
    return found | ({"mended": said} if said else {})


def spread(log: PreparedLog, by_time: bool = False) -> float:
    """RMS distance [mm] of the positions of trials from their mean, at equal phase or at equal share of the time."""
    paths = []
    for trial in log.trials:
        assert trial.phase is not None
        share = (trial.time - trial.time[0]) / np.ptp(trial.time)
        at = share if by_time else trial.phase
        paths.append(np.stack([np.interp(PLACES, at, column) for column in trial.position.T], axis=1))
    apart = np.stack(paths) - np.mean(paths, axis=0)
    return float(1e3 * np.sqrt(np.mean(np.sum(apart**2, axis=2))))


def tracings() -> Results:
    """Segments, spreads by kind of phase, and scores of each trace predicted from the others."""
    sources = ("path", "warping")
    models = {
        source: ImpedanceModel.from_config(
            "recordings/panda_comanipulation", [*QUICK, f"preprocessing.phase.source={source}"]
        )
        for source in sources
    }
    log = read_log(RECORDINGS / TRACES, models["path"].config.log)
    prepared = {source: model.prepare(log) for source, model in models.items()}
    scores = as_json(cross_validate(models["path"], log, "trials", baselines=("naive",)))
    return {
        "traces": len(prepared["path"].trials),
        "seconds": [float(np.ptp(trial.time)) for trial in prepared["path"].trials],
        "spread_mm": {"time": spread(prepared["path"], by_time=True)}
        | {source: spread(prepared[source]) for source in sources},
        "left_out_in_turn": {key: scores[key] for key in ("axes", "impedance_share")},
    }


def main() -> None:
    """Compute everything and write the committed JSON."""
    if not (RECORDINGS / BAGS).is_dir() or not (RECORDINGS / TRACES).is_file():
        print("skipped reading: recordings are not in ../shared/data; the committed figures stay")
        return
    paths = sorted((RECORDINGS / BAGS).rglob("*.bag"))
    bags = {path.relative_to(RECORDINGS / BAGS).with_suffix("").as_posix(): bag(path) for path in paths}
    commit("reading", 0, {"gp_mpc": bags, "panda_comanipulation": tracings()})


if __name__ == "__main__":
    main()
