"""Options of a mapping for images: crop, size, gray, and what 16 bits and floats mean.

Colors become uint8 (H, W, 3) or, if gray, (H, W, 1). Depth becomes float32 meters (H, W, 1), with
the value 0 where there is no surface, or uint8 if the mapping sets `range_m`. With `as: intensity`,
images of 16 bits or floats become float32 (H, W, 1) with the values of the messages, or uint8 if
the mapping sets `range`; values that are not finite become 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import UsageError, import_extra
from mcaprl.recorder.dataset.images import Frames
from mcaprl.recorder.mapping.config import Quantity
from mcaprl.recorder.mapping.images.pixels import Pixels, one_line

Image = NDArray[Any]

_GRAY_WEIGHTS = np.array([0.299, 0.587, 0.114])
"""ITU-R BT.601 weights of red, green and blue."""


class ImageOptions:
    """Options of an image quantity.

    Attributes:
        ambiguous: Encoding of images that were read as depth, although it does not say that they
            are; empty if there were none.
    """

    def __init__(self, topic: str, quantity: Quantity) -> None:
        """Store the options; `topic` is for error messages."""
        self._topic, self._quantity = topic, quantity
        self.ambiguous = ""

    def to_json(self) -> str:
        """Return the options that determine the pixels."""
        names = {"crop", "resize", "gray", "range_m", "range", "as_"}
        return self._quantity.model_dump_json(include=names)

    def space(self, images: Frames) -> spaces.Box:
        """Return the space of one image or stack of images (N, H, W, C)."""
        if images.dtype == np.uint8:
            return spaces.Box(0, 255, images.shape[1:], np.uint8)
        low = -np.inf if self._quantity.as_ == "intensity" else 0.0
        return spaces.Box(low, np.inf, images.shape[1:], np.float32)

    def applied(self, pixels: Pixels) -> Image:
        """Return the image (H, W, C) of an observation."""
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
        """Return whether the pixels are read as depth."""
        wanted, kind = self._quantity.as_, one_line(pixels.encoding)
        if wanted == "intensity":
            return False
        if pixels.has_lost_depth:
            raise UsageError(
                f"{self._topic}: images '{kind}' have 8 bits per pixel and have lost the depth: use"
                " a raw, PNG or compressedDepth topic, or `as: intensity` to read them as gray"
            )
        if not pixels.units_per_m:
            key = "range_m" if self._quantity.range_m is not None else f"as: {wanted}"
            if key == "range_m" or wanted is not None:
                raise UsageError(
                    f"{self._topic}: images '{kind}' are not depth: remove {key} from the mapping"
                )
            return False
        if not pixels.is_certain and wanted is None and self._quantity.range_m is None:
            self.ambiguous = kind
        return True

    def _cropped(self, image: Any, left: int, top: int, width: int, height: int) -> Any:
        full_width, full_height = _size(image)
        if min(left, top) < 0 or left + width > full_width or top + height > full_height:
            raise UsageError(
                f"{self._topic}: crop {[left, top, width, height]} is outside of the image of"
                f" {full_width} x {full_height} pixels"
            )
        if isinstance(image, np.ndarray):
            return image[top : top + height, left : left + width]
        return image.crop((left, top, left + width, top + height))


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
