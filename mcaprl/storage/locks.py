"""Locks on files and folders, which end with the process that took them.

A forked process inherits the open files of its parent, and with them the locks. A child that
outlives a killed recorder would keep the log locked. A forked process therefore closes its copies
of all locked files; the locks of the parent remain.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import BinaryIO, Protocol
from weakref import WeakKeyDictionary

from mcaprl.errors import LogError
from mcaprl.system import lock_descriptor, unlock_descriptor

_TAKEN = "{} is being written by another process; wait until it ends, or choose another path"
_NOT_REGULAR = "it is not a regular file"
_OWN = "this program has an open recorder of {0}: call close() on it"


class Lockable(Protocol):
    """Open file or folder."""

    @property
    def closed(self) -> bool:
        """Whether the file is closed."""

    def fileno(self) -> int:
        """Return the descriptor."""

    def close(self) -> None:
        """Close the file, which ends its lock."""


class OpenFolder:
    """Descriptor of a folder, which is closed once."""

    def __init__(self, descriptor: int) -> None:
        """Take over a descriptor."""
        self._descriptor: int | None = descriptor

    @property
    def closed(self) -> bool:
        """Whether the descriptor is closed."""
        return self._descriptor is None

    def fileno(self) -> int:
        """Return the descriptor."""
        if self._descriptor is None:
            raise ValueError("the folder is closed")
        return self._descriptor

    def close(self) -> None:
        """Close the descriptor, which ends its lock."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


# Locked files of this process, and whether a recorder writes them.
_held: WeakKeyDictionary[Lockable, bool] = WeakKeyDictionary()


def _close_inherited() -> None:
    for file in list(_held):
        with suppress(OSError):
            file.close()
    _held.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_inherited)


def lock(file: Lockable) -> bool:
    """Lock an open file or folder until it is closed; return False if it is locked already."""
    if not try_lock(file.fileno()):
        return False
    hold(file)
    return True


def hold(file: Lockable, *, records: bool = False) -> None:
    """Close a locked file in processes that are forked from this one."""
    _held[file] = records


def try_lock(descriptor: int) -> bool:
    """Lock an open file or folder; return False if it is locked already."""
    # The lock is advisory and ends when the file is closed. On systems without `flock`, such as
    # Windows and some network file systems, nothing is locked, and the result is True.
    return lock_descriptor(descriptor) is not False


def taken(path: Path, descriptor: int | None = None) -> LogError:
    """Return the error for a file that is locked already."""
    if descriptor is not None:
        state = os.fstat(descriptor)
        for file in [file for file, records in list(_held.items()) if records]:
            # Another thread may close the file.
            with suppress(OSError, ValueError):
                if os.path.samestat(os.fstat(file.fileno()), state):
                    return LogError(_OWN.format(path))
    return LogError(_TAKEN.format(path))


@contextmanager
def waiting_lock(file: BinaryIO | FileIO) -> Iterator[None]:
    """Lock an open file, after another process that has it."""
    # Unlock it at the end. See `try_lock`.
    lock_descriptor(file.fileno(), wait=True)
    try:
        yield
    finally:
        file.flush()
        # A forked process may still have the file open, so closing it does not end the lock.
        unlock_descriptor(file.fileno())


@contextmanager
def locked_file(path: Path) -> Iterator[None]:
    """Lock a file against other writers. Do nothing if it does not exist or cannot be read."""
    while True:
        try:
            file = FileIO(open_at_once(path))
        except OSError:
            yield
            return
        with file:
            if not lock(file):
                raise taken(path, file.fileno())
            # A writer may have replaced the file before this lock was acquired: try again.
            if is_at(file.fileno(), path):
                yield
                return


def open_at_once(path: str | Path) -> int:
    """Open a regular file for reading, without waiting for the writer of a FIFO."""
    check_regular(path)
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(_NOT_REGULAR)
    return descriptor


def check_regular(path: str | Path) -> None:
    """Check that a path belongs to a regular file, so that opening it does not wait."""
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise OSError(_NOT_REGULAR)


def read_file(path: str | Path) -> bytes:
    """Read a regular file."""
    with FileIO(open_at_once(path)) as file:
        return file.readall()


def check_plain(path: str | Path) -> None:
    """Check that a path is a regular file, or a folder of such; libraries would wait for a FIFO."""
    if not os.path.isdir(path):
        check_regular(path)
        return
    for folder, _, names in os.walk(path):
        for name in names:
            place = os.path.join(folder, name)
            # A link to a missing file is an error of the reader that needs it.
            if os.path.exists(place) and not os.path.isfile(place):
                raise OSError(f"{place} is not a regular file")


def is_at(descriptor: int, path: str | Path) -> bool:
    """Return whether a descriptor and a path refer to the same file or folder."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except (FileNotFoundError, NotADirectoryError):
        return False
