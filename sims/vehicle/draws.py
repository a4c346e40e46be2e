"""Random numbers for starting states, drawn by compiled code from NumPy's generators."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

from mcaprl.compiled import compiled


class _BitGenerator(ctypes.Structure):
    """State and functions of a generator, as declared in `numpy/random/bitgen.h`."""

    _fields_: ClassVar = [
        ("state", ctypes.c_void_p),
        ("next_uint64", ctypes.c_void_p),
        ("next_uint32", ctypes.c_void_p),
        ("next_double", ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_void_p)),
        ("next_raw", ctypes.c_void_p),
    ]


_STATE, _NEXT_DOUBLE = 0, 3
"""Indices of two fields. All fields are pointers."""
_capsule_pointer = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)


class Generators:
    """Generators of N vehicles, from which compiled code draws numbers.

    Compiled code draws the same numbers in a small part of the time of a call in Python.

    Attributes:
        addresses: (N,) addresses of the generators, for `draw`; 0 before `use`.
    """

    def __init__(self, count: int) -> None:
        """Prepare to draw from `count` generators."""
        self._generators: list[np.random.Generator | None] = [None] * count
        self._missing = count
        self.addresses = np.zeros(count, dtype=np.intp)

    def use(self, i: int, generator: np.random.Generator) -> None:
        """Assign a generator to vehicle i."""
        # The address is valid only as long as the generator exists.
        before = self._generators[i]
        if before is not generator:
            self._generators[i], self.addresses[i] = generator, _address_of(generator)
            self._missing -= before is None

    def complete(
        self, chosen: NDArray[np.int64], generators: Sequence[np.random.Generator]
    ) -> None:
        """Assign a generator to each of the chosen vehicles (K,) that has none.

        `generators` has one generator for each of the N vehicles.
        """
        if self._missing:
            for i in chosen.tolist():
                if self._generators[i] is None:
                    self.use(i, generators[i])

    def __getstate__(self) -> list[np.random.Generator | None]:
        """Return the generators for copying or pickling."""
        return self._generators

    def __setstate__(self, generators: list[np.random.Generator | None]) -> None:
        """Look up the addresses of the copied generators."""
        Generators.__init__(self, len(generators))
        for i, generator in enumerate(generators):
            if generator is not None:
                self.use(i, generator)


@compiled
def draw(address: int, shares: NDArray[np.float64]) -> None:
    """Fill an array with the next numbers of a generator, like `Generator.random`.

    Args:
        address: Element of `Generators.addresses`, not 0.
        shares: (K,) output: numbers of at least 0 and below 1.
    """
    for k in range(len(shares)):
        shares[k] = _next_double(address)


@compiled
def spread(share: float, most: float) -> float:
    """Map [0, 1] linearly to [-most, most]."""
    return (2.0 * share - 1.0) * most


def _address_of(generator: np.random.Generator) -> int:
    """Return the address of a generator's `_BitGenerator`."""
    return int(_capsule_pointer(generator.bit_generator.capsule, b"BitGenerator"))


def _next_double(address: int) -> float:
    """Return the next number of a generator."""
    one = _BitGenerator.from_address(int(address))
    return float(one.next_double(one.state))


@overload(_next_double, inline="always")  # type: ignore[untyped-decorator]
def _compiled_next_double(address: Any) -> Any:
    def next_double(address: Any) -> Any:
        return _call_next_double(address)

    return next_double


@intrinsic  # type: ignore[untyped-decorator]
def _call_next_double(context: Any, address: Any) -> Any:
    """Return code that calls `next_double` of the `_BitGenerator` at an address."""
    function = cgutils.ir.FunctionType(cgutils.ir.DoubleType(), [cgutils.voidptr_t])

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        fields = builder.inttoptr(values[0], cgutils.voidptr_t.as_pointer())
        state, next_double = (
            builder.load(cgutils.gep_inbounds(builder, fields, k)) for k in (_STATE, _NEXT_DOUBLE)
        )
        return builder.call(builder.bitcast(next_double, function.as_pointer()), [state])

    return types.float64(types.intp), code
