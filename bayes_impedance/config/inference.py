"""How hyperparameters are found, and what the model is compared with."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from bayes_impedance.config.sections import Component, Section


class EngineConfig(Section):
    """The dense engine. `jitter` is relative to the mean prior variance of force."""

    name: Literal["dense"] = "dense"
    max_samples: int = Field(default=4000, ge=2)
    jitter: float = Field(default=1e-10, ge=0, le=1e-3)


class TrainingConfig(Section):
    """MAP training by L-BFGS; restart 0 starts at the hyperprior medians, the others at draws from it."""

    restarts: int = Field(default=3, ge=1, le=100)
    seed: int = Field(default=0, ge=0)
    max_iterations: int = Field(default=200, ge=1)
    gradient_tolerance: float = Field(default=1e-3, gt=0)


class BaselineConfig(Section):
    """Naive GP: squared exponential on `input` (default: θ and every input of the impedance model)."""

    input: tuple[Component, ...] | None = Field(default=None, min_length=1)
