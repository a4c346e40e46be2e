"""Pixels of raw and compressed image messages, in the encodings of ROS and Foxglove.

`format` names the file's format, such as `jpeg`, or the encoding and the format, such as
`16UC1; png compressed` and `16UC1; compressedDepth rvl`.

RVL, the lossless compression of depth images, is described in A. D. Wilson, "Fast Lossless Depth
Image Compression", ISS 2017, https://doi.org/10.1145/3132272.3134144.

The stream is a sequence of nibbles, eight in each little-endian 32-bit word, the highest first. A
number has three bits in each nibble, the lowest first; the fourth bit is set if another nibble
follows. The numbers are: the count of pixels that are 0, the count n of pixels that are not, n
differences from the last pixel that is not 0, and so on. Differences are zigzag codes: 0, -1, 1, -2
are 0, 1, 2, 3.

Colors become red, green and blue, 8 bits each. YUV is that of ITU-R BT.601 with limited range
(Y from 16 to 235), which cameras send and which cv_bridge assumes: it uses OpenCV's conversion,
whose constants are used here. 16 bits become 8 bits by division by 257, rounded, as in cv_bridge.
"""

from __future__ import annotations

import re
import struct
import warnings
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, import_extra
from mcaprl.limits import MAX_IMAGE_PIXELS
from mcaprl.recorder.dataset.images import FORMATS, decoded_file
from mcaprl.texts import shortened

Image = NDArray[Any]

MM_PER_M: Final = 1000.0


class Pixels(NamedTuple):
    """Pixels of a message.

    Attributes:
        image: (H, W) or (H, W, 3) uint8 array or Pillow image; for an image that may be depth,
            (H, W) numbers of 16 bits or floats.
        encoding: Encoding that the message names.
        units_per_m: Units of the depth in a meter; 0 if the image cannot be depth.
        is_certain: Whether the encoding says that the image is depth (REP 118), and not only that
            its pixels have 16 bits.
        has_lost_depth: Whether the message says that it is depth, but only has 8 bits per pixel.
    """

    image: Any
    encoding: str
    units_per_m: float = 0.0
    is_certain: bool = True
    has_lost_depth: bool = False


class _Layout(NamedTuple):
    """Channels of a pixel, their dtype, and which of them are red, green and blue."""

    channels: int
    dtype: str
    order: tuple[int, ...]


_RGB, _BGR, _GRAY = (0, 1, 2), (2, 1, 0), (0,)
_PLAIN: Final = {
    "rgb8": _Layout(3, "u1", _RGB),
    "bgr8": _Layout(3, "u1", _BGR),
    "rgba8": _Layout(4, "u1", _RGB),
    "bgra8": _Layout(4, "u1", _BGR),
    "8UC3": _Layout(3, "u1", _BGR),
    "8UC4": _Layout(4, "u1", _BGR),
    "mono8": _Layout(1, "u1", _GRAY),
    "8UC1": _Layout(1, "u1", _GRAY),
    "rgb16": _Layout(3, "u2", _RGB),
    "bgr16": _Layout(3, "u2", _BGR),
    "rgba16": _Layout(4, "u2", _RGB),
    "bgra16": _Layout(4, "u2", _BGR),
    "16UC3": _Layout(3, "u2", _BGR),
    "16UC4": _Layout(4, "u2", _BGR),
    "mono16": _Layout(1, "u2", _GRAY),
    "16UC1": _Layout(1, "u2", _GRAY),
    "32FC1": _Layout(1, "f4", _GRAY),
}
UNITS_PER_M: Final = {"16uc1": MM_PER_M, "mono16": MM_PER_M, "32fc1": 1.0}
"""Encodings that may be depth, with the units in a meter (REP 118), in lower case."""
CERTAIN_DEPTH: Final = ("16uc1", "32fc1")
"""Encodings that are depth by REP 118; `mono16` may also be an infrared or thermal image."""
# Bytes of two pixels: positions of Y of both, U and V.
_UYVY, _YUYV = (1, 3, 0, 2), (0, 2, 1, 3)
_PACKED: Final = {
    "yuv422": _UYVY,
    "uyvy": _UYVY,
    "yuv422_yuy2": _YUYV,
    "yuyv": _YUYV,
    "yuy2": _YUYV,
}
_PLANAR: Final = ("nv12", "nv21", "nv24", "i420")
_BAYER: Final = {
    f"bayer_{pattern}{bits}": (pattern, f"u{bits // 8}")
    for bits in (8, 16)
    for pattern in ("rggb", "bggr", "gbrg", "grbg")
}
ENCODINGS: Final = (*_PLAIN, *_PACKED, *_PLANAR, *_BAYER)
"""Encodings of raw images that can be read."""
_PLAIN_BY_NAME: Final = {name.lower(): layout for name, layout in _PLAIN.items()}


