"""Gaussian posteriors of every latent, given forces."""

from bayes_impedance.posterior.compute import compute_posterior as compute_posterior
from bayes_impedance.posterior.compute import infer_log as infer_log
from bayes_impedance.posterior.results import Marginal as Marginal
from bayes_impedance.posterior.results import MatrixLaw as MatrixLaw
from bayes_impedance.posterior.results import Posterior as Posterior
from bayes_impedance.posterior.results import draw_matrices as draw_matrices
from bayes_impedance.posterior.results import matrix_marginals as matrix_marginals
