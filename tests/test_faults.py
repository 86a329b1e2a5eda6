"""Kill -9, full disks, rivals: what stood there stays whole; --resume ends with the model of an untroubled run."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from bayes_impedance import training
from bayes_impedance.config import load_config
from bayes_impedance.journal import open_journal
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.persistence import FILES, METADATA, load_model, save_model
from conftest import TINY

#: Long enough to be killed in the middle.
LONGER = ("training.restarts=3", "training.max_iterations=25")


def settings(*changes: str) -> list[str]:
    return ["--config", "phase", *(part for item in (*TINY, *changes) for part in ("--set", item))]


def state(folder: Path) -> tuple[object, ...]:
    """All that a model folder holds, but for the times; the model loads."""
    load_model(folder)
    metadata = json.loads((folder / METADATA).read_text())
    for restart in metadata["report"]["restarts"]:
        del restart["seconds"]
    return (json.dumps(metadata), *((folder / name).read_bytes() for name in FILES))


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@contextmanager
def process(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """A command in another process, which does not outlive the block."""
    started = subprocess.Popen(
        [sys.executable, "-m", "bayes_impedance", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield started
    finally:
        started.kill()
        started.communicate()


def wait_for(path: Path, size: int, worker: subprocess.Popen[str]) -> None:
    """Until a file has grown to this size [B]."""
    while not (path.is_file() and path.stat().st_size >= size):
        assert worker.poll() is None, worker.communicate()
        time.sleep(1e-3)


@pytest.fixture
def place(tiny, tmp_path) -> Path:
    """A folder with an older model in it, and nothing else."""
    shutil.copytree(tiny.model, tmp_path / "model")
    return tmp_path


@pytest.fixture(scope="module")
def untroubled(tiny, tmp_path_factory) -> Path:
    """Model of a run that nothing disturbed, beside the journal that it would have left if it had been killed."""
    folder = tmp_path_factory.mktemp("untroubled")
    config = load_config("phase", [*TINY, *LONGER])
    with open_journal(folder / "journal") as journal:
        save_model(ImpedanceModel(config).fit(tiny.fitted.fitted.log, journal=journal), folder / "model")
    return folder


# --- kill -9 -------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_killed_training_leaves_the_old_model_and_resumes_to_the_same_bits(
    command, tiny, place, untroubled, share
):
    out, journal = place / "model", place / "model.journal"
    before = state(out)
    arguments = ("train", tiny.log, *settings(*LONGER), "--out", out)
    size = int(share * (untroubled / "journal").stat().st_size)
    with process(*arguments) as worker:
        wait_for(journal, size, worker)
        worker.kill()
        assert worker.wait() == -signal.SIGKILL
    assert state(out) == before
    assert names(place) == ["model", "model.journal"]
    done = command(*arguments, "--resume")
    assert (done.code, done.err) == (0, "")
    assert "continuing after" in done.out or share == 0
    assert state(out) == state(untroubled / "model")
    assert names(place) == ["model"]


#: Saves a model over another one, again and again, and kills the process at its n-th step on files, for n = 1, 2, …
#: until it ends; says each time which of the two stands there.
KILL_AT_EVERY_STEP = """
import os, shutil, signal, sys
from pathlib import Path
from bayes_impedance.persistence import load_model, save_model
from test_faults import state

old, new, place = map(Path, sys.argv[1:])
out = place / "model"

def save(kill_at):
    child = os.fork()
    if child:
        return os.waitpid(child, 0)[1]
    seen = 0
    def hook(event, _):
        nonlocal seen
        if event.startswith(("open", "os.", "shutil.", "tempfile.", "ctypes.")):
            seen += 1
            if seen == kill_at:
                os.kill(os.getpid(), signal.SIGKILL)
    sys.addaudithook(hook)
    save_model(model, out)
    os._exit(0)

model, before, after = load_model(new), state(old), state(new)
step, status = 0, None
while status != 0:
    step += 1
    shutil.rmtree(place)
    shutil.copytree(old, out)
    status = save(step)
    assert status in (0, signal.SIGKILL), status
    found = state(out)
    print({before: "old", after: "new"}[found], flush=True)
    # What the kill left behind does not stand in the way.
    assert save(None) == 0
    assert state(out) == after
