"""Save and resume: to the bit, whole or not at all, and of nothing else."""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from streams import SHARED, model_of, same, state, stream

from bayes_impedance.errors import LogError, OutputError
from bayes_impedance.online import OnlinePredictor
from bayes_impedance.sampling.checkpoint import Checkpoint
from bayes_impedance.sealed import read_sealed, write_sealed

OVERRIDES = (SHARED, "engine.local.width={position: 0.2, velocity: 1.0}", "engine.local.forgetting=500")


@pytest.fixture(scope="module")
def model():
    return model_of("position_velocity", OVERRIDES)


@pytest.fixture(scope="module")
def saved(model, tmp_path_factory):
    """A predictor in the middle of its stream, and its file."""
    path = tmp_path_factory.mktemp("state") / "state.safetensors"
    predictor = OnlinePredictor(model)
    for one in stream(model)[:25]:
        predictor.update(one)
    predictor.save(path)
    return path


def test_a_resumed_predictor_goes_on_to_the_same_bits(model, tmp_path):
    """Through a refresh on either side, with cells that are new after the save."""
    path, every = tmp_path / "state.safetensors", stream(model)
    plain = OnlinePredictor(model, warm=False)
    for one in every[:15]:
        plain.update(one)
    plain.save(path)
    resumed = OnlinePredictor.resume(path, model)
    assert (resumed.samples, resumed.last, resumed.cells) == (plain.samples, plain.last, plain.cells)
    assert same(state(resumed), state(plain))
    few = plain.cells
    for i in range(4):
        for one in every[15:]:
            later = one._replace(time=one.time + 100.0 * i)
            assert plain.update(later) is resumed.update(later)
    assert plain.cells > few
    assert same(state(resumed), state(plain))
    assert all(same(resumed.predict(one), plain.predict(one)) for one in every)


def test_a_save_changes_nothing_and_may_be_repeated(model, saved, tmp_path):
    one = OnlinePredictor.resume(saved, model)
    before = state(one)
    one.save(tmp_path / "other.safetensors")
    one.save(tmp_path / "other.safetensors")
    arrays, about = read_sealed(tmp_path / "other.safetensors")
    expected, other = read_sealed(saved)
    assert about == other
    assert arrays.keys() == expected.keys()
    assert all(arrays[name].tobytes() == expected[name].tobytes() for name in arrays)
    assert same(before, state(one))


def test_a_predictor_that_learned_nothing_is_saved_too(model, tmp_path):
    path = tmp_path / "state.safetensors"
    OnlinePredictor(model, warm=False).save(path)
    resumed = OnlinePredictor.resume(path, model)
    assert (resumed.samples, resumed.cells, resumed.last) == (0, 0, -np.inf)
    resumed.update(stream(model)[0])


def test_a_resumed_predictor_still_refuses_what_was_learned_before(model, saved):
    resumed = OnlinePredictor.resume(saved, model)
    with pytest.raises(LogError, match="expected one later than the last"):
        resumed.update(stream(model)[24])


KILLED = """
import sys
sys.path[:0] = {paths!r}
from streams import model_of, stream
from bayes_impedance.online import OnlinePredictor
model = model_of("position_velocity", {overrides!r})
predictor = OnlinePredictor(model, warm=False)
print("ready", flush=True)
for i in range(10_000):
    for one in stream(model) if i == 0 else []:
        predictor.update(one)
    predictor.save({path!r})
    print(i, flush=True)
"""


def test_a_kill_in_the_middle_of_a_save_leaves_a_whole_state(model, tmp_path):
    """No sample of the last save that ended is lost, and no half of one is read."""
    path = tmp_path / "state.safetensors"
    here = str(Path(__file__).parent.parent)
    code = KILLED.format(paths=[here], overrides=OVERRIDES, path=str(path))
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip() == "3":
            break
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()
    resumed = OnlinePredictor.resume(path, model)
    assert resumed.samples == len(stream(model))
    plain = OnlinePredictor(model, warm=False)
    for one in stream(model):
        plain.update(one)
    assert same(state(resumed), state(plain))


# --- files that are not its state --------------------------------------------------------------------


