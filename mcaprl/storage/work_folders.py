"""Files and folders that replace their targets as a whole, and folders for temporary files.

A file is written in a hidden work folder beside its target. When the file is complete and synced to
disk, it replaces the target atomically. If the writer is killed, the target has either its old or
its new content. The next writer in the same folder removes the work folder.

`.NAME.part` beside a target holds the file until it is complete, and `mcaprl-*` in the folder for
temporary files holds copies for one run. Such a folder is locked while its process runs. It
contains an empty file, its mark, and its user's files in the folder `files`. Only a folder with the
mark, of the same user and without a lock is emptied or removed, so what other programs put at the
same path stays as it is. No symbolic link is followed: the folder is opened with `O_NOFOLLOW`, and
its content is listed and removed through this descriptor.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import FileIO
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any

from mcaprl.errors import LogError, McaprlError, OutputExistsError, UsageError
from mcaprl.storage.locks import OpenFolder, lock, locked_file, taken
from mcaprl.system import (
    HAS_FOLDER_DESCRIPTORS,
    folder_descriptor,
    is_of_another_user,
    lock_descriptor,
)

_MARK, _FILES = ".mcaprl-work-folder", "files"
_MAX_NAME_BYTES = 255
_PRIVATE = 0o700
# `Path` turns the two slashes of a URL into one.
_URL = re.compile(r"[a-z][a-z0-9+.-]+:/")
_LEFTOVER = re.compile(r"\..+\.part|mcaprl-.+", re.DOTALL)
_DIGITS = re.compile(r"\d+")
# Folders in which this process has looked for leftovers.
_searched: set[Path] = set()


@contextmanager
def work_folder(path: Path, *, concurrent: bool = False) -> Iterator[Path]:
    """Create and lock the work folder of a target, and yield an empty folder in it."""
    # It is removed at the end; before, what killed writers left in the same folder.
    check_local(path)
    folder = _work_path(path, f".{os.getpid()}.part" if concurrent else ".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent)
    opened = _locked(folder, path)
    files = folder / _FILES
    try:
        _restore(folder)
        _empty(folder, opened)
        files.mkdir(_PRIVATE)
        try:
            yield files
        except LogError as error:
            # The message names the target, because the user does not know the work folder.
            cause = error.__cause__
            if isinstance(cause, OSError) and str(folder) in str(error):
                raise LogError(f"cannot write {path}: {cause.strerror or cause}") from error
            raise
    finally:
        _remove(folder, opened)


def remove_leftover(path: Path) -> None:
    """Remove the work folder of a target if a process was killed while writing it."""
    remove_leftovers(path.parent)
    with suppress(OSError):
        _remove_left(_work_path(path))


def is_leftover(folder: Path) -> bool:
    """Return whether a folder is the work folder of a target, made by this package."""
    try:
        opened = _opened(folder, create=False)
    except (OSError, OutputExistsError):
        return False
    opened.close()
    return bool(_LEFTOVER.fullmatch(folder.name))


def remove_leftovers(parent: Path) -> None:
    """Remove work and temporary folders that killed processes left, once; none without locks."""
    parent = Path(os.path.abspath(parent))
    if parent in _searched:
        return
    _searched.add(parent)
    with suppress(OSError), os.scandir(parent) as entries:
        for entry in entries:
            if _LEFTOVER.fullmatch(entry.name) and entry.is_dir(follow_symlinks=False):
                with suppress(OSError, OutputExistsError):
                    _remove_left(Path(entry.path), marked=True)


class TemporaryFolder:
    """Folder for temporary files, removed by `remove`, with the object, or when Python exits."""

    # If the process is killed, the next one that makes a temporary folder removes it.

    def __init__(self) -> None:
        """Create the folder."""
        remove_leftovers(Path(tempfile.gettempdir()))
        folder = Path(tempfile.mkdtemp(prefix="mcaprl-"))
        opened = _opened(folder)
        lock(opened)
        _mark(folder, opened)
        self.path = folder / _FILES
        self.path.mkdir(_PRIVATE)
        # Unlike `weakref.finalize`, this also works at the end of a process of `multiprocessing`,
        # and does nothing in a forked process.
        self._finalizer = Finalize(self, _remove, (folder, opened), exitpriority=0)

    def remove(self) -> None:
        """Remove the folder."""
        self._finalizer()


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Create a temporary folder; remove it at the end."""
    try:
        folder = TemporaryFolder()
    except OSError as error:
        place = tempfile.gettempdir()
        raise LogError(f"cannot write to {place}: {error.strerror or error}") from error
    try:
        yield folder.path
    finally:
        folder.remove()


