"""Locks on files and folders, and atomic replacement of files.

A file is written in a hidden work folder beside its target. This folder, `.NAME.part`, is locked
while its writer runs. When the file is complete and synced to disk, it replaces the target
atomically. If the writer is killed, the target has either its old or its new content. The next
writer removes the work folder.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import Any, BinaryIO

from mcaprl.errors import LogError, McaprlError, OutputExistsError, UsageError

if sys.platform != "win32":
    import fcntl

_MAX_NAME_BYTES = 255
_MAX_JSON_DEPTH = 100
_DIGITS = re.compile(r"\d+")
# `Path` turns the two slashes of a URL into one.
_URL = re.compile(r"[a-z][a-z0-9+.-]+:/")
_TAKEN = "{} is being written by another process; wait until it ends, or choose another path"


def try_lock(descriptor: int) -> bool:
    """Lock an open file or folder; return False if another process has locked it.

    The lock is advisory and ends when the file is closed. On systems without `flock`, such as
    Windows and some network file systems, nothing is locked, and the result is True.
    """
    if sys.platform != "win32":
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:
            pass
    return True


@contextmanager
def waiting_lock(file: BinaryIO) -> Iterator[None]:
    """Lock an open file; if another process has locked it, wait. Unlock it at the end.

    On systems without `flock`, nothing is locked; see `try_lock`.
    """
    if sys.platform == "win32":
        yield
        return
    with suppress(OSError):
        fcntl.flock(file, fcntl.LOCK_EX)
    try:
        yield
    finally:
        file.flush()
        # A forked process may still have the file open, so closing it does not end the lock.
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_UN)


@contextmanager
def locked_folder(folder: Path, error_type: type[McaprlError] = LogError) -> Iterator[None]:
    """Create a folder if it is missing, and lock it against other writers.

    If the folder is new and empty at the end, it is removed.

    Raises:
        UsageError: The path is a URL.
        McaprlError: Another process is writing to the folder, or it cannot be created.
    """
    _check_local(folder)
    descriptor, is_new = -1, not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if sys.platform != "win32":
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise error_type(f"cannot write {folder}: {_reason(folder, error)}") from error
    try:
        if descriptor >= 0 and not try_lock(descriptor):
            raise error_type(
                f"{folder} is in use by another recording or training: wait until it ends, or"
                " choose another folder"
            )
        try:
            yield
        finally:
            if is_new:
                with suppress(OSError):
                    folder.rmdir()
    finally:
        if descriptor >= 0:
            os.close(descriptor)


def check_target(path: Path, *, overwrite: bool) -> None:
    """Check that a path is new, or belongs to a regular file that may be replaced.

    Raises:
        OutputExistsError: The file exists and `overwrite` is not set, or the path belongs to a
            symbolic link, folder, device or FIFO.
        UsageError: The path is a URL.
        LogError: Another writer has locked the file.
    """
    _check_local(path)
    try:
        mode = path.lstat().st_mode
    except OSError:
        # There is no file, or its folder is unreadable. In the second case, creating the file
        # fails later.
        return
    if stat.S_ISLNK(mode):
        raise OutputExistsError(f"{path} is a symbolic link: choose the path of a regular file")
    if not stat.S_ISREG(mode):
        raise OutputExistsError(f"{path} is not a regular file: choose another path")
    if not overwrite:
        raise OutputExistsError(
            f"{path} exists: choose another path, or pass --overwrite (overwrite=True in Python)"
        )
    with locked_file(path):
        pass


def _check_local(path: Path) -> None:
    """Raise UsageError if the path of an output is a URL."""
    if _URL.match(str(path)):
        url = str(path).replace(":/", "://", 1)
        raise UsageError(
            f"{url} is a URL, but outputs are local: choose a local path; record, convert and"
            " train-online copy their logs with --upload URL"
        )


def check_writable(path: Path, error_type: type[McaprlError]) -> None:
    """Check that a file can be written, without writing it; create its folder if it is missing.

    Raises:
        LogError: Another process is writing the file.
        McaprlError: The file cannot be written; the type is `error_type`.
    """
    try:
        with work_folder(path):
            pass
    except OSError as error:
        raise error_type(f"cannot write {path}: {_reason(path, error)}") from error


def check_log_name(path: str | Path) -> Path:
    """Check that the name of a log to write ends in `.mcap`; return the path.

    Raises:
        UsageError: It has another suffix, so that folders and globs of logs would not include it.
    """
    path = Path(path)
    if path.suffix != ".mcap":
        raise UsageError(f"{path}: the name of a log must end in .mcap")
    return path


@contextmanager
def locked_file(path: Path) -> Iterator[None]:
    """Lock a file against other writers. Do nothing if it does not exist or cannot be read.

    Raises:
        LogError: Another writer has locked the file.
    """
    while True:
        try:
            file = FileIO(open_at_once(path))
        except OSError:
            yield
            return
        with file:
            if not try_lock(file.fileno()):
                raise LogError(_TAKEN.format(path))
            # A writer may have replaced the file before this lock was acquired: try again.
            if is_at(file.fileno(), path):
                yield
                return


def open_at_once(path: Path) -> int:
    """Open a file for reading; if it is a FIFO, do not wait for its writer."""
    return os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))


def is_at(descriptor: int, path: str | Path) -> bool:
    """Return whether a descriptor and a path refer to the same file or folder."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except (FileNotFoundError, NotADirectoryError):
        return False


