"""Scores of predicted force: on another log, in cross-validation, beside baselines and other models."""
