"""Images of a bag as observations, in memory or on disk.

Raw and compressed images of ROS and Foxglove are supported; see `pixels` and `compressed`.
`image_options` describes what they become.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, UsageError
from mcaprl.problem import Problem
from mcaprl.recorder.bags.bag import Bag, Failure, TopicInfo
from mcaprl.recorder.dataset.images import Frames, Storage, as_pixels, is_mapped
from mcaprl.recorder.format.spaces import MAX_ELEMENTS
from mcaprl.recorder.mapping.config import Quantity
from mcaprl.recorder.mapping.images.compressed import compressed_pixels, is_video
from mcaprl.recorder.mapping.images.copies import copied_images
from mcaprl.recorder.mapping.images.options import ImageOptions
from mcaprl.recorder.mapping.images.pixels import Pixels, one_line, raw_pixels
from mcaprl.texts import counted, size

Image = NDArray[Any]

_BLOCK_ROWS, _BLOCK_BYTES = 32, 1 << 22
"""Largest number and size of the messages that are in memory at a time."""
# foxglove.RawImage has no is_bigendian: its pixels are little-endian.
_RAW_FIELDS, _BIG_ENDIAN = ("height", "width", "encoding", "step", "data"), "is_bigendian"
_COMPRESSED_FIELDS = ("format", "data")
_TYPES = ("Image", "CompressedImage", "RawImage")
_PACKAGES = ("sensor_msgs", "foxglove", "foxglove_msgs")


def is_image_type(type_name: str) -> bool:
    """Return whether messages of a type are images that can be read.

    ROS 1 names, which have no `/msg/`, and those of Foxglove are known.

    >>> is_image_type("sensor_msgs/msg/Image"), is_image_type("sensor_msgs/Image")
    (True, True)
    >>> is_image_type("foxglove.RawImage"), is_image_type("sensor_msgs/msg/Imu")
    (True, False)
    """
    package, *_, name = type_name.replace(".", "/").split("/") * 2
    return package in _PACKAGES and name in _TYPES


class ImageReader:
    """Reader that decodes, crops and resizes the images of one topic as a mapping specifies.

    Attributes:
        bag: Bag that has the topic.
        topic: Topic of the images.
        name: Name of the quantity, which is part of the name of a copy on disk.
        options: Options of the mapping.
        failures: Messages without a readable image, by their index in the topic, as far as `read`
            found any. They are to be treated as if they did not exist.
    """

    def __init__(
        self,
        bag: Bag,
        topic: str,
        quantity: Quantity,
        *,
        name: str = "image",
        strict: bool = False,
    ) -> None:
        """Find out whether the images are raw or compressed."""
        self.bag, self.topic, self.name = bag, topic, name
        self.options, self._strict = ImageOptions(topic, quantity), strict
        self._fields = _image_fields(bag, bag.topics[topic])
        self.failures: dict[int, Failure] = {}

    def read(self, rows: NDArray[np.int64], storage: Storage = "memory") -> Frames | None:
        """Return the images of N messages as (N, H, W, C); repeated messages are decoded only once.

        Args:
            rows: (N,) positions of the messages in the topic; or (N, K) to join K images along the
                last axis, (N, H, W, K * C).
            storage: Where the images are stored. If they are `mapped`, they are decoded into a file
                beside the bag, and read when they are indexed.

        Returns:
            The images; None if a message has no readable image. All such messages among `rows` are
            in `failures` then: choose other rows, and read again.
        """
        wanted, places = np.unique(rows, return_inverse=True)
        first = next(self._images(wanted), None)
        if first is None:
            raise LogError(f"{self.topic}: {self._why_none(wanted)}")
        image = first[1]
        elements = image.size * (rows.shape[1] if rows.ndim > 1 else 1)
        if elements > MAX_ELEMENTS:
            raise UsageError(
                f"{self.topic}: an observation of {elements} elements is too large; at most"
                f" {MAX_ELEMENTS} can be used: set `resize` or `crop`, or a smaller `stack`"
            )
        if not is_mapped(storage, rows.size * image.nbytes):
            found: Frames | None = self._in_memory(wanted, places.reshape(rows.shape), image)
        elif (mapped := copied_images(self, wanted, image)) is not None:
            found = mapped.rows(places.reshape(rows.shape))
        else:
            found = None
        return None if self.failures.keys() & set(wanted.tolist()) else found

    def blocks(
        self,
        rows: NDArray[np.int64],
        shape: tuple[int, ...],
        dtype: np.dtype[Any],
        count: int,
    ) -> Iterator[tuple[NDArray[np.int64], Image]]:
        """Yield positions (K,) and images (K, H, W, C) of the messages with readable images.

        The arrays are used again for the next block.
        """
        numbers, images = np.empty(count, np.int64), np.empty((count, *shape), dtype)
        filled = 0
        for row, image in self._images(rows):
            if image.shape != shape or image.dtype != dtype:
                raise LogError(
                    f"{self.topic}: image {row} is {image.shape} {image.dtype}, but the"
                    f" first is {shape} {dtype}: set `resize` in the mapping"
                )
            numbers[filled], images[filled] = row, image
            filled += 1
            if filled == count:
                yield numbers, images
                filled = 0
        if filled:
            yield numbers[:filled], images[:filled]

    def space(self, images: Frames) -> spaces.Box:
        """Return the space of one of the images (N, H, W, C)."""
        return self.options.space(images)

    def problems(self) -> list[Problem]:
        """Return problems of the images that `read` decoded."""
        found = []
        if self.options.ambiguous:
            what = f"images '{self.options.ambiguous}' are read as depth, but may have other values"
            action = "set `as: depth`, or `as: intensity` for infrared and thermal images"
            found.append(Problem(what, self.topic, next=action))
        if self.failures:
            first = self.failures[min(self.failures)]
            what = f"{counted(len(self.failures), 'image')} cannot be decoded"
            what += f", the first is message {first.row} at {first.log_time_ns} ns"
            action = "they are left out: the image before is used"
            found.append(Problem(what, self.topic, effect=first.reason, next=action))
        return found

    def leave_out(self, failure: Failure) -> None:
        """Add a message to `failures`."""
        if self._strict:
            row, time_ns, reason = failure
            raise LogError(f"{self.topic}: message {row} at {time_ns} ns: {reason}")
        self.failures[failure.row] = failure

    def _in_memory(self, wanted: NDArray[np.int64], places: NDArray[np.intp], like: Image) -> Image:
        """Return the images at `places` (N,) or (N, K), which are indexes of `wanted`."""
        stack = places.shape[1] if places.ndim > 1 else 1
        *edges, channels = like.shape
        try:
            found = np.empty((len(places), *edges, stack), as_pixels(like).dtype)
        except MemoryError as error:
            raise LogError(
                f"{self.topic}: the images need {size(places.size * like.nbytes)} of memory: set"
                " `resize` or `crop` in the mapping, or open the bag with images='mapped'"
            ) from error
        # Places of each message in the result, message by message.
        order = np.argsort(places, axis=None, kind="stable")
        bounds = np.searchsorted(places.ravel()[order], np.arange(len(wanted) + 1))
        for rows, images in self.blocks(wanted, like.shape, like.dtype, 1):
            k = int(np.searchsorted(wanted, rows[0]))
            frames = order[bounds[k] : bounds[k + 1]]
            if stack == 1:
                for frame in frames.tolist():
                    found[frame, ..., 0] = as_pixels(images[0])
                continue
            frame, position = np.divmod(frames, stack)
            found[frame, :, :, position] = as_pixels(images[0])
        return found.view(like.dtype).reshape(len(places), *edges, stack * channels)

    def _why_none(self, rows: NDArray[np.int64]) -> str:
        first = self.failures[int(rows[0])]
        if len(rows) == 1:
            return first.reason
        return (
            f"none of the {len(rows)} images can be decoded; message {first.row} at"
            f" {first.log_time_ns} ns: {first.reason}"
        )

    def _images(self, rows: NDArray[np.int64]) -> Iterator[tuple[int, Image]]:
        """Yield the messages with readable images: index in the topic, and pixels."""
        at, count = 0, 1
        while at < len(rows):
            block = rows[at : at + count]
            largest = 1
            for row, message in self._messages(block):
                if isinstance(message, Failure):
                    self.leave_out(message)
                    continue
                largest = max(largest, _length(message["data"]))
                try:
                    # The full image is not kept: the next one is decoded into the same memory.
                    image = self.options.applied(self._decoded(message))
                except LogError as error:
                    time_ns = int(self.bag.times(self.topic)[row])
                    self.leave_out(Failure(row, time_ns, str(error)))
                    continue
                yield row, image
            at, count = at + len(block), min(_BLOCK_ROWS, max(1, _BLOCK_BYTES // largest))

    def _messages(self, rows: NDArray[np.int64]) -> Iterator[tuple[int, dict[str, Any] | Failure]]:
        """Yield the fields of each message, or why the message cannot be decoded."""
        found = self.bag.read(self.topic, self._fields, rows)
        messages: dict[int, dict[str, Any] | Failure] = {each.row: each for each in found.failures}
        for k, row in enumerate(found.rows.tolist()):
            messages[row] = {name: column[k] for name, column in found.columns.items()}
        yield from sorted(messages.items(), key=lambda each: each[0])

    def _decoded(self, message: dict[str, Any]) -> Pixels:
        kind = str(message["encoding" if "encoding" in message else "format"])
        if is_video(kind):
            raise UsageError(
                f"{self.topic} has video ({one_line(kind)}): video topics are not supported"
                " yet; convert it to JPEG images (sensor_msgs/msg/CompressedImage)"
            )
        if "encoding" in message:
            return raw_pixels({**message, "data": _bytes_of(message["data"])})
        try:
            return compressed_pixels(kind, _bytes_of(message["data"]))
        except LogError as error:
            raise LogError(
                f"a compressed image ({one_line(kind)}) cannot be read: {error}"
            ) from error


def _image_fields(bag: Bag, topic: TopicInfo) -> tuple[str, ...]:
    """Return the fields of an image message to read."""
    if is_video(topic.type_name):
        raise UsageError(
            f"{topic.name} has video ({topic.type_name}): video topics are not supported yet;"
            " convert it to JPEG images (sensor_msgs/msg/CompressedImage)"
        )
    every = (*_RAW_FIELDS, _BIG_ENDIAN, *_COMPRESSED_FIELDS)
    known = {name.split("[")[0] for name in topic.fields}
    if not topic.fields and topic.count:
        # JSON without a schema: the first message shows the fields.
        columns = bag.read(topic.name, every, np.zeros(1, np.int64)).columns
        known = {name for name, column in columns.items() if _is_given(column)}
    if known.issuperset(_RAW_FIELDS):
        return (*_RAW_FIELDS, *({_BIG_ENDIAN} & known))
    if known.issuperset(_COMPRESSED_FIELDS):
        return _COMPRESSED_FIELDS
    raise UsageError(
        f"{topic.name} has {topic.type_name}, not images: expected sensor_msgs/Image or"
        " CompressedImage, or foxglove.RawImage or CompressedImage"
    )


def _length(data: Any) -> int:
    return len(data) if isinstance(data, bytes | str) else int(np.size(data))


def _bytes_of(data: Any) -> bytes:
    """Return the bytes of an image; in JSON, they are base64 or a list of numbers."""
    if isinstance(data, bytes):
        return data
    try:
        if isinstance(data, str):
            return base64.b64decode(data, validate=True)
        values = np.asarray(data)
        if values.ndim == 1 and values.dtype.kind in "iu" and not (values & ~0xFF).any():
            return values.astype(np.uint8).tobytes()
    except ValueError as error:
        raise LogError(f"the data of the image cannot be read: {error}") from error
    raise LogError("the data of the image are not bytes")


def _is_given(column: NDArray[Any]) -> bool:
    """Return whether the first message has the field."""
    value = column[0] if len(column) else None
    return value is not None and not (isinstance(value, float) and math.isnan(value))
