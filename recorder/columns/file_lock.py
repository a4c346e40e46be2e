"""Files that are written in place, by one writer at a time, while others read them.

Readers need no lock, since a file only grows by whole records or is replaced as a whole: a writer
never changes or cuts off bytes that a reader may have mapped.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import sys
from io import FileIO
from pathlib import Path

from mcaprl.errors import LogError
from mcaprl.files import check_regular, check_target, hold, is_at, taken, try_lock, work_folder

if sys.platform != "win32":
    import fcntl

_COPIED_BYTES = 2**20


def create(path: Path, *, overwrite: bool) -> FileIO:
    """Create and lock a file and the missing folders of its path.

    If a file is overwritten, processes that have it open still read the old contents.
    """
    check_target(path, overwrite=overwrite)
    try:
        if path.exists():
            return replaced(path, reopen(path), 0)
        path.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            file = _locked(FileIO(path, "x"), path)
            if is_at(file.fileno(), path):
                return file
            release(file)
    except OSError as error:
        raise LogError(f"cannot write {path}: {error.strerror or error}") from error
    # Another process has created or replaced the file in the meantime.
    raise taken(path)


def reopen(path: Path) -> FileIO:
    """Open and lock an existing file."""
    try:
        while True:
            check_regular(path)
            file = _locked(FileIO(path, "r+"), path)
            if is_at(file.fileno(), path):
                return file
            release(file)
    except OSError as error:
        raise LogError(f"cannot write {path}: {error.strerror or error}") from error


def release(file: FileIO) -> None:
    """Unlock and close a file, even if a child process still has it open."""
    if not file.closed and sys.platform != "win32":
        with contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_UN)
    file.close()


def replaced(path: Path, locked: FileIO, length: int) -> FileIO:
    """Replace a file with a locked copy of its first bytes. Current readers keep the old file.

    The old file is released once the copy is in place; an error leaves the old file unchanged.

    Args:
        path: Path of the file; a symbolic link is followed.
        locked: The file, locked by the caller.
        length: Number of bytes to copy; the returned file is positioned after them.
    """
    path = path.resolve()
    with work_folder(path) as folder:
        unfinished = folder / path.name
        file = _locked(FileIO(unfinished, "x+"), path)
        try:
            copy_start(locked, file, length)
            os.chmod(unfinished, stat.S_IMODE(os.fstat(locked.fileno()).st_mode))
            os.replace(unfinished, path)
        except BaseException:
            release(file)
            raise
    release(locked)
    return file


def copy_start(source: FileIO, target: FileIO, length: int) -> None:
    """Copy the first bytes of a file."""
    source.seek(0)
    while length:
        part = memoryview(source.read(min(length, _COPIED_BYTES)))
        if not part:
            raise OSError(errno.EIO, "the file became shorter while it was copied")
        length -= len(part)
        while part:
            part = part[target.write(part) :]


def _locked(file: FileIO, path: Path) -> FileIO:
    if not try_lock(file.fileno()):
        error = taken(path, file.fileno())
        file.close()
        raise error
    hold(file, records=True)
    return file
