"""Rectification of images by their camera's calibration, as `image_proc` does it in ROS.

A pixel of the rectified image is the ray through it in the camera of P, turned back by R, and
distorted by the model of D; K gives its place in the image that was recorded. The models are
those of OpenCV: `plumb_bob` (D has 4 or 5 numbers), `rational_polynomial` (8) and `equidistant`
(4), which is also called `fisheye` (https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, UsageError
from mcaprl.limits import MAX_IMAGE_PIXELS
from mcaprl.recorder.bags.bag import Bag, TopicInfo
from mcaprl.recorder.bags.values import value_at

Floats = NDArray[np.float64]

_COUNTS: Final = {
    "plumb_bob": (4, 5),
    "rational_polynomial": (8,),
    "equidistant": (4,),
    "fisheye": (4,),
}
_FIELDS: Final = ("width", "height", "distortion_model")


class Calibration(NamedTuple):
    """Calibration of a camera, as in CameraInfo.

    Attributes:
        width: Width of the images, pixels.
        height: Height of the images, pixels.
        model: Distortion model.
        d: Parameters of the model.
        k: (3, 3) intrinsics of the recorded images.
        r: (3, 3) rotation to the rectified camera.
        p: (3, 3) intrinsics of the rectified images.
    """

    width: int
    height: int
    model: str
    d: Floats
    k: Floats
    r: Floats
    p: Floats

    @classmethod
    def of(cls, bag: Bag, topic: str) -> Calibration:
        """Read the calibration of a CameraInfo or CameraCalibration topic.

        Raises:
            LogError: The topic has no message, or its calibration changes.
            UsageError: There is no such topic, or it has no calibration that can be used.
        """
        if topic not in bag.topics:
            raise UsageError(f"undistort: the bag has no topic {topic}")
        info, fields = bag.topics[topic], calibration_fields(bag.topics[topic])
        ends = np.unique([0, max(0, info.count - 1)])
        found = bag.read(topic, fields, ends if info.count else ends[:0]).columns
        count = len(found["width"])
        if not count:
            raise LogError(f"undistort: {topic} has no message that can be read")
        first, last = (
            cls.parsed(topic, *(found[name][row] for name in fields)) for row in (0, count - 1)
        )
        if str(first) != str(last):
            raise LogError(f"undistort: the calibration on {topic} changes: split the bag")
        return first

    @classmethod
    def parsed(cls, topic: str, width: Any, height: Any, kind: Any, *arrays: Any) -> Calibration:
        """Return the calibration of the values of `calibration_fields`.

        Raises:
            UsageError: It cannot be used.
        """
        try:
            d, k, r, p = (np.asarray(each, np.float64).ravel() for each in arrays)
            width, height, sizes = int(width), int(height), (len(k), len(r), len(p))
        except (TypeError, ValueError, OverflowError) as error:
            raise UsageError(f"undistort: {topic} has no calibration: {error}") from error
        if sizes != (9, 9, 12) or not 0 < width * height <= MAX_IMAGE_PIXELS or width < 0:
            raise UsageError(
                f"undistort: {topic} has {', '.join(map(str, sizes))} numbers in K, R and P for"
                f" {width} x {height} pixels; expected 9, 9 and 12, for at most"
                f" {MAX_IMAGE_PIXELS} pixels"
            )
        model = str(kind)
        # Without a model, the images are not distorted.
        counts = _COUNTS.get(model, (0,) if not model else ())
        if len(d) not in (0, *counts) or not counts:
            raise UsageError(
                f"undistort: {topic} has the model '{model:.40}' with {len(d)} numbers; supported:"
                f" {', '.join(_COUNTS)}"
            )
        camera, turn = k.reshape(3, 3), r.reshape(3, 3) if r.any() else np.eye(3)
        wanted = p.reshape(3, 4)[:, :3] if p.any() else camera
        if not min(camera[0, 0], camera[1, 1], wanted[0, 0], wanted[1, 1]) > 0:
            raise UsageError(
                f"undistort: the camera of {topic} is not calibrated: K is {camera.tolist()}"
            )
        return cls(width, height, model, d, camera, turn, wanted)

    def places(self) -> tuple[Floats, Floats]:
        """Return where the pixels of the rectified image are in the recorded one: x, y (H, W)."""
        u, v = np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float))
        ray = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(self.p @ self.r).T
        with np.errstate(all="ignore"):
            x, y = ray[..., 0] / ray[..., 2], ray[..., 1] / ray[..., 2]
        x, y = (_fisheye if self.model in ("equidistant", "fisheye") else _polynomial)(x, y, self.d)
        k = self.k
        return k[0, 0] * x + k[0, 1] * y + k[0, 2], k[1, 1] * y + k[1, 2]


def calibration_fields(info: TopicInfo) -> tuple[str, ...]:
    """Return the fields of a topic with the calibration: size, model, D, K, R and P."""
    names = "dkrp" if info.may_have("k") and not info.may_have("K") else "DKRP"
    if not all(map(info.may_have, (*_FIELDS, *names))):
        raise UsageError(f"undistort: {info.name} has {info.type_name}, not CameraInfo")
    return (*_FIELDS, *names)


class HeldCalibration:
    """Calibration of a camera that is running: that of the first message.

    Attributes:
        fields: Fields of a message that are used.
        rectifier: Rectification of the images; None before the first message.
    """

    def __init__(self, topics: Mapping[str, TopicInfo], topic: str) -> None:
        """Find the fields of the topic."""
        if topic not in topics:
            raise UsageError(f"undistort: the type of {topic} is not known: train again")
        self.fields, self._topic = calibration_fields(topics[topic]), topic
        self.rectifier: Rectifier | None = None
        self._held: Calibration | None = None
        self._key: Any = None

    def push(self, message: Any) -> None:
        """Use a message.

        Raises:
            UsageError: It has no calibration, or another one than the first message.
        """
        values = [value_at(message, name) for name in self.fields]
        key = [each.tobytes() if isinstance(each, np.ndarray) else each for each in values]
        if key == self._key:
            return
        found = Calibration.parsed(self._topic, *values)
        if self._held is None:
            self._held, self.rectifier = found, Rectifier(found)
        elif str(found) != str(self._held):
            raise UsageError(
                f"undistort: the calibration on {self._topic} changes: start again with the new one"
            )
        self._key = key


def _polynomial(x: Floats, y: Floats, d: Floats) -> tuple[Floats, Floats]:
    """Return distorted coordinates by OpenCV's model of up to 8 parameters."""
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(d, (0, 8 - len(d)))
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def _fisheye(x: Floats, y: Floats, d: Floats) -> tuple[Floats, Floats]:
    """Return distorted coordinates by the equidistant model, for rays at an angle theta."""
    k1, k2, k3, k4 = np.pad(d, (0, 4 - len(d)))
    r = np.hypot(x, y)
    theta = np.arctan(r)
    t2 = theta * theta
    distorted = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    scale = np.divide(distorted, r, out=np.ones_like(r), where=r > 0)
    return x * scale, y * scale


