"""Conversion of images to the pixel format of video encoders."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled, inlined

Bytes = NDArray[np.uint8]


@compiled
def to_yuv420(image: Bytes, luma: Bytes, blue: Bytes, red: Bytes) -> None:
    """Convert an RGB image to planes of limited range, with the coefficients of BT.601.

    A chroma sample is the mean of its 2x2 pixels. Rows of the planes may be longer than needed.
    """
    # With rows as contiguous 1-D arrays, the compiler can vectorize the loops over columns.
    lines = image.reshape(image.shape[0], 3 * image.shape[1])
    half = image.shape[1] // 2
    for row in range(len(luma)):
        line, out = lines[row], luma[row]
        for x in range(2 * half):
            r, g, b = np.int32(line[3 * x]), np.int32(line[3 * x + 1]), np.int32(line[3 * x + 2])
            # The coefficients are multiplied by 256; 128 rounds, and 4096 is 16 * 256.
            light = np.int32(66) * r + np.int32(129) * g + np.int32(25) * b + np.int32(128 + 4096)
            out[x] = np.uint8(light >> np.int32(8))
    for row in range(len(blue)):
        top, low, blues, reds = lines[2 * row], lines[2 * row + 1], blue[row], red[row]
        for x in range(half):
            # Sums of R, G and B over the 2x2 pixels; 512 rounds, and 131072 is 128 * 1024.
            r4, g4 = _sum(top, low, 6 * x), _sum(top, low, 6 * x + 1)
            b4 = _sum(top, low, 6 * x + 2)
            to_blue = np.int32(-38) * r4 - np.int32(74) * g4 + np.int32(112) * b4
            to_red = np.int32(112) * r4 - np.int32(94) * g4 - np.int32(18) * b4
            blues[x] = np.uint8((to_blue + np.int32(512 + 131072)) >> np.int32(10))
            reds[x] = np.uint8((to_red + np.int32(512 + 131072)) >> np.int32(10))


@inlined
def _sum(top: Bytes, low: Bytes, first: int) -> Any:
    """Return the sum of a color over 2x2 pixels of two rows, from the index of its first byte."""
    upper = np.int32(top[first]) + np.int32(top[first + 3])
    lower = np.int32(low[first]) + np.int32(low[first + 3])
    return upper + lower


def fill_frame(image: Bytes, frame: Any) -> None:
    """Convert an image into the planes of a `VideoFrame` of PyAV in the format `yuv420p`."""
    planes = [
        np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: plane.height]
        for plane in frame.planes
    ]
    to_yuv420(np.ascontiguousarray(image), *planes)
