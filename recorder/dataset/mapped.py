"""Pictures that stay on disk: an array to index, whose rows are read when they are asked for.

Uncompressed chunks hold each picture as it is, so the rows of a batch are gathered from the mapped
file at the speed of memory. A chunk is checked against its CRC when one of its pictures is asked
for the first time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


class PictureFile:
    """A mapped file with pictures of one size in it.

    Attributes:
        name: of the file, to tell where pictures are.
    """

    def __init__(
        self, name: str, view: memoryview, picture_bytes: int, checks: Sequence[Callable[[], None]]
    ) -> None:
        """Map pictures.

        Args:
            name: of the file.
            view: of all its bytes.
            picture_bytes: of each picture.
            checks: for each chunk, what raises an error if it is damaged.
        """
        self.name = name
        bytes_ = np.frombuffer(view, np.uint8)
        # A window at each byte; a void-typed index copies them as fast as memcpy does.
        self._windows = np.lib.stride_tricks.as_strided(
            bytes_[:picture_bytes].view(np.dtype((np.void, picture_bytes))),
            (len(bytes_) - picture_bytes + 1,),
            (1,),
        )
        self._checks = checks
        self._is_checked = np.zeros(len(checks), bool)

    def read(self, offsets: NDArray[np.int64], chunks: NDArray[np.int32]) -> NDArray[np.uint8]:
        """The pictures at byte offsets, one behind the other.

        Args:
            offsets: (K,) in the file.
            chunks: (K,) the number of the chunk that each one is in.

        Raises:
            CorruptLogError: a chunk is damaged.
        """
        checked = self._is_checked[chunks]
        if not checked.all():
            for chunk in np.unique(chunks[~checked]).tolist():
                self._checks[chunk]()
                self._is_checked[chunk] = True
        return self._windows[offsets].view(np.uint8)


class MappedImages:
    """(F, *shape) uint8 pictures on disk. Indexing reads; `rows` does not.

    Attributes:
        shape: like an array's.
        dtype: likewise.
    """

    dtype = np.dtype(np.uint8)

    def __init__(
        self,
        files: Sequence[PictureFile],
        shape: tuple[int, ...],
        places: NDArray[np.int64],
    ) -> None:
        """Point at pictures.

        Args:
            files: that they are in.
            shape: of one.
            places: (F, 3) of each the number of its file, its chunk there, and its byte offset.
        """
        self._files, self._places = tuple(files), places
        self.shape = (len(places), *shape)

    @property
    def ndim(self) -> int:
        """Like an array's."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """Like an array's."""
        return int(np.prod(self.shape))

    @property
    def nbytes(self) -> int:
        """Bytes of all pictures."""
        return self.size

    @property
    def names(self) -> tuple[str, ...]:
        """Of the files."""
        return tuple(file.name for file in self._files)

    def rows(self, rows: Any) -> MappedImages:
        """Some of the pictures, still on disk."""
        return MappedImages(self._files, self.shape[1:], self._places[rows])

    def __len__(self) -> int:
        """Pictures."""
        return self.shape[0]

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        """Read one picture after the other."""
        return (self[row] for row in range(len(self)))

    def __getitem__(self, key: Any) -> NDArray[Any]:
        """Read pictures, indexed as an array's rows, or parts of them."""
        first, rest = (key[0], key[1:]) if isinstance(key, tuple) else (key, ())
        places = self._places[first]
        if places.ndim == 1:
            picture: NDArray[Any] = self._read(places[None])[0]
            return picture[rest] if rest else picture
        pictures = self._read(places)
        return pictures[(slice(None), *rest)] if rest else pictures

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Read all of them."""
        if copy is False:
            raise ValueError("pictures on disk cannot become an array without a copy")
        return self[:] if dtype is None else self[:].astype(dtype, copy=False)

    def _read(self, places: NDArray[np.int64]) -> NDArray[np.uint8]:
        number, chunk, offset = places.T
        shape = (len(places), *self.shape[1:])
        if len(self._files) == 1:
            return self._files[0].read(offset, chunk).reshape(shape)
        pictures = np.empty(shape, np.uint8)
        for index in np.unique(number).tolist():
            mine = number == index
            found = self._files[index].read(offset[mine], chunk[mine])
            pictures[mine] = found.reshape(-1, *self.shape[1:])
        return pictures


Frames = NDArray[Any] | MappedImages
"""The values of one leaf of an observation space."""


def rows_of(frames: Frames, rows: Any) -> Frames:
    """Some of the frames: a view or copy of arrays, and no reading of what is on disk."""
    return frames.rows(rows) if isinstance(frames, MappedImages) else frames[rows]


def joined(parts: Sequence[Frames]) -> Frames:
    """Frames of several logs, one behind the other; on disk if all are."""
    mapped = [part for part in parts if isinstance(part, MappedImages)]
    if len(mapped) < len(parts):
        return np.concatenate([np.asarray(part) for part in parts])
    files: list[PictureFile] = []
    places = []
    for part in mapped:
        moved = part._places.copy()
        moved[:, 0] += len(files)
        files += part._files
        places.append(moved)
    return MappedImages(files, mapped[0].shape[1:], np.concatenate(places))
