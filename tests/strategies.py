"""Hypothesis strategies: configurations, valid and mutilated; recordings as files, valid and mutilated; whole cases."""

from __future__ import annotations

import copy
import io
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
import yaml
from hypothesis import strategies as st

from bayes_impedance.config import Config, Hyperparameter, LengthScales, Section

Content = dict[str, Any]
Draw = Callable[[st.SearchStrategy[Any]], Any]


def keys(section: type[Section], prefix: str = "") -> set[str]:
    """Dotted keys of the schema; a hyperparameter, its length scales and a section that is absent count as one."""
    found = set()
    for name, entry in section.model_fields.items():
        inner = [
            kind
            for kind in (entry.annotation, *getattr(entry.annotation, "__args__", ()))
            if isinstance(kind, type) and issubclass(kind, Section)
        ]
        absent = entry.default is None
        if inner and not absent and not issubclass(inner[0], (Hyperparameter, LengthScales)):
            found |= keys(inner[0], f"{prefix}{name}.")
        else:
            found.add(prefix + name)
    return found


# --- configurations ------------------------------------------------------------------------------

positive = st.floats(1e-6, 1e6)
hyperparameters = st.one_of(
    positive,
    st.fixed_dictionaries(
        {"median": positive}, optional={"log_sd": st.floats(0.01, 5), "fixed": st.booleans()}
    ),
)
components = st.lists(st.sampled_from(["time", "phase", "position", "velocity"]), unique=True)
length_scales = st.fixed_dictionaries(
    {}, optional=dict.fromkeys(("time", "phase", "position", "velocity"), hyperparameters)
)
templates = st.text(st.characters(codec="utf-8"), max_size=5).map(lambda text: text + "{axis}")

by_axis = st.one_of(positive, st.dictionaries(st.sampled_from("xyz"), positive))
devices = st.fixed_dictionaries(
    {"mass": by_axis, "damping": by_axis}, optional={"acceleration": st.sampled_from(["law", "measured"])}
)


@st.composite
def impedance_priors(draw):
    prior = draw(st.sampled_from(["log_gp", "gp"]))
    content = {"prior": prior, "level": draw(hyperparameters), "input": draw(components)}
    content["length_scale"] = draw(length_scales)
    if prior == "gp":
        content["sd"] = draw(hyperparameters)
    elif draw(st.booleans()):
        content["log_sd"] = draw(st.floats(0.01, 0.5))
    return content


@st.composite
def configurations(draw):
    """Plain content of a valid configuration."""
    theta = draw(st.sampled_from(["time", "phase", "position", "position_velocity"]))
    means = ["equilibrium", "reference", "constant"] + (["trial_average"] if theta == "phase" else [])
    start = draw(st.none() | st.floats(-10, 10))
    return {
        "log": {
            "axes": draw(st.none() | st.lists(st.sampled_from("xyz"), min_size=1, unique=True)),
            "columns": {
                "time": draw(st.text(st.characters(codec="utf-8"), max_size=8)),
                "position": draw(templates),
                "velocity": draw(st.none() | templates),
            },
            "units": {"time": draw(st.sampled_from(["s", "ms", "us", "ns"]))},
            "window": {"start": start, "end": None if start is None else start + 1},
            "delimiter": draw(st.none() | st.characters(codec="utf-8")),
        },
        "preprocessing": {
            "smoother": draw(st.none() | st.fixed_dictionaries({"polynomial_order": st.integers(3, 7)})),
            "rate": draw(st.none() | positive),
        },
        "model": {
            "trajectory_input": theta,
            "drop_acceleration": theta == "position_velocity" and draw(st.booleans()),
            "desired_trajectory": {
                "mean": draw(st.sampled_from(means)),
                "sd": draw(hyperparameters),
                "length_scale": draw(length_scales),
                "value": draw(st.none() | st.dictionaries(st.sampled_from("xyz"), st.floats(-5, 5))),
            },
            "stiffness": draw(impedance_priors()),
            "damping": draw(impedance_priors()),
            "residual": draw(
                st.none() | st.fixed_dictionaries({"sd": hyperparameters, "input": components.filter(bool)})
            ),
            "noise_sd": draw(hyperparameters),
        },
        "device": draw(st.none() | devices),
        "engine": {"jitter": draw(st.floats(0, 1e-3))},
        "training": {"seed": draw(st.integers(0, 2**70)), "restarts": draw(st.integers(1, 100))},
        "baseline": {"input": draw(st.none() | components.filter(bool))},
    }


# --- content of any kind -------------------------------------------------------------------------

