"""How hyperparameters are found, and what the model is compared with."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from bayes_impedance.config.sections import Component, Section

#: Engines by name; `auto` takes the cheapest that computes the same quantity exactly.
EngineName = Literal["auto", "dense", "markov", "lowrank", "local"]
#: How posteriors are drawn: exactly, in the limit, or by an approximation.
SamplingMethod = Literal["nuts", "svi", "laplace"]
#: Family of variational posteriors.
Guide = Literal["multivariate_normal", "low_rank"]
#: What becomes of stiffness, damping and mass: integrated out to second order, or estimated as functions.
ImpedanceInference = Literal["moments", "map"]


class LocalConfig(Section):
    """Local sparse models on a grid of cells, for streams and long logs.

    Each sample belongs to the `active` nearest cells. A cell keeps at most `inducing` inputs, and a sample becomes one
    of them where what the others leave of its force exceeds `novelty` times the noise variance. `width` of a cell by
    component, in the component's unit; null: every component of θ, a length scale of the desired trajectory wide. The
    grid reaches one cell beyond the motion that the model was trained on, with at most `cells` of them in use.
    `forgetting`: samples of a cell after which one weighs 1/e; null keeps all.
    """

    inducing: int = Field(default=50, ge=2, le=2000)
    active: int = Field(default=3, ge=1, le=9)
    novelty: float = Field(default=0.03, ge=0)
    width: dict[Component, Annotated[float, Field(gt=0)]] | None = None
    cells: int = Field(default=1000, ge=1)
    forgetting: float | None = Field(default=None, gt=0)


class EngineConfig(Section):
    """How the likelihood of the forces is computed.

    `impedance: moments` integrates stiffness, damping and mass out to second order, which the dense engine does; for
    posteriors of long logs `local` does it by local sparse models of the same covariance, and training stays dense.
    `map` estimates them as functions, with a Laplace covariance, from the likelihood given impedance, which every
    engine but `local` computes. `inducing` inputs carry each such function. `max_samples` and `jitter`, relative to the
    mean prior variance of force, are of the dense engine.
    """

    name: EngineName = "auto"
    impedance: ImpedanceInference = "moments"
    inducing: int = Field(default=12, ge=2, le=200)
    max_samples: int = Field(default=4000, ge=2)
    jitter: float = Field(default=1e-10, ge=0, le=1e-3)
    local: LocalConfig = LocalConfig()

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.impedance == "moments" and self.name in ("markov", "lowrank"):
            raise ValueError(
                f"name: expected auto, dense or local with impedance: moments, got {self.name}, which computes the "
                "likelihood given impedance; set engine.impedance=map"
            )
        if self.impedance == "map" and self.name == "local":
            raise ValueError(
                "name: expected auto, dense, markov or lowrank with impedance: map, got local, whose covariance has "
                "impedance integrated out; set engine.impedance=moments"
            )
        return self


class TrainingConfig(Section):
    """MAP training by L-BFGS; restart 0 starts at the hyperprior medians, the others at draws from it."""

    restarts: int = Field(default=3, ge=1, le=100)
    seed: int = Field(default=0, ge=0)
    max_iterations: int = Field(default=200, ge=1)
    gradient_tolerance: float = Field(default=1e-3, gt=0)


class SamplingConfig(Section):
    """How posteriors of impedance and hyperparameters are drawn.

    `nuts`: `chains` of `warmup` iterations and then `draws`, each step aimed at `target_acceptance`, in trees of at
    most 2^`max_tree_depth` steps. `svi`: a Gaussian `guide`, fitted in `steps`. `laplace`: the curvature at the mode.
    The last two give `chains` times `draws` as well. Functions are kept at `places` of their input.
    """

    method: SamplingMethod = "nuts"
    chains: int = Field(default=4, ge=1, le=64)
    warmup: int = Field(default=500, ge=20)
    draws: int = Field(default=500, ge=1)
    seed: int = Field(default=0, ge=0)
    target_acceptance: float = Field(default=0.8, ge=0.5, le=0.999)
    max_tree_depth: int = Field(default=10, ge=1, le=15)
    guide: Guide = "multivariate_normal"
    steps: int = Field(default=2000, ge=1)
    places: int = Field(default=50, ge=2, le=1000)


class BaselineConfig(Section):
    """Naive GP: squared exponential on `input` (default: θ and every input of the impedance model)."""

    input: tuple[Component, ...] | None = Field(default=None, min_length=1)
