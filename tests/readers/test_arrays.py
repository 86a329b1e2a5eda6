"""The same samples in every format, flat and nested, alone and several in a file: what goes in comes out to the bit."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import hdf5storage
import numpy as np
import pandas as pd
import pytest
import scipy.io

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError
from bayes_impedance.readers import read_log
from bayes_impedance.readers.arrays import tables, tree
from bayes_impedance.readers.read import open_file

Content = dict[str, Any]


def samples(n: int = 37, seed: int = 0) -> dict[str, np.ndarray]:
    """A recording: `time (n,)`, `position`, `force` `(n, 3)`."""
    random = np.random.default_rng(seed)
    return {
        "time": np.cumsum(random.uniform(0.001, 0.01, n)),
        "position": random.normal(size=(n, 3)) / 3,
        "force": random.normal(size=(n, 3)) * 7,
    }


def nested(recording: dict[str, np.ndarray]) -> Content:
    return {
        "time": recording["time"],
        "robot": {"pose": {"position": recording["position"]}},
        "sensor": {"force": recording["force"]},
    }


# --- formats -------------------------------------------------------------------------------------


def put(group: h5py.Group, content: Content) -> None:
    for name, value in content.items():
        if isinstance(value, dict):
            put(group.create_group(name), value)
        else:
            group[name] = value


def write_hdf5(path: Path, content: Content) -> None:
    with h5py.File(path, "w") as file:
        put(file, content)


def flattened(content: Content, path: str = "") -> Content:
    flat: Content = {}
    for name, value in content.items():
        flat |= flattened(value, f"{path}{name}/") if isinstance(value, dict) else {path + name: value}
    return flat


def write_npz(path: Path, content: Content) -> None:
    np.savez(path, **flattened(content))


def write_mat(path: Path, content: Content) -> None:
    scipy.io.savemat(path, content)


def write_mat73(path: Path, content: Content) -> None:
    # An older file would be written into.
    path.unlink(missing_ok=True)
    hdf5storage.savemat(str(path), content, format="7.3", store_python_metadata=False)


ARRAYS: dict[str, tuple[str, Callable[[Path, Content], None]]] = {
    "HDF5": ("log.h5", write_hdf5),
    "NumPy": ("log.npz", write_npz),
    "MATLAB 5": ("log.mat", write_mat),
    "MATLAB 7.3": ("log.mat", write_mat73),
}


@pytest.fixture(params=ARRAYS)
def save(request, tmp_path):
    """Function that writes content in one of the formats."""
    name, write = ARRAYS[request.param]

    def written(content: Content) -> Path:
        write(tmp_path / name, content)
        return tmp_path / name

    return written


def config(position="position[{index}]", force="force[{index}]", **log) -> LogConfig:
    columns = {"position": position, "force": force, **log.pop("columns", {})}
    return LogConfig.model_validate({"columns": columns, **log})


FLAT = config()
NESTED = config("robot/pose/position[{index}]", "sensor/force[{index}]")


def assert_equal(trial, recording) -> None:
    for name in ("time", "position", "force"):
        np.testing.assert_array_equal(getattr(trial, name), recording[name], strict=True)


# --- what goes in comes out ----------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".txt", ".parquet"])
def test_tables_hold_what_arrays_hold(tmp_path, suffix):
    recording = samples()
    table = pd.DataFrame({"time": recording["time"]})
    for index in range(3):
        table[f"position[{index}]"] = recording["position"][:, index]
        table[f"force[{index}]"] = recording["force"][:, index]
    path = tmp_path / f"log{suffix}"
    if suffix == ".parquet":
        table.to_parquet(path)
    else:
        table.to_csv(path, index=False, sep={".csv": ",", ".tsv": "\t", ".txt": " "}[suffix])
    (trial,) = read_log(path, FLAT).trials
    assert_equal(trial, recording)


def test_flat(save):
    recording = samples()
    (trial,) = read_log(save(recording), FLAT).trials
    assert (trial.name, trial.rows.word) == ("0", "row")
    assert_equal(trial, recording)
    np.testing.assert_array_equal(trial.rows.numbers, np.arange(1, 38))


def test_nested(save):
    recording = samples()
    (trial,) = read_log(save(nested(recording)), NESTED).trials
    assert trial.name == "0"
    assert_equal(trial, recording)


def test_rows_or_columns_may_count_samples(save):
    recording = samples()
    lying = recording | {"position": recording["position"].T, "force": recording["force"].T}
    (trial,) = read_log(save(lying), FLAT).trials
    assert_equal(trial, recording)


@pytest.mark.parametrize("n", [2, 3])
def test_time_tells_samples_from_columns_of_a_short_recording(save, n):
    recording = samples(n)
    lying = {"time": recording["time"]} | {name: recording[name][:, :2].T for name in ("position", "force")}
    path = save(lying)
    if n == 2:
        with pytest.raises(
            LogError, match=r"'position\[0\]': expected an array with more samples than columns"
        ):
            read_log(path, FLAT)
        return
    (trial,) = read_log(path, FLAT).trials
    np.testing.assert_array_equal(trial.position, recording["position"][:, :2])
    # The longer dimension would have been the other one.
    two = {
        "time": np.array([0.0, 1.0]),
        "position": recording["position"][:2],
        "force": recording["force"][:2],
    }
    (trial,) = read_log(save(two), FLAT).trials
    np.testing.assert_array_equal(trial.position, recording["position"][:2])


def test_a_column_may_be_an_array_of_its_own(save):
    recording = samples()
    content = {"time": recording["time"]}
    for index, axis in enumerate("xyz"):
        content[f"position_{axis}"] = recording["position"][:, index]
        content[f"force_{axis}"] = recording["force"][:, index]
    (trial,) = read_log(save(content)).trials
    assert_equal(trial, recording)


def test_groups_are_recordings(save):
    recordings = {f"trial_{index}": samples(20 + index, seed=index) for index in (3, 4, 11)}
    contents = {name: nested(recording) for name, recording in recordings.items()}
    for root, content in ((None, contents), ("session", {"session": contents, "gains": np.eye(3)})):
        log = read_log(save(content), NESTED.model_copy(update={"root": root}))
        found = {trial.name: trial for trial in log.trials}
        assert set(found) == set(recordings)
        for name, recording in recordings.items():
            assert_equal(found[name], recording)
    log = read_log(save(contents), NESTED.model_copy(update={"root": "/trial_4/"}))
    assert [trial.name for trial in log.trials] == ["trial_4"]


def test_recordings_of_one_name_are_told_apart_by_what_surrounds_them(save):
    contents = {subject: {f"run_{run}": samples(seed=run) for run in (1, 2)} for subject in ("ada", "bob")}
    log = read_log(save(contents), FLAT)
    assert sorted(trial.name for trial in log.trials) == ["ada/run_1", "ada/run_2", "bob/run_1", "bob/run_2"]


def test_the_outermost_recording_is_read_and_root_reaches_deeper(save):
    outer, inner = samples(20, 1), samples(30, 2)
    path = save(outer | {"filtered": inner})
    assert_equal(read_log(path, FLAT).trials[0], outer)
    (trial,) = read_log(path, FLAT.model_copy(update={"root": "filtered"})).trials
    assert_equal(trial, inner)


def test_a_single_number_is_no_recording(save):
    path = save({"offset": {"position_x": 1.0, "position_y": 2.0}, "run": samples()})
    columns = {"position": "position_{axis}", "force": "force[{index}]"}
    with pytest.raises(
        LogError, match=r"expected column 'position_x' in the file or in one of its groups, found"
    ):
        read_log(path, LogConfig.model_validate({"columns": columns}))


@pytest.mark.parametrize("kind", [np.int8, np.uint8, np.int32, np.uint16, np.int64, np.float32, ">f8", ">i4"])
def test_numbers_of_every_kind_become_float64(save, kind):
    recording = samples()
    position = (np.arange(37 * 3).reshape(37, 3) % 10).astype(kind)
    (trial,) = read_log(save(recording | {"position": position}), FLAT).trials
    assert trial.position.dtype == np.float64
    np.testing.assert_array_equal(trial.position, position)


def test_a_label_that_stands_there_once_holds_for_all_samples(save):
    recordings = {f"t{index}": samples(seed=index) | {"group": "Ada", "repetition": 7} for index in (1, 2)}
    log = read_log(save(recordings), FLAT)
    assert [trial.group for trial in log.trials] == ["Ada", "Ada"]
    assert not log.trials[0].repetition.any()


def test_a_label_of_every_sample(save):
    labels = np.repeat([4.0, 5.0], [20, 17])
    log = read_log(save(samples() | {"trial": labels}), FLAT)
    assert [(trial.name, trial.n_samples) for trial in log.trials] == [("4", 20), ("5", 17)]


def test_arrays_of_two_clocks_are_two_streams(save):
    slow, fast = samples(30, 1), samples(300, 2)
    path = save(
        {"time": slow["time"], "position": slow["position"], "t_F": fast["time"], "force": fast["force"]}
    )
    opened = open_file(path, "log", config(columns={"force_time": "t_F"}))
    (table,) = opened.tables
    names = ["time", "position[0]", "position[2]", "t_F", "force[1]"]
    first, second = table.load(names, ())
    assert (first.name, second.name) == ("time", "t_F")
    assert (set(first.columns), set(second.columns)) == (set(names[:3]), set(names[3:]))
    np.testing.assert_array_equal(first.columns["position[2]"], slow["position"][:, 2])
    np.testing.assert_array_equal(second.columns["force[1]"], fast["force"][:, 1])
    assert (len(first.rows.numbers), len(second.rows.numbers)) == (30, 300)


def test_a_structured_array_is_a_group_of_its_fields(tmp_path):
    recording = samples()
    table = np.zeros(
        37,
        dtype=[("time", "f8"), ("robot", [("position", "f4", (3,))]), ("force", "f8", (3,)), ("group", "S3")],
    )
    table["time"], table["robot"]["position"] = recording["time"], recording["position"]
    table["force"], table["group"] = recording["force"], b"Ada"
    write_npz(tmp_path / "a.npz", {"log": table})
    write_hdf5(tmp_path / "a.h5", {"log": table})
    for name in ("a.npz", "a.h5"):
        (trial,) = read_log(tmp_path / name, config("robot/position[{index}]")).trials
        assert (trial.name, trial.group) == ("log", "Ada")
        assert_equal(trial, recording | {"position": recording["position"].astype(np.float32).astype(float)})


# --- what is refused -----------------------------------------------------------------------------


def test_refuses_what_is_not_there(save):
    path = save(nested(samples()))
    with pytest.raises(
        LogError,
        match=r"expected column 'Position\[0\]' in the file or in one of its groups, found none of that name "
        r"\(the nearest is 'position\[0\]'; there is",
    ):
        read_log(path, config("Position[{index}]"))
    with pytest.raises(
        LogError, match=r"there is .*robot/pose/position \(.*\).*; set log.columns.position to the"
    ):
        read_log(path, config("q{axis}"))
    with pytest.raises(LogError, match=r"expected a group or struct 'trials', found .*; mend log.root"):
        read_log(path, NESTED.model_copy(update={"root": "trials"}))
    with pytest.raises(LogError, match=r"expected a group or struct 'robot/pose/position'"):
        read_log(path, NESTED.model_copy(update={"root": "robot/pose/position"}))
    with pytest.raises(
        LogError, match=r"expected column 'sensor/Force\[0\]', .*the nearest is 'sensor/force\[0\]'"
    ):
        read_log(path, config("robot/pose/position[{index}]", "sensor/Force[{index}]"))


def test_refuses_a_file_without_arrays(save):
    with pytest.raises(LogError, match="expected named arrays, found none; save matrices, or structs"):
        read_log(save({"nothing": {}}), FLAT)


def test_refuses_complex_numbers(save):
    recording = samples()
    with pytest.raises(
        LogError, match=r"column 'force\[0\]': expected real numbers, found complex ones; save the"
    ):
        read_log(save(recording | {"force": recording["force"] + 1j}), FLAT)


def test_refuses_a_number_that_is_missing(save):
    recordings = {"first": samples(), "second": samples(seed=1)}
    recordings["second"]["force"][[4, 9], 1] = np.nan
    with pytest.raises(
        LogError, match=r"trial 'second', column 'force\[1\]': expected finite numbers, .* at rows 5, 10;"
    ):
        read_log(save(recordings), FLAT)


@pytest.mark.parametrize(("name", "write"), [ARRAYS["HDF5"], ARRAYS["NumPy"]])
def test_refuses_empty_arrays(tmp_path, name, write):
    write(tmp_path / name, {"a": samples(), "b": samples(0)})
    with pytest.raises(
        LogError, match=r"trial 'b', column 'time': expected samples, found an array of shape \(0,\)"
    ):
        read_log(tmp_path / name, FLAT)


def test_refuses_more_than_fits(save, monkeypatch):
    path = save({"a": samples(), "b": samples(seed=1)})
    monkeypatch.setattr(tables, "LARGEST", 3 * 37 * 7 * 8)
    with pytest.raises(
        LogError, match=r"expected at most .* GB in the columns of a file, found arrays that are"
    ):
        monkeypatch.setattr(tables, "LARGEST", 37 * 7 * 8)
        read_log(path, FLAT)


def test_refuses_more_arrays_than_a_recording_has(save, monkeypatch):
    path = save({f"a{index}": np.zeros(3) for index in range(12)} | samples())
    monkeypatch.setattr(tree, "MOST_ARRAYS", 10)
    with pytest.raises(
        LogError, match="expected at most 10 arrays and groups in a file, found more; split the"
    ):
        read_log(path, FLAT)


def test_refuses_python_objects(tmp_path):
    recording = samples()
    np.savez(tmp_path / "a.npz", **{name: value.astype(object) for name, value in recording.items()})
    message = "expected numbers or text, found Python objects in '{}', which are not read"
    with pytest.raises(LogError, match=message.format("time")):
        read_log(tmp_path / "a.npz", FLAT)
    np.savez(tmp_path / "b.npz", data=np.array(recording, dtype=object))
    with pytest.raises(LogError, match=message.format("data")):
        read_log(tmp_path / "b.npz", FLAT)


def test_refuses_a_name_that_is_array_and_group(tmp_path):
    message = "expected names of arrays that differ from those of groups, found 'a' twice; rename one"
    for names in (["a", "a/b"], ["a/b", "a"]):
        np.savez(tmp_path / "a.npz", **dict.fromkeys(names, np.zeros(3)))
        with pytest.raises(LogError, match=message):
            read_log(tmp_path / "a.npz", FLAT)
