"""Gaussian posteriors of every latent, given forces."""

from bayes_impedance.posterior.compute import Marginal as Marginal
from bayes_impedance.posterior.compute import MatrixLaw as MatrixLaw
from bayes_impedance.posterior.compute import Posterior as Posterior
from bayes_impedance.posterior.compute import by_sample as by_sample
from bayes_impedance.posterior.compute import compute_posterior as compute_posterior
from bayes_impedance.posterior.compute import draw_matrices as draw_matrices
from bayes_impedance.posterior.compute import marginal_of as marginal_of
from bayes_impedance.posterior.compute import matrix_marginals as matrix_marginals
