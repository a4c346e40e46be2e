"""Video of the images that an environment renders, as a topic for viewers.

Each image is one message of H.264 in Annex B, without B-frames, and each keyframe has its parameter
sets, as Foxglove and Lichtblick need it. Each episode begins with a keyframe.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any, Final

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, UsageError, import_extra
from mcaprl.recorder.format.video_messages import video_message

VIDEO: Final = "/camera/image"
VIDEO_PERIOD_NS: Final = 33_000_000
"""Shortest time between two images, simulated: viewers show up to 30 in a second."""
_KEYFRAME_EVERY: Final = 60
_OPTIONS: Final = {"preset": "superfast", "tune": "zerolatency", "crf": "25"}


class VideoEncoder:
    """Encoder of images to messages of `VIDEO_TYPE`; each episode has a new one."""

    def __init__(self) -> None:
        """Import PyAV; the first image determines the size."""
        self._av = import_extra("av", "video")
        self._context: Any = None
        self._count = 0

    def encode(self, image: NDArray[np.uint8], time_ns: int) -> bytes:
        """Return the message of an image (H, W, 3), cut to the even sizes of H.264."""
        height, width = (edge // 2 * 2 for edge in image.shape[:2])
        if self._context is None:
            self._context = self._av.CodecContext.create("libx264", "w")
            self._context.width, self._context.height = width, height
            self._context.pix_fmt, self._context.time_base = "yuv420p", Fraction(1, 30)
            self._context.framerate = Fraction(30)
            self._context.gop_size, self._context.max_b_frames = _KEYFRAME_EVERY, 0
            self._context.thread_count, self._context.options = 1, _OPTIONS
        if (width, height) != (self._context.width, self._context.height):
            raise LogError(
                f"the environment renders images of {width} x {height} pixels, but its first one"
                f" had {self._context.width} x {self._context.height}"
            )
        pixels = np.ascontiguousarray(image[:height, :width])
        frame = self._av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format="yuv420p")
        frame.pts, self._count = self._count, self._count + 1
        data = b"".join(bytes(packet) for packet in self._context.encode(frame))
        return video_message(time_ns, "h264", data)


def rendering_env(env: gym.Env[Any, Any], camera: bool | str) -> gym.Env[Any, Any] | None:
    """Return the environment whose images are recorded as video; None for no video."""
    if isinstance(camera, bool):
        return None
    if camera != "h264":
        raise UsageError(f"camera must be True, False or h264, not {camera!r:.40}")
    if env.render_mode != "rgb_array":
        raise UsageError(
            f"camera 'h264' records what the environment renders, but its render_mode is"
            f' {env.render_mode}: make it with `render_mode="rgb_array"`'
        )
    import_extra("av", "video")
    return env


def rendered(env: Any) -> NDArray[np.uint8]:
    """Return the image that an environment renders."""
    image = np.asarray(env.render())
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or min(image.shape) < 2:
        raise LogError(
            f"the environment renders {image.dtype} of shape {image.shape}, not an image of 8 bits"
        )
    return image
