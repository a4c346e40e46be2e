"""A picture of a scene from straight above, drawn with pygame: a body stays in the middle."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import import_extra
from mcaprl.sims.scene import Color, Shape
from mcaprl.sims.top_view import Patch, patches, placed

SIDE_PX = 600
_SMOOTH = 2
"""Each pixel is the mean of this many squared, so that edges are not jagged."""
_INK = (255, 255, 255)
_PLATE = (20, 22, 26)


class Body(NamedTuple):
    """Where the body is that the picture follows."""

    frame: str
    """Shapes of this frame are drawn at the body."""
    x_m: float
    y_m: float
    yaw_rad: float
    height_m: float = 0.0
    """Added to the heights of the body's shapes, which decide what covers what."""


class FollowView:
    """Draws one picture for each step, and shows it in a window in mode `human`."""

    def __init__(
        self,
        render_mode: Literal["human", "rgb_array"],
        name: str,
        static: Iterable[Shape],
        width_m: float,
        frames_per_s: int,
        floor: Iterable[Shape] = (),
    ) -> None:
        """Prepare the parts of the picture that never change.

        Args:
            render_mode: whether there is a window.
            name: of the sim, for the window's title.
            static: the shapes that never change.
            width_m: of the ground in the picture.
            frames_per_s: of the window.
            floor: shapes that never change and lie under all others, however high they are.

        Raises:
            MissingExtraError: pygame is not installed.
        """
        # Programs that print results on stdout must not find a greeting there.
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        self.pygame: Any = import_extra("pygame", "sims")
        self.pygame.font.init()
        self._font = self.pygame.font.Font(None, 26)
        self._canvas = self.pygame.Surface((_SMOOTH * SIDE_PX, _SMOOTH * SIDE_PX))
        lowest = [patch._replace(top_m=-math.inf) for patch in patches(floor)]
        self._static = [*lowest, *patches(static)]
        self._low = np.array([patch.corners_m.min(axis=0) for patch in self._static])
        self._high = np.array([patch.corners_m.max(axis=0) for patch in self._static])
        self._on_body = np.array([patch.frame != "map" for patch in self._static])
        self._width_m = width_m
        self._frames_per_s = frames_per_s
        self._window: Any = None
        if render_mode == "human":
            self.pygame.display.init()
            self._window = self.pygame.display.set_mode((SIDE_PX, SIDE_PX))
            self.pygame.display.set_caption(f"mcaprl {name}")
            self._clock = self.pygame.time.Clock()

    def draw(self, moving: Iterable[Shape], body: Body, text: str) -> Any:
        """Draw what is around the body.

        Args:
            moving: the shapes that change.
            body: stays in the middle.
            text: the line at the bottom.

        Returns:
            The picture, 600 x 600, to be drawn over and then shown.
        """
        lifted = [
            patch._replace(top_m=patch.top_m + body.height_m) if patch.frame != "map" else patch
            for patch in [*self._near(body), *patches(moving)]
        ]
        for patch in sorted(lifted, key=lambda each: each.top_m):
            self._fill(patch, body)
        picture = self.pygame.transform.smoothscale(self._canvas, (SIDE_PX, SIDE_PX))
        self.pygame.draw.rect(picture, _PLATE, (0, SIDE_PX - 34, SIDE_PX, 34))
        self.write(picture, text, (12, SIDE_PX - 26))
        return picture

    def write(self, picture: Any, text: str, at_px: tuple[int, int]) -> None:
        """Write a line into a picture."""
        picture.blit(self._font.render(text, True, _INK), at_px)

    def show(self, picture: Any) -> NDArray[np.uint8]:
        """Show a picture in the window, if there is one, and give it as (600, 600, 3)."""
        if self._window is not None:
            self._window.blit(picture, (0, 0))
            self.pygame.event.pump()
            self.pygame.display.flip()
            self._clock.tick(self._frames_per_s)
        pixels = self.pygame.surfarray.array3d(picture)
        return np.ascontiguousarray(pixels.transpose(1, 0, 2))

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self.pygame.display.quit()
            self._window = None

    def _near(self, body: Body) -> list[Patch]:
        """Give the static patches that are on the body or may be in the picture."""
        here, reach_m = np.array([body.x_m, body.y_m]), self._width_m / 2
        seen = np.all((self._low - here <= reach_m) & (self._high - here >= -reach_m), axis=1)
        return [self._static[i] for i in np.flatnonzero(seen | self._on_body)]

    def _fill(self, patch: Patch, body: Body) -> None:
        corners_m = patch.corners_m
        if patch.frame == body.frame:
            corners_m = placed(corners_m, body.x_m, body.y_m, body.yaw_rad)
        away_m = corners_m - [body.x_m, body.y_m]
        scale_px = _SMOOTH * SIDE_PX / self._width_m
        corners_px = _SMOOTH * SIDE_PX / 2 + away_m * [scale_px, -scale_px]
        self.pygame.draw.polygon(self._canvas, rgb(patch.color), corners_px.tolist())


def rgb(color: Color) -> tuple[int, int, int]:
    """Give a colour as pygame wants it, without its opacity."""
    red, green, blue = (round(255 * part) for part in color[:3])
    return red, green, blue
