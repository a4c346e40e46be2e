"""Painter of flat faces: equal images of the compiled and the pure path, and closed-form cases."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from mcaprl.sims.drawing import chase_view
from mcaprl.sims.drawing.chase_view import Eye, Faces, Painter, joined

WIDTH, HEIGHT, FOCAL_PX, ABOVE_M = 64, 48, 50.0, 2.0
AHEAD = np.column_stack([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Axes of a level camera that faces along x."""
EYE = Eye(np.array([0.0, 0.0, ABOVE_M]), AHEAD, FOCAL_PX)
SKY = (0.0, 0.0, 1.0)
KERNELS = ("packed", "keys", "paint", "shrink", "clip_near", "project", "_stroke", "_light")


def faces(corners_m: Any, color: Any = (1.0, 1.0, 1.0), width_m: float = 0.0) -> Faces:
    corners = np.array(corners_m, np.float64)
    starts = np.array([0, len(corners)])
    return Faces(corners, starts, np.array([color], np.float64), np.array([width_m]))


def drawn(parts: Sequence[Faces], far: int = 0) -> np.ndarray[Any, Any]:
    return Painter((WIDTH, HEIGHT)).draw(joined(parts), far, EYE, SKY)


def upright(x_m: float, half_m: float, color: Sequence[float]) -> Faces:
    """Return a square that faces the camera."""
    sides = ((-half_m, -half_m), (half_m, -half_m), (half_m, half_m), (-half_m, half_m))
    return faces([(x_m, y_m, ABOVE_M + z_m) for y_m, z_m in sides], color)


def random_faces(count: int) -> list[Faces]:
    """Return polygons and strokes around the camera, some of which cross the near plane."""
    random = np.random.default_rng(0)
    found = []
    for k in range(count):
        corners = 2 if k % 3 == 0 else 3 if k % 3 == 1 else 4
        middle_m = random.uniform((-2, -9, -1), (20, 9, 5))
        points_m = middle_m + random.normal(0, 2, (corners, 3))
        if corners == 4:
            points_m[3] = points_m[0] + points_m[2] - points_m[1]
        color = random.random(3)
        found.append(faces(points_m, color, random.uniform(0.01, 0.5) if corners == 2 else 0.0))
    return found


def test_the_compiled_and_the_pure_path_draw_equal_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """At most one pixel in a thousand may differ: libraries round square roots differently."""
    some = random_faces(60)
    image = drawn(some)
    for name in (*KERNELS, "_spans"):
        pure = getattr(chase_view, name)
        monkeypatch.setattr(chase_view, name, getattr(pure, "py_func", pure))
    assert (drawn(some) != image).any(axis=2).mean() <= 1e-3
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 50, "the image shows the faces"


def test_a_square_covers_its_pixels_and_at_most_a_sample_more() -> None:
    image = drawn([upright(10.0, 2.0, (1.0, 0.0, 0.0))])
    # The half side is 50 * 2 / 10 = 10 pixels.
    square = image[HEIGHT // 2 - 10 : HEIGHT // 2 + 10, WIDTH // 2 - 10 : WIDTH // 2 + 10]
    assert (square[..., 0] > 150).all()
    assert (square[..., 2] == 0).all()
    blue = np.full(image.shape, (0, 0, 255), np.uint8)
    wide = np.ones(image.shape[:2], bool)
    wide[HEIGHT // 2 - 11 : HEIGHT // 2 + 11, WIDTH // 2 - 11 : WIDTH // 2 + 11] = False
    np.testing.assert_array_equal(image[wide], blue[wide])


def test_a_strip_that_reaches_past_the_camera_keeps_its_place() -> None:
    """The image of a strip of ground, 0.5 m to 1 m right of the camera, has straight edges."""
    strip = faces([(-50, -0.5, 0), (500, -0.5, 0), (500, -1, 0), (-50, -1, 0)])
    shown = drawn([strip])[..., 0] > 100
    for row in range(HEIGHT // 2 + 4, HEIGHT):
        # A pixel of the ground is this many meters wide.
        pixel_m = ABOVE_M / (row + 0.5 - HEIGHT / 2)
        first, last = np.flatnonzero(shown[row])[[0, -1]]
        assert first == pytest.approx(WIDTH / 2 + 0.5 / pixel_m, abs=1.5)
        assert last + 1 == pytest.approx(WIDTH / 2 + 1.0 / pixel_m, abs=1.5)
        assert shown[row, first : last + 1].all()


def test_nearer_faces_are_drawn_over_farther_ones_and_over_the_ground() -> None:
    red, green = upright(10.0, 2.0, (1.0, 0.0, 0.0)), upright(5.0, 1.0, (0.0, 1.0, 0.0))
    ground = faces([(1, -50, 0), (300, -50, 0), (300, 50, 0), (1, 50, 0)])
    images = [drawn(some) for some in ([red, green, ground], [ground, green, red])]
    np.testing.assert_array_equal(images[0], images[1])
    middle = images[0][HEIGHT // 2, WIDTH // 2]
    assert middle[1] > 150
    assert middle[0] == 0
    assert (images[0][-1] > 150).all(), "the ground"


def test_a_thin_face_remains_visible() -> None:
    """A board that is a hundredth of a pixel high is drawn as one row of samples."""
    board = faces([(10, -1, ABOVE_M - 0.05), (10, 1, ABOVE_M - 0.05), (10, 1, ABOVE_M - 0.052)])
    rows = (drawn([board])[..., 0] > 50).any(axis=1)
    assert rows.sum() == 1


def test_only_the_first_faces_are_left_out_in_the_distance() -> None:
    board = upright(chase_view.FAR_M + 1.0, 50.0, (1.0, 0.0, 0.0))
    assert (drawn([board], far=1)[..., 0] == 0).all()
    assert (drawn([board], far=0)[..., 0] > 150).any()
    unseen = upright(-5.0, 1.0, (1.0, 0.0, 0.0))
    assert (drawn([unseen])[..., 0] == 0).all()


def test_a_pixel_is_the_mean_of_its_samples() -> None:
    samples = np.array([[0x10FF04, 0x20FF05], [0x30FF06, 0x44FF07]], np.uint32)
    image = np.empty((1, 1, 3), np.uint8)
    chase_view.shrink(samples, image)
    assert image.tolist() == [[[0x29, 0xFF, 5]]]
