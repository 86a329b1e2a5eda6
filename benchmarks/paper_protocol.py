"""The paper's experiment as a protocol: a naive GP learns from little, and what it finds serves the impedance model.

Medina, Endo, Hirche 2016, section V-B: θ = ξ = [x, ẋ], x_d around the hand, acceleration and jerk set to zero in the
chain rule; μ_m = 3 kg, μ_d = 15 ± 5 Ns/m, μ_k = 300 ± 50 N/m, x_d with a variance of 1e-4 m², all known and none
learned; the residual takes the hyperparameters of the naive GP. What cannot be read in the paper's text is said in
`UNREADABLE`. Other people, other robot: no figure of the paper is replicated.

`WITH_ACCELERATION` is the same model with the complete chain rule. It is no fair rival of the naive GP, for it sees the
acceleration, which on a robot that answers force by motion holds the force of the same instant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from bayes_impedance import ImpedanceModel, Latent, load_config
from bayes_impedance.baselines.naive import NaiveModel
from bayes_impedance.baselines.without_residual import without_residual
from bayes_impedance.config import Config, override_config
from bayes_impedance.evaluation.contenders import Predictor
from bayes_impedance.evaluation.held_out import predict, scored
from bayes_impedance.features import FeatureMap
from bayes_impedance.model import Fit
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import build_force_model
from benchmarks.results import Results

NAIVE, IMPEDANCE = "naive", "impedance"
WITH_ACCELERATION, WITHOUT_RESIDUAL = "impedance_with_acceleration", "impedance_without_residual"

_INPUT = "input: [position, velocity], length_scale: {position: 0.224, velocity: 0.387}"
#: The naive GP has one function for all trials, and so has the residual.
SETTING = ("model.drop_acceleration=true", "shared.residual=true")
#: The paper's priors, length parameters l as ℓ = √(l/2) (see configs/position_velocity.yaml).
KNOWN = (
    "model.mass={level: 3, sd: 0.3}",
    f"model.stiffness={{prior: gp, level: 300, sd: 50, {_INPUT}}}",
    f"model.damping={{prior: gp, level: 15, sd: 5, {_INPUT}}}",
    "model.desired_trajectory={mean: equilibrium, sd: 0.01, length_scale: {position: 0.158, velocity: 0.387}}",
)
#: What stands here in the place of what cannot be read there.
UNREADABLE = {
    "noise variance": "that of the naive GP, learned with its other hyperparameters",
    "SD of the mass": "0.3 kg, a hundredth of what the mass adds to the variance around the hand itself",
    "number of inducing inputs": "none: predictions are those of the dense engine",
    "results": "nothing here replicates them",
}


def settings(source: str, overrides: Sequence[str]) -> Config:
    """`position_velocity` as in the paper, for logs that are read and prepared as `source` says."""
    reading = load_config(source)
    config = load_config("position_velocity", [*SETTING, *overrides])
    return config.model_copy(update={"log": reading.log, "preprocessing": reading.preprocessing})


@dataclass(frozen=True)
class Reuse:
    """A naive GP trained once, and the impedance model with its residual and noise.

    Without residual there is no such noise: that model learns its own from the same forces.
    """

    config: Config
    naive: NaiveModel
    bare: ImpedanceModel

    @classmethod
    def trained(cls, config: Config, log: PreparedLog) -> Reuse:
        """Hyperparameters from the forces of `log`."""
        bare = ImpedanceModel(without_residual(config)).fit(log)
        return cls(config, NaiveModel(config, log), bare)

    def impedance(self, log: PreparedLog, overrides: Sequence[str] = ()) -> ImpedanceModel:
        """The impedance model given the forces of `log`."""
        config = override_config(self.config, overrides)
        model = build_force_model(config, FeatureMap(config, log.axes))
        entries = {entry.name: entry for entry in model.entries}
        with torch.no_grad():
            for entry in self.naive.hyperparameters:
                entries[entry.name].raw.copy_(entry.raw)
        return ImpedanceModel(config, Fit(model, log, self.naive.report))

    def predictors(self, log: PreparedLog) -> dict[str, Predictor]:
        """Every model given the forces of `log`."""
        naive = self.naive.given(log)
        bare = ImpedanceModel(self.bare.config, Fit(self.bare.fitted.force_model, log, self.bare.report))
        return {
            IMPEDANCE: Predictor.of(self.impedance(log)),
            WITH_ACCELERATION: Predictor.of(self.impedance(log, ["model.drop_acceleration=false"])),
            NAIVE: Predictor(lambda target: naive.predict(target)[Latent.FORCE]),
            WITHOUT_RESIDUAL: Predictor.of(bare),
        }

    def scores(self, log: PreparedLog, target: PreparedLog, test: PreparedLog) -> Results:
        """Axis → model → scores on the forces of `test` given those of `log`."""
        return scores_of(self.predictors(log), log, target, test)

    def hyperparameters(self) -> Results:
        """What the naive GP found, by axis."""
        return {
            entry.name: entry.value.detach().reshape(entry.value.shape[0], -1).tolist()
            for entry in self.naive.hyperparameters
        }


def scores_of(
    predictors: Mapping[str, Predictor], training: PreparedLog, target: PreparedLog, test: PreparedLog
) -> Results:
    """Axis → model → scores on the forces of `test`, whose samples are those of `target`."""
    return {
        axis: {name: scores.as_dict() for name, scores in models.items()}
        for axis, models in scored([predict(predictors, training, target, test)]).items()
    }
