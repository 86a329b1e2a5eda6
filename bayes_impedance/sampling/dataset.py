"""Draws in the schema of ArviZ: groups of named dimensions, with units, as xarray and netCDF."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
import xarray
from numpy.typing import NDArray

from bayes_impedance.config import dump_config
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, TRAJECTORY_ORDER, Latent
from bayes_impedance.outputs import whole_file
from bayes_impedance.posterior.results import UNITS
from bayes_impedance.sampling.drawn import DrawnPosterior
from bayes_impedance.sampling.parameters import QUANTITIES, Parameter

Array = NDArray[np.float64]

#: Units of what a sampler says of its draws; the rest are numbers.
STAT_UNITS = {"lp": "nats", "energy": "nats"}


def as_tree(posterior: DrawnPosterior) -> xarray.DataTree:
    """Groups `posterior`, `posterior_predictive`, `sample_stats`, `observed_data` and `constant_data`.

    Dimensions are chain, draw, group, axis (and `axis_2` of matrices), phase (or time, or place), and sample of the
    log. Every variable has `units`; stiffness, damping and mass also their verdicts, axis by axis.
    """
    groups = {
        "posterior": _posterior(posterior),
        "posterior_predictive": _predictive(posterior),
        "sample_stats": _stats(posterior),
        "observed_data": _observed(posterior),
        "constant_data": _constant(posterior),
    }
    attributes = {
        "inference_library": "pyro",
        "inference_library_version": version("pyro-ppl"),
        "creation_library": "bayes-impedance",
        "creation_library_version": version("bayes-impedance"),
        "method": posterior.draws.method,
        "engine": str(posterior.engine),
        "configuration": dump_config(posterior.config),
        "recording": posterior.places.log.fingerprint()[:16],
        "diagnosis": json.dumps(posterior.diagnosis.as_dict()),
        "findings": "\n".join(posterior.diagnosis.findings),
    }
    chains, draws = posterior.draws.shape
    for name, data in groups.items():
        if "chain" in data.dims:
            groups[name] = data.assign_coords(chain=np.arange(chains), draw=np.arange(draws))
        groups[name].attrs |= {"inference_library": "pyro", "method": posterior.draws.method}
    return xarray.DataTree.from_dict({"/": xarray.Dataset(attrs=attributes), **groups})


def save_netcdf(posterior: DrawnPosterior, path: Path) -> None:
    """Write `as_tree`, whole or not at all.

    Raises:
        OutputError: the file cannot be written.
    """
    with whole_file(path) as temporary:
        # By way of memory: on a full disk HDF5 crashes.
        temporary.write_bytes(as_tree(posterior).to_netcdf(engine="h5netcdf"))


def _posterior(posterior: DrawnPosterior) -> xarray.Dataset:
    data = xarray.Dataset(coords=_place_coordinates(posterior))
    values = posterior.values()
    for parameter in posterior.parameters:
        data = data.assign(_site(posterior, parameter, values[parameter.name]))
    for latent in IMPEDANCE_ORDER:
        data[latent.value] = _impedance(posterior, latent)
    for latent in TRAJECTORY_ORDER:
        data[latent.value] = _by_place(posterior, posterior.at_places(latent), latent)
    data[Latent.RESIDUAL_FORCE.value] = _by_sample(posterior, Latent.RESIDUAL_FORCE)
    return data.assign_coords(_sample_coordinates(posterior))


def _site(posterior: DrawnPosterior, parameter: Parameter, values: Array) -> dict[str, xarray.DataArray]:
    """Draws `(chains, draws, *shape)` of a site; components of a hyperparameter as variables of their own."""
    if parameter.median is None:
        quantity = parameter.name.removesuffix("_weights")
        layout = ("chain", "draw", "group", f"{quantity}_entry", f"{quantity}_weight")
        named = {f"{quantity}_entry": posterior.entry_names()}
        weights = xarray.DataArray(values, dims=layout, coords=named, attrs={"units": "1"})
        return {parameter.name: weights}
    result = {}
    for c, (label, unit) in enumerate(zip(parameter.labels, parameter.units, strict=True)):
        name = f"{parameter.name}_{label}" if label and len(parameter.labels) > 1 else parameter.name
        own = values[..., c]
        dims = ("chain", "draw", "axis")
        if parameter.shape[0] == len(posterior.axes):
            result[name] = xarray.DataArray(own, dims=dims, attrs={"units": unit})
        else:
            result[name] = xarray.DataArray(own[..., 0], dims=dims[:2], attrs={"units": unit})
    return result


def _impedance(posterior: DrawnPosterior, latent: Latent) -> xarray.DataArray:
    """K, D or M at the places, or once where it is a constant: matrices where axes couple, else their diagonals."""
    values = posterior.matrices(latent)
    if not posterior.coupled:
        values = values.diagonal(axis1=-2, axis2=-1)
    said = [one for one in posterior.verdicts if one.verdict.latent is latent]
    attributes = {
        "units": UNITS[latent],
        "verdict": [one.verdict.support.value for one in said],
        "verdict_sentence": [one.verdict.sentence for one in said],
        "contraction": [one.verdict.contraction for one in said],
        "correlation_with_desired_trajectory_sd": [one.correlation for one in said],
        "prior_sensitivity": [one.sensitivity for one in said],
    }
    axes = ("axis", "axis_2") if posterior.coupled else ("axis",)
    if posterior.is_constant(latent):
        return xarray.DataArray(
            posterior.first_place(values), dims=("chain", "draw", "group", *axes), attrs=attributes
        )
    return xarray.DataArray(values, dims=(*_place_dims(posterior), *axes), attrs=attributes)


def _by_place(posterior: DrawnPosterior, values: Array, latent: Latent) -> xarray.DataArray:
    return xarray.DataArray(
        values, dims=(*_place_dims(posterior), "axis"), attrs={"units": UNITS[latent].replace("²", "^2")}
    )


def _by_sample(posterior: DrawnPosterior, latent: Latent) -> xarray.DataArray:
    return xarray.DataArray(
        posterior.at_samples(latent), dims=("chain", "draw", "sample", "axis"), attrs={"units": UNITS[latent]}
    )


def _predictive(posterior: DrawnPosterior) -> xarray.Dataset:
    force = _by_sample(posterior, Latent.FORCE)
    force.attrs["description"] = "a new measurement, noise included"
    return xarray.Dataset({"force": force}, coords=_sample_coordinates(posterior) | _axes(posterior))


def _stats(posterior: DrawnPosterior) -> xarray.Dataset:
    return xarray.Dataset(
        {
            name: xarray.DataArray(values, dims=("chain", "draw"), attrs={"units": STAT_UNITS.get(name, "1")})
            for name, values in posterior.draws.stats.items()
        }
    )


def _observed(posterior: DrawnPosterior) -> xarray.Dataset:
    force = posterior.recorded("force")
    coordinates = _sample_coordinates(posterior) | _axes(posterior)
    if force is None:
        return xarray.Dataset(coords=coordinates)
    array = xarray.DataArray(force, dims=("sample", "axis"), attrs={"units": "N"})
    return xarray.Dataset({"force": array}, coords=coordinates)


def _constant(posterior: DrawnPosterior) -> xarray.Dataset:
    units = {
        "position": "m",
        "velocity": "m/s",
        "acceleration": "m/s^2",
        "reference": "m",
        "perturbation": "N",
    }
    arrays = {name: posterior.recorded(name) for name in units}
    return xarray.Dataset(
        {
            name: xarray.DataArray(values, dims=("sample", "axis"), attrs={"units": units[name]})
            for name, values in arrays.items()
            if values is not None
        },
        coords=_sample_coordinates(posterior) | _axes(posterior),
    )


def _place_dims(posterior: DrawnPosterior) -> tuple[str, ...]:
    if posterior.places.dimension == "phase":
        return ("chain", "draw", "group", "phase")
    return ("chain", "draw", posterior.places.dimension)


def _place_coordinates(posterior: DrawnPosterior) -> dict[str, object]:
    coordinates: dict[str, object] = {**_axes(posterior), "group": list(posterior.groups)}
    trials, rows = posterior.kept(posterior.places.places)
    if posterior.places.dimension == "phase":
        assert trials[0].phase is not None
        return coordinates | {"phase": trials[0].phase}
    time = np.concatenate([trial.time[own] for trial, own in zip(trials, rows, strict=True)])
    if posterior.places.dimension == "time":
        return coordinates | {"time": ("time", time, {"units": "s"})}
    names = _repeated([trial.name for trial in trials], rows)
    groups = _repeated([trial.group for trial in trials], rows)
    return coordinates | {
        "place_time": ("place", time, {"units": "s"}), "place_trial": ("place", names),
        "place_group": ("place", groups),
    }  # fmt: skip


def _sample_coordinates(posterior: DrawnPosterior) -> dict[str, object]:
    trials, rows = posterior.kept(posterior.places.forces)
    time = np.concatenate([trial.time[own] for trial, own in zip(trials, rows, strict=True)])
    coordinates: dict[str, object] = {
        "sample_time": ("sample", time, {"units": "s"}),
        "sample_trial": ("sample", _repeated([trial.name for trial in trials], rows)),
        "sample_group": ("sample", _repeated([trial.group for trial in trials], rows)),
    }
    if all(trial.phase is not None for trial in trials):
        phase = [trial.phase[own] for trial, own in zip(trials, rows, strict=True) if trial.phase is not None]
        coordinates["sample_phase"] = ("sample", np.concatenate(phase))
    return coordinates


def _axes(posterior: DrawnPosterior) -> dict[str, object]:
    axes = list(posterior.axes)
    return {"axis": axes, "axis_2": axes} if posterior.coupled else {"axis": axes}


def _repeated(names: Sequence[str], rows: Sequence[NDArray[np.int64]]) -> list[str]:
    return [name for name, own in zip(names, rows, strict=True) for _ in range(len(own))]


def names_of_coordinates(parameters: Sequence[Parameter], axes: Sequence[str]) -> list[str]:
    """A name for each coordinate of the parameters: noise_sd x, stiffness_weights 3."""
    names = []
    for parameter in parameters:
        if parameter.name.removesuffix("_weights") in QUANTITIES:
            names += [f"{parameter.name} {i}" for i in range(parameter.size)]
            continue
        owners = axes if parameter.shape[0] == len(axes) else ("",)
        for owner in owners:
            names += [" ".join(filter(None, (parameter.name, label, owner))) for label in parameter.labels]
    return names
