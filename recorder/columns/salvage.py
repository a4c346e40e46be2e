"""Search for the valid records of a damaged MCAP file.

MCAP has no synchronization markers. After a damaged record, the search first skips the length that
this record declares. If no valid record follows, the search tries each byte over a limited
distance. Then it looks only for chunks, whose record length and data length must agree. A record is
valid if its lengths agree and if serializing its parsed content reproduces its bytes. The CRC of a
chunk is checked only when the chunk is decompressed.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.columns.chunks import parse_chunk_index
from mcaprl.recorder.columns.message_rows import INDEX_ENTRY, MESSAGE_HEADER, RECORD_HEADER_BYTES
from mcaprl.recorder.columns.records import (
    MAGIC,
    RECORD_HEADER,
    crc32,
    footer_of,
    parse_record,
    records_of,
)

ValidRecord = tuple[int, int, memoryview]
"""Offset, opcode and content of a valid record."""

# Records with content that cannot be recomputed from other records.
_REWRITTEN = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT)
_SEARCHED = (*_REWRITTEN, Opcode.CHUNK, Opcode.MESSAGE_INDEX)
_CHUNK_NAME = struct.Struct("<QQQII")
_KNOWN = frozenset(int(opcode) for opcode in Opcode)
# The search tries every byte over this distance; beyond it, the search looks only for chunks.
_NEAR_BYTES = 2**16
_BLOCK_BYTES = 2**22


@dataclass(frozen=True)
class Damage:
    """Part of a file that cannot be read.

    Attributes:
        offset: Offset of the first byte.
        bytes: Number of bytes; 0 if the position of the damage is unknown.
        what: Description of the damage.
    """

    offset: int
    bytes: int
    what: str


def valid_records(view: memoryview, damages: list[Damage]) -> Iterator[ValidRecord]:
    """Yield the valid records of the data section; add each damaged range to `damages`."""
    offset = len(MAGIC)
    if bytes(view[:offset]) != MAGIC:
        damages.append(Damage(0, min(offset, len(view)), "no magic bytes"))
    while offset < len(view):
        content = _valid_record(view, offset)
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
            damages.append(Damage(offset, 0, "the data section does not match its CRC"))
        yield offset, opcode, content
        offset += RECORD_HEADER_BYTES + len(content)
        # Compare lengths first; otherwise, `bytes` would copy the rest of the file for each record.
        if len(view) - offset == len(MAGIC) and bytes(view[offset:]) == MAGIC:
            return


def _ends_data(view: memoryview, offset: int, content: memoryview) -> bool:
    """Return whether a DataEnd record is the end of the data section.

    The CRC in the record must match all data before the record. If the record has no CRC, no chunk
    may follow it.
    """
    (crc,) = struct.unpack("<I", content)
    if crc:
        return bool(crc32(view[:offset]) == crc)
    return _next_chunk(view, offset, len(view)) == len(view)


def _valid_record(view: memoryview, offset: int) -> memoryview | None:
    """Return the content of the record at `offset`; None if it is not valid."""
    if offset + RECORD_HEADER_BYTES > len(view):
        return None
    opcode, length = RECORD_HEADER.unpack_from(view, offset)
    start = offset + RECORD_HEADER_BYTES
    # Opcodes from 0x80 on are for private use.
    if (opcode not in _KNOWN and opcode < 0x80) or length > len(view) - start:
        return None
    content = view[start : start + length]
    return content if _is_valid(opcode, content) else None


def _is_valid(opcode: int, content: memoryview) -> bool:
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
    """Return whether parsing and serializing a record returns the same bytes."""
    try:
        builder = RecordBuilder()
        parse_record(opcode, content).write(builder)
    except (CorruptLogError, struct.error):
        return False
    again, original = bytes(builder.end()[RECORD_HEADER_BYTES:]), bytes(content)
    # Writers may omit the CRC of an attachment.
    without_crc = opcode == Opcode.ATTACHMENT and original[-4:] == bytes(4)
    return again == original or (without_crc and again[:-4] == original[:-4])


def _is_chunk(content: memoryview) -> bool:
    try:
        *_, name_bytes = _CHUNK_NAME.unpack_from(content)
        (data_bytes,) = struct.unpack_from("<Q", content, _CHUNK_NAME.size + name_bytes)
    except struct.error:
        return False
    return bool(len(content) == _CHUNK_NAME.size + name_bytes + 8 + data_bytes)


def _next_record(view: memoryview, damaged: int) -> int:
    """Return the offset of the next valid record after a damaged one, or the length of the file."""
    if damaged + RECORD_HEADER_BYTES <= len(view):
        _, length = RECORD_HEADER.unpack_from(view, damaged)
        following = int(damaged + RECORD_HEADER_BYTES + length)
        is_valid = (
            following < len(view) and view[following] in _KNOWN and _valid_record(view, following)
        )
        # A wrong length can point beyond valid chunks; check that none would be skipped.
        if is_valid and _next_chunk(view, damaged + 1, following) == following:
            return following
    near = min(damaged + _NEAR_BYTES, len(view))
    for offset in range(damaged + 1, near):
        if view[offset] in _SEARCHED and _valid_record(view, offset) is not None:
            return offset
    return _next_chunk(view, near, len(view))


def _next_chunk(view: memoryview, start: int, stop: int) -> int:
    """Return the offset of the first valid chunk from `start` on; `stop` if there is none."""
    bytes_ = np.frombuffer(view, np.uint8)
    for block in range(start, stop, _BLOCK_BYTES):
        part = bytes_[block : min(block + _BLOCK_BYTES, stop)]
        found = block + np.flatnonzero(part == int(Opcode.CHUNK))
        found = found[found + RECORD_HEADER_BYTES <= len(bytes_)]
        # The lengths of chunks are below 2**40, so their three high bytes are 0.
        for high in (6, 7, 8):
            found = found[bytes_[found + high] == 0]
        for offset in found.tolist():
            if _valid_record(view, offset) is not None:
                return int(offset)
    return stop


def intact_summary(view: memoryview) -> list[Any]:
    """Return schemas, channels and chunk indexes of the summary; [] if the summary is damaged."""
    try:
        footer = footer_of(view)
    except CorruptLogError:
        return []
    if footer is None or not footer.summary_start or not footer.summary_crc:
        return []
    return [
        parse_chunk_index(content)
        if opcode == Opcode.CHUNK_INDEX
        else parse_record(opcode, content)
        for _, opcode, content in records_of(view, footer.summary_start)
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK_INDEX)
    ]
