"""CRC-32, which covers all that is read and written.

ISA-L's takes an eighth of the time of zlib's; it is there with `pip install 'mcaprl[fast]'`.
"""

from __future__ import annotations

try:
    from isal.isal_zlib import crc32
except ImportError:
    from zlib import crc32

__all__ = ["crc32"]
