"""MATLAB files of every version: structs, struct arrays, cells, text, and what scipy would not survive."""

import struct
import zlib
from pathlib import Path
from typing import Any

import h5py
import hdf5storage
import numpy as np
import pytest
import scipy.io

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError
from bayes_impedance.readers import read_log
from bayes_impedance.readers.arrays import matlab_elements, matlab_hdf5
from bayes_impedance.readers.arrays.matlab_elements import check_elements

COLUMNS = {"time": "t", "position": "pos[{index}]", "velocity": None, "force": "F[{index}]"}
CONFIG = LogConfig.model_validate({"columns": COLUMNS})
UNTIMED = LogConfig.model_validate({"columns": COLUMNS | {"time": None}, "sampling_rate": 500})


def recording(n: int, seed: int = 0) -> dict[str, Any]:
    random = np.random.default_rng(seed)
    return {"t": np.arange(n) / 500, "pos": random.normal(size=(3, n)), "F": random.normal(size=(3, n))}


def cells(values: list[Any], shape: tuple[int, ...] | None = None) -> np.ndarray:
    """A cell array, filled along its first dimension."""
    array = np.empty(len(values), dtype=object)
    for index, value in enumerate(values):
        array[index] = value
    return array.reshape(shape or (1, -1), order="F")


def structs(values: list[dict[str, Any]], shape: tuple[int, ...] | None = None) -> np.ndarray:
    """A struct array."""
    array = np.empty(len(values), dtype=[(name, object) for name in values[0]])
    for index, value in enumerate(values):
        array[index] = tuple(value.values())
    return array.reshape(shape or (1, -1), order="F")


@pytest.fixture(params=["5", "5 compressed", "7.3"])
def save(request, tmp_path):
    """Function that writes variables to a file of one of the versions."""

    def write(variables: dict[str, Any]) -> Path:
        path = tmp_path / "log.mat"
        if request.param == "7.3":
            path.unlink(missing_ok=True)
            hdf5storage.savemat(str(path), variables, format="7.3", store_python_metadata=False)
        else:
            scipy.io.savemat(path, variables, do_compression="compressed" in request.param)
        return path

    return write


def assert_trials(log, recordings: dict[str, dict[str, Any]]) -> None:
    assert [trial.name for trial in log.trials] == list(recordings)
    for trial, expected in zip(log.trials, recordings.values(), strict=True):
        np.testing.assert_array_equal(trial.time, expected["t"])
        np.testing.assert_array_equal(trial.position, expected["pos"].T)
        np.testing.assert_array_equal(trial.force, expected["F"].T)


SIX = [recording(20 + index, seed=index) for index in range(6)]
NUMBERED = {str(index): value for index, value in enumerate(SIX, start=1)}


@pytest.mark.parametrize("shape", [(1, 6), (6, 1), (2, 3)])
@pytest.mark.parametrize("make", [structs, cells])
def test_elements_are_trials_in_the_order_of_the_linear_index(save, make, shape):
    path = save({"symbol_data": make(SIX, shape), "rate": 500.0, "gains": np.eye(3), "note": "of Tuesday"})
    assert_trials(read_log(path, CONFIG), NUMBERED)
    assert_trials(read_log(path, CONFIG.model_copy(update={"root": "symbol_data/4"})), {"4": SIX[3]})
    without_time = read_log(path, UNTIMED)
    np.testing.assert_allclose(without_time.trials[2].time, SIX[2]["t"], rtol=1e-15)


def test_a_struct_is_a_trial_of_its_name(save):
    assert_trials(
        read_log(save({"first": SIX[0], "second": SIX[1]}), CONFIG), {"first": SIX[0], "second": SIX[1]}
    )


def test_structs_in_structs(save):
    content = {"name": "Ada", "runs": structs([{"robot": value} for value in SIX])}
    columns = {name: template and f"robot/{template}" for name, template in COLUMNS.items()}
    config = LogConfig.model_validate({"columns": columns})
    assert_trials(read_log(save({"experiment": content}), config), NUMBERED)
    # The position is as well found from within.
    log = read_log(save({"experiment": content}), CONFIG)
    assert [trial.name for trial in log.trials] == [f"{index}/robot" for index in range(1, 7)]


def test_cell_arrays_side_by_side(save):
    columns = {name: cells([value[name] for value in SIX]) for name in ("t", "pos", "F")}
    path = save(columns | {"group": "Ada", "others": cells([np.zeros(3)] * 9)})
    log = read_log(path, CONFIG)
    assert_trials(log, NUMBERED)
    assert log.groups == ("Ada",)
    assert_trials(read_log(save({"data": columns}), CONFIG), NUMBERED)


