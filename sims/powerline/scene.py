"""Scene of the powerline sim (hills, firs, towers, conductors and the drone), and its top view.

Frames: `map` (x north, y west, z up), `base_stabilized` (at the drone, level), `drone` (its body, x
forward, y left, z up) and `camera` (ROS optical axes: x right, y down, z along the view).
The drone is drawn at five times its size to be visible.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.scene import Color, Frame, Kind, Shape, coarse, cut, no_points, path
from mcaprl.sims.drawing.shapes import LOOK, STEEL, TRAIL, WHITE, label
from mcaprl.sims.drawing.top_view import SIDE_PX, Body, FollowView, rgb
from mcaprl.sims.geometry import Vector, norm
from mcaprl.sims.powerline import camera, course
from mcaprl.sims.powerline.course import (
    ALONG_M,
    CHORDS,
    LENGTH_M,
    PHASES_M,
    POINTS_M,
    WIRES_M,
    Place,
    ground_height,
    nearest_on_line,
    point_on_line,
    towers,
)
from mcaprl.sims.powerline.quadrotor import ROTOR_OFFSET_M, Drone
from mcaprl.sims.powerline.rules import DECISION_S, Flight

Floats = NDArray[np.float64]

CERAMIC: Color = (0.45, 0.25, 0.18, 1.0)
COPPER: Color = (0.10, 0.10, 0.12, 1.0)
ROUTE: Color = (0.93, 0.76, 0.22, 1.0)
TOWER: Color = (0.42, 0.45, 0.48, 1.0)
BODY: Color = (0.16, 0.17, 0.20, 1.0)
ARM: Color = (0.95, 0.95, 0.93, 1.0)
PAINT: Color = (0.83, 0.18, 0.16, 1.0)
DISC: Color = (0.85, 0.88, 0.92, 0.45)
GRASS = (0.42, 0.52, 0.34)
NEEDLES = (0.16, 0.33, 0.20)
UP_A_LITTLE = np.array([0.0, 0.0, 1e-3])
"""Offset of an arrow's tip that prevents the length 0, which viewers reject."""
CORNERS_PER_M = 4
"""Rounding of surface corners to 1/4 m, which reduces their size in a log to a third."""
GROUND_X_M = np.concatenate(
    [np.linspace(-180, -30, 6), np.linspace(0, 48, 5), np.linspace(60, 720, 21)]
)
GROUND_Y_M = np.linspace(-260, 345, 17)
"""NED grid of the drawn ground, coarser than that of the depth camera."""
FIR_CORNERS = np.array([[1.0, 0.0], [-0.5, 0.75], [-0.5, -0.75]])
"""Base corners (x, y) of a drawn fir, as multiples of half the base's side."""
SHADES = 8  # Number of brightness levels of surfaces; the angle to the sun determines the level
SUN = np.array([0.45, 0.35, 0.82])

DRONE_SCALE = 5.0
ROUTE_PIECE_M = 12.0  # Length of the pieces of the route; see `cut`
MAP_ROUTE_M, MAP_TOWER_M = 3.0, 9.0
CROSSINGS = 6  # Number of cross-braced sections of a tower


def ros(ned: Vector) -> tuple[float, float, float]:
    """Transform an NED vector into ROS axes."""
    return ned.x, -ned.y, -ned.z