"""


@pytest.mark.skipif(sys.platform != "linux", reason="names are swapped in one step on Linux")
def test_killed_at_any_step_of_writing_there_is_always_a_whole_model(tiny, tmp_path, untroubled):
    (tmp_path / "place").mkdir()
    folders = (tiny.model, untroubled / "model", tmp_path / "place")
    done = subprocess.run(
        [sys.executable, "-B", "-c", KILL_AT_EVERY_STEP, *map(str, folders)],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    found = done.stdout.split()
    # The old model until the names are swapped, the new one from then on.
    assert found == sorted(found, reverse=True)
    assert found.count("old") > 10
    assert found.count("new") > 3


# --- resuming ------------------------------------------------------------------------------------


def test_unfinished_training_is_not_thrown_away(command, tiny, place, untroubled):
    shutil.copy(untroubled / "journal", place / "model.journal")
    content = (place / "model.journal").read_bytes()
    done = command("train", tiny.log, *settings(*LONGER), "--out", place / "model")
    assert (done.code, done.out) == (2, "")
    assert re.fullmatch(
        r"error: \S+model\.journal: expected no unfinished training of model, found one with \d+ evaluations; add "
        r"--resume to continue it, or delete the file to start anew\n",
        done.err,
    )
    assert (place / "model.journal").read_bytes() == content
    assert state(place / "model") == state(tiny.model)


def test_resuming_with_other_settings_is_refused(command, tiny, place, untroubled):
    shutil.copy(untroubled / "journal", place / "model.journal")
    changed = settings(*LONGER, "model.noise_sd=0.3")
    done = command("train", tiny.log, *changed, "--out", place / "model", "--resume")
    assert done.code == 2
    assert re.fullmatch(
        r"error: \S+model\.journal: expected the journal of this training, found one of another "
        r"configuration\.model\.noise_sd\.median \(0\.2, now 0\.3\); continue with what it was started with, or delete "
        r"the file to start anew\n",
        done.err,
    )
    assert names(place) == ["model", "model.journal"]


def test_resuming_without_a_journal_trains(command, tiny, tmp_path):
    done = command("train", tiny.log, *settings(), "--out", tmp_path / "model", "--resume")
    assert (done.code, done.err) == (0, "")
    assert "nothing to resume: training from the start" in done.out
    assert state(tmp_path / "model") == state(tiny.model)
    assert names(tmp_path) == ["model"]


def test_ctrl_c_leaves_a_model_that_can_be_continued(command, tiny, tmp_path, untroubled):
    out = tmp_path / "model"
    arguments = ("train", tiny.log, *settings(*LONGER), "--out", out)
    with process(*arguments) as worker:
        wait_for(tmp_path / "model.journal", (untroubled / "journal").stat().st_size // 2, worker)
        worker.send_signal(signal.SIGINT)
        said, problems = worker.communicate()
    assert (worker.returncode, problems) == (130, "")
    assert "to continue, add --resume to the same command" in said
    assert load_model(out).report.interrupted
    assert names(tmp_path) == ["model", "model.journal"]
    done = command(*arguments, "--resume")
    assert (done.code, done.err) == (0, "")
    assert state(out) == state(untroubled / "model")
    assert names(tmp_path) == ["model"]


# --- full disk -----------------------------------------------------------------------------------


def test_full_disk_loses_no_training(command, tiny, place, full_disk, monkeypatch):
    """The journal fills up, then the model cannot be written; with room made, --resume writes it."""
    arguments = ("train", tiny.log, *settings(), "--out", place / "model")
    (place / "model" / "mine").write_text("a trace of the old one")
    with full_disk(5120):
        done = command(*arguments)
    assert done.code == 2
    warning, error = done.err.splitlines()
    assert re.fullmatch(
        r"warning: \S+model\.journal: could not be written: File too large; training goes on.*", warning
    )
    assert error == f"error: {place / 'model'}: could not be written: File too large"
    assert (place / "model" / "mine").exists()
    assert names(place) == ["model", "model.journal"]
    done = command(*arguments, "--resume")
    assert (done.code, done.err) == (0, "")
    assert state(place / "model") == state(tiny.model)


def test_model_that_could_not_be_written_is_not_computed_again(command, tiny, place, monkeypatch):
    arguments = ("train", tiny.log, *settings(), "--out", place / "model")
    with monkeypatch.context() as patched:
        patched.setattr(
            "bayes_impedance.persistence.dump_config", lambda _: (_ for _ in ()).throw(OSError(28, "full"))
        )
        assert command(*arguments).code == 2
    monkeypatch.setattr(training, "objective", lambda *_: pytest.fail("computed again"))
    done = command(*arguments, "--resume")
    assert (done.code, done.err) == (0, "")
    assert state(place / "model") == state(tiny.model)


# --- rivals --------------------------------------------------------------------------------------


def test_two_trainings_into_one_model_do_not_mix(command, tiny, place):
    endless = settings(
        "training.restarts=100", "training.max_iterations=100000", "training.gradient_tolerance=1e-30"
    )
    with process("train", tiny.log, *endless, "--out", place / "model") as worker:
        wait_for(place / "model.journal", 10_000, worker)
        for more in ((), ("--resume",)):
            done = command("train", tiny.log, *settings(), "--out", place / "model", *more)
            assert (done.code, done.out) == (2, "")
            assert done.err == (
                f"error: {place / 'model.journal'}: expected no other training into the same model, found one at "
                "work; wait for it, or train with another --out\n"
            )
        worker.send_signal(signal.SIGINT)
        _, problems = worker.communicate()
    assert (worker.returncode, problems) == (130, "")
    assert load_model(place / "model").report.interrupted


#: Two processes, each of which saves its model twenty times.
RIVALS = """
import os, sys
from bayes_impedance.persistence import load_model, save_model

models, out = [load_model(folder) for folder in sys.argv[1:3]], sys.argv[3]
children = []
for model in models:
    child = os.fork()
    if not child:
        for _ in range(20):
            save_model(model, out)
        os._exit(0)
    children.append(child)
sys.exit(sum(os.waitpid(child, 0)[1] for child in children))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="names are swapped in one step on Linux")
def test_two_processes_that_save_one_model_leave_one_of_the_two(tiny, tmp_path, untroubled):
    folders = (tiny.model, untroubled / "model")
    done = subprocess.run(
        [sys.executable, "-c", RIVALS, *map(str, folders), str(tmp_path / "model")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert state(tmp_path / "model") in map(state, folders)
    assert names(tmp_path) == ["model"]
