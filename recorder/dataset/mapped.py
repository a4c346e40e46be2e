"""Images on disk: an array-like object that reads its rows when they are indexed.

In uncompressed chunks, images are stored as plain bytes, so a batch is gathered from the
memory-mapped file at memory speed. The CRC of a chunk is checked at the first read of its images.
"""

from __future__ import annotations

import math
import mmap
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.format.reading import prefetch, release

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
