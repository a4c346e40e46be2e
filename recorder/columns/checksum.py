"""CRC-32 of all data that are read and written.

ISA-L takes an eighth of the time of zlib; `pip install 'mcaprl[fast]'` installs it.
"""

from __future__ import annotations

try:
    from isal.isal_zlib import crc32
except ImportError:
    from zlib import crc32

__all__ = ["crc32"]
