"""Configuration: YAML checked by pydantic, unknown keys refused with the nearest known one.

Sections follow the flow of the data: `log` → `preprocessing` → `model`, `shared` → `engine`,
`training`, `baseline`. Every scale is in the SI unit of its quantity.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from bayes_impedance.errors import ConfigurationError

#: Axis of motion and force.
Axis = Literal["x", "y", "z"]
#: What a process may depend on.
Component = Literal["time", "phase", "position", "velocity"]
#: θ, what the desired trajectory depends on.
TrajectoryInput = Literal["time", "phase", "position", "position_velocity"]
#: Prior mean of the desired trajectory (docs/model.md §1).
TrajectoryMean = Literal["equilibrium", "reference", "trial_average", "constant"]
#: Covariance of the desired trajectory.
ProfileName = Literal["squared_exponential", "rational_quadratic", "matern52", "matern72", "matern92"]

#: Above this log-SD the product of a log-normal stiffness and a displacement is so heavy-tailed
#: (kurtosis 3 exp(4 s²)) that a Gaussian with the same two moments misleads.
LARGEST_LOG_SD = 0.5

#: Widest log-SD of a hyperprior.
LARGEST_HYPERPRIOR_LOG_SD = 5.0

#: Far beyond what makes sense in any unit, so that squares and products of medians stay within float64.
MEDIANS = (1e-30, 1e30)

#: What PyYAML raises at a text that it cannot turn into values (13 months, a thousand brackets).
UNREADABLE = (yaml.YAMLError, ValueError, RecursionError)


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


def _number_means_fixed(value: Any) -> Any:
    number = _as_number(value)
    return value if number is None else {"median": number, "fixed": True}


def _number_means_every_axis(value: Any) -> Any:
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
Scale = Annotated[Hyperparameter, BeforeValidator(_number_means_fixed)]


def _learned(median: float, log_sd: float = 1.0) -> Any:
    return Field(default=Hyperparameter(median=median, log_sd=log_sd))


# --- log -----------------------------------------------------------------------------------------

LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
FORCE_UNITS = {"N": 1.0, "mN": 1e-3, "kN": 1e3}


class Columns(Section):
    """Names of the columns of the log; `{axis}` stands for x, y or z. `null` where the log has none.

    `position` and `time` are required; the optional ones (velocity, acceleration, trial, …) are read
    when a column of that name exists.
    """

    time: str = "time"
    position: str = "position_{axis}"
    force: str = "force_{axis}"
    velocity: str | None = "velocity_{axis}"
    acceleration: str | None = "acceleration_{axis}"
    reference: str | None = "reference_{axis}"
    perturbation: str | None = "perturbation_{axis}"
    group: str | None = "group"
    trial: str | None = "trial"
    repetition: str | None = "repetition"
    phase: str | None = "phase"

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name in ("position", "force", "velocity", "acceleration", "reference", "perturbation"):
            template = getattr(self, name)
            if template is not None and "{axis}" not in template:
                raise ValueError(f"{name}: expected a column name with {{axis}} in it, got {template!r}")
        return self


class Units(Section):
    """Units of the columns as they stand in the file; everything inside is SI."""

    time: Literal["s", "ms", "us", "ns"] = "s"
    position: Literal["m", "cm", "mm"] = "m"
    velocity: Literal["m/s", "cm/s", "mm/s"] = "m/s"
    acceleration: Literal["m/s^2", "cm/s^2", "mm/s^2"] = "m/s^2"
    force: Literal["N", "mN", "kN"] = "N"

    def scale(self, quantity: Literal["time", "position", "velocity", "acceleration", "force"]) -> float:
        """Factor that turns a column of `quantity` into SI."""
        unit = str(getattr(self, quantity)).split("/")[0]
        return (LENGTH_UNITS | TIME_UNITS | FORCE_UNITS)[unit]


class Window(Section):
    """Part of each trial that is kept: start ≤ time < end, in the time [s] of the log after unit conversion."""

    start: float | None = None
    end: float | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.start is not None and self.end is not None and self.start >= self.end:
            raise ValueError(f"expected start < end, got start {self.start:g} s and end {self.end:g} s")
        return self


class LogConfig(Section):
    """How a recording maps onto an interaction log."""

    axes: tuple[Axis, ...] | None = Field(default=None, min_length=1)
    columns: Columns = Columns()
    units: Units = Units()
    force_direction: Literal["human_on_robot", "robot_on_human"] = "human_on_robot"
    window: Window = Window()
    delimiter: str | None = Field(default=None, min_length=1, max_length=1)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.axes is not None and len(set(self.axes)) != len(self.axes):
            raise ValueError(f"axes: expected each axis once, got {list(self.axes)}")
        return self


# --- preprocessing -------------------------------------------------------------------------------


class Smoother(Section):
    """Savitzky–Golay filter, applied alike to every measured channel (position, force, …)."""

    window: float = Field(default=0.1, gt=0)
    polynomial_order: int = Field(default=4, ge=3, le=7)


class PreprocessingConfig(Section):
    """From raw samples to position, velocity, acceleration and jerk on an even grid."""

    smoother: Smoother | None = Smoother()
    rate: float | None = Field(default=None, gt=0)
    max_gap: float = Field(default=0.5, gt=0)


# --- model ---------------------------------------------------------------------------------------


class LengthScales(Section):
    """Length scale for each kind of input, each in the unit of that input; one per axis component (ARD)."""

    time: Scale = _learned(0.5)
    phase: Scale = _learned(0.15)
    position: Scale = _learned(0.1)
    velocity: Scale = _learned(0.3)


class ImpedancePrior(Section):
    """Prior of damping or stiffness, a process over `input`; without inputs it is one constant a group.

    `log_gp`: log w ~ GP(log median, log_sd²); `gp`: w ~ GP(mean, sd²). `level` is that median or mean.
    """

    prior: Literal["log_gp", "gp"] = "log_gp"
    level: Scale
    log_sd: Scale | None = None
    sd: Scale | None = None
    input: tuple[Component, ...] = ()
    length_scale: LengthScales = LengthScales()

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
        _check_distinct(self.input)
        return self

    @property
    def scale(self) -> Hyperparameter:
        """`log_sd` [1] of a log_gp, `sd` [unit of the quantity] of a gp."""
        chosen = self.log_sd if self.prior == "log_gp" else self.sd
        return chosen if chosen is not None else Hyperparameter(median=0.3, log_sd=0.5)


class StiffnessPrior(ImpedancePrior):
    """Stiffness k [N/m]."""

    level: Scale = _learned(300.0)


class DampingPrior(ImpedancePrior):
    """Damping d [Ns/m]."""

    level: Scale = _learned(20.0)


class MassPrior(Section):
    """Mass m ~ N(level, sd²) [kg], one for each group."""

    level: Scale = _learned(1.5, 0.7)
    sd: Scale = Hyperparameter(median=0.3, fixed=True)


class DesiredTrajectoryPrior(Section):
    """Desired trajectory x_d ~ GP(mean, kernel over θ); `sd` [m]."""

    mean: TrajectoryMean = "equilibrium"
    kernel: ProfileName = "squared_exponential"
    sd: Scale = _learned(0.02)
    length_scale: LengthScales = LengthScales()
    shape: Scale = Hyperparameter(median=1.0, fixed=True)
    value: dict[Axis, float] | None = None
    average_knots: int = Field(default=6, ge=1, le=500)


class ResidualPrior(Section):
    """Residual force ũ ~ GP(0, SE(`sd`) over `input`) plus a constant offset a trial ~ N(0, `offset_sd`²) [N]."""

    sd: Scale = _learned(1.0)
    input: tuple[Component, ...] = ("position", "velocity")
    length_scale: LengthScales = LengthScales()
    offset_sd: Scale | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_distinct(self.input)
        if not self.input:
            raise ValueError("input: expected at least one of time, phase, position, velocity, got none")
        return self


def _check_distinct(components: Iterable[str]) -> None:
    listed = list(components)
    if len(set(listed)) != len(listed):
        raise ValueError(f"input: expected each component once, got {listed}")


class ModelConfig(Section):
    """Priors of every latent of u = Σ_j w_j e⁽ʲ⁾ + ũ + ε."""

    trajectory_input: TrajectoryInput = "time"
    drop_acceleration: bool = False
    desired_trajectory: DesiredTrajectoryPrior = DesiredTrajectoryPrior()
    stiffness: StiffnessPrior = StiffnessPrior()
    damping: DampingPrior = DampingPrior()
    mass: MassPrior = MassPrior()
    residual: ResidualPrior | None = ResidualPrior()
    noise_sd: Scale = _learned(0.2)

    @model_validator(mode="after")
    def _check(self) -> Self:
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


PerAxis = BeforeValidator(_number_means_every_axis)


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


# --- inference -----------------------------------------------------------------------------------


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


class Config(Section):
    """A whole configuration."""

    log: LogConfig = LogConfig()
    preprocessing: PreprocessingConfig = PreprocessingConfig()
    model: ModelConfig = ModelConfig()
    shared: SharedConfig = SharedConfig()
    device: DeviceConfig | None = None
    engine: EngineConfig = EngineConfig()
    training: TrainingConfig = TrainingConfig()
    baseline: BaselineConfig = BaselineConfig()


# --- loading -------------------------------------------------------------------------------------


def shipped_configurations() -> dict[str, Path]:
    """Name → file of the configurations that come with the package (`recordings/…` included)."""
    packaged = Path(str(resources.files("bayes_impedance"))) / "configs"
    # An editable install or a checkout keeps them at the top level of the repository.
    folder = packaged if packaged.is_dir() else Path(__file__).resolve().parent.parent / "configs"
    return {
        path.relative_to(folder).with_suffix("").as_posix(): path for path in sorted(folder.rglob("*.yaml"))
    }


def load_config(source: str | Path, overrides: Iterable[str] = ()) -> Config:
    """Configuration from a YAML file, or from the name of a shipped one, with KEY=VALUE overrides.

    Example:
        >>> config = load_config("phase", ["preprocessing.rate=50", "model.mass.level=1.2"])
        >>> config.preprocessing.rate, config.model.mass.level.fixed
        (50.0, True)

    Raises:
        ConfigurationError: names the file, the key and the nearest known key.
    """
    path = Path(source)
    if not path.is_file():
        shipped = shipped_configurations()
        name = str(source).removesuffix(".yaml")
        if name not in shipped:
            near = difflib.get_close_matches(name, shipped, n=1, cutoff=0.4)
            hint = f"did you mean {near[0]!r}?" if near else f"shipped are {', '.join(shipped)}."
            raise ConfigurationError(
                f"expected a YAML file or the name of a shipped configuration, found neither at '{source}'; {hint}"
            )
        path = shipped[name]
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: expected a readable UTF-8 YAML file, got: {error}") from error
    except UNREADABLE as error:
        raise ConfigurationError(f"{path}: expected YAML, got: {_one_line(error)}") from error
    return parse_config({} if content is None else content, str(path), overrides)


def parse_config(content: Any, where: str = "configuration", overrides: Iterable[str] = ()) -> Config:
    """Configuration from plain mappings; `where` is named in errors.

    Example:
        >>> parse_config({"model": {"stifness": {"level": 300}}}, "arm.yaml")
        Traceback (most recent call last):
        ...
        bayes_impedance.errors.ConfigurationError: arm.yaml: unknown key 'model.stifness'; did you mean 'stiffness'?

    Raises:
        ConfigurationError: as `load_config` does.
    """
    if not isinstance(content, Mapping):
        raise ConfigurationError(f"{where}: expected a mapping of sections, got {type(content).__name__}")
    config = _validate(content, where)
    assignments = list(overrides)
    if not assignments:
        return config
    changed = config.model_dump(mode="json")
    for assignment in assignments:
        changed = _override(changed, assignment)
    # All at once: prior=gp and its sd, say, are only valid together.
    return _validate(changed, " ".join(f"--set {assignment}" for assignment in assignments))


def _validate(content: Mapping[str, Any], where: str) -> Config:
    try:
        return Config.model_validate(content)
    except ValidationError as error:
        raise ConfigurationError(f"{where}: {' '.join(_explain(error).split())}") from error


def replace_value(config: Config, key: str, value: Any) -> Config:
    """`config` with another value at a dotted key.

    Raises ConfigurationError as load_config does.
    """
    return _validate(_assign(config.model_dump(mode="json"), key.split("."), value), key)


def dump_config(config: Config) -> str:
    """The whole configuration, defaults included, as YAML."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def _override(content: dict[str, Any], assignment: str) -> dict[str, Any]:
    """`content` with dotted KEY=VALUE set; the value is read as YAML."""
    key, equals, text = assignment.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise ConfigurationError(f"--set: expected KEY=VALUE such as training.restarts=5, got {assignment!r}")
    try:
        value = yaml.safe_load(text)
    except UNREADABLE as error:
        raise ConfigurationError(f"--set {key}: expected a YAML value, got {text!r}") from error
    return _assign(content, parts, value)


