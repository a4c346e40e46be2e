"""Video files and contact sheets from rendered images."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from fractions import Fraction
from io import BytesIO
from itertools import chain, repeat
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import OutputExistsError, ReportError, UnknownNameError, UsageError, import_extra
from mcaprl.files import replacing

Image = NDArray[np.uint8]

VIDEO_KINDS = (".mp4", ".gif", ".webp")
MAX_FPS: Final = 50.0
"""Largest frame rate that GIF viewers support; it is close to the frame rate of screens."""
SMOOTH_FPS: Final = 20.0
"""Frame rate from which motion looks continuous."""
# x264's defaults, "medium" and 23, take 3 to 4 times the CPU time for a PSNR that is at most 0.3 dB
# higher. Their files of our scenes are half to two thirds as large.
_H264_OPTIONS: Final = {"preset": "superfast", "crf": "25"}
# WebP with a quality of 80 is nearly twice as large. The default level of 4 takes twice as long.
_WEBP_OPTIONS: Final = {"quality": "50", "compression_level": "0"}
# Codec, pixel format and options of the encoder.
_ENCODERS: Final = {
    ".mp4": ("libx264", "yuv420p", _H264_OPTIONS),
    ".gif": ("gif", "pal8", {}),
    ".webp": ("libwebp_anim", "bgra", _WEBP_OPTIONS),
}
_COLUMNS = 3
_GAP_PX = 6


def check_output(path: Path, kinds: Sequence[str], *, overwrite: bool) -> None:
    """Check that a video or contact sheet can be written, before its images are rendered."""
    import_extra("av" if path.suffix in _ENCODERS else "imageio", "video")
    if path.suffix not in kinds:
        raise UnknownNameError("kind of output", path.suffix or path.name, kinds)
    if path.exists() and not overwrite:
        raise OutputExistsError(f"{path} exists: choose another path, or pass `overwrite=True`")


def write_video(path: Path, images: Iterable[Image], fps: float, hold_s: float = 0.0) -> int:
    """Write a video frame by frame: an H.264 encoded `.mp4`, or a `.gif` or `.webp` that loops.

    The last image is shown for `hold_s` seconds more, so that the end can be read.

    Returns:
        Number of frames, with those that repeat the last image.
    """
    with replacing(path, ReportError) as unfinished:
        shown = _held(_of_one_size(images), round(hold_s * fps))
        count = _encode(unfinished, path.suffix, shown, fps)
        if count == 0:
            raise UsageError(f"{path}: the video has no frames")
    return count


def _held(images: Iterable[Image], count: int) -> Iterator[Image]:
    """Yield images, and the last one `count` times more."""
    last = None
    for last in images:
        yield last
    if last is not None:
        yield from repeat(last, count)


def _of_one_size(images: Iterable[Image]) -> Iterator[Image]:
    """Yield images."""
    shape: tuple[int, ...] = ()
    for image in images:
        shape = shape or image.shape
        if image.shape != shape:
            raise UsageError(f"a video needs images of one size, got {shape} and {image.shape}")
        yield image


def _encode(path: Path, kind: str, images: Iterable[Image], fps: float) -> int:
    """Write images of one size; see `write_video`."""
    av = import_extra("av", "video")
    # imageio does not offer the options of the encoders. Pillow keeps all frames of a GIF or WebP.
    codec, pixels, options = _ENCODERS[kind]
    rate = Fraction(fps).limit_denominator(10_000)
    frames: Iterable[Any] = (_frame(image, kind) for image in images)
    if kind == ".gif":
        frames = _with_palettes(frames, rate)
    count, stream = 0, None
    # The encoder cannot be closed after a failed write, so it writes to memory.
    content = BytesIO()
    looping = {} if kind == ".mp4" else {"loop": "0"}
    with av.open(content, "w", format=kind[1:], options=looping) as container:
        for count, frame in enumerate(frames, 1):  # noqa: B007
            if stream is None:
                stream = container.add_stream(codec, rate=rate, options=options)
                stream.height, stream.width, stream.pix_fmt = frame.height, frame.width, pixels
            container.mux(stream.encode(frame))
        if stream is not None:
            container.mux(stream.encode())
    path.write_bytes(content.getvalue())
    return count


def _with_palettes(frames: Iterable[Any], rate: Fraction) -> Iterator[Any]:
    """Convert each RGB frame to a palette of 256 colors that fits it best."""
    av, graph = import_extra("av", "video"), None
    for number, frame in enumerate(chain(frames, [None])):
        if frame is not None:
            frame.pts, frame.time_base = number, 1 / rate
            graph = graph or _palette_graph(av, frame)
        if graph is not None:
            graph.push(frame)
            # PyAV raises BlockingIOError if a filter waits for the next frame.
            with suppress(BlockingIOError, EOFError):
                while True:
                    yield graph.pull()


def _palette_graph(av: Any, frame: Any) -> Any:
    graph, base = av.filter.Graph(), frame.time_base
    source = graph.add_buffer(
        width=frame.width, height=frame.height, format=frame.format, time_base=base
    )
    both, palette = graph.add("split"), graph.add("palettegen", "stats_mode=single")
    use, sink = graph.add("paletteuse", "new=1:dither=none"), graph.add("buffersink")
    source.link_to(both)
    both.link_to(use)
    both.link_to(palette, 1)
    palette.link_to(use, 0, 1)
    use.link_to(sink)
    graph.configure()
    return graph


def _frame(image: Image, kind: str) -> Any:
    av = import_extra("av", "video")
    if kind == ".gif":
        return av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
    if kind == ".webp":
        # Some versions of PyAV do not free images that they convert.
        alpha = np.full((*image.shape[:2], 1), 255, np.uint8)
        pixels = np.concatenate([image[..., ::-1], alpha], axis=-1)
        return av.VideoFrame.from_ndarray(pixels, format="bgra")
    # This module imports numba. PyAV's own conversion takes three times as long.
    from mcaprl.recorder.viewer.yuv import fill_frame

    # H.264 needs an even height and width.
    height, width = (edge // 2 * 2 for edge in image.shape[:2])
    frame = av.VideoFrame(width, height, "yuv420p")
    fill_frame(image, frame)
    return frame


def write_sheet(path: Path, images: Sequence[Image]) -> None:
    """Write a contact sheet of images as PNG; see `contact_sheet`."""
    imageio = import_extra("imageio.v3", "video")
    with replacing(path, ReportError) as unfinished:
        imageio.imwrite(unfinished, contact_sheet(images), extension=".png")


def contact_sheet(images: Sequence[Image]) -> Image:
    """Arrange images at half their size in three columns with gaps."""
    halves = [_half(image) for image in images]
    height, width, _ = halves[0].shape
    columns = min(_COLUMNS, len(halves))
    rows = math.ceil(len(halves) / columns)
    size = (rows * (height + _GAP_PX) - _GAP_PX, columns * (width + _GAP_PX) - _GAP_PX, 3)
    sheet = np.full(size, 255, np.uint8)
    for number, half in enumerate(halves):
        top, left = (number // columns) * (height + _GAP_PX), (number % columns) * (width + _GAP_PX)
        sheet[top : top + height, left : left + width] = half
    return sheet


def shown_steps(length: int, steps_per_s: float) -> tuple[range, float]:
    """Return the steps of an episode that a video shows, and the frame rate of the video.

    Steps are skipped at a constant stride if the frame rate would exceed `MAX_FPS`; the last step
    is always shown.
    """
    stride = max(1, math.ceil(steps_per_s / MAX_FPS - 1e-9))
    return range(length % stride, length + 1, stride), steps_per_s / stride


def parts_of_step(images_per_s: float) -> int:
    """Return the number of images per shown step that yields at least 20 images per second.

    `images_per_s` is the number of shown steps per second.

    >>> parts_of_step(2.0), parts_of_step(10.0), parts_of_step(30.0)
    (10, 2, 1)
    """
    return max(1, math.ceil(SMOOTH_FPS / images_per_s - 1e-9))


def evenly_spaced(length: int, count: int) -> list[int]:
    """Return evenly spaced, distinct steps from the first to the last of an episode.

    >>> evenly_spaced(10, 3)
    [0, 5, 10]
    """
    return sorted(set(np.rint(np.linspace(0, length, count)).astype(int).tolist()))


def _half(image: Image) -> Image:
    height, width = (edge // 2 * 2 for edge in image.shape[:2])
    parts: Any = image[:height, :width].reshape(height // 2, 2, width // 2, 2, 3)
    mean: Image = parts.mean(axis=(1, 3)).astype(np.uint8)
    return mean
