"""CRC-32 of data that is read or written.

zlib-ng is 3 to 15 times as fast as zlib: 3 times for data in memory, 15 times for data in the cache.
`pip install 'mcaprl[fast]'` installs it.
"""

from __future__ import annotations

try:
    from zlib_ng.zlib_ng import crc32
except ImportError:
    from zlib import crc32

__all__ = ["crc32"]
