"""Files that are opened by one writer at a time.

The lock is advisory: it keeps out other writers of this library, on systems with `flock`. Readers
need no lock, since a file only grows by whole records or is replaced as a whole.
"""

from __future__ import annotations

import contextlib
import os
import sys
from io import FileIO
from pathlib import Path

from mcaprl.errors import LogError, OutputExistsError

if sys.platform != "win32":
    import fcntl


def create(path: Path, *, overwrite: bool) -> FileIO:
    """Create and lock a file and the missing folders of its path.

    Args:
        path: Path of the file.
        overwrite: Whether to replace an existing file; its readers keep the old contents.

    Raises:
        OutputExistsError: The file exists, and `overwrite` is not set.
        LogError: The file cannot be created, or another writer has locked it.
    """
    if path.exists() and not overwrite:
        raise OutputExistsError(f"{path} exists: choose another path, or pass --overwrite")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_file():
            refuse_if_taken(path)
            path.resolve().unlink()
            return _locked(FileIO(path.resolve(), "x"), path)
        return _locked(FileIO(path, "w" if path.exists() else "x"), path)
    except OSError as error:
        raise LogError(f"cannot write {path}: {error.strerror}") from error


def reopen(path: Path) -> FileIO:
    """Open a file for reading and writing, and lock it.

    Raises:
        LogError: The file cannot be written, or another writer has locked it.
    """
    try:
        while True:
            file = _locked(FileIO(path, "r+"), path)
            # A writer that has just finished may have replaced the file before its lock was free.
            if is_at(file, path):
                return file
            release(file)
    except OSError as error:
        raise LogError(f"cannot write {path}: {error.strerror}") from error


def release(file: FileIO) -> None:
    """Unlock and close a file, even if a child process still has it open."""
    if not file.closed and sys.platform != "win32":
        with contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_UN)
    file.close()


def is_at(file: FileIO, path: Path) -> bool:
    """Return whether an open file is the one at a path.

    Raises:
        OSError: There is no file at the path.
    """
    return os.path.samestat(os.fstat(file.fileno()), path.stat())


def refuse_if_taken(path: Path) -> None:
    """Raise an error if another writer has locked the file.

    Raises:
        LogError: Another writer has locked it.
    """
    if path.is_file():
        with contextlib.suppress(OSError):
            release(_locked(FileIO(path, "r"), path))


def _locked(file: FileIO, path: Path) -> FileIO:
    if sys.platform != "win32":
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.close()
            raise LogError(
                f"{path} is being written by another recording; wait for its end, or choose"
                " another path"
            ) from error
        # Some network file systems have no locks.
        except OSError:
            pass
    return file
