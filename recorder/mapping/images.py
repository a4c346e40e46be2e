"""Images of a bag as observations: decoded, cropped, resized and converted to gray.

Raw and compressed images of ROS and Foxglove are supported; see `pixels` and `compressed`. Colors
become uint8 (H, W, 3) or, if gray, (H, W, 1). Depth becomes float32 meters (H, W, 1), with the
value 0 where there is no surface, or uint8 if the mapping sets `range_m`. With `as: intensity`,
images of 16 bits or floats become float32 (H, W, 1) with the values of the messages, or uint8 if
the mapping sets `range`; values that are not finite become 0.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, UsageError, import_extra
from mcaprl.problem import Problem
from mcaprl.recorder.bags.bag import Bag, Failure, TopicInfo
from mcaprl.recorder.dataset.image_cache import Storage, is_mapped
from mcaprl.recorder.dataset.mapped import Frames
from mcaprl.recorder.mapping.compressed import compressed_pixels, is_video
from mcaprl.recorder.mapping.config import Quantity
from mcaprl.recorder.mapping.image_copy import copied_images
from mcaprl.recorder.mapping.pixels import Pixels, raw_pixels
from mcaprl.texts import counted, shortened, size

Image = NDArray[Any]

_BLOCK_ROWS, _BLOCK_BYTES = 32, 1 << 24
"""Largest number and size of the messages that are in memory at a time."""
_GRAY_WEIGHTS = np.array([0.299, 0.587, 0.114])
"""ITU-R BT.601 weights of red, green and blue."""
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
        """Find out whether the images are raw or compressed.

        Args:
            bag: Bag that has the topic.
            topic: Topic of the images.
            quantity: Options of the mapping.
            name: Name of the quantity.
            strict: Whether an image that cannot be decoded is an error.

        Raises:
            UsageError: The topic has no images.
        """
        self.bag, self.topic, self.name = bag, topic, name
        self._quantity, self._strict = quantity, strict
        self._fields = _image_fields(bag, bag.topics[topic])
        self.failures: dict[int, Failure] = {}
        self._ambiguous = ""

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

        Raises:
            LogError: No image can be decoded, or sizes differ; if the reader is strict: an image
                cannot be decoded.
            UsageError: The options of the mapping do not fit the images.
        """
        wanted, places = np.unique(rows, return_inverse=True)
        first = next(self._images(wanted), None)
        if first is None:
            raise LogError(f"{self.topic}: {self._why_none(wanted)}")
        image = first[1]
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

        Args:
            rows: Ascending positions of messages in the topic.
            shape: Expected shape of an image.
            dtype: Expected dtype.
            count: Largest number of images in a block.

        Raises:
            LogError: An image has another shape or dtype.
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
        """Return the space of one image or stack."""
        if images.dtype == np.uint8:
            return spaces.Box(0, 255, images.shape[1:], np.uint8)
        low = -np.inf if self._quantity.as_ == "intensity" else 0.0
        return spaces.Box(low, np.inf, images.shape[1:], np.float32)

    def problems(self) -> list[Problem]:
        """Return problems of the images that `read` decoded."""
        found = []
        if self._ambiguous:
            what = f"images '{self._ambiguous}' are read as depth, but may have other values"
            action = "set `as: depth`, or `as: intensity` for infrared and thermal images"
            found.append(Problem(what, self.topic, next=action))
        if self.failures:
            first = self.failures[min(self.failures)]
            what = f"{counted(len(self.failures), 'image')} cannot be decoded"
            what += f", the first is message {first.row} at {first.log_time_ns} ns"
            action = "they are left out: the image before is used"
            found.append(Problem(what, self.topic, effect=first.reason, next=action))
        return found

    @property
    def options(self) -> str:
        """Options of the mapping that determine the pixels, as JSON."""
        names = {"crop", "resize", "gray", "range_m", "range", "as_"}
        return self._quantity.model_dump_json(include=names)

    def leave_out(self, failure: Failure) -> None:
        """Add a message to `failures`.

        Raises:
            LogError: The reader is strict.
        """
        if self._strict:
            row, time_ns, reason = failure
            raise LogError(f"{self.topic}: message {row} at {time_ns} ns: {reason}")
        self.failures[failure.row] = failure

    def _in_memory(self, wanted: NDArray[np.int64], places: NDArray[np.intp], like: Image) -> Image:
        """Return the images at `places` (N,) or (N, K), which are indexes of `wanted`."""
        stack = places.shape[1] if places.ndim > 1 else 1
        *edges, channels = like.shape
        try:
            found = np.empty((len(places), *edges, stack, channels), like.dtype)
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
            frame, position = np.divmod(order[bounds[k] : bounds[k + 1]], stack)
            found[frame, :, :, position] = images[0]
        return found.reshape(len(places), *edges, stack * channels)

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
                data = message["data"]
                largest = max(largest, len(data) if data is not None else 1)
                try:
                    pixels = self._decoded(message)
                except LogError as error:
                    time_ns = int(self.bag.times(self.topic)[row])
                    self.leave_out(Failure(row, time_ns, str(error)))
                    continue
                yield row, self._prepared(pixels)
            at, count = at + len(block), min(_BLOCK_ROWS, max(1, _BLOCK_BYTES // largest))

    def _messages(
        self, rows: NDArray[np.int64]
    ) -> Iterator[tuple[int, dict[str, Any] | Failure]]:
        """Yield the fields of each message, or why the message cannot be decoded."""
        reason = "the message cannot be decoded"
        try:
            columns = self.bag.read(self.topic, self._fields, rows).columns
            is_complete = all(len(column) == len(rows) for column in columns.values())
        except LogError as error:
            is_complete, reason = False, str(error)
        if is_complete:
            for k, row in enumerate(rows.tolist()):
                yield row, {name: column[k] for name, column in columns.items()}
        elif len(rows) == 1:
            row = int(rows[0])
            yield row, Failure(row, int(self.bag.times(self.topic)[row]), reason)
        else:
            for k in range(len(rows)):
                yield from self._messages(rows[k : k + 1])

    def _decoded(self, message: dict[str, Any]) -> Pixels:
        data = message["data"]
        try:
            data = base64.b64decode(data, validate=True) if isinstance(data, str) else bytes(data)
        except (TypeError, ValueError) as error:
            raise LogError(f"the image has no bytes: {error}") from error
        kind = str(message["encoding" if "encoding" in message else "format"])
        if is_video(kind):
            raise UsageError(
                f"{self.topic} has video ({shortened(kind, 40)}): video topics are not supported"
                " yet; convert it to JPEG images (sensor_msgs/msg/CompressedImage)"
            )
        if "encoding" in message:
            return raw_pixels({**message, "data": data})
        try:
            return compressed_pixels(kind, data)
        except LogError as error:
            raise LogError(
                f"a compressed image ({shortened(kind, 40)}) cannot be read: {error}"
            ) from error

    def _prepared(self, pixels: Pixels) -> Image:
        quantity, is_depth = self._quantity, self._is_depth(pixels)
        image, is_number = pixels.image, pixels.units_per_m > 0
        if is_number:
            image = _meters(image, pixels.units_per_m) if is_depth else _finite(image)
        if quantity.crop is not None:
            image = self._cropped(image, *quantity.crop)
        if quantity.resize is not None:
            image = _resized(image, *quantity.resize, is_depth=is_depth)
        values: Image = np.asarray(image)
        if quantity.gray and values.ndim == 3:
            values = np.rint(values @ _GRAY_WEIGHTS).astype(np.uint8)
        limits = quantity.range_m if is_depth else quantity.range
        if limits is not None:
            share = np.clip((values - limits[0]) / (limits[1] - limits[0]), 0.0, 1.0)
            codes = np.rint(255 * share)
            # Pixels without a surface get the largest value, as in the depth images of the sims.
            values = (np.where(values > 0, codes, 255) if is_depth else codes).astype(np.uint8)
        return values if values.ndim == 3 else values[..., np.newaxis]

    def _is_depth(self, pixels: Pixels) -> bool:
        """Return whether the pixels are read as depth.

        Raises:
            UsageError: The mapping says that they are, but they have 8 bits.
        """
        wanted, kind = self._quantity.as_, shortened(pixels.encoding, 40)
        if wanted == "intensity":
            return False
        if pixels.has_lost_depth:
            raise UsageError(
                f"{self.topic}: images '{kind}' have 8 bits per pixel, so they have lost the depth:"
                " use a raw, PNG or compressedDepth topic, or `as: intensity` to read them as gray"
            )
        if not pixels.units_per_m:
            for key in ("range_m", "as: depth"):
                if self._quantity.range_m is not None if key == "range_m" else wanted == "depth":
                    raise UsageError(
                        f"{self.topic}: images '{kind}' are not depth: remove {key} from the mapping"
                    )
            return False
        if not pixels.is_certain and wanted is None and self._quantity.range_m is None:
            self._ambiguous = kind
        return True

    def _cropped(self, image: Any, left: int, top: int, width: int, height: int) -> Any:
        full_width, full_height = _size(image)
        if min(left, top) < 0 or left + width > full_width or top + height > full_height:
            raise UsageError(
                f"{self.topic}: crop {[left, top, width, height]} is outside of the image of"
                f" {full_width} x {full_height} pixels"
            )
        if isinstance(image, np.ndarray):
            return image[top : top + height, left : left + width]
        return image.crop((left, top, left + width, top + height))


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


def _is_given(column: NDArray[Any]) -> bool:
    """Return whether the first message has the field."""
    value = column[0] if len(column) else None
    return value is not None and value == value


def _meters(depth: Image, units_per_m: float) -> Image:
    meters = depth.astype(np.float32)
    if units_per_m != 1:
        # A division, unlike a multiplication by 0.001, is exact to the last bit: 1500 is 1.5.
        meters /= np.float32(units_per_m)
    return np.where(np.isfinite(meters) & (meters > 0), meters, np.float32(0))


def _finite(image: Image) -> Image:
    values = image.astype(np.float32)
    return np.where(np.isfinite(values), values, np.float32(0))


def _size(image: Any) -> tuple[int, int]:
    """Return width and height of a Pillow image or a NumPy array."""
    if isinstance(image, np.ndarray):
        return image.shape[1], image.shape[0]
    width, height = image.size
    return width, height


def _resized(image: Any, width: int, height: int, *, is_depth: bool) -> Any:
    """Resize an image by averaging.

    Depth is resized by the nearest pixel: the mean of two depths may not be on any surface.
    """
    if _size(image) == (width, height):
        return image
    pillow = import_extra("PIL.Image", "bags")
    method = pillow.Resampling.NEAREST if is_depth else pillow.Resampling.BOX
    image = pillow.fromarray(image) if isinstance(image, np.ndarray) else image
    return image.resize((width, height), method)
