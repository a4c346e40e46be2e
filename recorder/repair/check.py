"""Checks of a whole log.

    file      summary, CRCs of the data section and attachments        (file_check)
    chunks    CRCs, message indexes, chunk indexes of the summary      (file_check)
    log       metadata, schema, episodes, order of steps, images       (episode_check)
    bag       all messages, if the file is another robot's bag

Each chunk is decompressed once.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from itertools import cycle, islice
from pathlib import Path

from mcap.records import ChunkIndex

from mcaprl.errors import CorruptLogError, LogError, NotMcapError, SpaceError
from mcaprl.problem import Problem, Shortlist
from mcaprl.recorder.bags.bag import Bag, open_bag
from mcaprl.recorder.bags.files import is_bag_file
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
from mcaprl.storage.remote import RemotePath, as_path
from mcaprl.texts import counted

_LISTED = 3
"""Number of undecodable messages of a topic that are listed."""


def check_messages(path: Path) -> list[Problem]:
    """Decode all messages of a bag file, or of a rosbag2 folder; return the problems by topic.

    One message is in memory at a time. If the file can be opened, the last finding is a note that
    it is a bag.
    """
    try:
        with closing(open_bag(path)) as bag:
            found = Shortlist[Problem]()
            if not any(info.count for info in bag.topics.values()):
                found.append(Problem("the bag has no messages", "all topics", file=str(path)))
            for name in bag.topics:
                found.extend(_problems_of(bag, name, str(path)))
            return [*found, *found.rest(), _note(path)]
    except LogError as error:
        what = str(error).removeprefix(f"{path}: ").removeprefix(f"{path} ")
        return [Problem(what, "reading the bag", file=str(path))]


def _note(path: Path) -> Problem:
    return Problem(
        "this is another robot's bag, not a log: its messages were decoded",
        "no topic /rl/step",
        next="to check its transitions, pass `mapping=FILE`; `mcaprl convert --suggest BAG > FILE`"
        " drafts one",
        file=str(path),
        severity="note",
    )


def _problems_of(bag: Bag, name: str, file: str) -> Iterator[Problem]:
    info = bag.topics[name]
    if info.problem:
        effect = f"its {counted(info.count, 'message')} cannot be read"
        yield Problem(info.problem, name, effect=effect, file=file)
        return
    count = 0
    try:
        for failure in bag.failures(name):
            count += 1
            if count <= _LISTED:
                what = f"message {failure.row} at {failure.log_time_ns} ns: {failure.reason}"
                yield Problem(what, name, file=file)
    except LogError as error:
        yield Problem(str(error).removeprefix(f"{file}: "), name, file=file)
    if count > _LISTED:
        what = f"{count} of {counted(info.count, 'message')} cannot be decoded"
        yield Problem(what, name, file=file)


# Number of chunks that a thread decompresses before it hands them over. Handing over each one takes
# more time.
_BLOCK_CHUNKS = 4
_Read = memoryview | CorruptLogError
"""Records of a chunk, or the error if the chunk is damaged."""


def check_log(path: str | Path, *, threads: int = 1) -> list[Problem]:
    """Check the structure, CRCs, indexes, episodes and metadata of one log.

    If the file is another robot's bag, its messages are decoded instead of the episodes.

    Returns:
        Problems in file order; for a bag, a note follows them.
    """
    path = as_path(path)
    is_other = path.is_dir() or (is_bag_file(path) and path.suffix != ".mcap")
    if is_other and not isinstance(path, RemotePath):
        return check_messages(path)
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
    found, notes = Shortlist(check_file(reader)), list[Problem]()
    is_log = bool(reader.channels_of(STEP_TOPIC)) or METADATA_NAME in reader.metadata
    # Bags are read from local files only.
    is_bag = not is_log and not isinstance(path, RemotePath)
    try:
        _check_contents(reader, found, threads=threads)
    except (LogError, SpaceError) as error:
        if not is_bag:
            found.append(Problem(_without_path(error, path), STEP_TOPIC))
    if is_bag and not (found and reader.complete):
        notes = check_messages(path)
    problems = [*found, *found.rest()]
    named = [
        replace(found, next=found.next or _recover(path), file=str(path)) for found in problems
    ]
    return [*named, *notes]


def _check_contents(reader: McapReader, found: Shortlist[Problem], *, threads: int) -> None:
    """Check each chunk. If all chunks are valid, check the log."""
    log, refusal = None, None
    if not found:
        try:
            log = EpisodeCheck(reader)
        except (LogError, SpaceError) as error:
            # The chunks of any MCAP file can be checked, so they are checked before this error is
            # raised.
            refusal = error
    for chunk, records in _decompressed(reader, threads):
        try:
            if isinstance(records, CorruptLogError):
                raise records
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


def _decompressed(reader: McapReader, threads: int) -> Iterator[tuple[ChunkIndex, _Read]]:
    """Yield each chunk and its records, or the error if it is damaged.

    The records are valid until the caller requests the next chunk.
    """
    chunks = iter(reader.chunks)
    if threads == 1:
        scratch = Scratch()
        yield from ((chunk, _records_of(reader, chunk, scratch)) for chunk in chunks)
        return

    def read(block: list[ChunkIndex], scratches: list[Scratch]) -> list[_Read]:
        return [_records_of(reader, *each) for each in zip(block, scratches, strict=False)]

    with ThreadPoolExecutor(threads) as pool:
        ahead = deque[tuple[list[ChunkIndex], Future[list[_Read]]]]()
        # Memory use is limited: there are buffers for a block for each thread, and for the caller.
        buffers = cycle([[Scratch() for _ in range(_BLOCK_CHUNKS)] for _ in range(threads + 1)])
        while True:
            while len(ahead) <= threads and (block := list(islice(chunks, _BLOCK_CHUNKS))):
                ahead.append((block, pool.submit(read, block, next(buffers))))
            if not ahead:
                return
            block, future = ahead.popleft()
            yield from zip(block, future.result(), strict=True)


def _records_of(reader: McapReader, chunk: ChunkIndex, scratch: Scratch) -> _Read:
    try:
        return reader.chunk_records(chunk, scratch)
    except CorruptLogError as error:
        return error


def _recover(path: Path) -> str:
    return f"run `mcaprl recover {path} OUT`"


def _without_path(error: Exception, path: str | Path) -> str:
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path} ")
