"""Which columns of a file hold what, guessed from their names, and in which units, from their values.

Reading never guesses: this only writes the first draft of a configuration, for a person to check.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np

from bayes_impedance.log import AXES, Array
from bayes_impedance.readers.columns import of_axis

#: What people call each vector, the likeliest name first; an empty stem is the bare axis.
STEMS: dict[str, tuple[str, ...]] = {
    "position": ("position", "pos", "ee_pos", "tcp_pos", "pose", "translation", "p", ""),
    "force": ("force", "human_force", "ext_force", "wrench", "ft", "f", "effort"),
    "velocity": ("velocity", "vel", "linear", "twist", "v", "d", "dot"),
    "acceleration": ("acceleration", "acc", "accel", "a", "dd"),
    "reference": ("reference", "ref", "desired", "des", "goal", "setpoint", "equilibrium", "0"),
    "perturbation": ("perturbation", "pert", "disturbance"),
    "torque": ("torque", "moment", "tau"),
}
#: How a stem and an axis make a name; `{index}` counts the columns of an array.
FORMS = ("{stem}_{axis}", "{stem}{axis}", "{stem}.{axis}", "{axis}_{stem}", "{axis}{stem}", "{stem}[{index}]")
#: What people call columns that stand alone.
NAMES: dict[str, tuple[str, ...]] = {
    "time": ("time", "t", "timestamp", "stamp", "time_s", "time_ms", "secs", "seconds", "sec"),
    "trial": ("trial", "run", "trial_id"),
    "group": ("group", "subject", "participant", "arm"),
    "repetition": ("repetition", "rep", "cycle", "lap"),
    "phase": ("phase",),
}
#: Steps between samples [s] of recordings between 10 Hz and 10 kHz, in each unit of time: the ranges do not meet.
TIME_UNITS = (("s", 0.1), ("ms", 100.0), ("us", 1e5), ("ns", np.inf))
#: A hand that moves farther than this [m] moves millimetres.
LARGEST_REACH = 5.0


def guess_columns(names: Sequence[str]) -> dict[str, str]:
    """Names or templates of the columns that seem to hold each quantity; those that nothing is found for lack.

    Example:
        >>> guess_columns(["t", "x", "y", "vx", "vy", "Fx", "Fy"])
        {'position': '{axis}', 'force': 'F{axis}', 'velocity': 'v{axis}', 'time': 't'}
        >>> guess_columns(["/robot_state.position[0]", "/robot_state.effort[0]"])
        {'position': '/robot_state.position[{index}]', 'force': '/robot_state.effort[{index}]'}
    """
    left = list(dict.fromkeys(names))
    found: dict[str, str] = {}
    for quantity, stems in STEMS.items():
        template = next((t for stem in stems for t in _templates(stem, left)), None)
        if template is not None:
            found[quantity] = template
            taken = {of_axis(template, axis) for axis in AXES}
            left = [name for name in left if name not in taken]
    for quantity, words in NAMES.items():
        by_word = {re.split(r"[/.]", name)[-1].lower(): name for name in reversed(left)}
        name = next((by_word[word] for word in words if word in by_word), None)
        if name is not None:
            found[quantity] = name
    return found


def _templates(stem: str, names: Sequence[str]) -> Iterator[str]:
    """Templates made of `stem` that name a column for x, those with most axes first."""
    found = {}
    for form in FORMS:
        if not stem and form != "{stem}{axis}":
            continue
        expected = form.replace("{stem}", stem)
        pattern = re.compile(
            r"(.*[/.]|)(" + re.escape(expected.replace("{axis}", "x").replace("{index}", "0")) + ")",
            re.IGNORECASE,
        )
        for name in names:
            match = pattern.fullmatch(name)
            if match is None:
                continue
            prefix, own = match.groups()
            template = prefix + _with_axis(own, expected)
            found[template] = sum(of_axis(template, axis) in names for axis in AXES)
    return iter(sorted(found, key=lambda template: -found[template]))


def _with_axis(own: str, expected: str) -> str:
    """`own`, the name of the x axis as the file spells it, with the axis left open."""
    if "{index}" in expected:
        return own[: -len("[0]")] + "[{index}]"
    start = expected.index("{axis}")
    return own[:start] + "{axis}" + own[start + 1 :]


def guess_time_unit(time: Array) -> str:
    """Unit of time stamps, from the steps between them."""
    step = float(np.median(np.abs(np.diff(time))))
    return next(unit for unit, largest in TIME_UNITS if step <= largest)


def guess_length_unit(position: Array) -> str:
    """Unit of positions `(n, a)`, from how far they move."""
    return "mm" if float(np.ptp(position, axis=0).max()) > LARGEST_REACH else "m"


def guess_sampling_rate(position: Array, velocity: Array) -> float | None:
    """Rate [Hz] of samples without time stamps from positions and velocities, `(n, a)` in one unit of length.

    Δx = v Δt: the slope of v over Δx, over a hundredth of the record at a time so that noise averages out. None where
    they do not belong together.
    """
    span = max(1, len(position) // 100)
    moved = position[span:] - position[:-span]
    total = np.cumsum(0.5 * (velocity[1:] + velocity[:-1]), axis=0)
    steps = np.concatenate([np.zeros_like(total[:1]), total])
    expected = steps[span:] - steps[:-span]
    power = float((moved**2).sum())
    if power == 0.0 or float((expected**2).sum()) == 0.0:
        return None
    rate = float((expected * moved).sum()) / power
    explained = 1.0 - float(((moved - expected / rate) ** 2).sum()) / power if rate > 0 else 0.0
    return rate if explained > 0.9 else None
