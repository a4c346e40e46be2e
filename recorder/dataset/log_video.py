"""Images of a log that are the frames of a video: a topic with one packet for each image.

An image is the frame of the last packet at or before its time, so the last observation of an
episode need not have a packet.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import CorruptLogError
from mcaprl.recorder.dataset.episodes import time_order
from mcaprl.recorder.dataset.packets import Packets
from mcaprl.recorder.dataset.video import Converter, Message, VideoDecoder, VideoStream, is_keyframe
from mcaprl.recorder.format.reading import McapReader, Topic
from mcaprl.recorder.format.schema import IMAGES_PER_CHUNK
from mcaprl.recorder.format.spaces import Leaf
from mcaprl.recorder.format.video_messages import VIDEO_TYPE, packet_of


def is_video_leaf(reader: McapReader, leaf: Leaf) -> bool:
    """Return whether the images of a leaf are frames of a video."""
    names = [reader.schema_of(channel).name for channel in reader.channels_of(leaf.topic)]
    return set(names) == {VIDEO_TYPE}


class LogVideo:
    """The video of a leaf, in one log.

    Attributes:
        times: (P,) log_times of the packets, not descending.
    """

    def __init__(self, reader: McapReader, leaf: Leaf) -> None:
        """Find the packets."""
        topic = Topic(reader, leaf.topic)
        self._reader, self._leaf, self._parts = reader, leaf, topic.parts
        self._where = f"{reader.path}: {leaf.topic}"
        order = time_order(topic)
        self._order = np.arange(len(topic)) if order is None else order
        self.times = topic.times[self._order]
        self._starts = np.cumsum([0, *(len(part) for _, part in self._parts)])

    def order_at(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the packet of the image at each time."""
        found = np.searchsorted(self.times, times, side="right") - 1
        if (found < 0).any():
            first = times[int(np.argmax(found < 0))]
            raise CorruptLogError(f"{self._where} has no image at log_time {first} or before")
        return found

    def packets(self, rows: NDArray[np.int64]) -> Iterator[tuple[str, bytes]]:
        """Yield the codec and the data of packets."""
        places = self._order[rows]
        numbers = np.searchsorted(self._starts, places, side="right") - 1
        if self._reader.is_remote:
            self._reader.fetch_chunks(self._parts[k][1] for k in np.unique(numbers).tolist())
        for row, number in zip(places.tolist(), numbers.tolist(), strict=True):
            decoder, part = self._parts[number]
            time_ns, offset = part.index[row - self._starts[number]].tolist()
            records = self._reader.records_of(part)
            message = self._reader.message(records, decoder.channel, time_ns, offset)
            try:
                yield packet_of(message)
            except CorruptLogError as error:
                raise CorruptLogError(f"{self._where} at log_time {time_ns}: {error}") from error

    def frames(self, rows: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.uint8] | str]]:
        """Yield the images of ascending packets, or why they cannot be decoded."""
        converter = Converter()
        stream = VideoStream(self._messages, np.zeros(1, np.int64), self.times)
        wanted = set(rows.tolist())
        for row, frame in stream.frames(rows):
            if row not in wanted:
                continue
            if isinstance(frame, str) or (frame.height, frame.width) == self._leaf.shape[:2]:
                yield row, frame if isinstance(frame, str) else converter.pixels(frame)
            else:
                yield row, f"it has {frame.width} x {frame.height} pixels"

    def has_images(self, times: NDArray[np.int64], final: NDArray[Any]) -> NDArray[np.bool_]:
        """Return whether the records at these log_times have images; all packets are decoded.

        The last record of an episode, where `final` is set, can have the image of the one before.
        """
        every = np.arange(len(self.times))
        readable = [row for row, image in self.frames(every) if not isinstance(image, str)]
        known, counts = np.unique(self.times[readable], return_counts=True)
        found = np.isin(times, known[counts == 1])
        repeats = final[: len(times)].astype(bool) & ~np.isin(times, self.times)
        found[1:] |= repeats[1:] & found[:-1]
        return found

    def is_start(self, time_ns: int) -> bool:
        """Return whether the images from this log_time on need no packet before it."""
        row = int(np.searchsorted(self.times, time_ns))
        if row == len(self.times) or self.times[row] != time_ns:
            return False
        return is_keyframe(VideoDecoder(), *next(self.packets(np.array([row]))))

    def read(self, order: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Decode the images (F, *shape) of packets."""
        rows, places = np.unique(order, return_inverse=True)
        found = np.empty((len(rows), *self._leaf.shape), np.uint8)
        for row, image in self._images(rows):
            found[np.searchsorted(rows, row)] = image
        return found if len(rows) == len(order) and (np.diff(places) == 1).all() else found[places]

    def blocks(self) -> Iterator[tuple[NDArray[np.int64], NDArray[np.uint8]]]:
        """Yield the log_times and images of all packets in blocks."""
        every = np.arange(len(self.times))
        images = self._images(every)
        for start in range(0, len(every), IMAGES_PER_CHUNK):
            rows = every[start : start + IMAGES_PER_CHUNK]
            block = [next(images)[1] for _ in rows]
            yield self.times[rows], np.stack(block)

    def _images(self, rows: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        for row, image in self.frames(rows):
            if isinstance(image, str):
                where = f"{self._where} at log_time {self.times[row]}"
                raise CorruptLogError(f"{where} has no image: {image}")
            yield row, image

    def _messages(self, rows: NDArray[np.int64]) -> Iterator[tuple[int, Message]]:
        for row, (kind, data) in zip(rows.tolist(), self.packets(rows), strict=True):
            yield row, (kind, data, ())


def packets_of_leaf(reader: McapReader, leaf: Leaf, times: NDArray[np.int64]) -> Packets:
    """Return the packets of the images at these log_times."""
    stream = partial(_packets, reader.path, leaf)
    return Packets.of_rows(stream, LogVideo(reader, leaf).order_at(times), in_logs=True)


def _packets(path: Path, leaf: Leaf, rows: NDArray[np.int64]) -> Iterator[tuple[str, bytes]]:
    yield from LogVideo(McapReader(path), leaf).packets(rows)
