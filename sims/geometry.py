"""Paths, vectors, meshes, rays and kinematics that the sims share."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mcaprl.compiled import compiled, inlined


class Path(NamedTuple):
    """Closed polyline of N legs."""

    points_m: NDArray[np.float64]  # (N + 1, 2) corners; the last one equals the first
    along_m: NDArray[np.float64]  # (N + 1,) distance of each corner from the start, along the path
    yaw_rad: NDArray[np.float64]  # (N,) direction of each leg, counter-clockwise from x
    forward: NDArray[np.float64]  # (N, 2) direction of each leg as a unit vector
    length_m: float


class Projection(NamedTuple):
    """Path point nearest to a position."""

    along_m: float
    offset_m: float  # Distance of the position from the path, positive to the left of its direction
    yaw_rad: float  # Direction of the path at the nearest point


def closed_path(corners: ArrayLike) -> Path:
    """Return the path through corners (N + 1, 2), meters; the last corner equals the first."""
    points = np.array(corners, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3:
        raise ValueError(f"corners have shape {points.shape}: at least (3, 2) is needed")
    if not np.array_equal(points[0], points[-1]):
        raise ValueError(f"the path is open: it starts at {points[0]} and ends at {points[-1]}")
    legs = np.diff(points, axis=0)
    lengths = np.hypot(legs[:, 0], legs[:, 1])
    if not np.all(lengths > 0):
        raise ValueError("two neighboring corners are the same point")
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    yaw_rad = np.arctan2(legs[:, 1], legs[:, 0])
    return Path(points, along, yaw_rad, legs / lengths[:, np.newaxis], float(along[-1]))


@inlined
def wrap_angle(angle_rad: float) -> float:
    """Wrap an angle to [-pi, pi)."""
    turns = np.floor((angle_rad + math.pi) / (2.0 * math.pi))
    wrapped = max(angle_rad - 2.0 * math.pi * turns, -math.pi)
    # Rounding may push the result to pi.
    return wrapped if wrapped < math.pi else -math.pi


@inlined
def sine(angle_rad: float) -> float:
    """Return the sine of an angle from -45 to 45 degrees, accurate to about the last bit.

    The function has no branches or calls, so that the compiler can vectorize loops. The series is
    x - x^3/3! + x^5/5! - ...; the first omitted term is below 6e-17 times the sine.
    """
    square = angle_rad * angle_rad
    rest = 1.0 / 6227020800.0 - square * (1.0 / 1307674368000.0)
    rest = 1.0 / 39916800.0 - square * rest
    rest = 1.0 / 362880.0 - square * rest
    rest = 1.0 / 5040.0 - square * rest
    rest = 1.0 / 120.0 - square * rest
    rest = 1.0 / 6.0 - square * rest
    return angle_rad * (1.0 - square * rest)


@inlined
def cosine(angle_rad: float) -> float:
    """Return the cosine of an angle from -45 to 45 degrees, computed as in `sine`.

    The series is 1 - x^2/2! + x^4/4! - ...; the first omitted term is below 2e-18.
    """
    square = angle_rad * angle_rad
    rest = 1.0 / 87178291200.0 - square * (1.0 / 20922789888000.0)
    rest = 1.0 / 479001600.0 - square * rest
    rest = 1.0 / 3628800.0 - square * rest
    rest = 1.0 / 40320.0 - square * rest
    rest = 1.0 / 720.0 - square * rest
    rest = 1.0 / 24.0 - square * rest
    return 1.0 - square * (0.5 - square * rest)


_QUARTER_RAD, _QUARTER_REST_RAD = math.pi / 2, 6.123233995736766e-17
"""A quarter turn, and the rounding error of its float64 value."""


class Heading(NamedTuple):
    """Direction of a yaw angle as a unit vector."""

    cos: float
    sin: float


@inlined
def heading_of(yaw_rad: float) -> Heading:
    """Return the direction of a yaw angle from quarter turns and a rest of up to 45 degrees."""
    # Like `sine`, the function has no branches or calls.
    quarters = np.floor(yaw_rad * (2.0 / math.pi) + 0.5)
    rest_rad = (yaw_rad - quarters * _QUARTER_RAD) - quarters * _QUARTER_REST_RAD
    sin, cos = sine(rest_rad), cosine(rest_rad)
    # This is `quarters` modulo 4.
    quarter = quarters - 4.0 * np.floor(0.25 * quarters)
    is_odd = (quarter == 1.0) | (quarter == 3.0)
    size_of_cos, size_of_sin = (sin, cos) if is_odd else (cos, sin)
    is_left, is_below = (quarter == 1.0) | (quarter == 2.0), quarter >= 2.0
    return Heading(
        -size_of_cos if is_left else size_of_cos, -size_of_sin if is_below else size_of_sin
    )


@inlined
def turned(heading: Heading, angle_rad: float) -> Heading:
    """Rotate a direction counter-clockwise by an angle from -12 to 12 degrees.

    The function uses the angle addition formulas and cos(a) = 1 - 2 sin^2(a / 2). The sine is the
    series of `sine` with fewer terms; the first omitted term is below 5e-18 times the sine.
    """
    half_rad = 0.5 * angle_rad
    square = half_rad * half_rad
    rest = 1.0 / 5040.0 - square * (1.0 / 362880.0)
    rest = 1.0 / 120.0 - square * rest
    rest = 1.0 / 6.0 - square * rest
    half = half_rad * (1.0 - square * rest)
    cos = 1.0 - 2.0 * half * half
    sin = 2.0 * half * math.sqrt(1.0 - half * half)
    return Heading(heading.cos * cos - heading.sin * sin, heading.sin * cos + heading.cos * sin)


class Spot(NamedTuple):
    """Position on a path: the index of its leg, and the distance from the leg's start."""

    leg: int
    rest_m: float


