"""A trained model as a folder: YAML, JSON and safetensors, no pickle; loading gives the same bits.

The folder holds

    config.yaml                   the whole configuration
    hyperparameters.safetensors   unconstrained hyperparameters, by name
    data.safetensors              the prepared training log
    functions.safetensors         impedance functions and their covariance, where impedance is a function
    metadata.json                 schema and package version, training report, fingerprints
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from bayes_impedance.config import Config, dump_config, load_config
from bayes_impedance.engines.choice import EngineChoice
from bayes_impedance.errors import BayesImpedanceError, ModelFolderError
from bayes_impedance.features import FeatureMap
from bayes_impedance.impedance_functions.train import FittedFunctions, expected_sizes
from bayes_impedance.model import Fit, ImpedanceModel
from bayes_impedance.outputs import whole_folder
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import ForceModel, build_force_model
from bayes_impedance.training import RestartReport, TrainingReport

Array = NDArray[np.float64]

SCHEMA_VERSION = 1
METADATA = "metadata.json"
FILES = ("config.yaml", "hyperparameters.safetensors", "data.safetensors")
#: Only where impedance is a function.
FUNCTIONS = "functions.safetensors"


def save_model(model: ImpedanceModel, folder: str | Path) -> None:
    """Write a fitted model to `folder`, whole or not at all; a model that was there is replaced.

    Example:
        >>> from bayes_impedance.simulation.generative import draw_force, repeated_motion
        >>> model = ImpedanceModel.from_config("phase", ["training.restarts=1", "training.max_iterations=1"])
        >>> log = draw_force(model.config, repeated_motion(repetitions=2, duration=2.0, rate=10.0), seed=0)
        >>> model = model.fit(log)
        >>> save_model(model, "model")
        >>> sorted(path.suffix for path in Path("model").iterdir())
        ['.json', '.safetensors', '.safetensors', '.yaml']

    Raises:
        OutputError: the folder cannot be written.
        ConfigurationError: the model is not fitted.
    """
    fit = model.fitted
    with whole_folder(Path(folder), METADATA) as place:
        (place / "config.yaml").write_text(dump_config(model.config), encoding="utf-8")
        tensors = {entry.name: entry.raw.detach().numpy() for entry in fit.force_model.entries}
        arrays = {name: np.ascontiguousarray(values) for name, values in fit.log.arrays().items()}
        # Not save_file: a full disk is no OSError there.
        (place / "hyperparameters.safetensors").write_bytes(save(tensors))
        (place / "data.safetensors").write_bytes(save(arrays))
        files = list(FILES)
        if fit.functions is not None:
            (place / FUNCTIONS).write_bytes(save(_function_arrays(fit.functions)))
            files.append(FUNCTIONS)
        metadata = {
            "schema_version": SCHEMA_VERSION,
            "package_version": version("bayes-impedance"),
            "log": fit.log.header(),
            "data_fingerprint": fit.log.fingerprint(),
            "report": _finite_or_null(asdict(fit.report)),
            "functions": None if fit.functions is None else _function_header(fit.functions),
            "files": {name: _digest(place / name) for name in files},
        }
        (place / METADATA).write_text(
            json.dumps(metadata, indent=2, allow_nan=False) + "\n", encoding="utf-8"
        )


def load_model(folder: str | Path) -> ImpedanceModel:
    """The model that `save_model` wrote, predicting the same to the last bit.

    Example:
        >>> from bayes_impedance.simulation.generative import draw_force, repeated_motion
        >>> model = ImpedanceModel.from_config("phase", ["training.restarts=1", "training.max_iterations=1"])
        >>> log = draw_force(model.config, repeated_motion(repetitions=2, duration=2.0, rate=10.0), seed=0)
        >>> model = model.fit(log)
        >>> save_model(model, "model")
        >>> before, after = (m.posterior(log)["force"].mean for m in (model, load_model("model")))
        >>> bool((before == after).all())
        True

    Raises:
        ModelFolderError: the folder is missing, incomplete, changed, or of a newer schema.
    """
    place = Path(folder)
    metadata = _metadata(place)
    expected = (*FILES, FUNCTIONS) if metadata.get("functions") else FILES
    for name in expected:
        if not (place / name).is_file():
            raise ModelFolderError(
                f"{place}: expected the files {', '.join(expected)}, found no {name}; copy the whole folder again, "
                "or train again"
            )
        if _digest(place / name) != metadata["files"].get(name):
            raise ModelFolderError(
                f"{place / name}: expected the content that training wrote, found it changed; restore it, or train "
                "again (settings are changed with train --config or --set)"
            )
    try:
        return _assemble(place, metadata)
    except (KeyError, TypeError, ValueError, SafetensorError, BayesImpedanceError) as error:
        raise ModelFolderError(
            f"{place}: expected a model folder of schema {SCHEMA_VERSION}, found inconsistent content "
            f"({error}); train again"
        ) from error


def _assemble(place: Path, metadata: Mapping[str, Any]) -> ImpedanceModel:
    config = load_config(place / "config.yaml")
    log = PreparedLog.from_arrays(metadata["log"], load_file(place / "data.safetensors"))
    if log.fingerprint() != metadata["data_fingerprint"]:
        raise ValueError("other names, groups or axes than those that were trained on")
    force_model = build_force_model(config, FeatureMap(config, log.axes))
    tensors = load_file(place / "hyperparameters.safetensors")
    for entry in force_model.entries:
        stored = torch.from_numpy(tensors[entry.name])
        if stored.shape != entry.raw.shape or stored.dtype != entry.raw.dtype:
            raise ValueError(f"{entry.name} of another shape or type")
        with torch.no_grad():
            entry.raw.copy_(stored)
    report: dict[str, Any] = metadata["report"]
    restarts = tuple(
        RestartReport(
            **{**item, **{k: tuple(_numbers(item[k], -math.inf)) for k in ("objective", "log_likelihood")}}
        )
        for item in report["restarts"]
    )
    lists: dict[str, Any] = {key: tuple(report[key]) for key in ("best", "log_likelihood", "objective")}
    lists["log_sd"] = {
        name: [_numbers(row, math.nan) for row in rows] for name, rows in report["log_sd"].items()
    }
    functions = None
    if metadata.get("functions"):
        functions = _functions(metadata["functions"], load_file(place / FUNCTIONS))
    _check_functions(config, force_model, functions)
    training = TrainingReport(**{**report, **lists, "restarts": restarts})
    return ImpedanceModel(config, Fit(force_model, log, training, functions))


def _check_functions(config: Config, model: ForceModel, functions: FittedFunctions | None) -> None:
    if (config.engine.impedance == "map") != (functions is not None):
        raise ValueError("engine.impedance: map without functions, or functions without it")
    if functions is None:
        return
    size, free = expected_sizes(config, model, functions)
    arrays = (functions.point, (size,)), (functions.covariance, (free, free))
    wrong = any(array.shape != shape or array.dtype != np.float64 for array, shape in arrays)
    if wrong or any(own is not None and own.dtype != torch.float64 for own in functions.inducing):
        raise ValueError("functions of another shape or type")


def _function_header(functions: FittedFunctions) -> dict[str, Any]:
    return {
        "groups": list(functions.groups),
        "engine": {"name": functions.engine.name, "reason": functions.engine.reason},
        "inducing": [inducing is not None for inducing in functions.inducing],
    }


def _function_arrays(functions: FittedFunctions) -> dict[str, Array]:
    inducing = {f"inducing.{j}": own.numpy() for j, own in enumerate(functions.inducing) if own is not None}
    return {"point": functions.point, "covariance": np.ascontiguousarray(functions.covariance), **inducing}


def _functions(header: Mapping[str, Any], arrays: Mapping[str, Array]) -> FittedFunctions:
    inducing = tuple(
        torch.from_numpy(arrays[f"inducing.{j}"]) if there else None
        for j, there in enumerate(header["inducing"])
    )
    engine = EngineChoice(str(header["engine"]["name"]), str(header["engine"]["reason"]))
    groups = tuple(str(group) for group in header["groups"])
    return FittedFunctions(groups, arrays["point"], arrays["covariance"], inducing, engine)


def _metadata(place: Path) -> dict[str, Any]:
    if not place.is_dir():
        raise ModelFolderError(
            f"{place}: expected a model folder, found {'a file' if place.exists() else 'nothing'}; name the folder "
            "that `bayes-impedance train --out` wrote"
        )
    if not (place / METADATA).is_file():
        raise ModelFolderError(
            f"{place}: expected a model folder with {METADATA}, found none; name the folder that "
            "`bayes-impedance train --out` wrote"
        )
    try:
        metadata = json.loads((place / METADATA).read_text(encoding="utf-8"))
        schema = int(metadata["schema_version"])
        files = dict(metadata["files"])
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise ModelFolderError(
            f"{place / METADATA}: expected the JSON that training wrote, found it truncated or changed ({error}); "
            "copy the whole folder again, or train again"
        ) from error
    if schema > SCHEMA_VERSION:
        raise ModelFolderError(
            f"{place}: expected a model of schema {SCHEMA_VERSION} or older, found schema {schema}, written by "
            f"bayes_impedance {metadata.get('package_version', 'of unknown version')}; update bayes_impedance"
        )
    return {**metadata, "files": files}


def _finite_or_null(tree: Any) -> Any:
    """JSON has no NaN (a hyperparameter that is fixed or not determined) and no −∞ (a restart that failed)."""
    if isinstance(tree, Mapping):
        return {key: _finite_or_null(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [_finite_or_null(value) for value in tree]
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree


def _numbers(values: Sequence[float | None], null: float) -> list[float]:
    return [null if value is None else value for value in values]


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
