"""Decoding of image files that a foreign file contains, such as a JPEG in a message.

Pillow knows dozens of formats. Some of its decoders are rarely tested, and that of PostScript
starts the program `gs`. Only the formats in `FORMATS` are decoded, and only images of a declared
size within `mcaprl.limits`.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from io import BytesIO
from typing import Any, Final

from mcaprl.errors import LogError, import_extra
from mcaprl.limits import MAX_IMAGE_PIXELS

FORMATS: Final = ("JPEG", "PNG", "WEBP", "TIFF")
"""Formats of image files, by Pillow's names; TIFF stores depth as floats."""


def decoded_file(
    data: bytes,
    extra: str,
    *,
    formats: Sequence[str] = FORMATS,
    max_pixels: int = MAX_IMAGE_PIXELS,
) -> Any:
    """Decode an image file to a Pillow image.

    Args:
        data: Content of the file.
        extra: Extra of `mcaprl` that installs Pillow.
        formats: Formats that may be decoded.
        max_pixels: Maximum of width times height, which is checked before pixels are decoded.
    """
    pillow = import_extra("PIL.Image", extra)
    try:
        with warnings.catch_warnings():
            # Pillow warns about sizes above its limit, and about damaged EXIF data.
            warnings.simplefilter("ignore")
            image = pillow.open(BytesIO(data), formats=list(formats))
            width, height = image.size
            if width * height > max_pixels:
                raise LogError(
                    f"it declares {width} x {height} pixels; at most {max_pixels} can be read"
                )
            image.load()
    except LogError:
        raise
    except pillow.UnidentifiedImageError as error:
        raise LogError(f"{len(data)} bytes are not {', '.join(formats)}") from error
    # Pillow raises errors of many types for damaged images.
    except Exception as error:
        raise LogError(f"the {len(data)} bytes are damaged: {error}") from error
    return image
