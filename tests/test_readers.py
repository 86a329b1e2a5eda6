"""Tables as interaction logs: formats, mapping, units, and every way a file can be wrong."""

import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from bayes_impedance.config import Columns, LogConfig, Units, Window
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.readers import read_log

SEPARATORS = {".csv": ",", ".tsv": "\t", ".txt": " "}


def frame(n=6, axes="x", **columns):
    time = np.arange(n) * 0.1
    data = {"time": time}
    for index, axis in enumerate(axes):
        data |= {f"position_{axis}": np.sin(time + index), f"force_{axis}": np.cos(time + index)}
    return pd.DataFrame(data | columns)


def write(table, path):
    if path.suffix in SEPARATORS:
        table.to_csv(path, sep=SEPARATORS[path.suffix], index=False)
    else:
        table.to_parquet(path, index=False)
    return path


@pytest.fixture
def file(tmp_path):
    """Function that writes text to a file."""

    def write_text(text, name="log.csv"):
        (tmp_path / name).write_text(text, encoding="utf-8")
        return tmp_path / name

    return write_text


# --- what goes in comes out ----------------------------------------------------------------------

number = st.floats(-4, 4, allow_subnormal=True)


@st.composite
def tables(draw):
    n = draw(st.integers(2, 8))
    column = st.lists(number, min_size=n, max_size=n)
    steps = draw(st.lists(st.floats(1e-3, 10), min_size=n, max_size=n))
    data = {"time": np.cumsum(steps)}
    axes = draw(st.sampled_from(["x", "y", "xz", "xyz"]))
    for axis in axes:
        data[f"position_{axis}"], data[f"force_{axis}"] = draw(column), draw(column)
        assume(np.ptp(data[f"position_{axis}"]) > 0 and np.any(data[f"force_{axis}"]))
    for name in draw(st.sets(st.sampled_from(["velocity", "acceleration", "reference", "perturbation"]))):
        data |= {f"{name}_{axis}": draw(column) for axis in axes}
    for name in draw(st.sets(st.sampled_from(["stiffness_xx", "damping_xy", "residual_force_z"]))):
        data[name] = draw(column)
    label = st.sampled_from(["a", "b c", "7", "NA", "-3"])
    labels = draw(st.lists(label, min_size=2, max_size=2, unique=True))
    if draw(st.booleans()) and n >= 4:
        data["trial"] = [labels[int(index >= n // 2)] for index in range(n)]
    if draw(st.booleans()):
        data["group"] = [labels[0]] * n
    order = draw(st.permutations(list(data)))
    return pd.DataFrame(data)[order], axes


@settings(max_examples=60, deadline=None)
@given(tables(), st.sampled_from([".csv", ".tsv", ".parquet", ".pq"]))
def test_round_trip(table_and_axes, suffix):
    table, axes = table_and_axes
    with tempfile.TemporaryDirectory() as folder:
        log = read_log(write(table, Path(folder) / f"log{suffix}"))
    assert log.axes == tuple(axes)
    parts = table.groupby("trial", sort=False) if "trial" in table else [("0", table)]
    for trial, (name, part) in zip(log.trials, parts, strict=True):
        assert (trial.name, trial.source) == (name, f"log{suffix}")
        assert trial.group == (part["group"].iloc[0] if "group" in part else "0")
        np.testing.assert_array_equal(trial.time, part["time"])
        for quantity in ("position", "force", "velocity", "acceleration", "reference", "perturbation"):
            columns = [f"{quantity}_{axis}" for axis in axes]
            if columns[0] in part:
                np.testing.assert_array_equal(getattr(trial, quantity), part[columns])
            else:
                assert getattr(trial, quantity) is None
        assert set(trial.truth) == set(part) & {"stiffness_xx", "damping_xy", "residual_force_z"}
        for column, values in trial.truth.items():
            np.testing.assert_array_equal(values, part[column])


@pytest.mark.parametrize("separator", [",", ";", "\t", "   ", ", ", " "])
@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
def test_delimiters_line_endings_blank_lines_and_byte_order_mark(tmp_path, separator, ending):
    lines = ["", "time position_x force_x", "0 1 2", "", "1 2 3", "2 2 -1e-1", "", ""]
    text = ending.join(line.replace(" ", separator) for line in lines)
    (tmp_path / "log.txt").write_bytes(b"\xef\xbb\xbf" + text.encode())
    trial = read_log(tmp_path / "log.txt").trials[0]
    np.testing.assert_array_equal(trial.position[:, 0], [1, 2, 2])
    np.testing.assert_array_equal(trial.force[:, 0], [2, 3, -0.1])
    np.testing.assert_array_equal(trial.rows.numbers, [3, 5, 6])


def test_delimiter_by_configuration_and_quotes(file):
    path = file('"time"|"position_x"|force_x|trial\n0|1|2|"a|b"\n1|2|3|"a|b"\n')
    log = read_log(str(path), LogConfig(delimiter="|"))
    assert log.trials[0].name == "a|b"


def test_mapping_units_and_direction(tmp_path):
    table = pd.DataFrame(
        {"t": [0, 1000, 2000], "py": [1, 2, 4], "F_y": [1.0, 2, 3], "dy": [1, 2, 3], "ddy": [1, 2, 3]}
        | {"goal_y": [10, 20, 30], "push_y": [1, 1, 1]}
    )
    columns = Columns(
        time="t",
        position="p{axis}",
        force="F_{axis}",
        velocity="d{axis}",
        acceleration="dd{axis}",
        reference="goal_{axis}",
        perturbation="push_{axis}",
    )
    units = Units(time="ms", position="mm", velocity="cm/s", acceleration="mm/s^2", force="kN")
    config = LogConfig(columns=columns, units=units, force_direction="robot_on_human")
    (trial,) = read_log(write(table, tmp_path / "a.csv"), config).trials
    np.testing.assert_array_equal(trial.time, [0, 1, 2])
    np.testing.assert_allclose(trial.position[:, 0], [1e-3, 2e-3, 4e-3], rtol=1e-15)
    np.testing.assert_allclose(trial.velocity[:, 0], [1e-2, 2e-2, 3e-2], rtol=1e-15)
    np.testing.assert_allclose(trial.acceleration[:, 0], [1e-3, 2e-3, 3e-3], rtol=1e-15)
    np.testing.assert_allclose(trial.reference[:, 0], [1e-2, 2e-2, 3e-2], rtol=1e-15)
    np.testing.assert_allclose(trial.force[:, 0], [-1e3, -2e3, -3e3], rtol=1e-15)
    np.testing.assert_allclose(trial.perturbation[:, 0], [1e3] * 3, rtol=1e-15)


def test_axes_are_those_with_position_and_force(tmp_path):
    table = frame(axes="xy").drop(columns="force_x")
    path = write(table, tmp_path / "a.csv")
    with pytest.warns(
        LogWarning, match="axis x has a column 'position_x' but none named 'force_x'.*log.axes"
    ):
        assert read_log(path).axes == ("y",)
    assert read_log(path, LogConfig(axes=("y",))).axes == ("y",)
    with pytest.raises(LogError, match=r"a.csv: expected column 'force_x'"):
        read_log(path, LogConfig(axes=("x", "y")))
    with pytest.raises(LogError, match=r"expected column 'force_x', .* set log.columns.force to the name"):
        read_log(path, LogConfig(axes=("x", "y")), require_force=False)


@pytest.mark.parametrize(
    ("right", "wrong"), [("position_x", "positon_x"), ("force_x", "Force_x"), ("force_x", "forcex")]
)
def test_a_misspelt_column_does_not_drop_its_axis(tmp_path, right, wrong):
    path = write(frame(axes="xy").rename(columns={right: wrong}), tmp_path / "a.csv")
    for require_force in (True, False):
        with pytest.raises(LogError, match=rf"expected column '{right}', .*the nearest is '{wrong}'"):
            read_log(path, require_force=require_force)


def test_misspelt_forces_are_not_taken_for_none(tmp_path):
    table = frame(axes="xy").rename(columns={"force_x": "forces_x", "force_y": "forces_y"})
    with pytest.raises(LogError, match=r"expected column 'force_x', .*the nearest is 'forces_x'"):
        read_log(write(table, tmp_path / "a.csv"), require_force=False)


def test_force_may_be_absent_only_when_not_required(tmp_path):
    path = write(frame(axes="xy")[["time", "position_x", "position_y"]], tmp_path / "a.csv")
    log = read_log(path, require_force=False)
    assert log.axes == ("x", "y") and log.trials[0].force is None
    with pytest.raises(
        LogError, match=r"expected column 'force_x', found none of that name \(the nearest is"
    ):
        read_log(path)
    assert read_log(write(frame(), tmp_path / "b.csv"), require_force=False).trials[0].force is not None


def test_labels(tmp_path):
    table = frame(trial=[1.0, 2, 1, 2, 1, 2], group=["S"] * 6, repetition=[5, 9, 5, 9, 4, 9], phase=[0.1] * 6)
    table["phase"] = [0.1, 0.1, 0.2, 0.2, 0.1, 0.3]
    for suffix in (".csv", ".parquet"):
        log = read_log(write(table, tmp_path / f"a{suffix}"))
        # Rows of a trial may lie apart.
        assert [(trial.name, trial.group) for trial in log.trials] == [("1", "S"), ("2", "S")]
        np.testing.assert_array_equal(log.trials[0].time, table["time"][::2])
        np.testing.assert_array_equal(log.trials[0].repetition, [0, 0, 1])
        np.testing.assert_array_equal(log.trials[1].phase, [0.1, 0.2, 0.3])


def test_window_cuts_each_trial(tmp_path):
    table = pd.concat([frame(trial=["a"] * 6), frame(trial=["b"] * 6), frame(3, trial=["c"] * 3)])
    table.iloc[0, 1] = np.nan  # outside the window, so nobody minds
    path = write(table, tmp_path / "a.csv")
    log = read_log(path, LogConfig(window=Window(start=0.3, end=0.5)))
    assert [trial.name for trial in log.trials] == ["a", "b"]
    np.testing.assert_array_equal(log.trials[1].time, table["time"][3:5])
    assert log.trials[1].rows.numbers.tolist() == [11, 12]
    with pytest.raises(
        LogError, match=r"within log.window \(start 7.0, end None s\), .* spans 0 to 0.5 s; change"
    ):
        read_log(path, LogConfig(window=Window(start=7)))


def test_several_files(tmp_path):
    for folder in ("s1", "s2", "s2/deep"):
        (tmp_path / folder).mkdir()
    paths = [tmp_path / name for name in ("s1/a.csv", "s2/a.csv", "s2/deep/b.tsv")]
    for path in paths:
        write(frame(), path)
    log = read_log(paths)
    assert [trial.source for trial in log.trials] == ["s1/a.csv", "s2/a.csv", "b.tsv"]
    assert [trial.name for trial in log.trials] == ["0", "0", "0"]
    with pytest.raises(LogError, match=r"a.csv: expected each file once, found it twice; name it once"):
        read_log([paths[0], tmp_path / "s2" / ".." / "s1" / "a.csv"])
    with pytest.raises(LogError, match="expected at least one file to read, found none"):
        read_log([])
    write(frame(axes="xy"), paths[2])
    with pytest.raises(
        LogError, match=r"axes that differ between files: x in s1/a.csv and x, y in b.tsv; set log"
    ):
        read_log(paths)


def test_parquet_index_dictionary_integers_and_dots(tmp_path):
    # A column that pandas made the index is a column all the same.
    table = (
        frame(trial=pd.Categorical(["a"] * 6)).rename(columns={"force_x": "wrench.force.x"}).set_index("time")
    )
    table["count"] = 2**60 + np.arange(6)
    table.to_parquet(tmp_path / "a.parquet")
    config = LogConfig(columns=Columns(force="wrench.force.{axis}"))
    log = read_log(tmp_path / "a.parquet", config)
    np.testing.assert_array_equal(log.trials[0].time, table.index)
    assert log.trials[0].name == "a"
    config = LogConfig(columns=Columns(time="count", force="wrench.force.{axis}"), units=Units(time="ns"))
    with pytest.raises(LogError, match="found duplicate time stamps at rows 2, 3, 4"):
        read_log(tmp_path / "a.parquet", config)


def test_text_as_numbers_in_parquet(tmp_path):
    table = frame(position_x=["1", "2.5", " 3", "4", "5", "6"])
    log = read_log(write(table, tmp_path / "a.parquet"))
    np.testing.assert_array_equal(log.trials[0].position[:, 0], [1, 2.5, 3, 4, 5, 6])


# --- columns that lack ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("table", "config", "message"),
    [
        (
            frame().rename(columns={"force_x": "Force_X"}),
            LogConfig(),
            r"log.csv: expected column 'force_x', found none of that name \(the nearest is 'Force_X'\); "
            "set log.columns.force to the name in the file",
        ),
        (
            frame().drop(columns="time"),
            LogConfig(),
            "expected column 'time', .*; set log.columns.time to the name",
        ),
        (
            frame().drop(columns="position_x"),
            LogConfig(),
            "expected column 'position_x'.* log.columns.position",
        ),
        (
            pd.DataFrame({f"q{i}": [1, 2] for i in range(9)}),
            LogConfig(),
            r"expected column 'position_x', .* \(there is 'q0', 'q1', 'q2', 'q3', 'q4', …\); set",
        ),
        (frame(), LogConfig(axes=("x", "y")), "expected column 'position_y'"),
        (
            frame(),
            LogConfig(columns=Columns(velocity="vel_{axis}")),
            "expected column 'vel_x', .*; set log.columns.velocity to null or to the name in the file",
        ),
        (
            frame(),
            LogConfig(columns=Columns(trial="run")),
            "expected column 'run', .* log.columns.trial to null or",
        ),
        (
            frame(axes="xy", velocity_x=[1] * 6),
            LogConfig(),
            "expected column 'velocity_y', .* log.columns.velocity",
        ),
        (
            frame(trial=[1, 1, 1, 1, 1, np.nan]),
            LogConfig(),
            "'trial': expected a label in every cell, .* at line 7;",
        ),
        (
            frame(trial=["a"] * 6, group=["A"] * 3 + ["B"] * 3),
            LogConfig(),
            "log.csv, trial 'a': expected one group a trial, found 'A' and 'B'; label trials",
        ),
        (frame(1), LogConfig(), "log.csv, trial '0': expected at least two samples, found one sample"),
        (frame(position_x=[1] * 6), LogConfig(), "log.csv: expected motion along axis x"),
        (frame(time=[0, 1, 2, 2, 3, 4]), LogConfig(), "log.csv, trial '0', column time: .* at line 5"),
        (frame(time=[0, 1, 2, 1, 3, 4]), LogConfig(), "time goes back at line 5"),
    ],
)
def test_refuses_table(tmp_path, table, config, message):
    with pytest.raises(LogError, match=message):
        read_log(write(table, tmp_path / "log.csv"), config)


def test_null_leaves_a_column_out(tmp_path):
    path = write(frame(trial=["a"] * 6, velocity_x=[np.nan] * 6), tmp_path / "log.csv")
    with pytest.raises(
        LogError, match=r"'velocity_x': .* or leave the column out with log.columns.velocity: null"
    ):
        read_log(path)
    (trial,) = read_log(path, LogConfig(columns=Columns(trial=None, velocity=None))).trials
    assert trial.name == "0" and trial.velocity is None


# --- cells that are wrong ------------------------------------------------------------------------

HEAD = "time,position_x,force_x,note\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            HEAD + "0,1,1,a\n1,2,abc,b\n",
            "column 'force_x': expected numbers, found 'abc' at line 3; mend the cell",
        ),
        (HEAD + "0,1,1,a\n\n1,2,abc,b\n", "found 'abc' at line 4"),
        (HEAD + "0,1,1,a\n1,2,1_0,b\n", "found '1_0' at line 3"),
        (
            HEAD + "0,1,True,a\n1,2,False,b\n",
            "column 'force_x': expected numbers, found 'True' at line 2, of type",
        ),
        ("time;position_x;force_x\n0;1;1\n1;2;0,5\n", "found '0,5' at line 3; write decimals with a point"),
        (
            HEAD + "0,1,1,a\n1,2,,b\n",
            "expected finite numbers, found nan or an empty cell at line 3; fill or",
        ),
        (
            HEAD + "0,1,1,a\n1,-inf,1,b\n",
            "column 'position_x': expected finite numbers, found -inf .* at line 3",
        ),
        (HEAD + "0,1,1,a\n1,1e999,1,b\n", "column 'position_x': expected finite numbers, found inf"),
        (HEAD + "0,1,NA,a\n1,2,abc,b\n", "found 'abc' at line 3"),
        (HEAD + "0,nan,1,a\n" * 5, "column 'position_x': .* at lines 2, 3, 4 and 2 more"),
        (HEAD + "0,1,1,a\nnan,2,1,b\n", "column 'time': expected finite numbers, .* at line 3"),
        (
            HEAD + "0,1,1,a\n1,2,1\n",
            "log.csv, line 3: expected 4 cells as in the header, found 3; mend the line",
        ),
        (HEAD + "0,1,5,1,a\n1,2,5,1,b\n", "line 2: expected 4 cells as in the header, found 5"),
        (HEAD + '0,1,1,"a,b"\n1,2,1,"a",b\n', "line 3: expected 4 cells as in the header, found 5"),
        (
            HEAD + '0,1,1,"a\n1,2,1,b"\n',
            r"expected cells separated by ',', found '0,1,1,\"a' .* mend the quotes",
        ),
        ("time position_x force_x\n0 1 1\n1 2\n", "line 3: expected 3 cells as in the header, found 2"),
        (
            "time,position_x,position_x,force_x\n0,1,1,1\n1,2,2,2\n",
            "expected one column 'position_x', found 2",
        ),
        ("0,1,2\n1,2,3\n", "expected names of columns in the first line, found numbers; add a header line"),
        ("", "log.csv: expected a header line and samples, found an empty file"),
        ("\n \n\n", "found an empty file"),
        (HEAD, "log.csv: expected samples below the header line, found none"),
        (HEAD + "0,1\0,1,a\n", "log.csv: expected text, found binary data"),
        ("q" * 200_000 + ",b\n1,2\n", "expected cells separated by ','"),
    ],
)
def test_refuses_text(file, text, message):
    with pytest.raises(LogError, match=message) as caught:
        read_log(file(text))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (frame(force_x=[1, 2, 3, np.nan, 5, 6]), "column 'force_x': expected finite numbers, .* at row 4"),
        (
            frame(force_x=["1", "2", "3", "x", "5", None]),
            "column 'force_x': expected numbers, found 'x' at row 4",
        ),
        (
            frame(force_x=[None] * 6),
            "column 'force_x': expected finite numbers, .* at rows 1, 2, 3 and 3 more",
        ),
        (
            frame(time=pd.date_range("2024-01-01", periods=6)),
            "'time': expected numbers, found '2024-.* convert",
        ),
        (frame(force_x=[True] * 6), "'force_x': expected numbers, found 'True' at row 1, of type bool"),
        (frame(force_x=[[1, 2]] * 6), r"'force_x': expected numbers, found '\[1 2\]' at row 1"),
        (frame(trial=["a"] * 5 + [None]), "'trial': expected a label in every cell, found none at row 6"),
        (frame(time=[0, 1, 2, 2, 3, 4]), "found duplicate time stamps at row 4"),
        (frame(0), "a.parquet: expected samples, found a table without rows"),
    ],
)
def test_refuses_parquet(tmp_path, table, message):
    with pytest.raises(LogError, match=message):
        read_log(write(table, tmp_path / "a.parquet"))


