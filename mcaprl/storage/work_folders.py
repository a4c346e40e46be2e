"""Folders for unfinished and temporary files, which are removed when their process ends.

`.NAME.part` beside a target holds the file until it is complete, and `mcaprl-*` in the folder for
temporary files holds copies for one run. Such a folder is locked while its process runs. It
contains an empty file, its mark, and its user's files in the folder `files`. Only a folder with the
mark, of the same user and without a lock is emptied or removed, so what other programs put at the
same path stays as it is. No symbolic link is followed: the folder is opened with `O_NOFOLLOW`, and
its content is listed and removed through this descriptor.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.util import Finalize
from pathlib import Path

from mcaprl.errors import LogError, OutputExistsError, UsageError
from mcaprl.storage.locks import OpenFolder, lock, surely_locked, taken

_MARK, _FILES = ".mcaprl-work-folder", "files"
_MAX_NAME_BYTES = 255
_PRIVATE = 0o700
# `Path` turns the two slashes of a URL into one.
_URL = re.compile(r"[a-z][a-z0-9+.-]+:/")
_LEFTOVER = re.compile(r"\..+\.part|mcaprl-.+", re.DOTALL)
# Folders in which this process has looked for leftovers.
_searched: set[Path] = set()


@contextmanager
def work_folder(path: Path, *, concurrent: bool = False) -> Iterator[Path]:
    """Create and lock the work folder of a target, and yield an empty folder in it.

    The work folder is removed at the end. What killed writers left in the same folder is removed
    first.
    """
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
    """Remove the work folders and temporary folders that killed processes left in a folder.

    Each process searches a folder once. Where locks do not work, nothing is removed.
    """
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
    """Folder for temporary files of this process.

    It is removed by `remove`, when the object is deleted, or when Python exits. If the process is
    killed, the next one that makes a temporary folder removes it.

    Attributes:
        path: Path of the folder.
    """

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
    """Create a hidden folder that other processes fill, or empty the one of an earlier run.

    The caller must hold a lock that keeps out other runs.
    """
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
        opened = OpenFolder(_descriptor_of(folder))
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


def _descriptor_of(folder: Path) -> int:
    if sys.platform == "win32":
        return os.open(os.devnull, os.O_RDONLY)
    return os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)


def _problem(folder: Path, opened: OpenFolder) -> str:
    """Return why an existing folder is not one of this package; empty if it is one.

    Earlier versions made no mark: their folders contain nothing but the target.
    """
    if sys.platform != "win32" and os.fstat(opened.fileno()).st_uid != os.geteuid():
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
    if sys.platform == "win32":
        return True
    try:
        return os.path.samestat(os.fstat(opened.fileno()), folder.lstat())
    except (FileNotFoundError, NotADirectoryError):
        return False


def _at(folder: Path, opened: OpenFolder) -> tuple[int | Path, dict[str, int]]:
    """Return how to list a folder, and the argument with which names are relative to it."""
    if sys.platform == "win32":
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
    """Remove a folder of this package if no process has locked it.

    Its process locks a new folder before it writes the mark. An empty folder is therefore left
    alone: locking it here could refuse its process.
    """
    opened = _opened(folder, create=False)
    try:
        entries = _entries(folder, opened)
        is_left = _MARK in entries if marked else bool(entries)
        if is_left and surely_locked(opened.fileno()) and _is_at(opened, folder):
            _restore(folder)
            _remove(folder, opened)
    finally:
        opened.close()
