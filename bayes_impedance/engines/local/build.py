"""A local model for a force model and the motion that it was trained on."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray

from bayes_impedance.config import LocalConfig
from bayes_impedance.engines.compiled.numbers import KernelNumbers
from bayes_impedance.engines.local.grid import Grid, weights_of
from bayes_impedance.engines.local.model import LocalModel
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import FeatureMap
from bayes_impedance.kernels.impedance import InteractionKernel
from bayes_impedance.priors import ForceModel

Floats = NDArray[np.float64]

#: Most cells that a grid may have: their numbers must fit into 64 bits, with room to spare.
MOST = 2**53


def build_local(
    model: ForceModel, feature_map: FeatureMap, settings: LocalConfig, visited: Floats
) -> LocalModel:
    """Empty cells over the range of `visited` `(n, D)`, inputs of an axis, one cell more on every side.

    Raises:
        ConfigurationError: the model is none that local models hold, or the widths fit no grid.
    """
    kernel = model.kernel
    if not isinstance(kernel, InteractionKernel):
        raise ConfigurationError(
            "engine.name: expected model.axes: independent and an impedance model with local, got "
            f"{type(kernel).__name__}; set model.axes=independent, or engine.name=auto"
        )
    if kernel.motion_noise is not None:
        raise ConfigurationError(
            "model.position_noise_sd: expected null with local sparse models, whose samples are independent given the "
            "force, got a noise; set model.position_noise_sd=null"
        )
    numbers = KernelNumbers.of(kernel, feature_map.width)
    axes = len(feature_map.axes)
    with torch.no_grad():
        noise = model.noise_variance.expand(axes, 1, 1).reshape(axes).numpy().copy()
    widths = settings.width or _length_scales(model, feature_map)
    columns: list[int] = []
    width: list[float] = []
    for component, value in widths.items():
        own = feature_map.columns_of(component)
        if not own:
            known = ", ".join(dict.fromkeys((*feature_map.theta, *feature_map.xi)))
            raise ConfigurationError(
                f"engine.local.width: expected components that the model depends on ({known}), got {component}; remove "
                "it, or name another"
            )
        columns += own
        width += np.broadcast_to(value, len(own)).tolist()
    grid = _grid(visited, np.array(columns), np.array(width))
    return LocalModel(numbers, noise, grid, settings, feature_map.width)


def learn_log(local: LocalModel, inputs: Floats, residual: Floats) -> None:
    """Teach an empty model all samples of a log, inputs `(axes, n, D)` and u − E[u] `(axes, n)` [N].

    Raises:
        ConfigurationError: they visit more cells than there may be, so that some would be left out.
    """
    codes, _ = weights_of(local.grid, inputs[0], local.settings.active)
    needed = np.unique(codes[codes >= 0]).size
    if needed > local.settings.cells:
        raise ConfigurationError(
            f"engine.local.cells: expected at least {needed}, which the given motion visits, got "
            f"{local.settings.cells}; raise it, or widen cells with engine.local.width"
        )
    local.learn_all(inputs, residual)


def _grid(visited: Floats, columns: NDArray[np.int64], width: Floats) -> Grid:
    place = visited[:, columns]
    low, high = place.min(axis=0), place.max(axis=0)
    inner = np.floor((high - low) / width) + 1.0
    # Centred: the first and the last place visited lie inside of a cell, not at its border.
    lower = 0.5 * (low + high) - (0.5 * inner + 1.0) * width
    cells = inner + 2.0
    if math.prod(cells.tolist()) > MOST:
        raise ConfigurationError(
            f"engine.local.width: expected cells of which at most {MOST:g} cover the range of motion, got "
            f"{np.format_float_scientific(math.prod(cells.tolist()), 1)}; widen them"
        )
    return Grid(columns, lower, width, cells.astype(np.int64))


def _length_scales(model: ForceModel, feature_map: FeatureMap) -> Mapping[str, Floats]:
    """Of the desired trajectory, by component of θ; of axes that differ the shortest."""
    scales = model.kernel.impedance.trajectory.lengthscale.detach()
    size = len(feature_map.layout.theta)
    shortest = scales.expand(*scales.shape[:-1], size).reshape(-1, size).amin(0).numpy()
    found: dict[str, Floats] = {}
    start = 0
    for component in feature_map.theta:
        count = len(feature_map.columns_of(component))
        found[component] = shortest[start : start + count]
        start += count
    return found
