"""Priors of every latent, what trials share, and the robot that they are recorded on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from bayes_impedance.config.sections import (
    Axis,
    Component,
    Hyperparameter,
    PerAxis,
    Scale,
    Section,
    check_distinct,
    learned,
)
from bayes_impedance.errors import ConfigurationError

#: θ, what the desired trajectory depends on.
TrajectoryInput = Literal["time", "phase", "position", "position_velocity"]
#: Prior mean of the desired trajectory (docs/model.md §1).
TrajectoryMean = Literal["equilibrium", "reference", "trial_average", "constant"]
#: Covariance of the desired trajectory.
ProfileName = Literal["squared_exponential", "rational_quadratic", "matern52", "matern72", "matern92"]
#: Covariance of the residual force.
ResidualProfileName = Literal["squared_exponential", "matern12", "matern32", "matern52"]
#: Whether stiffness, damping and mass are numbers of each axis, or symmetric positive definite matrices.
Coupling = Literal["independent", "coupled"]

#: Above this log-SD the product of a log-normal stiffness and a displacement is so heavy-tailed
#: (kurtosis 3 exp(4 s²)) that a Gaussian with the same two moments misleads.
LARGEST_LOG_SD = 0.5


class LengthScales(Section):
    """Length scale for each kind of input, each in the unit of that input; one per axis component (ARD)."""

    time: Scale = learned(0.5)
    phase: Scale = learned(0.15)
    position: Scale = learned(0.1)
    velocity: Scale = learned(0.3)


class ImpedancePrior(Section):
    """Prior of damping or stiffness, a process over `input`; without inputs it is one constant a group.

    `log_gp`: log w ~ GP(log median, log_sd²); `gp`: w ~ GP(mean, sd²). `level` is that median or mean. `coupling` is
    the typical size of K_xy/√(K_xx K_yy) before any data, where axes are coupled.
    """

    prior: Literal["log_gp", "gp"] = "log_gp"
    level: Scale
    log_sd: Scale | None = None
    sd: Scale | None = None
    input: tuple[Component, ...] = ()
    length_scale: LengthScales = LengthScales()
    coupling: Scale = learned(0.3)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.prior == "log_gp" and self.sd is not None:
            raise ValueError("a log_gp takes its scale as log_sd, not sd: set log_sd, or prior: gp")
        if self.prior == "gp" and self.log_sd is not None:
            raise ValueError("a gp takes its scale as sd, not log_sd: set sd, or prior: log_gp")
        if self.prior == "gp" and self.sd is None:
            raise ValueError("a gp needs its scale: set sd, in the unit of the quantity")
        if self.log_sd is not None and self.log_sd.median > LARGEST_LOG_SD:
            raise ValueError(
                f"log_sd: expected at most {LARGEST_LOG_SD} (a wider log-normal is too heavy-tailed for a "
                f"Gaussian force; widen the hyperprior of level instead), got {self.log_sd.median:g}"
            )
        check_distinct(self.input)
        return self

    @property
    def scale(self) -> Hyperparameter:
        """`log_sd` [1] of a log_gp, `sd` [unit of the quantity] of a gp."""
        chosen = self.log_sd if self.prior == "log_gp" else self.sd
        return chosen if chosen is not None else Hyperparameter(median=0.3, log_sd=0.5)


class StiffnessPrior(ImpedancePrior):
    """Stiffness k [N/m]."""

    level: Scale = learned(300.0)


class DampingPrior(ImpedancePrior):
    """Damping d [Ns/m]."""

    level: Scale = learned(20.0)


class MassPrior(Section):
    """Mass m ~ N(level, sd²) [kg], one for each group; where axes are coupled log-normal with the median `level`.

    Where it depends on an `input`, as that of an arm does on posture, log m ~ GP(log median, log_sd²) instead.
    `coupling` as for stiffness.
    """

    level: Scale = learned(1.5, 0.7)
    sd: Scale = Hyperparameter(median=0.3, fixed=True)
    log_sd: Scale = learned(0.2, 0.5)
    input: tuple[Component, ...] = ()
    length_scale: LengthScales = LengthScales()
    coupling: Scale = learned(0.3)

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_distinct(self.input)
        return self

    @property
    def scale(self) -> Hyperparameter:
        """`log_sd` [1] of a mass that depends on an input, `sd` [kg] of one that does not."""
        return self.log_sd if self.input else self.sd


class DesiredTrajectoryPrior(Section):
    """Desired trajectory x_d ~ GP(mean, kernel over θ); `sd` [m]. `periodic` joins the ends of the phase."""

    mean: TrajectoryMean = "equilibrium"
    kernel: ProfileName = "squared_exponential"
    periodic: bool = False
    sd: Scale = learned(0.02)
    length_scale: LengthScales = LengthScales()
    shape: Scale = Hyperparameter(median=1.0, fixed=True)
    value: dict[Axis, float] | None = None
    average_knots: int = Field(default=6, ge=1, le=500)


class ResidualPrior(Section):
    """Residual force ũ ~ GP(0, `kernel` over `input`) plus a constant offset a trial ~ N(0, `offset_sd`²) [N]."""

    kernel: ResidualProfileName = "squared_exponential"
    sd: Scale = learned(1.0)
    input: tuple[Component, ...] = ("position", "velocity")
    length_scale: LengthScales = LengthScales()
    offset_sd: Scale | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_distinct(self.input)
        if not self.input:
            raise ValueError("input: expected at least one of time, phase, position, velocity, got none")
        return self


class ModelConfig(Section):
    """Priors of every latent of u = Σ_j w_j e⁽ʲ⁾ + ũ + ε.

    `axes: coupled` makes stiffness, damping and mass symmetric positive definite matrices across axes.
    `position_noise_sd` [m]: white noise of the recorded positions, whose share that the smoother leaves in position,
    velocity and acceleration is part of the covariance of the force; None leaves it out.
    """

    axes: Coupling = "independent"
    trajectory_input: TrajectoryInput = "time"
    drop_acceleration: bool = False
    desired_trajectory: DesiredTrajectoryPrior = DesiredTrajectoryPrior()
    stiffness: StiffnessPrior = StiffnessPrior()
    damping: DampingPrior = DampingPrior()
    mass: MassPrior = MassPrior()
    residual: ResidualPrior | None = ResidualPrior()
    noise_sd: Scale = learned(0.2)
    position_noise_sd: Scale | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.position_noise_sd is not None and self.desired_trajectory.mean == "equilibrium":
            raise ValueError(
                "position_noise_sd: with desired_trajectory.mean: equilibrium the position cancels from x_d − x, and "
                "its noise with it; set position_noise_sd to null, or take another mean"
            )
        for name in ("stiffness", "damping") if self.axes == "coupled" else ():
            if getattr(self, name).prior == "gp":
                raise ValueError(
                    f"{name}.prior: expected log_gp with axes: coupled, whose matrices are made of positive terms, got "
                    f"gp; set model.{name}.prior=log_gp (and log_sd in place of sd), or model.axes=independent"
                )
        if self.desired_trajectory.periodic and self.trajectory_input != "phase":
            raise ValueError(
                "desired_trajectory.periodic: expected trajectory_input: phase with it, whose ends it joins, got "
                f"{self.trajectory_input}; remove one of the two"
            )
        if self.drop_acceleration and self.trajectory_input != "position_velocity":
            raise ValueError(
                "drop_acceleration: expected trajectory_input: position_velocity with it, got "
                f"{self.trajectory_input}; remove one of the two"
            )
        if self.desired_trajectory.mean == "trial_average" and self.trajectory_input != "phase":
            raise ValueError(
                "desired_trajectory.mean: trial_average averages repetitions at equal phase, so it needs "
                f"trajectory_input: phase, got {self.trajectory_input}"
            )
        return self


class SharedConfig(Section):
    """Which latents the trials of a group share; stiffness, damping and mass always are.

    `desired_trajectory: null` means: one a trial when θ is time, else one a group.
    """

    desired_trajectory: bool | None = None
    residual: bool = False


class DeviceConfig(Section):
    """An admittance-controlled robot: virtual `mass` M_r [kg] and `damping` D_r [Ns/m] of M_r ẍ + D_r ẋ = u + p.

    One number, or one for each axis. `acceleration: law` takes ẍ from this law and the recorded force u and
    perturbation p, `measured` from the motion.
    """

    mass: Annotated[dict[Axis, Annotated[float, Field(gt=0)]], PerAxis]
    damping: Annotated[dict[Axis, Annotated[float, Field(ge=0)]] | None, PerAxis] = None
    acceleration: Literal["measured", "law"] = "measured"

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.acceleration == "law" and self.damping is None:
            raise ValueError(
                "acceleration: the law M_r ẍ + D_r ẋ = u + p needs damping, got none; add it (0 is allowed), or set "
                "acceleration: measured"
            )
        return self

    def masses(self, axes: Iterable[str]) -> NDArray[np.float64]:
        """M_r of `axes`, `(axes,)` [kg].

        Raises:
            ConfigurationError: an axis has none.
        """
        return _of_axes("device.mass", "mass [kg]", self.mass, axes)

    def dampings(self, axes: Iterable[str]) -> NDArray[np.float64] | None:
        """D_r of `axes`, `(axes,)` [Ns/m]; None where the configuration does not say.

        Raises:
            ConfigurationError: an axis has none while another has.
        """
        return (
            None if self.damping is None else _of_axes("device.damping", "damping [Ns/m]", self.damping, axes)
        )


def _of_axes(
    key: str, quantity: str, values: Mapping[Any, float], axes: Iterable[str]
) -> NDArray[np.float64]:
    listed = list(axes)
    missing = [axis for axis in listed if axis not in values]
    if missing:
        raise ConfigurationError(
            f"{key}: expected a {quantity} for each of {', '.join(listed)}, found none for {', '.join(missing)}; add "
            "it, or give one number for all"
        )
    return np.array([values[axis] for axis in listed])
