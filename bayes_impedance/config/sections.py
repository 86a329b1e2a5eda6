"""What every section of a configuration is made of: refusal of unknown keys, hyperparameters, values by axis."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

#: Axis of motion and force.
Axis = Literal["x", "y", "z"]
#: What a process may depend on.
Component = Literal["time", "phase", "position", "velocity"]

#: Widest log-SD of a hyperprior.
LARGEST_HYPERPRIOR_LOG_SD = 5.0

#: Far beyond what makes sense in any unit, so that squares and products of medians stay within float64.
MEDIANS = (1e-30, 1e30)


class Section(BaseModel):
    """Base of every section: immutable, no unknown keys, no infinities."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Hyperparameter(Section):
    """A positive hyperparameter with a log-normal hyperprior.

    `median` [unit of the quantity] and `log_sd` [1] are the median and the SD of the logarithm of the
    hyperprior; `fixed: true` keeps the value at `median`. A bare number in YAML is a fixed value.
    """

    median: float = Field(gt=0)
    log_sd: float = Field(default=1.0, gt=0, le=LARGEST_HYPERPRIOR_LOG_SD)
    fixed: bool = False

    @model_validator(mode="after")
    def _check(self) -> Self:
        low, high = MEDIANS
        if not low <= self.median <= high:
            raise ValueError(
                f"median: expected between {low:g} and {high:g}, got {self.median:g}; check its unit"
            )
        return self


def number_means_fixed(value: Any) -> Any:
    """A bare number as a hyperparameter that is not learned."""
    number = _as_number(value)
    return value if number is None else {"median": number, "fixed": True}


def number_means_every_axis(value: Any) -> Any:
    """A bare number as a value of each axis."""
    number = _as_number(value)
    return value if number is None else dict.fromkeys(get_args(Axis), number)


def _as_number(value: Any) -> float | None:
    if isinstance(value, str):
        # YAML 1.1 reads 1e-3, without a point, as text.
        try:
            return float(value)
        except ValueError:
            return None
    return value if isinstance(value, (int, float)) and not isinstance(value, bool) else None


#: A hyperparameter, for which a bare number may stand: a fixed value.
Scale = Annotated[Hyperparameter, BeforeValidator(number_means_fixed)]


def learned(median: float, log_sd: float = 1.0) -> Any:
    """Default of a hyperparameter that is learned under a log-normal hyperprior."""
    return Field(default=Hyperparameter(median=median, log_sd=log_sd))


PerAxis = BeforeValidator(number_means_every_axis)


def check_distinct(components: Iterable[str]) -> None:
    """Refuse (ValueError) a list of inputs that names one twice."""
    listed = list(components)
    if len(set(listed)) != len(listed):
        raise ValueError(f"input: expected each component once, got {listed}")