def fresh_folder(path: Path) -> Path:
    """Create a hidden folder for other processes, or empty it; the caller holds a lock."""
    path.parent.mkdir(parents=True, exist_ok=True)
    opened = _opened(path)
    try:
        _mark(path, opened)
        _empty(path, opened)
    finally:
        opened.close()
    return path


def check_local(path: Path) -> None:
    """Raise UsageError if the path of an output is a URL."""
    if _URL.match(str(path)):
        url = str(path).replace(":/", "://", 1)
        raise UsageError(
            f"{url} is a URL, but outputs are local: choose a local path; record, convert and"
            " online training copy their logs with `upload=URL`"
        )


def _work_path(path: Path, suffix: str = ".part") -> Path:
    name = f".{path.name}{suffix}"
    if len(os.fsencode(name)) > _MAX_NAME_BYTES:
        name = f".{hashlib.sha256(os.fsencode(name)).hexdigest()[:32]}{suffix}"
    return path.with_name(name)


def target_of(folder: Path) -> str:
    """Return the name of the target of a work folder."""
    return folder.name.removeprefix(".").removesuffix(".part")


def _restore(folder: Path) -> None:
    """Move a folder back that a killed process was replacing; see `moved_aside`."""
    old, target = (
        moved_aside(folder / _FILES, target_of(folder)),
        folder.with_name(target_of(folder)),
    )
    if old.is_dir() and not old.is_symlink() and not os.path.lexists(target):
        with suppress(OSError):
            old.rename(target)


def moved_aside(files: Path, name: str) -> Path:
    """Return the path in a work folder for the earlier version of a target that is a folder."""
    return files / f"{name}.old"


def _locked(folder: Path, path: Path) -> OpenFolder:
    """Create, lock and mark the work folder of a target."""
    while True:
        opened = _opened(folder)
        try:
            if not lock(opened):
                raise taken(path, opened.fileno())
            # A writer may have removed the folder before this lock was acquired: try again.
            if _is_at(opened, folder):
                _mark(folder, opened)
                return opened
        except BaseException:
            opened.close()
            raise
        opened.close()


def _opened(folder: Path, *, create: bool = True) -> OpenFolder:
    """Open a folder of this package; create it if it is missing and `create` is set."""
    is_new = False
    if create:
        with suppress(FileExistsError):
            folder.mkdir(_PRIVATE)
            is_new = True
    try:
        mode = folder.lstat().st_mode
        if not stat.S_ISDIR(mode):
            kind = "a symbolic link" if stat.S_ISLNK(mode) else "not a folder"
            raise _foreign(folder, f"is {kind}")
        opened = OpenFolder(folder_descriptor(folder, follow=False))
    except FileNotFoundError:
        if not create:
            raise
        # Its process has removed it in the meantime.
        return _opened(folder)
    try:
        # Some file systems give all files to one user, so a new folder may have another owner.
        if not is_new and (problem := _problem(folder, opened)):
            raise _foreign(folder, problem)
    except BaseException:
        opened.close()
        raise
    return opened


