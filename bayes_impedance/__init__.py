"""Interaction forces between a person and a robot: arm impedance and intention by Gaussian processes."""
