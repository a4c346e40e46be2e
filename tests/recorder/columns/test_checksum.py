"""Each implementation of CRC-32 returns the same values as zlib."""

from __future__ import annotations

import importlib
import sys
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcaprl.recorder.columns import checksum


@given(st.binary(max_size=3000), st.integers(0, 2**32 - 1))
def test_equals_zlib(data: bytes, before: int) -> None:
    assert checksum.crc32(data) == zlib.crc32(data)
    assert checksum.crc32(memoryview(data), before) == zlib.crc32(data, before)


def test_known_value() -> None:
    assert checksum.crc32(b"123456789") == 0xCBF43926


def test_zlib_where_zlib_ng_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zlib_ng.zlib_ng", None)
    try:
        assert importlib.reload(checksum).crc32 is zlib.crc32
    finally:
        monkeypatch.undo()
        importlib.reload(checksum)
