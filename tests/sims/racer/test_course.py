"""Tests of the tracks of the racer sim."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mcaprl.sims.racer.course import (
    GATES,
    HALF_WIDTH_PX,
    WALLS_PER_SIDE,
    Track,
    asphalt,
    make_track,
    to_map,
)

Floats = NDArray[np.float64]
SEEDS = [None, 0, 1, 2, 3]


def sides(track: Track) -> tuple[Floats, Floats]:
    return track.walls_px[:WALLS_PER_SIDE], track.walls_px[WALLS_PER_SIDE:]


def area(corners: Floats) -> float:
    """Return the signed area of a polygon (K, 2)."""
    x, y = corners[:, 0], corners[:, 1]
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) / 2)


@pytest.mark.parametrize("seed", SEEDS)
def test_two_closed_walls_on_the_image(seed: int | None) -> None:
    track = make_track(seed)
    assert track.walls_px.shape == (48, 4)
    for side in sides(track):
        np.testing.assert_array_equal(side[:, 2:], np.roll(side[:, :2], -1, axis=0))
    assert track.walls_px.min() >= 0.0
    assert track.walls_px[:, [0, 2]].max() <= 1000.0
    assert track.walls_px[:, [1, 3]].max() <= 600.0


@pytest.mark.parametrize("seed", SEEDS)
def test_gates_extend_from_wall_to_wall(seed: int | None) -> None:
    track = make_track(seed)
    assert track.gates_px.shape == (GATES, 4)
    widths = np.hypot(*(track.gates_px[:, 2:] - track.gates_px[:, :2]).T)
    assert widths.mean() == pytest.approx(2 * HALF_WIDTH_PX, abs=2.0)
    assert widths.min() > 70.0
    middles = to_map((track.gates_px[:, :2] + track.gates_px[:, 2:]) / 2)
    steps = np.hypot(*(middles - np.roll(middles, 1, axis=0)).T)
    assert steps == pytest.approx(track.path.length_m / GATES, rel=0.25)


def test_the_default_track() -> None:
    track = make_track()
    assert track.start_px == (50.0, 300.0, np.pi / 2)
    assert track.path.length_m == pytest.approx(249.3, abs=0.1)
    np.testing.assert_allclose(track.path.points_m[0], [5.0, 30.0])


@pytest.mark.parametrize("seed", SEEDS)
def test_all_are_driven_counter_clockwise(seed: int | None) -> None:
    track = make_track(seed)
    left, right = sides(track)
    assert area(track.path.points_m[:-1]) > 0.0
    assert abs(area(left[:, :2])) < abs(area(right[:, :2]))


@pytest.mark.parametrize("seed", SEEDS)
def test_asphalt_covers_what_is_between_the_walls(seed: int | None) -> None:
    """All triangles have the same orientation, and the sum of their areas is the whole area.

    Thus the triangles have no overlaps or gaps.
    """
    track = make_track(seed)
    left, right = sides(track)
    areas = [area(triangle) for triangle in asphalt(track).reshape(-1, 3, 2)]
    assert len(areas) == 48
    assert len({np.sign(each) for each in areas}) == 1
    between = abs(area(right[:, :2])) - abs(area(left[:, :2]))
    assert sum(map(abs, areas)) == pytest.approx(between)


def test_seeds_make_different_tracks_and_the_same_again() -> None:
    first, second = make_track(0), make_track(1)
    assert not np.array_equal(first.walls_px, second.walls_px)
    again = make_track.__wrapped__(0)
    assert first.walls_px.tobytes() == again.walls_px.tobytes()
    assert first.gates_px.tobytes() == again.gates_px.tobytes()


def test_the_maps_y_axis_points_up_in_the_image() -> None:
    assert to_map(np.array([[0.0, 600.0], [1000.0, 0.0]])).tolist() == [[0, 0], [100, 60]]