def _shaded(name: str, triangles: Floats, color: tuple[float, float, float]) -> list[Shape]:
    """Shade triangles (T, 3, 3) by their angle to the sun. Return one shape for each brightness."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    light = np.clip(normals @ SUN / np.linalg.norm(normals, axis=1), 0.0, 1.0)
    classes = np.minimum((light * SHADES).astype(np.int64), SHADES - 1)
    shapes = []
    for shade in range(SHADES):
        points = np.rint(triangles[classes == shade].reshape(-1, 3) * CORNERS_PER_M) / CORNERS_PER_M
        if len(points):
            bright = 0.45 + 0.75 * (shade + 0.5) / SHADES
            red, green, blue = (min(1.0, bright * part) for part in color)
            shapes.append(Shape(f"{name}_{shade}", "triangles", (red, green, blue, 1.0), points))
    return shapes


def _fir(tree: course.Tree) -> Floats:
    """Return a fir as a pyramid with three sides in ROS axes, (3, 3, 3) meters."""
    half_m = 0.5 * camera.TREE_SIDE_M * tree.height_m
    # Firs begin 1 m below the ground, because the drawn ground is up to 1 m too low.
    foot_z_m = course.ground_height(tree.x_m, tree.y_m) - 1.0
    foot = np.array([tree.x_m, -tree.y_m, foot_z_m])
    corners = foot + np.pad(half_m * FIR_CORNERS, ((0, 0), (0, 1)))
    top = foot + np.array([0.0, 0.0, tree.height_m + 0.5])
    return np.array([[corners[i - 1], corners[i], top] for i in range(3)])


def _lattice(tower: course.Tower) -> Floats:
    """Return the beams of a tower in ROS axes as pairs of points, (N, 3)."""
    foot = np.array([tower.x_m, -tower.y_m, -tower.foot_z_m])
    height_m = tower.foot_z_m - tower.arm_z_m
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    rings = []
    for section in range(CROSSINGS + 1):
        share = section / CROSSINGS
        side_m = camera.MAST_FOOT_M + share * (camera.MAST_TOP_M - camera.MAST_FOOT_M)
        ring = np.column_stack([side_m * corners, np.full(4, share * height_m)])
        rings.append(foot + ring)
    pairs = []
    for lower, upper in itertools.pairwise(rings):
        for i in range(4):
            j = (i + 1) % 4
            pairs += [lower[i], upper[i], lower[i], upper[j], upper[i], upper[j]]
    return np.array(pairs)


def _arm(index: int, tower: course.Tower) -> list[Shape]:
    """Return the arm of a tower and its insulators."""
    right = np.array([tower.right[0], -tower.right[1], 0.0])
    middle = np.array([tower.x_m, -tower.y_m, -tower.arm_z_m])
    yaw_rad = math.atan2(right[1], right[0])
    size = (2 * course.ARM_HALF_LENGTH_M, 0.5, 0.4)
    at = (float(middle[0]), float(middle[1]), float(middle[2]))
    shapes = [Shape(f"arm_{index}", "box", STEEL, size=size, position=at, yaw_rad=yaw_rad)]
    size = (0.25, 0.25, course.ARM_BELOW_WIRES_M)
    for phase, phase_m in enumerate(course.PHASES_M):
        x_m, y_m, z_m = middle + phase_m * right + [0.0, 0.0, course.ARM_BELOW_WIRES_M / 2]
        name, at = f"insulator_{index}_{phase}", (float(x_m), float(y_m), float(z_m))
        shapes.append(Shape(name, "cylinder", CERAMIC, size=size, position=at))
    return shapes


def _line() -> list[Shape]:
    route = course.to_ros(course.POINTS_M)
    legs = cut(np.stack([route[:-1], route[1:]], axis=1).reshape(-1, 3), ROUTE_PIECE_M)
    shapes = [Shape("route", "segments", ROUTE, legs, size=(0.12, 0.0, 0.0))]
    for index, tower in enumerate(course.towers()):
        lattice = _lattice(tower)
        shapes.append(Shape(f"tower_{index}", "segments", TOWER, lattice, size=(0.3, 0.0, 0.0)))
        shapes += _arm(index, tower)
    wires = camera.world_wires().reshape(-1, 3)
    shapes.append(Shape("conductors", "segments", COPPER, wires, size=(0.16, 0.0, 0.0)))
    return shapes


def _drone() -> list[Shape]:
    """Return the drone's parts in its own frame."""
    arm_m = DRONE_SCALE * ROTOR_OFFSET_M
    turns = ((1, 1), (-1, -1), (1, -1), (-1, 1))
    names = ("front_left", "rear_right", "front_right", "rear_left")
    arm = functools.partial(
        _part, kind="box", color=ARM, size=(2 * math.sqrt(2) * arm_m, 0.12, 0.08)
    )
    return [
        _part("body", "box", BODY, (0.9, 0.55, 0.3)),
        _part("nose", "box", PAINT, (0.3, 0.4, 0.2), (0.5, 0.0, 0.05)),
        arm("arms_a", yaw_rad=math.pi / 4),
        arm("arms_b", yaw_rad=-math.pi / 4),
        _part("camera", "sphere", BODY, (0.3, 0.3, 0.3), (0.3, 0.0, -0.25)),
        *(
            _part(f"rotor_{name}", "cylinder", DISC, (1.2, 1.2, 0.04), (x * arm_m, y * arm_m, 0.16))
            for name, (x, y) in zip(names, turns, strict=True)
        ),
    ]


