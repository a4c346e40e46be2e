"""Storage of image observations in memory, or on disk in uncompressed chunks."""

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
"""`memory`, `mapped` (on disk), or `auto`: `mapped` above `MEMORY_SHARE` of the free memory."""

IMAGE_TYPE = "sensor_msgs/msg/Image"
CACHE_METADATA = "mcaprl.images"
MEMORY_SHARE = 0.5


def is_mapped(storage: Storage, image_bytes: int) -> bool:
    """Return whether images of this total size stay on disk."""
    if storage == "auto":
        return image_bytes > MEMORY_SHARE * free_memory_bytes()
    return storage == "mapped"


def free_memory_bytes() -> float:
    """Return the free memory in bytes; infinity where the system does not report it."""
    try:
        return float(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return float("inf")


def image_cache(
    reader: McapReader, topic: Topic, blocks: Iterator[tuple[NDArray[np.int64], NDArray[np.uint8]]]
) -> McapReader:
    """Open the uncompressed copy of a log's images; write the copy beside the log if needed.

    Args:
        reader: Reader of the log.
        topic: Topic of the images.
        blocks: log_times and (K, height, width) or (K, height, width, channels) images of the whole
            topic; consumed only if the copy has to be written.

    Raises:
        LogError: The copy cannot be written.
    """
    path = reader.path.with_name(f"{reader.path.name}.{topic.name.rpartition('/')[2]}.images")
    description = {"fingerprint": fingerprint(reader), "topic": topic.name}
    if path.exists():
        try:
            cache = McapReader(path)
            if cache.complete and cache.metadata.get(CACHE_METADATA) == description:
                return cache
        except LogError:
            # The file is not a copy of these images: replace it.
            pass
    from mcaprl.recorder.format.writing import McapWriter

    with replacing(path, LogError, concurrent=True) as unfinished:
        writer = McapWriter(unfinished, compression="none", overwrite=True)
        try:
            writer.add_metadata(CACHE_METADATA, description)
            _write_blocks(writer, topic.name, blocks)
            writer.close()
        finally:
            writer.abandon()
    return McapReader(path)


def fingerprint(reader: McapReader) -> str:
    """Return the SHA-256 of a log's chunk offsets and CRCs, and of its mtime if it has no CRCs."""
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
    for times, images in blocks:
        height, width, channels = (*images.shape[1:], 1)[:3]
        if rows is None or len(rows) < len(images):
            dtype = image_dtype(height, width, channels, IMAGE_ENCODINGS[channels], IMAGE_FRAME)
            definition = messages.definition(IMAGE_TYPE)
            channel = writer.add_channel(topic, IMAGE_TYPE, definition)
            rows = message_rows(len(images), dtype, channel)
            encoding = IMAGE_ENCODINGS[channels]
            fill_image_constants(rows["payload"], height, width, encoding, IMAGE_FRAME)
        chunk = rows[: len(images)]
        chunk["log_time"] = times
        sec, nanosec = np.divmod(times, 10**9)
        chunk["payload"]["sec"], chunk["payload"]["nanosec"] = sec, nanosec
        chunk["payload"]["data"] = images.reshape(len(chunk), -1)
        writer.write_rows(chunk)
