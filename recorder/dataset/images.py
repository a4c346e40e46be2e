"""Images of observations, in memory or on disk, and their reader.

Pillow knows dozens of formats. Some of its decoders are rarely tested, and that of PostScript
starts the program `gs`. Only the formats in `FORMATS` are decoded, and only images of a declared
size within `mcaprl.limits`.

In uncompressed chunks, images are stored as plain bytes, so a batch is gathered from the
memory-mapped file at memory speed. The CRC of a chunk is checked at the first read of its images.
"""

from __future__ import annotations

import math
import mmap
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError, LogError, import_extra
from mcaprl.files import replacing
from mcaprl.limits import MAX_IMAGE_PIXELS
from mcaprl.recorder.dataset.episodes import time_order
from mcaprl.recorder.dataset.log_video import LogVideo, is_video_leaf
from mcaprl.recorder.format.messages import definition
from mcaprl.recorder.format.reading import (
    MESSAGE_HEADER,
    Columns,
    Decoder,
    McapReader,
    MessageRange,
    Topic,
    chunk_header,
    prefetch,
    release,
)
from mcaprl.recorder.format.schema import IMAGES_PER_CHUNK, STEP_TOPIC, ImageRows
from mcaprl.recorder.format.spaces import Leaf

FORMATS: Final = ("JPEG", "PNG", "WEBP", "TIFF")
"""Formats of image files, by Pillow's names; TIFF stores depth as floats."""


def decoded_file(
    data: bytes,
    extra: str,
    *,
    formats: Sequence[str] = FORMATS,
    max_pixels: int = MAX_IMAGE_PIXELS,
) -> Any:
    """Decode an image file to a Pillow image.

    Args:
        data: Content of the file.
        extra: Extra of `mcaprl` that installs Pillow.
        formats: Formats that may be decoded.
        max_pixels: Maximum of width times height, which is checked before pixels are decoded.
    """
    pillow = import_extra("PIL.Image", extra)
    try:
        with warnings.catch_warnings():
            # Pillow warns about sizes above its limit, and about damaged EXIF data.
            warnings.simplefilter("ignore")
            image = pillow.open(BytesIO(data), formats=list(formats))
            width, height = image.size
            if width * height > max_pixels:
                raise LogError(
                    f"it declares {width} x {height} pixels; at most {max_pixels} can be read"
                )
            image.load()
    except LogError:
        raise
    except pillow.UnidentifiedImageError as error:
        raise LogError(f"{len(data)} bytes are not {', '.join(formats)}") from error
    # Pillow raises errors of many types for damaged images.
    except Exception as error:
        raise LogError(f"the {len(data)} bytes are damaged: {error}") from error
    return image


_UINT8 = np.dtype(np.uint8)
_BLOCK_BYTES = 1 << 24
_PREFETCHED_BYTES = 1 << 30
"""Size of the images from which on they are prefetched. Fewer are soon in the system's cache."""


