"""What only some operating systems have, each with a fallback.

Only `_interrupt`, which is imported before all others, asks for signals of a system as well.

Locks, descriptors of folders, owners of files and signal masks are those of POSIX. On Windows
nothing is locked, names in folders are resolved again at each use, and signals are not held back
while a process starts. Linux alone can bind sockets to the loopback interface. The tests run the
commands without all of these.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

try:
    import fcntl
except ImportError:
    fcntl = None  # type: ignore[assignment]

HAS_FOLDER_DESCRIPTORS: Final = hasattr(os, "O_DIRECTORY") and os.open in os.supports_dir_fd
"""Whether a folder can be opened, locked, and used instead of its path."""
STOPS: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Signals that end a program."""
END: Final = signal.SIGTERM if hasattr(signal, "pthread_kill") else signal.SIGINT
"""Signal that ends a worker. Background processes ignore SIGINT; Windows cannot send SIGTERM."""


def lock_descriptor(descriptor: int, *, wait: bool = False) -> bool | None:
    """Lock an open file; return False if another process has, and None if there are no locks."""
    # Some network file systems have no locks either.
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def unlock_descriptor(descriptor: int) -> None:
    """End a lock, also if a forked process still has the file open."""
    if fcntl is not None:
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_UN)


def folder_descriptor(folder: Path, *, follow: bool = True) -> int:
    """Open a folder; where that is not possible, the descriptor is that of the null device."""
    if not HAS_FOLDER_DESCRIPTORS:
        return os.open(os.devnull, os.O_RDONLY)
    return os.open(folder, os.O_RDONLY | os.O_DIRECTORY | (0 if follow else os.O_NOFOLLOW))


def is_of_another_user(state: os.stat_result) -> bool:
    """Return whether a file belongs to another user; Windows does not say."""
    return hasattr(os, "geteuid") and state.st_uid != os.geteuid()


def read_at(descriptor: int, size: int, place: int) -> bytes:
    """Read bytes of a file, and leave its position as it is."""
    if hasattr(os, "pread"):
        return os.pread(descriptor, size, place)
    before = os.lseek(descriptor, 0, os.SEEK_CUR)
    try:
        os.lseek(descriptor, place, os.SEEK_SET)
        return os.read(descriptor, size)
    finally:
        os.lseek(descriptor, before, os.SEEK_SET)


def has_display() -> bool:
    """Return whether programs can open a window."""
    has_windows = sys.platform in ("win32", "darwin")
    return has_windows or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))


def memory_maps() -> Any:
    """Return the C library; None without `mmap` of 64-bit offsets, where Python's is used."""
    import ctypes

    if fcntl is None or ctypes.sizeof(ctypes.c_long) < 8:
        return None
    libc = ctypes.CDLL(None, use_errno=True)
    address, size, number = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
    libc.mmap.restype = address
    libc.mmap.argtypes = [address, size, number, number, number, ctypes.c_long]
    libc.munmap.argtypes = [address, size]
    libc.madvise.argtypes = [address, size, number]
    return libc


def unblock_stops() -> None:
    """Receive the signals that `blocked_stops` holds back."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)


@contextmanager
def blocked_stops() -> Iterator[None]:
    """Block signals in this thread and in new processes. A process unblocks them when ready."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    # Start the resource tracker first: its start unblocks the signals.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def udp_sockets() -> set[int] | None:
    """Return the UDP sockets of this process; None if they cannot be bound to an interface."""
    import socket

    if not hasattr(socket, "SO_BINDTODEVICE") or not os.path.isdir("/proc/self/fd"):
        return None
    found = set()
    for name in os.listdir("/proc/self/fd"):
        with suppress(OSError):
            if os.readlink(f"/proc/self/fd/{name}").startswith("socket:"):
                with socket.socket(fileno=os.dup(int(name))) as one:
                    if (one.family, one.type) == (socket.AF_INET, socket.SOCK_DGRAM):
                        found.add(int(name))
    return found


def bind_to_interface(descriptor: int, interface: str) -> None:
    """Let a socket of `udp_sockets` receive from one interface alone."""
    import socket

    with socket.socket(fileno=os.dup(descriptor)) as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, f"{interface}\0".encode())
