"""Tracks of the racer sim, closed splines with walls on both sides and gates, and the car on them.

Pixel coordinates refer to a 1000 x 600 image: x to the right, y down, angles clockwise. One pixel
is 0.1 m. The map for viewers has its origin in the image's lower left corner, y up, and
counter-clockwise angles.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled
from mcaprl.sims.geometry import Path, closed_path, project, wrap_angle

Floats = NDArray[np.float64]

IMAGE_WIDTH_PX, IMAGE_HEIGHT_PX = 1000, 600
METERS_PER_PX = 0.1
HALF_WIDTH_PX = 41.5
GATES = 37
WALLS_PER_SIDE = 24
PATH_LEGS = 12 * GATES

CONTROL_POINTS_PX = (
    (50.0, 300.0),
    (58.0, 415.0),
    (115.0, 520.0),
    (225.0, 538.0),
    (308.0, 475.0),
    (362.0, 390.0),
    (455.0, 350.0),
    (545.0, 400.0),
    (605.0, 490.0),
    (710.0, 540.0),
    (840.0, 538.0),
    (935.0, 455.0),
    (925.0, 325.0),
    (825.0, 265.0),
    (725.0, 225.0),
    (640.0, 130.0),
    (520.0, 65.0),
    (395.0, 90.0),
    (310.0, 160.0),
    (240.0, 165.0),
    (125.0, 150.0),
    (58.0, 205.0),
)
"""Control points of the default track, counter-clockwise in the image, from the start line."""

_SAMPLES_PER_SPAN = 32
_STRAIGHT_PX = 220.0  # Length of a straight that is divided into as many walls as a bend of 1 rad
_MARGIN_PX = 6.0
_TIGHTEST_PX = 62.0
"""Minimum distance of random tracks from the image's edge, and minimum radius of their turns."""


class Track(NamedTuple):
    """Walls, gates and center line of one track."""

    walls_px: Floats  # (W, 4) x1, y1, x2, y2 of each wall
    gates_px: Floats
    """(G, 4) x1, y1, x2, y2 of each gate, from the left wall to the right one; gate i of G is
    (i + 1/2) / G of a lap after the start line."""
    path: Path  # Center line in the map, in the direction of travel, from the start line
    start_px: tuple[float, float, float]
    """x, y and heading (radians, clockwise from x) on the start line."""


def to_map(points_px: Floats) -> Floats:
    """Return the map coordinates, meters, of points (..., 2) of the image."""
    x_px, y_px = points_px[..., 0], points_px[..., 1]
    return np.stack([METERS_PER_PX * x_px, METERS_PER_PX * (IMAGE_HEIGHT_PX - y_px)], axis=-1)


def asphalt(track: Track) -> Floats:
    """Return the corners (3 W, 2) of the W triangles between the walls, pixels."""
    left, right = track.walls_px[:WALLS_PER_SIDE, :2], track.walls_px[WALLS_PER_SIDE:, :2]
    left_m, right_m = _progress(track.path, left), _progress(track.path, right)
    i = j = 0
    corners: list[Floats] = []
    while i < WALLS_PER_SIDE or j < WALLS_PER_SIDE:
        here_left, here_right = left[i % WALLS_PER_SIDE], right[j % WALLS_PER_SIDE]
        if j == WALLS_PER_SIDE or (i < WALLS_PER_SIDE and left_m[i + 1] <= right_m[j + 1]):
            i += 1
            corners += [here_left, here_right, left[i % WALLS_PER_SIDE]]
        else:
            j += 1
            corners += [here_left, here_right, right[j % WALLS_PER_SIDE]]
    return np.array(corners)


def _progress(path: Path, corners_px: Floats) -> list[float]:
    """Return the distance along the path to each wall corner of a side, and its length."""
    rest = [project(path, x, y, 0.0, path.length_m).along_m for x, y in to_map(corners_px[1:])]
    return [0.0, *rest, path.length_m]


@functools.cache
def make_track(seed: int | None = None) -> Track:
    """Return the random track of a seed, or the default track for None."""
    if seed is None:
        return track_through(np.array(CONTROL_POINTS_PX))
    random = np.random.default_rng(seed)
    while True:
        controls = _random_controls(random)
        if _drivable(controls):
            return track_through(controls)


