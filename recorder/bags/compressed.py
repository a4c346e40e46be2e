"""Decompression of files and messages that rosbag2 compressed, within limits."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.limits import MAX_CHUNK_BYTES, MAX_UNPACKED_BYTES, MAX_UNPACKED_RATIO
from mcaprl.recorder.bags.source import RawMessage, TopicSource

_BLOCK_BYTES = 2**20
# Content size of a frame that does not declare it.
_UNKNOWN = -1
# Part of the free disk space that decompressed files may take.
_FREE_SHARE = 0.9


def decompress_file(path: Path, target: Path) -> None:
    """Decompress a file to `target`."""
    try:
        size = path.stat().st_size
        most = max(MAX_UNPACKED_BYTES, MAX_UNPACKED_RATIO * size)
        free = int(shutil.disk_usage(target.parent).free * _FREE_SHARE)
        with path.open("rb") as packed, target.open("wb") as file:
            declared = zstandard.frame_content_size(packed.read(18))
            packed.seek(0)
            _check_size(path, declared, most, free, target.parent)
            written = 0
            reader = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
            while block := reader.read(_BLOCK_BYTES):
                written += len(block)
                _check_size(path, written, most, free, target.parent)
                file.write(block)
    except (OSError, zstandard.ZstdError) as error:
        raise LogError(f"{path} cannot be decompressed: {error}") from error


def _check_size(path: Path, size: int, most: int, free: int, folder: Path) -> None:
    if size > most:
        raise LogError(
            f"{path} has more than {most} bytes when it is decompressed: at most"
            f" {MAX_UNPACKED_BYTES} bytes, or {MAX_UNPACKED_RATIO} for each byte, are read;"
            " decompress it with zstd if you trust it"
        )
    if size > free:
        raise LogError(
            f"{path} is larger than {free} bytes when it is decompressed, the free space in"
            f" {folder}: set TMPDIR to a folder of a larger disk"
        )


class CompressedTopic:
    """Topic whose messages are compressed one by one."""

    def __init__(self, source: TopicSource) -> None:
        """Store the topic with the compressed messages."""
        self._source, self.definition = source, source.definition

    @property
    def times_ns(self) -> NDArray[np.int64]:
        """(N,) log_times in file order."""
        return self._source.times_ns

    @property
    def positions(self) -> NDArray[np.int64]:
        """(N,) positions in the file."""
        return self._source.positions

    def raw(self, rows: NDArray[np.int64]) -> Iterator[RawMessage]:
        """Yield the messages at the positions `rows` (K,), which are distinct and ascending."""
        for message in self._source.raw(rows):
            try:
                yield message._replace(data=_decompressed(message.data))
            except LogError as error:
                yield message._replace(data=b"", problem=str(error))

    def columns(
        self, fields: Sequence[str], rows: NDArray[np.int64] | None
    ) -> dict[str, NDArray[Any]] | None:
        """Return None: messages are decoded one by one."""
        return None


def _decompressed(data: bytes) -> bytes:
    """Decompress a message."""
    found: bytes | None = None
    try:
        size = zstandard.frame_content_size(data)
        if size == _UNKNOWN:
            found = zstandard.ZstdDecompressor().stream_reader(data).read(MAX_CHUNK_BYTES + 1)
            size = len(found)
        if size > MAX_CHUNK_BYTES:
            raise LogError(f"a compressed message has more than {MAX_CHUNK_BYTES} bytes")
        return found if found is not None else zstandard.ZstdDecompressor().decompress(data)
    except zstandard.ZstdError as error:
        raise LogError(f"a message cannot be decompressed: {error}") from error