names = st.one_of(
    st.sampled_from(sorted({part for key in keys(Config) for part in key.split(".")} | {"median", "log_sd"})),
    st.text(max_size=5),
)
scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=8),
    st.binary(max_size=4),
    st.dates(),
    st.sampled_from(["time", "phase", "gp", "x", "trial_average", "{axis}", "1e-3"]),
)
yamlish = st.recursive(
    scalars,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(st.one_of(names, st.integers(), st.none()), inner, max_size=4),
    ),
    max_leaves=12,
)


def sections(section: type[Section] = Config) -> st.SearchStrategy:
    """Content with known keys in their places and anything at all as values."""
    inner = {}
    for name, entry in section.model_fields.items():
        kinds = [
            kind
            for kind in (entry.annotation, *getattr(entry.annotation, "__args__", ()))
            if isinstance(kind, type) and issubclass(kind, Section)
        ]
        inner[name] = st.one_of(yamlish, sections(kinds[0])) if kinds else yamlish
    return st.fixed_dictionaries({}, optional=inner)


# --- configurations that suit a recording, and mutilated ones ------------------------------------


def scales(typical: float) -> st.SearchStrategy[Any]:
    """A hyperparameter around its typical value, now and then far from it, fixed or learned."""
    usual = [typical] * 30 + [factor * typical for factor in (0.1, 0.3, 3.0, 10.0)] * 5
    median = st.sampled_from([*usual, 1e-300, 1e-30, 1e-4, 1e4, 1e30])
    log_sd = st.sampled_from([0.01, 0.5, 2.0, 5.0])
    learned = st.fixed_dictionaries({"median": median}, optional={"log_sd": log_sd})
    # The more there is to learn, the longer training takes.
    return st.one_of(median, median, median, learned)


LENGTHS = st.fixed_dictionaries(
    {"time": scales(0.5), "phase": scales(0.15), "position": scales(0.1), "velocity": scales(0.3)},
)
kinds = st.sampled_from(["time", "phase", "position", "velocity"])
inputs = st.lists(kinds, max_size=2, unique=True)
some_inputs = st.lists(kinds, min_size=1, max_size=2, unique=True)


