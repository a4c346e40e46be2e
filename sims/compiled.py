"""One decorator for every equation that runs as machine code."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

AnyFunction = TypeVar("AnyFunction", bound=Callable[..., object])


def compiled(function: AnyFunction) -> AnyFunction:
    """Compile a function with numba at its first call, and keep the result on disk.

    Without `fastmath`: sums keep the order they are written in, so the same input gives the same
    bits. The decorator says to a type checker that the signature stays as written.

    The cache notices an edit of the function's own file only. After an edit of a function that is
    called from other files, delete the `__pycache__` folder.
    """
    return cast(AnyFunction, numba.njit(cache=True)(function))
