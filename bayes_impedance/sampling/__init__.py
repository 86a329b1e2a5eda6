"""Posteriors drawn by Pyro: impedance, hyperparameters and, given those, desired trajectory and force."""