def _problem(folder: Path, opened: OpenFolder) -> str:
    """Return why an existing folder is not one of this package; empty if it is one."""
    # Earlier versions made no mark: their folders contain nothing but the target.
    if HAS_FOLDER_DESCRIPTORS and is_of_another_user(os.fstat(opened.fileno())):
        return "belongs to another user"
    entries = _entries(folder, opened)
    is_marked = stat.S_ISREG(entries.get(_MARK, 0))
    is_early = all(n == target_of(folder) and not stat.S_ISLNK(m) for n, m in entries.items())
    return "" if is_marked or is_early else "has files that mcaprl did not write"


def _foreign(folder: Path, problem: str) -> OutputExistsError:
    return OutputExistsError(
        f"{folder} {problem}, but its name is that of a work folder: move or delete it, or choose"
        " another output"
    )


def _is_at(opened: OpenFolder, folder: Path) -> bool:
    if not HAS_FOLDER_DESCRIPTORS:
        return True
    try:
        return os.path.samestat(os.fstat(opened.fileno()), folder.lstat())
    except (FileNotFoundError, NotADirectoryError):
        return False


def _at(folder: Path, opened: OpenFolder) -> tuple[int | Path, dict[str, int]]:
    """Return how to list a folder, and the argument with which names are relative to it."""
    if not HAS_FOLDER_DESCRIPTORS:
        return folder, {}
    return opened.fileno(), {"dir_fd": opened.fileno()}


def _entries(folder: Path, opened: OpenFolder) -> dict[str, int]:
    """Return the names in a folder and their modes, without following links."""
    with os.scandir(_at(folder, opened)[0]) as entries:
        return {one.name: one.stat(follow_symlinks=False).st_mode for one in entries}


def _mark(folder: Path, opened: OpenFolder) -> None:
    options = _at(folder, opened)[1]
    flags = os.O_WRONLY | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
    os.close(os.open(_MARK if options else folder / _MARK, flags, 0o600, **options))


def _empty(folder: Path, opened: OpenFolder) -> None:
    """Remove everything but the mark, which is removed last."""
    options = _at(folder, opened)[1]
    for name, mode in _entries(folder, opened).items():
        place = name if options else folder / name
        if stat.S_ISDIR(mode):
            shutil.rmtree(place, dir_fd=options.get("dir_fd"))
        elif name != _MARK:
            os.unlink(place, **options)


def _remove(folder: Path, opened: OpenFolder) -> None:
    """Remove a folder and end its lock; do nothing in a process forked from its own."""
    if opened.closed:
        return
    try:
        with suppress(OSError):
            _empty(folder, opened)
            options = _at(folder, opened)[1]
            os.unlink(_MARK if options else folder / _MARK, **options)
            if _is_at(opened, folder):
                folder.rmdir()
    finally:
        opened.close()


def _remove_left(folder: Path, *, marked: bool = False) -> None:
    """Remove a folder of this package if no process has locked it."""
    # A new folder is locked before it is marked, so an empty one is left alone: locking it here
    # could refuse its process.
    opened = _opened(folder, create=False)
    try:
        entries = _entries(folder, opened)
        is_left = _MARK in entries if marked else bool(entries)
        if is_left and lock_descriptor(opened.fileno()) and _is_at(opened, folder):
            _restore(folder)
            _remove(folder, opened)
    finally:
        opened.close()


@contextmanager
def locked_folder(folder: Path, error_type: type[McaprlError] = LogError) -> Iterator[None]:
    """Create a folder if it is missing, and lock it; a new one that stays empty is removed."""
    check_local(folder)
    is_new, opened = not folder.exists(), None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if HAS_FOLDER_DESCRIPTORS:
            opened = OpenFolder(folder_descriptor(folder))
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
    elif own and is_of_another_user(state):
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
    """Yield a path in a work folder; move the file written there to `path` at the end."""
    # It is synced before. `path` is left as it was if the body raises an error, or if another
    # writer has locked or created the file in the meantime.
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
    """Yield an empty folder in a work folder; sync it and move it to `path`, but not on errors."""
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