def test_a_file_that_is_not_there(model, tmp_path):
    with pytest.raises(
        OutputError, match="expected the state of a predictor, got: No such file or directory; name"
    ):
        OnlinePredictor.resume(tmp_path / "none.safetensors", model)
    with pytest.raises(OutputError, match="expected the state of a predictor, got: Is a directory"):
        OnlinePredictor.resume(tmp_path, model)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.5, 0.999])
def test_a_truncated_file_is_refused(model, saved, tmp_path, share):
    content = saved.read_bytes()
    path = tmp_path / "state.safetensors"
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(
        OutputError, match="found a damaged or another file; restore it, or begin anew from the model"
    ):
        OnlinePredictor.resume(path, model)


def test_a_single_bit_is_noticed(model, saved, tmp_path):
    content = bytearray(saved.read_bytes())
    path = tmp_path / "state.safetensors"
    generator = np.random.default_rng(0)
    for place in [0, 7, 8, 9, len(content) - 1, *generator.integers(8, len(content), size=8).tolist()]:
        content[place] ^= 4
        path.write_bytes(content)
        with pytest.raises(OutputError, match="found a damaged or another file"):
            OnlinePredictor.resume(path, model)
        content[place] ^= 4


@pytest.mark.parametrize("content", [b"", b"{}", b"\xff" * 400, b"time,force\n0,1\n" * 30], ids=range(4))
def test_another_file_is_refused(model, tmp_path, content):
    path = tmp_path / "state.safetensors"
    path.write_bytes(content)
    with pytest.raises(OutputError, match="found a damaged or another file"):
        OnlinePredictor.resume(path, model)


def test_a_sealed_file_of_something_else_is_refused(model, tmp_path):
    checkpoint = Checkpoint(tmp_path, {"model": "a"})
    checkpoint.write(0, {"done": np.array(3)})
    with pytest.raises(
        OutputError, match="expected the state of a predictor of this model, group and engine.local"
    ):
        OnlinePredictor.resume(checkpoint.path(0), model)


@pytest.mark.parametrize(
    "overrides",
    [
        ("engine.local.inducing=49",),
        ("engine.local.forgetting=null",),
        ("engine.local.width={position: 0.21, velocity: 1.0}",),
        ("model.residual.kernel=matern32",),
    ],
    ids=str,
)
def test_the_state_of_another_model_is_refused(saved, overrides):
    with pytest.raises(
        OutputError, match="found that of another; resume it with those that it was begun with"
    ):
        OnlinePredictor.resume(saved, model_of("position_velocity", (*OVERRIDES, *overrides)))


def test_the_state_of_another_group_is_refused(tmp_path):
    """Even where both moved in the same range, so that their cells lie at the same places."""
    model = model_of("phase", (SHARED,), groups=("ada", "bob"))
    log = model.fitted.log
    ada = [trial for trial in log.trials if trial.group == "ada"]
    twins = [replace(trial, group="bob", name=f"b{trial.name}", force=-trial.force) for trial in ada]
    model = type(model)(model.config, replace(model.fitted, log=log.with_trials([*ada, *twins])))
    path = tmp_path / "state.safetensors"
    OnlinePredictor(model, "ada").save(path)
    assert OnlinePredictor.resume(path, model, "ada").samples == 40
    with pytest.raises(OutputError, match="of this model, group and engine.local, found that of another"):
        OnlinePredictor.resume(path, model, "bob")


def test_a_state_with_something_more_is_not_its_state(model, saved, tmp_path):
    arrays, about = read_sealed(saved)
    path = tmp_path / "state.safetensors"
    write_sealed(path, arrays, {**about, "axis": "z"})
    with pytest.raises(OutputError, match="found that of another"):
        OnlinePredictor.resume(path, model)


def test_where_nothing_can_be_written(model, tmp_path):
    with pytest.raises(OutputError):
        OnlinePredictor(model, warm=False).save(tmp_path / "none" / "state.safetensors")


def test_a_full_disk_leaves_the_last_state(model, saved, tmp_path, full_disk):
    path = tmp_path / "state.safetensors"
    path.write_bytes(saved.read_bytes())
    predictor = OnlinePredictor.resume(path, model)
    predictor.update(stream(model)[30])
    with full_disk(), pytest.raises(OutputError, match="could not be written"):
        predictor.save(path)
    assert path.read_bytes() == saved.read_bytes()
    assert [one.name for one in tmp_path.iterdir()] == ["state.safetensors"]
    # And the predictor goes on.
    predictor.update(stream(model)[31])