def test_refuses_duplicate_parquet_columns(tmp_path):
    columns = [pa.array([0.0, 1.0])] * 4
    pq.write_table(
        pa.table(columns, names=["time", "position_x", "force_x", "force_x"]), tmp_path / "a.parquet"
    )
    with pytest.raises(LogError, match="expected one column 'force_x', found 2; rename the others"):
        read_log(tmp_path / "a.parquet")


# --- files that are wrong ------------------------------------------------------------------------


def test_refuses_files_it_cannot_read(tmp_path, file):
    with pytest.raises(LogError, match=r"nothing.csv: expected a recording, found no such file at"):
        read_log(tmp_path / "nothing.csv")
    with pytest.raises(LogError, match="expected a file, found a folder; name the recordings in it"):
        read_log(tmp_path)
    with pytest.raises(
        LogError, match=r"log.xlsx: expected a file that ends in .csv, .* found '.xlsx'; convert it"
    ):
        read_log(file("a", "log.xlsx"))
    with pytest.raises(LogError, match="found no ending; convert it"):
        read_log(file("a", "log"))
    (tmp_path / "latin.csv").write_bytes("time,weg_µm\n0,1\n".encode("latin-1"))
    with pytest.raises(
        LogError, match=r"latin.csv: expected text in UTF-8, found byte 0xb5 at position 9; save it"
    ):
        read_log(tmp_path / "latin.csv")
    (tmp_path / "noise.csv").write_bytes(np.random.default_rng(0).bytes(5000))
    with pytest.raises(LogError, match=r"noise.csv: expected text"):
        read_log(tmp_path / "noise.csv")


