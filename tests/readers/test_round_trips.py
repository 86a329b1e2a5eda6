"""The same samples written in every format read back equal to the last bit."""

import h5py
import hdf5storage
import numpy as np
import pandas as pd
import pytest
import scipy.io
from message_files import START, joint_state, write_bag

from bayes_impedance.config import LogConfig
from bayes_impedance.readers import read_log

N = 203
GENERATOR = np.random.default_rng(5)
#: Whole nanoseconds, since messages count them.
TIME = np.arange(N) * 5_000_000 / 1e9
POSITION, FORCE = GENERATOR.normal(size=(N, 3)), 10.0 * GENERATOR.normal(size=(N, 3))
ARRAYS = {"time": TIME, "position": POSITION, "force": FORCE}


def table() -> pd.DataFrame:
    columns = {
        f"{name}_{axis}": ARRAYS[name][:, a] for name in ("position", "force") for a, axis in enumerate("xyz")
    }
    return pd.DataFrame({"time": TIME} | columns)


def write(path):
    """The samples in the format of the ending; returns the path of what was written."""
    kind = path.name.split(".", 1)[1]
    if kind in ("bag", "db3", "mcap"):
        steps = [START + 5_000_000 * k for k in range(N)]
        rows = zip(steps, POSITION, FORCE, strict=True)
        return write_bag(path, [joint_state("/robot_state", at, x, u) for at, x, u in rows])
    if kind == "h5":
        with h5py.File(path, "w") as file:
            for name, values in ARRAYS.items():
                file[name] = values
    elif kind == "v5.mat":
        scipy.io.savemat(path, ARRAYS)
    elif kind == "v73.mat":
        hdf5storage.savemat(str(path), ARRAYS, format="7.3", appendmat=False)
    elif kind == "npz":
        np.savez(path, **ARRAYS)
    elif kind == "parquet":
        table().to_parquet(path)
    else:
        table().to_csv(path, index=False, sep={"csv": ",", "tsv": "\t", "txt": " "}[kind])
    return path


def columns_in(path) -> dict[str, str]:
    if path.suffix in (".bag", ".db3", ".mcap"):
        return {"position": "/robot_state.position[{index}]", "force": "/robot_state.effort[{index}]"}
    arrays = path.suffix in (".h5", ".mat", ".npz")
    return {"position": "position[{index}]", "force": "force[{index}]"} if arrays else {}


@pytest.mark.parametrize(
    "kind", ["bag", "db3", "mcap", "h5", "v5.mat", "v73.mat", "npz", "csv", "tsv", "txt", "parquet"]
)
def test_the_same_samples_read_back_equal(tmp_path, kind):
    path = write(tmp_path / f"log.{kind}")
    (trial,) = read_log(path, LogConfig.model_validate({"columns": columns_in(path)})).trials
    np.testing.assert_array_equal(trial.time, TIME)
    np.testing.assert_array_equal(trial.position, POSITION)
    np.testing.assert_array_equal(trial.force, FORCE)
