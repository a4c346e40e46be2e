"""Storage of image observations: in memory, or in a file of uncompressed chunks."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.files import replacing
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.reading import McapReader, chunk_header
from mcaprl.recorder.format.schema import IMAGES_PER_CHUNK, ImageRows
from mcaprl.recorder.format.spaces import Leaf

Storage = Literal["auto", "memory", "mapped"]
"""Where images are stored: `memory`, `mapped` (on disk) or `auto`.

`auto` is `mapped` if the images exceed `MEMORY_SHARE` of the free memory, otherwise `memory`.
"""

STORAGES: Final[tuple[str, ...]] = get_args(Storage)
IMAGE_TYPE = "sensor_msgs/msg/Image"
CACHE_METADATA, CACHE_NOTES = "mcaprl.images", "mcaprl.images.notes"
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


Blocks = Iterator[tuple[NDArray[np.int64], NDArray[Any]]]
"""Log_times (K,) and images (K, *shape), block by block."""


def image_cache(reader: McapReader, leaf: Leaf, blocks: Blocks) -> McapReader:
    """Open the uncompressed copy of a log's images; write the copy beside the log if needed.

    `blocks` yields the images of the whole topic. It is iterated only if the copy is written.
    """
    path = cache_path(reader.path, leaf)
    description = {"fingerprint": fingerprint(reader), "topic": leaf.topic}
    return open_cache(path, description) or write_cache(path, description, leaf, blocks)


def cache_path(path: Path, leaf: Leaf) -> Path:
    """Return the path of the copy of a leaf's images, beside the file that they come from."""
    return path.with_name(f"{path.name}.{leaf.name}.images")


def open_cache(path: Path, description: dict[str, str]) -> McapReader | None:
    """Open a copy of images; return None if there is none, or if it has another description."""
    if not path.exists():
        return None
    try:
        cache = McapReader(path)
    except LogError:
        # The existing file is not a readable log: replace it.
        return None
    is_wanted = cache.complete and cache.metadata.get(CACHE_METADATA) == description
    return cache if is_wanted else None


def write_cache(
    path: Path,
    description: dict[str, str],
    leaf: Leaf,
    blocks: Blocks,
    *,
    most: int = IMAGES_PER_CHUNK,
    notes: dict[str, str] | None = None,
) -> McapReader:
    """Write the uncompressed copy of images, and open it."""
    from mcaprl.recorder.format.writing import McapWriter

    with replacing(path, LogError, concurrent=True) as unfinished:
        writer = McapWriter(unfinished, compression="none", overwrite=True)
        try:
            writer.add_metadata(CACHE_METADATA, description)
            channel = writer.add_channel(leaf.topic, IMAGE_TYPE, messages.definition(IMAGE_TYPE))
            rows = ImageRows.of_shape(
                leaf.shape, leaf.encoding or "", channel, most, writer.write_rows
            )
            for times, images in blocks:
                rows.write_columns(times, {"data": np.ascontiguousarray(images).view(np.uint8)})
            if notes:
                writer.add_metadata(CACHE_NOTES, notes)
            writer.close()
        finally:
            writer.abandon()
    return McapReader(path)


def fingerprint(reader: McapReader) -> str:
    """Return the SHA-256 of the offsets, sizes and CRCs of a log's chunks.

    If a chunk has no CRC, the hash includes the mtime of the log.
    """
    digest = hashlib.sha256(str(len(reader.view)).encode())
    has_crcs = bool(reader.chunks)
    for chunk in reader.chunks:
        header = chunk_header(reader.view, chunk.chunk_start_offset)
        digest.update(f"{header.data.start} {header.uncompressed_bytes} {header.crc} ".encode())
        has_crcs &= header.crc != 0
    if not has_crcs:
        digest.update(str(reader.path.stat().st_mtime_ns).encode())
    return digest.hexdigest()
