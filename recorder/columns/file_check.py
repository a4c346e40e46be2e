"""Checks of an MCAP file as a whole: summary, end and CRC of the data section, attachments."""

from __future__ import annotations

import struct

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from mcaprl.problem import Problem
from mcaprl.recorder.columns.checksum import crc32
from mcaprl.recorder.columns.message_rows import RECORD_HEADER_BYTES
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import is_intact_attachment


def check_file(reader: McapReader) -> list[Problem]:
    """Check the presence of a summary and the CRCs of the data section and attachments."""
    found = []
    if not reader.complete:
        found.append(
            Problem(
                "the file has no summary: its writer was killed or is still running",
                f"after byte {reader.data_end}",
            )
        )
    end = None
    for offset, opcode, content in reader.records(len(MCAP0_MAGIC)):
        if opcode == Opcode.ATTACHMENT and not is_intact_attachment(content):
            found.append(Problem("an attachment does not match its CRC", f"byte {offset}"))
        if opcode == Opcode.DATA_END:
            end = offset
            found += _check_data_end(reader, offset, content)
            break
    if reader.complete and end is None:
        where = "the records between header and summary"
        found.append(Problem("the data section has no DataEnd record", where))
    return found


def _check_data_end(reader: McapReader, offset: int, content: memoryview) -> list[Problem]:
    if len(content) != 4 or (
        reader.summary_start and offset + RECORD_HEADER_BYTES + 4 != reader.summary_start
    ):
        return [Problem("the data section's end is damaged", f"byte {offset}")]
    (crc,) = struct.unpack("<I", content)
    if crc and crc32(reader.view[:offset]) != crc:
        where = f"bytes 0 to {offset}"
        return [Problem("the data section does not match its CRC", where)]
    return []
