"""Local sparse models in the paper's setting: over inducing inputs and width of cells, and learning as samples come."""

from __future__ import annotations

import numpy as np

from bayes_impedance import OnlinePredictor, Sample
from bayes_impedance.evaluation.contenders import Predictor
from bayes_impedance.evaluation.metrics import score
from bayes_impedance.preprocessing import PreparedLog
from benchmarks.paper_protocol import IMPEDANCE, NAIVE, Reuse, scores_of
from benchmarks.results import Results

INDUCING = (5, 10, 25, 50, 100)
#: Width of cells in length scales of the desired trajectory.
WIDTHS = (0.5, 1.0, 2.0)
#: [m], [m/s]: `paper_protocol.KNOWN`.
LENGTH_SCALES = {"position": 0.158, "velocity": 0.387}


def local(inducing: int = 50, width: float = 1.0) -> tuple[str, ...]:
    """Settings of the local engine."""
    widths = ", ".join(f"{component}: {width * scale:.6g}" for component, scale in LENGTH_SCALES.items())
    return (
        "engine.name=local",
        f"engine.local.inducing={inducing}",
        f"engine.local.width={{{widths}}}",
    )


def sparse(reuse: Reuse, given: PreparedLog, test: PreparedLog) -> Results:
    """Axis → model → scores of `test` given `given`: dense and naive, and local models over B and width."""
    dense = reuse.predictors(given)
    models = {name: dense[name] for name in (IMPEDANCE, NAIVE)}
    for inducing in INDUCING:
        models[f"inducing {inducing}"] = Predictor.of(reuse.impedance(given, local(inducing)))
    for width in WIDTHS:
        models[f"width {width:g}"] = Predictor.of(reuse.impedance(given, local(width=width)))
    return scores_of(models, given, test, test)


def stream(reuse: Reuse, log: PreparedLog) -> Results:
    """Each repetition but the first, forces predicted as samples come, by what is learned until then.

    Axis → `learning`, `frozen` → MSLL of each repetition; frozen knows the first alone.
    """
    first = log.select([0])
    model = reuse.impedance(first, local())
    learning, frozen = (OnlinePredictor(model) for _ in range(2))
    given = first.trials[0].force
    assert given is not None
    msll: dict[str, dict[str, list[float]]] = {axis: {"learning": [], "frozen": []} for axis in log.axes}
    for number, trial in enumerate(log.trials[1:], start=1):
        found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {"learning": [], "frozen": []}
        assert trial.force is not None
        for i in range(trial.n_samples):
            sample = Sample(
                100.0 * number + trial.time[i], trial.position[i], trial.velocity[i], trial.force[i],
                trial.acceleration[i], trial.jerk[i],
            )  # fmt: skip
            for name, predictor in (("learning", learning), ("frozen", frozen)):
                prediction = predictor.predict(sample)
                found[name].append((prediction.force, prediction.force_variance))
            learning.update(sample)
        for name, values in found.items():
            mean, variance = (np.array(part) for part in zip(*values, strict=True))
            for a, axis in enumerate(log.axes):
                scored = score(mean[:, a], np.sqrt(variance[:, a]), trial.force[:, a], given[:, a])
                msll[axis][name].append(scored.msll)
    return dict(msll)
