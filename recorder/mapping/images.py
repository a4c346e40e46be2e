"""Images of a bag as observations: decoded, cropped, resized and converted to gray.

Raw `sensor_msgs/Image` messages of the encodings in `_RAW` and compressed images of every format
that Pillow reads are supported. Colors become uint8 (H, W, 3) or, if gray, (H, W, 1). Depth
becomes float32 meters (H, W, 1), with the value 0 where there is no surface. If the mapping sets
`range_m`, depth becomes uint8 instead.
"""

from __future__ import annotations

import struct
from io import BytesIO
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, UsageError, import_extra
from mcaprl.recorder.bags.bag import Bag, TopicInfo
from mcaprl.recorder.mapping.config import Quantity

Image = NDArray[Any]

_BLOCK_ROWS = 32
_GRAY_WEIGHTS = np.array([0.299, 0.587, 0.114])
"""ITU-R BT.601 weights of red, green and blue."""
# Raw encodings: channels per pixel, dtype, and channel indexes of red, green and blue.
_RAW: dict[str, tuple[int, str, tuple[int, ...]]] = {
    "rgb8": (3, "u1", (0, 1, 2)),
    "bgr8": (3, "u1", (2, 1, 0)),
    "rgba8": (4, "u1", (0, 1, 2)),
    "bgra8": (4, "u1", (2, 1, 0)),
    "8UC3": (3, "u1", (2, 1, 0)),
    "mono8": (1, "u1", (0,)),
    "8UC1": (1, "u1", (0,)),
    "mono16": (1, "u2", (0,)),
    "16UC1": (1, "u2", (0,)),
    "32FC1": (1, "f4", (0,)),
}
_METERS_PER_UNIT = {"16UC1": 1e-3, "mono16": 1e-3, "32FC1": 1.0}
"""Depth encodings (REP 118), with their units in meters."""
# compressed_depth_image_transport puts format, A and B before the PNG.
_DEPTH_HEADER = struct.Struct("<iff")
_RAW_FIELDS = ("height", "width", "encoding", "is_bigendian", "step", "data")
_COMPRESSED_FIELDS = ("format", "data")


class ImageReader:
    """Reader that decodes, crops and resizes the images of one topic as a mapping specifies."""

    def __init__(self, bag: Bag, topic: str, quantity: Quantity) -> None:
        """Find out whether the images are raw or compressed.

        Raises:
            UsageError: The topic has no images.
        """
        self._bag, self.topic, self._quantity = bag, topic, quantity
        self._fields = _image_fields(bag.topics[topic])

    def read(self, rows: NDArray[np.int64]) -> Image:
        """Return the images of N messages as (N, H, W, C); repeated messages are decoded only once.

        Args:
            rows: (N,) positions of the messages in the topic.

        Raises:
            LogError: An image is damaged or of an unknown encoding, or sizes differ.
        """
        wanted, places = np.unique(rows, return_inverse=True)
        found: Image | None = None
        for first in range(0, len(wanted), _BLOCK_ROWS):
            block = wanted[first : first + _BLOCK_ROWS]
            columns = self._bag.read(self.topic, self._fields, block).columns
            for k in range(len(block)):
                message = {name: column[k] for name, column in columns.items()}
                image = self._prepared(self._decoded(message))
                if found is None:
                    found = np.empty((len(wanted), *image.shape), image.dtype)
                if image.shape != found.shape[1:] or image.dtype != found.dtype:
                    raise LogError(
                        f"{self.topic}: image {block[k]} is {image.shape} {image.dtype}, but the"
                        f" first is {found.shape[1:]} {found.dtype}: set `resize` in the mapping"
                    )
                found[first + k] = image
        assert found is not None, "there is at least one image"
        return found if len(places) == len(wanted) and (np.diff(rows) > 0).all() else found[places]

    def space(self, images: Image) -> spaces.Box:
        """Return the space of one image."""
        if images.dtype == np.uint8:
            return spaces.Box(0, 255, images.shape[1:], np.uint8)
        return spaces.Box(0.0, np.inf, images.shape[1:], np.float32)

    def _decoded(self, message: dict[str, Any]) -> Any:
        """Return colors or gray as a uint8 image (Pillow or NumPy), or depth as float32 meters."""
        if "encoding" in message:
            return _raw_image(self.topic, message)
        return _compressed_image(self.topic, str(message["format"]), bytes(message["data"]))

    def _prepared(self, image: Any) -> Image:
        quantity = self._quantity
        if quantity.crop is not None:
            image = self._cropped(image, *quantity.crop)
        if quantity.resize is not None:
            image = _resized(image, *quantity.resize)
        pixels: Image = np.asarray(image)
        if quantity.gray and pixels.ndim == 3:
            pixels = np.rint(pixels @ _GRAY_WEIGHTS).astype(np.uint8)
        if quantity.range_m is not None and pixels.dtype == np.float32:
            low, high = quantity.range_m
            share = np.clip((pixels - low) / (high - low), 0.0, 1.0)
            # Pixels without a surface get the largest value, as in the depth images of the sims.
            pixels = np.where(pixels > 0, np.rint(255 * share), 255).astype(np.uint8)
        return pixels if pixels.ndim == 3 else pixels[..., np.newaxis]

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


