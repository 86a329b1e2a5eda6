"""Synthetic people: an arm and a pace with a name.

Three of them stand in for the three people of the paper's experiment, whose data are not available: nothing here claims
to be like them. They differ in size, strength, speed and noise, as stated at each.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from bayes_impedance.errors import SimulationError
from bayes_impedance.simulation.arm import MUSCLE_STIFFNESS, Arm
from bayes_impedance.simulation.tasks import Pace


@dataclass(frozen=True)
class Subject:
    """A person: group in the log, arm, and pace of a repetition."""

    name: str
    arm: Arm = Arm()
    pace: Pace = Pace()


def scaled_arm(length: float, mass: float, **changes: float) -> Arm:
    """The default arm with lengths times `length` and masses times `mass`; inertias and moment arms follow.

    Raises:
        SimulationError: a parameter is not physical.
    """
    arm = Arm()
    scales = {
        "lengths": length,
        "masses": mass,
        "centres": length,
        "inertias": mass * length**2,
        "moment_arms": length,
    }
    scaled = {name: tuple(scale * value for value in getattr(arm, name)) for name, scale in scales.items()}
    return replace(arm, **scaled, **changes)  # type: ignore[arg-type]  # each name has its own type


#: Small, soft, slow and precise; medium; tall, stiff, quick and noisy.
SUBJECTS: Mapping[str, Subject] = {
    "A": Subject(
        "A",
        scaled_arm(0.92, 0.80, muscle_stiffness=MUSCLE_STIFFNESS["low"], co_contraction=0.5, noise=0.05),
        Pace(repetition=12.0, spread=0.03, unevenness=0.05),
    ),
    "B": Subject(
        "B",
        scaled_arm(1.0, 1.0, muscle_stiffness=6700.0, co_contraction=1.0, noise=0.10),
        Pace(repetition=10.0, spread=0.05, unevenness=0.10),
    ),
    "C": Subject(
        "C",
        scaled_arm(1.07, 1.25, muscle_stiffness=12000.0, co_contraction=2.0, noise=0.15),
        Pace(repetition=8.0, spread=0.08, unevenness=0.15),
    ),
}


def find_subject(name: str) -> Subject:
    """One of the synthetic subjects.

    Raises:
        SimulationError: there is none of that name.
    """
    if name not in SUBJECTS:
        raise SimulationError(
            f"subject: expected one of {', '.join(SUBJECTS)}, got {name!r}; choose one of them"
        )
    return SUBJECTS[name]
