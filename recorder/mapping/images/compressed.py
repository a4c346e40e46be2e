"""Pixels of compressed image messages: image files, and depth of compressed_depth_image_transport.

`format` names the file's format, such as `jpeg`, or the encoding and the format, such as
`16UC1; png compressed` and `16UC1; compressedDepth rvl`.
"""

from __future__ import annotations

import re
import struct
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.limits import MAX_IMAGE_PIXELS
from mcaprl.recorder.dataset.image_files import FORMATS, decoded_file
from mcaprl.recorder.mapping.images.pixels import CERTAIN_DEPTH, MM_PER_M, UNITS_PER_M, Pixels
from mcaprl.recorder.mapping.images.rvl import rvl_decoded

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
