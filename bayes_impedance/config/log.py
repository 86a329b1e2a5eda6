"""How a recording maps onto an interaction log: columns or topics, units, signs, frames, clocks, the tool."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from bayes_impedance.config.sections import Axis, Section

LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
FORCE_UNITS = {"N": 1.0, "mN": 1e-3, "kN": 1e3}
TORQUE_UNITS = {"Nm": 1.0, "mNm": 1e-3}

#: What has a unit that `Units` names.
Quantity = Literal["time", "position", "velocity", "acceleration", "force", "torque"]
#: Columns that hold a vector: their names carry `{axis}` (x, y, z) or `{index}` (0, 1, 2).
VECTOR_COLUMNS = ("position", "force", "velocity", "acceleration", "reference", "perturbation", "torque")


class Columns(Section):
    """Names of the columns of the log. `null` where the log has none.

    `{axis}` stands for x, y or z, `{index}` for 0, 1 or 2. In a file of topics a column is a topic, a point and a
    field, such as /robot_state.position[{index}]; in a file of arrays a path, such as robot/position[{index}].
    `position` and `time` are required; the optional ones (velocity, acceleration, trial, …) are read when a column
    of that name exists. `time: null` with `log.sampling_rate` where nothing tells the time; `force_time` where force
    and torque have time stamps of their own. `orientation`: three angles or the four parts of a quaternion.
    """

    time: str | None = "time"
    force_time: str | None = None
    position: str = "position_{axis}"
    force: str = "force_{axis}"
    velocity: str | None = "velocity_{axis}"
    acceleration: str | None = "acceleration_{axis}"
    reference: str | None = "reference_{axis}"
    perturbation: str | None = "perturbation_{axis}"
    torque: str | None = "torque_{axis}"
    orientation: tuple[str, ...] | None = ("orientation_x", "orientation_y", "orientation_z", "orientation_w")
    group: str | None = "group"
    trial: str | None = "trial"
    repetition: str | None = "repetition"
    phase: str | None = "phase"

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name in VECTOR_COLUMNS:
            template = getattr(self, name)
            if template is not None and "{axis}" not in template and "{index}" not in template:
                raise ValueError(
                    f"{name}: expected a column name with {{axis}} or {{index}} in it, got {template!r}"
                )
        if self.orientation is not None and len(self.orientation) not in (3, 4):
            raise ValueError(
                "orientation: expected the columns of three angles or of the four parts of a quaternion, got "
                f"{len(self.orientation)}"
            )
        return self


class Units(Section):
    """Units of the columns as they stand in the file; everything inside is SI."""

    time: Literal["s", "ms", "us", "ns"] = "s"
    position: Literal["m", "cm", "mm"] = "m"
    velocity: Literal["m/s", "cm/s", "mm/s"] = "m/s"
    acceleration: Literal["m/s^2", "cm/s^2", "mm/s^2"] = "m/s^2"
    force: Literal["N", "mN", "kN"] = "N"
    torque: Literal["Nm", "mNm"] = "Nm"
    angle: Literal["rad", "deg"] = "rad"

    def scale(self, quantity: Quantity) -> float:
        """Factor that turns a column of `quantity` into SI."""
        unit = str(getattr(self, quantity)).split("/")[0]
        return (LENGTH_UNITS | TIME_UNITS | FORCE_UNITS | TORQUE_UNITS)[unit]


class Window(Section):
    """Part of each trial that is kept: start ≤ time < end, in the time [s] of the log after unit conversion.

    The time of a file of topics begins at zero with its first sample.
    """

    start: float | None = None
    end: float | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.start is not None and self.end is not None and self.start >= self.end:
            raise ValueError(f"expected start < end, got start {self.start:g} s and end {self.end:g} s")
        return self


class ClockConfig(Section):
    """Which clock tells the time of messages, and what is done where clocks or stamps disagree.

    `header` is the sender's stamp, `record` the time of arrival; `auto` takes the sender's where it increases.
    `align` removes offset and drift between the senders of several topics by what their arrival shows.
    `duplicates: drop` keeps the first of samples with equal stamps.
    """

    source: Literal["auto", "header", "record"] = "auto"
    align: bool = True
    duplicates: Literal["refuse", "drop"] = "refuse"


class ToolConfig(Section):
    """What hangs on the force sensor between it and the hand; its weight, inertia and bias are taken off.

    Either `identify`, a part of the recording [s] in which nobody touches it while the robot turns it about (it may lie
    outside `log.window`), or the values themselves: `mass` [kg], `center_of_mass` [m], `bias` [N] and `torque_bias`
    [Nm] in the frame of the sensor, in the sign of the force of the human. `inertia`: take off m a as well as the
    weight, for a handle that moves briskly. `gravity`: in the base frame [m/s²].
    """

    identify: Window | None = None
    mass: float | None = Field(default=None, ge=0)
    center_of_mass: tuple[float, float, float] | None = None
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    torque_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    inertia: bool = False

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.identify is None) == (self.mass is None):
            raise ValueError(
                "expected either identify, a part without contact, or mass (0 for a bias alone), got "
                f"{'neither' if self.mass is None else 'both'}"
            )
        if self.identify is not None and (self.identify.start is None or self.identify.end is None):
            raise ValueError(
                "identify: expected start and end [s] of a part without contact, got one of them"
            )
        return self


class ForceConfig(Section):
    """What stands between the sensor's reading and the force of the human on the robot.

    `frame: tool` is turned into the base frame by the orientation; `rotation` names what its columns hold: a
    quaternion's order, or the axes of Euler angles (upper case turns about the moving axes, as scipy has it).
    `lag` [s]: the force is logged that much later than the motion; `estimate` finds it.
    """

    frame: Literal["base", "tool"] = "base"
    rotation: str = Field(default="quaternion_xyzw", pattern="^(quaternion_(xyzw|wxyz)|[xyzXYZ]{3})$")
    tool: ToolConfig | None = None
    lag: float | Literal["estimate"] = 0.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        angles = "quaternion" not in self.rotation
        if angles and not (self.rotation.islower() or self.rotation.isupper()):
            raise ValueError(f"rotation: expected axes of one case, such as ZYZ or xyz, got {self.rotation}")
        return self


class LogConfig(Section):
    """How a recording maps onto an interaction log.

    `root`: where in a file of arrays (HDF5, MATLAB) the recordings lie. `sampling_rate` [Hz]: for files without time,
    which then begins at zero in each trial.
    """

    axes: tuple[Axis, ...] | None = Field(default=None, min_length=1)
    columns: Columns = Columns()
    units: Units = Units()
    force_direction: Literal["human_on_robot", "robot_on_human"] = "human_on_robot"
    window: Window = Window()
    delimiter: str | None = Field(default=None, min_length=1, max_length=1)
    root: str | None = None
    sampling_rate: float | None = Field(default=None, gt=0)
    clock: ClockConfig = ClockConfig()
    force: ForceConfig = ForceConfig()

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.axes is not None and len(set(self.axes)) != len(self.axes):
            raise ValueError(f"axes: expected each axis once, got {list(self.axes)}")
        if self.columns.time is None and self.sampling_rate is None:
            raise ValueError("columns.time: null needs sampling_rate [Hz], got none; set log.sampling_rate")
        if self.columns.orientation is None and (self.force.frame == "tool" or self.force.tool is not None):
            raise ValueError(
                "columns.orientation: expected the columns that tell how the tool turns, for log.force.frame is tool "
                "or log.force.tool is given, got null"
            )
        return self
