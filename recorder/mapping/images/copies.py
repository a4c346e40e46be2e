"""Copy of a bag's decoded images on disk, from which single images are read when they are indexed.

The copy is beside the first file of the bag, `BAG.NAME.images`, where NAME is the name of the
quantity. It is an MCAP file whose log_times are the positions of the messages in their topic. It is
used again as long as the files of the bag and the options of the image are the same.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.files import parse_json
from mcaprl.recorder.bags.bag import Failure
from mcaprl.recorder.dataset.images import (
    CACHE_NOTES,
    Blocks,
    MappedImages,
    cache_path,
    mapped_images,
    open_cache,
    write_cache,
)
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.format.schema import IMAGES_PER_CHUNK
from mcaprl.recorder.format.spaces import IMAGE_ENCODINGS, Leaf
from mcaprl.texts import size

if TYPE_CHECKING:
    from mcaprl.recorder.mapping.images.reader import ImageReader

_VERSION = "1"
"""Version of the decoders. It changes if they decode the same message to other pixels."""
_FAILURES = "failures"
_BLOCK_BYTES = 1 << 20
"""Size of the images that are in memory at a time, but for one that is larger."""


def copied_images(
    reader: ImageReader, rows: NDArray[np.int64], like: NDArray[Any]
) -> MappedImages | None:
    """Return the images of messages from the copy on disk; write the copy if needed.

    Args:
        reader: Reader of the topic.
        rows: (N,) ascending positions of the messages in the topic.
        like: One of the images.

    Returns:
        (N, H, W, C) images; None if one cannot be decoded.
    """
    encoding = IMAGE_ENCODINGS[like.shape[2]] if like.dtype == np.uint8 else "32FC1"
    leaf = Leaf(reader.name, (), like.shape, like.dtype, encoding)
    path = cache_path(reader.bag.paths[0], leaf)
    description = {
        "bag": _fingerprint(reader.bag.paths),
        "topic": reader.topic,
        "options": reader.options.to_json(),
        "image": f"{like.shape} {like.dtype}",
        "version": _VERSION,
    }
    found = _existing(reader, open_cache(path, description), leaf, rows)
    if found is None:
        _write(reader, path, description, leaf, rows)
        found = _existing(reader, open_cache(path, description), leaf, rows)
    if found is None:
        raise LogError(f"{path} was changed by another process: try again")
    return found if len(found) == len(rows) else None


def _existing(
    reader: ImageReader, cache: McapReader | None, leaf: Leaf, rows: NDArray[np.int64]
) -> MappedImages | None:
    """Return the images of a copy, without those that could not be decoded.

    The result is None if the copy is missing or damaged, or lacks other messages.
    """
    if cache is None:
        return None
    try:
        failed = _failures(cache, reader.bag.times(reader.topic))
        is_failed = np.isin(rows, [each.row for each in failed])
        found = mapped_images(cache, leaf, rows[~is_failed])
    except (LogError, ValueError, TypeError):
        return None
    if found is not None:
        for each in failed:
            reader.leave_out(each)
    return found


def _failures(cache: McapReader, times_ns: NDArray[np.int64]) -> list[Failure]:
    """Return the failures that a copy lists."""
    found = []
    for row, reason in parse_json(cache.metadata.get(CACHE_NOTES, {}).get(_FAILURES, "[]")):
        if not isinstance(row, int) or not 0 <= row < len(times_ns):
            raise ValueError(row)
        found.append(Failure(row, int(times_ns[row]), str(reason)))
    return found


def _write(
    reader: ImageReader,
    path: Path,
    description: dict[str, str],
    leaf: Leaf,
    rows: NDArray[np.int64],
) -> None:
    image_bytes = leaf.size * leaf.dtype.itemsize
    needed, notes = len(rows) * image_bytes, dict[str, str]()
    remedy = "set `resize`, `crop` or a lower rate in the mapping, or images='memory'"
    try:
        free = shutil.disk_usage(path.parent).free
    except OSError as error:
        raise LogError(f"cannot write {path}: {error.strerror}") from error
    if needed > free:
        raise LogError(
            f"cannot write {path}: the images need {size(needed)}, {size(free)} are free; {remedy}"
        )

    most = max(1, min(IMAGES_PER_CHUNK, _BLOCK_BYTES // image_bytes))

    def blocks() -> Blocks:
        yield from reader.blocks(rows, leaf.shape, leaf.dtype, most)
        if reader.failures:
            failed = [(each.row, each.reason) for each in reader.failures.values()]
            notes[_FAILURES] = json.dumps(failed)

    try:
        write_cache(path, description, leaf, blocks(), most=most, notes=notes)
    except LogError as error:
        if isinstance(error.__cause__, OSError):
            raise LogError(f"{error}; images are copied there: {remedy}") from error
        raise


def _fingerprint(paths: tuple[Path, ...]) -> str:
    """Return the SHA-256 of the paths, sizes and times of change of files."""
    digest = hashlib.sha256()
    try:
        for file in _files(paths):
            state = file.stat()
            digest.update(f"{file.resolve()} {state.st_size} {state.st_mtime_ns}\n".encode())
    except OSError as error:
        raise LogError(f"{error.filename}: {error.strerror}") from error
    return digest.hexdigest()


def _files(paths: tuple[Path, ...]) -> Iterator[Path]:
    for path in paths:
        yield from sorted(path.iterdir()) if path.is_dir() else [path]