def test_refuses_an_unreadable_file(file, monkeypatch):
    path = file(HEAD + "0,1,1,a\n1,2,1,b\n")

    def refuse(self, mode):
        raise PermissionError(13, "Permission denied")

    # Taking the permission away does not keep root from reading.
    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(
        LogError, match=r"log.csv: expected a readable file, found: Permission denied; check the file"
    ):
        read_log(path)


@pytest.mark.parametrize("cut", [0, 3, 10, 0.3, 0.7, 0.99])
def test_refuses_truncated_parquet(tmp_path, cut):
    path = write(frame(500), tmp_path / "a.parquet")
    data = path.read_bytes()
    path.write_bytes(data[: cut if cut in (0, 3, 10) else int(cut * len(data))])
    with pytest.raises(
        LogError, match=r"a.parquet: expected a Parquet file, found one that is truncated or"
    ) as caught:
        read_log(path)
    assert "\n" not in str(caught.value)


def test_refuses_parquet_with_damaged_pages(tmp_path):
    path = write(frame(500), tmp_path / "a.parquet")
    data = bytearray(path.read_bytes())
    data[4:2000] = bytes(1996)
    path.write_bytes(data)
    with pytest.raises(LogError, match=r"a.parquet: expected a readable table, found: .*; write it anew"):
        read_log(path)


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=200), st.sampled_from([".csv", ".tsv", ".txt", ".parquet"]), st.booleans())
def test_garbage_gives_a_log_error(data, suffix, headed):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        path.write_bytes((HEAD.encode() if headed else b"") + data)
        with pytest.raises(LogError):
            read_log(path)