@compiled
def spot_at(path: Path, along_m: float) -> Spot:
    """Return the position at a distance along the path; distances wrap around."""
    rest_m = along_m % path.length_m
    leg, beyond = 0, len(path.yaw_rad)
    while beyond - leg > 1:
        middle = (leg + beyond) // 2
        if path.along_m[middle] <= rest_m:
            leg = middle
        else:
            beyond = middle
    return Spot(leg, rest_m - path.along_m[leg])


@compiled
def further(path: Path, spot: Spot, ahead_m: float) -> Spot:
    """Return the position that is `ahead_m` further along the path; `ahead_m` is at least 0."""
    leg, rest_m = spot.leg, spot.rest_m + ahead_m
    length_m = path.along_m[leg + 1] - path.along_m[leg]
    while rest_m >= length_m:
        rest_m -= length_m
        leg = leg + 1 if leg + 1 < len(path.yaw_rad) else 0
        length_m = path.along_m[leg + 1] - path.along_m[leg]
    return Spot(leg, rest_m)


@compiled
def point_of(path: Path, spot: Spot) -> tuple[float, float]:
    """Return the coordinates (x, y) of a position, meters."""
    start, forward = path.points_m[spot.leg], path.forward[spot.leg]
    return start[0] + spot.rest_m * forward[0], start[1] + spot.rest_m * forward[1]


@compiled
def leg_at(path: Path, along_m: float) -> int:
    """Return the index of the leg at a distance along the path; distances wrap around."""
    return spot_at(path, along_m).leg


@compiled
def point_at(path: Path, along_m: float) -> tuple[float, float]:
    """Return the point (x, y), meters, at a distance along the path; distances wrap around."""
    return point_of(path, spot_at(path, along_m))