def _image_fields(topic: TopicInfo) -> tuple[str, ...]:
    known = {name.split("[")[0] for name in topic.fields}
    for fields in (_RAW_FIELDS, _COMPRESSED_FIELDS):
        if known.issuperset(fields):
            return fields
    raise UsageError(
        f"{topic.name} has {topic.type_name}, not images: expected sensor_msgs/Image or"
        " CompressedImage"
    )


def _raw_image(topic: str, message: dict[str, Any]) -> Image:
    encoding = str(message["encoding"])
    if encoding not in _RAW:
        raise LogError(f"{topic}: encoding '{encoding}'; supported: {', '.join(_RAW)}")
    channels, code, order = _RAW[encoding]
    height, width, step = (int(message[name]) for name in ("height", "width", "step"))
    dtype = np.dtype(code).newbyteorder(">" if message["is_bigendian"] else "<")
    used = width * channels * dtype.itemsize
    data = np.frombuffer(bytes(message["data"]), np.uint8)
    if step < used or len(data) < step * height or not height * width:
        raise LogError(
            f"{topic}: an image of {width} x {height} {encoding} with {step} bytes per row has"
            f" {len(data)} bytes, which do not match"
        )
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :used])
    pixels = rows.view(dtype).reshape(height, width, channels)[..., list(order)]
    if encoding in _METERS_PER_UNIT:
        return _meters(pixels[..., 0], _METERS_PER_UNIT[encoding])
    return pixels if channels > 1 else pixels[..., 0]


def _compressed_image(topic: str, kind: str, data: bytes) -> Any:
    """Return colors or gray as a Pillow image, or depth as float32 meters."""
    pillow = import_extra("PIL.Image", "bags")
    is_depth = "compressedDepth" in kind
    try:
        image = pillow.open(BytesIO(data[_DEPTH_HEADER.size :] if is_depth else data))
        image.load()
        if is_depth and kind.startswith("32FC1"):
            return _meters_of_code(np.asarray(image), data)
        if image.mode in ("I;16", "I", "F"):
            return _meters(np.asarray(image), 1.0 if image.mode == "F" else 1e-3)
        wanted = "L" if image.mode in ("L", "1") else "RGB"
        # Do not convert an image that has this mode, because the conversion would copy it.
        return image if image.mode == wanted else image.convert(wanted)
    # Pillow raises errors of many types for damaged images.
    except Exception as error:
        raise LogError(f"{topic}: a compressed image ({kind}) cannot be read: {error}") from error


def _meters_of_code(code: Image, data: bytes) -> Image:
    """Return the depth of a coded float image.

    compressed_depth_image_transport stores the integer part of A / depth + B, or 0 where there is
    no depth.
    """
    _, a, b = _DEPTH_HEADER.unpack_from(data)
    with np.errstate(divide="ignore"):
        depth = a / (code.astype(np.float64) - b)
    return _meters(np.where(code > 0, depth, 0.0), 1.0)


def _meters(depth: Image, unit_m: float) -> Image:
    meters = depth.astype(np.float32) * np.float32(unit_m)
    return np.where(np.isfinite(meters) & (meters > 0), meters, np.float32(0))


def _size(image: Any) -> tuple[int, int]:
    """Return width and height of a Pillow image or a NumPy array."""
    if isinstance(image, np.ndarray):
        return image.shape[1], image.shape[0]
    width, height = image.size
    return width, height


def _resized(image: Any, width: int, height: int) -> Any:
    """Resize an image by averaging.

    Depth is resized by the nearest pixel: the mean of two depths may not be on any surface.
    """
    if _size(image) == (width, height):
        return image
    pillow = import_extra("PIL.Image", "bags")
    is_array = isinstance(image, np.ndarray)
    is_depth = is_array and image.dtype == np.float32
    method = pillow.Resampling.NEAREST if is_depth else pillow.Resampling.BOX
    return (pillow.fromarray(image) if is_array else image).resize((width, height), method)
