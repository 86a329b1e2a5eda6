"""Arm impedance and intention from motion and interaction force, with Gaussian processes.

A person holds a robot's handle. From logged motion and interaction force, `bayes_impedance` infers what the
person's arm is (mass, damping, stiffness) and where the person wants to go (the desired trajectory), with honest
uncertainty, and predicts the force that follows. Every estimate of impedance comes with a verdict: supported by
these data, weakly, or prior only.

    from bayes_impedance import ImpedanceModel, read_log

    log = read_log("demo/training.csv")
    model = ImpedanceModel.from_config("arm").fit(log)
    posterior = model.posterior(log)
    print(posterior["stiffness"].mean[:3], model.verdicts()[0].sentence)

Two levels:

- High: `inspect_recordings` says what is in files and what looks wrong; `read_log` and `load_config` take in data and
  choices; `ImpedanceModel` fits, gives a `Posterior` of every `Latent` and a `Verdict` on every impedance; `evaluate`
  scores it on another log, `cross_validate` on parts of its own; `prior_sensitivity` tells what rests on a prior;
  `save_model` and `load_model` keep it; `OnlinePredictor` learns and predicts every `Sample` of a control loop. Each
  failure that input can cause is a `BayesImpedanceError`.
- Under it: `bayes_impedance.kernels` are ordinary gpytorch kernels (`ImpedanceKernel`, `PDKernel`,
  `InteractionKernel`) for models of one's own; `bayes_impedance.engines` computes exact likelihoods
  with them, and given impedance by engines whose cost grows with the length of the log;
  `bayes_impedance.impedance_functions` finds impedance as a function.

The formulas are in docs/model.md, whose section numbers the docstrings quote. Everything is in SI units.
"""

from bayes_impedance.config import Config as Config
from bayes_impedance.config import load_config as load_config
from bayes_impedance.errors import BayesImpedanceError as BayesImpedanceError
from bayes_impedance.evaluation.cross_validation import cross_validate as cross_validate
from bayes_impedance.evaluation.explained import impedance_share as impedance_share
from bayes_impedance.evaluation.held_out import evaluate as evaluate
from bayes_impedance.identifiability import Support as Support
from bayes_impedance.identifiability import Verdict as Verdict
from bayes_impedance.inspection.inspect import Inspection as Inspection
from bayes_impedance.inspection.inspect import inspect_recordings as inspect_recordings
from bayes_impedance.kernels.impedance import Latent as Latent
from bayes_impedance.log import InteractionLog as InteractionLog
from bayes_impedance.model import ImpedanceModel as ImpedanceModel
from bayes_impedance.online import OnlinePredictor as OnlinePredictor
from bayes_impedance.online import Sample as Sample
from bayes_impedance.persistence import load_model as load_model
from bayes_impedance.persistence import save_model as save_model
from bayes_impedance.posterior import Posterior as Posterior
from bayes_impedance.readers import read_log as read_log
from bayes_impedance.sensitivity import Sensitivity as Sensitivity
from bayes_impedance.sensitivity import prior_sensitivity as prior_sensitivity
from bayes_impedance.writer import write_log as write_log
