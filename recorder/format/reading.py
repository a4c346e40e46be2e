"""Names of the package `columns`, re-exported for packages that read MCAP files, and telemetry."""

from __future__ import annotations

from mcaprl.recorder.columns.cdr import ROS_TO_NUMPY
from mcaprl.recorder.columns.chunks import Scratch, chunk_header
from mcaprl.recorder.columns.definitions import (
    ROS1,
    UNREADABLE,
    Definitions,
    TypeSource,
    definitions_of,
    full_name,
    leaf_kinds,
    parsed_types,
)
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import MESSAGE_HEADER, MessageRange, prefetch, release
from mcaprl.recorder.columns.summary import check_chunk, check_file, check_statistics, place
from mcaprl.recorder.columns.topic import LOG_TIME, Columns, Decoder, Topic
from mcaprl.recorder.format.schema import TELEMETRY_TOPIC, TELEMETRY_TYPE

__all__ = [
    "LOG_TIME",
    "MESSAGE_HEADER",
    "ROS1",
    "ROS_TO_NUMPY",
    "UNREADABLE",
    "Columns",
    "Decoder",
    "Definitions",
    "McapReader",
    "MessageRange",
    "Scratch",
    "Topic",
    "TypeSource",
    "check_chunk",
    "check_file",
    "check_statistics",
    "chunk_header",
    "definitions_of",
    "full_name",
    "leaf_kinds",
    "parsed_types",
    "place",
    "prefetch",
    "release",
    "telemetry_names",
]


def telemetry_names(reader: McapReader) -> list[str]:
    """Return the fields of `/telemetry`; none if a robot has a topic of this name."""
    types = [reader.type_of(channel) for channel in reader.channels_of(TELEMETRY_TOPIC)]
    if not all(name.startswith(TELEMETRY_TYPE) for name in types):
        return []
    return [name for name in Topic(reader, TELEMETRY_TOPIC).fields if name != "encapsulation"]
