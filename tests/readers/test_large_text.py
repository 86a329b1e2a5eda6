"""Text in pieces: wherever a piece ends, the log is the same to the bit, and so is every sentence."""

import numpy as np
import pandas as pd
import pytest

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError
from bayes_impedance.readers import read_log, text

#: So small that a piece ends within headers, cells, line ends and characters.
PIECES = [1, 2, 3, 7, 20, 64]


@pytest.fixture(params=PIECES)
def pieces(request, monkeypatch):
    """Everything is read in pieces of so many bytes."""
    monkeypatch.setattr(text, "PIECE", request.param)


def recording(n: int = 40) -> pd.DataFrame:
    random = np.random.default_rng(0)
    table = pd.DataFrame({"time": np.cumsum(random.uniform(0.001, 0.1, n))})
    for name in ("position_x", "force_x"):
        table[name] = random.normal(size=n) * 10.0 ** random.integers(-12, 0, n)
    # Whole numbers in some pieces, fractions in others, and one that has no float64 of its own.
    table["velocity_x"] = [str(index) for index in range(n - 2)] + ["0.5", str(2**53 + 1)]
    table["group"] = "über"
    table["trial"] = ["007" if index < n // 2 else "b" for index in range(n)]
    table["repetition"] = [str(index // 10) for index in range(n)]
    return table


@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("separator", [",", "\t", "  "])
@pytest.mark.parametrize("last", ["", "\n", "\r", "\n\n \n"])
def test_pieces_are_the_whole(tmp_path, pieces, ending, separator, last):
    table = recording()
    rows = [separator.join(map(str, row)) for row in [list(table), *table.itertuples(index=False)]]
    # Blank lines count, but are no samples.
    rows[20:20] = ["", "  "]
    (tmp_path / "log.txt").write_bytes(b"\xef\xbb\xbf" + (ending.join(rows) + last).encode())
    first, second = read_log(tmp_path / "log.txt").trials
    assert (first.name, second.name, first.group) == ("007", "b", "über")
    for trial, part in ((first, table[:20]), (second, table[20:])):
        np.testing.assert_array_equal(trial.time, part["time"])
        np.testing.assert_array_equal(trial.position[:, 0], part["position_x"])
        np.testing.assert_array_equal(trial.force[:, 0], part["force_x"])
        np.testing.assert_array_equal(trial.velocity[:, 0], [float(cell) for cell in part["velocity_x"]])
        np.testing.assert_array_equal(trial.repetition, part["repetition"].astype(int) - part.index[0] // 10)
    lines = [2 + index + 2 * (index >= 19) for index in range(40)]
    np.testing.assert_array_equal(np.concatenate([first.rows.numbers, second.rows.numbers]), lines)


HEAD = "time,position_x,force_x\n"
BODY = "".join(f"{index},{index / 7},{index / 3}\n" for index in range(30))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (HEAD + BODY + "30,1\n" + BODY, "log.csv, line 32: expected 3 cells as in the header, found 2; mend"),
        (
            HEAD + BODY + "30,1,abc\n31,1,1\n",
            "'force_x': expected numbers, found 'abc' at line 32; mend the cell",
        ),
        (
            HEAD + BODY + "30,1,True\n31,1,1\n",
            "'force_x': expected numbers, found 'True' at line 32; mend the cell",
        ),
        (HEAD + BODY + "30,1,\n31,1,1\n", "column 'force_x': expected finite numbers, .* at line 32;"),
        (
            HEAD + "0,1,True\n1,2,False\n" * 9,
            "expected numbers, found 'True' at line 2, of type bool; convert",
        ),
        (HEAD + BODY + '30,1,"2\n', r"expected cells separated by ',', found '30,1,\"2' .*; mend the quotes"),
        (HEAD + BODY + "30,1,\0\n", "log.csv: expected text, found binary data; rename the file"),
        (HEAD, "expected samples below the header line, found none; record"),
        ("\n" * 50, "expected a header line and samples, found an empty file"),
    ],
)
def test_sentences_are_those_of_the_whole(tmp_path, pieces, content, message):
    (tmp_path / "log.csv").write_text(content, encoding="utf-8", newline="")
    with pytest.raises(LogError, match=message):
        read_log(tmp_path / "log.csv")


def test_the_position_of_a_byte_is_that_in_the_file(tmp_path, pieces):
    content = (HEAD + BODY).encode()
    (tmp_path / "log.csv").write_bytes(content + b"30,1,\xe4\n")
    with pytest.raises(
        LogError, match=rf"expected text in UTF-8, found byte 0xe4 at position {len(content) + 5}; save"
    ):
        read_log(tmp_path / "log.csv")


def test_a_file_that_vanishes_between_opening_and_loading(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(HEAD + BODY, encoding="utf-8")
    (table,) = text.open_text(path, "log.csv", LogConfig()).tables
    path.unlink()
    with pytest.raises(
        LogError, match="log.csv: expected a readable file, found: No such file or directory; check"
    ):
        table.load(["time"], ())


def test_opening_reads_only_the_beginning(tmp_path, monkeypatch):
    monkeypatch.setattr(text, "PIECE", 100)
    read = []
    whole = text._blocks

    def spied(file):
        for block in whole(file):
            read.append(len(block))
            yield block

    monkeypatch.setattr(text, "_blocks", spied)
    path = tmp_path / "log.csv"
    path.write_text(HEAD + BODY * 100, encoding="utf-8")
    (table,) = text.open_text(path, "log.csv", LogConfig()).tables
    assert table.columns == ("time", "position_x", "force_x")
    assert sum(read) <= 100


def test_labels_of_a_long_file_are_codes(tmp_path):
    table = recording(1000)
    table.to_csv(tmp_path / "log.csv", index=False)
    (opened,) = text.open_text(tmp_path / "log.csv", "log.csv", LogConfig()).tables
    (stream,) = opened.load(["trial", "time"], {"trial"})
    assert isinstance(stream.columns["trial"].dtype, pd.CategoricalDtype)
    assert list(stream.columns["trial"].cat.categories) == ["007", "b"]
