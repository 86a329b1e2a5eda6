"""A whole configuration from YAML, refused in one sentence where it is malformed."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Self, get_args

import yaml
from pydantic import BaseModel, ValidationError, model_validator

from bayes_impedance.config.inference import (
    BaselineConfig,
    EngineConfig,
    SamplingConfig,
    TrainingConfig,
)
from bayes_impedance.config.log import LogConfig
from bayes_impedance.config.model import DeviceConfig, ModelConfig, SharedConfig
from bayes_impedance.config.preprocessing import PreprocessingConfig
from bayes_impedance.config.sections import Hyperparameter, Section
from bayes_impedance.errors import ConfigurationError

#: What PyYAML raises at a text that it cannot turn into values (13 months, a thousand brackets).
UNREADABLE = (yaml.YAMLError, ValueError, RecursionError)


class Config(Section):
    """A whole configuration."""

    log: LogConfig = LogConfig()
    preprocessing: PreprocessingConfig = PreprocessingConfig()
    model: ModelConfig = ModelConfig()
    shared: SharedConfig = SharedConfig()
    device: DeviceConfig | None = None
    engine: EngineConfig = EngineConfig()
    training: TrainingConfig = TrainingConfig()
    sampling: SamplingConfig = SamplingConfig()
    baseline: BaselineConfig = BaselineConfig()

    @model_validator(mode="after")
    def _check(self) -> Self:
        for complaint in (_moments_only(self), _map_only(self)):
            if complaint is not None:
                raise ValueError(complaint)
        return self


def _map_only(config: Config) -> str | None:
    """What only impedance as a function can have."""
    if config.engine.impedance == "map":
        return None
    if config.model.mass.input:
        return (
            "model.mass.input: expected no input with engine.impedance: moments, whose mass is one number a group, got "
            f"{', '.join(config.model.mass.input)}; set engine.impedance=map, or model.mass.input=[]"
        )
    if config.model.desired_trajectory.periodic:
        return (
            "model.desired_trajectory.periodic: expected false with engine.impedance: moments, whose kernel has two "
            "ends, got true; set engine.impedance=map, or model.desired_trajectory.periodic=false"
        )
    return None


def _moments_only(config: Config) -> str | None:
    """What only impedance that is integrated out can have."""
    if config.engine.impedance == "moments":
        return None
    for name in ("stiffness", "damping"):
        prior = getattr(config.model, name).prior
        if prior != "log_gp":
            return (
                f"model.{name}.prior: expected log_gp with engine.impedance: map, which keeps impedance positive, got "
                f"{prior}; set model.{name}.prior=log_gp"
            )
    if config.model.position_noise_sd is not None:
        return (
            "model.position_noise_sd: expected null with engine.impedance: map, which takes the recorded motion as it "
            "is, got a noise; set model.position_noise_sd=null, or engine.impedance=moments"
        )
    return None


def shipped_configurations() -> dict[str, Path]:
    """Name → file of the configurations that come with the package (`recordings/…` included)."""
    packaged = Path(str(resources.files("bayes_impedance"))) / "configs"
    # An editable install or a checkout keeps them at the top level of the repository.
    folder = packaged if packaged.is_dir() else Path(__file__).resolve().parents[2] / "configs"
    return {
        path.relative_to(folder).with_suffix("").as_posix(): path for path in sorted(folder.rglob("*.yaml"))
    }


def load_config(source: str | Path, overrides: Iterable[str] = ()) -> Config:
    """Configuration from a YAML file, or from the name of a shipped one, with KEY=VALUE overrides.

    `extends: NAME` in a file takes every key that the file does not set from another one: a file beside it or a
    shipped configuration.

    Example:
        >>> config = load_config("phase", ["preprocessing.rate=50", "model.mass.level=1.2"])
        >>> config.preprocessing.rate, config.model.mass.level.fixed
        (50.0, True)

    Raises:
        ConfigurationError: names the file, the key and the nearest known key.
    """
    path = _found(source)
    return parse_config(_content(path, ()), str(path), overrides)


def _found(source: str | Path, beside: Path = Path()) -> Path:
    """A file, looked for in the folder `beside`, or the shipped configuration of that name."""
    path = beside / source
    if path.is_file():
        return path
    shipped = shipped_configurations()
    name = str(source).removesuffix(".yaml")
    if name not in shipped:
        near = difflib.get_close_matches(name, shipped, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"shipped are {', '.join(shipped)}."
        raise ConfigurationError(
            f"expected a YAML file or the name of a shipped configuration, found neither at '{source}'; {hint}"
        )
    return shipped[name]


def _content(path: Path, inner: tuple[Path, ...]) -> Any:
    """What stands in a file, on top of what the file extends."""
    if path.resolve() in inner:
        raise ConfigurationError(
            f"{path}: expected a chain of extends that ends, got one that comes back to this file; mend extends"
        )
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: expected a readable UTF-8 YAML file, got: {error}") from error
    except UNREADABLE as error:
        raise ConfigurationError(f"{path}: expected YAML, got: {_one_line(error)}") from error
    content = {} if content is None else content
    if not isinstance(content, Mapping) or "extends" not in content:
        return content
    own = {key: value for key, value in content.items() if key != "extends"}
    if not isinstance(content["extends"], str):
        raise ConfigurationError(
            f"{path}: extends: expected the name of one configuration, got {content['extends']!r}"
        )
    return _merged(_content(_found(content["extends"], path.parent), (*inner, path.resolve())), own)


def _merged(below: Any, above: Any) -> Any:
    """Mappings joined key by key; of anything else the one `above`."""
    if not isinstance(below, Mapping) or not isinstance(above, Mapping):
        return above
    return {**below, **{key: _merged(below.get(key), value) for key, value in above.items()}}


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
    return override_config(_validate(content, where), overrides)


def override_config(config: Config, overrides: Iterable[str]) -> Config:
    """`config` with KEY=VALUE overrides.

    Raises:
        ConfigurationError: as `load_config`.
    """
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


def as_functions(config: Config) -> Config:
    """`config` with impedance as a function, which is what the likelihood given impedance takes.

    Raises:
        ConfigurationError: its priors do not allow that.
    """
    if config.engine.impedance == "map":
        return config
    content = config.model_dump(mode="json")
    content["engine"] |= {"impedance": "map", "name": "auto"}
    return _validate(content, "sampling, which takes engine.impedance: map")


def dump_config(config: Config) -> str:
    """The whole configuration, defaults included, as YAML."""
    return as_yaml(config.model_dump(mode="json"))


def as_yaml(content: Mapping[str, Any]) -> str:
    """Plain mappings as the text of a configuration."""
    return yaml.safe_dump(dict(content), sort_keys=False)


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