@st.composite
def plausible_configurations(draw: Draw) -> Content:
    """Content that suits the recordings of `tables`, with every choice that the model knows."""
    theta = draw(st.sampled_from(["time", "phase", "position", "position_velocity"]))
    means = ["equilibrium", "reference", "constant"] + (["trial_average"] if theta == "phase" else [])
    model: Content = {"trajectory_input": theta}
    trajectory = model["desired_trajectory"] = {"mean": draw(st.sampled_from(means)), "average_knots": 2}
    options: dict[str, st.SearchStrategy[Any]] = {
        "kernel": st.sampled_from(
            ["squared_exponential", "rational_quadratic", "matern52", "matern72", "matern92"]
        ),
        "shape": scales(1.0),
        "value": st.dictionaries(st.sampled_from("xyz"), st.floats(-1, 1) | st.sampled_from([1e155, -1e300])),
        "average_knots": st.sampled_from([1, 2, 3, 6, 500]),
    }
    required: dict[str, st.SearchStrategy[Any]] = {"sd": scales(0.02), "length_scale": LENGTHS}
    trajectory |= draw(st.fixed_dictionaries(required, optional=options))
    for name, typical in (("stiffness", 300.0), ("damping", 20.0)):
        gaussian = draw(st.sampled_from([False, False, True]))
        required = {"level": scales(typical), "length_scale": LENGTHS}
        if gaussian:
            required |= {"prior": st.just("gp"), "sd": scales(typical / 10)}
        else:
            required["log_sd"] = st.floats(0.01, 0.5)
        model[name] = draw(st.fixed_dictionaries(required, optional={"input": inputs}))
    model["noise_sd"] = draw(scales(0.2))
    residual = st.fixed_dictionaries(
        {"sd": scales(1.0), "length_scale": LENGTHS},
        optional={"offset_sd": scales(0.5), "input": some_inputs},
    )
    model["residual"] = draw(st.none() | residual)
    whole: dict[str, st.SearchStrategy[Any]] = {
        "mass": st.fixed_dictionaries({}, optional={"level": scales(1.5), "sd": scales(0.3)}),
    }
    if theta == "position_velocity":
        whole["drop_acceleration"] = st.booleans()
    model |= draw(st.fixed_dictionaries({}, optional=whole))
    smoother = {
        "window": st.sampled_from([0.02, 0.1, 0.1, 0.2, 0.2, 0.3, 30.0, 1e300, 1e-320]),
        "polynomial_order": st.integers(3, 7),
    }
    segmentation = {
        "trim_rest": st.booleans(),
        "split": st.sampled_from(["none", "rest", "return"]),
        "gaps": st.sampled_from(["refuse", "split"]),
        "rest_speed": st.sampled_from([1e-320, 0.005, 0.1, 1e300]),
        "rest_duration": st.sampled_from([1e-320, 0.1, 0.3, 1e300]),
        "return_radius": st.sampled_from([1e-320, 0.02, 0.1, 1e300]),
        "minimum_duration": st.sampled_from([1e-320, 0.1, 0.5, 1e300]),
    }
    phase = {
        "source": st.sampled_from(["column", "path", "warping"]),
        "rest_speed": st.sampled_from([1e-320, 0.002, 0.1, 1e300]),
        "knots": st.sampled_from([1, 8, 100]),
    }
    preprocessing = {
        "segmentation": st.just({}) | st.fixed_dictionaries({}, optional=segmentation),
        "phase": st.just({}) | st.fixed_dictionaries({}, optional=phase),
        "smoother": st.none() | st.fixed_dictionaries({}, optional=smoother),
        "rate": st.sampled_from([None, None, None, 5, 10, 10, 20, 1e-6, 1e-320, 1e300]),
        "max_gap": st.sampled_from([0.04, 0.5, 0.5, 1.0, 1e9, 1e300, 1e-320]),
    }
    log = {
        "axes": st.sampled_from([None] * 8 + [["x"], ["y", "x"], ["z"]]),
        "units": st.fixed_dictionaries(
            {},
            optional={
                "time": st.sampled_from(["s", "s", "ms", "ns"]),
                "position": st.sampled_from(["m", "mm"]),
            },
        ),
        "force_direction": st.sampled_from(["human_on_robot", "robot_on_human"]),
        "window": st.sampled_from(
            [
                {},
                {},
                {},
                {"start": 0.1},
                {"end": 0.5},
                {"start": 0.3, "end": 0.31},
                {"start": 1e9},
                {"start": -1e300, "end": 1e300},
            ]
        ),
        "columns": st.sampled_from(
            [{}, {"velocity": None, "acceleration": None}, {"phase": None}, {"trial": "group"}]
        ),
        "delimiter": st.sampled_from([None] * 8 + [",", ";", "\t", " "]),
    }
    sections = {
        "preprocessing": st.fixed_dictionaries({}, optional=preprocessing),
        "log": st.fixed_dictionaries({}, optional=log),
        "shared": st.fixed_dictionaries(
            {},
            optional={"desired_trajectory": st.sampled_from([None, True, False]), "residual": st.booleans()},
        ),
        "engine": st.fixed_dictionaries(
            {},
            optional={
                "jitter": st.sampled_from([0, 1e-12, 1e-6, 1e-3]),
                "max_samples": st.sampled_from([2, 30, 100, 1000, 4000]),
            },
        ),
        "training": st.fixed_dictionaries(
            {},
            optional={
                "seed": st.integers(0, 2**70),
                "gradient_tolerance": st.sampled_from([1e-320, 1e-3, 1e300]),
            },
        ),
        "baseline": st.fixed_dictionaries({}, optional={"input": st.none() | some_inputs}),
    }
    return {"model": model} | draw(st.fixed_dictionaries({}, optional=sections))


