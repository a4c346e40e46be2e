"""Reading MCAP files: what the rooms above `format` use of `columns`."""

from __future__ import annotations

from mcaprl.recorder.columns.checksum import crc32
from mcaprl.recorder.columns.chunk_check import (
    Contradiction,
    check_chunk,
    check_statistics,
    place,
)
from mcaprl.recorder.columns.chunks import Scratch, chunk_header, chunk_records
from mcaprl.recorder.columns.decoder import Columns, Decoder
from mcaprl.recorder.columns.message_rows import MESSAGE_HEADER, RECORD_HEADER_BYTES, MessageRange
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import (
    contents_of,
    is_intact_attachment,
    map_file,
    only,
    parse_record,
)
from mcaprl.recorder.columns.salvage import Damage, SoundRecord, intact_summary, sound_records
from mcaprl.recorder.columns.topic import LOG_TIME, Topic

__all__ = [
    "LOG_TIME",
    "MESSAGE_HEADER",
    "RECORD_HEADER_BYTES",
    "Columns",
    "Contradiction",
    "Damage",
    "Decoder",
    "McapReader",
    "MessageRange",
    "Scratch",
    "SoundRecord",
    "Topic",
    "check_chunk",
    "check_statistics",
    "chunk_header",
    "chunk_records",
    "contents_of",
    "crc32",
    "intact_summary",
    "is_intact_attachment",
    "map_file",
    "only",
    "parse_record",
    "place",
    "sound_records",
]