def _part(
    name: str,
    kind: Kind,
    color: Color,
    size: tuple[float, float, float],
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    yaw_rad: float = 0.0,
) -> Shape:
    return Shape(f"drone_{name}", kind, color, no_points(), size, position, yaw_rad, "drone")


@functools.cache
def ground_shapes() -> tuple[Shape, ...]:
    """Return the ground and the firs."""
    firs = np.concatenate([_fir(tree) for tree in course.trees()])
    ground = _shaded("ground", camera.grid_triangles(GROUND_X_M, GROUND_Y_M), GRASS)
    return (*ground, *_shaded("firs", firs, NEEDLES))


@functools.cache
def static_shapes() -> tuple[Shape, ...]:
    """Return the shapes that never change: the ground, the rest of the world, and the drone."""
    return (*ground_shapes(), *_line(), *_drone())


@functools.cache
def map_shapes() -> tuple[Shape, ...]:
    """Return the route and the tops of the towers for a view of the whole world from above."""
    tops = np.array([[one.x_m, -one.y_m, -one.arm_z_m] for one in course.towers()])
    size = (MAP_TOWER_M, MAP_TOWER_M, MAP_TOWER_M)
    return (
        Shape("route", "line", ROUTE, course.to_ros(course.POINTS_M), size=(MAP_ROUTE_M, 0.0, 0.0)),
        Shape("towers", "spheres", STEEL, tops, size=size),
    )


def moving_shapes(flight: Flight, trail_m: Sequence[tuple[float, ...]]) -> tuple[Shape, ...]:
    """Return the shapes that change with each step; `trail_m` are the last positions, NED."""
    position = flight.drone.position_m
    place = course.nearest_on_line(position)
    here = np.array(ros(position))
    # Shapes near the drone use its frame, so that their points repeat and compress well in logs.
    level, origin = "base_stabilized", np.zeros(3)
    link = coarse(np.array([origin, ros(place.point_m) - here]))
    ahead = coarse(np.array([ros(course.point_on_line(place.along_m + 6.0)) - here]))
    arrow = np.array([origin, np.array(ros(flight.command_m_s)) + UP_A_LITTLE])
    return (
        Shape("trail", "line", TRAIL, course.to_ros(path(trail_m)), size=(0.15, 0.0, 0.0)),
        Shape("offset", "line", LOOK, link, size=(0.08, 0.0, 0.0), frame=level),
        Shape("ahead", "spheres", LOOK, ahead, size=(0.4, 0.4, 0.4), frame=level),
        Shape("command", "arrow", WHITE, arrow, size=(0.12, 0.3, 0.4), frame=level),
        label(norm(flight.drone.velocity_m_s), 2.0, level),
    )


def drone_frames(drone: Drone) -> tuple[Frame, ...]:
    """Return the drone's level frame in the map, and the body's frame in the level frame."""
    # NED axes are ROS axes rotated by half a turn about x: y and z change sign, also in
    # quaternions.
    q = drone.attitude
    return (
        Frame("base_stabilized", ros(drone.position_m), (0.0, 0.0, 0.0, 1.0)),
        Frame("drone", (0.0, 0.0, 0.0), (q.x, -q.y, -q.z, q.w), parent="base_stabilized"),
    )


def camera_frame(view: str) -> Frame:
    """Return the camera's optical frame, relative to the drone."""
    half = math.sqrt(0.5)
    rotations = {"front": (-0.5, 0.5, -0.5, 0.5), "down": (half, -half, 0.0, 0.0)}
    return Frame("camera", ros(camera.CAMERA_AT_M[view]), rotations[view], parent="drone")


def telemetry(flight: Flight) -> dict[str, float]:
    """Return the state that `info` does not contain, in ROS axes; names include the units."""
    drone = flight.drone
    x_m, y_m, z_m = ros(drone.position_m)
    tilt_cosine = 1.0 - 2.0 * (drone.attitude.x**2 + drone.attitude.y**2)
    return {
        "x_m": x_m,
        "y_m": y_m,
        "z_m": z_m,
        "tilt_rad": math.acos(min(1.0, max(-1.0, tilt_cosine))),
        "wire_distance_m": course.wire_distance(drone.position_m),
        "height_m": z_m - course.ground_height(drone.position_m.x, drone.position_m.y),
    }


