"""Read-only memory maps of files that keep no descriptor open.

`mmap.mmap` keeps a copy of the descriptor, so a process could not have more files open than it may
have descriptors, which are usually 1024.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import sys
from typing import Any

import numpy as np

_FAILED = ctypes.c_void_p(-1).value


def mapped(descriptor: int, size: int) -> memoryview:
    """Map the first `size` bytes of a file; the caller may close the descriptor.

    Raises:
        OSError: The file cannot be mapped.
        ValueError: The file is shorter, on systems where `mmap.mmap` is used.
    """
    if _LIBC is None:
        return memoryview(mmap.mmap(descriptor, size, access=mmap.ACCESS_READ))
    return np.asarray(_Map(descriptor, size)).data


def prefetch(view: memoryview, start: int, stop: int) -> None:
    """Let the system start to load the pages of a range of bytes of a mapped file from the disk."""
    owner = _owner(view)
    if owner is not None:
        owner.advise(start, stop, mmap.MADV_WILLNEED)


def release(view: memoryview) -> None:
    """Let the system take back the memory of a mapped file; it is read again when it is needed."""
    owner = _owner(view)
    if owner is not None:
        owner.advise(0, view.nbytes, mmap.MADV_DONTNEED)


def _owner(view: memoryview) -> _Map | None:
    owner = view.obj.base if isinstance(view.obj, np.ndarray) else view.obj
    return owner if isinstance(owner, _Map) else None


class _Map:
    """Mapped bytes, as an array that NumPy does not copy; unmapped when no array uses them."""

    def __init__(self, descriptor: int, size: int) -> None:
        assert _LIBC is not None
        self._size = 0
        address = _LIBC.mmap(None, size, mmap.PROT_READ, mmap.MAP_SHARED, descriptor, 0)
        if address == _FAILED:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))
        self._address, self._size = int(address), size
        self.__array_interface__ = {
            "data": (self._address, True),
            "shape": (size,),
            "typestr": "|u1",
            "version": 3,
        }

    def advise(self, start: int, stop: int, advice: int) -> None:
        assert _LIBC is not None
        first = start - start % mmap.PAGESIZE
        _LIBC.madvise(self._address + first, stop - first, advice)

    def __del__(self) -> None:
        if self._size and _LIBC is not None:
            _LIBC.munmap(self._address, self._size)


def _libc() -> Any:
    """Return the C library; None if it has no `mmap` of 64-bit offsets."""
    if sys.platform == "win32" or ctypes.sizeof(ctypes.c_long) < 8:
        return None
    libc = ctypes.CDLL(None, use_errno=True)
    address, size, number = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
    libc.mmap.restype = address
    libc.mmap.argtypes = [address, size, number, number, number, ctypes.c_long]
    libc.munmap.argtypes = [address, size]
    libc.madvise.argtypes = [address, size, number]
    return libc


_LIBC = _libc()
