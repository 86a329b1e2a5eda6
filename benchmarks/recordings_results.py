"""Real recordings end to end: `make results` writes results/recordings.json (nothing where ../shared/data is absent).

The last third of each recording is predicted from the first two by the impedance model, a naive GP and the impedance
model without residual, with the share of the training force that impedance explains. Of the recording whose
equilibrium is known, also what its conclusions rest on.
"""

from __future__ import annotations

from pathlib import Path

from bayes_impedance import ImpedanceModel, cross_validate, load_config, prior_sensitivity, read_log
from bayes_impedance.evaluation.cross_validation import as_json
from benchmarks.results import RECORDINGS, Results, commit

FILES = {
    "delta_robot": "delta_robot/pHRI_test_experiment_dataset.csv",
    "iiwa_known_equilibrium": "iiwa_known_equilibrium/RobotData_Circle_2025-03-25_14-19-22.txt",
}


def last_third(name: str) -> Results:
    """Scores on the last third, and shares of impedance, by axis and model."""
    config = load_config(f"recordings/{name}")
    log = read_log(RECORDINGS / FILES[name], config.log)
    result = cross_validate(
        ImpedanceModel(config), log, "last-third", baselines=("naive", "without-residual")
    )
    scores = as_json(result)
    return {"recording": Path(FILES[name]).name, "samples": ImpedanceModel(config).prepare(log).n_samples} | {
        key: scores[key] for key in ("axes", "impedance_share")
    }


def sensitivity(name: str) -> Results:
    """What the conclusions of the whole recording rest on."""
    config = load_config(f"recordings/{name}")
    model = ImpedanceModel(config).fit(read_log(RECORDINGS / FILES[name], config.log))
    found = prior_sensitivity(model)
    return {"changes": len(found.refits), "sentences": list(found.sentences)}


def main() -> None:
    """Compute everything and write the committed JSON."""
    if not all((RECORDINGS / file).is_file() for file in FILES.values()):
        print("skipped recordings: they are not in ../shared/data; the committed figures stay")
        return
    figures: Results = {name: {"last_third": last_third(name)} for name in FILES}
    figures["iiwa_known_equilibrium"]["sensitivity"] = sensitivity("iiwa_known_equilibrium")
    commit("recordings", 0, figures)


if __name__ == "__main__":
    main()
