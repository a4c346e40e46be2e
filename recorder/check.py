"""Reads a log from end to end and tells everything that is wrong with it."""

from __future__ import annotations

import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, DataEnd
from mcap.writer import MCAP0_MAGIC

from mcaprl.errors import CorruptLogError, LogError, SpaceError
from mcaprl.recorder.chunks import MESSAGE_HEADER, RECORD_HEADER_BYTES, chunk_records, message_index
from mcaprl.recorder.log_reader import LogReader
from mcaprl.recorder.mcap_reader import McapReader
from mcaprl.recorder.mcap_records import parse_record
from mcaprl.recorder.rows import add_up

_REWRITE = "read what is left with mcaprl.open and save it anew"


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong.

    Attributes:
        file: where.
        what: is wrong.
        where: in the file: a byte, a topic, an episode.
        next: what to do about it.
    """

    file: str
    what: str
    where: str
    next: str

    def __str__(self) -> str:
        """One line."""
        return f"{self.file}: {self.what} ({self.where}); {self.next}"


def check_log(path: str | Path) -> list[Problem]:
    """Check one log: structure, CRCs, indexes against contents, episodes, metadata.

    Args:
        path: of the file.

    Returns:
        What is wrong with it, in the order of the file; empty if nothing is.
    """
    found: list[Problem] = []

    def report(what: str, where: str, next_: str = _REWRITE) -> None:
        found.append(Problem(str(path), what, where, next_))

    try:
        reader = McapReader(path)
    except LogError as error:
        report(_without_path(error, path), "opening the file", "restore it from a copy")
        return found
    if not reader.complete:
        report(
            "the file has no summary: its writer was killed or is still at work",
            f"after byte {reader.data_end}",
            "finished episodes can be read; save them anew to get a whole file",
        )
    _check_data_crc(reader, report)
    for chunk in reader.chunks:
        _check_chunk(reader, chunk, report)
    if not found:
        _check_contents(reader.path, report)
    return found


Report = Callable[..., None]


def _check_data_crc(reader: McapReader, report: Report) -> None:
    """The data section's own CRC, which covers what stands outside the chunks as well."""
    for offset, opcode, content in reader.records(len(MCAP0_MAGIC)):
        if opcode == Opcode.DATA_END:
            try:
                end: DataEnd = parse_record(opcode, content)
            except CorruptLogError as error:
                report(str(error), f"byte {offset}")
                return
            crc = end.data_section_crc
            if crc and zlib.crc32(reader.view[:offset]) != crc:
                report("the data section does not match its CRC", f"bytes 0 to {offset}")
            if (
                reader.complete
                and offset + RECORD_HEADER_BYTES + len(content) != reader.summary_start
            ):
                report("the data section's end is damaged", f"byte {offset}")
            return
    if reader.complete:
        report("the data section has no end", "the records between header and summary")


def _check_chunk(reader: McapReader, chunk: ChunkIndex, report: Report) -> None:
    """One chunk's CRC, and its message indexes against its messages."""
    offset = chunk.chunk_start_offset
    try:
        records = chunk_records(reader.view, offset)
        times, offsets, channels = _messages_in(records)
        for channel_id, index_offset in chunk.message_index_offsets.items():
            index = message_index(reader.view, index_offset, channel_id)
            mine = channels == channel_id
            order = np.argsort(index["offset"], kind="stable")
            told = index[order]
            if not (
                np.array_equal(told["offset"], offsets[mine])
                and np.array_equal(told["log_time"], times[mine])
            ):
                known = reader.channels.get(channel_id)
                topic = known.topic if known else f"channel {channel_id}"
                report(f"the message index of {topic} is wrong", f"chunk at byte {offset}")
        unindexed = set(np.unique(channels).tolist()) - set(chunk.message_index_offsets)
        for channel_id in unindexed:
            report(f"channel {channel_id} is not in the message index", f"chunk at byte {offset}")
    except CorruptLogError as error:
        report(_without_path(error, reader.path), f"chunk at byte {offset}")


def _messages_in(records: memoryview) -> tuple[Any, Any, Any]:
    """Times, offsets and channels of a chunk's messages, in their order."""
    times, offsets, channels = [], [], []
    offset, header = 0, MESSAGE_HEADER.itemsize
    while offset < len(records):
        end = offset + RECORD_HEADER_BYTES
        if end > len(records):
            raise CorruptLogError("a record is cut off")
        opcode, length = records[offset], int.from_bytes(records[offset + 1 : end], "little")
        if end + length > len(records):
            raise CorruptLogError("a record reaches beyond its chunk")
        if opcode == Opcode.MESSAGE:
            if RECORD_HEADER_BYTES + length < header:
                raise CorruptLogError("a message is shorter than its header")
            message = np.frombuffer(records, MESSAGE_HEADER, 1, offset)[0]
            times.append(message["log_time"])
            channels.append(message["channel_id"])
            offsets.append(offset)
        offset = end + length
    return np.array(times, np.uint64), np.array(offsets, np.uint64), np.array(channels, np.uint16)


def _check_contents(path: Path, report: Report) -> None:
    """Metadata, episodes and their order: what reading the dataset verifies."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            dataset = LogReader(path).read()
    except (LogError, SpaceError) as error:
        report(_without_path(error, path), "/rl/step", "record it again, or open another file")
        return
    for episode in dataset.episodes:
        total = add_up(episode.rewards)
        if total != episode.total_reward and not np.isnan(total):
            report(
                f"/rl/episode tells a return of {episode.total_reward}, its rewards give {total}",
                f"episode {episode.index}",
            )


def _without_path(error: Exception, path: str | Path) -> str:
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path} ")