@contextmanager
def work_folder(path: Path, *, concurrent: bool = False) -> Iterator[Path]:
    """Create and lock the work folder of a target; remove it at the end.

    Files that a killed writer left there are removed first.

    Args:
        path: Target, which this function neither reads nor writes.
        concurrent: Whether several processes may write files for the target at the same time.

    Raises:
        LogError: Another process is writing the target, or a log in the folder cannot be written.
        OSError: The folder cannot be created.
    """
    _check_local(path)
    folder = _work_path(path, f".{os.getpid()}.part" if concurrent else ".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    if concurrent:
        _remove_unlocked(path.parent, f".{path.name}.")
    while True:
        folder.mkdir(exist_ok=True)
        descriptor = -1 if sys.platform == "win32" else os.open(folder, os.O_RDONLY)
        try:
            if descriptor >= 0 and not try_lock(descriptor):
                raise LogError(_TAKEN.format(path))
            # A writer may have removed the folder before this lock was acquired: try again.
            if descriptor >= 0 and not is_at(descriptor, folder):
                continue
            _empty(folder)
            try:
                yield folder
            except LogError as error:
                # The message names the target, because the user does not know the work folder.
                cause = error.__cause__
                if isinstance(cause, OSError) and str(folder) in str(error):
                    raise LogError(f"cannot write {path}: {cause.strerror or cause}") from error
                raise
            finally:
                shutil.rmtree(folder, ignore_errors=True)
            return
        finally:
            if descriptor >= 0:
                os.close(descriptor)


def remove_leftover(path: Path) -> None:
    """Remove the work folder of a target if a process was killed while writing it."""
    if _work_path(path).is_dir():
        with suppress(OSError, LogError), work_folder(path):
            pass


def _remove_unlocked(parent: Path, prefix: str) -> None:
    """Remove the work folders of concurrent writers that were killed."""
    for folder in parent.iterdir():
        if folder.name.startswith(prefix) and folder.name.endswith(".part"):
            with suppress(OSError, LogError), locked_folder(folder):
                shutil.rmtree(folder)


def _work_path(path: Path, suffix: str = ".part") -> Path:
    name = f".{path.name}{suffix}"
    if len(os.fsencode(name)) > _MAX_NAME_BYTES:
        name = f".{hashlib.sha256(os.fsencode(name)).hexdigest()[:32]}{suffix}"
    return path.with_name(name)


def _empty(folder: Path) -> None:
    for leftover in folder.iterdir():
        if leftover.is_dir() and not leftover.is_symlink():
            shutil.rmtree(leftover)
        else:
            leftover.unlink()


@contextmanager
def replacing(
    path: Path,
    error_type: type[McaprlError] | None = None,
    *,
    overwrite: bool = True,
    concurrent: bool = False,
) -> Iterator[Path]:
    """Yield a path in a work folder; move the file written there to `path` at the end.

    The content is synced to disk before the move. `path` is left as it was if the body raises an
    error, or if another writer has locked or created the file in the meantime.

    Args:
        path: File to create or replace; missing folders are created.
        error_type: Type raised in place of an OSError; None lets the OSError pass.
        overwrite: Whether an existing file is replaced.
        concurrent: Whether several processes may replace `path` at the same time.

    Raises:
        OutputExistsError: The file exists and is not to be replaced, or is not a regular file.
        LogError: Another process is writing the file.
        McaprlError: The file cannot be written, and `error_type` is given.
        OSError: The file cannot be written, and `error_type` is None.
    """
    check_target(path, overwrite=overwrite)
    try:
        with work_folder(path, concurrent=concurrent) as folder:
            unfinished = folder / path.name
            yield unfinished
            with unfinished.open("rb+") as file:
                os.fsync(file.fileno())
            _move(unfinished, path, overwrite=overwrite)
    except OSError as error:
        if error_type is None:
            raise
        raise error_type(f"cannot write {path}: {_reason(path, error)}") from error


@contextmanager
def replacing_folder(
    path: Path, error_type: type[McaprlError] = LogError, *, overwrite: bool = False
) -> Iterator[Path]:
    """Yield an empty folder in a work folder; move it to `path` at the end.

    The files are synced to disk before the move. If the body raises an error, `path` is left as it
    was.

    Args:
        path: Folder to create or replace.
        error_type: Type raised in place of an OSError.
        overwrite: Whether an existing folder is replaced.

    Raises:
        OutputExistsError: The folder exists and is not to be replaced, has files with other names
            than the new one, apart from their numbers, or is not a folder.
        LogError: Another process is writing the folder, or a file in it.
        McaprlError: A file cannot be written.
    """
    _check_folder(path, overwrite=overwrite)
    try:
        with work_folder(path) as work:
            unfinished = work / path.name
            unfinished.mkdir()
            yield unfinished
            for file in (entry for entry in unfinished.rglob("*") if entry.is_file()):
                with file.open("rb+") as opened:
                    os.fsync(opened.fileno())
            _check_folder(path, overwrite=overwrite)
            if path.exists():
                _check_contents(path, unfinished)
                # Between these two moves, nothing is at `path`, but both folders are complete.
                os.rename(path, work / f"{path.name}.old")
            os.rename(unfinished, path)
    except OSError as error:
        raise error_type(f"cannot write {path}: {_reason(path, error)}") from error


def _reason(path: Path, error: OSError) -> str:
    """Return why a file or folder cannot be created."""
    if isinstance(error, FileExistsError | NotADirectoryError):
        for folder in (path, *path.parents):
            if folder.exists() and not folder.is_dir():
                return f"{folder} is not a folder"
    return error.strerror or str(error)


def _check_folder(path: Path, *, overwrite: bool) -> None:
    _check_local(path)
    if path.is_symlink() or (path.exists() and not path.is_dir()):
        raise OutputExistsError(f"{path} is not a folder: choose another path")
    if path.name in ("", ".."):
        raise OutputExistsError(f"{path} cannot be replaced: give the name of the folder")
    if path.exists() and not overwrite:
        raise OutputExistsError(
            f"{path} exists: choose another path, or pass --overwrite (overwrite=True in Python)"
        )


def _check_contents(path: Path, replacement: Path) -> None:
    """Check that a folder has only files that an earlier run of the same command wrote.

    Raises:
        OutputExistsError: A file has another name than all files of the replacement, apart from
            its numbers.
        LogError: Another writer has locked a file.
    """
    names = {_without_numbers(entry, replacement) for entry in _files_in(replacement)}
    for entry in sorted(_files_in(path)):
        if _without_numbers(entry, path) not in names:
            raise OutputExistsError(
                f"{path} has other files ({entry.relative_to(path)}), which would be deleted:"
                " choose another folder"
            )
        check_target(entry, overwrite=True)


def _files_in(folder: Path) -> list[Path]:
    return [entry for entry in folder.rglob("*") if entry.is_symlink() or not entry.is_dir()]


def _without_numbers(entry: Path, folder: Path) -> str:
    """Return the path of an entry in a folder, with 0 for each number."""
    return _DIGITS.sub("0", str(entry.relative_to(folder)))


def _move(source: Path, path: Path, *, overwrite: bool) -> None:
    """Move a complete file to its target atomically, unless another writer has locked `path`."""
    if not overwrite:
        # Unlike a rename, a link does not replace a file that was created in the meantime. Some
        # file systems have no links.
        with suppress(OSError):
            os.link(source, path)
            return
    check_target(path, overwrite=overwrite)
    with locked_file(path):
        if path.exists():
            os.chmod(source, stat.S_IMODE(path.stat().st_mode))
        os.replace(source, path)


def write_atomically(
    path: Path, content: bytes, error_type: type[McaprlError] | None = None
) -> None:
    """Write a file atomically with `replacing`."""
    with replacing(path, error_type) as unfinished:
        unfinished.write_bytes(content)


def size_of(path: Path) -> int:
    """Return the size in bytes of a file, or of all files in a folder."""
    if not path.is_dir():
        return path.stat().st_size
    return sum(each.stat().st_size for each in path.rglob("*") if each.is_file())


def parse_json(text: str | bytes) -> Any:
    """Parse JSON; refuse texts that are nested more deeply than the files of this package.

    Raises:
        ValueError: The text is not JSON, or is nested too deeply.
    """
    too_deep = f"JSON is nested more than {_MAX_JSON_DEPTH} levels deep"
    try:
        found = json.loads(text)
    except RecursionError as error:
        raise ValueError(too_deep) from error
    # Each level takes two brackets, so most texts are too short to be nested too deeply.
    if len(text) <= 2 * _MAX_JSON_DEPTH:
        return found
    level = [found] if isinstance(found, dict | list) else []
    for _ in range(_MAX_JSON_DEPTH):
        inner = [part.values() if isinstance(part, dict) else part for part in level]
        level = [part for parts in inner for part in parts if isinstance(part, dict | list)]
        if not level:
            return found
    raise ValueError(too_deep)


def json_text(value: Any) -> str:
    """Return indented JSON. NaN and infinities become null, because JSON cannot express them."""
    return json.dumps(_finite(value), indent=2)


def write_json(path: Path, value: Any, error_type: type[McaprlError] | None = None) -> None:
    """Write a value to a file atomically, as the JSON text that `json_text` returns."""
    write_atomically(path, f"{json_text(value)}\n".encode(), error_type)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
