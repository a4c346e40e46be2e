"""Top view of a scene with a body in the middle: shapes as flat patches, drawn with pygame."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import import_extra
from mcaprl.sims.drawing.scene import Color, Shape

Floats = NDArray[np.float64]

_SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
_CIRCLE = 0.5 * np.array([[math.cos(a), math.sin(a)] for a in np.arange(16) * math.pi / 8])


class Patch(NamedTuple):
    """Convex polygon of one color."""

    top_m: float  # Height of the shape's top
    color: Color
    corners_m: Floats  # (K, 2) corners
    frame: str


def patches(shapes: Iterable[Shape]) -> list[Patch]:
    """Return the patches of all shapes except `text`, the lowest first."""
    flat = [
        Patch(_top(shape), shape.color, corners, shape.frame)
        for shape in shapes
        for corners in _outlines(shape)
    ]
    return sorted(flat, key=lambda patch: patch.top_m)


def placed(corners_m: Floats, x_m: float, y_m: float, yaw_rad: float) -> Floats:
    """Rotate points (..., 2) by a yaw, then translate them."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    moved: Floats = corners_m @ np.array([[cos, sin], [-sin, cos]]) + [x_m, y_m]
    return moved


def _top(shape: Shape) -> float:
    if len(shape.points):
        return float(shape.position[2] + shape.points[:, 2].max())
    return shape.position[2] + shape.size[2] / 2


def _outlines(shape: Shape) -> list[Floats]:
    """Return the polygons (K, 2) of a shape in its frame."""
    flat, width_m = shape.points[:, :2], shape.size[0]
    match shape.kind:
        case "box":
            outlines = [_SQUARE * shape.size[:2]]
        case "sphere" | "cylinder":
            outlines = [_CIRCLE * shape.size[:2]]
        case "points" | "spheres":
            outlines = [_CIRCLE * width_m + point for point in flat]
        case "triangles":
            outlines = list(flat.reshape(-1, 3, 2))
        case "segments":
            outlines = [_stroke(a, b, width_m) for a, b in flat.reshape(-1, 2, 2)]
        case "line" | "arrow":
            outlines = [_stroke(a, b, width_m) for a, b in pairwise(flat)]
        case "text":
            outlines = []
    x_m, y_m, _ = shape.position
    return [placed(outline, x_m, y_m, shape.yaw_rad) for outline in outlines]


def _stroke(start: Floats, end: Floats, width_m: float) -> Floats:
    """Return a rectangle (4, 2) for a line; it extends half a width beyond each end."""
    along = end - start
    length_m = float(np.hypot(along[0], along[1]))
    yaw_rad = math.atan2(along[1], along[0])
    middle = (start + end) / 2
    size = (length_m + width_m, width_m)
    return placed(_SQUARE * size, float(middle[0]), float(middle[1]), yaw_rad)


Rgb = tuple[int, int, int]

_SMOOTH = 2  # Factor of supersampling in each direction, for smooth edges


class Canvas:
    """Canvas for images: first `polygon`, then `flatten`, then text and others, then `finish`."""

    def __init__(
        self,
        render_mode: Literal["human", "rgb_array"],
        size_px: tuple[int, int],
        caption: str,
        images_per_s: int,
    ) -> None:
        """Prepare an empty image of the given size; open a window in mode `human`."""
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
        """Use (height, width, 3) pixels as the image; later calls draw over them, in place."""
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
        """Fill a rectangle (left, top, width, height); return a surface with its memory."""
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
        """Prepare the static shapes, with `floor` below all others, and a view of `width_m`."""
        self.canvas = Canvas(render_mode, (SIDE_PX, SIDE_PX), f"mcaprl {name}", frames_per_s)
        lowest = [patch._replace(top_m=-math.inf) for patch in patches(floor)]
        self._static = [*lowest, *patches(static)]
        self._low = np.array([patch.corners_m.min(axis=0) for patch in self._static])
        self._high = np.array([patch.corners_m.max(axis=0) for patch in self._static])
        self._on_body = np.array([patch.frame != "map" for patch in self._static])
        self._width_m = width_m

    def draw(self, moving: Iterable[Shape], body: Body, text: str) -> None:
        """Draw the body, its surroundings, and a text; the caller may draw more before `show`."""
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
