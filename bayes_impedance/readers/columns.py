"""Which columns of a table hold what."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Sequence

from bayes_impedance.config import Columns, LogConfig
from bayes_impedance.config.log import VECTOR_COLUMNS
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.log import AXES, TRUTH_COLUMN, VECTORS
from bayes_impedance.readers.cells import is_optional
from bayes_impedance.readers.table import Table

TIMES = ("time", "force_time")
#: Columns that only make up the force of the human, where the configuration asks for that.
WRENCH = ("torque", "orientation")


def axes_of(table: Table, config: LogConfig, require_force: bool) -> tuple[str, ...]:
    """Axes that are configured, else those that have position and force.

    Raises:
        LogError: no axis has.
    """
    if config.axes is not None:
        return config.axes
    moving = [axis for axis in AXES if of_axis(config.columns.position, axis) in table.columns]
    if not moving:
        raise _missing(table, "position", of_axis(config.columns.position, AXES[0]))
    measured = [axis for axis in moving if of_axis(config.columns.force, axis) in table.columns]
    if not measured and require_force:
        raise _missing(table, "force", of_axis(config.columns.force, moving[0]))
    _question_half_axes(table, config.columns, forceless=not measured)
    return tuple(measured or moving)


def wanted_columns(
    table: Table, config: LogConfig, axes: tuple[str, ...], require_force: bool
) -> dict[str, tuple[str, ...]]:
    """Columns to load for each quantity.

    Raises:
        LogError: a required or renamed column lacks, one axis has one and another none, or two have one name.
    """
    columns = config.columns
    required = {"time", "position"} | ({"force"} if require_force else set())
    # A log without force has nothing that could be turned.
    forces = require_force or not set(_names(columns, "force", axes) or ()).isdisjoint(table.columns)
    turned = is_turned(config) and forces
    if turned:
        required |= {"orientation"}
    wanted: dict[str, tuple[str, ...]] = {}
    for key in Columns.model_fields:
        names = _names(columns, key, _axes_of_quantity(key, config, axes) if turned else axes)
        # Messages carry their time.
        if names is None or (key in WRENCH and not turned) or (key in TIMES and table.timed):
            continue
        absent = [name for name in names if name not in table.columns]
        # A name that the user wrote down is a name that the user expects to be there.
        renamed = getattr(columns, key) != Columns.model_fields[key].default
        expected = key in required or (key != "force" and renamed)
        if absent and (expected or len(absent) < len(names)):
            raise _missing(table, key, absent[0], optional=is_optional(key))
        if not absent:
            wanted[key] = names
    taken = {name for names in wanted.values() for name in names}
    wanted |= {name: (name,) for name in table.columns if TRUTH_COLUMN.fullmatch(name) and name not in taken}
    for names in wanted.values():
        for name in names:
            if table.columns.count(name) > 1:
                raise LogError(
                    f"{table.where}: expected one column {name!r}, found {table.columns.count(name)}; "
                    "rename the others"
                )
    return wanted


def is_turned(config: LogConfig) -> bool:
    """Whether the force of the human takes the orientation of the tool to find."""
    return config.force.frame == "tool" or config.force.tool is not None


def _axes_of_quantity(key: str, config: LogConfig, axes: tuple[str, ...]) -> tuple[str, ...]:
    # A vector turns as a whole, whatever axes are wanted in the end; so does the acceleration of a tool.
    moves = config.force.tool is not None and config.force.tool.inertia
    return AXES if key in ("force", "torque") or (moves and key == "position") else axes


def _names(columns: Columns, key: str, axes: tuple[str, ...]) -> tuple[str, ...] | None:
    value = getattr(columns, key)
    if value is None or isinstance(value, tuple):
        return value
    return tuple(of_axis(value, axis) for axis in axes) if key in VECTOR_COLUMNS else (value,)


def _question_half_axes(table: Table, columns: Columns, forceless: bool) -> None:
    """An axis with position or force alone is a misspelling where a name is near (LogError), else a warning."""
    known = {
        of_axis(getattr(columns, key), axis) for key in VECTORS for axis in AXES if getattr(columns, key)
    }
    others = [name for name in table.columns if name not in known]
    for axis in AXES:
        names = {key: of_axis(getattr(columns, key), axis) for key in ("position", "force")}
        absent = [key for key, name in names.items() if name not in table.columns]
        if len(absent) != 1:
            continue
        (key,) = absent
        if difflib.get_close_matches(names[key], others, n=1, cutoff=0.85):
            raise _missing(table, key, names[key])
        if not forceless:
            (present,) = set(names) - {key}
            warnings.warn(
                f"{table.where}: axis {axis} has a column {names[present]!r} but none named {names[key]!r}, so it "
                "is left out; name the axes that are meant in log.axes",
                LogWarning,
                stacklevel=2,
            )


def of_axis(template: str, axis: str) -> str:
    """Name of the column of an axis."""
    return template.replace("{axis}", axis).replace("{index}", str(AXES.index(axis)))


def _missing(table: Table, key: str, name: str, optional: bool = False) -> LogError:
    if key in table.absent:
        return table.absent[key]
    by_lower_case = {column.lower(): column for column in table.columns}
    near = difflib.get_close_matches(name.lower(), by_lower_case, n=1, cutoff=0.3)
    found = f"the nearest is {by_lower_case[near[0]]!r}" if near else f"there is {_listed(table.columns)}"
    return LogError(
        f"{table.where}: expected column {name!r}, found none of that name ({found}); set log.columns.{key}"
        f"{' to null or' if optional else ''} to the name in the file"
    )


def _listed(names: Sequence[str]) -> str:
    return ", ".join(repr(name[:40]) for name in names[:5]) + (", …" if len(names) > 5 else "")
