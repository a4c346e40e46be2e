"""Checks of a whole log.

    file      summary, CRCs of the data section and attachments        (file_check)
    chunks    CRCs, message indexes, chunk indexes of the summary      (chunk_check)
    log       metadata, schema, episodes, order of steps, images       (episode_check)

Each chunk is decompressed once.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import cycle, islice
from pathlib import Path

from mcaprl.errors import CorruptLogError, LogError, SpaceError
from mcaprl.problem import Problem
from mcaprl.recorder.format.reading import (
    McapReader,
    Piece,
    Scratch,
    check_file,
    check_piece,
    check_statistics,
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
    found = [*check_file(reader)]
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


def _recover(path: Path) -> str:
    return f"run `mcaprl recover {path} OUT`"


def _without_path(error: Exception, path: str | Path) -> str:
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path} ")