@compiled
def project(path: Path, x_m: float, y_m: float, from_m: float, to_m: float) -> Projection:
    """Return the path point nearest to (x_m, y_m) between two distances along the path."""
    # The window, on any lap, selects the vehicle's branch where the path crosses itself.
    leg, rest_m = spot_at(path, from_m)
    leg_start_m = from_m - rest_m
    nearest, along_m, leftward, yaw_rad = math.inf, from_m, True, 0.0
    while leg_start_m <= to_m:
        leg_length_m = path.along_m[leg + 1] - path.along_m[leg]
        cos, sin = path.forward[leg, 0], path.forward[leg, 1]
        dx, dy = x_m - path.points_m[leg, 0], y_m - path.points_m[leg, 1]
        first_m = max(0.0, from_m - leg_start_m)
        last_m = min(leg_length_m, to_m - leg_start_m)
        along_leg_m = min(max(dx * cos + dy * sin, first_m), last_m)
        square = (dx - along_leg_m * cos) ** 2 + (dy - along_leg_m * sin) ** 2
        if square < nearest:
            nearest, along_m, yaw_rad = square, leg_start_m + along_leg_m, path.yaw_rad[leg]
            leftward = cos * dy - sin * dx >= 0.0
        leg_start_m += leg_length_m
        leg = leg + 1 if leg + 1 < len(path.yaw_rad) else 0
    distance_m = math.sqrt(nearest)
    return Projection(along_m, distance_m if leftward else -distance_m, yaw_rad)


@inlined
def in_body_frame(dx_m: float, dy_m: float, cos_yaw: float, sin_yaw: float) -> tuple[float, float]:
    """Transform a map vector into a body's frame: (forward, left), meters."""
    return dx_m * cos_yaw + dy_m * sin_yaw, dy_m * cos_yaw - dx_m * sin_yaw


def scattered(index: int, low: float, high: float) -> float:
    """Return element `index` of a golden-ratio sequence that covers `low` to `high` evenly."""
    return low + (high - low) * (index * 0.6180339887498949 % 1.0)


class Motion(NamedTuple):
    """Pose and speed of the middle of the wheelbase."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_m_s: float
    heading: Heading
    """Direction of the yaw; each step rotates the direction instead of recomputing it."""


@inlined
def moving(x_m: float, y_m: float, yaw_rad: float, speed_m_s: float) -> Motion:
    """Return the motion of a car; compute the heading from the yaw."""
    return Motion(x_m, y_m, yaw_rad, speed_m_s, heading_of(yaw_rad))


@inlined
def roll(
    motion: Motion,
    slip_sine: float,
    acceleration_m_s2: float,
    wheelbase_m: float,
    duration_s: float,
) -> Motion:
    """Advance a bicycle by one explicit Euler step, which must turn it by at most 12 degrees."""
    moved, turn_rad = roll_pose(motion, slip_sine, acceleration_m_s2, wheelbase_m, duration_s)
    heading = turned(moved.heading, turn_rad)
    return Motion(moved.x_m, moved.y_m, moved.yaw_rad, moved.speed_m_s, heading)


@inlined
def roll_pose(
    motion: Motion,
    slip_sine: float,
    acceleration_m_s2: float,
    wheelbase_m: float,
    duration_s: float,
) -> tuple[Motion, float]:
    """Return the motion after the step of `roll`, with the old heading, and the turn in radians.

    Let beta be the slip angle, l half the wheelbase and v the speed. Then x' = v cos(yaw + beta),
    y' = v sin(yaw + beta), yaw' = v sin(beta) / l, and v' = acceleration. Polack, Altche,
    d'Andrea-Novel and de La Fortelle, "The kinematic bicycle model: a consistent model for planning
    feasible trajectories for autonomous vehicles?", IEEE IV 2017, eq. 1. cos(yaw + beta) and
    sin(yaw + beta) are expanded into products, because the argument `slip_sine` is sin(beta).
    """
    cos, sin = motion.heading
    slip_cosine = math.sqrt(1.0 - slip_sine * slip_sine)
    distance_m = motion.speed_m_s * duration_s
    turn_rad = distance_m * slip_sine * (2.0 / wheelbase_m)
    moved = Motion(
        motion.x_m + distance_m * (cos * slip_cosine - sin * slip_sine),
        motion.y_m + distance_m * (sin * slip_cosine + cos * slip_sine),
        motion.yaw_rad + turn_rad,
        motion.speed_m_s + acceleration_m_s2 * duration_s,
        motion.heading,
    )
    return moved, turn_rad


@inlined
def slip_of(
    steering_rad: float, speed_m_s: float, most_lateral_m_s2: float, wheelbase_m: float
) -> float:
    """Return sin(beta) for a steering angle, limited by a maximum lateral acceleration.

    tan(beta) = tan(steering) / 2, so sin(beta) = sin(steering) / sqrt(4 - 3 sin^2(steering)). Let l
    be half the wheelbase and v the speed. The radius of the turn is l / sin(beta), so the lateral
    acceleration is v^2 sin(beta) / l. It limits sin(beta) to l / v^2 times the maximum.
    """
    steering_sine = sine(steering_rad)
    root = math.sqrt(4.0 - 3.0 * steering_sine * steering_sine)
    limit, square = 0.5 * wheelbase_m * most_lateral_m_s2, speed_m_s * speed_m_s
    # The fractions are compared by products, so that there is only one division, which takes as
    # long as many products.
    is_limited = abs(steering_sine) * square > limit * root
    size = limit if is_limited else abs(steering_sine)
    slip_size = size / (square if is_limited else root)
    return -slip_size if steering_sine < 0.0 else slip_size


@inlined
def steering_of(slip_sine: float) -> float:
    """Return the steering angle in radians for sin(beta): the inverse of `slip_of` at speed 0."""
    return math.atan2(2.0 * slip_sine, math.sqrt(1.0 - slip_sine * slip_sine))


class Vector(NamedTuple):
    """Three coordinates; the name of the variable or field contains their unit."""

    x: float
    y: float
    z: float


class Quaternion(NamedTuple):
    """A rotation as a unit quaternion w + x i + y j + z k."""

    w: float
    x: float
    y: float
    z: float


@inlined
def plus(a: Vector, b: Vector) -> Vector:
    """Return a + b."""
    return Vector(a.x + b.x, a.y + b.y, a.z + b.z)


@inlined
def minus(a: Vector, b: Vector) -> Vector:
    """Return a - b."""
    return Vector(a.x - b.x, a.y - b.y, a.z - b.z)


@inlined
def times(factor: float, a: Vector) -> Vector:
    """Return the vector a multiplied by `factor`."""
    return Vector(factor * a.x, factor * a.y, factor * a.z)


@inlined
def dot(a: Vector, b: Vector) -> float:
    """Return the dot product."""
    return a.x * b.x + a.y * b.y + a.z * b.z


@inlined
def cross(a: Vector, b: Vector) -> Vector:
    """Return the cross product."""
    return Vector(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


@inlined
def norm(a: Vector) -> float:
    """Return the length."""
    return math.sqrt(dot(a, a))


@inlined
def product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return the rotation by q followed by the rotation by p."""
    return Quaternion(
        p.w * q.w - p.x * q.x - p.y * q.y - p.z * q.z,
        p.w * q.x + p.x * q.w + p.y * q.z - p.z * q.y,
        p.w * q.y - p.x * q.z + p.y * q.w + p.z * q.x,
        p.w * q.z + p.x * q.y - p.y * q.x + p.z * q.w,
    )


