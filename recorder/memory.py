"""Memory for long columns, in large pages where the system has them.

A page of memory is made ready when it is first touched. A large one takes a quarter of the time of
the small ones that would cover it, and reading touches all of a column.
"""

from __future__ import annotations

import contextlib
import math
import mmap
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

_LARGE_PAGE = 2 * 2**20


def empty(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """An array whose numbers are not set yet, as `np.empty` gives."""
    dtype = np.dtype(dtype)
    size = math.prod(shape) * dtype.itemsize
    # Other systems choose their pages themselves.
    if size < _LARGE_PAGE or not hasattr(mmap, "MADV_HUGEPAGE"):
        return np.empty(shape, dtype)
    pages = -(-size // _LARGE_PAGE)
    # One more, to begin where a large page can: it is never touched, so it takes nothing.
    memory = mmap.mmap(-1, (pages + 1) * _LARGE_PAGE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    bytes_ = np.frombuffer(memory, np.uint8)
    start = -bytes_.ctypes.data % _LARGE_PAGE
    # A kernel may be built without them.
    with contextlib.suppress(OSError):
        memory.madvise(mmap.MADV_HUGEPAGE, start, pages * _LARGE_PAGE)
    return bytes_[start : start + size].view(dtype).reshape(shape)
