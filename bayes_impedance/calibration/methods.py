"""Draws of a posterior by what a configuration says of sampling."""

from __future__ import annotations

from bayes_impedance.config import Config
from bayes_impedance.sampling.chains import sample_nuts
from bayes_impedance.sampling.density import JointDensity
from bayes_impedance.sampling.draws import Draws
from bayes_impedance.sampling.importance import laplace_draws
from bayes_impedance.sampling.start import find_start
from bayes_impedance.sampling.variational import svi_draws


def posterior_draws(density: JointDensity, config: Config) -> Draws:
    """Draws by `sampling.method`, in this process.

    Raises:
        NotPositiveDefiniteError: the density is not finite where it has to be.
        SamplingError: every chain died.
    """
    start = find_start(density, config.training)
    if config.sampling.method == "nuts":
        # Draws of a calibration are what runs side by side.
        return sample_nuts(density, start, config.sampling, processes=1)
    approximate = svi_draws if config.sampling.method == "svi" else laplace_draws
    return approximate(density, start, config.sampling)