@inlined
def inverse(q: Quaternion) -> Quaternion:
    """Return the inverse rotation."""
    return Quaternion(q.w, -q.x, -q.y, -q.z)


@inlined
def unit(q: Quaternion) -> Quaternion:
    """Normalize a quaternion to length 1."""
    scale = 1.0 / math.sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z)
    return Quaternion(scale * q.w, scale * q.x, scale * q.y, scale * q.z)


@inlined
def rotate(q: Quaternion, a: Vector) -> Vector:
    """Rotate a vector: a + 2 u x (u x a + w a), where u is the imaginary part of q."""
    axis = Vector(q.x, q.y, q.z)
    return plus(a, times(2.0, cross(axis, plus(cross(axis, a), times(q.w, a)))))


FAR_M = 100.0  # Length of a ray that hits nothing
SCALE_M = 1.0
_FARTHEST = math.log1p(FAR_M / SCALE_M)
_LN_2 = math.log(2.0)
_ROOT_2 = math.sqrt(2.0)


@inlined
def log_code(length_m: float) -> float:
    """Encode a length d as a number from 0 to 1: ln(1 + d / 1 m) / ln(1 + 100 m / 1 m)."""
    return logarithm(1.0 + length_m / SCALE_M) / _FARTHEST


@inlined
def logarithm(number: float) -> float:
    """Return the natural logarithm of a number from 1 to 181, with an error below 1e-15.

    The function has no branches or calls, so that the compiler can vectorize loops. It divides the
    number by a power of 2, so that the result q is from sqrt(1/2) to sqrt(2). With
    s = (q - 1) / (q + 1), ln q = 2 (s + s^3/3 + s^5/5 + ...); the rest is below 1e-18.
    """
    is_large = number >= 8.0 * _ROOT_2
    scaled = number * 0.0625 if is_large else number
    twos = 4.0 if is_large else 0.0
    is_large = scaled >= 2.0 * _ROOT_2
    scaled = scaled * 0.25 if is_large else scaled
    twos = twos + 2.0 if is_large else twos
    is_large = scaled >= _ROOT_2
    scaled = scaled * 0.5 if is_large else scaled
    twos = twos + 1.0 if is_large else twos
    share = (scaled - 1.0) / (scaled + 1.0)
    square = share * share
    rest = 1.0 / 19.0 + square * (1.0 / 21.0)
    rest = 1.0 / 17.0 + square * rest
    rest = 1.0 / 15.0 + square * rest
    rest = 1.0 / 13.0 + square * rest
    rest = 1.0 / 11.0 + square * rest
    rest = 1.0 / 9.0 + square * rest
    rest = 1.0 / 7.0 + square * rest
    rest = 1.0 / 5.0 + square * rest
    rest = 1.0 / 3.0 + square * rest
    return twos * _LN_2 + 2.0 * share * (1.0 + square * rest)


