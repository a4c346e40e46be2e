"""Pixels of compressed image messages: image files, and depth of compressed_depth_image_transport.

`format` names the file's format, such as `jpeg`, or the encoding and the format, such as
`16UC1; png compressed` and `16UC1; compressedDepth rvl`.

RVL, the lossless compression of depth images, is described in A. D. Wilson, "Fast Lossless Depth
Image Compression", ISS 2017, https://doi.org/10.1145/3132272.3134144.

The stream is a sequence of nibbles, eight in each little-endian 32-bit word, the highest first. A
number has three bits in each nibble, the lowest first; the fourth bit is set if another nibble
follows. The numbers are: the count of pixels that are 0, the count n of pixels that are not, n
differences from the last pixel that is not 0, and so on. Differences are zigzag codes: 0, -1, 1, -2
are 0, 1, 2, 3.
"""

from __future__ import annotations

import re
import struct
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.limits import MAX_IMAGE_PIXELS
from mcaprl.recorder.dataset.images import FORMATS, decoded_file
from mcaprl.recorder.mapping.images.pixels import CERTAIN_DEPTH, MM_PER_M, UNITS_PER_M, Pixels

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
    image = decoded_file(data, "bags", formats=FORMATS)
    if image.mode in ("I", "F") or image.mode.startswith("I;16"):
        units = 1.0 if image.mode == "F" else MM_PER_M
        return Pixels(np.asarray(image), kind, units, is_certain=encoding in CERTAIN_DEPTH)
    wanted = "L" if image.mode in ("L", "1") else "RGB"
    # Do not convert an image that has this mode, because the conversion would copy it.
    found = image if image.mode == wanted else image.convert(wanted)
    return Pixels(found, kind, has_lost_depth=encoding in UNITS_PER_M)


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