class Rectifier:
    """Rectification of the images of one camera; what the camera did not see is 0."""

    def __init__(self, calibration: Calibration) -> None:
        """Compute the place of each pixel."""
        self._size = (calibration.height, calibration.width)
        x, y = calibration.places()
        self._nearest = self._corner(np.rint(x), np.rint(y))
        left, top = np.floor(x), np.floor(y)
        right, low = x - left, y - top
        # Places and weights of the four pixels around each place.
        self._corners = [
            (*self._corner(left + dx, top + dy), np.abs(1 - dx - right) * np.abs(1 - dy - low))
            for dy in (0, 1)
            for dx in (0, 1)
        ]

    def _corner(self, x: Floats, y: Floats) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Return indexes of pixels, and which of them are in the image."""
        height, width = self._size
        # Comparisons with NaN, from rays behind the camera, are false.
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        flat = np.where(inside, y, 0) * width + np.where(inside, x, 0)
        return flat.astype(np.intp), inside

    def rectified(self, image: NDArray[Any], *, nearest: bool) -> NDArray[Any]:
        """Return the rectified image (H, W) or (H, W, C).

        Args:
            image: Recorded image.
            nearest: Whether to take the nearest pixel instead of averaging four; for depth.

        Raises:
            LogError: The image has another size than the calibration.
        """
        if image.shape[:2] != self._size:
            height, width = self._size
            raise LogError(
                f"the image has {image.shape[1]} x {image.shape[0]} pixels, but its calibration is"
                f" for {width} x {height}: remove `undistort`"
            )
        pixels = image.reshape(-1, *image.shape[2:])
        axes = (..., np.newaxis) if image.ndim > 2 else (...,)
        if nearest:
            places, inside = self._nearest
            return np.where(inside[axes], pixels[places], 0).astype(image.dtype)
        total = np.zeros(image.shape)
        for places, inside, weights in self._corners:
            total += np.where(inside, weights, 0.0)[axes] * pixels[places]
        return (np.rint(total) if image.dtype.kind in "iu" else total).astype(image.dtype)