# --- real recordings -----------------------------------------------------------------------------


def test_iiwa(shared_data):
    (path,) = (shared_data / "iiwa_known_equilibrium").glob("*.txt")
    columns = Columns(position="{axis}", force="f_{axis}", reference="{axis}0", velocity="d{axis}")
    config = LogConfig(
        axes=("z",), columns=columns, force_direction="robot_on_human", window=Window(start=6.0)
    )
    log = read_log(path, config)
    (trial,) = log.trials
    assert log.axes == ("z",) and 6.0 <= trial.time[0] < 6.01
    whole = read_log(path, config.model_copy(update={"window": Window()})).trials[0]
    assert np.corrcoef(whole.velocity[:, 0], np.gradient(whole.position[:, 0], whole.time))[0, 1] > 0.99
    # The data's own README: f_z = 138 (z - z0) + 1.2 N on the robot, correlation .993.
    slope, offset = np.polyfit((trial.reference - trial.position)[:, 0], trial.force[:, 0], 1)
    assert slope == pytest.approx(138, abs=0.5) and offset == pytest.approx(-1.2, abs=0.05)


def test_delta_robot(shared_data):
    path = shared_data / "delta_robot" / "pHRI_test_experiment_dataset.csv"
    columns = Columns(time="t", position="{axis}", force="F{axis}", velocity="v{axis}")
    log = read_log(path, LogConfig(columns=columns, units=Units(position="mm", velocity="mm/s")))
    (trial,) = log.trials
    assert log.axes == ("x", "y", "z") and trial.n_samples == 1123
    assert trial.time[-1] - trial.time[0] == pytest.approx(55, abs=0.5)
    assert np.abs(trial.velocity).max() == pytest.approx(4.5e-3, rel=0.01)
    assert np.ptp(trial.position[:, 2]) < 0.1
    with pytest.raises(LogError, match=r"expected column 'position_x', .* set log.columns.position"):
        read_log(path)
