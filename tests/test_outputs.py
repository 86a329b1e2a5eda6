"""Files and folders are written whole or not at all, and what stood there before is never lost."""

import errno
import os
import shutil
import stat
import tempfile
from contextlib import nullcontext
from pathlib import Path

import pytest

from bayes_impedance import outputs
from bayes_impedance.errors import OutputError
from bayes_impedance.outputs import check_replaceable, check_writable, whole_file, whole_folder

MARKER = "marker.json"


def no_space(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def content(folder: Path) -> dict[str, str]:
    """Every file below `folder`, hidden ones too."""
    return {
        path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()
    }


def sentence(caught: pytest.ExceptionInfo[OutputError], path: Path) -> str:
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


@pytest.fixture
def old(tmp_path):
    """A folder of the right kind."""
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / MARKER).write_text("old")
    (folder / "data").write_text("old data")
    return folder


# --- check_writable ------------------------------------------------------------------------------


def test_writable_place(tmp_path, monkeypatch):
    check_writable(tmp_path / "new")
    monkeypatch.chdir(tmp_path)
    check_writable(Path("new.csv"))
    assert content(tmp_path) == {}


@pytest.mark.parametrize("below", ["missing/new.csv", "file/new.csv"])
def test_parent_is_no_folder(tmp_path, below):
    (tmp_path / "file").write_text("")
    path = tmp_path / below
    with pytest.raises(OutputError, match="found none; create it") as caught:
        check_writable(path)
    assert f"expected an existing folder {path.parent} to write into" in sentence(caught, path)


def test_folder_that_takes_no_files():
    # Tests may run as root, whom permissions do not stop; nobody can write here.
    path = Path("/proc/new.csv")
    if not path.parent.is_dir():
        pytest.skip("no /proc")
    with pytest.raises(OutputError, match="expected a writable folder /proc, got: .*; choose another place"):
        check_writable(path)


def test_folder_without_permission(tmp_path, monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    path = tmp_path / "new.csv"
    with pytest.raises(OutputError) as caught:
        check_writable(path)
    assert sentence(caught, path).endswith("got: Permission denied; choose another place")


# --- whole_file ----------------------------------------------------------------------------------


def test_file_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "new.csv"
    with whole_file(path) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".csv"
        temporary.write_text("half")
        assert not path.exists()
    assert content(tmp_path) == {"new.csv": "half"}


def test_file_has_the_permissions_of_any_new_file(tmp_path):
    before = os.umask(0o027)
    try:
        with whole_file(tmp_path / "new.csv") as temporary:
            temporary.write_text("")
        with whole_folder(tmp_path / "folder", MARKER) as place:
            (place / MARKER).write_text("")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "new.csv").stat().st_mode) == 0o640
    assert stat.S_IMODE((tmp_path / "folder").stat().st_mode) == 0o750


