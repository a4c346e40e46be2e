"""Checks of a whole log.

    file      summary, CRC of the data section                         (this module)
    chunks    CRCs, message indexes, chunk indexes of the summary      (chunk_check)
    log       metadata, schema, episodes, order of steps, images       (episode_check)

Each chunk is decompressed once.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import cycle, islice
from pathlib import Path

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from mcaprl.errors import CorruptLogError, LogError, SpaceError
from mcaprl.problem import Problem
from mcaprl.recorder.format.reading import (
    RECORD_HEADER_BYTES,
    McapReader,
    Piece,
    Scratch,
    check_piece,
    check_statistics,
    crc32,
    is_intact_attachment,
    packed,
    place,
)
from mcaprl.recorder.format.topics import STEP_TOPIC
from mcaprl.recorder.repair.episode_check import EpisodeCheck


def check_log(path: str | Path, *, threads: int = 1) -> list[Problem]:
    """Check the structure, CRCs, indexes, episodes and metadata of one log.

    Args:
        path: Path of the log.
        threads: Number of threads that decompress chunks.

    Returns:
        Problems in the order of the file; empty if there are none.
    """
    path = Path(path)
    try:
        reader = McapReader(path)
    except LogError as error:
        action = _recover(path) if isinstance(error, CorruptLogError) else "restore it from a copy"
        what = _without_path(error, path)
        return [Problem(what, "opening the file", next=action, file=str(path))]
    found = [*_check_file(reader)]
    try:
        found += _check_contents(reader, whole=not found, threads=threads)
    except (LogError, SpaceError) as error:
        found.append(Problem(_without_path(error, path), STEP_TOPIC))
    return [replace(problem, next=_recover(path), file=str(path)) for problem in found]


def _check_contents(reader: McapReader, *, whole: bool, threads: int) -> list[Problem]:
    """Check each chunk, then the log if all of them are valid."""
    found: list[Problem] = []
    log = EpisodeCheck(reader) if whole else None
    for numbers, read in _decompressed(reader, threads):
        try:
            piece = read()
            found += check_piece(reader, piece)
        except CorruptLogError:
            found += _check_alone(reader, numbers)
            continue
        if log is not None and not found:
            log.take(piece)
    if log is not None and not found:
        found += [*check_statistics(reader), *log.finish()]
    return found


def _check_alone(reader: McapReader, numbers: slice) -> Iterator[Problem]:
    """Check chunks separately, of which at least one is damaged."""
    scratch = Scratch()
    for number in range(numbers.start, numbers.stop):
        try:
            piece = Piece.read(reader, slice(number, number + 1), scratch)
            yield from check_piece(reader, piece)
        except CorruptLogError as error:
            where = place(reader, reader.chunks[number])
            yield Problem(_without_path(error, reader.path), where)


def _decompressed(reader: McapReader, threads: int) -> Iterator[tuple[slice, Callable[[], Piece]]]:
    """Yield numbers of chunks with what gives them, which are there until the next ones are."""
    sizes = reader.table.rows["raw_bytes"].tolist()
    several = packed(range(len(sizes)), sizes.__getitem__)
    pieces = (slice(numbers[0], numbers[-1] + 1) for numbers in several)
    if threads == 1:
        scratch = Scratch()
        for numbers in pieces:
            yield numbers, partial(Piece.read, reader, numbers, scratch)
        return
    with ThreadPoolExecutor(threads) as pool:
        ahead = deque[tuple[slice, Future[Piece]]]()
        # One for each thread, and one at hand: memory does not grow with the file.
        scratches = cycle([Scratch() for _ in range(threads + 1)])
        while True:
            for numbers in islice(pieces, threads + 1 - len(ahead)):
                ahead.append((numbers, pool.submit(Piece.read, reader, numbers, next(scratches))))
            if not ahead:
                return
            numbers, future = ahead.popleft()
            yield numbers, future.result


def _check_file(reader: McapReader) -> list[Problem]:
    """Check that there is a summary, and the CRCs of the data section and of attachments."""
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
        found.append(Problem("the data section has no end", where))
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


def _recover(path: Path) -> str:
    return f"run `mcaprl recover {path} OUT`"


def _without_path(error: Exception, path: str | Path) -> str:
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path} ")
