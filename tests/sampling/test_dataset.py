"""Draws in the schema of ArviZ: names, dimensions, units, and the same from a file."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
import xarray
from drawn_cases import CASES, CHAINS, DRAWS, PLACES, config_of, drawn

from bayes_impedance.config import dump_config, parse_config
from bayes_impedance.errors import OutputError
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.sampling.dataset import as_tree, save_netcdf

PLACE = {"groups": ("group", "phase"), "inside one trial": ("group", "phase"), "time": ("time",)}
FIRST = ("chain", "draw")


@pytest.mark.parametrize("case", CASES)
def test_names_dimensions_and_units(case):
    posterior = drawn(case)
    tree = as_tree(posterior)
    assert list(tree.children) == [
        "posterior",
        "posterior_predictive",
        "sample_stats",
        "observed_data",
        "constant_data",
    ]
    for group in tree.children.values():
        assert all(variable.attrs["units"] for variable in group.data_vars.values()), group
    data = tree["posterior"]
    axes = ("axis", "axis_2") if case == "groups" else ("axis",)
    place = (*FIRST, *PLACE.get(case, ("place",)))
    once = {"groups": {"mass"}, "inside one trial": {"damping", "mass"}}.get(case)
    for latent in IMPEDANCE_ORDER:
        is_constant = posterior.is_constant(latent)
        assert once is None or (latent.value in once) is is_constant
        assert data[latent.value].dims == ((*FIRST, "group") if is_constant else place) + axes
        expected = posterior.matrices(latent)
        expected = expected if case == "groups" else expected.diagonal(axis1=-2, axis2=-1)
        if is_constant:
            expected = posterior.first_place(expected)
        np.testing.assert_array_equal(data[latent.value], expected)
        said = [one.verdict for one in posterior.verdicts if one.verdict.latent is latent]
        assert data[latent.value].attrs["verdict_sentence"] == [verdict.sentence for verdict in said]
        assert len(said) == 2
    units = {"stiffness": "N/m", "damping": "Ns/m", "mass": "kg", "desired_position": "m"}
    units |= {"desired_velocity": "m/s", "desired_acceleration": "m/s^2", "residual_force": "N", "noise_sd": "N"}
    assert {name: data[name].attrs["units"] for name in units} == units
    assert data["desired_position"].dims == (*place, "axis")
    assert data["residual_force"].dims == (*FIRST, "sample", "axis")
    assert data["noise_sd"].dims == (*FIRST, "axis")
    np.testing.assert_array_equal(data["noise_sd"], posterior.values()["noise_sd"][..., 0])
    np.testing.assert_array_equal(data["axis"], ["x", "y"])
    np.testing.assert_array_equal(data["group"], posterior.groups)
    for name in ("posterior", "posterior_predictive", "sample_stats"):
        np.testing.assert_array_equal(tree[name]["chain"], np.arange(CHAINS))
        np.testing.assert_array_equal(tree[name]["draw"], np.arange(DRAWS))
    np.testing.assert_array_equal(tree["observed_data"]["force"], posterior.recorded("force"))
    assert set(tree["sample_stats"].data_vars) == {"lp", "diverging", "n_steps", "energy"}
    assert tree["sample_stats"]["diverging"].dtype == bool


def test_coordinates_say_where_a_place_is():
    posterior = drawn("groups")
    data = as_tree(posterior)["posterior"]
    average = posterior.places.log.trials[0]
    np.testing.assert_array_equal(data["phase"], average.phase)
    assert list(data["stiffness_entry"].values) == ["xx", "yy", "xy"]
    assert data.sizes["phase"] == PLACES
    times = as_tree(drawn("times"))["posterior"]
    trials = drawn("times").log.trials
    np.testing.assert_array_equal(times["place_trial"], [t.name for t in trials for _ in range(PLACES)])
    np.testing.assert_array_equal(times["place_group"], [t.group for t in trials for _ in range(PLACES)])
    kept = drawn("times").places.places
    np.testing.assert_array_equal(
        times["place_time"], np.concatenate([t.time[own] for t, own in zip(trials, kept, strict=True)])
    )
    for data in (times, as_tree(posterior)["observed_data"]):
        np.testing.assert_array_equal(data["sample_time"], np.concatenate([t.time for t in trials]))
        assert data["sample_trial"].values[0] == trials[0].name
    time = as_tree(drawn("time"))["posterior"]["time"]
    assert time.attrs["units"] == "s" and len(time) == PLACES


def test_components_of_a_length_scale_are_variables_of_their_own():
    data = as_tree(drawn("position"))["posterior"]
    names = {name for name in data.data_vars if "length_scale" in name}
    assert "desired_trajectory_length_scale_position_x" in names
    assert all(data[name].dims in ((*FIRST, "axis"), FIRST) and data[name].attrs["units"] == "m" for name in names)


@pytest.mark.parametrize("case", CASES)
def test_the_file_holds_the_same(case, tmp_path):
    posterior, path = drawn(case), tmp_path / "posterior.nc"
    save_netcdf(posterior, path)
    assert list(tmp_path.iterdir()) == [path]
    expected = as_tree(posterior)
    with xarray.open_datatree(path, engine="h5netcdf") as tree:
        for name, group in expected.children.items():
            xarray.testing.assert_equal(tree[name].to_dataset(), group.to_dataset())
            for variable in group.data_vars:
                assert tree[name][variable].attrs["units"] == group[variable].attrs["units"]
        said = tree["posterior"]["stiffness"].attrs
        assert list(said["verdict"]) == [one.verdict.support.value for one in posterior.verdicts[:2]]
        np.testing.assert_allclose(said["contraction"], [one.verdict.contraction for one in posterior.verdicts[:2]])
        about = tree.attrs
        assert about["method"] == "nuts" and about["engine"] == str(posterior.engine)
        assert json.loads(about["diagnosis"]) == json.loads(json.dumps(posterior.diagnosis.as_dict()))
        assert about["findings"].split("\n") == list(posterior.diagnosis.findings)
        assert "R-hat" in about["findings"] or "ESS" in about["findings"]


def test_the_configuration_in_the_file_is_the_one_that_was_sampled():
    import yaml

    text = as_tree(drawn("groups")).attrs["configuration"]
    assert parse_config(yaml.safe_load(text)) == config_of("groups")
    assert text == dump_config(config_of("groups"))


def test_a_log_without_force_has_nothing_observed():
    posterior = drawn("times")
    bare = tuple(replace(trial, force=None) for trial in posterior.places.log.trials)
    places = replace(posterior.places, log=replace(posterior.places.log, trials=bare))
    tree = as_tree(replace(posterior, places=places))
    assert not tree["observed_data"].data_vars
    assert set(tree["constant_data"].data_vars) >= {"position", "velocity", "acceleration"}
    assert tree["posterior_predictive"]["force"].shape[:2] == (CHAINS, DRAWS)


def test_what_cannot_be_written_leaves_nothing(tmp_path, full_disk):
    with full_disk(), pytest.raises(OutputError, match="could not be written"):
        save_netcdf(drawn("time"), tmp_path / "posterior.nc")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("case", ["groups", "times"])
def test_arviz_reads_it(case, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        az = pytest.importorskip("arviz")
        save_netcdf(drawn(case), tmp_path / "posterior.nc")
        data = az.from_netcdf(tmp_path / "posterior.nc")
        assert set(data.groups()) == set(as_tree(drawn(case)).children)
        table = az.summary(data, var_names=["stiffness", "noise_sd"])
    assert table.loc["noise_sd[x]", "mean"] == pytest.approx(
        drawn(case).values()["noise_sd"][:, :, 0].mean(), abs=1e-3
    )
    assert np.isfinite(table["r_hat"]).all()
    data.close()


def test_residual_is_zero_where_there_is_none():
    assert not as_tree(drawn("groups"))["posterior"][Latent.RESIDUAL_FORCE.value].values.any()