def test_text_labels(save):
    names = ["reach", "reach", "rest €", "rest €"]
    values = recording(4) | {
        "trial": cells(names, (4, 1)),
        "group": "Ada",
        "repetition": np.array([1, 1, 2, 2]),
    }
    for path in (save(values), save({"data": values})):
        log = read_log(path, CONFIG)
        assert [(trial.name, trial.group) for trial in log.trials] == [("reach", "Ada"), ("rest €", "Ada")]


def test_a_matrix_of_characters_is_a_label_a_row(tmp_path):
    path = tmp_path / "log.mat"
    scipy.io.savemat(path, recording(4) | {"trial": np.array(["ab", "ab", "c", "c"])})
    assert [trial.name for trial in read_log(path, CONFIG).trials] == ["ab", "c"]
    path.unlink()
    hdf5storage.savemat(str(path), recording(4), format="7.3", store_python_metadata=False)
    with h5py.File(path, "a") as file:
        # As MATLAB writes it: codes of UTF-16, transposed.
        file["trial"] = np.array([[97, 97, 99, 99], [98, 98, 32, 32]], dtype=np.uint16)
        file["trial"].attrs["MATLAB_class"] = np.bytes_("char")
    assert [trial.name for trial in read_log(path, CONFIG).trials] == ["ab", "c"]


def test_logical_and_integer_arrays_are_numbers(save):
    values = recording(5)
    values["F"] = values["F"] > 0
    values["pos"] = np.arange(15, dtype=np.int16).reshape(3, 5) // 2
    (trial,) = read_log(save(values), CONFIG).trials
    np.testing.assert_array_equal(trial.force, values["F"].T.astype(float))
    np.testing.assert_array_equal(trial.position, values["pos"].T)


def test_empty_fields_are_not_there(save):
    values = recording(5) | {"vel": np.zeros((0, 0)), "note": "", "nothing": cells([])}
    log = read_log(
        save({"data": structs([values, recording(6) | dict.fromkeys(("vel", "note", "nothing"), 1.0)])}),
        CONFIG,
    )
    assert [trial.n_samples for trial in log.trials] == [5, 6]


def test_version_4(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", recording(9), format="4")
    assert_trials(read_log(tmp_path / "a.mat", CONFIG), {"0": recording(9)})


def test_references_in_a_circle_end(tmp_path):
    path = tmp_path / "log.mat"
    hdf5storage.savemat(str(path), recording(9), format="7.3", store_python_metadata=False)
    with h5py.File(path, "a") as file:
        circle = file.create_dataset("circle", (1, 1), dtype=h5py.ref_dtype)
        circle.attrs["MATLAB_class"] = np.bytes_("cell")
        circle[0, 0] = circle.ref
    assert_trials(read_log(path, CONFIG), {"0": recording(9)})
    with h5py.File(path, "a") as file:
        many = file.create_dataset("many", (1_000_000, 1000), dtype=h5py.ref_dtype, chunks=(1000, 1))
        many.attrs["MATLAB_class"] = np.bytes_("cell")
        many[0, 0] = file["t"].ref
    with pytest.raises(LogError, match="expected at most 100000 arrays and groups in a file, found more"):
        read_log(path, CONFIG)


def test_six_traced_symbols(shared_data):
    """A struct array of six, 3×T each, 1 kHz, 5.5 to 17.7 s, as the README of the data says."""
    columns = COLUMNS | {"time": None}
    config = LogConfig.model_validate({"columns": columns, "sampling_rate": 1000, "axes": ["x", "y"]})
    path = shared_data / "panda_comanipulation" / "symbol_17_data.mat"
    log = read_log(path, config)
    assert [trial.name for trial in log.trials] == ["1", "2", "3", "4", "5", "6"]
    durations = [trial.time[-1] for trial in log.trials]
    assert min(durations) == pytest.approx(5.5, abs=0.05) and max(durations) == pytest.approx(17.7, abs=0.05)
    third = scipy.io.loadmat(path, simplify_cells=True)["symbol_data"][2]
    np.testing.assert_array_equal(log.trials[2].position, third["pos"][:2].T)
    np.testing.assert_array_equal(log.trials[2].force, third["F"][:2].T)


# --- what scipy would not survive ----------------------------------------------------------------

HEADER = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x100) + b"IM"


