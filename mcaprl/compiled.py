"""Decorators that compile the equations of the sims, and other loops, to machine code."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, ClassVar, TypeVar, cast

import numba
import numpy as np
from numba.core import cgutils, event, pythonapi, types
from numba.core.types.containers import NamedTuple, NamedUniTuple
from numba.extending import intrinsic, overload
from numpy.typing import DTypeLike, NDArray

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
    """Compile a function and inline it into compiled callers, whose loops then vectorize."""
    return _compiled(function, forceinline=True)


def ready(
    function: Callable[..., Result], *arguments: Any, examples: tuple[Any, ...] = ()
) -> Callable[..., Result]:
    """Bind the first arguments of a compiled function, arrays or constants, for faster calls."""
    # A normal call inspects the type of each argument, which for a single vehicle takes as long as
    # the step itself. The contents of the bound arrays may change, but not their shape or memory.
    if not isinstance(function, numba.core.dispatcher.Dispatcher):
        return partial(function, *arguments)
    kinds = tuple(numba.typeof(argument) for argument in (*arguments, *examples))
    function.compile(kinds)
    return partial(function.get_overload(kinds), *arguments)


Arrays = Any  # Arrays that `ready_at` bound. In a compiled function, this is an address.


def ready_at(
    function: Callable[..., Result],
    arrays: Sequence[NDArray[Any]],
    *constants: Any,
    examples: tuple[Any, ...] = (),
) -> Callable[..., Result]:
    """Bind the first arguments of a compiled function as `ready`, but its arrays as one address."""
    # For each array in a call, numba checks its type and counts a reference. For four arrays, this
    # takes nearly as long as computing a car's step.
    if not isinstance(function, numba.core.dispatcher.Dispatcher):
        return partial(function, arrays, *constants)
    addresses = np.array([array.ctypes.data for array in arrays], dtype=np.intp)
    bound = ready(function, addresses.ctypes.data, *constants, examples=examples)
    # An address is valid only as long as its array exists.
    bound.kept = addresses, arrays  # type: ignore[attr-defined]
    return bound


def array_at(arrays: Arrays, k: int, shape: tuple[int, ...], kind: DTypeLike) -> NDArray[Any]:
    """Return array k of those that `ready_at` bound; for compiled functions."""
    # Without compilation, `ready_at` binds the arrays themselves.
    return cast(NDArray[Any], arrays[k])


@overload(array_at, inline="always")  # type: ignore[untyped-decorator]
def _array_at(arrays: Any, k: Any, shape: Any, kind: Any) -> Any:
    def array_from(arrays: Any, k: Any, shape: Any, kind: Any) -> Any:
        addresses = numba.carray(_pointer(arrays), (k + 1,), np.intp)
        return numba.carray(_pointer(addresses[k]), shape, kind)

    return array_from


@intrinsic  # type: ignore[untyped-decorator]
def _pointer(context: Any, address: Any) -> Any:
    """Return the pointer with an integer's value."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.inttoptr(values[0], cgutils.voidptr_t)

    return types.voidptr(types.intp), code


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
        """Replace numba's conversion, and print one line to stderr at the first compilation."""
        _replace_conversion()
        module = event.data["dispatcher"].py_func.__module__
        if module.startswith("mcaprl.") and not _Announcer.is_silent:
            _Announcer.is_silent = True
            # Commands compile what they need, so a later one may compile another part.
            part = module.removeprefix("mcaprl.").removeprefix("sims.")
            print(f"compiling {part} for this machine, {self.lasts}", file=sys.stderr)

    def on_end(self, event: Any) -> None:
        """Do nothing."""


@cache
def _replace_conversion() -> None:
    """Replace numba's conversion of a returned NamedTuple to an object, for our own ones."""
    # It runs Python code without checks for errors: a KeyboardInterrupt there crashes the process.
    # The conversions are loaded only to compile, because the import takes time.
    from numba.core import boxing

    def box(kind: Any, value: Any, context: Any) -> Any:
        if kind.instance_class.__module__.startswith("mcaprl."):
            return _box_named_tuple(kind, value, context)
        return boxing.box_namedtuple(kind, value, context)

    # numba has no public function that replaces a conversion.
    for kind in (NamedTuple, NamedUniTuple):
        pythonapi._boxers.functions[kind] = box


def _box_named_tuple(kind: Any, value: Any, context: Any) -> Any:
    """Return code (an LLVM value) that makes a NamedTuple an object and runs no Python code."""
    python, constants = context.pyapi, context.env_manager
    fields = python.tuple_new(kind.count)
    for i, field_kind in enumerate(kind):
        field = context.box(field_kind, context.builder.extract_value(value, i))
        python.tuple_setitem(fields, i, field)
    new, cls = (
        constants.read_const(constants.add_const(constant))
        for constant in (tuple.__new__, kind.instance_class)
    )
    result = python.call_function_objargs(new, (cls, fields))
    python.decref(fields)
    return result


event.register("numba:compile", _Announcer())
