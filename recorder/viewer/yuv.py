"""Conversion of images to the pixel format of video encoders."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled

Bytes = NDArray[np.uint8]


@compiled
def to_yuv420(image: Bytes, luma: Bytes, blue: Bytes, red: Bytes) -> None:
    """Convert an RGB image to planes of limited range, with the coefficients of BT.601.

    A chroma sample is the mean of its 2x2 pixels.

    Args:
        image: (height, width, 3) image, which may have one row or column more than `luma`.
        luma: (height, width) output for Y, 16 to 235, with an even height and width.
        blue: (height / 2, width / 2) output for Cb, 16 to 240.
        red: (height / 2, width / 2) output for Cr, 16 to 240.
    """
    height, width = luma.shape
    for row in range(0, height, 2):
        for column in range(0, width, 2):
            # Sums of R, G and B over the 2x2 pixels.
            r4 = g4 = b4 = np.int32(0)
            for y in (row, row + 1):
                for x in (column, column + 1):
                    r = np.int32(image[y, x, 0])
                    g = np.int32(image[y, x, 1])
                    b = np.int32(image[y, x, 2])
                    # The coefficients are multiplied by 256; 128 rounds, and 4096 is 16 * 256.
                    luma[y, x] = np.uint8((66 * r + 129 * g + 25 * b + 128 + 4096) >> 8)
                    r4, g4, b4 = r4 + r, g4 + g, b4 + b
            half = row // 2, column // 2
            # 512 rounds, and 131072 is 128 * 1024.
            blue[half] = np.uint8((-38 * r4 - 74 * g4 + 112 * b4 + 512 + 131072) >> 10)
            red[half] = np.uint8((112 * r4 - 94 * g4 - 18 * b4 + 512 + 131072) >> 10)


def fill_frame(image: Bytes, frame: Any) -> None:
    """Convert an image into the planes of a `VideoFrame` of PyAV in the format `yuv420p`."""
    # A row of a plane can be longer than the image is wide.
    planes = [
        np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: plane.height, : plane.width]
        for plane in frame.planes
    ]
    to_yuv420(image, *planes)