def one_line(text: str) -> str:
    """Return a name that a message contains, in one short line.

    >>> one_line("16UC1; jpeg compressed ")
    '16UC1; jpeg compressed'
    """
    return shortened(" ".join(text.split()), 40)


def raw_pixels(message: dict[str, Any]) -> Pixels:
    """Decode a raw image message: its fields height, width, encoding, step, data, is_bigendian."""
    encoding = str(message["encoding"])
    name = encoding.strip().lower()
    sizes = _Sizes.of(message, encoding)
    if name in _PLAIN_BY_NAME:
        image = _plain(sizes, _PLAIN_BY_NAME[name])
        units = UNITS_PER_M.get(name, 0.0)
        return Pixels(image, encoding, units, is_certain=name in CERTAIN_DEPTH or not units)
    if name in _PACKED:
        return Pixels(_packed(sizes, _PACKED[name]), encoding)
    if name in _PLANAR:
        return Pixels(_planar(sizes, name), encoding)
    if name in _BAYER:
        pattern, dtype = _BAYER[name]
        return Pixels(_demosaiced(_plain(sizes, _Layout(1, dtype, _GRAY)), pattern), encoding)
    raise LogError(f"encoding '{one_line(encoding)}'; supported: {', '.join(ENCODINGS)}")


class _Sizes(NamedTuple):
    """Sizes of a raw image, and its bytes."""

    height: int
    width: int
    step: int
    data: NDArray[np.uint8]
    is_bigendian: bool
    encoding: str

    @classmethod
    def of(cls, message: dict[str, Any], encoding: str) -> _Sizes:
        try:
            height, width, step = (int(message[name]) for name in ("height", "width", "step"))
            is_bigendian = bool(message.get("is_bigendian"))
        except (TypeError, ValueError, OverflowError) as error:
            raise LogError(f"height, width or step is not a number: {error}") from error
        if not 0 < height * width <= MAX_IMAGE_PIXELS or min(height, width) < 0:
            raise LogError(
                f"an image of {width} x {height} pixels; 1 to {MAX_IMAGE_PIXELS} can be read"
            )
        data = np.frombuffer(message["data"], np.uint8)
        return cls(height, width, step, data, is_bigendian, encoding)

    def rows(self, used: int) -> NDArray[np.uint8]:
        """Return (height, used) bytes: the first bytes of each row."""
        return self.plane(0, self.height, self.step, used)

    def plane(self, first: int, count: int, step: int, used: int) -> NDArray[np.uint8]:
        """Return (count, used) bytes: the first bytes of rows that begin at byte `first`."""
        stop = first + count * step
        if step < used or stop > len(self.data):
            raise LogError(
                f"an image of {self.width} x {self.height} {one_line(self.encoding)} with"
                f" {self.step} bytes per row has {len(self.data)} bytes, which do not match"
            )
        return self.data[first:stop].reshape(count, step)[:, :used]

    def check_even(self, *, rows: bool) -> None:
        """Check that pixels which share their color are complete."""
        if self.width % 2 or (rows and self.height % 2):
            raise LogError(
                f"an image of {self.width} x {self.height} {one_line(self.encoding)}: its pixels"
                " share their colors, so its size must be even"
            )