def test_file_replaces_another(tmp_path):
    path = tmp_path / "new.csv"
    path.write_text("old")
    with whole_file(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert content(tmp_path) == {"new.csv": "new"}


@pytest.mark.parametrize("existing", [None, "old"])
@pytest.mark.parametrize(
    "failure", [OSError(errno.ENOSPC, "No space left on device"), ValueError, KeyboardInterrupt]
)
def test_nothing_is_left_of_half_a_file(tmp_path, existing, failure):
    path = tmp_path / "new.csv"
    if existing is not None:
        path.write_text(existing)
    before = content(tmp_path)
    expected = OutputError if isinstance(failure, OSError) else failure
    with pytest.raises(expected) as caught, whole_file(path) as temporary:
        temporary.write_text("half")
        raise failure
    assert content(tmp_path) == before
    if expected is OutputError:
        assert sentence(caught, path) == f"{path}: could not be written: No space left on device"


def test_file_that_cannot_be_put_in_place(tmp_path, monkeypatch):
    path = tmp_path / "new.csv"
    monkeypatch.setattr(Path, "replace", no_space)
    with (
        pytest.raises(OutputError, match="could not be written: No space left"),
        whole_file(path) as temporary,
    ):
        temporary.write_text("whole")
    assert content(tmp_path) == {}


def test_folder_in_place_of_a_file(tmp_path):
    with (
        pytest.raises(OutputError, match="expected a file name to write to, found a folder"),
        whole_file(tmp_path),
    ):
        pytest.fail("not to be written")


def test_device_in_place_of_a_file(tmp_path):
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    with pytest.raises(OutputError, match="found a device or pipe; name a file"), whole_file(pipe):
        pytest.fail("not to be written")
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_link_to_a_file_stays_a_link(tmp_path):
    (tmp_path / "far").mkdir()
    target, link = tmp_path / "far" / "target.csv", tmp_path / "link.csv"
    target.write_text("old")
    link.symlink_to(target)
    with whole_file(link) as temporary:
        temporary.write_text("new")
    assert link.is_symlink()
    assert target.read_text() == "new"


def test_real_disk_limit(tmp_path, full_disk):
    path = tmp_path / "new.csv"
    with pytest.raises(OutputError) as caught, full_disk(), whole_file(path) as temporary:
        temporary.write_bytes(b"0" * 100_000)
    assert sentence(caught, path) == f"{path}: could not be written: File too large"
    assert content(tmp_path) == {}


# --- whole_folder --------------------------------------------------------------------------------


def test_folder_appears_when_it_is_whole(tmp_path):
    with whole_folder(tmp_path / "model", MARKER) as place:
        (place / MARKER).write_text("new")
        assert not (tmp_path / "model").exists()
    assert content(tmp_path) == {f"model/{MARKER}": "new"}


def test_folder_replaces_one_of_its_kind(tmp_path, old):
    with whole_folder(old, MARKER) as place:
        (place / MARKER).write_text("new")
        assert content(old) == {MARKER: "old", "data": "old data"}
    assert content(tmp_path) == {f"model/{MARKER}": "new"}


def test_folder_replaces_an_empty_one(tmp_path):
    (tmp_path / "model").mkdir()
    with whole_folder(tmp_path / "model", MARKER) as place:
        (place / MARKER).write_text("new")
    assert content(tmp_path) == {f"model/{MARKER}": "new"}


def test_folder_behind_a_link(tmp_path, old):
    link = tmp_path / "elsewhere" / "link"
    link.parent.mkdir()
    link.symlink_to(old)
    with whole_folder(link, MARKER) as place:
        (place / MARKER).write_text("new")
    assert link.is_symlink()
    assert content(old) == {MARKER: "new"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["elsewhere", "model"]


@pytest.mark.parametrize(
    "failure", [OSError(errno.ENOSPC, "No space left on device"), ValueError, KeyboardInterrupt]
)
def test_nothing_is_left_of_half_a_folder(tmp_path, old, failure):
    before = content(tmp_path)
    expected = OutputError if isinstance(failure, OSError) else failure
    with pytest.raises(expected), whole_folder(old, MARKER) as place:
        (place / MARKER).write_text("half")
        raise failure
    assert content(tmp_path) == before
    with pytest.raises(expected), whole_folder(tmp_path / "other", MARKER) as place:
        (place / MARKER).write_text("half")
        raise failure
    assert content(tmp_path) == before


@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("call", [1, 2])
def test_old_folder_survives_a_failure_while_the_new_one_is_put_in_place(
    tmp_path, old, monkeypatch, call, failure
):
    """Where names cannot be swapped the old folder first steps aside, then the new one comes: either may fail."""
    monkeypatch.setattr(outputs, "_exchange", lambda *_: False)
    calls = 0
    rename = Path.rename

    def fail_once(self: Path, target: Path) -> Path:
        nonlocal calls
        calls += 1
        if calls == call:
            raise failure
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fail_once)
    before = content(tmp_path)
    expected = OutputError if isinstance(failure, OSError) else KeyboardInterrupt
    with pytest.raises(expected), whole_folder(old, MARKER) as place:
        (place / MARKER).write_text("new")
    assert content(tmp_path) == before


@pytest.mark.parametrize("swap", [True, False])
def test_one_folder_stands_there_when_two_are_put_in_place_at_once(tmp_path, monkeypatch, swap):
    if not swap:
        monkeypatch.setattr(outputs, "_exchange", lambda *_: False)
    path = tmp_path / "model"
    with whole_folder(path, MARKER) as one, whole_folder(path, MARKER) as other:
        (one / MARKER).write_text("one")
        (other / MARKER).write_text("other")
    assert content(tmp_path) == {f"model/{MARKER}": "one"}


@pytest.mark.parametrize("kind", [MARKER, "thesis.tex"])
def test_folder_that_appears_at_the_last_moment_is_replaced_if_it_is_of_the_same_kind(
    tmp_path, monkeypatch, kind
):
    path = tmp_path / "model"
    rename = Path.rename

    def late(self: Path, target: Path) -> Path:
        path.mkdir()
        (path / kind).write_text("another process")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", late)
    refused = pytest.raises(OutputError, match="could not be written: Directory not empty")
    with nullcontext() if kind == MARKER else refused, whole_folder(path, MARKER) as place:
        (place / MARKER).write_text("mine")
    assert content(tmp_path) == {f"model/{kind}": "mine" if kind == MARKER else "another process"}


def test_old_folder_that_cannot_be_removed_does_not_spoil_the_new_one(tmp_path, old, monkeypatch):
    monkeypatch.setattr(shutil, "rmtree", lambda *_, **__: None)
    with whole_folder(old, MARKER) as place:
        (place / MARKER).write_text("new")
    assert content(old) == {MARKER: "new"}


def test_what_is_not_of_the_same_kind_is_left_alone(tmp_path, old):
    (old / MARKER).unlink()
    with pytest.raises(OutputError, match="found a folder with other content; choose another name") as caught:
        check_replaceable(old, MARKER)
    sentence(caught, old)
    file = tmp_path / "file"
    file.write_text("mine")
    with (
        pytest.raises(OutputError, match="expected a new folder name, found a file"),
        whole_folder(file, MARKER),
    ):
        pytest.fail("not to be written")
    with pytest.raises(OutputError, match="found a folder with other content"), whole_folder(old, MARKER):
        pytest.fail("not to be written")
    assert content(tmp_path) == {"model/data": "old data", "file": "mine"}


def test_folder_without_a_parent(tmp_path):
    with (
        pytest.raises(OutputError, match="expected an existing folder .*; create it"),
        whole_folder(tmp_path / "missing" / "model", MARKER),
    ):
        pytest.fail("not to be written")
    assert not (tmp_path / "missing").exists()
