"""What Pyro's samplers take for a divergence."""

from __future__ import annotations

from pyro.ops.integrator import register_exception_handler

from bayes_impedance.errors import NotPositiveDefiniteError


def count_failures_as_divergences() -> None:
    """Tell Pyro that a potential that raises `NotPositiveDefiniteError` has diverged there, and is no crash."""
    register_exception_handler(
        "bayes_impedance",
        lambda error: isinstance(error, NotPositiveDefiniteError),
        warn_on_overwrite=False,
    )
