"""Memory in large pages is memory like any other."""

from __future__ import annotations

import copy
import mmap
import pickle
from typing import Any

import numpy as np
import pytest

from mcaprl.recorder.memory import empty

LARGE_PAGE = 2 * 2**20


@pytest.mark.parametrize("shape", [(0,), (3, 0), (5, 2), (300_000, 7), (2**20, 1, 2), (1_048_577,)])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.dtype("<i8"), np.dtype(">f8")])
def test_it_holds_what_is_written(shape: tuple[int, ...], dtype: Any) -> None:
    array = empty(shape, dtype)
    assert (array.shape, array.dtype) == (shape, np.dtype(dtype))
    assert array.flags.c_contiguous
    assert array.flags.writeable
    assert array.flags.aligned
    expected = (np.arange(array.size) % 251).reshape(shape)
    array[...] = expected
    assert np.array_equal(array, expected)
    for other in (copy.deepcopy(array), pickle.loads(pickle.dumps(array))):
        assert np.array_equal(other, expected)


@pytest.mark.skipif(not hasattr(mmap, "MADV_HUGEPAGE"), reason="this system has no such advice")
def test_long_columns_begin_with_a_page() -> None:
    assert empty((LARGE_PAGE,), np.uint8).ctypes.data % LARGE_PAGE == 0


def test_arrays_do_not_share_memory() -> None:
    first, second = empty((LARGE_PAGE,), np.uint8), empty((LARGE_PAGE,), np.uint8)
    first[:], second[:] = 1, 2
    assert (first == 1).all()


def test_a_system_without_large_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(mmap, "MADV_HUGEPAGE", raising=False)
    array = empty((LARGE_PAGE,), np.uint8)
    array[:] = 3
    assert (array == 3).all()


def test_a_kernel_that_knows_none(monkeypatch: pytest.MonkeyPatch) -> None:
    # No advice has this number.
    monkeypatch.setattr(mmap, "MADV_HUGEPAGE", 9999, raising=False)
    array = empty((LARGE_PAGE,), np.uint8)
    array[:] = 3
    assert (array == 3).all()
