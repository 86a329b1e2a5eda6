"""Errors a user can mend: each message says what was expected, what was found, where, and what to do."""


class BayesImpedanceError(Exception):
    """Base of every error that input, configuration or files can cause; the command line exits with 2."""


class ConfigurationError(BayesImpedanceError):
    """A configuration is malformed, or asks for something that the data cannot give."""


class LogError(BayesImpedanceError):
    """A recording cannot be read, or what it holds is not a valid interaction log."""


class ModelFolderError(BayesImpedanceError):
    """A model folder is missing, truncated, changed, or written by a newer schema."""


class NotPositiveDefiniteError(BayesImpedanceError):
    """A covariance matrix has no Cholesky factor at the jitter that was tried, or overflows."""


class TooManySamplesError(BayesImpedanceError):
    """More samples than the engine is allowed to hold."""


class OutputError(BayesImpedanceError):
    """An output file or folder cannot be written."""


class SamplingError(BayesImpedanceError):
    """No chain lived to draw anything."""


class SimulationError(BayesImpedanceError):
    """An arm, a device or a task is not physical, out of reach, or cannot be integrated at the step asked for."""


class BayesImpedanceWarning(UserWarning):
    """Base of every warning that a user should read."""


class LogWarning(BayesImpedanceWarning):
    """The recording can be used, but something in it looks wrong."""


class JournalWarning(BayesImpedanceWarning):
    """Training or sampling goes on, but could not be continued from here if it were killed."""
