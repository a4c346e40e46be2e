"""Course of the powerline sim: the line to follow, its towers and conductors, and the ground.

Axes are those of the published line, NED: x north, y east, z down; meters. `to_ros` transforms to
ROS axes for viewers. The course is deterministic and identical on every machine.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.compiled import compiled
from mcaprl.sims.geometry import Vector, cross, minus, norm, scattered

Floats = NDArray[np.float64]

POINTS_M: Floats = np.array(
    [
        (-0.55265, -31.9786, -19.0225),
        (48.59735, -63.3286, -60.07256),
        (193.5974, -55.0786, -46.32256),
        (369.2474, 35.32137, -62.5725),
        (541.3474, 143.6714, -32.07256),
    ]
)
"""(5, 3) points of the flight line; there is a tower under each point."""
LEGS = len(POINTS_M) - 1
_LEG_M = np.diff(POINTS_M, axis=0)
LEG_LENGTHS_M: Floats = np.sqrt((_LEG_M**2).sum(axis=1))
TANGENTS: Floats = _LEG_M / LEG_LENGTHS_M[:, None]  # (4, 3) unit vectors along the legs
ALONG_M: Floats = np.concatenate([[0.0], np.cumsum(LEG_LENGTHS_M)])
"""(5,) distance of each point from the first, along the line."""
LENGTH_M = float(ALONG_M[-1])

BELOW_LINE_M = 6.0  # Vertical distance of the conductors' ends from the points of the flight line
PHASES_M = (-4.0, 0.0, 4.0)  # Lateral positions of the three conductors, right positive
SAG = 0.02  # Sag of a conductor in the middle of its span, as a fraction of the span's length
CHORDS = 16  # Number of straight segments of a conductor

ARM_BELOW_WIRES_M = 1.0  # Length of the insulators on the towers' arms
ARM_HALF_LENGTH_M = 4.8
TOWER_HEIGHTS_M = (21.0, 26.0, 24.0, 28.0, 23.0)
TREE_COUNT = 240


class Place(NamedTuple):
    """Point of the line that is nearest to a position."""

    leg: int
    along_m: float  # Distance from the first point, along the line
    point_m: Vector
    distance_m: float


class Tower(NamedTuple):
    """Mast with an arm on top, perpendicular to the line."""

    x_m: float
    y_m: float
    foot_z_m: float
    arm_z_m: float
    right: tuple[float, float]  # Unit vector along the arm, to the right of the line


class Tree(NamedTuple):
    """Fir near the line."""

    x_m: float
    y_m: float
    height_m: float


def to_ros(ned: Floats) -> Floats:
    """Transform NED coordinates (..., 3) to ROS axes: y and z change sign."""
    turned: Floats = ned * np.array([1.0, -1.0, -1.0])
    return turned


@compiled
def point_on_line(along_m: float) -> Vector:
    """Return the point at a distance along the line, clipped to its ends."""
    rest_m = min(max(along_m, 0.0), LENGTH_M)
    leg = 0
    while leg + 1 < LEGS and ALONG_M[leg + 1] <= rest_m:
        leg += 1
    rest_m -= ALONG_M[leg]
    return Vector(
        POINTS_M[leg, 0] + rest_m * TANGENTS[leg, 0],
        POINTS_M[leg, 1] + rest_m * TANGENTS[leg, 1],
        POINTS_M[leg, 2] + rest_m * TANGENTS[leg, 2],
    )


@compiled
def nearest_on_line(position_m: Vector) -> Place:
    """Return the point of the line that is nearest to a position."""
    best = Place(0, 0.0, Vector(0.0, 0.0, 0.0), math.inf)
    for leg in range(LEGS):
        rest_m = 0.0
        for k in range(3):
            rest_m += (position_m[k] - POINTS_M[leg, k]) * TANGENTS[leg, k]
        along_m = ALONG_M[leg] + min(max(rest_m, 0.0), LEG_LENGTHS_M[leg])
        point = point_on_line(along_m)
        distance_m = norm(minus(position_m, point))
        if distance_m < best.distance_m:
            best = Place(leg, along_m, point, distance_m)
    return best


@compiled
def distance_to_infinite_line(position_m: Vector, leg: int) -> float:
    """Return the distance |(p - a) x t| to the infinite line through a leg, meters."""
    start = Vector(POINTS_M[leg, 0], POINTS_M[leg, 1], POINTS_M[leg, 2])
    tangent = Vector(TANGENTS[leg, 0], TANGENTS[leg, 1], TANGENTS[leg, 2])
    return norm(cross(minus(position_m, start), tangent))


@compiled
def ground_height(x_m: float, y_m: float) -> float:
    """Return the ground's height, meters: smooth through the towers' feet, hilly beside them."""
    span = 0
    while span + 1 < LEGS and POINTS_M[span + 1, 0] <= x_m:
        span += 1
    start, end = POINTS_M[span], POINTS_M[span + 1]
    share = min(max((x_m - start[0]) / (end[0] - start[0]), 0.0), 1.0)
    low, high = _foot_height(span), _foot_height(span + 1)
    base_m: float = low + (high - low) * share * share * (3.0 - 2.0 * share)
    beside_m = y_m - (start[1] + share * (end[1] - start[1]))
    away = 1.0 - math.exp(-((beside_m / 60.0) ** 2))
    hills_m = 9.0 * math.sin(x_m / 47.0 + 1.0) * math.cos(y_m / 39.0) + 4.0 * math.sin(y_m / 61.0)
    return base_m + away * hills_m


@compiled
def _foot_height(tower: int) -> float:
    arm_m: float = -POINTS_M[tower, 2] - BELOW_LINE_M - ARM_BELOW_WIRES_M
    return arm_m - TOWER_HEIGHTS_M[tower]


@compiled
def wire_distance(position_m: Vector) -> float:
    """Return the distance to the nearest conductor, meters; from 4 m on, a lower bound."""
    nearest_m = math.inf
    for wire in range(len(WIRES_M)):
        start, end = WIRES_M[wire, 0], WIRES_M[wire, CHORDS]
        ux, uy = end[0] - start[0], end[1] - start[1]
        along = (position_m.x - start[0]) * ux + (position_m.y - start[1]) * uy
        middle = math.floor(min(max(along / (ux * ux + uy * uy), 0.0), 1.0) * CHORDS)
        for chord in range(max(0, middle - 2), min(CHORDS, middle + 3)):
            chord_m = distance_to_segment(
                position_m, WIRES_M[wire, chord], WIRES_M[wire, chord + 1]
            )
            nearest_m = min(nearest_m, chord_m)
    return nearest_m


@compiled
def tower_distance(position_m: Vector) -> float:
    """Return the distance to the axis of the nearest mast or arm of a tower, meters."""
    nearest_m = math.inf
    for beam in range(len(BEAMS_M)):
        beam_m = distance_to_segment(position_m, BEAMS_M[beam, 0], BEAMS_M[beam, 1])
        nearest_m = min(nearest_m, beam_m)
    return nearest_m


@compiled
def distance_to_segment(position_m: Vector, start_m: Floats, end_m: Floats) -> float:
    """Return the distance to the segment between two points (3,), meters."""
    along, length = 0.0, 0.0
    for k in range(3):
        piece = end_m[k] - start_m[k]
        along += (position_m[k] - start_m[k]) * piece
        length += piece * piece
    share = min(max(along / length, 0.0), 1.0)
    square = 0.0
    for k in range(3):
        square += (position_m[k] - start_m[k] - share * (end_m[k] - start_m[k])) ** 2
    return math.sqrt(square)


def catenary(span_m: float, rise_m: float, sag_m: float, x_m: Floats) -> Floats:
    """Return the heights of a hanging wire relative to its first end, meters.

    The curve is y = a cosh((x - x0) / a) + c, where x0 follows from a and the rise. Bisection finds
    the value of a that results in the sag `sag_m`: the distance of the wire's middle below the
    straight line between its ends.
    """

    def lowest(a: float) -> float:
        return span_m / 2 - a * math.asinh(rise_m / (2 * a * math.sinh(span_m / (2 * a))))

    low, high = span_m / 20, span_m * span_m / sag_m
    for _ in range(100):
        a = (low + high) / 2
        ends = math.cosh(span_m / (2 * a)) - 1.0
        if a * math.cosh((span_m / 2 - lowest(a)) / a) * ends > sag_m:
            low = a
        else:
            high = a
    x0 = lowest(a)
    heights: Floats = a * (np.cosh((x_m - x0) / a) - math.cosh(x0 / a))
    return heights


def towers() -> tuple[Tower, ...]:
    """Return the five towers; each arm bisects the angle between the adjacent spans."""
    level = TANGENTS[:, :2] / np.hypot(*TANGENTS[:, :2].T)[:, None]
    forward = np.vstack([level[:1], level[:-1] + level[1:], level[-1:]])
    forward /= np.hypot(*forward.T)[:, None]
    return tuple(
        Tower(
            float(x),
            float(y),
            -_foot_height(i),
            float(z) + BELOW_LINE_M + ARM_BELOW_WIRES_M,
            (-float(forward[i, 1]), float(forward[i, 0])),
        )
        for i, (x, y, z) in enumerate(POINTS_M)
    )


def _wires() -> Floats:
    """Return the points (12, CHORDS + 1, 3) of the 12 conductors; each span has three."""
    shares = np.linspace(0.0, 1.0, CHORDS + 1)
    found = towers()
    wires = []
    for leg in range(LEGS):
        for phase_m in PHASES_M:
            start, end = (
                np.array([t.x_m, t.y_m, t.arm_z_m - ARM_BELOW_WIRES_M])
                + phase_m * np.array([*t.right, 0.0])
                for t in found[leg : leg + 2]
            )
            span_m = float(np.hypot(*(end - start)[:2]))
            sag_m = SAG * float(LEG_LENGTHS_M[leg])
            wire = start + shares[:, None] * (end - start)
            heights = catenary(span_m, float(start[2] - end[2]), sag_m, shares * span_m)
            wire[:, 2] = start[2] - heights
            wires.append(wire)
    return np.array(wires)


def _beams() -> Floats:
    """Return the masts and arms of the towers as segments, (10, 2, 3)."""
    beams = []
    for x_m, y_m, foot_z_m, arm_z_m, right in towers():
        across = ARM_HALF_LENGTH_M * np.array([*right, 0.0])
        top = np.array([x_m, y_m, arm_z_m])
        beams += [[np.array([x_m, y_m, foot_z_m]), top], [top - across, top + across]]
    return np.array(beams)


WIRES_M: Floats = _wires()
BEAMS_M: Floats = _beams()


def trees() -> tuple[Tree, ...]:
    """Return the firs: small ones under the line, tall ones on both sides of it."""
    found = []
    for index in range(TREE_COUNT):
        along_m = (index + 0.5) / TREE_COUNT * LENGTH_M
        side = 1.0 if index % 2 else -1.0
        small = index % 3 == 0
        away_m = scattered(index, 2.0, 12.0) if small else scattered(7 * index, 14.0, 80.0)
        height_m = scattered(5 * index, 1.0, 2.5) if small else scattered(5 * index, 6.0, 13.0)
        x_m, y_m, _ = point_on_line(along_m)
        found.append(Tree(x_m, y_m + side * away_m, height_m))
    return tuple(found)
