"""Atomic replacement of files and folders.

A file is written in a hidden work folder beside its target. This folder, `.NAME.part`, is locked
while its writer runs. When the file is complete and synced to disk, it replaces the target
atomically. If the writer is killed, the target has either its old or its new content. The next
writer in the same folder removes the work folder. `mcaprl.storage.locks` has the locks,
`mcaprl.storage.work_folders` the work folders, and `mcaprl.storage.documents` the readers of JSON
and YAML; other modules import them from here.
"""

from __future__ import annotations

import json
import math
import os
import re
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import Any

from mcaprl.errors import LogError, McaprlError, OutputExistsError, UsageError
from mcaprl.storage.documents import as_type, parse_json, read_json, read_yaml
from mcaprl.storage.locks import (
    OpenFolder,
    check_plain,
    check_regular,
    hold,
    is_at,
    lock,
    locked_file,
    open_at_once,
    read_file,
    taken,
    try_lock,
    waiting_lock,
)
from mcaprl.storage.work_folders import (
    TemporaryFolder,
    check_local,
    fresh_folder,
    is_leftover,
    moved_aside,
    remove_leftover,
    target_of,
    temporary_folder,
    work_folder,
)

__all__ = [
    "TemporaryFolder",
    "as_type",
    "check_log_name",
    "check_plain",
    "check_regular",
    "check_target",
    "check_writable",
    "fresh_folder",
    "hold",
    "is_at",
    "is_leftover",
    "json_text",
    "locked_file",
    "locked_folder",
    "open_at_once",
    "open_own",
    "parse_json",
    "read_file",
    "read_json",
    "read_yaml",
    "remove_leftover",
    "replacing",
    "replacing_folder",
    "size_of",
    "subfolder",
    "taken",
    "target_of",
    "temporary_folder",
    "try_lock",
    "waiting_lock",
    "work_folder",
    "write_atomically",
    "write_json",
]

_DIGITS = re.compile(r"\d+")


@contextmanager
def locked_folder(folder: Path, error_type: type[McaprlError] = LogError) -> Iterator[None]:
    """Create a folder if it is missing, and lock it against other writers.

    If the folder is new and empty at the end, it is removed.
    """
    check_local(folder)
    is_new, opened = not folder.exists(), None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if sys.platform != "win32":
            opened = OpenFolder(os.open(folder, os.O_RDONLY | os.O_DIRECTORY))
    except OSError as error:
        raise error_type(f"cannot write {folder}: {_reason(folder, error)}") from error
    try:
        if opened is not None and not lock(opened):
            raise error_type(
                f"{folder} is in use by another recording or training: wait until it ends, or"
                " choose another folder"
            )
        try:
            yield
        finally:
            # A forked process has closed its copy, and must not remove its parent's folder.
            if is_new and not (opened is not None and opened.closed):
                with suppress(OSError):
                    folder.rmdir()
    finally:
        if opened is not None:
            opened.close()


def subfolder(path: Path, *, own: bool = False) -> Path:
    """Create a folder in the folder of an output, if it is missing; return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with suppress(FileExistsError):
        path.mkdir()
    state, problem = path.lstat(), ""
    if not stat.S_ISDIR(state.st_mode):
        problem = "is a symbolic link" if path.is_symlink() else "is not a folder"
    elif own and sys.platform != "win32" and state.st_uid != os.geteuid():
        problem = "belongs to another user"
    if problem:
        raise OutputExistsError(f"{path} {problem}: move or delete it, or choose another output")
    return path


def open_own(path: Path, mode: str) -> FileIO:
    """Open a file of a cache, or create it; follow no symbolic link."""
    flags = {"a": os.O_WRONLY | os.O_APPEND, "r+": os.O_RDWR}[mode]
    flags |= os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    if os.path.lexists(path) and not stat.S_ISREG(path.lstat().st_mode):
        raise OutputExistsError(f"{path} is not a regular file: move or delete it")
    return FileIO(path, mode, opener=lambda name, _: os.open(name, flags, 0o666))


def check_target(path: Path, *, overwrite: bool) -> None:
    """Check that a path is new, or belongs to a regular file that may be replaced."""
    check_local(path)
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
    with locked_file(path):
        pass
    if not overwrite:
        raise OutputExistsError(f"{path} exists: choose another path, or pass `overwrite=True`")


def check_writable(path: Path, error_type: type[McaprlError]) -> None:
    """Check that a file can be written, without writing it; create its folder if it is missing."""
    try:
        with work_folder(path):
            pass
    except OSError as error:
        raise error_type(f"cannot write {path}: {_reason(path, error)}") from error


def check_log_name(path: str | Path) -> Path:
    """Check that the name of a log to write ends in `.mcap`; return the path."""
    path = Path(path)
    if path.suffix != ".mcap":
        raise UsageError(f"{path}: the name of a log must end in .mcap")
    return path


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
                # Between these two moves, nothing is at `path`. If the process is killed there,
                # the next run moves the old folder back.
                os.rename(path, moved_aside(work, path.name))
            os.rename(unfinished, path)
    except OSError as error:
        raise error_type(f"cannot write {path}: {_reason(path, error)}") from error


def _reason(path: Path, error: OSError) -> str:
    """Return why a file or folder cannot be created."""
    if isinstance(error, FileExistsError | NotADirectoryError):
        for folder in (path, *path.parents):
            if folder.is_symlink() and not folder.exists():
                return f"{folder} is a symbolic link to a missing file"
            if folder.exists() and not folder.is_dir():
                return f"{folder} is not a folder"
    # Some libraries put a sentence of theirs in the place of the system's text.
    return os.strerror(error.errno) if error.errno else str(error)


def _check_folder(path: Path, *, overwrite: bool) -> None:
    check_local(path)
    if path.is_symlink() or (path.exists() and not path.is_dir()):
        raise OutputExistsError(f"{path} is not a folder: choose another path")
    if path.name in ("", ".."):
        raise OutputExistsError(f"{path} cannot be replaced: give the name of the folder")
    if path.exists() and not overwrite:
        raise OutputExistsError(f"{path} exists: choose another path, or pass `overwrite=True`")


def _check_contents(path: Path, replacement: Path) -> None:
    """Check that a folder has only files that an earlier run of the same command wrote."""
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
