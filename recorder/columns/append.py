"""Takes up a finished MCAP file where its writer left it, so that more can be written behind it."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from mcaprl.errors import CorruptLogError, LogError
from mcaprl.recorder.columns.checksum import crc32
from mcaprl.recorder.columns.message_rows import RECORD_HEADER_BYTES
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import parse_record
from mcaprl.recorder.columns.summary import Summary

Standing = Metadata | Schema | Channel | Attachment
"""Records that stand outside of chunks."""
_DATA_END = struct.Struct("<BQI")


@dataclass
class Written:
    """What a writer knows when it has written a file.

    Attributes:
        summary: of what is in the file.
        end: of its data, where more can be written.
        crc: CRC-32 of the data.
        standing: the records outside of chunks.
    """

    summary: Summary
    end: int
    crc: int
    standing: list[Standing] = field(default_factory=list)


def what_is_written(path: Path) -> Written:
    """Read what the writer of a file knew when it finished it.

    Raises:
        LogError: the file is damaged or not finished, or others wrote it in ways of their own.
    """
    try:
        reader = McapReader(path)
        end = reader.summary_start - _DATA_END.size
        if end <= 0 or _DATA_END.unpack_from(reader.view, end)[:2] != (Opcode.DATA_END, 4):
            raise CorruptLogError("its writer did not finish it")
        (_, _, crc) = _DATA_END.unpack_from(reader.view, end)
        written = Written(Summary(chunks=list(reader.chunks)), end, crc or crc32(reader.view[:end]))
        _take_topics(reader, written)
        _take_other_records(reader, written)
    except CorruptLogError as error:
        what = str(error).removeprefix(f"{path}: ")
        raise LogError(
            f"{path} cannot be appended to, since {what}: run `mcaprl recover {path} OUT` and"
            " append to OUT"
        ) from error
    return written


def _take_topics(reader: McapReader, written: Written) -> None:
    topics: list[Standing] = [*reader.schemas.values(), *reader.channels.values()]
    for topic in topics:
        written.summary.note(topic, 0, 0)
        written.standing.append(topic)
    for channel in reader.channels.values():
        spans = reader.spans(channel)
        if any(span.chunk is None for span in spans):
            raise CorruptLogError(f"{channel.topic} has messages outside of chunks")
        written.summary.counts[channel.id] = sum(len(span) for span in spans)


def _take_other_records(reader: McapReader, written: Written) -> None:
    for offset, opcode, content in reader.records(len(MCAP0_MAGIC)):
        if opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
            record: Standing = parse_record(opcode, content)
            written.summary.note(record, offset, RECORD_HEADER_BYTES + len(content))
            written.standing.append(record)
        elif opcode == Opcode.DATA_END:
            return
