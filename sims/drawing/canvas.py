"""Canvas that draws images with pygame and can show them in a window."""

from __future__ import annotations

import os
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import import_extra
from mcaprl.sims.drawing.scene import Color

Rgb = tuple[int, int, int]

_SMOOTH = 2
"""Factor of supersampling in each direction, for smooth edges."""


class Canvas:
    """Canvas for a sequence of images. In mode `human`, a window shows them.

    For each image, call `polygon` any number of times, then `flatten`, then the methods that draw
    text and other elements without smoothing, then `finish`.
    """

    def __init__(
        self,
        render_mode: Literal["human", "rgb_array"],
        size_px: tuple[int, int],
        caption: str,
        images_per_s: int,
    ) -> None:
        """Prepare an empty image of the given size; open a window in mode `human`.

        Raises:
            MissingExtraError: Pygame is not installed.
        """
        # pygame would print a greeting among the results that commands print to stdout.
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        self.pygame = import_extra("pygame", "sims")
        self.pygame.font.init()
        self._fonts: dict[int, Any] = {}
        self._size_px, self._images_per_s = size_px, images_per_s
        width_px, height_px = size_px
        self._large = self.pygame.Surface((_SMOOTH * width_px, _SMOOTH * height_px))
        self._image = self.pygame.Surface(size_px)
        self._pixels: NDArray[np.uint8] | None = None
        self._window: Any = None
        if render_mode == "human":
            self.pygame.display.init()
            self._window = self.pygame.display.set_mode(size_px)
            self.pygame.display.set_caption(caption)
            self._clock = self.pygame.time.Clock()

    def polygon(self, corners_px: NDArray[np.float64], color: Color) -> None:
        """Fill a polygon (K, 2) in image coordinates, y down."""
        self.pygame.draw.polygon(self._large, rgb(color), (_SMOOTH * corners_px).tolist())

    def flatten(self) -> None:
        """Downsample the polygons to the image; later calls draw over them."""
        self._pixels = None
        self._image = self.pygame.transform.smoothscale(self._large, self._size_px)

    def paste(self, image: NDArray[np.uint8]) -> None:
        """Use (height, width, 3) pixels as the image; later calls draw over them, in place.

        This replaces the calls of `polygon` and `flatten`.
        """
        self._pixels = image
        self._image = self.pygame.image.frombuffer(image, self._size_px, "RGB")

    def rectangle(self, box_px: tuple[int, int, int, int], color: Rgb, edge_px: int = 0) -> None:
        """Draw a rectangle (left, top, width, height); fill it if `edge_px` is 0."""
        self.pygame.draw.rect(self._image, color, box_px, edge_px)

    def arrowhead(self, middle_px: tuple[int, int], toward: tuple[int, int], color: Rgb) -> None:
        """Draw a 16-pixel triangle; `toward` is (1, 0) for right and (0, 1) for down."""
        (x, y), (dx, dy) = middle_px, toward
        tip, left, right = (dx, dy), (dy - dx, -dx - dy), (-dy - dx, dx - dy)
        corners = [(x + 8 * part[0], y + 8 * part[1]) for part in (tip, left, right)]
        self.pygame.draw.polygon(self._image, color, corners)

    def text(self, text: str, at_px: tuple[int, int], height_px: int, color: Rgb) -> None:
        """Draw text whose top left corner is at `at_px`."""
        if height_px not in self._fonts:
            self._fonts[height_px] = self.pygame.font.Font(None, height_px)
        self._image.blit(self._fonts[height_px].render(text, True, color), at_px)

    def strip(self, box_px: tuple[int, int, int, int], color: Rgb) -> Any:
        """Fill the rectangle (left, top, width, height) with a background color.

        Returns:
            Pygame surface that shares memory with this rectangle of the image.
        """
        part = self._image.subsurface(box_px)
        part.fill(color)
        return part

    def finish(self) -> NDArray[np.uint8]:
        """Return the image, (height, width, 3). If there is a window, show the image there."""
        if self._window is not None:
            self._window.blit(self._image, (0, 0))
            self.pygame.event.pump()
            self.pygame.display.flip()
            self._clock.tick(self._images_per_s)
        if self._pixels is not None:
            return self._pixels
        # `surfarray` would take much longer, because it returns columns. The copy in a bytearray
        # makes the image writable.
        pixels = bytearray(self.pygame.image.tobytes(self._image, "RGB"))
        width_px, height_px = self._size_px
        return np.frombuffer(pixels, np.uint8).reshape(height_px, width_px, 3)

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self.pygame.display.quit()
            self._window = None


def rgb(color: Color) -> Rgb:
    """Return a color as three bytes, without its opacity."""
    red, green, blue = (round(255 * part) for part in color[:3])
    return red, green, blue
