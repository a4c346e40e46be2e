"""Images of a bag as observations, in memory or in a copy on disk.

Colors become uint8 (H, W, 3) or, if gray, (H, W, 1). Depth becomes float32 meters (H, W, 1), with
the value 0 where there is no surface, or uint8 if the mapping sets `range_m`. With `as: intensity`,
images of 16 bits or floats become float32 (H, W, 1) with the values of the messages, or uint8 if
the mapping sets `range`; values that are not finite become 0.

The copy is beside the first file of the bag, `BAG.NAME.images`, where NAME is the name of the
quantity. It is an MCAP file whose log_times are the positions of the messages in their topic. It is
used again as long as the files of the bag and the options of the image are the same.

`image_pixels` decodes raw and compressed images of ROS and Foxglove.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import LogError, Problem, UsageError, import_extra
from mcaprl.files import parse_json
from mcaprl.recorder.bags.bag import Bag, Failure, TopicInfo
from mcaprl.recorder.bags.values import converted, kind_at, value_at
from mcaprl.recorder.dataset.images import (
    CACHE_NOTES,
    Blocks,
    Frames,
    MappedImages,
    Storage,
    as_pixels,
    cache_path,
    is_mapped,
    mapped_images,
    open_cache,
    write_cache,
)
from mcaprl.recorder.dataset.packets import Packets
from mcaprl.recorder.dataset.video import (
    NO_FRAME,
    Converter,
    Message,
    VideoDecoder,
    VideoStream,
)
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.format.schema import IMAGES_PER_CHUNK
from mcaprl.recorder.format.spaces import IMAGE_ENCODINGS, MAX_ELEMENTS, Leaf
from mcaprl.recorder.mapping.calibration import Calibration, Rectifier
from mcaprl.recorder.mapping.config import Quantity
from mcaprl.recorder.mapping.image_pixels import (
    Pixels,
    compressed_pixels,
    is_video,
    one_line,
    raw_pixels,
)
from mcaprl.recorder.mapping.spatial import Grid, fields_of, grid_image, grid_of, image_of
from mcaprl.texts import counted, size

Image = NDArray[Any]
_Decoded = TypeVar("_Decoded")

Decoded = Iterator[tuple[int, Image]]
"""Messages with readable images: index in the topic, and pixels."""

_GRAY_WEIGHTS = np.array([0.299, 0.587, 0.114])
"""ITU-R BT.601 weights of red, green and blue."""


class ImageOptions:
    """Options of an image quantity.

    Attributes:
        ambiguous: Encoding of images that were read as depth, although it does not say that they
            are; empty if there were none.
        is_intensity: Whether numbers are no depth.
        rectifier: Rectification of the images; None if there is none.
    """

    def __init__(self, topic: str, quantity: Quantity) -> None:
        """Store the options; `topic` is for error messages."""
        self._topic, self._quantity = topic, quantity
        self.rectifier: Rectifier | None = None
        self.ambiguous, self.is_intensity = "", quantity.as_ == "intensity"

    def to_json(self) -> str:
        """Return the options that determine the pixels."""
        names = {*_CHANGES}
        if self._quantity.image is None:
            names |= {"size", "x_m", "y_m", "z_m", "azimuth_deg", "elevation_deg", "unknown"}
            names |= {"outside", "field", "clip"}
        return self._quantity.model_dump_json(include=names)

    def image(self, message: dict[str, Any]) -> Image:
        """Return the image (H, W, C) of an observation for the fields of a message."""
        return self.applied(pixels_of(self._quantity, message))

    def grid(self, message: dict[str, Any]) -> Grid:
        """Return the grid in the fields of a message."""
        return grid_of(self._quantity, with_bytes(message))

    def around(self, grid: Grid, pose: NDArray[np.float64]) -> Image:
        """Return the image (H, W, 1) around the robot at x, y and, if it is given, yaw."""
        return grid_image(self._quantity, grid, pose)[..., np.newaxis]

    def applied(self, pixels: Pixels) -> Image:
        """Return the image (H, W, C) of an observation."""
        quantity, is_depth = self._quantity, self._is_depth(pixels)
        image, is_number = pixels.image, pixels.units_per_m > 0
        if is_number:
            image = _meters(image, pixels.units_per_m) if is_depth else _finite(image)
        if self.rectifier is not None:
            image = self.rectifier.rectified(np.asarray(image), nearest=is_depth)
        if quantity.crop is not None:
            image = self._cropped(image, *quantity.crop)
        if quantity.resize is not None:
            image = _resized(image, *quantity.resize, is_depth=is_depth)
        values: Image = np.asarray(image)
        if quantity.gray and values.ndim == 3:
            values = np.rint(values @ _GRAY_WEIGHTS).astype(np.uint8)
        limits = quantity.range_m if is_depth else quantity.range
        # The codes of a grid are in its range already.
        if limits is not None and quantity.grid is None:
            share = np.clip((values - limits[0]) / (limits[1] - limits[0]), 0.0, 1.0)
            codes = np.rint(255 * share)
            # Pixels without a surface get the largest value, as in the depth images of the sims.
            values = (np.where(values > 0, codes, 255) if is_depth else codes).astype(np.uint8)
        return values if values.ndim == 3 else values[..., np.newaxis]

    def _is_depth(self, pixels: Pixels) -> bool:
        """Return whether the pixels are read as depth."""
        wanted, kind = self._quantity.as_, one_line(pixels.encoding)
        if self._quantity.image is None:
            return pixels.units_per_m > 0
        if self.is_intensity:
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


_VERSION = "3"
"""Version of the decoders. It changes if they decode the same message to other pixels."""
_FAILURES, _REORDERED = "failures", "reordered"
_COPIED_BYTES = 1 << 20
"""Size of the images that are in memory at a time, but for one that is larger."""


def copied_images(
    reader: ImageReader, rows: NDArray[np.int64], like: NDArray[Any], images: Decoded
) -> MappedImages | None:
    """Return the images of messages from the copy on disk; write the copy if needed.

    Args:
        reader: Reader of the topic.
        rows: (N,) ascending positions of the messages in the topic.
        like: One of the images.
        images: The images of `rows`, which are decoded only if the copy is written.

    Returns:
        (N, H, W, C) images; None if one cannot be decoded.
    """
    encoding = IMAGE_ENCODINGS[like.shape[2]] if like.dtype == np.uint8 else "32FC1"
    leaf = Leaf(reader.name, (), like.shape, like.dtype, encoding)
    path = cache_path(reader.bag.paths[0], leaf)
    description = {
        "bag": _fingerprint(reader.bag.paths),
        "topic": reader.topic,
        "options": reader.options.to_json(),
        "image": f"{like.shape} {like.dtype}",
        "version": _VERSION,
    }
    found = _existing(reader, open_cache(path, description), leaf, rows)
    if found is None:
        _write(reader, path, description, leaf, len(rows), images)
        found = _existing(reader, open_cache(path, description), leaf, rows)
    if found is None:
        raise LogError(f"{path} was changed by another process: try again")
    return found if len(found) == len(rows) else None


def _existing(
    reader: ImageReader, cache: McapReader | None, leaf: Leaf, rows: NDArray[np.int64]
) -> MappedImages | None:
    """Return the images of a copy, without those that could not be decoded.

    The result is None if the copy is missing or damaged, or lacks other messages.
    """
    if cache is None:
        return None
    try:
        failed = _failures(cache, reader.bag.times(reader.topic))
        is_failed = np.isin(rows, [each.row for each in failed])
        found = mapped_images(cache, leaf, rows[~is_failed])
    except (LogError, ValueError, TypeError):
        return None
    if found is not None:
        reader.is_reordered |= _REORDERED in cache.metadata.get(CACHE_NOTES, {})
        for each in failed:
            reader.leave_out(each)
    return found


def _failures(cache: McapReader, times_ns: NDArray[np.int64]) -> list[Failure]:
    """Return the failures that a copy lists."""
    found = []
    for row, reason in parse_json(cache.metadata.get(CACHE_NOTES, {}).get(_FAILURES, "[]")):
        if not isinstance(row, int) or not 0 <= row < len(times_ns):
            raise ValueError(row)
        found.append(Failure(row, int(times_ns[row]), str(reason)))
    return found


def _write(
    reader: ImageReader,
    path: Path,
    description: dict[str, str],
    leaf: Leaf,
    count: int,
    images: Decoded,
) -> None:
    image_bytes = leaf.size * leaf.dtype.itemsize
    needed, notes = count * image_bytes, dict[str, str]()
    remedy = "set `resize`, `crop` or a lower rate in the mapping, or images='memory'"
    try:
        free = shutil.disk_usage(path.parent).free
    except OSError as error:
        raise LogError(f"cannot write {path}: {error.strerror}") from error
    if needed > free:
        raise LogError(
            f"cannot write {path}: the images need {size(needed)}, {size(free)} are free; {remedy}"
        )

    most = max(1, min(IMAGES_PER_CHUNK, _COPIED_BYTES // image_bytes))

    def blocks() -> Blocks:
        yield from reader.blocks(images, leaf.shape, leaf.dtype, most)
        if reader.failures:
            failed = [(each.row, each.reason) for each in reader.failures.values()]
            notes[_FAILURES] = json.dumps(failed)
        if reader.is_reordered:
            notes[_REORDERED] = ""

    try:
        write_cache(path, description, leaf, blocks(), most=most, notes=notes)
    except LogError as error:
        if isinstance(error.__cause__, OSError):
            raise LogError(f"{error}; images are copied there: {remedy}") from error
        raise


def _fingerprint(paths: tuple[Path, ...]) -> str:
    """Return the SHA-256 of the paths, sizes and times of change of files."""
    digest = hashlib.sha256()
    try:
        for file in _files(paths):
            state = file.stat()
            digest.update(f"{file.resolve()} {state.st_size} {state.st_mtime_ns}\n".encode())
    except OSError as error:
        raise LogError(f"{error.filename}: {error.strerror}") from error
    return digest.hexdigest()


def _files(paths: tuple[Path, ...]) -> Iterator[Path]:
    for path in paths:
        yield from sorted(path.iterdir()) if path.is_dir() else [path]


_CHANGES: Final = {"undistort", "crop", "resize", "gray", "range_m", "range", "as_"}
"""Options by which an image is not that of the message."""
_REASONS = 4
"""Number of reasons that are listed for images of a video that have none."""
_BLOCK_ROWS, _BLOCK_BYTES = 32, 1 << 22
"""Largest number and size of the messages that are in memory at a time."""
# foxglove.RawImage has no is_bigendian: its pixels are little-endian.
_RAW_FIELDS, _BIG_ENDIAN = ("height", "width", "encoding", "step", "data"), "is_bigendian"
_COMPRESSED_FIELDS = ("format", "data")
_PACKET_FIELDS, _STAMPS = ("encoding", "pts", "data"), ("timestamp", "header.stamp")


class ImageReader:
    """Reader that decodes, crops and resizes the images of one topic as a mapping specifies.

    Attributes:
        bag: Bag that has the topic.
        topic: Topic of the images.
        name: Name of the quantity, which is part of the name of a copy on disk.
        options: Options of the mapping.
        fields: Fields of a message to read.
        failures: Messages without a readable image, by their index in the topic, as far as `read`
            found any. They are to be treated as if they did not exist.
        packets_ns: Typical interval of the packets of a video; None for images.
        is_reordered: Whether frames of a video were decoded in another order than their packets.
    """

    def __init__(
        self,
        bag: Bag,
        topic: str,
        quantity: Quantity,
        *,
        name: str = "image",
        strict: bool = False,
        packets_ns: Mapping[str, float] | None = None,
    ) -> None:
        """Find out whether the images are raw, compressed, or frames of a video.

        For a robot that is running, whose messages come later, `packets_ns` has the typical
        interval of each topic of packets.
        """
        self.bag, self.topic, self.name = bag, topic, name
        self.options, self._strict = ImageOptions(topic, quantity), strict
        if quantity.undistort is not None and packets_ns is None:
            self.options.rectifier = Rectifier(Calibration.of(bag, quantity.undistort))
        self._quantity, is_stream = quantity, topic in (packets_ns or ())
        if quantity.image is None:
            self.fields = fields_of(bag.topics[topic], quantity)
        else:
            self.fields, is_stream = _image_fields(bag, bag.topics[topic], is_stream=is_stream)
        self.failures: dict[int, Failure] = {}
        self.packets_ns: float | None = None
        self.is_reordered = False
        self._video: VideoStream | None = None
        if is_stream:
            # A frame is averaged as it is decoded, unless a part of it is wanted.
            is_whole = quantity.crop is None and quantity.undistort is None
            self._converter = Converter(quantity.resize if is_whole else None)
        if is_stream and packets_ns is not None:
            if topic not in packets_ns:
                raise UsageError(
                    f"{topic}: the run does not contain the interval of its packets: train again"
                )
            self.packets_ns = packets_ns[topic]
        elif is_stream:
            files = np.array(bag.recordings)[bag.places(topic)[:, 0]]
            begins = np.flatnonzero(np.diff(files, prepend=-1))
            self._video = VideoStream(self.messages, begins, bag.times(topic))
            self.packets_ns = self._video.typical_ns
            if not strict:
                for row, reason in self._video.before_keyframes():
                    self._leave_out(row, reason)
            if len(self.failures) == len(files) > 0:
                raise LogError(f"{topic}: no frame can be decoded: {self.failures[0].reason}")

    def of_frame(self, frame: Any) -> Image:
        """Return the image (H, W, C) of an observation for a frame of a video."""
        return self.options.applied(Pixels(self._converter.pixels(frame), "video"))

    def live_video(self) -> LiveVideo:
        """Return a decoder of the packets of a robot that is running."""
        kinds = kinds_of(self.bag.topics[self.topic], self.fields)
        return LiveVideo(self.topic, kinds, self.packets_ns or 0.0)

    def read(
        self,
        rows: NDArray[np.int64],
        storage: Storage = "memory",
        poses: NDArray[np.float64] | None = None,
    ) -> Frames | None:
        """Return the images of N messages as (N, H, W, C); repeated messages are decoded only once.

        Args:
            rows: (N,) positions of the messages in the topic; or (N, K) to join K images along the
                last axis, (N, H, W, K * C).
            storage: Where the images are stored. If they are `mapped`, they are decoded into a file
                beside the bag, and read when they are indexed.
            poses: (N, 2 or 3) or (N, K, 2 or 3) poses of the robot, around which the images are.
                They are stored in memory.

        Returns:
            The images; None if a message has no readable image. All such messages among `rows` are
            in `failures` then: choose other rows, and read again.
        """
        needed, places = np.unique(rows, return_inverse=True)
        wanted = needed
        if poses is None:
            images = self.images(needed)
        else:
            pairs = np.column_stack([rows.reshape(-1), poses.reshape(rows.size, -1)])
            pairs, places = np.unique(pairs, axis=0, return_inverse=True)
            wanted, images = np.arange(len(pairs)), self._around(needed, pairs)
        first = next(images, None)
        if first is None:
            raise LogError(f"{self.topic}: {self._why_none(needed)}")
        image, images = first[1], chain([first], images)
        elements = image.size * (rows.shape[1] if rows.ndim > 1 else 1)
        if elements > MAX_ELEMENTS:
            raise UsageError(
                f"{self.topic}: an observation of {elements} elements is too large; at most"
                f" {MAX_ELEMENTS} can be used: set `resize` or `crop`, or a smaller `stack`"
            )
        if poses is not None or not is_mapped(storage, rows.size * image.nbytes):
            found: Frames | None = self._in_memory(
                wanted, places.reshape(rows.shape), image, images
            )
        elif (mapped := copied_images(self, wanted, image, images)) is not None:
            found = mapped.rows(places.reshape(rows.shape))
        else:
            found = None
        return None if self.failures.keys() & set(needed.tolist()) else found

    def packets(self, rows: NDArray[np.int64]) -> Packets | None:
        """Return the packets of the images that `read` returned for `rows`; None for images."""
        if self._video is None:
            return None
        changes = self._quantity.model_dump(include=_CHANGES, exclude_defaults=True, by_alias=True)
        lack = f"the mapping has {', '.join(sorted(changes))}" if changes else ""
        if rows.ndim > 1:
            lack = "the mapping has stack"
        elif self.is_reordered and not lack:
            lack = "its packets are not in the order of its frames (B-frames)"
        stream = partial(_packets_of, self.bag.again, self.topic, self._quantity)
        return Packets.of_rows(stream, rows if rows.ndim == 1 else rows[:, -1], lack=lack)

    def blocks(
        self,
        decoded: Decoded,
        shape: tuple[int, ...],
        dtype: np.dtype[Any],
        count: int,
    ) -> Iterator[tuple[NDArray[np.int64], Image]]:
        """Yield positions (K,) and images (K, H, W, C) in blocks of `count`.

        The arrays are used again for the next block.
        """
        numbers, images = np.empty(count, np.int64), np.empty((count, *shape), dtype)
        filled = 0
        for row, image in decoded:
            if image.shape != shape or image.dtype != dtype:
                what = (
                    f"image {row} is {image.shape} {image.dtype}, but the first is {shape} {dtype}:"
                    " set `resize` in the mapping"
                )
                if self._video is None:
                    raise LogError(f"{self.topic}: {what}")
                self._leave_out(row, what)
                continue
            if count == 1:
                yield np.array([row]), image[np.newaxis]
                continue
            numbers[filled], images[filled] = row, image
            filled += 1
            if filled == count:
                yield numbers, images
                filled = 0
        if filled:
            yield numbers[:filled], images[:filled]

    def space(self, images: Frames) -> spaces.Box:
        """Return the space of one of the images (N, H, W, C)."""
        if images.dtype == np.uint8:
            return spaces.Box(0, 255, images.shape[1:], np.uint8)
        low = -np.inf if self.options.is_intensity else 0.0
        return spaces.Box(low, np.inf, images.shape[1:], np.float32)

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
            reasons = Counter(self.failures[row].reason for row in sorted(self.failures))
            effect = first.reason
            if self._video is not None and len(reasons) > 1:
                listed = [f"{count}: {reason}" for reason, count in reasons.most_common(_REASONS)]
                effect = "; ".join(listed)
            action = "they are left out: the image before is used"
            found.append(Problem(what, self.topic, effect=effect, next=action))
        return found

    def leave_out(self, failure: Failure) -> None:
        """Add a message to `failures`."""
        if self._strict:
            row, time_ns, reason = failure
            raise LogError(f"{self.topic}: message {row} at {time_ns} ns: {reason}")
        self.failures[failure.row] = failure

    def _leave_out(self, row: int, reason: str) -> None:
        self.leave_out(Failure(row, int(self.bag.times(self.topic)[row]), reason))

    def _in_memory(
        self, wanted: NDArray[np.int64], places: NDArray[np.intp], like: Image, decoded: Decoded
    ) -> Image:
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
        for rows, images in self.blocks(decoded, like.shape, like.dtype, 1):
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

    def images(self, rows: NDArray[np.int64]) -> Decoded:
        """Yield the messages with readable images among `rows`, which ascend.

        With B-frames of a video, the result does not ascend.
        """
        if self._video is not None:
            yield from self._frames(self._video, rows)
            return
        yield from self._decoded(rows, self.options.image)

    def _around(self, rows: NDArray[np.int64], pairs: NDArray[Any]) -> Decoded:
        """Yield the images of grids: index of the row and pose in `pairs`, which are sorted."""
        for row, grid in self._decoded(rows, self.options.grid):
            for k in range(*np.searchsorted(pairs[:, 0], [row, row + 1]).tolist()):
                yield k, self.options.around(grid, pairs[k, 1:])

    def _decoded(
        self, rows: NDArray[np.int64], decode: Callable[[dict[str, Any]], _Decoded]
    ) -> Iterator[tuple[int, _Decoded]]:
        for row, message in self._in_blocks(rows):
            if isinstance(message, Failure):
                self.leave_out(message)
                continue
            try:
                # The full image is not kept: the next one is decoded into the same memory.
                image = decode(message)
            except LogError as error:
                self._leave_out(row, str(error))
                continue
            yield row, image

    def _frames(self, video: VideoStream, rows: NDArray[np.int64]) -> Decoded:
        """Yield the frames of a video; with B-frames, their rows do not ascend."""
        wanted, last = set(rows.tolist()), -1
        for row, frame in video.frames(rows):
            if not isinstance(frame, str):
                self.is_reordered, last = self.is_reordered or row < last, row
            if isinstance(frame, str):
                # The frames beside the wanted ones are left out as well: they may be chosen next.
                if row in wanted or not self._strict:
                    self._leave_out(row, frame)
            elif row in wanted:
                try:
                    image = self.of_frame(frame)
                except LogError as error:
                    self._leave_out(row, str(error))
                    continue
                yield row, image

    def messages(self, rows: NDArray[np.int64]) -> Iterator[tuple[int, Message]]:
        """Yield the packets of a video for ascending rows."""
        for row, message in self._in_blocks(rows):
            if isinstance(message, Failure):
                yield row, message.reason
                continue
            yield row, _packet(message, int(self.bag.times(self.topic)[row]))

    def _in_blocks(self, rows: NDArray[np.int64]) -> Iterator[tuple[int, dict[str, Any] | Failure]]:
        """Yield the fields of each message, a few MB of which are in memory at a time."""
        at, count = 0, 1
        while at < len(rows):
            block = rows[at : at + count]
            largest = 1
            for row, message in self._messages(block):
                if not isinstance(message, Failure):
                    largest = max(largest, _length(message["data"]))
                yield row, message
            at, count = at + len(block), min(_BLOCK_ROWS, max(1, _BLOCK_BYTES // largest))

    def _messages(self, rows: NDArray[np.int64]) -> Iterator[tuple[int, dict[str, Any] | Failure]]:
        """Yield the fields of each message, or why the message cannot be decoded."""
        found = self.bag.read(self.topic, self.fields, rows)
        messages: dict[int, dict[str, Any] | Failure] = {each.row: each for each in found.failures}
        for k, row in enumerate(found.rows.tolist()):
            messages[row] = {name: column[k] for name, column in found.columns.items()}
        yield from sorted(messages.items(), key=lambda each: each[0])


def _packets_of(
    again: Callable[[], Bag], topic: str, quantity: Quantity, rows: NDArray[np.int64]
) -> Iterator[tuple[str, bytes]]:
    """Yield the codec and the data of the packets `rows` of a topic of a bag that is closed."""
    with closing(again()) as bag:
        reader = ImageReader(bag, topic, quantity, strict=True)
        # Messages are read in ascending order.
        for part in np.split(rows, np.flatnonzero(np.diff(rows) <= 0) + 1):
            for row, message in reader.messages(part):
                if isinstance(message, str):
                    raise LogError(f"{topic}: message {row}: {message}")
                yield message[:2]


class LiveVideo:
    """Frames of a topic whose packets come one by one; several quantities may use them.

    Attributes:
        frame: Frame of the last packet (`av.VideoFrame`).
        lack: Why it has none; empty if it has one.
    """

    def __init__(self, topic: str, kinds: Mapping[str, str], packets_ns: float) -> None:
        """Prepare the decoder; see `ImageReader.packets_ns`."""
        self._topic, self._kinds = topic, kinds
        self._row, self._decoder = 0, VideoDecoder(packets_ns)
        self.frame: Any = None
        self.lack = ""

    def push(self, message: Any, log_time_ns: int) -> None:
        """Decode the next packet.

        Raises:
            UsageError: The codec is not supported, or frames are complete with later packets only.
        """
        packet = _packet(parts_of(message, self._kinds), log_time_ns)
        decoder, self._row, found = self._decoder, self._row + 1, NO_FRAME
        for row, frame in (
            decoder.lose(self._row, packet)
            if isinstance(packet, str)
            else decoder.feed(self._row, *packet)
        ):
            if row == self._row:
                found = frame
            elif not isinstance(frame, str):
                raise UsageError(
                    f"{self._topic}: its frames are complete with later packets only (B-frames),"
                    " which a robot does not have yet: encode without B-frames, and train again"
                )
        is_lost = isinstance(found, str)
        self.frame = None if is_lost else found
        self.lack = f"the last packet of {self._topic} has no frame: {found}" if is_lost else ""


def kinds_of(topic: TopicInfo, fields: Iterable[str]) -> dict[str, str]:
    """Return the kind of each field of a topic; see `kind_at`."""
    return {name: kind_at(topic.fields, name) for name in fields}


def parts_of(message: Any, kinds: Mapping[str, str]) -> dict[str, Any]:
    """Return fields of a decoded message."""
    return {name: converted(value_at(message, name), kind) for name, kind in kinds.items()}


def _packet(message: dict[str, Any], log_time_ns: int) -> Message:
    """Return the packet in the fields of a message."""
    stamps = [message[name] for name in _STAMPS if name in message]
    times_ns = [int(each) for each in stamps if isinstance(each, int | np.integer)]
    try:
        return _kind_of(message), _bytes_of(message["data"]), (log_time_ns, *times_ns)
    except LogError as error:
        return str(error)


def pixels_of(quantity: Quantity, message: dict[str, Any]) -> Pixels:
    """Decode the fields of a message with an image, a scan, a cloud or a grid."""
    if quantity.image is None:
        return image_of(quantity, with_bytes(message))
    kind = _kind_of(message)
    if "encoding" in message:
        return raw_pixels({**message, "data": _bytes_of(message["data"])})
    try:
        if is_video(kind):
            raise LogError("the topic has files of images as well")
        return compressed_pixels(kind, _bytes_of(message["data"]))
    except LogError as error:
        raise LogError(f"a compressed image ({one_line(kind)}) cannot be read: {error}") from error


def with_bytes(message: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a cloud or grid; packed elements are bytes."""
    if "fields[:].offset" not in message:
        return message
    return {**message, "data": _bytes_of(message["data"])}


