"""HDF5 as others write it: text, chunks, links, types that are no numbers, and sizes that are only declared."""

import h5py
import numpy as np
import pytest

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError
from bayes_impedance.readers import read_log
from bayes_impedance.readers.arrays import hdf5
from bayes_impedance.readers.read import open_file

CONFIG = LogConfig.model_validate(
    {"columns": {"position": "robot/position[{index}]", "force": "force[{index}]"}}
)
N = 50
RANDOM = np.random.default_rng(0)
TIME, POSITION, FORCE = np.arange(N) * 0.01, RANDOM.normal(size=(N, 3)), RANDOM.normal(size=(N, 3))


def fill(group: h5py.Group, **options) -> None:
    group["time"] = TIME
    group.create_dataset("robot/position", data=POSITION, **options)
    group.create_dataset("force", data=FORCE, **options)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "log.h5"


def assert_whole(trial) -> None:
    np.testing.assert_array_equal(trial.position, POSITION)
    np.testing.assert_array_equal(trial.force, FORCE)


@pytest.mark.parametrize(
    "options",
    [
        {"chunks": (7, 3)},
        {"chunks": (7, 1), "compression": "gzip", "shuffle": True, "fletcher32": True},
        {"compression": "lzf"},
        {"maxshape": (None, 3)},
    ],
)
@pytest.mark.parametrize("version", ["earliest", "latest"])
def test_chunks_and_filters(path, options, version):
    with h5py.File(path, "w", libver=version) as file:
        fill(file, **options)
    assert_whole(read_log(path, CONFIG).trials[0])
    (trial,) = read_log(path.rename(path.with_suffix(".HDF5")), CONFIG).trials
    assert_whole(trial)


