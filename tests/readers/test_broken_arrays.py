"""Files torn, flipped, spliced and renamed: they are read, or refused in one sentence that is ours."""

import io
import struct
import tempfile
import tracemalloc
import warnings
import zipfile
from functools import cache
from pathlib import Path

import h5py
import hdf5storage
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import ConfigurationError, LogError, LogWarning
from bayes_impedance.readers import read_log

N = 12
CONFIG = LogConfig.model_validate({"columns": {"position": "position[{index}]", "force": "force[{index}]"}})
#: Endings of all formats, with what writes them.
FORMATS = {"HDF5": ".h5", "HDF5 latest": ".hdf5", "NumPy": ".npz", "NumPy packed": ".npz", "MATLAB 4": ".mat"} | {
    "MATLAB 5": ".mat", "MATLAB 5 packed": ".mat", "MATLAB 7.3": ".mat", "CSV": ".csv", "Parquet": ".parquet",
}  # fmt: skip


def recording(seed: int) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    return {
        "time": np.arange(N) * 0.1,
        "position": random.normal(size=(N, 3)),
        "force": random.normal(size=(N, 3)),
    }


def fill(file: h5py.File) -> None:
    for index in range(2):
        group = file.create_group(f"trial_{index}")
        for name, value in recording(index).items():
            options = {} if name == "time" else {"compression": "gzip", "shuffle": True}
            group.create_dataset(name, data=value, **options)
        group["group"] = ["Ada"] * N


@cache
def whole(format_: str) -> bytes:
    """A valid file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"log{FORMATS[format_]}"
        both = np.empty((1, 2), dtype=[(name, object) for name in recording(0)])
        for index in range(2):
            both[0, index] = tuple(recording(index).values())
        variables = {"data": both, "note": "of Tuesday", "rest": recording(0) | {"position": 1.0}}
        match format_:
            case "HDF5" | "HDF5 latest":
                with h5py.File(path, "w", libver="latest" if "latest" in format_ else "earliest") as file:
                    fill(file)
            case "NumPy" | "NumPy packed":
                save = np.savez if format_ == "NumPy" else np.savez_compressed
                save(path, **recording(0), group=np.array(["Ada"] * N))
            case "MATLAB 4":
                scipy.io.savemat(path, recording(0), format="4")
            case "MATLAB 5" | "MATLAB 5 packed":
                scipy.io.savemat(path, variables, do_compression="packed" in format_)
            case "MATLAB 7.3":
                hdf5storage.savemat(str(path), variables, format="7.3", store_python_metadata=False)
            case _:
                values = recording(0)
                columns = {
                    f"{name}[{i}]": values[name][:, i] for name in ("position", "force") for i in range(3)
                }
                table = pd.DataFrame({"time": values["time"]} | columns)
                table.to_csv(path, index=False) if path.suffix == ".csv" else table.to_parquet(path)
        return path.read_bytes()


def follow(data: bytes, suffix: str) -> bool:
    """Whether a file is read; anything but our own errors, and other libraries' warnings, fail the test."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"log{suffix}"
        path.write_bytes(data)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LogWarning)
            try:
                read_log(path, CONFIG)
            except (LogError, ConfigurationError) as error:
                sentence = str(error)
            else:
                return True
    assert sentence.startswith("log") and "\n" not in sentence
    return False


@pytest.mark.parametrize("format_", FORMATS)
def test_whole_files_are_read(format_):
    assert follow(whole(format_), FORMATS[format_])


@settings(max_examples=60, deadline=None, derandomize=True)
@pytest.mark.parametrize("format_", FORMATS)
@given(data=st.data())
def test_torn_files(format_, data):
    content = whole(format_)
    follow(content[: data.draw(st.integers(0, len(content) - 1))], FORMATS[format_])


