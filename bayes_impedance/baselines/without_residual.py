"""The impedance model without its residual force: what impedance alone predicts."""

from __future__ import annotations

from bayes_impedance.config import Config
from bayes_impedance.errors import ConfigurationError


def without_residual(config: Config) -> Config:
    """`config` with `model.residual: null`, sensor offset included; all else stays as it is.

    Raises:
        ConfigurationError: there is no residual to leave out.
    """
    if config.model.residual is None:
        raise ConfigurationError(
            "baseline without-residual: expected a model with a residual to leave out, found model.residual: null; "
            "leave the baseline out"
        )
    return config.model_copy(update={"model": config.model.model_copy(update={"residual": None})})