@pytest.mark.parametrize("dtype", [h5py.string_dtype(), h5py.string_dtype(length=12), "S12"])
@pytest.mark.parametrize("options", [{}, {"chunks": (7,)}, {"chunks": (7,), "compression": "gzip"}])
def test_text_of_every_kind_labels(path, dtype, options):
    names = ["reach", "rest"] if dtype == "S12" else ["über", "b"]
    with h5py.File(path, "w") as file:
        fill(file)
        trial = file.create_dataset("trial", (N,), dtype=dtype, **options)
        labels = np.repeat([name.encode() for name in names], N // 2)
        trial[:] = labels.astype(trial.dtype)
        file["group"] = "Ada"
    log = read_log(path, CONFIG)
    assert [(trial.name, trial.group) for trial in log.trials] == [(name, "Ada") for name in names]


def test_text_in_a_structured_array(path):
    kind = np.dtype([("x", "f8"), ("trial", h5py.string_dtype()), ("from", h5py.ref_dtype)])
    with h5py.File(path, "w") as file:
        table = file.create_dataset("table", (3,), dtype=kind)
        for index in range(3):
            table[index] = (index, "ab"[index // 2], table.ref)
    columns = {"position": "position_{axis}", "force": "force_{axis}"}
    with pytest.raises(LogError, match=r"there is table/x \(3,\), table/trial \(3,\), table/from \(3,\)\)"):
        read_log(path, LogConfig.model_validate({"columns": columns}))


def test_links(path, tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as other:
        fill(other)
    with h5py.File(path, "w") as file:
        fill(file.create_group("trial_1"))
        # A recording has one name, an array may have several.
        file["latest"] = h5py.SoftLink("/trial_1")
        file["trial_2/force"] = h5py.SoftLink("/trial_1/force")
        file["trial_2/robot"] = file["trial_1/robot"]
        file["trial_2/time"] = file["trial_1/time"]
        # Round in circles, to nowhere, and out of the file.
        file["trial_1/root"] = file["/"]
        file["nowhere"] = h5py.SoftLink("/nothing")
        file["elsewhere"] = h5py.ExternalLink("other.h5", "/")
    log = read_log(path, CONFIG)
    assert [trial.name for trial in log.trials] == ["trial_1", "trial_2"]
    for trial in log.trials:
        assert_whole(trial)


def test_types_that_are_no_numbers_are_passed_over(path):
    with h5py.File(path, "w") as file:
        fill(file)
        file["image"] = np.zeros((40, 50))
        file["film"] = np.zeros((4, 5, 6))
        file["empty"] = h5py.Empty("f8")
        file.create_dataset("ragged", (3,), dtype=h5py.vlen_dtype(np.float64))
        file.create_dataset("opaque", data=np.zeros(3, "V5"))
        file["reference"] = file["time"].ref
        file["type"] = np.dtype("f8")
        file["choice"] = np.array([True, False])
    (table,) = open_file(path, "log", CONFIG).tables
    assert {name.partition("[")[0] for name in table.columns} == {
        "time",
        "robot/position",
        "force",
        "empty",
        "choice",
    }
    assert_whole(read_log(path, CONFIG).trials[0])


def test_only_wanted_columns_are_read(path, monkeypatch):
    selections = []
    plain = h5py.Dataset.__getitem__

    def spied(self, selection, **options):
        selections.append((self.name, selection))
        return plain(self, selection, **options)

    with h5py.File(path, "w") as file:
        fill(file)
        file["spectrum"] = np.zeros((N, 30))
    monkeypatch.setattr(h5py.Dataset, "__getitem__", spied)
    (trial,) = read_log(path, CONFIG.model_copy(update={"axes": ("y",)})).trials
    np.testing.assert_array_equal(trial.position[:, 0], POSITION[:, 1])
    assert sorted(selections, key=str) == [
        ("/force", (slice(None), slice(1, 2))),
        ("/robot/position", (slice(None), slice(1, 2))),
        ("/time", (slice(None),)),
    ]


# --- sizes that are only declared ----------------------------------------------------------------


def test_a_huge_array_is_refused_before_it_is_read(path):
    with h5py.File(path, "w") as file:
        fill(file)
        del file["force"]
        file.create_dataset("force", (10**12, 3), dtype="f8", chunks=(1000, 3), compression="gzip")
    with pytest.raises(
        LogError,
        match=r"log.h5: expected at most 4 GB in the columns of a file, found arrays that are declared to take "
        r"2.24e\+04 GB; split the recording, or check the file",
    ):
        read_log(path, CONFIG)
    # Nobody wants z.
    with h5py.File(path, "a") as file:
        del file["force"]
        file["force"] = FORCE
        file.create_dataset("noise", (10**12,), dtype="f8", chunks=(1000,))
    assert_whole(read_log(path, CONFIG).trials[0])


def test_a_huge_chunk_is_refused(path):
    with h5py.File(path, "w", libver="latest") as file:
        fill(file)
        del file["force"]
        file.create_dataset("force", (N, 3), dtype="f8", chunks=(2**28, 3), maxshape=(None, 3))
    with pytest.raises(LogError, match="declared to take 6 GB"):
        read_log(path, CONFIG)


def test_damaged_text_is_refused(path):
    """HDF5 alone would take gigabytes at one of these, and not return from the others."""
    with h5py.File(path, "w") as file:
        fill(file)
        labels = file.create_dataset("trial", data=[f"{index // 25}" for index in range(N)])
        offset = labels.id.get_offset()
    data = path.read_bytes()
    heap = data.index(hdf5.HEAP)
    assert len(read_log(path, CONFIG).trials) == 2
    for at, damage, found in (
        (offset, b"\xff\xff\xff\xff", "the lengths of its texts are damaged"),
        (heap + 8, b"\xff\xff\xff\x00", "the sizes of its texts are damaged"),
        (heap + 24, b"\x00\x00\x01", "the sizes of its texts are damaged"),
        (heap + 16, b"\x00\x00", "the sizes of its texts are damaged"),
    ):
        path.write_bytes(data[:at] + damage + data[at + len(damage) :])
        with pytest.raises(
            LogError, match=rf"log.h5: expected an HDF5 file, found one that .* \({found}\); save"
        ):
            read_log(path, CONFIG)
