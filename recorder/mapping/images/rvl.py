"""Decoder of RVL, the lossless compression of depth images.

A. D. Wilson, "Fast Lossless Depth Image Compression", ISS 2017,
https://doi.org/10.1145/3132272.3134144. compressed_depth_image_transport uses it for
`compressedDepth rvl`.

The stream is a sequence of nibbles, eight in each little-endian 32-bit word, the highest first. A
number has three bits in each nibble, the lowest first; the fourth bit is set if another nibble
follows. The numbers are: the count of pixels that are 0, the count n of pixels that are not, n
differences from the last pixel that is not 0, and so on. Differences are zigzag codes: 0, -1, 1, -2
are 0, 1, 2, 3.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError

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
