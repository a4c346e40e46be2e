"""GIF files, written with bounded memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import import_extra

_Change = tuple[Any, tuple[int, int], dict[str, int], int]


def write_gif(path: Path, images: Iterable[NDArray[np.uint8]], duration_ms: int) -> int:
    """Write a GIF that loops, frame by frame; each frame has its own palette.

    Successive images that look the same are one frame with a longer duration.

    Args:
        path: Path of the file.
        images: (height, width, 3) images of one size.
        duration_ms: Duration of an image, milliseconds.

    Returns:
        Number of images.
    """
    # Pillow's `Image.save` keeps all frames in memory. `getheader` and `getdata` write one frame.
    gif = import_extra("PIL.GifImagePlugin", "video")
    count = 0
    with path.open("wb") as file:
        for still, offset, options, repeats in _changes(images):
            options["duration"] = repeats * duration_ms
            if count == 0:
                header, _ = gif.getheader(still, info={"loop": 0})
                file.writelines(header)
            file.writelines(gif.getdata(still, offset, include_color_table=count > 0, **options))
            count += repeats
        file.write(b";")
    return count


def _changes(images: Iterable[NDArray[np.uint8]]) -> Iterator[_Change]:
    """Yield the part of each frame that differs from the frame before.

    Each is a Pillow image with a palette, its left and upper edge, the options of the GIF writer,
    and the number of successive images that look like this frame.
    """
    pillow = import_extra("PIL.Image", "video")
    chops = import_extra("PIL.ImageChops", "video")
    change: tuple[Any, tuple[int, int], dict[str, int]] | None = None
    shown, repeats = None, 0
    for image in images:
        still = pillow.fromarray(image).convert("P", palette=pillow.Palette.ADAPTIVE)
        seen = still.convert("RGB")
        if change is None:
            change = still, (0, 0), {}
        else:
            difference = chops.subtract_modulo(seen, shown)
            box = difference.getbbox()
            if box is not None:
                yield *change, repeats
                options = _hide_unchanged(still, difference)
                change, repeats = (still.crop(box), box[:2], options), 0
        shown, repeats = seen, repeats + 1
    if change is not None:
        yield *change, repeats


def _hide_unchanged(still: Any, difference: Any) -> dict[str, int]:
    """Make unchanged pixels transparent if a color is not used, so that the GIF is smaller."""
    chops = import_extra("PIL.ImageChops", "video")
    histogram, palette = still.histogram(), bytes(still.palette.palette)
    if 0 not in histogram:
        return {}
    index = histogram.index(0)
    if 3 * index == len(palette):
        still.putpalette(palette + bytes(3))
    red, green, blue = difference.split()
    largest = chops.lighter(chops.lighter(red, green), blue)
    still.paste(index, mask=largest.point([255] + 255 * [0], "1"))
    return {"transparency": index}