def track_through(controls_px: Floats) -> Track:
    """Return the track whose center line passes through control points (N, 2)."""
    center = _spline(controls_px)
    normals = _left_normals(center)
    walls = np.concatenate([_wall(center + side * HALF_WIDTH_PX * normals) for side in (1.0, -1.0)])
    along = _along(center)
    places = (np.arange(GATES) + 0.5) / GATES * along[-1]
    middles = _at(center, along, places)
    across = _at(normals, along, places)
    gates = np.array([_gate(*pair, walls) for pair in zip(middles, across, strict=True)])
    corners = _at(center, along, np.linspace(0.0, along[-1], PATH_LEGS + 1))
    corners[-1] = corners[0]
    path = closed_path(to_map(corners))
    toward = controls_px[1] - controls_px[-1]
    start_x, start_y = controls_px[0].tolist()
    return Track(walls, gates, path, (start_x, start_y, math.atan2(toward[1], toward[0])))


def _spline(controls: Floats) -> Floats:
    """Sample the closed spline through (N, 2) points; the last sample equals the first."""
    # E. Catmull and R. Rom, "A class of local interpolating splines", 1974.
    t = np.arange(_SAMPLES_PER_SPAN)[:, None] / _SAMPLES_PER_SPAN
    spans = []
    for i in range(len(controls)):
        before, start, end, after = (controls[(i + k) % len(controls)] for k in (-1, 0, 1, 2))
        spans.append(
            start
            + 0.5 * t * (end - before)
            + 0.5 * t**2 * (2.0 * before - 5.0 * start + 4.0 * end - after)
            + 0.5 * t**3 * (3.0 * start - before - 3.0 * end + after)
        )
    return np.concatenate([*spans, controls[:1]])


def _tangents(center: Floats) -> Floats:
    """Return the unit tangents (M, 2) of a closed line whose last point equals the first."""
    around = np.concatenate([center[-2:-1], center, center[1:2]])
    chords = around[2:] - around[:-2]
    tangents: Floats = chords / np.hypot(chords[:, 0], chords[:, 1])[:, None]
    return tangents


def _left_normals(center: Floats) -> Floats:
    """Return the unit normals to the left of the direction of travel, in an image with y down."""
    tangents = _tangents(center)
    return np.column_stack([tangents[:, 1], -tangents[:, 0]])


def _along(line: Floats) -> Floats:
    """Return the distance along the line from its first point to each point."""
    steps = np.diff(line, axis=0)
    return np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])


def _at(values: Floats, along: Floats, places: Floats) -> Floats:
    """Interpolate values (M, 2) at distances `places`; `along` are the distances of the values."""
    return np.column_stack([np.interp(places, along, values[:, k]) for k in range(2)])


def _wall(line: Floats) -> Floats:
    """Approximate a closed line by `WALLS_PER_SIDE` walls (W, 4), which are shorter in bends."""
    tangents = _tangents(line)
    yaw = np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))
    bend = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(yaw)))])
    measure = bend + _along(line) / _STRAIGHT_PX
    corners = _at(line, measure, np.linspace(0.0, measure[-1], WALLS_PER_SIDE + 1))
    corners[-1] = corners[0]
    return np.concatenate([corners[:-1], corners[1:]], axis=1)


def _gate(middle: Floats, normal: Floats, walls: Floats) -> Floats:
    """Return the gate from wall to wall through a point of the center line."""
    ends = [
        middle + side * _distance(middle, side * normal, walls) * normal for side in (1.0, -1.0)
    ]
    return np.concatenate(ends)


def _distance(start: Floats, direction: Floats, walls: Floats) -> float:
    """Return the distance from a point to the nearest wall in a direction, pixels."""
    edge = walls[:, 2:] - walls[:, :2]
    to_wall = walls[:, :2] - start
    cross = direction[0] * edge[:, 1] - direction[1] * edge[:, 0]
    # A parallel wall gets the distance 0, and the mask `met` excludes this distance.
    cross[cross == 0.0] = math.inf
    distance = (to_wall[:, 0] * edge[:, 1] - to_wall[:, 1] * edge[:, 0]) / cross
    share = (to_wall[:, 0] * direction[1] - to_wall[:, 1] * direction[0]) / cross
    met = (distance > 0.0) & (share >= 0.0) & (share <= 1.0)
    return float(distance[met].min())


def _random_controls(random: np.random.Generator) -> Floats:
    """Draw random control points around the image's center, counter-clockwise from the left."""
    count = int(random.integers(11, 16))
    angles = math.pi - (np.arange(count) + random.uniform(-0.25, 0.25, count)) * (
        2 * math.pi / count
    )
    radii = random.uniform(0.45, 1.0, count)
    half = np.array([IMAGE_WIDTH_PX, IMAGE_HEIGHT_PX]) / 2
    room = half - HALF_WIDTH_PX - _MARGIN_PX
    away: Floats = radii[:, None] * room * np.column_stack([np.cos(angles), np.sin(angles)])
    return half + away