class ImageFile:
    """A memory-mapped file that contains images of one size.

    Attributes:
        name: Name of the file, for messages.
    """

    def __init__(
        self,
        name: str,
        view: memoryview,
        image_bytes: int,
        checks: Sequence[Callable[[], None]],
        check_unchanged: Callable[[], None],
    ) -> None:
        """Create a view of the file's images without reading them.

        Each function in `checks` raises an error if its chunk is damaged. `check_unchanged` raises
        an error if the file was changed in place.
        """
        self.name, self._check_unchanged = name, check_unchanged
        bytes_ = np.frombuffer(view, np.uint8)
        # Element k is the image that starts at byte k. Indexing a void dtype is as fast as memcpy.
        self._windows = np.lib.stride_tricks.as_strided(
            bytes_[:image_bytes].view(np.dtype((np.void, image_bytes))),
            (len(bytes_) - image_bytes + 1,),
            (1,),
        )
        self._view = view
        self._checks = checks
        self._is_checked = np.zeros(len(checks), bool)

    def prefetch(self, start: int, stop: int) -> None:
        """Let the system start to load the pages of a range of bytes from the disk."""
        prefetch(self._view, start, stop)

    def release(self) -> None:
        """Let the system take back the memory of the file; it is read again when it is needed."""
        release(self._view)

    def read(self, offsets: NDArray[np.int64], chunks: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Copy K images, given their byte offsets (K,) and the indexes (K,) of their chunks."""
        self._check_unchanged()
        checked = self._is_checked[chunks]
        if not checked.all():
            for chunk in np.unique(chunks[~checked]).tolist():
                self._checks[chunk]()
                self._is_checked[chunk] = True
        return self._windows[offsets].view(np.uint8)


class MappedImages:
    """An array of (F, *shape) images on disk; indexing reads images, `rows` selects them.

    An element may be a stack of K images, joined along their last axis. The file contains each
    image once, however many stacks it is in.

    Attributes:
        shape: Shape of the corresponding array.
        dtype: Data type of the corresponding array.
    """

    def __init__(
        self,
        files: Sequence[ImageFile],
        image_shape: tuple[int, ...],
        places: NDArray[np.int64],
        dtype: np.dtype[Any] = _UINT8,
    ) -> None:
        """Create an array of images of one shape without reading them.

        Each row of `places` (F, 3), or (F, K, 3) for stacks, contains the index of the file, the
        index of the chunk in the file, and the byte offset of the image.
        """
        self._files, self._places, self._image_shape = tuple(files), places, image_shape
        self.dtype = dtype
        *edges, channels = image_shape
        is_stacked = places.ndim == 3
        last = channels * places.shape[1] if is_stacked else channels
        self.shape = (len(places), *edges, last)

    @property
    def ndim(self) -> int:
        """Number of dimensions."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    @property
    def nbytes(self) -> int:
        """Size of all images in bytes."""
        return self.size * self.dtype.itemsize

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the files."""
        return tuple(file.name for file in self._files)

    def release(self) -> None:
        """Let the system take back the memory of the files."""
        for file in self._files:
            file.release()

    def rows(self, rows: Any) -> MappedImages:
        """Select images without reading them; `rows` (N, K) selects N stacks of K images."""
        return MappedImages(self._files, self._image_shape, self._places[rows], self.dtype)

    def __len__(self) -> int:
        """Return the number of images."""
        return self.shape[0]

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Read the images one by one."""
        return (self[row] for row in range(len(self)))

    def __getitem__(self, key: Any) -> NDArray[Any]:
        """Read images or parts of images; `key` is a NumPy index."""
        first, rest = (key[0], key[1:]) if isinstance(key, tuple) else (key, ())
        places = self._places[first]
        if places.ndim < self._places.ndim:
            image: NDArray[Any] = self._read(places[None])[0]
            return image[rest] if rest else image
        images = self._read(places)
        return images[(slice(None), *rest)] if rest else images

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Read all images."""
        if copy is False:
            raise ValueError("images on disk cannot be converted to an array without a copy")
        return self[:] if dtype is None else self[:].astype(dtype, copy=False)

    def _read(self, places: NDArray[np.int64]) -> NDArray[Any]:
        if places.ndim == 2:
            return self._images(places)
        count, stack, _ = places.shape
        pixels = as_pixels(self._images(places.reshape(-1, 3)))
        found = np.empty((count, *pixels.shape[1:], stack), pixels.dtype)
        for k in range(stack):
            found[..., k] = pixels[k::stack]
        return found.view(self.dtype).reshape(count, *self.shape[1:])

    def _images(self, places: NDArray[np.int64]) -> NDArray[Any]:
        """Read images (M, *image_shape) at places (M, 3)."""
        shape = (len(places), *self._image_shape)
        if len(self._files) == 1:
            if self.nbytes >= _PREFETCHED_BYTES:
                self._prefetch(places[np.argsort(places[:, 2])])
            found = self._files[0].read(places[:, 2], places[:, 1])
            return found.view(self.dtype).reshape(shape)
        order = np.lexsort((places[:, 2], places[:, 0]))
        if self.nbytes >= _PREFETCHED_BYTES:
            self._prefetch(places[order])
        number, chunk, offset = places[order].T
        images = np.empty(shape, self.dtype)
        ends = [*(np.flatnonzero(np.diff(number)) + 1).tolist(), len(order)]
        for first, stop in zip([0, *ends], ends, strict=False):
            if first < stop:
                found = self._files[number[first]].read(offset[first:stop], chunk[first:stop])
                images[order[first:stop]] = found.view(self.dtype).reshape(-1, *shape[1:])
        return images

    def _prefetch(self, places: NDArray[np.int64]) -> None:
        """Let the system start to load images, given in the order of their files and offsets.

        Without this, `read` would wait for one image after the other, and the system would load
        their surroundings too.
        """
        if not len(places):
            return
        number, _, offset = places.T
        first = offset // mmap.PAGESIZE * mmap.PAGESIZE
        stop = offset + math.prod(self._image_shape) * self.dtype.itemsize
        apart = (np.diff(number) != 0) | (first[1:] > stop[:-1])
        begins = np.flatnonzero(np.concatenate([[True], apart]))
        ends = np.flatnonzero(np.concatenate([apart, [True]]))
        ranges = (number[begins], first[begins], stop[ends])
        for index, start, end in zip(*(part.tolist() for part in ranges), strict=True):
            self._files[index].prefetch(start, end)


def as_pixels(images: NDArray[Any]) -> NDArray[Any]:
    """Return images (..., H, W, C) as (..., H, W) items, each with the C values of a pixel.

    Copying such items is two to three times as fast as copying channels.
    """
    channels = images.shape[-1]
    item = np.dtype((np.void, channels * images.itemsize)) if channels > 1 else images.dtype
    return np.ascontiguousarray(images).view(item)[..., 0]


Frames = NDArray[Any] | MappedImages
"""All frames of one observation leaf, in memory or on disk."""


def rows_of(frames: Frames, rows: Any) -> Frames:
    """Select rows of an array or of images on disk; images on disk are not read."""
    return frames.rows(rows) if isinstance(frames, MappedImages) else frames[rows]


def joined(parts: Sequence[Frames]) -> Frames:
    """Concatenate the frames of several logs; the result is on disk if all frames are on disk."""
    mapped = [part for part in parts if isinstance(part, MappedImages)]
    if len(mapped) < len(parts):
        return np.concatenate([np.asarray(part) for part in parts])
    files: list[ImageFile] = []
    places = []
    for part in mapped:
        moved = part._places.copy()
        moved[..., 0] += len(files)
        files += part._files
        places.append(moved)
    return MappedImages(files, mapped[0]._image_shape, np.concatenate(places), mapped[0].dtype)


def blocks_of(frames: Frames) -> Iterator[NDArray[Any]]:
    """Yield all frames in blocks of a few MB, which fit into memory."""
    if not len(frames):
        return
    rows = max(1, _BLOCK_BYTES * len(frames) // max(frames.nbytes, 1))
    for start in range(0, len(frames), rows):
        yield np.ascontiguousarray(frames[start : start + rows])


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
    description = {"fingerprint": reader.checksum, "topic": leaf.topic}
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
            channel = writer.add_channel(leaf.topic, IMAGE_TYPE, definition(IMAGE_TYPE))
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


_FIELDS = ("height", "width", "encoding", "step", "data")


def read_images(
    reader: McapReader, leaf: Leaf, times: NDArray[np.int64], *, storage: Storage, threads: int
) -> Frames:
    """Read the (F, *shape) images of a leaf at these log_times."""
    if is_video_leaf(reader, leaf):
        video = LogVideo(reader, leaf)
        order = video.order_at(times)
        if not is_mapped(storage, len(times) * leaf.size):
            return video.read(order)
        cache = image_cache(reader, leaf, video.blocks())
        images, times = _Images(cache, leaf), video.times[order]
        return images.mapped(images.order_at(times))
    images = _Images(reader, leaf)
    if not is_mapped(storage, len(times) * leaf.size):
        return images.read(images.order_at(times), threads)
    if not images.are_mappable:
        images = _Images(image_cache(reader, leaf, images.blocks()), leaf)
    return images.mapped(images.order_at(times))


def mapped_images(cache: McapReader, leaf: Leaf, times: NDArray[np.int64]) -> MappedImages | None:
    """Return the images of a copy at these log_times (F,); None if it lacks some of them."""
    images = _Images(cache, leaf)
    if not (images.are_mappable and np.isin(times, images.topic.times).all()):
        return None
    found = images.mapped(images.order_at(times))
    # The positions of the images were read from all over the file.
    found.release()
    return found


class _Images:
    """The topic with the images of one leaf, in one file."""

    def __init__(self, reader: McapReader, leaf: Leaf) -> None:
        self.topic = Topic(reader, leaf.topic)
        self._reader, self._leaf = reader, leaf
        if not len(self.topic):
            raise CorruptLogError(f"{reader.path}: no images on {leaf.topic}")
        if not set(_FIELDS) <= set(self.topic.fields):
            raise CorruptLogError(f"{reader.path}: messages of {leaf.topic} are not {IMAGE_TYPE}")

    @property
    def are_mappable(self) -> bool:
        """Whether all images are in uncompressed chunks."""
        chunks = [messages.chunk for _, messages in self.topic.parts]
        return all(chunk is not None and not chunk.compression for chunk in chunks)

    def order_at(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the row of the message at each time."""
        if self._reader.is_remote and self.topic.chunks_rise:
            return self._order_in_chunks(times)
        by_time = time_order(self.topic)
        rising = self.topic.times if by_time is None else self.topic.times[by_time]
        place = np.searchsorted(rising, times)
        found = rising[np.minimum(place, len(rising) - 1)] == times
        where = f"{self._reader.path}: {self.topic.name}"
        if not found.all():
            missing = times[~found]
            raise CorruptLogError(
                f"{where} has no image for {len(missing)} records of {STEP_TOPIC}, the first at"
                f" log_time {missing[0]}"
            )
        if (rising[1:] == rising[:-1]).any():
            raise CorruptLogError(f"{where} has two images with the same log_time")
        return place if by_time is None else by_time[place]

    def _order_in_chunks(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the row of the message at each time; read only the chunks with these times."""
        parts = [part for _, part in self.topic.parts]
        starts = [part.chunk.message_start_time for part in parts if part.chunk is not None]
        stops = np.cumsum([len(part) for part in parts])
        numbers = np.maximum(np.searchsorted(starts, times, side="right") - 1, 0)
        chosen = np.unique(numbers).tolist()
        self._reader.fetch_chunks(parts[number] for number in chosen)
        order = np.empty(len(times), np.int64)
        for number in chosen:
            mine, index = numbers == number, parts[number].index["log_time"]
            place = np.searchsorted(index, times[mine])
            if (index[np.minimum(place, len(index) - 1)] != times[mine]).any():
                raise CorruptLogError(
                    f"{self._reader.path}: {self.topic.name} has no image for some records of"
                    f" {STEP_TOPIC}"
                )
            order[mine] = place + stops[number] - len(index)
        return order

    def read(self, order: NDArray[np.int64], threads: int = 1) -> NDArray[np.uint8]:
        """Read the images (F, *shape) into memory."""
        is_all = len(order) == len(self.topic) and bool((np.diff(order) == 1).all())
        columns = self.topic.read(_FIELDS, None if is_all else order, threads=threads)
        self._check(columns)
        return columns["data"].reshape(-1, *self._leaf.shape)

    def blocks(self) -> Iterator[tuple[NDArray[np.int64], NDArray[np.uint8]]]:
        """Yield the log_times and images of the topic in blocks, in log_time order."""
        order = time_order(self.topic)
        order = np.arange(len(self.topic)) if order is None else order
        for start in range(0, len(order), IMAGES_PER_CHUNK):
            part = order[start : start + IMAGES_PER_CHUNK]
            yield self.topic.times[part], self.read(part)

    def mapped(self, order: NDArray[np.int64]) -> MappedImages:
        """Return an array-like (F, *shape) on disk; a chunk is checked when it is first read."""
        places = np.empty((len(self.topic), 3), np.int64)
        checks, start = [], 0
        first = self._data_offset()
        for number, (decoder, messages) in enumerate(self.topic.parts):
            chunk, index = messages.chunk, messages.index
            assert chunk is not None, "images outside of chunks are not mapped"
            data = chunk_header(self._reader.view, chunk.chunk_start_offset).data
            stop = start + len(index)
            places[start:stop, 0], places[start:stop, 1] = 0, number
            places[start:stop, 2] = index["offset"].astype(np.int64) + data.start + first
            checks.append(self._check_of(decoder, messages, first))
            start = stop
        reader, leaf = self._reader, self._leaf
        file = ImageFile(
            str(reader.path), reader.view, self._image_bytes, checks, reader.check_unchanged
        )
        return MappedImages([file], leaf.shape, places[order], leaf.dtype)

    @property
    def _image_bytes(self) -> int:
        return self._leaf.size * self._leaf.dtype.itemsize

    def _data_offset(self) -> int:
        """Return the offset of the image data in the first message record."""
        decoder, messages = self.topic.parts[0]
        found = decoder.alike(self._reader.records_of(messages), messages.index[:1], _FIELDS)
        if found is None:
            raise CorruptLogError(f"{self._reader.path}: an image on {self.topic.name} is damaged")
        return _offset_of_data(found.dtype)

    def _check_of(
        self, decoder: Decoder, messages: MessageRange, data_offset: int
    ) -> Callable[[], None]:
        def check() -> None:
            found = decoder.alike(self._reader.records_of(messages), messages.index, _FIELDS)
            if found is None or _offset_of_data(found.dtype) != data_offset:
                raise CorruptLogError(
                    f"{self._reader.path}: images on {self.topic.name} differ in message layout;"
                    " open the log with images='memory'"
                )
            self._check({name: found[name] for name in _FIELDS})

        return check

    def _check(self, columns: Columns) -> None:
        """Check the size and encoding of images against the leaf."""
        height, width = self._leaf.shape[:2]
        encoding = self._leaf.encoding or ""
        as_stored = encoding.encode() if columns["encoding"].dtype.kind == "S" else encoding
        expected = (height, width, as_stored, self._image_bytes // height)
        found = [columns[name] for name in _FIELDS[:-1]]
        wrong = np.logical_or.reduce([a != b for a, b in zip(found, expected, strict=True)])
        if wrong.any() or columns["data"].shape[1:] != (self._image_bytes,):
            row = int(np.argmax(wrong))
            found_text = ", ".join(
                f"{name} {column[row]}" for name, column in zip(_FIELDS, found, strict=False)
            )
            raise CorruptLogError(
                f"{self._reader.path}: an image on {self.topic.name} has {found_text} and"
                f" {columns['data'].shape[1]} bytes; its space is {height}x{width} {encoding}"
            )


def _offset_of_data(message: np.dtype[np.void]) -> int:
    assert message.fields is not None
    return MESSAGE_HEADER.itemsize + int(message.fields["data"][1])