def element(kind: int, content: bytes, size: int | None = None) -> bytes:
    padded = content + b"\0" * (-len(content) % 8)
    return struct.pack("<II", kind, len(content) if size is None else size) + padded


def matrix(kind: int, size: tuple[int, ...], *parts: bytes, name: bytes = b"pos") -> bytes:
    head = element(6, struct.pack("<II", kind, 0)) + element(5, struct.pack(f"<{len(size)}i", *size))
    return element(14, head + element(1, name) + b"".join(parts))


DOUBLES = element(9, np.arange(6.0).tobytes())


def deep(levels: int, name: bytes = b"pos") -> bytes:
    inner = matrix(6, (2, 3), DOUBLES)
    for _ in range(levels):
        inner = matrix(1, (1, 1), inner, name=name)
    return inner


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (element(9, b"", 2**31), "an element of 2147483648 bytes where 0 are left"),
        (matrix(6, (2, 3), element(9, b"", 2**31)), "an element of 2147483648 bytes where 0 are left"),
        (matrix(6, (2, 3), element(0, bytes(48))), "values of type 0"),
        (matrix(6, (2, 3), element(0x4009, bytes(48))), "values of type 16393"),
        (matrix(6, (2, 3), matrix(6, (2, 3), DOUBLES)), "values of type 14"),
        (matrix(6, (2, 3), struct.pack("<II", 0x90009, 0)), "9 bytes where four have room"),
        (matrix(6, (2, 3)), "a matrix of 3 parts where 4 are expected"),
        (matrix(6, (-2, 3), DOUBLES), r"a matrix of size \(-2, 3\)"),
        (matrix(1, (10**6, 10**6), deep(0)), "a matrix of 4 parts where 1000000000003 are expected"),
        (matrix(1, (1, 1), DOUBLES), "an element of type 9 at a depth of 1"),
        (matrix(2, (1, 1)), "a struct without names of fields"),
        (matrix(2, (1, 1), element(5, bytes(4)), element(1, b"a")), "names of fields of 0 characters"),
        (matrix(99, (2, 3), DOUBLES), "a matrix of class 99"),
        (element(14, element(5, bytes(8))), "a matrix without a head"),
        (deep(40), "an element of type 14 at a depth of 33"),
        (DOUBLES, "an element of type 9 at a depth of 0"),
        (element(15, zlib.compress(bytes(3000))), "more than .* GB once it is unpacked"),
    ],
)
def test_refuses_elements_that_are_damaged(tmp_path, monkeypatch, content, found):
    if "unpacked" in found:
        monkeypatch.setattr(matlab_elements, "LARGEST", 2000)
    (tmp_path / "log.mat").write_bytes(HEADER + content)
    with pytest.raises(ValueError, match=found):
        check_elements(HEADER + content)
    with pytest.raises(
        LogError,
        match=rf"log.mat: expected a MATLAB file, found one that is truncated or something else \({found}",
    ):
        read_log(tmp_path / "log.mat", CONFIG)


def test_elements_made_by_hand_are_what_scipy_reads(tmp_path):
    (tmp_path / "a.mat").write_bytes(
        HEADER + matrix(6, (2, 3), DOUBLES) + element(15, zlib.compress(deep(2, b"deep")))
    )
    check_elements((tmp_path / "a.mat").read_bytes())
    np.testing.assert_array_equal(
        scipy.io.loadmat(tmp_path / "a.mat")["deep"][0, 0][0, 0], np.arange(6.0).reshape(2, 3, order="F")
    )


def test_files_that_matlab_wrote_pass():
    """scipy brings files of MATLAB 5 to 7.4 along, on all kinds of machine; those that it refuses may be refused."""
    folder = Path(scipy.io.matlab.__file__).parent / "tests" / "data"
    checked = 0
    for path in sorted(folder.glob("test*.mat")):
        if scipy.io.matlab.matfile_version(path)[0] == 1:
            check_elements(path.read_bytes())
            checked += 1
    if not checked:
        pytest.skip("scipy is installed without its tests")
    assert checked > 30


def test_deep_structs_of_version_7_3_end(tmp_path):
    path = tmp_path / "log.mat"
    hdf5storage.savemat(str(path), recording(9), format="7.3", store_python_metadata=False)
    with h5py.File(path, "a") as file:
        file.create_group("/".join("a" * (matlab_hdf5.DEEPEST + 5)))["x"] = np.zeros(4)
    assert_trials(read_log(path, CONFIG), {"0": recording(9)})
