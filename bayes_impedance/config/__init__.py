"""Configuration: YAML checked by pydantic, unknown keys refused with the nearest known one.

Sections follow the flow of the data: `log` → `preprocessing` → `model`, `shared` → `engine`,
`training`, `sampling`, `baseline`. Every scale is in the SI unit of its quantity.
"""

from bayes_impedance.config.inference import BaselineConfig as BaselineConfig
from bayes_impedance.config.inference import EngineConfig as EngineConfig
from bayes_impedance.config.inference import LocalConfig as LocalConfig
from bayes_impedance.config.inference import SamplingConfig as SamplingConfig
from bayes_impedance.config.inference import TrainingConfig as TrainingConfig
from bayes_impedance.config.loading import Config as Config
from bayes_impedance.config.loading import as_functions as as_functions
from bayes_impedance.config.loading import as_yaml as as_yaml
from bayes_impedance.config.loading import dump_config as dump_config
from bayes_impedance.config.loading import load_config as load_config
from bayes_impedance.config.loading import override_config as override_config
from bayes_impedance.config.loading import parse_config as parse_config
from bayes_impedance.config.loading import replace_value as replace_value
from bayes_impedance.config.loading import shipped_configurations as shipped_configurations
from bayes_impedance.config.log import ClockConfig as ClockConfig
from bayes_impedance.config.log import Columns as Columns
from bayes_impedance.config.log import ForceConfig as ForceConfig
from bayes_impedance.config.log import LogConfig as LogConfig
from bayes_impedance.config.log import ToolConfig as ToolConfig
from bayes_impedance.config.log import Units as Units
from bayes_impedance.config.log import Window as Window
from bayes_impedance.config.model import DampingPrior as DampingPrior
from bayes_impedance.config.model import DesiredTrajectoryPrior as DesiredTrajectoryPrior
from bayes_impedance.config.model import DeviceConfig as DeviceConfig
from bayes_impedance.config.model import ImpedancePrior as ImpedancePrior
from bayes_impedance.config.model import LengthScales as LengthScales
from bayes_impedance.config.model import MassPrior as MassPrior
from bayes_impedance.config.model import ModelConfig as ModelConfig
from bayes_impedance.config.model import ResidualPrior as ResidualPrior
from bayes_impedance.config.model import SharedConfig as SharedConfig
from bayes_impedance.config.model import StiffnessPrior as StiffnessPrior
from bayes_impedance.config.preprocessing import PhaseConfig as PhaseConfig
from bayes_impedance.config.preprocessing import PreprocessingConfig as PreprocessingConfig
from bayes_impedance.config.preprocessing import Segmentation as Segmentation
from bayes_impedance.config.preprocessing import Smoother as Smoother
from bayes_impedance.config.sections import Hyperparameter as Hyperparameter
from bayes_impedance.config.sections import Section as Section
