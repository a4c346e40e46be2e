"""Where image observations are kept, and a copy beside a log that can be mapped."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.files import replacing
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.reading import McapReader, Topic, chunk_header
from mcaprl.recorder.format.schema import fill_image_constants, image_dtype
from mcaprl.recorder.format.spaces import IMAGE_ENCODINGS
from mcaprl.recorder.format.topics import IMAGE_FRAME

if TYPE_CHECKING:
    from mcaprl.recorder.format.writing import McapWriter

Storage = Literal["auto", "memory", "mapped"]
"""`memory`, `mapped` (on disk), or `auto`: mapped if they would take much of the free memory."""

IMAGE_TYPE = "sensor_msgs/msg/Image"
CACHE_METADATA = "mcaprl.images"
MEMORY_SHARE = 0.5


def is_mapped(storage: Storage, image_bytes: int) -> bool:
    """Whether pictures of so many bytes are to stay on disk."""
    if storage == "auto":
        return image_bytes > MEMORY_SHARE * free_memory_bytes()
    return storage == "mapped"


def free_memory_bytes() -> float:
    """Memory that is free; infinite where the system does not tell."""
    try:
        return float(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return float("inf")


def image_cache(
    reader: McapReader, topic: Topic, blocks: Iterator[tuple[NDArray[np.int64], NDArray[np.uint8]]]
) -> McapReader:
    """A copy of a log's pictures in uncompressed chunks, made beside it unless it is there.

    Args:
        reader: of the log.
        topic: the pictures'.
        blocks: log_times and (K, height, width) or (K, height, width, channels) pictures, all of
            the topic; asked for only if the copy has to be made.

    Raises:
        LogError: it cannot be written.
    """
    path = reader.path.with_name(f"{reader.path.name}.{topic.name.rpartition('/')[2]}.images")
    told = {"fingerprint": fingerprint(reader), "topic": topic.name}
    if path.exists():
        try:
            cache = McapReader(path)
            if cache.complete and cache.metadata.get(CACHE_METADATA) == told:
                return cache
        except LogError:
            # Whatever it is, it is no copy of these pictures.
            pass
    from mcaprl.recorder.format.writing import McapWriter

    with replacing(path, LogError, concurrent=True) as unfinished:
        writer = McapWriter(unfinished, compression="none", overwrite=True)
        try:
            writer.add_metadata(CACHE_METADATA, told)
            _write_blocks(writer, topic.name, blocks)
            writer.close()
        finally:
            writer.abandon()
    return McapReader(path)


def fingerprint(reader: McapReader) -> str:
    """SHA-256 of where a log's chunks are and of their CRCs; of its date, too, if it has none."""
    digest = hashlib.sha256(str(len(reader.view)).encode())
    has_crcs = bool(reader.chunks)
    for chunk in reader.chunks:
        header = chunk_header(reader.view, chunk.chunk_start_offset)
        digest.update(f"{header.data.start} {header.uncompressed_bytes} {header.crc} ".encode())
        has_crcs &= header.crc != 0
    if not has_crcs:
        digest.update(str(reader.path.stat().st_mtime_ns).encode())
    return digest.hexdigest()


def _write_blocks(
    writer: McapWriter, topic: str, blocks: Iterator[tuple[NDArray[np.int64], NDArray[np.uint8]]]
) -> None:
    from mcaprl.recorder.format.writing import message_rows

    rows: NDArray[Any] | None = None
    for times, pictures in blocks:
        height, width, channels = (*pictures.shape[1:], 1)[:3]
        if rows is None or len(rows) < len(pictures):
            dtype = image_dtype(height, width, channels, IMAGE_ENCODINGS[channels], IMAGE_FRAME)
            definition = messages.definition(IMAGE_TYPE)
            channel = writer.add_channel(topic, IMAGE_TYPE, definition)
            rows = message_rows(len(pictures), dtype, channel)
            encoding = IMAGE_ENCODINGS[channels]
            fill_image_constants(rows["payload"], height, width, encoding, IMAGE_FRAME)
        chunk = rows[: len(pictures)]
        chunk["log_time"] = times
        sec, nanosec = np.divmod(times, 10**9)
        chunk["payload"]["sec"], chunk["payload"]["nanosec"] = sec, nanosec
        chunk["payload"]["data"] = pictures.reshape(len(chunk), -1)
        writer.write_rows(chunk)
