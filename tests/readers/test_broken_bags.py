"""Damaged bags end in a LogError or are read: never in a traceback, a hang, or memory without bound."""

import tempfile
import tracemalloc
import warnings
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from message_files import HIDDEN, START, joint_state, pose, wrench, write_bag

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import BayesImpedanceWarning, LogError
from bayes_impedance.readers import read_log
from bayes_impedance.readers.read import open_file

#: What a damaged file of some kilobytes may take [byte].
ROOM = 1 << 26
FORMATS = {
    "bag": (".bag", None),
    "bag in BZ2": (".bag", "bz2"),
    "bag in LZ4": (".bag", "lz4"),
    "db3": (".db3", None),
    "mcap": (".mcap", None),
    "mcap in Zstandard": (".mcap", "zstd"),
}


@pytest.fixture(scope="module", params=FORMATS)
def whole(request, tmp_path_factory):
    """Name and bytes of a small bag, with topics that are wanted and others."""
    ending, compression = FORMATS[request.param]
    messages = [
        message
        for i in range(6)
        for message in (
            joint_state("/robot_state", START + 1000 * i, (i, i, i), (1, 2, i)),
            pose("/pose", START + 1000 * i + 1, (1, 2, 3)),
            wrench("/ft", START + 1000 * i + 2, (1, 2, 3)),
        )
    ]
    file = write_bag(tmp_path_factory.mktemp("bags") / f"log{ending}", messages, compression)
    return file.name, file.read_bytes()


def read_damaged(name, raw):
    """Read by topics that are named, and load every column."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", BayesImpedanceWarning)
        file = Path(folder) / name
        file.write_bytes(raw)
        sentences: list[str] = []
        tracemalloc.start()
        try:
            for read in (lambda: read_log(file, HIDDEN), lambda: everything(file)):
                try:
                    read()
                except LogError as error:
                    sentences.append(str(error))
            assert all(sentence.startswith(name) for sentence in sentences), sentences
            assert tracemalloc.get_traced_memory()[1] < ROOM
        finally:
            tracemalloc.stop()


def everything(file):
    for table in open_file(file, file.name, LogConfig()).tables:
        table.load(table.columns, ())


examples = settings(max_examples=60, derandomize=True, deadline=None)


@pytest.mark.timeout(120)
@examples
@given(data=st.data())
def test_truncated(whole, data):
    name, raw = whole
    read_damaged(name, raw[: data.draw(st.integers(0, len(raw) - 1))])


@pytest.mark.timeout(120)
@examples
@given(data=st.data())
def test_flipped(whole, data):
    name, raw = whole
    damaged = bytearray(raw)
    for bit in data.draw(st.lists(st.integers(0, 8 * len(raw) - 1), min_size=1, max_size=8)):
        damaged[bit // 8] ^= 1 << bit % 8
    read_damaged(name, bytes(damaged))


@pytest.mark.timeout(120)
@examples
@given(data=st.data())
def test_spliced(whole, data):
    name, raw = whole
    first, last = sorted(data.draw(st.tuples(*[st.integers(0, len(raw))] * 2)))
    keep = data.draw(st.booleans())
    inserted = data.draw(st.one_of(st.binary(max_size=64), st.just(b"\xff" * 8), st.just(bytes(8))))
    read_damaged(name, raw[:first] + inserted + raw[first + len(inserted) if keep else last :])


@pytest.mark.timeout(120)
@examples
@given(data=st.data())
def test_words_that_may_be_lengths_replaced_by_huge_ones(whole, data):
    name, raw = whole
    at = data.draw(st.integers(0, len(raw) - 4))
    huge = data.draw(st.sampled_from([2**31, 2**31 - 1, 2**32 - 1, 10**8]))
    read_damaged(name, raw[:at] + huge.to_bytes(4, "little") + raw[at + 4 :])
