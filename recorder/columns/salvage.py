"""Finds what is sound in a damaged MCAP file: records that are what their lengths say.

MCAP has no marks to begin again at. Where a record is damaged, the one behind it is looked for: by
the damaged one's length if that leads to a sound record, else byte by byte for a while, else by the
form of a chunk, in which two lengths must agree. A record that passes is exactly as its writer
would have written it; whether a chunk's contents are whole, its CRC tells whoever opens it.
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

ValidRecord = tuple[int, int, memoryview]
"""Offset, opcode and content."""

# Records that carry something; what the rest say can be found out again.
_REWRITTEN = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT)
_SEARCHED = (*_REWRITTEN, Opcode.CHUNK, Opcode.MESSAGE_INDEX)
_CHUNK_NAME = struct.Struct("<QQQII")
_KNOWN = frozenset(int(opcode) for opcode in Opcode)
# So far every byte is tried; a search for chunks goes on from there.
_NEAR_BYTES = 2**16
_BLOCK_BYTES = 2**22


@dataclass(frozen=True)
class Damage:
    """A place in a file that cannot be read.

    Attributes:
        offset: of its first byte.
        bytes: how many.
        what: is wrong there.
    """

    offset: int
    bytes: int
    what: str


def valid_records(view: memoryview, damages: list[Damage]) -> Iterator[ValidRecord]:
    """Yield offset, opcode and content of each sound record of the data section.

    Args:
        view: the file.
        damages: what is between them is added here.
    """
    offset = len(MCAP0_MAGIC)
    if bytes(view[:offset]) != MCAP0_MAGIC:
        damages.append(Damage(0, min(offset, len(view)), "no magic"))
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
            damages.append(Damage(offset, 0, "the data does not match the CRC of all"))
        yield offset, opcode, content
        offset += RECORD_HEADER_BYTES + len(content)
        # Not before the end: a copy of the rest at each record would make this quadratic.
        if len(view) - offset == len(MCAP0_MAGIC) and bytes(view[offset:]) == MCAP0_MAGIC:
            return


def _ends_data(view: memoryview, offset: int, content: memoryview) -> bool:
    """Whether a DataEnd record is the data's end: all in front of it is, then, as it was written.

    Without a CRC it is believed if only a summary can follow.
    """
    (crc,) = struct.unpack("<I", content)
    if crc:
        return bool(crc32(view[:offset]) == crc)
    return _next_chunk(view, offset, len(view)) == len(view)


def _valid_record(view: memoryview, offset: int) -> memoryview | None:
    """The content of the record at `offset`, if it is as a writer would have written it."""
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
    """Whether a record that is read and written again is the same."""
    try:
        builder = RecordBuilder()
        parse_record(opcode, content).write(builder)
    except (CorruptLogError, struct.error):
        return False
    again, told = bytes(builder.end()[RECORD_HEADER_BYTES:]), bytes(content)
    # The CRC of an attachment may have been left out.
    without_crc = opcode == Opcode.ATTACHMENT and told[-4:] == bytes(4)
    return again == told or (without_crc and again[:-4] == told[:-4])


def _is_chunk(content: memoryview) -> bool:
    try:
        *_, name_bytes = _CHUNK_NAME.unpack_from(content)
        (data_bytes,) = struct.unpack_from("<Q", content, _CHUNK_NAME.size + name_bytes)
    except struct.error:
        return False
    return bool(len(content) == _CHUNK_NAME.size + name_bytes + 8 + data_bytes)


def _next_record(view: memoryview, damaged: int) -> int:
    """Where the next sound record is behind a damaged one; the file's end if there is none."""
    if damaged + RECORD_HEADER_BYTES <= len(view):
        _, length = RECORD_HEADER.unpack_from(view, damaged)
        behind = int(damaged + RECORD_HEADER_BYTES + length)
        leads_on = behind < len(view) and view[behind] in _KNOWN and _valid_record(view, behind)
        # A wrong length may lead to a message within another chunk, past whole ones.
        if leads_on and _next_chunk(view, damaged + 1, behind) == behind:
            return behind
    near = min(damaged + _NEAR_BYTES, len(view))
    for offset in range(damaged + 1, near):
        if view[offset] in _SEARCHED and _valid_record(view, offset) is not None:
            return offset
    return _next_chunk(view, near, len(view))


def _next_chunk(view: memoryview, start: int, stop: int) -> int:
    """Where the first sound chunk begins from `start` on; `stop` if there is none before it."""
    bytes_ = np.frombuffer(view, np.uint8)
    for block in range(start, stop, _BLOCK_BYTES):
        for offset in _may_be_chunks(bytes_, block, min(block + _BLOCK_BYTES, stop)):
            if _valid_record(view, offset) is not None:
                return offset
    return stop


def _may_be_chunks(bytes_: NDArray[Any], start: int, stop: int) -> list[int]:
    """Places with a chunk's opcode and a length below 2**40."""
    found = start + np.flatnonzero(bytes_[start:stop] == int(Opcode.CHUNK))
    found = found[found + RECORD_HEADER_BYTES <= len(bytes_)]
    for high in (6, 7, 8):
        found = found[bytes_[found + high] == 0]
    chosen: list[int] = found.tolist()
    return chosen


def intact_summary(view: memoryview) -> list[Any]:
    """Schemas and channels from the summary, if that is there and matches its CRC."""
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
