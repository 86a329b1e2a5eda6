"""Sealed files: what was written is read to the bit; whatever was changed is noticed."""

import json
import struct

import numpy as np
import pytest
from safetensors.numpy import save

from bayes_impedance.errors import OutputError
from bayes_impedance.sealed import DIGEST, DamagedFileError, read_sealed, write_sealed

ABOUT = {"model": "a", "note": "ü – ẋ"}
ARRAYS = {
    "scalar": np.array(7),
    "transposed": np.arange(6.0).reshape(2, 3).T,
    "strided": np.arange(12.0)[::3],
    "flags": np.array([True, False]),
    "bytes": np.arange(9, dtype=np.uint8),
    "empty": np.empty((0, 3)),
    "extremes": np.array([np.nan, np.inf, -np.inf, -0.0, 5e-324, np.finfo(float).max]),
}


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "sealed.safetensors"
    write_sealed(path, ARRAYS, ABOUT)
    return path


def test_what_was_written_is_read(path):
    arrays, about = read_sealed(path)
    assert about == ABOUT
    assert arrays.keys() == ARRAYS.keys()
    for name, values in ARRAYS.items():
        assert arrays[name].dtype == values.dtype
        assert arrays[name].shape == values.shape
        assert arrays[name].tobytes() == np.ascontiguousarray(values).tobytes()


def test_nothing_at_all_can_be_sealed(tmp_path):
    path = tmp_path / "sealed.safetensors"
    write_sealed(path, {}, {})
    assert read_sealed(path) == ({}, {})


def test_a_second_writing_replaces_the_first(path):
    write_sealed(path, {"other": np.zeros(2)}, {})
    assert read_sealed(path)[0].keys() == {"other"}
    assert [one.name for one in path.parent.iterdir()] == [path.name]


def test_every_bit_counts(path):
    content = bytearray(path.read_bytes())
    for place in range(len(content)):
        content[place] ^= 1 << place % 8
        path.write_bytes(content)
        with pytest.raises(DamagedFileError, match=r"sealed\.safetensors"):
            read_sealed(path)
        content[place] ^= 1 << place % 8
    path.write_bytes(content)
    assert read_sealed(path)[1] == ABOUT


def test_every_length_counts(path):
    content = path.read_bytes()
    for length in range(len(content)):
        path.write_bytes(content[:length])
        with pytest.raises(DamagedFileError):
            read_sealed(path)
    path.write_bytes(content + b"\0")
    with pytest.raises(DamagedFileError):
        read_sealed(path)


@pytest.mark.parametrize(
    "about", [None, {}, {"model": "a"}, {DIGEST: "0" * 64}, {"model": "a", DIGEST: ""}], ids=str
)
def test_a_file_without_its_seal(path, about):
    path.write_bytes(save({"other": np.zeros(2)}, about))
    with pytest.raises(DamagedFileError):
        read_sealed(path)


def test_the_seal_of_another_file(path, tmp_path):
    """The digest is of the arrays and of what they are about, together."""
    header_size = struct.unpack("<Q", path.read_bytes()[:8])[0]
    seal = json.loads(path.read_bytes()[8 : 8 + header_size])["__metadata__"][DIGEST]
    other = tmp_path / "other.safetensors"
    contiguous = {name: np.array(values, order="C") for name, values in ARRAYS.items()}
    other.write_bytes(save(contiguous, {**ABOUT, DIGEST: seal}))
    assert read_sealed(other)[1] == ABOUT
    for arrays, about in (
        (contiguous, {**ABOUT, "model": "b"}),
        (contiguous, {"model": "a"}),
        ({**contiguous, "scalar": np.array(8)}, ABOUT),
        ({**contiguous, "more": np.array(8)}, ABOUT),
        ({**contiguous, "flags": contiguous["flags"].astype(np.uint8)}, ABOUT),
        ({**contiguous, "transposed": contiguous["transposed"].reshape(2, 3)}, ABOUT),
    ):
        other.write_bytes(save(arrays, {**about, DIGEST: seal}))
        with pytest.raises(DamagedFileError):
            read_sealed(other)


def test_a_header_that_is_no_mapping(path):
    for header in (b"[]", b"7", b'{"__metadata__": 3}', b'{"__metadata__": {}}', b"{"):
        path.write_bytes(struct.pack("<Q", len(header)) + header)
        with pytest.raises(DamagedFileError):
            read_sealed(path)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_sealed(tmp_path / "none.safetensors")
    with pytest.raises(IsADirectoryError):
        read_sealed(tmp_path)


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(OutputError):
        write_sealed(tmp_path / "none" / "sealed.safetensors", ARRAYS, ABOUT)


def test_a_full_disk_leaves_what_was_there(path, full_disk):
    before = path.read_bytes()
    with full_disk(), pytest.raises(OutputError, match="could not be written"):
        write_sealed(path, {"large": np.ones(10_000)}, ABOUT)
    assert path.read_bytes() == before
    assert [one.name for one in path.parent.iterdir()] == [path.name]
