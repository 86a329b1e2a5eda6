"""From raw samples to what the model sees: trials and repetitions, smoothing, phase, rate, gaps."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from bayes_impedance.config.sections import Section


class Smoother(Section):
    """Savitzky–Golay filter, applied alike to every measured channel (position, force, …)."""

    window: float = Field(default=0.1, gt=0)
    polynomial_order: int = Field(default=4, ge=3, le=7)


class Segmentation(Section):
    """Where trials and repetitions begin and end, where the log has no columns that say so.

    `rest` is a speed under `rest_speed` [m/s], averaged over half of `rest_duration` [s], for at least that long; what
    never exceeds twice `rest_speed` in between is noise. `trim_rest` cuts it off both ends of each trial. `split: rest`
    makes a trial of what lies between two rests; `split: return` makes a repetition of what lies between two passages
    of the start, within `return_radius` [m] of it, having left it by twice that. Parts shorter than `minimum_duration`
    [s] are left out; a way out of the radius that is shorter is no round. `gaps: split` begins a new trial behind a gap
    longer than `max_gap`, in place of refusing it. `repetitions_as_trials`: each repetition, found or labelled, becomes
    a trial once it is smoothed, with a residual force of its own.
    """

    trim_rest: bool = False
    split: Literal["none", "rest", "return"] = "none"
    rest_speed: float = Field(default=0.005, gt=0)
    rest_duration: float = Field(default=0.3, gt=0)
    return_radius: float = Field(default=0.02, gt=0)
    minimum_duration: float = Field(default=0.5, gt=0)
    gaps: Literal["refuse", "split"] = "refuse"
    repetitions_as_trials: bool = False


class PhaseConfig(Section):
    """Progress through a repetition: from a `column`, along the `path`, or by `warping` to a reference repetition.

    `path`: the share of the way that has been covered, faster than `rest_speed` [m/s] at all times so that it never
    stands still. `warping`: path progress, bent so that positions agree with those of the repetition named
    `reference` (default: the one of median duration), by dynamic time warping through `knots` knots.
    """

    source: Literal["column", "path", "warping"] = "column"
    rest_speed: float = Field(default=0.002, gt=0)
    knots: int = Field(default=8, ge=1, le=100)
    reference: str | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.reference is not None and self.source != "warping":
            raise ValueError(f"reference: expected source: warping with it, got {self.source}; remove one")
        return self


class PreprocessingConfig(Section):
    """From raw samples to position, velocity, acceleration and jerk on an even grid."""

    segmentation: Segmentation = Segmentation()
    smoother: Smoother | None = Smoother()
    phase: PhaseConfig = PhaseConfig()
    rate: float | None = Field(default=None, gt=0)
    max_gap: float = Field(default=0.5, gt=0)
