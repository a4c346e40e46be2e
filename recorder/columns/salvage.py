"""Search for valid records in a damaged MCAP file.

MCAP has no synchronization marks. After a damaged record, the next one is searched for: where the
damaged length ends, if there is a valid record; else byte by byte for a while; else by the form of
a chunk, in which two lengths must agree. A valid record has exactly the bytes that a writer would
have written; the contents of a chunk are checked by their CRC when it is opened.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns.checksum import crc32
from mcaprl.recorder.columns.message_rows import INDEX_ENTRY, MESSAGE_HEADER, RECORD_HEADER_BYTES
from mcaprl.recorder.columns.records import RECORD_HEADER, parse_record, records_of

SoundRecord = tuple[int, int, memoryview]
"""Offset, opcode and content."""

# Records with data of their own; all others can be derived from these.
_REWRITTEN = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT)
_SEARCHED = (*_REWRITTEN, Opcode.CHUNK, Opcode.MESSAGE_INDEX)
_CHUNK_NAME = struct.Struct("<QQQII")
_KNOWN = frozenset(int(opcode) for opcode in Opcode)
# Distance within which every byte is tried; after it, only chunks are searched for.
_NEAR_BYTES = 2**16
_BLOCK_BYTES = 2**22


@dataclass(frozen=True)
class Damage:
    """Part of a file that cannot be read.

    Attributes:
        offset: First byte.
        bytes: Number of bytes.
        what: Description.
    """

    offset: int
    bytes: int
    what: str

    def __str__(self) -> str:
        """Return one phrase."""
        return f"{self.what} at byte {self.offset} ({self.bytes} bytes)"


def sound_records(view: memoryview, damages: list[Damage]) -> Iterator[SoundRecord]:
    """Yield offset, opcode and content of each valid record of the data section.

    Args:
        view: Bytes of the file.
        damages: List to which the parts between valid records are added.
    """
    offset = len(MCAP0_MAGIC)
    if bytes(view[:offset]) != MCAP0_MAGIC:
        damages.append(Damage(0, min(offset, len(view)), "no magic"))
    while offset < len(view):
        content = _sound_record(view, offset)
        if content is None:
            following = _next_record(view, offset)
            what = "the rest of the file is cut off or damaged"
            if following < len(view):
                what = "a damaged record"
            damages.append(Damage(offset, following - offset, what))
            offset = following
            continue
        opcode = view[offset]
        if opcode == Opcode.DATA_END:
            if _ends_data(view, offset, content):
                return
            damages.append(Damage(offset, 0, "the data does not match the CRC of all"))
        yield offset, opcode, content
        offset += RECORD_HEADER_BYTES + len(content)
        # Only at the end: a copy of the rest at each record would take quadratic time.
        if len(view) - offset == len(MCAP0_MAGIC) and bytes(view[offset:]) == MCAP0_MAGIC:
            return


def _ends_data(view: memoryview, offset: int, content: memoryview) -> bool:
    """Return whether a DataEnd record ends the data section, so that all before it is undamaged.

    One without a CRC does so if no chunk follows.
    """
    (crc,) = struct.unpack("<I", content)
    if crc:
        return bool(crc32(view[:offset]) == crc)
    return _next_chunk(view, offset, len(view)) == len(view)


def _sound_record(view: memoryview, offset: int) -> memoryview | None:
    """Return the content of the record at `offset`; None if it is not valid."""
    if offset + RECORD_HEADER_BYTES > len(view):
        return None
    opcode, length = RECORD_HEADER.unpack_from(view, offset)
    start = offset + RECORD_HEADER_BYTES
    # Opcodes from 0x80 on are for private use.
    if (opcode not in _KNOWN and opcode < 0x80) or length > len(view) - start:
        return None
    content = view[start : start + length]
    return content if _is_sound(opcode, content) else None


def _is_sound(opcode: int, content: memoryview) -> bool:
    match opcode:
        case Opcode.CHUNK:
            return _is_chunk(content)
        case Opcode.MESSAGE_INDEX:
            if len(content) < 6:
                return False
            (entries,) = struct.unpack_from("<I", content, 2)
            return len(content) == 6 + int(entries) and entries % INDEX_ENTRY.itemsize == 0
        case Opcode.MESSAGE:
            return len(content) >= MESSAGE_HEADER.itemsize - RECORD_HEADER_BYTES
        case Opcode.DATA_END:
            return len(content) == 4
        case Opcode.FOOTER:
            return len(content) == 20
        case _ if opcode == Opcode.HEADER or opcode in _REWRITTEN:
            return _repeats(opcode, content)
    return True


def _repeats(opcode: int, content: memoryview) -> bool:
    """Return whether a record is unchanged when it is parsed and serialized."""
    try:
        builder = RecordBuilder()
        parse_record(opcode, content).write(builder)
    except (CorruptLogError, struct.error):
        return False
    again, found = bytes(builder.end()[RECORD_HEADER_BYTES:]), bytes(content)
    # An attachment may have no CRC.
    without_crc = opcode == Opcode.ATTACHMENT and found[-4:] == bytes(4)
    return again == found or (without_crc and again[:-4] == found[:-4])


def _is_chunk(content: memoryview) -> bool:
    try:
        *_, name_bytes = _CHUNK_NAME.unpack_from(content)
        (data_bytes,) = struct.unpack_from("<Q", content, _CHUNK_NAME.size + name_bytes)
    except struct.error:
        return False
    return bool(len(content) == _CHUNK_NAME.size + name_bytes + 8 + data_bytes)


def _next_record(view: memoryview, damaged: int) -> int:
    """Return the next valid record after a damaged one; the end of the file if there is none."""
    if damaged + RECORD_HEADER_BYTES <= len(view):
        _, length = RECORD_HEADER.unpack_from(view, damaged)
        after = int(damaged + RECORD_HEADER_BYTES + length)
        leads_on = after < len(view) and view[after] in _KNOWN and _sound_record(view, after)
        # A wrong length may lead into a later chunk, past undamaged ones.
        if leads_on and _next_chunk(view, damaged + 1, after) == after:
            return after
    near = min(damaged + _NEAR_BYTES, len(view))
    for offset in range(damaged + 1, near):
        if view[offset] in _SEARCHED and _sound_record(view, offset) is not None:
            return offset
    return _next_chunk(view, near, len(view))


def _next_chunk(view: memoryview, start: int, stop: int) -> int:
    """Return the first valid chunk between `start` and `stop`; `stop` if there is none."""
    bytes_ = np.frombuffer(view, np.uint8)
    for block in range(start, stop, _BLOCK_BYTES):
        for offset in _may_be_chunks(bytes_, block, min(block + _BLOCK_BYTES, stop)):
            if _sound_record(view, offset) is not None:
                return offset
    return stop


def _may_be_chunks(bytes_: NDArray[Any], start: int, stop: int) -> list[int]:
    """Return the offsets of a chunk's opcode with a length below 2**40."""
    found = start + np.flatnonzero(bytes_[start:stop] == int(Opcode.CHUNK))
    found = found[found + RECORD_HEADER_BYTES <= len(bytes_)]
    for high in (6, 7, 8):
        found = found[bytes_[found + high] == 0]
    chosen: list[int] = found.tolist()
    return chosen


def intact_summary(view: memoryview) -> list[Any]:
    """Return the schemas and channels of a summary that matches its CRC; else nothing."""
    end = len(view) - len(MCAP0_MAGIC)
    start = end - RECORD_HEADER_BYTES - 20
    if start < len(MCAP0_MAGIC) or bytes(view[end:]) != MCAP0_MAGIC:
        return []
    if RECORD_HEADER.unpack_from(view, start) != (Opcode.FOOTER, 20):
        return []
    summary_start, _, crc = struct.unpack_from("<QQI", view, start + RECORD_HEADER_BYTES)
    if not len(MCAP0_MAGIC) <= summary_start <= start:
        return []
    if not crc or crc32(view[summary_start : end - 4]) != crc:
        return []
    return [
        parse_record(opcode, content)
        for _, opcode, content in records_of(view, summary_start, start)
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL)
    ]
