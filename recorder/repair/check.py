"""Reads a log from end to end and tells everything that is wrong with it.

    the file     summary, CRC of all data                          (here)
    its chunks   CRCs, indexes against contents, what the summary tells of them  (chunk_check)
    the log      metadata against schema, episodes, steps in order, pictures     (episode_check)

Each chunk is decompressed once.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import cycle, islice
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from mcap.writer import MCAP0_MAGIC

from mcaprl.errors import CorruptLogError, LogError, SpaceError
from mcaprl.recorder.format.reading import (
    RECORD_HEADER_BYTES,
    Contradiction,
    McapReader,
    Scratch,
    check_chunk,
    check_statistics,
    crc32,
    is_intact_attachment,
    place,
)
from mcaprl.recorder.repair.episode_check import EpisodeCheck


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


def check_log(path: str | Path, *, threads: int = 1) -> list[Problem]:
    """Check one log: structure, CRCs, indexes against contents, episodes, metadata.

    Args:
        path: of the file.
        threads: that decompress chunks at a time.

    Returns:
        What is wrong with it, in the order of the file; empty if nothing is.
    """
    path = Path(path)
    try:
        reader = McapReader(path)
    except LogError as error:
        is_damaged = isinstance(error, CorruptLogError)
        what_next = _recover(path) if is_damaged else "restore it from a copy"
        return [Problem(str(path), _without_path(error, path), "opening the file", what_next)]
    found = [*_check_file(reader)]
    try:
        found += _check_contents(reader, whole=not found, threads=threads)
    except (LogError, SpaceError) as error:
        found.append(Contradiction(_without_path(error, path), "/rl/step"))
    return [Problem(str(path), told.what, told.where, _recover(path)) for told in found]


def _check_contents(reader: McapReader, *, whole: bool, threads: int) -> list[Contradiction]:
    """Check each chunk, and what the log says across chunks."""
    found: list[Contradiction] = []
    log = EpisodeCheck(reader) if whole else None
    for chunk, read in _decompressed(reader, threads):
        try:
            records = read()
            found += check_chunk(reader, chunk, records)
        except CorruptLogError as error:
            found.append(Contradiction(_without_path(error, reader.path), place(reader, chunk)))
            continue
        if log is not None and not found:
            log.take(chunk, records)
    if log is not None and not found:
        found += [*check_statistics(reader), *log.finish()]
    return found


def _decompressed(
    reader: McapReader, threads: int
) -> Iterator[tuple[ChunkIndex, Callable[[], memoryview]]]:
    """Yield chunks with functions that return their records, valid until the next chunk."""
    if threads == 1:
        scratch = Scratch()
        for chunk in reader.chunks:
            yield chunk, partial(reader.chunk_records, chunk, scratch)
        return
    chunks = iter(reader.chunks)
    with ThreadPoolExecutor(threads) as pool:
        ahead = deque[tuple[ChunkIndex, Future[memoryview]]]()
        # One for each thread and one for the caller: memory does not grow with the file.
        scratches = cycle([Scratch() for _ in range(threads + 1)])
        while True:
            for chunk in islice(chunks, threads + 1 - len(ahead)):
                ahead.append((chunk, pool.submit(reader.chunk_records, chunk, next(scratches))))
            if not ahead:
                return
            chunk, future = ahead.popleft()
            yield chunk, future.result


def _check_file(reader: McapReader) -> list[Contradiction]:
    """The summary's presence, the CRC of all data, and those of attachments."""
    found = []
    if not reader.complete:
        found.append(
            Contradiction(
                "the file has no summary: its writer was killed or is still at work",
                f"after byte {reader.data_end}",
            )
        )
    end = None
    for offset, opcode, content in reader.records(len(MCAP0_MAGIC)):
        if opcode == Opcode.ATTACHMENT and not is_intact_attachment(content):
            found.append(Contradiction("an attachment does not match its CRC", f"byte {offset}"))
        if opcode == Opcode.DATA_END:
            end = offset
            found += _check_data_end(reader, offset, content)
            break
    if reader.complete and end is None:
        where = "the records between header and summary"
        found.append(Contradiction("the data section has no end", where))
    return found


def _check_data_end(reader: McapReader, offset: int, content: memoryview) -> list[Contradiction]:
    if len(content) != 4 or (
        reader.summary_start and offset + RECORD_HEADER_BYTES + 4 != reader.summary_start
    ):
        return [Contradiction("the data section's end is damaged", f"byte {offset}")]
    (crc,) = struct.unpack("<I", content)
    if crc and crc32(reader.view[:offset]) != crc:
        where = f"bytes 0 to {offset}"
        return [Contradiction("the data section does not match its CRC", where)]
    return []


def _recover(path: Path) -> str:
    return f"run `mcaprl recover {path} OUT`"


def _without_path(error: Exception, path: str | Path) -> str:
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path} ")
