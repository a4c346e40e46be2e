"""Opens the file that a log is written to: for one writer at a time.

The lock is advisory: it keeps out other writers of this library, on systems that have `flock`.
Readers need none, since a file only ever grows by whole records.
"""

from __future__ import annotations

import contextlib
import sys
from io import FileIO
from pathlib import Path

from mcaprl.errors import LogError, OutputExistsError

if sys.platform != "win32":
    import fcntl


def create(path: Path, *, overwrite: bool) -> FileIO:
    """Create a file and lock it; folders above it are made.

    Args:
        path: where to.
        overwrite: replace a file that is there. Who reads that one keeps it to the end.

    Raises:
        OutputExistsError: there is a file, and `overwrite` is not set.
        LogError: it cannot be created, or another writer is at work on it.
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
    """Open a file to change it, and lock it.

    Raises:
        LogError: it cannot be written, or another writer is at work on it.
    """
    try:
        return _locked(FileIO(path, "r+"), path)
    except OSError as error:
        raise LogError(f"cannot write {path}: {error.strerror}") from error


def release(file: FileIO) -> None:
    """Unlock and close a file, even one that a child process still holds."""
    if not file.closed and sys.platform != "win32":
        with contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_UN)
    file.close()


def refuse_if_taken(path: Path) -> None:
    """Make sure that nobody writes to the file.

    Raises:
        LogError: another writer is at work on it.
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
        # File systems without locks, as some of networks are: then there is none.
        except OSError:
            pass
    return file
