"""Small video streams, encoded by PyAV."""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache
from typing import Any, Final

import av
import numpy as np

GROUP: Final = 10
"""Frames from keyframe to keyframe."""
# Encoder, decoder and options that repeat the parameter sets and let no frame be a keyframe by
# chance.
_X265 = "log-level=none:repeat-headers=1:scenecut=0:keyint=10:min-keyint=10:pools=1"
_CODECS: Final[dict[str, tuple[str, str, dict[str, str]]]] = {
    "h264": ("libx264", "h264", {"preset": "ultrafast", "x264-params": "scenecut=0:threads=1"}),
    "h265": ("libx265", "hevc", {"preset": "ultrafast", "x265-params": f"{_X265}:bframes=0"}),
    "vp9": ("libvpx-vp9", "vp9", {"deadline": "realtime", "cpu-used": "8", "lag-in-frames": "0"}),
    "av1": ("libsvtav1", "libdav1d", {"preset": "12", "svtav1-params": "pred-struct=1:lp=1"}),
    "h264 with B-frames": (
        "libx264",
        "h264",
        {"preset": "veryfast", "x264-params": "scenecut=0:threads=1"},
    ),
    "h265 with B-frames": (
        "libx265",
        "hevc",
        {"preset": "ultrafast", "x265-params": f"{_X265}:bframes=2"},
    ),
}
CODECS: Final = tuple(_CODECS)


def scene(number: int, width: int = 64, height: int = 48) -> np.ndarray[Any, Any]:
    """Return the image of a frame: a bright box that moves over a ramp."""
    image = np.empty((height, width, 3), np.uint8)
    image[...] = np.linspace(30, 180, width, dtype=np.uint8)[:, None]
    left = number * 5 % (width - 16)
    image[8:24, left : left + 16] = (250, 40, number * 6 % 256)
    image[-4:, : 1 + number % width] = 240
    return image


def packets(name: str, count: int = 40, width: int = 64, height: int = 48) -> list[bytes]:
    """Return the packets of a stream in the order of decoding.

    Args:
        name: One of `CODECS`.
        count: Number of frames.
        width: Width, pixels.
        height: Height, pixels.
    """
    return _stream(name, count, width, height)[0]


def frames(name: str, count: int = 40, width: int = 64, height: int = 48) -> list[Any]:
    """Return the frame of each packet (`av.VideoFrame`), decoded by PyAV alone."""
    return _stream(name, count, width, height)[1]


@lru_cache(maxsize=32)
def _stream(name: str, count: int, width: int, height: int) -> tuple[list[bytes], list[Any]]:
    encoder, decoder, options = _CODECS[name]
    context: Any = av.CodecContext.create(encoder, "w")
    context.width, context.height, context.pix_fmt = width, height, "yuv420p"
    context.time_base, context.framerate = Fraction(1, 30), Fraction(30)
    context.gop_size, context.max_b_frames = GROUP, 2 if "B-frames" in name else 0
    context.options = options
    found = []
    for number in range(count):
        frame = av.VideoFrame.from_ndarray(scene(number, width, height), format="rgb24")
        frame.pts = number
        found += context.encode(frame)
    found += context.encode(None)
    stream = [bytes(each) for each in found]
    context, decoded = av.CodecContext.create(decoder, "r"), dict[int, Any]()
    for row, data in enumerate(stream):
        packet = av.Packet(data)
        packet.pts = row
        decoded |= {frame.pts: frame for frame in context.decode(packet)}
    decoded |= {frame.pts: frame for frame in context.decode(None)}
    return stream, [decoded[row] for row in range(count)]
