"""CRC-32 of data that is read or written.

zlib-ng is at least three times as fast as zlib, and ten times for data in the processor's cache.
`pip install 'mcaprl[fast]'` installs it.
"""

from __future__ import annotations

try:
    from zlib_ng.zlib_ng import crc32
except ImportError:
    from zlib import crc32

__all__ = ["crc32"]
