"""Tests of the binding of arrays to compiled functions."""

from __future__ import annotations

import gc
from typing import Any

import numpy as np

from mcaprl.compiled import Arrays, array_at, compiled, ready_at


@compiled
def scale(arrays: Arrays, factor: float, row: int) -> float:
    """Multiply a row of array 0 by a factor, count in array 1, and return the row's sum."""
    rows = array_at(arrays, 0, (2, 3), np.float64)
    array_at(arrays, 1, (1,), np.int32)[0] += 1
    rows[row] *= factor
    return float(rows[row].sum())


def test_bound_arrays_are_read_and_written() -> None:
    rows, calls = np.arange(6.0).reshape(2, 3), np.zeros(1, dtype=np.int32)
    bound = ready_at(scale, (rows, calls), 10.0, examples=(0,))
    assert bound(1) == 120.0
    assert rows.tolist() == [[0.0, 1.0, 2.0], [30.0, 40.0, 50.0]]
    rows[0] = 1.0
    assert bound(0) == 30.0
    assert calls[0] == 2


def test_bound_arrays_live_as_long_as_the_function() -> None:
    def bind() -> Any:
        return ready_at(
            scale, (np.full((2, 3), 7.0), np.zeros(1, dtype=np.int32)), 1.0, examples=(0,)
        )

    functions = [bind() for _ in range(50)]
    gc.collect()
    # New arrays would reuse the memory of arrays that were freed.
    others = [np.zeros((2, 3)) for _ in range(1000)]
    assert [function(1) for function in functions] == [21.0] * 50
    assert not any(other.any() for other in others)


def test_functions_that_are_not_compiled_get_the_arrays() -> None:
    def first(arrays: Arrays, factor: float) -> float:
        return factor * float(array_at(arrays, 0, (1,), np.float64)[0])

    assert ready_at(first, (np.array([4.0]),), 2.0)() == 8.0
