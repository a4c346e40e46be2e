"""Films and sheets of stills, as files, from pictures."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import OutputExistsError, ReportError, UnknownNameError, UsageError, import_extra
from mcaprl.files import replacing

Picture = NDArray[np.uint8]

FILM_KINDS = (".mp4", ".gif")
MOST_PICTURES_PER_S: Final = 50.0
"""What viewers of GIFs can show; screens hardly show more."""
_COLUMNS = 3
_GAP_PX = 6


def check_output(path: Path, kinds: Sequence[str], *, overwrite: bool) -> None:
    """Make sure, before the work, that a film or sheet can be written there.

    Raises:
        UnknownNameError: the path ends otherwise than these kinds.
        OutputExistsError: there is a file, and `overwrite` is not set.
        MissingExtraError: imageio is not installed.
    """
    import_extra("imageio", "video")
    if path.suffix == ".mp4":
        import_extra("av", "video")
    if path.suffix not in kinds:
        raise UnknownNameError("kind of picture", path.suffix or path.name, kinds)
    if path.exists() and not overwrite:
        raise OutputExistsError(f"{path} exists: choose another path, or pass --overwrite")


def write_film(path: Path, pictures: Iterable[Picture], pictures_per_s: float) -> int:
    """Write a film as the pictures come; an `.mp4` is H.264, a `.gif` loops.

    Args:
        path: `.mp4` or `.gif`.
        pictures: (height, width, 3), all of one size with even edges.
        pictures_per_s: how fast it plays.

    Returns:
        How many pictures it has.

    Raises:
        UsageError: there are no pictures.
        ReportError: it cannot be written.
    """
    with replacing(path, ReportError) as unfinished:
        count = _write(unfinished, path.suffix, pictures, pictures_per_s)
        if count == 0:
            raise UsageError(f"{path}: there is nothing to show")
    return count


def _write(path: Path, kind: str, pictures: Iterable[Picture], pictures_per_s: float) -> int:
    imageio = import_extra("imageio.v3", "video")
    if kind == ".gif":
        stills = list(pictures)
        if stills:
            milliseconds = round(1000 / pictures_per_s)
            options = {"extension": kind, "plugin": "pillow", "loop": 0}
            imageio.imwrite(path, stills, duration=milliseconds, **options)
        return len(stills)
    count = 0
    options = {"plugin": "pyav", "extension": kind, "container": kind[1:]}
    with imageio.imopen(path, "w", **options) as film:
        film.init_video_stream("libx264", fps=float(pictures_per_s))
        for picture in pictures:
            film.write_frame(picture)
            count += 1
    return count


def write_sheet(path: Path, pictures: Sequence[Picture]) -> None:
    """Write pictures side by side and below each other as one PNG, at half their size.

    Raises:
        ReportError: it cannot be written.
    """
    imageio = import_extra("imageio.v3", "video")
    with replacing(path, ReportError) as unfinished:
        imageio.imwrite(unfinished, contact_sheet(pictures), extension=".png")


def contact_sheet(pictures: Sequence[Picture]) -> Picture:
    """Pictures at half their size in three columns, with a gap between."""
    halves = [_half(picture) for picture in pictures]
    height, width, _ = halves[0].shape
    columns = min(_COLUMNS, len(halves))
    rows = math.ceil(len(halves) / columns)
    size = (rows * (height + _GAP_PX) - _GAP_PX, columns * (width + _GAP_PX) - _GAP_PX, 3)
    sheet = np.full(size, 255, np.uint8)
    for number, half in enumerate(halves):
        top, left = (number // columns) * (height + _GAP_PX), (number % columns) * (width + _GAP_PX)
        sheet[top : top + height, left : left + width] = half
    return sheet


def filmed(length: int, steps_per_s: float) -> tuple[range, float]:
    """Which steps of an episode a film shows, and how many pictures a second.

    All of them as long as that can be watched; else every second one, every third one, ... so that
    the last is among them.

    Args:
        length: steps of the episode.
        steps_per_s: at the film's speed.
    """
    stride = max(1, math.ceil(steps_per_s / MOST_PICTURES_PER_S - 1e-9))
    return range(length % stride, length + 1, stride), steps_per_s / stride


def spread(length: int, count: int) -> list[int]:
    """Steps from the first to the last of an episode, evenly spread, each once.

    >>> spread(10, 3)
    [0, 5, 10]
    """
    return sorted(set(np.rint(np.linspace(0, length, count)).astype(int).tolist()))


def _half(picture: Picture) -> Picture:
    height, width = (edge // 2 * 2 for edge in picture.shape[:2])
    parts: Any = picture[:height, :width].reshape(height // 2, 2, width // 2, 2, 3)
    mean: Picture = parts.mean(axis=(1, 3)).astype(np.uint8)
    return mean
