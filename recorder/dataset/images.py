"""Reader of image observations, one image per record of `/rl/step`."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.dataset.episodes import time_order
from mcaprl.recorder.dataset.image_cache import IMAGE_TYPE, Storage, image_cache, is_mapped
from mcaprl.recorder.dataset.mapped import Frames, ImageFile, MappedImages
from mcaprl.recorder.format.reading import (
    MESSAGE_HEADER,
    Columns,
    Decoder,
    McapReader,
    MessageRange,
    Topic,
    chunk_header,
)
from mcaprl.recorder.format.schema import IMAGES_PER_CHUNK, STEP_TOPIC
from mcaprl.recorder.format.spaces import Leaf

_FIELDS = ("height", "width", "encoding", "step", "data")


def read_images(
    reader: McapReader, leaf: Leaf, times: NDArray[np.int64], *, storage: Storage, threads: int
) -> Frames:
    """Read the (F, *shape) images of a leaf at these log_times."""
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
