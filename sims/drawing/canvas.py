"""A picture drawn with pygame, and the window that shows it."""

from __future__ import annotations

import os
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import import_extra
from mcaprl.sims.drawing.scene import Color

Rgb = tuple[int, int, int]

_SMOOTH = 2
"""Each pixel is the mean of this many squared, so that edges are not jagged."""


class Canvas:
    """Draws one picture after the other, and shows them in a window in mode `human`.

    First come polygons, then `flatten`, then what shall stay sharp, then `finish`.
    """

    def __init__(
        self,
        render_mode: Literal["human", "rgb_array"],
        size_px: tuple[int, int],
        caption: str,
        pictures_per_s: int,
    ) -> None:
        """Prepare an empty picture.

        Args:
            render_mode: `human` opens a window.
            size_px: width and height.
            caption: of the window.
            pictures_per_s: how fast the window shows them.

        Raises:
            MissingExtraError: pygame is not installed.
        """
        # Programs that print results on stdout must not find a greeting there.
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        self.pygame = import_extra("pygame", "sims")
        self.pygame.font.init()
        self._fonts: dict[int, Any] = {}
        self._size_px, self._pictures_per_s = size_px, pictures_per_s
        width_px, height_px = size_px
        self._large = self.pygame.Surface((_SMOOTH * width_px, _SMOOTH * height_px))
        self._picture = self.pygame.Surface(size_px)
        self._window: Any = None
        if render_mode == "human":
            self.pygame.display.init()
            self._window = self.pygame.display.set_mode(size_px)
            self.pygame.display.set_caption(caption)
            self._clock = self.pygame.time.Clock()

    def polygon(self, corners_px: NDArray[np.float64], color: Color) -> None:
        """Fill a polygon (K, 2) of picture coordinates, y down."""
        self.pygame.draw.polygon(self._large, rgb(color), (_SMOOTH * corners_px).tolist())

    def flatten(self) -> None:
        """End the polygons; what follows is drawn over them."""
        self._picture = self.pygame.transform.smoothscale(self._large, self._size_px)

    def rectangle(self, box_px: tuple[int, int, int, int], color: Rgb, edge_px: int = 0) -> None:
        """Draw a rectangle (left, top, width, height); filled, unless it has an edge."""
        self.pygame.draw.rect(self._picture, color, box_px, edge_px)

    def arrowhead(self, middle_px: tuple[int, int], toward: tuple[int, int], color: Rgb) -> None:
        """Draw a triangle of 16 pixels that points right (1, 0), down (0, 1), and so on."""
        (x, y), (dx, dy) = middle_px, toward
        tip, left, right = (dx, dy), (dy - dx, -dx - dy), (-dy - dx, dx - dy)
        corners = [(x + 8 * part[0], y + 8 * part[1]) for part in (tip, left, right)]
        self.pygame.draw.polygon(self._picture, color, corners)

    def text(self, text: str, at_px: tuple[int, int], height_px: int, color: Rgb) -> None:
        """Write from (left, top) on."""
        if height_px not in self._fonts:
            self._fonts[height_px] = self.pygame.font.Font(None, height_px)
        self._picture.blit(self._fonts[height_px].render(text, True, color), at_px)

    def strip(self, box_px: tuple[int, int, int, int], color: Rgb) -> Any:
        """A part of the picture (left, top, width, height) with a background of its own.

        Returns:
            A pygame surface; what is drawn on it is in the picture.
        """
        part = self._picture.subsurface(box_px)
        part.fill(color)
        return part

    def finish(self) -> NDArray[np.uint8]:
        """Show the picture, if there is a window, and give it: (height, width, 3)."""
        if self._window is not None:
            self._window.blit(self._picture, (0, 0))
            self.pygame.event.pump()
            self.pygame.display.flip()
            self._clock.tick(self._pictures_per_s)
        pixels = self.pygame.surfarray.array3d(self._picture)
        return np.ascontiguousarray(pixels.transpose(1, 0, 2))

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self.pygame.display.quit()
            self._window = None


def rgb(color: Color) -> Rgb:
    """Give a colour as pygame wants it, without its opacity."""
    red, green, blue = (round(255 * part) for part in color[:3])
    return red, green, blue
