"""Inference engines: exact likelihoods and the factors that posteriors are computed from."""