def ray_name(left_deg: int) -> str:
    """Return the name of a ray from its angle to the left, such as `ahead` or `left_30`."""
    if left_deg in (0, 180):
        return "behind" if left_deg else "ahead"
    return f"{'left' if left_deg > 0 else 'right'}_{abs(left_deg)}"


Point = tuple[float, float, float]

# The corners of a unit cube are numbered 4 x + 2 y + z. Each face lists its corners
# counter-clockwise as seen from outside; its diagonal splits it into two triangles.
_FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
_TRIANGLES = np.array([half for a, b, c, d in _FACES for half in ((a, b, c), (a, c, d))])
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


def box_faces(middle_m: Point, size_m: Point) -> NDArray[np.float64]:
    """Return the faces of a box, (6 faces, 4 corners, 3) meters, counter-clockwise outside."""
    corners: NDArray[np.float64] = np.array(middle_m) + _CORNERS * np.array(size_m)
    faces: NDArray[np.float64] = corners[np.array(_FACES)]
    return faces


def box_mesh(middle_m: Point, size_m: Point) -> NDArray[np.float64]:
    """Return the triangles of a box, (12, 3 corners, 3) meters, counter-clockwise outside."""
    corners: NDArray[np.float64] = np.array(middle_m) + _CORNERS * np.array(size_m)
    triangles: NDArray[np.float64] = corners[_TRIANGLES]
    return triangles


def ground_mesh(half_side_m: float) -> NDArray[np.float64]:
    """Return a square of ground at z = 0 around the origin, (2, 3, 3) meters, facing up."""
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    triangles: NDArray[np.float64] = half_side_m * corners[[[0, 1, 2], [0, 2, 3]]]
    return triangles


def frustum_mesh(
    foot_m: Point, foot_side_m: float, top_side_m: float, height_m: float
) -> NDArray[np.float64]:
    """Return the triangles of a square frustum without base, (10, 3, 3) meters."""
    # (4, 3, 3) of a pyramid.
    height = _CORNERS[:, 2:] + 0.5
    level = _CORNERS[:, :2] * (foot_side_m + (top_side_m - foot_side_m) * height)
    corners: NDArray[np.float64] = np.array(foot_m) + np.hstack([level, height_m * height])
    triangles: NDArray[np.float64] = corners[_TRIANGLES]
    on_base = np.all(triangles[:, :, 2] == foot_m[2], axis=1)
    sides = triangles[:, 1:] - triangles[:, :1]
    flat = np.all(np.cross(sides[:, 0], sides[:, 1]) == 0.0, axis=1)
    seen: NDArray[np.float64] = triangles[~(on_base | flat)]
    return seen