VIEW_M = 50.0
STRIP_TOP_PX, STRIP_BOTTOM_PX = 430, SIDE_PX - 34
STRIP_M = 180.0  # Length of the part of the line that the strip shows; heights have the same scale
DRONE_DOWN_PX = 45  # Distance of the drone from the top of the strip
_SKY = (158, 188, 212)
_GROUND = (88, 112, 74)
_SAMPLE_M = 2.0


class PowerlineView:
    """Renderer of one image per step, shown in a window in mode `human`."""

    def __init__(self, render_mode: Literal["human", "rgb_array"]) -> None:
        """Prepare the shapes that never change."""
        frames_per_s = round(1.0 / DECISION_S)
        floor = ground_shapes()
        above = static_shapes()[len(floor) :]
        self._view = FollowView(render_mode, "powerline", above, VIEW_M, frames_per_s, floor)

    def draw(
        self, flight: Flight, trail_m: Sequence[tuple[float, ...]], reward: float
    ) -> NDArray[np.uint8]:
        """Render the drone and its surroundings, (600, 600, 3)."""
        drone = flight.drone
        x_m, y_m, z_m = ros(drone.position_m)
        place = nearest_on_line(drone.position_m)
        text = (
            f"{norm(drone.velocity_m_s):4.1f} m/s   {place.distance_m:.2f} m off the line   "
            f"at {place.along_m:.0f} m   reward {reward:+.2f}"
        )
        body = Body("drone", x_m, y_m, 0.0, z_m)
        self._view.draw(moving_shapes(flight, trail_m), body, text)
        self._draw_strip(place, z_m)
        return self._view.show()

    def close(self) -> None:
        """Close the window."""
        self._view.close()

    def _draw_strip(self, place: Place, height_m: float) -> None:
        """Draw the side view of the line and the drone."""
        draw = self._view.canvas.pygame.draw
        box_px = (0, STRIP_TOP_PX, SIDE_PX, STRIP_BOTTOM_PX - STRIP_TOP_PX)
        strip = self._view.canvas.strip(box_px, _SKY)

        def pixels(along_m: Floats, heights_m: Floats) -> list[tuple[float, float]]:
            scale_px = SIDE_PX / STRIP_M
            across = SIDE_PX / 2 + scale_px * (along_m - place.along_m)
            down = DRONE_DOWN_PX - scale_px * (heights_m - height_m)
            return list(zip(across.tolist(), down.tolist(), strict=True))

        along_m = np.arange(0.0, LENGTH_M + _SAMPLE_M, _SAMPLE_M)
        ground = pixels(along_m, _ground_under(along_m))
        below = [(ground[-1][0], 10.0 * SIDE_PX), (ground[0][0], 10.0 * SIDE_PX)]
        draw.polygon(strip, _GROUND, [*ground, *below])
        for index, tower in enumerate(towers()):
            ends = pixels(ALONG_M[[index, index]], -np.array([tower.foot_z_m, tower.arm_z_m]))
            draw.line(strip, rgb(STEEL), *ends, 4)
        draw.aalines(strip, rgb(COPPER), False, pixels(*_middle_wire()))
        draw.aalines(strip, rgb(ROUTE), False, pixels(ALONG_M, -POINTS_M[:, 2]))
        here = pixels(np.array([place.along_m]), np.array([height_m]))[0]
        draw.circle(strip, rgb(PAINT), here, 5)


def _ground_under(along_m: Floats) -> Floats:
    """Return the heights (N,) of the ground below points of the line."""
    points = [point_on_line(along) for along in along_m]
    return np.array([ground_height(point.x, point.y) for point in points])


def _middle_wire() -> tuple[Floats, Floats]:
    """Return distances along the line, and heights of the middle conductor at these distances."""
    shares = np.linspace(0.0, 1.0, CHORDS + 1)
    spans = WIRES_M[len(PHASES_M) // 2 :: len(PHASES_M)]
    along_m = ALONG_M[:-1, None] + shares * np.diff(ALONG_M)[:, None]
    return along_m.ravel(), -spans[:, :, 2].ravel()
