"""Simulation-based calibration: whether a sampler draws from the posterior of its model."""