def _drivable(controls: Floats) -> bool:
    """Return whether a track through control points (N, 2) fits into the image and is drivable."""
    center = _spline(controls)
    room = HALF_WIDTH_PX + _MARGIN_PX
    limits = np.array([IMAGE_WIDTH_PX, IMAGE_HEIGHT_PX]) - room
    if (center < room).any() or (center > limits).any():
        return False
    tangents = _tangents(center)
    turns = np.abs(np.diff(np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))))
    steps = np.diff(_along(center))
    if (turns > steps / _TIGHTEST_PX).any():
        return False
    return _apart(center)


def _apart(center: Floats) -> bool:
    """Return whether all parts of the track are far enough from each other in the image."""
    along = _along(center)
    places = np.arange(0.0, along[-1], HALF_WIDTH_PX / 2)
    points = _at(center, along, places)
    for i, j in itertools.combinations(range(len(points)), 2):
        between = min(places[j] - places[i], along[-1] - places[j] + places[i])
        distance = math.hypot(*(points[i] - points[j]))
        if between > 4.0 * HALF_WIDTH_PX and distance < 2.0 * (HALF_WIDTH_PX + _MARGIN_PX):
            return False
    return True


CAR_LENGTH_PX, CAR_WIDTH_PX = 30.0, 14.0


class Car(NamedTuple):
    """State of one car: the first 12 values of its row in an (N, 13) array of cars."""

    x_px: float
    y_px: float
    heading_rad: float  # Heading clockwise from the image's x, in [-pi, pi)
    course_rad: float  # Direction of travel; equals the heading unless the car drifts
    speed_px: float  # Speed in the direction `course_rad`, pixels per step; negative when reversing
    next_gate: float
    gates: float  # Number of gates passed since the start
    idle_steps: float  # Number of steps since the last gate
    steps: float  # Number of steps since the start
    along_m: float  # Distance along the path to the point nearest to the car, summed over all laps
    offset_m: float  # Distance from the path, left positive
    heading_error_rad: float
    """Heading relative to the path's direction, counter-clockwise, in [-pi, pi)."""


STARTED_AT = len(Car._fields)
"""Index of the last value in a car's row: the distance along the path at the episode's start."""


@compiled
def car_at(row: NDArray[np.float64]) -> Car:
    """Read a car from a row of 12 floats."""
    motion, counts = (row[0], row[1], row[2], row[3], row[4]), (row[5], row[6], row[7], row[8])
    return Car(*motion, *counts, row[9], row[10], row[11])


@compiled
def store_car(car: Car, row: NDArray[np.float64]) -> None:
    """Write a car into a row of 12 floats."""
    for i, value in enumerate(car):
        row[i] = value


@compiled
def placed(
    track: Track,
    x_px: float,
    y_px: float,
    heading_rad: float,
    speed_px: float,
    near_m: float,
    within_m: float = math.inf,
) -> Car:
    """Return a car on a track before its first step. Its next gate is the nearest gate ahead."""
    # Its position along the path is searched within `near_m`, at most half a lap.
    reach_m = min(within_m, 0.5 * track.path.length_m)
    x_m, y_m = METERS_PER_PX * x_px, METERS_PER_PX * (IMAGE_HEIGHT_PX - y_px)
    place = project(track.path, x_m, y_m, near_m - reach_m, near_m + reach_m)
    along_m, count = place.along_m % track.path.length_m, len(track.gates_px)
    gate = int(along_m / track.path.length_m * count) % count
    if is_beyond(x_px, y_px, track.gates_px[gate]):
        gate = (gate + 1) % count
    error_rad = wrap_angle(-heading_rad - place.yaw_rad)
    heading_rad = wrap_angle(heading_rad)
    motion, counts = (x_px, y_px, heading_rad, heading_rad, speed_px), (float(gate), 0.0, 0.0, 0.0)
    return Car(*motion, *counts, along_m, place.offset_m, error_rad)


@compiled
def is_beyond(x_px: float, y_px: float, gate: NDArray[np.float64]) -> bool:
    """Return whether a point is past the line through a gate (4,), in the direction of travel."""
    across_x, across_y = gate[2] - gate[0], gate[3] - gate[1]
    return bool(across_x * (y_px - gate[1]) - across_y * (x_px - gate[0]) < 0.0)


@compiled
def corner_at(car: Car, forward: float, right: float) -> tuple[float, float]:
    """Return a corner of the car: `forward` is 1 or -1 (rear), `right` 1 or -1 (left)."""
    cos, sin = math.cos(car.heading_rad), math.sin(car.heading_rad)
    ahead, aside = 0.5 * CAR_LENGTH_PX * forward, 0.5 * CAR_WIDTH_PX * right
    return car.x_px + ahead * cos - aside * sin, car.y_px + ahead * sin + aside * cos
