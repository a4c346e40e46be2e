"""Reading MCAP files: what the rooms above `format` use of `columns`."""

from __future__ import annotations

from mcaprl.recorder.columns.checksum import crc32
from mcaprl.recorder.columns.chunk_check import (
    Piece,
    check_piece,
    check_statistics,
    place,
)
from mcaprl.recorder.columns.chunks import Scratch, chunk_header, chunk_records
from mcaprl.recorder.columns.decoder import Columns, Decoder
from mcaprl.recorder.columns.joined import packed
from mcaprl.recorder.columns.message_rows import MESSAGE_HEADER, RECORD_HEADER_BYTES
from mcaprl.recorder.columns.message_spans import Span, joined_index
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import (
    contents_of,
    is_intact_attachment,
    map_file,
    only,
    parse_record,
)
from mcaprl.recorder.columns.salvage import Damage, ValidRecord, intact_summary, valid_records
from mcaprl.recorder.columns.topic import LOG_TIME, Topic

__all__ = [
    "LOG_TIME",
    "MESSAGE_HEADER",
    "RECORD_HEADER_BYTES",
    "Columns",
    "Damage",
    "Decoder",
    "McapReader",
    "Piece",
    "Scratch",
    "Span",
    "Topic",
    "ValidRecord",
    "check_piece",
    "check_statistics",
    "chunk_header",
    "chunk_records",
    "contents_of",
    "crc32",
    "intact_summary",
    "is_intact_attachment",
    "joined_index",
    "map_file",
    "only",
    "packed",
    "parse_record",
    "place",
    "valid_records",
]