def _assign(content: dict[str, Any], parts: Sequence[str], value: Any) -> dict[str, Any]:
    """`content` with `value` at the end of a path of keys."""
    level = content
    for part in parts[:-1]:
        # A section that is absent (null) opens up; an unknown one is refused by the validation that follows.
        if not isinstance(level.get(part), dict):
            level[part] = {}
        level = level[part]
    level[parts[-1]] = value
    return content


def _explain(error: ValidationError) -> str:
    """The first problem of a pydantic error in one sentence, with the nearest known key where one is unknown."""
    problems = error.errors(include_url=False)
    # A misspelt key also leaves the right one missing: the spelling is the cause to name.
    problem = next((p for p in problems if p["type"] == "extra_forbidden"), problems[0])
    location = [str(part) for part in problem["loc"]]
    key = ".".join(location)
    if problem["type"] == "extra_forbidden":
        known = _known_keys(location[:-1])
        near = difflib.get_close_matches(location[-1], known, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}?" if near else f"known here: {', '.join(known)}."
        return f"unknown key '{key}'; {hint}"
    if problem["type"] == "missing":
        return f"missing key '{key}'"
    if problem["type"] == "model_type":
        number = "a number or " if problem["ctx"]["class_name"] == Hyperparameter.__name__ else ""
        return f"{key}: expected {number}a mapping of keys to values, got {problem['input']!r}"
    if problem["type"] == "dict_type":
        return f"{key}: expected a mapping of axes to numbers, such as {{x: 1.0, y: 2.0}}, got {problem['input']!r}"
    message = re.sub(r"^Value error, ", "", problem["msg"])
    message = message[:1].lower() + message[1:]
    if problem["type"] == "value_error":
        return f"{key}: {message}" if key else message
    return f"{key}: expected a valid value ({message}), got {problem['input']!r}"


def _known_keys(location: Iterable[str]) -> list[str]:
    """Names of the keys of the section at `location`."""
    section: type[BaseModel] = Config
    for part in location:
        if part not in section.model_fields:
            continue
        inner = _section_of(section.model_fields[part].annotation)
        if inner is None:
            return []
        section = inner
    return list(section.model_fields)


def _section_of(annotation: Any) -> type[BaseModel] | None:
    """The section class inside an annotation such as `Smoother | None` or `Annotated[Hyperparameter, …]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in get_args(annotation):
        found = _section_of(argument)
        if found is not None:
            return found
    return None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
