"""Decorators that compile the equations of the sims, and other loops, to machine code."""

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
    """Compile a function with numba at its first call, and cache the machine code on disk.

    `fastmath` is off, so that sums keep their written order and equal inputs produce identical
    results. A division by 0 returns inf or NaN, as in NumPy, because a check before each division
    would prevent vectorization. Type checkers see the original signature.

    If `NUMBA_CACHE_DIR` is set, that folder is the cache. Otherwise it is `__pycache__` beside the
    source, or the user's cache folder if `__pycache__` cannot be written. If no folder can be
    written, each process compiles again.

    Only an edit of the function's own file invalidates the cache. After an edit of a function that
    other files call, delete the `__pycache__` folder.
    """
    return _compiled(function)


def inlined(function: AnyFunction) -> AnyFunction:
    """Compile a function and inline it into each compiled function that calls it.

    Loops over vehicles can then be vectorized. With `compiled` instead, the compiler inlines only
    short functions.
    """
    return _compiled(function, forceinline=True)


def ready(
    function: Callable[..., Result], *arguments: Any, examples: tuple[Any, ...] = ()
) -> Callable[..., Result]:
    """Bind the first arguments of a compiled function, arrays or constants, for faster calls.

    A normal call inspects the type of each argument. For a single vehicle, this takes as long as
    the step itself. This function inspects the types once. The contents of the bound arrays may
    change, but not their shape or memory.

    Args:
        function: Compiled function.
        *arguments: First arguments, which each call reuses.
        examples: Example values of the arguments that each call passes; only the types matter.
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
        _Announcer.lasts = "again in each process: no cache folder is writable; set NUMBA_CACHE_DIR"
        machine_code = numba.njit(**options)(function)
    return cast(AnyFunction, machine_code)


class _Announcer(event.Listener):  # type: ignore[misc]
    """Listener that announces the first compilation, because it takes several seconds."""

    lasts: ClassVar[str] = "once"
    is_silent: ClassVar[bool] = False

    def on_start(self, event: Any) -> None:
        """Print one line to stderr at the first compilation."""
        module = event.data["dispatcher"].py_func.__module__
        if module.startswith("mcaprl.") and not _Announcer.is_silent:
            _Announcer.is_silent = True
            # Commands compile what they need, so a later one may compile another part.
            part = module.removeprefix("mcaprl.").removeprefix("sims.")
            print(f"compiling {part} for this machine, {self.lasts}", file=sys.stderr)

    def on_end(self, event: Any) -> None:
        """Do nothing."""


event.register("numba:compile", _Announcer())
