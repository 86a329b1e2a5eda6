"""Writing files and folders whole or not at all."""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bayes_impedance.errors import OutputError


def check_writable(path: Path) -> None:
    """Refuse a place where nothing can be written, before hours of work are lost to it.

    Raises:
        OutputError: the parent folder is missing, or not writable.
    """
    parent = path.resolve().parent
    if not parent.is_dir():
        raise OutputError(
            f"{path}: expected an existing folder {parent} to write into, found none; create it"
        )
    try:
        with tempfile.TemporaryFile(dir=parent):
            pass
    except OSError as error:
        raise OutputError(
            f"{path}: expected a writable folder {parent}, got: {error.strerror}; choose another place"
        ) from error


def check_file(path: Path) -> None:
    """Refuse a place where no file can be written.

    Raises:
        OutputError: as `check_writable`, or something that is no file stands there.
    """
    check_writable(path)
    if path.is_dir():
        raise OutputError(f"{path}: expected a file name to write to, found a folder; name a file in it")
    if path.exists() and not path.is_file():
        # Renaming over /dev/null would remove it.
        raise OutputError(f"{path}: expected a file name to write to, found a device or pipe; name a file")


def prepare_folder(folder: Path) -> None:
    """Make a folder that files are to go into, where there is none.

    Raises:
        OutputError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"{folder}: could not be created: {error.strerror}; choose another place"
        ) from error


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary file beside `path` that replaces it when the block ends well, else vanishes.

    Raises:
        OutputError: the file cannot be written.
    """
    check_file(path)
    target = path.resolve()
    handle, name = tempfile.mkstemp(prefix=f".{target.stem}-", suffix=target.suffix, dir=target.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        _synchronise(temporary)
        temporary.replace(target)
    except OSError as error:
        raise OutputError(f"{path}: could not be written: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def write_json(content: object, path: Path) -> None:
    """Write `content` as indented JSON, whole or not at all.

    Raises:
        OutputError: the file cannot be written.
    """
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


@contextmanager
def whole_folder(path: Path, marker: str) -> Iterator[Path]:
    """A temporary folder beside `path` that takes its place when the block ends well, else vanishes.

    An existing folder is replaced only if it holds `marker`, the file that shows it to be of the same kind.

    Raises:
        OutputError: the folder cannot be written, or something else stands in its place.
    """
    check_writable(path)
    check_replaceable(path, marker)
    target = path.resolve()
    temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    replaced = temporary.with_name(f"{temporary.name}.old")
    try:
        yield temporary
        temporary.chmod(0o777 & ~_umask())
        for file in temporary.iterdir():
            _synchronise(file)
        _put_in_place(temporary, target, replaced, marker)
    except OSError as error:
        raise OutputError(f"{path}: could not be written: {error.strerror or error}") from error
    finally:
        # Whatever came between the two renamings, Ctrl-C included: the old folder goes back to its place.
        if replaced.is_dir() and not target.exists():
            replaced.rename(target)
        shutil.rmtree(temporary, ignore_errors=True)
        shutil.rmtree(replaced, ignore_errors=True)


def _put_in_place(temporary: Path, target: Path, replaced: Path, marker: str) -> None:
    """Give `temporary` the name `target`; what had it ends up as `temporary` or `replaced`."""
    if _exchange(temporary, target):
        return
    try:
        if target.is_dir():
            target.rename(replaced)
        temporary.rename(target)
    except OSError:
        # Another process may have put a folder of the same kind there just now.
        if not ((target / marker).is_file() and _exchange(temporary, target)):
            raise


def _exchange(one: Path, other: Path) -> bool:
    """Swap two names in one step, so that no kill comes between; False where a name is free or the system cannot."""
    if sys.platform != "linux":
        return False
    rename = getattr(ctypes.CDLL(None), "renameat2", None)
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    return rename is not None and rename(here, os.fsencode(one), here, os.fsencode(other), exchange) == 0


def _synchronise(file: Path) -> None:
    """To the disk, before the name is: after a power cut a name without content would be a half-written file."""
    with file.open("r+b") as opened:
        os.fsync(opened.fileno())


def check_replaceable(path: Path, marker: str) -> None:
    """Refuse to replace what is not a folder of the same kind.

    Raises:
        OutputError: `path` is a file, or a folder with other content.
    """
    if path.is_file():
        raise OutputError(f"{path}: expected a new folder name, found a file; choose another name")
    if path.is_dir() and any(path.iterdir()) and not (path / marker).is_file():
        raise OutputError(
            f"{path}: expected a new folder, or one written by this command before, found a folder with other "
            "content; choose another name"
        )


def _umask() -> int:
    current = os.umask(0)
    os.umask(current)
    return current