@settings(max_examples=60, deadline=None, derandomize=True)
@pytest.mark.parametrize("format_", FORMATS)
@given(data=st.data())
def test_flipped_bits(format_, data):
    content = bytearray(whole(format_))
    for at in data.draw(st.lists(st.integers(0, 8 * len(content) - 1), min_size=1, max_size=4)):
        content[at // 8] ^= 1 << at % 8
    follow(bytes(content), FORMATS[format_])


@settings(max_examples=60, deadline=None, derandomize=True)
@pytest.mark.parametrize("format_", FORMATS)
@given(data=st.data())
def test_spliced_files(format_, data):
    content = whole(format_)
    at = data.draw(st.integers(0, len(content)))
    gone = data.draw(st.integers(0, 40))
    follow(content[:at] + data.draw(st.binary(max_size=40)) + content[at + gone :], FORMATS[format_])


@pytest.mark.parametrize("format_", FORMATS)
def test_renamed_files(format_):
    family = next(
        (both for both in ({".h5", ".hdf5"}, {".parquet", ".pq"}) if FORMATS[format_] in both), set()
    )
    for suffix in {*FORMATS.values(), ".tsv", ".txt", ".pq"} - family - {FORMATS[format_]}:
        # Text is text whatever its delimiter.
        if format_ != "CSV" or suffix not in (".tsv", ".txt"):
            assert not follow(whole(format_), suffix)


@pytest.mark.parametrize(
    ("format_", "expected"),
    [
        ("HDF5", "an HDF5 file"),
        ("NumPy", "a NumPy archive"),
        ("MATLAB 5", "a MATLAB file"),
        ("MATLAB 7.3", "a MATLAB"),
    ],
)
def test_the_sentence_of_a_torn_file(tmp_path, format_, expected):
    path = tmp_path / f"log{FORMATS[format_]}"
    for content in (b"", b"time,position_x\n0,1\n", whole(format_)[: len(whole(format_)) // 2]):
        path.write_bytes(content)
        with pytest.raises(
            LogError,
            match=rf"log.*: expected {expected}.*, found one that is truncated or something else \(.*\); "
            "save it anew, or rename it by its format",
        ):
            read_log(path, CONFIG)


def test_parquet_with_fewer_rows_than_it_declares(tmp_path, monkeypatch):
    """Flipped bits of its footer do that, and Arrow does not mind."""
    (tmp_path / "log.parquet").write_bytes(whole("Parquet"))
    plain = pq.ParquetFile.read
    monkeypatch.setattr(pq.ParquetFile, "read", lambda self, columns: plain(self, columns=columns).slice(1))
    with pytest.raises(LogError, match=r"expected a readable table, found: columns without the 12 rows that"):
        read_log(tmp_path / "log.parquet", CONFIG)


# --- sizes that are only declared ----------------------------------------------------------------


def refused(path: Path, message: str) -> None:
    """Refused, with little memory taken."""
    tracemalloc.start()
    try:
        with pytest.raises(LogError, match=message):
            read_log(path, CONFIG)
        assert tracemalloc.get_traced_memory()[1] < 200e6
    finally:
        tracemalloc.stop()


def header(shape: tuple[int, ...]) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return stream.getvalue()


def archive(path: Path, force: bytes) -> None:
    np.savez(path, **{name: value for name, value in recording(0).items() if name != "force"})
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as file:
        file.writestr("force.npy", force)


def test_an_npz_header_that_declares_a_trillion_samples(tmp_path):
    archive(tmp_path / "log.npz", header((10**12, 3)) + bytes(1000))
    refused(
        tmp_path / "log.npz", r"expected a NumPy archive, .* \(force.npy is shorter than its header says\)"
    )


def test_a_member_that_unpacks_to_gigabytes(tmp_path, monkeypatch):
    monkeypatch.setattr("bayes_impedance.readers.arrays.tables.LARGEST", 10**8)
    archive(tmp_path / "log.npz", header((6 * 10**6, 3)) + bytes(6 * 10**6 * 24))
    assert (tmp_path / "log.npz").stat().st_size < 10**6
    refused(tmp_path / "log.npz", "in the columns of a file, found arrays that are declared to take 0.268 GB")


def test_an_element_of_two_gigabytes(tmp_path):
    data = whole("MATLAB 5")
    (tmp_path / "log.mat").write_bytes(data[:132] + struct.pack("<I", 2**31) + data[136:])
    refused(tmp_path / "log.mat", "an element of 2147483648 bytes where")


def test_a_version_4_matrix_of_a_trillion_numbers(tmp_path):
    content = struct.pack("<5i", 0, 10**6, 10**6, 0, 6) + b"force\0" + bytes(80)
    (tmp_path / "log.mat").write_bytes(whole("MATLAB 4") + content)
    refused(tmp_path / "log.mat", "expected a MATLAB file, found one that is truncated or something else")
