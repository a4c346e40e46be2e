"""Checks of a whole log.

    file      summary, CRCs of the data section and attachments        (file_check)
    chunks    CRCs, message indexes, chunk indexes of the summary      (file_check)
    log       metadata, schema, episodes, order of steps, images       (episode_check)

Each chunk is decompressed once.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import cycle, islice
from pathlib import Path

from mcap.records import ChunkIndex

from mcaprl.errors import CorruptLogError, LogError, NotMcapError, SpaceError
from mcaprl.problem import Problem, Shortlist
from mcaprl.recorder.format.metadata import METADATA_NAME
from mcaprl.recorder.format.reading import (
    McapReader,
    Scratch,
    check_chunk,
    check_file,
    check_statistics,
    place,
)
from mcaprl.recorder.format.topics import STEP_TOPIC
from mcaprl.recorder.repair.episode_check import EpisodeCheck
from mcaprl.remote import as_path

# Number of chunks that a thread decompresses one after the other.
_BLOCK_CHUNKS = 4


def check_log(path: str | Path, *, threads: int = 1) -> list[Problem]:
    """Check the structure, CRCs, indexes, episodes and metadata of one log.

    Args:
        path: Path of the log.
        threads: Number of threads that decompress chunks.

    Returns:
        Problems in file order.
    """
    path = as_path(path)
    try:
        reader = McapReader(path)
    except LogError as error:
        what, action = _without_path(error, path), "check the path and its permissions"
        if isinstance(error, NotMcapError):
            what = f"the file {what}"
            action = "restore a backup copy, or read another tool's dataset with `mcaprl info`"
        elif isinstance(error, CorruptLogError):
            action = _recover(path)
        return [Problem(what, "opening the file", next=action, file=str(path))]
    found = Shortlist(check_file(reader))
    action = _recover(path)
    try:
        _check_contents(reader, found, threads=threads)
    except (LogError, SpaceError) as error:
        if not found and METADATA_NAME not in reader.metadata:
            action = "the MCAP file itself is valid, but it is not an mcaprl log"
        found.append(Problem(_without_path(error, path), STEP_TOPIC))
    problems = [*found, *found.rest()]
    return [replace(found, next=found.next or action, file=str(path)) for found in problems]


def _check_contents(reader: McapReader, found: Shortlist[Problem], *, threads: int) -> None:
    """Check each chunk. If all chunks are valid, check the log.

    Args:
        reader: Reader of the file.
        found: Problems found so far; this function adds further problems.
        threads: Number of threads that decompress chunks.

    Raises:
        LogError, SpaceError: The file is not a valid log.
    """
    log, refusal = None, None
    if not found:
        try:
            log = EpisodeCheck(reader)
        except (LogError, SpaceError) as error:
            # The chunks of any MCAP file can be checked, so they are checked before this error is
            # raised.
            refusal = error
    for chunk, read in _decompressed(reader, threads):
        try:
            records = read()
            found.extend(check_chunk(reader, chunk, records))
        except CorruptLogError as error:
            found.append(Problem(_without_path(error, reader.path), place(reader, chunk)))
            continue
        if log is not None and not found:
            log.take(chunk, records)
    if refusal is not None:
        raise refusal
    if log is not None and not found:
        found.extend(check_statistics(reader))
        found.extend(log.finish())


def _decompressed(
    reader: McapReader, threads: int
) -> Iterator[tuple[ChunkIndex, Callable[[], memoryview]]]:
    """Yield each chunk and a function that returns its records.

    The records are valid until the caller requests the next chunk.
    """
    if threads == 1:
        scratch = Scratch()
        for chunk in reader.chunks:
            yield chunk, partial(reader.chunk_records, chunk, scratch)
        return
    # Handing over several chunks at once takes less time than handing over each one.
    blocks = _blocks_of(reader.chunks, _BLOCK_CHUNKS)
    with ThreadPoolExecutor(threads) as pool:
        ahead = deque[tuple[list[ChunkIndex], Future[list[Callable[[], memoryview]]]]]()
        # Memory use is limited: there are buffers for a block for each thread, and for the caller.
        scratches = cycle([[Scratch() for _ in range(_BLOCK_CHUNKS)] for _ in range(threads + 1)])
        while True:
            for block in islice(blocks, threads + 1 - len(ahead)):
                ahead.append((block, pool.submit(_read_block, reader, block, next(scratches))))
            if not ahead:
                return
            block, future = ahead.popleft()
            yield from zip(block, future.result(), strict=True)


def _read_block(
    reader: McapReader, block: Sequence[ChunkIndex], scratches: Sequence[Scratch]
) -> list[Callable[[], memoryview]]:
    """Decompress chunks; return functions that return the records, or raise the error."""

    def read(chunk: ChunkIndex, scratch: Scratch) -> Callable[[], memoryview]:
        done: Future[memoryview] = Future()
        try:
            done.set_result(reader.chunk_records(chunk, scratch))
        except CorruptLogError as error:
            done.set_exception(error)
        return done.result

    return list(map(read, block, scratches))


def _blocks_of(chunks: Iterable[ChunkIndex], size: int) -> Iterator[list[ChunkIndex]]:
    rest = iter(chunks)
    while block := list(islice(rest, size)):
        yield block


def _recover(path: Path) -> str:
    return f"run `mcaprl recover {path} OUT`"


def _without_path(error: Exception, path: str | Path) -> str:
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path} ")