def _plain(sizes: _Sizes, layout: _Layout) -> Image:
    dtype = np.dtype(layout.dtype).newbyteorder(">" if sizes.is_bigendian else "<")
    used = sizes.width * layout.channels * dtype.itemsize
    values = np.ascontiguousarray(sizes.rows(used)).view(dtype)
    pixels = values.reshape(sizes.height, sizes.width, layout.channels)[..., list(layout.order)]
    if layout.channels == 1:
        return pixels[..., 0]
    return _eight_bits(pixels) if dtype.itemsize > 1 else pixels


def _eight_bits(values: Image) -> Image:
    """Return 16 bits as 8 bits: v / 257, rounded."""
    return ((values.astype(np.uint32) + 128) // 257).astype(np.uint8)


def _packed(sizes: _Sizes, places: tuple[int, int, int, int]) -> Image:
    """Return the colors of YUV 4:2:2, in which two pixels of a row share U and V."""
    sizes.check_even(rows=False)
    pairs = sizes.rows(2 * sizes.width).reshape(sizes.height, sizes.width // 2, 4)
    first, second, u, v = places
    luma = pairs[..., [first, second]].reshape(sizes.height, sizes.width)
    return _rgb_of_yuv(luma, pairs[..., u], pairs[..., v])


def _planar(sizes: _Sizes, name: str) -> Image:
    """Return the colors of YUV with a plane of Y, followed by U and V.

    U and V are interleaved in `nv12` (V first in `nv21`), one pair for 2 x 2 pixels; `nv24` has a
    pair for each pixel. `i420` has a plane of each.
    """
    height, width, step = sizes.height, sizes.width, sizes.step
    luma, first = sizes.rows(width), height * step
    if name == "nv24":
        pairs = sizes.plane(first, height, 2 * step, 2 * width).reshape(height, width, 2)
        return _rgb_of_yuv(luma, pairs[..., 0], pairs[..., 1])
    sizes.check_even(rows=True)
    if name == "i420":
        half = step // 2
        u, v = (
            sizes.plane(first + k * half * height // 2, height // 2, half, width // 2)
            for k in range(2)
        )
        return _rgb_of_yuv(luma, u, v)
    pairs = sizes.plane(first, height // 2, step, width).reshape(height // 2, width // 2, 2)
    first_u = 1 if name == "nv21" else 0
    return _rgb_of_yuv(luma, pairs[..., first_u], pairs[..., 1 - first_u])


# OpenCV's constants: the factors of BT.601 for limited range, times 2^20.
_SHIFT: Final = 20
_Y, _U_TO_B, _U_TO_G, _V_TO_G, _V_TO_R = 1220542, 2116026, -409993, -852492, 1673527


def _rgb_of_yuv(y: Image, u: Image, v: Image) -> Image:
    """Return the colors (H, W, 3) of Y (H, W) and U and V, which may be smaller.

    R = 1.164 (Y - 16) + 1.596 (V - 128)
    G = 1.164 (Y - 16) - 0.813 (V - 128) - 0.391 (U - 128)
    B = 1.164 (Y - 16) + 2.018 (U - 128)
    """
    luma = np.maximum(y.astype(np.int32) - 16, 0) * _Y
    u, v = u.astype(np.int32) - 128, v.astype(np.int32) - 128
    half = 1 << (_SHIFT - 1)
    found = np.empty((*y.shape, 3), np.uint8)
    chroma = (half + _V_TO_R * v, half + _V_TO_G * v + _U_TO_G * u, half + _U_TO_B * u)
    for channel, part in enumerate(chroma):
        for axis in range(2):
            part = part.repeat(y.shape[axis] // part.shape[axis], axis)
        found[..., channel] = np.clip((luma + part) >> _SHIFT, 0, 255)
    return found


_OPPOSITE: Final = {"r": "b", "b": "r"}


def _demosaiced(mosaic: Image, pattern: str) -> Image:
    """Return the colors of a Bayer mosaic: at each pixel, the mean of the nearest of each color.

    `pattern` names the colors of the first two pixels of the first row, then of the second row. At
    the borders, the image is mirrored, which keeps the pattern.
    """
    height, width = mosaic.shape
    padded = np.pad(mosaic, 1, mode="reflect").astype(np.int32)

    def shifted(down: int, right: int) -> Image:
        return padded[1 + down : 1 + down + height, 1 + right : 1 + right + width]

    beside = (shifted(0, -1) + shifted(0, 1) + 1) >> 1
    above = (shifted(-1, 0) + shifted(1, 0) + 1) >> 1
    cross = (shifted(-1, 0) + shifted(1, 0) + shifted(0, -1) + shifted(0, 1) + 2) >> 2
    corners = (shifted(-1, -1) + shifted(-1, 1) + shifted(1, -1) + shifted(1, 1) + 2) >> 2
    found = np.empty((height, width, 3), np.int32)
    for place, color in enumerate(pattern):
        part = (slice(place // 2, None, 2), slice(place % 2, None, 2))
        # The color of the other pixels in the same row; at red and blue pixels, it is green.
        neighbor = pattern[place ^ 1]
        if color == "g":
            sources = {"g": mosaic, neighbor: beside, _OPPOSITE[neighbor]: above}
        else:
            sources = {color: mosaic, "g": cross, _OPPOSITE[color]: corners}
        for channel, name in enumerate("rgb"):
            found[(*part, channel)] = sources[name][part]
    return _eight_bits(found) if mosaic.dtype.itemsize > 1 else found.astype(np.uint8)


_MAX_NIBBLES = 11
"""Nibbles of the longest number, of 32 bits."""


def rvl_decoded(data: bytes, count: int) -> NDArray[np.uint16]:
    """Return the `count` pixels of an RVL stream, which the caller has limited."""
    numbers = _numbers(data)
    pixels = np.zeros(count, np.uint16)
    at, done, previous = 0, 0, 0
    while done < count:
        if at + 2 > len(numbers):
            raise LogError(f"the RVL stream ends after {done} of {count} pixels")
        zeros, others = int(numbers[at]), int(numbers[at + 1])
        at, done = at + 2, done + zeros
        # An encoder never writes two counts of 0, which would take time but no pixels.
        if done + others > count or at + others > len(numbers) or not zeros + others:
            raise LogError(f"the RVL stream is damaged after {min(done, count)} of {count} pixels")
        codes = numbers[at : at + others]
        values = previous + np.cumsum((codes >> 1) ^ -(codes & 1))
        pixels[done : done + others] = values & 0xFFFF
        previous = int(values[-1]) if others else previous
        at, done = at + others, done + others
    return pixels


def _numbers(data: bytes) -> NDArray[np.int64]:
    """Return all numbers of a stream; an unfinished number at the end is left out."""
    words = np.frombuffer(data, np.uint8)[: len(data) // 4 * 4].reshape(-1, 4)[:, ::-1]
    nibbles = np.stack([words >> 4, words & 15], axis=-1).ravel()
    ends = np.flatnonzero(nibbles < 8)
    starts = np.concatenate([[0], ends[:-1] + 1]) if len(ends) else ends
    lengths = ends - starts + 1
    if len(lengths) and lengths.max() > _MAX_NIBBLES:
        raise LogError("the RVL stream is damaged: a number has more than 32 bits")
    numbers = np.zeros(len(ends), np.int64)
    for k in range(int(lengths.max(initial=0))):
        has_one = lengths > k
        numbers[has_one] |= (nibbles[starts[has_one] + k].astype(np.int64) & 7) << (3 * k)
    return numbers


_VIDEO: Final = re.compile(r"h\.?26[45]|hevc|avc|vp[89]|av1|mpeg|theora", re.IGNORECASE)
_PNG: Final = b"\x89PNG"
# compressed_depth_image_transport writes format, A and B before the PNG or RVL stream, and columns
# and rows before an RVL stream.
_DEPTH_HEADER: Final = struct.Struct("<iff")
_RVL_HEADER: Final = struct.Struct("<II")


def is_video(name: str) -> bool:
    """Return whether a format, an encoding or a type is that of a video stream.

    >>> is_video("h264"), is_video("foxglove.CompressedVideo"), is_video("rgb8; jpeg compressed")
    (True, True, False)
    """
    return bool(_VIDEO.search(name)) or name.endswith(("CompressedVideo", "FFMPEGPacket"))


def compressed_pixels(kind: str, data: bytes) -> Pixels:
    """Decode a compressed image message."""
    encoding = kind.split(";")[0].strip().lower()
    if "compresseddepth" in kind.lower():
        return _depth(kind, encoding, data)
    image = _upright(decoded_file(data, "bags", formats=FORMATS))
    if image.mode in ("I", "F") or image.mode.startswith("I;16"):
        units = 1.0 if image.mode == "F" else MM_PER_M
        return Pixels(np.asarray(image), kind, units, is_certain=encoding in CERTAIN_DEPTH)
    wanted = "L" if image.mode in ("L", "1") else "RGB"
    # Do not convert an image that has this mode, because the conversion would copy it.
    found = image if image.mode == wanted else image.convert(wanted)
    return Pixels(found, kind, has_lost_depth=encoding in UNITS_PER_M)


def _upright(image: Any) -> Any:
    """Turn a photo as its EXIF data say, which OpenCV's decoder does as well."""
    if "exif" not in image.info:
        return image
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return import_extra("PIL.ImageOps", "bags").exif_transpose(image)
    # Pillow raises errors of many types for damaged EXIF data, which other readers ignore.
    except Exception:
        return image


def _depth(kind: str, encoding: str, data: bytes) -> Pixels:
    if len(data) < _DEPTH_HEADER.size:
        raise LogError(f"{len(data)} bytes are too short for the header of compressedDepth")
    _, a, b = _DEPTH_HEADER.unpack_from(data)
    body = data[_DEPTH_HEADER.size :]
    if body.startswith(_PNG):
        image = decoded_file(body, "bags", formats=("PNG",))
        if not (image.mode == "I" or image.mode.startswith("I;16")):
            return Pixels(image.convert("L"), kind, has_lost_depth=True)
        code: NDArray[Any] = np.asarray(image)
    elif "rvl" in kind.lower():
        code = _rvl(body)
    else:
        raise LogError("compressedDepth has neither PNG nor RVL data")
    if encoding == "32fc1":
        return Pixels(_meters_of_code(code, a, b), kind, 1.0)
    return Pixels(code, kind, MM_PER_M)


def _rvl(body: bytes) -> NDArray[np.uint16]:
    if len(body) < _RVL_HEADER.size:
        raise LogError(f"{len(body)} bytes are too short for the header of RVL")
    width, height = _RVL_HEADER.unpack_from(body)
    if not 0 < width * height <= MAX_IMAGE_PIXELS:
        raise LogError(
            f"it declares {width} x {height} pixels; 1 to {MAX_IMAGE_PIXELS} can be read"
        )
    return rvl_decoded(body[_RVL_HEADER.size :], width * height).reshape(height, width)


def _meters_of_code(code: NDArray[Any], a: float, b: float) -> NDArray[np.float64]:
    """Return the depth of a coded float image; 0 where there is none.

    compressed_depth_image_transport stores the integer part of A / depth + B, or 0 where there is
    no depth.
    """
    with np.errstate(all="ignore"):
        depth = a / (code.astype(np.float64) - b)
    return np.where(code > 0, depth, 0.0)
