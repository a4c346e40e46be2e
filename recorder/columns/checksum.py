"""CRC-32 of data that is read or written.

ISA-L is eight times as fast as zlib; `pip install 'mcaprl[fast]'` installs it.
"""

from __future__ import annotations

try:
    from isal.isal_zlib import crc32
except ImportError:
    from zlib import crc32

__all__ = ["crc32"]
