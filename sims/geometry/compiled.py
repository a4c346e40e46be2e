"""One decorator for every equation that runs as machine code."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, TypeVar, cast

import numba
from numba.core import event

AnyFunction = TypeVar("AnyFunction", bound=Callable[..., object])
Result = TypeVar("Result")


def compiled(function: AnyFunction) -> AnyFunction:
    """Compile a function with numba at its first call, and keep the result on disk.

    Without `fastmath`: sums keep the order they are written in, so the same input gives the same
    bits. A division by 0 gives inf or NaN, as in NumPy: a check before each would keep the compiler
    from doing several at once. The decorator says to a type checker that the signature stays as
    written.

    The result is kept in `__pycache__` beside the source; where that cannot be written, in the
    user's cache folder; where NUMBA_CACHE_DIR is set, there. Where nothing can be written, it lasts
    as long as the process.

    The cache notices an edit of the function's own file only. After an edit of a function that is
    called from other files, delete the `__pycache__` folder.
    """
    return _compiled(function)


def inlined(function: AnyFunction) -> AnyFunction:
    """Compile a function into each that calls it, however long it is.

    A loop over vehicles can then do several of them at once; by itself the compiler inlines short
    functions only.
    """
    return _compiled(function, forceinline=True)


def ready(
    function: Callable[..., Result], *arguments: Any, examples: tuple[Any, ...] = ()
) -> Callable[..., Result]:
    """Bind a compiled function to arguments that stay the same objects: arrays, and constants.

    A call by name looks at the type of each argument first, which for a single vehicle takes as
    long as the step itself. Here that is done once; the arrays' contents may change, and nothing
    else of them.

    Args:
        function: to be called.
        *arguments: its first ones.
        examples: of the types of the others, which are given in each call.
    """
    if not isinstance(function, numba.core.dispatcher.Dispatcher):
        return partial(function, *arguments)
    kinds = tuple(numba.typeof(argument) for argument in (*arguments, *examples))
    function.compile(kinds)
    return partial(function.get_overload(kinds), *arguments)


def _compiled(function: AnyFunction, **options: Any) -> AnyFunction:
    options = {"error_model": "numpy", **options}
    try:
        machine_code = numba.njit(cache=True, **options)(function)
    except RuntimeError:
        _Announcer.lasts = "in each process, as no cache folder can be written: set NUMBA_CACHE_DIR"
        machine_code = numba.njit(**options)(function)
    return cast(AnyFunction, machine_code)


class _Announcer(event.Listener):  # type: ignore[misc]
    """Tells whoever waits, once, that something of ours is compiled and not read from the cache."""

    lasts: ClassVar[str] = "once"
    is_silent: ClassVar[bool] = False

    def on_start(self, event: Any) -> None:
        """Say it at the first compilation."""
        ours = event.data["dispatcher"].py_func.__module__.startswith("mcaprl.")
        if ours and not _Announcer.is_silent:
            _Announcer.is_silent = True
            print(f"compiling the sim for this machine, {self.lasts}", file=sys.stderr)

    def on_end(self, event: Any) -> None:
        """Say nothing."""


event.register("numba:compile", _Announcer())