def _places(content: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    if not isinstance(content, dict):
        return [at]
    return [at, *(place for key in content for place in _places(content[key], (*at, key)))]


@st.composite
def configuration_files(draw: Draw, spoilt: bool) -> bytes:
    """Bytes of a YAML file: plausible, or with other values, keys or characters."""
    content: Any = copy.deepcopy(draw(plausible_configurations()))
    for _ in range(draw(st.integers(0, 2)) if spoilt else 0):
        place = draw(st.sampled_from(_places(content)))
        if not place:
            content = draw(yamlish)
            continue
        inner = content
        for key in place[:-1]:
            inner = inner[key]
        match draw(st.sampled_from(["replace", "remove", "add", "nest"])):
            case "replace":
                inner[place[-1]] = draw(yamlish)
            case "remove":
                del inner[place[-1]]
            case "add":
                inner[draw(st.one_of(names, scalars.filter(_hashable)))] = draw(yamlish)
            case "nest":
                inner[place[-1]] = [[[inner[place[-1]]]]]
        if not isinstance(content, dict):
            break
    data = yaml.dump(content, allow_unicode=draw(st.booleans())).encode("utf-8", "replace")
    return draw(noisy(data)) if spoilt and draw(st.integers(0, 3)) == 0 else data


def _hashable(value: Any) -> bool:
    return not (isinstance(value, float) and math.isnan(value))


@st.composite
def noisy(draw: Draw, data: bytes) -> bytes:
    """Bytes with some cut out, put in or torn off the end."""
    at = draw(st.integers(0, len(data)))
    match draw(st.sampled_from(["cut", "insert", "tear", "flip"])):
        case "cut":
            return data[:at] + data[at + draw(st.integers(1, 20)) :]
        case "insert":
            return data[:at] + draw(st.binary(min_size=1, max_size=6)) + data[at:]
        case "tear":
            return data[:at]
        case _:
            return data[:at] + bytes(255 - byte for byte in data[at : at + 1]) + data[at + 1 :]


# --- recordings ----------------------------------------------------------------------------------


@st.composite
def recordings(draw: Draw) -> pd.DataFrame:
    """A valid recording: one or two trials of one or two repetitions, with every column or only the needed ones."""
    axes = draw(st.sampled_from(["x", "xy"]))
    random = np.random.default_rng(draw(st.integers(0, 2**16)))
    samples, repetitions = draw(st.integers(8, 16)), draw(st.integers(1, 2))
    every = draw(st.booleans())
    parts = []
    for trial in range(draw(st.integers(1, 2))):
        n = samples * repetitions
        time = np.arange(n) * 0.05
        phase = np.tile(np.linspace(0.0, 1.0, samples), repetitions)
        columns: dict[str, Any] = {
            "trial": trial,
            "time": time,
            "repetition": np.repeat(range(repetitions), samples),
        }
        columns["phase"] = phase
        for axis in axes:
            amplitude, shift = random.uniform(0.02, 0.2), random.uniform(0, 6)
            turn = 2 * np.pi / (samples * 0.05)
            path = amplitude * np.sin(turn * time + shift)
            columns[f"position_{axis}"] = path + random.normal(0, 0.005, n)
            columns[f"force_{axis}"] = random.normal(0, 2, n) + 100 * (path - columns[f"position_{axis}"])
            if every:
                columns[f"velocity_{axis}"] = amplitude * turn * np.cos(turn * time + shift)
                columns[f"acceleration_{axis}"] = -(turn**2) * path
                columns[f"perturbation_{axis}"] = random.normal(0, 1, n)
            columns[f"reference_{axis}"] = path
        if every:
            columns |= {"group": "right", "stiffness_xx": 200.0}
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


#: What stands in a cell that should hold an ordinary number.
CELLS = (
    np.nan, np.inf, -np.inf, "", " ", "text", "1,5", "1_0", "0x10", "1e400", "-1e-400", 1e300, -1e300, 1e155, 5e-324,
    1e18, 0.0, -0.0, -1.0, 2.0, True, "NA", "None", "=1+1", '"', "ü", "x" * 2000, "1e5", "٣", "∞", "2021-01-01",
)  # fmt: skip


@st.composite
def mutilated(draw: Draw, table: pd.DataFrame) -> pd.DataFrame:
    """The recording with one thing wrong with it, or odd about it."""
    table = table.copy()
    if table.empty or table.columns.has_duplicates:
        return table
    column = draw(st.sampled_from(list(table.columns)))
    first, second = draw(st.integers(0, len(table) - 1)), draw(st.integers(0, len(table) - 1))
    low, high = min(first, second), max(first, second) + 1
    match draw(st.sampled_from(MUTILATIONS)):
        case "drop column":
            return table.drop(columns=column)
        case "cell":
            table[column] = table[column].astype(object)
            table.loc[first, column] = draw(st.sampled_from(CELLS))
        case "cells":
            table[column] = table[column].astype(object)
            table.loc[low : high - 1, column] = draw(st.sampled_from(CELLS))
        case "constant":
            table[column] = draw(st.sampled_from(CELLS))
        case "scale":
            factor = draw(st.sampled_from([-1.0, 0.0, 1e-300, 1e-160, 1e-9, 1e3, 1e9, 1e100, 1e155, 1e200]))
            if pd.api.types.is_numeric_dtype(table[column]):
                table[column] = table[column].astype(float) * factor
        case "offset":
            if pd.api.types.is_numeric_dtype(table[column]):
                table[column] = table[column].astype(float) + draw(st.sampled_from([-0.5, 1e4, 1.7e9, 1e17]))
        case "duplicate rows":
            return pd.concat([table.iloc[:high], table.iloc[low:]], ignore_index=True)
        case "reverse rows":
            return table.iloc[::-1].reset_index(drop=True)
        case "shuffle rows":
            return table.sample(frac=1.0, random_state=first).reset_index(drop=True)
        case "cut rows":
            return table.iloc[low:high].reset_index(drop=True)
        case "gap":
            return table.drop(index=range(low, high)).reset_index(drop=True)
        case "rename":
            return table.rename(
                columns={column: draw(st.one_of(st.text(max_size=8), st.sampled_from(list(table.columns))))}
            )
        case "duplicate column":
            return pd.concat([table, table[[column]].iloc[:, :1]], axis=1)
        case "labels":
            column = draw(st.sampled_from(["trial", "repetition", "group"]))
            labels = draw(
                st.lists(st.sampled_from(["a", "b", "", "1.0", "1", "é", "../x", "[red]"]), min_size=1)
            )
            table[column] = [labels[index * len(labels) // len(table)] for index in range(len(table))]
        case "types":
            table[column] = table[column].astype(draw(st.sampled_from(["object", "string", "category"])))
    return table


MUTILATIONS = (
    "drop column", "cell", "cells", "constant", "scale", "offset", "duplicate rows", "reverse rows", "shuffle rows",
    "cut rows", "gap", "rename", "duplicate column", "labels", "types",
)  # fmt: skip


@dataclass(frozen=True)
class File:
    """A file to be written."""

    name: str
    content: bytes = field(repr=False)


@st.composite
def tables(draw: Draw, spoilt: bool) -> File:
    """A recording as the bytes of a file: valid, or mutilated as a table, as text or as bytes."""
    table = draw(recordings())
    for _ in range(draw(st.integers(0, 3)) if spoilt else 0):
        table = draw(mutilated(table))
    suffixes = [".csv", ".csv", ".tsv", ".txt", ".parquet", ".CSV", ".pq"] + [".xlsx"] * spoilt
    suffix = draw(st.sampled_from(suffixes))
    if suffix in (".parquet", ".pq"):
        data = _parquet(table)
    else:
        data = draw(_texts(table, {".tsv": "\t", ".txt": " "}.get(suffix, ","), spoilt))
    if spoilt and draw(st.integers(0, 5)) == 0:
        data = draw(noisy(data))
    return File(f"log{suffix}", data)


def _parquet(table: pd.DataFrame) -> bytes:
    buffer = io.BytesIO()
    try:
        table.to_parquet(buffer, index=False)
    except Exception:
        # Columns of one name, or of several types, are for text files only.
        return b"PAR1"
    return buffer.getvalue()


@st.composite
def _texts(draw: Draw, table: pd.DataFrame, delimiter: str, spoilt: bool) -> bytes:
    if spoilt and draw(st.integers(0, 5)) == 0:
        delimiter = draw(st.sampled_from([";", "\t", " ", "|", ", "]))
    text = table.to_csv(
        sep=delimiter[:1],
        index=False,
        lineterminator=draw(st.sampled_from(["\n", "\n", "\r\n", "\r"])),
        quoting=draw(st.sampled_from([0, 0, 0, 1, 2])),
        float_format=draw(st.sampled_from([None, None, None, "%.3f", "%.17e"])),
    )
    encodings = ["utf-8", "utf-8", "utf-8-sig"] + ["utf-16", "latin-1"] * spoilt
    encoding = draw(st.sampled_from(encodings))
    if spoilt and draw(st.integers(0, 4)) == 0:
        lines = text.split("\n")
        at = draw(st.integers(0, len(lines) - 1))
        lines[at] = draw(
            st.sampled_from([lines[at] + ",", lines[at][:5], "", "# comment", lines[0], '"' + lines[at]])
        )
        text = "\n".join(lines)
    return text.encode(encoding, "replace")


# --- cases ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """What a user brings along: a configuration, changes of it, a recording to train on and another one."""

    config: bytes
    overrides: tuple[str, ...]
    log: File
    other: File
    baseline: bool


@st.composite
def cases(draw: Draw) -> Case:
    """Everything that the commands can be given: nothing is wrong with some, one thing or all with the others."""
    wrong = draw(
        st.sampled_from(["nothing"] * 6 + ["recording"] * 3 + ["configuration", "override", "everything"])
    )
    anything = st.builds("{}={}".format, st.sampled_from(sorted(keys(Config))), st.text(max_size=8))
    log = draw(tables(wrong in ("recording", "everything")))
    other = draw(tables(draw(st.booleans()))) if draw(st.booleans()) else log
    config = draw(configuration_files(wrong in ("configuration", "everything")))
    overrides = (draw(anything),) if wrong == "override" else ()
    return Case(config, overrides, log, other, draw(st.booleans()))
