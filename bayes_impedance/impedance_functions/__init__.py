"""Stiffness, damping and mass as functions of phase or position: MAP, with a Laplace covariance."""
