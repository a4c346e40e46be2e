"""Top view of a scene, drawn with pygame, with a body in the middle of the image."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.canvas import Canvas
from mcaprl.sims.drawing.scene import Shape
from mcaprl.sims.drawing.top_view import Patch, patches, placed

SIDE_PX = 600
_INK = (255, 255, 255)
_PLATE = (20, 22, 26)


class Body(NamedTuple):
    """Pose of the body that the image follows."""

    frame: str
    """Frame whose shapes rotate with the body; shapes of other frames are only
    translated, and shapes of `map` stay fixed."""
    x_m: float
    y_m: float
    yaw_rad: float
    height_m: float = 0.0
    """Height of the body. It is added to the heights of the body's shapes, which determine the
    order of drawing."""


class FollowView:
    """Renderer that draws one image for each step. In mode `human`, a window shows the images."""

    def __init__(
        self,
        render_mode: Literal["human", "rgb_array"],
        name: str,
        static: Iterable[Shape],
        width_m: float,
        frames_per_s: int,
        floor: Iterable[Shape] = (),
    ) -> None:
        """Prepare the static shapes. Shapes in `floor` are drawn below all other shapes.

        The image shows `width_m` meters of the ground from left to right.

        Raises:
            MissingExtraError: Pygame is not installed.
        """
        self.canvas = Canvas(render_mode, (SIDE_PX, SIDE_PX), f"mcaprl {name}", frames_per_s)
        lowest = [patch._replace(top_m=-math.inf) for patch in patches(floor)]
        self._static = [*lowest, *patches(static)]
        self._low = np.array([patch.corners_m.min(axis=0) for patch in self._static])
        self._high = np.array([patch.corners_m.max(axis=0) for patch in self._static])
        self._on_body = np.array([patch.frame != "map" for patch in self._static])
        self._width_m = width_m

    def draw(self, moving: Iterable[Shape], body: Body, text: str) -> None:
        """Draw the body, its surroundings, and a line of text at the bottom.

        The caller may draw more on `canvas` before the call of `show`.
        """
        lifted = [
            patch._replace(top_m=patch.top_m + body.height_m) if patch.frame != "map" else patch
            for patch in [*self._near(body), *patches(moving)]
        ]
        for patch in sorted(lifted, key=lambda each: each.top_m):
            self._fill(patch, body)
        self.canvas.flatten()
        self.canvas.rectangle((0, SIDE_PX - 34, SIDE_PX, 34), _PLATE)
        self.canvas.text(text, (12, SIDE_PX - 26), 26, _INK)

    def show(self) -> NDArray[np.uint8]:
        """Return the image, (600, 600, 3). If there is a window, show the image there."""
        return self.canvas.finish()

    def close(self) -> None:
        """Close the window."""
        self.canvas.close()

    def _near(self, body: Body) -> list[Patch]:
        """Return the static patches that are fixed to the body or overlap the visible ground."""
        here, half_m = np.array([body.x_m, body.y_m]), self._width_m / 2
        seen = np.all((self._low - here <= half_m) & (self._high - here >= -half_m), axis=1)
        return [self._static[i] for i in np.flatnonzero(seen | self._on_body)]

    def _fill(self, patch: Patch, body: Body) -> None:
        corners_m = patch.corners_m
        if patch.frame != "map":
            yaw_rad = body.yaw_rad if patch.frame == body.frame else 0.0
            corners_m = placed(corners_m, body.x_m, body.y_m, yaw_rad)
        away_m = corners_m - [body.x_m, body.y_m]
        scale_px = SIDE_PX / self._width_m
        self.canvas.polygon(SIDE_PX / 2 + away_m * [scale_px, -scale_px], patch.color)
