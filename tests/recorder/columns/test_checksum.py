"""Each implementation of CRC-32 returns the same values as zlib."""

from __future__ import annotations

import subprocess
import sys
import zlib

from hypothesis import given
from hypothesis import strategies as st

from mcaprl.recorder.columns import records


@given(st.binary(max_size=3000), st.integers(0, 2**32 - 1))
def test_equals_zlib(data: bytes, before: int) -> None:
    assert records.crc32(data) == zlib.crc32(data)
    assert records.crc32(memoryview(data), before) == zlib.crc32(data, before)


def test_known_value() -> None:
    assert records.crc32(b"123456789") == 0xCBF43926


def test_zlib_where_zlib_ng_is_missing() -> None:
    program = (
        "import sys, zlib; sys.modules['zlib_ng.zlib_ng'] = None;"
        "from mcaprl.recorder.columns.records import crc32; assert crc32 is zlib.crc32"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
