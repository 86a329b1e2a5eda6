"""How much of the force impedance explains."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.posterior import Posterior

#: What `impedance_share` reads of a posterior.
EXPLAINING = (Latent.FORCE, Latent.RESIDUAL_FORCE)


def impedance_share(posterior: Posterior) -> NDArray[np.float64]:
    """Share of the variance of the measured force that the posterior mean of the impedance's force explains, `(axes,)`.

    1 − Var(u − ĝ) / Var(u), with ĝ = E[u − ũ − ε | forces] and variances over the samples of known force; 1 where
    impedance accounts for all of the force, 0 where it does for none of it, less where ĝ runs against it. The
    forces are those that the posterior was given, so this is a description and not a prediction. Nor does it tell a
    right impedance from a wrong one: where the desired trajectory is free (the equilibrium mean, a wide
    `desired_trajectory.sd`), x_d bends to whatever force there is and the share is high by construction. It means most
    where the desired trajectory is known (`reference`).
    """
    trials = posterior.log.trials
    known = np.concatenate([trial.observed for trial in trials])
    force = np.concatenate([trial.force[trial.observed] for trial in trials if trial.force is not None])
    impedance = posterior[Latent.FORCE].mean - posterior[Latent.RESIDUAL_FORCE].mean
    return 1.0 - np.var(force - impedance[known], axis=0) / np.var(force, axis=0)
