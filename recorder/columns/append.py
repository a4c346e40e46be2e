"""State that a writer needs to append to a finished MCAP file."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema

from mcaprl.errors import CorruptLogError, LogError
from mcaprl.recorder.columns.checksum import crc32
from mcaprl.recorder.columns.message_rows import RECORD_HEADER_BYTES
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import MAGIC, is_intact_attachment, parse_record
from mcaprl.recorder.columns.summary import Summary

TopLevelRecord = Metadata | Schema | Channel | Attachment
"""Records that writers store outside of chunks."""
_DATA_END = struct.Struct("<BQI")


@dataclass
class WrittenState:
    """State in which a writer left a finished file.

    Attributes:
        summary: Summary of the file.
        end: First byte after the data, where a writer can append.
        crc: CRC-32 of the data.
        top_level: Top-level records in file order.
    """

    summary: Summary
    end: int
    crc: int
    top_level: list[TopLevelRecord]


def written_state(path: Path) -> WrittenState:
    """Open a finished file, and return the state that a writer needs to append to it.

    Raises:
        LogError: The file is damaged or not finished, or has messages outside of chunks.
    """
    try:
        return finished_state(McapReader(path))
    except CorruptLogError as error:
        what = str(error).removeprefix(f"{path}: ")
        raise LogError(
            f"{path} cannot be appended to: {what}; run `mcaprl recover {path} OUT` and"
            " append to OUT"
        ) from error


def finished_state(reader: McapReader) -> WrittenState:
    """Return the state of a finished file, from which a writer can append to it.

    Raises:
        CorruptLogError: The file is damaged or not finished, or has messages outside of chunks.
    """
    end = reader.summary_start - _DATA_END.size
    if end <= 0 or _DATA_END.unpack_from(reader.view, end)[:2] != (Opcode.DATA_END, 4):
        raise CorruptLogError("the file is not finished")
    (_, _, listed) = _DATA_END.unpack_from(reader.view, end)
    # Only this CRC covers metadata. A copy of damaged data would get valid CRCs.
    crc = crc32(reader.view[:end])
    if listed and crc != listed:
        raise CorruptLogError("the data section does not match its CRC")
    summary = Summary(chunks=list(reader.chunks))
    top_level: list[TopLevelRecord] = [*reader.schemas.values(), *reader.channels.values()]
    for topic in top_level:
        summary.add(topic, 0, 0)
    for channel in reader.channels.values():
        ranges = reader.message_ranges(channel)
        if any(messages.chunk is None for messages in ranges):
            raise CorruptLogError(f"{channel.topic} has messages outside of chunks")
        summary.counts[channel.id] = sum(map(len, ranges))
    for offset, opcode, content in reader.records(len(MAGIC)):
        if opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
            if opcode == Opcode.ATTACHMENT and not is_intact_attachment(content):
                raise CorruptLogError(f"the attachment at byte {offset} does not match its CRC")
            record: TopLevelRecord = parse_record(opcode, content)
            summary.add(record, offset, RECORD_HEADER_BYTES + len(content))
            top_level.append(record)
        elif opcode == Opcode.DATA_END:
            break
    return WrittenState(summary, end, crc, top_level)