def _kind_of(message: dict[str, Any]) -> str:
    """Return the name of an encoding or a codec."""
    return str(message["encoding" if "encoding" in message else "format"])


def _image_fields(bag: Bag, topic: TopicInfo, *, is_stream: bool) -> tuple[tuple[str, ...], bool]:
    """Return the fields of an image message to read, and whether they are packets of a video."""
    every = (*_RAW_FIELDS, _BIG_ENDIAN, *_COMPRESSED_FIELDS, *_STAMPS)
    known = {name.split("[")[0] for name in topic.fields}
    if not topic.fields and topic.count:
        # JSON without a schema: the first message shows the fields.
        columns = bag.read(topic.name, every, np.zeros(1, np.int64)).columns
        known = {name for name, column in columns.items() if _is_given(column)}
    stamps = tuple({*_STAMPS} & known)
    if known.issuperset(_RAW_FIELDS):
        return (*_RAW_FIELDS, *({_BIG_ENDIAN} & known)), False
    if known.issuperset(_COMPRESSED_FIELDS):
        found = bag.read(topic.name, ("format",), np.arange(min(1, topic.count))).columns["format"]
        is_stream |= is_video(topic.type_name) or any(is_video(str(each)) for each in found)
        return (*_COMPRESSED_FIELDS, *(stamps if is_stream else ())), is_stream
    if known.issuperset(_PACKET_FIELDS):
        return (*_PACKET_FIELDS, *stamps), True
    raise UsageError(
        f"{topic.name} has {topic.type_name}, not images: expected sensor_msgs/Image or"
        " CompressedImage, foxglove.RawImage, CompressedImage or CompressedVideo, or FFMPEGPacket"
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
        if values.ndim == 1 and values.dtype == np.uint8:
            return values.tobytes()
        if values.ndim == 1 and values.dtype.kind in "iu" and not (values & ~0xFF).any():
            return values.astype(np.uint8).tobytes()
    except ValueError as error:
        raise LogError(f"the data of the image cannot be read: {error}") from error
    raise LogError("the data of the image are not bytes")


def _is_given(column: NDArray[Any]) -> bool:
    """Return whether the first message has the field."""
    value = column[0] if len(column) else None
    return value is not None and not (isinstance(value, float) and math.isnan(value))
