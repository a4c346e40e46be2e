"""Nested data with NumPy arrays as compressed bytes that a browser can read.

The bytes are compressed by gzip and contain: the length of the header (uint32, little-endian), the
header as JSON, padding to a multiple of 8 bytes, and the arrays. In the header, an array is an
object with its `dtype`, its `shape` and its offset `at` in bytes; each array starts at a multiple
of 8 bytes.
"""

from __future__ import annotations

import gzip
import json
from typing import Any

import numpy as np

from mcaprl.texts import encodable

_ALIGNMENT = 8


def pack(value: Any) -> bytes:
    """Pack nested dicts and lists of texts, finite numbers and arrays.

    Arrays may have the types uint8, int32, float32 and float64.
    """
    arrays = bytearray()
    header = json.dumps(_without_arrays(value, arrays), allow_nan=False).encode()
    head = len(header).to_bytes(4, "little") + header
    # Level 6 of gzip takes a third of the time of the default level 9.
    return gzip.compress(_padded(head) + arrays, 6, mtime=0)


def _without_arrays(value: Any, arrays: bytearray) -> Any:
    """Append the arrays of a value to `arrays`.

    Return the value with descriptions in their place.
    """
    if isinstance(value, np.ndarray):
        described = {"dtype": value.dtype.name, "shape": value.shape, "at": len(arrays)}
        arrays += _padded(value.astype(value.dtype.newbyteorder("<")).tobytes())
        return described
    if isinstance(value, dict):
        return {key: _without_arrays(part, arrays) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_without_arrays(part, arrays) for part in value]
    return encodable(value) if isinstance(value, str) else value


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % _ALIGNMENT)
