"""Interaction forces between a person and a robot: arm impedance and intention by Gaussian processes.

High level: `read_log`, `load_config`, `ImpedanceModel`, `evaluate`, `cross_validate`, `prior_sensitivity`,
`save_model`, `load_model`. Under it: `bayes_impedance.kernels`, ordinary gpytorch kernels to take into one's own code.
"""

from bayes_impedance.config import Config as Config
from bayes_impedance.config import load_config as load_config
from bayes_impedance.cross_validation import cross_validate as cross_validate
from bayes_impedance.errors import BayesImpedanceError as BayesImpedanceError
from bayes_impedance.evaluation import evaluate as evaluate
from bayes_impedance.explained import impedance_share as impedance_share
from bayes_impedance.identifiability import Support as Support
from bayes_impedance.identifiability import Verdict as Verdict
from bayes_impedance.kernels.impedance import Latent as Latent
from bayes_impedance.log import InteractionLog as InteractionLog
from bayes_impedance.model import ImpedanceModel as ImpedanceModel
from bayes_impedance.persistence import load_model as load_model
from bayes_impedance.persistence import save_model as save_model
from bayes_impedance.posterior import Posterior as Posterior
from bayes_impedance.readers import read_log as read_log
from bayes_impedance.sensitivity import Sensitivity as Sensitivity
from bayes_impedance.sensitivity import prior_sensitivity as prior_sensitivity
