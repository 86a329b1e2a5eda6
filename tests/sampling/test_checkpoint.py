"""Chains on disk: what was written is read, anything else is refused in words."""

from pathlib import Path

import numpy as np
import pytest

from bayes_impedance.errors import OutputError
from bayes_impedance.sampling.checkpoint import Checkpoint

STATE = {
    "done": np.array(7),
    "standard": np.arange(6.0).reshape(2, 3).T,
    "diverging": np.array([True, False]),
    "random": np.arange(9, dtype=np.uint8),
    "empty": np.empty((0, 3)),
}


@pytest.fixture
def checkpoint(tmp_path: Path) -> Checkpoint:
    return Checkpoint(tmp_path / "posterior.nc.unfinished", {"model": "a", "data": "b"})


def test_what_was_written_is_read(checkpoint):
    assert checkpoint.read(0) is None
    checkpoint.write(0, STATE)
    state = checkpoint.read(0)
    assert state.keys() == STATE.keys()
    for name, values in STATE.items():
        assert state[name].dtype == values.dtype and state[name].shape == values.shape
        assert (state[name] == values).all()
    assert checkpoint.read(1) is None
    assert [path.name for path in checkpoint.folder.iterdir()] == ["chain-1.safetensors"]


def test_removal_leaves_what_others_put_there(checkpoint):
    checkpoint.write(0, STATE)
    checkpoint.write(1, STATE)
    note = checkpoint.folder / "note.txt"
    note.write_text("mine")
    checkpoint.remove()
    assert list(checkpoint.folder.iterdir()) == [note]
    note.unlink()
    checkpoint.remove()
    assert not checkpoint.folder.exists()
    checkpoint.remove()


@pytest.mark.parametrize(
    ("other", "sentence"),
    [
        ({"model": "c", "data": "b"}, r"another model \(a, now c\); go on with what it was started with"),
        (
            {"model": "a", "data": "d"},
            r"expected a checkpoint of what is sampled now, found one of another data",
        ),
        ({"model": "a"}, r"another data \(b, now none\)"),
        ({"model": "a", "data": "b", "seed": "1"}, r"another seed \(none, now 1\)"),
    ],
)
def test_of_something_else(checkpoint, other, sentence):
    checkpoint.write(0, STATE)
    with pytest.raises(OutputError, match=sentence):
        Checkpoint(checkpoint.folder, other).read(0)


def test_damaged_anywhere(checkpoint):
    checkpoint.write(0, STATE)
    path = checkpoint.path(0)
    content = path.read_bytes()
    generator = np.random.default_rng(0)
    damages = [
        b"",
        b"\0" * 8,
        b"not a tensor in sight",
        content[:-1],
        content[: len(content) // 2],
        content + b"\0",
    ]
    for place in generator.choice(len(content), 60, replace=False):
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(generator.integers(8))
        damages.append(bytes(flipped))
    for damage in damages:
        path.write_bytes(damage)
        with pytest.raises(
            OutputError, match="expected the checkpoint of a chain, found a damaged file; delete it"
        ):
            checkpoint.read(0)


def test_unreadable(checkpoint):
    checkpoint.path(0).mkdir(parents=True)
    with pytest.raises(OutputError, match="expected a checkpoint that can be read, got"):
        checkpoint.read(0)


def test_full_disk_leaves_the_one_before(checkpoint, full_disk):
    checkpoint.write(0, STATE)
    with full_disk(), pytest.raises(OutputError, match="could not be written"):
        checkpoint.write(0, {**STATE, "standard": np.zeros((1000, 3))})
    assert (checkpoint.read(0)["standard"] == STATE["standard"]).all()
