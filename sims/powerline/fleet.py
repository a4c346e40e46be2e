"""Fleet of the powerline sim: starting states, steps and observations of N drones."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.sims.drawing.depth import encode_depth, encode_nearness
from mcaprl.sims.geometry import Vector, norm, plus
from mcaprl.sims.powerline.camera import CAMERAS, IMAGE_SHAPE, DroneCamera
from mcaprl.sims.powerline.course import (
    LENGTH_M,
    POINTS_M,
    TANGENTS,
    nearest_on_line,
    point_on_line,
)
from mcaprl.sims.powerline.quadrotor import PLANTS, Drone, fly
from mcaprl.sims.powerline.rules import (
    ACTION_MEANINGS,
    AXES,
    CHECK_S,
    CLASSIC_DECISION_S,
    CLASSIC_FIRST_COMMAND_M_S,
    CLASSIC_VELOCITY_STEP_M_S,
    DECISION_S,
    DIRECTIONS,
    FIRST_COMMAND_M_S,
    FLIGHT_SIZE,
    FLYING,
    MAX_COMMAND_M_S,
    OBSERVATION_LIMIT,
    OBSERVATION_NAMES,
    REASONS,
    VELOCITY_STEP_M_S,
    Flight,
    approach,
    begin,
    classic_end,
    collides,
    end_of,
    flight_at,
    observe,
    step_classic,
    step_flights,
    store_bearings,
    store_flight,
)
from mcaprl.sims.vehicle.controls import (
    KINDS,
    Controls,
    check_actions,
    check_name,
    check_range,
    read_pose,
)
from mcaprl.sims.vehicle.fleet import GOING_ON, Fleet

MAX_WIND_M_S = 8.0
MAX_GUST_M_S = 3.0
ACTION_KINDS = (*KINDS, "increments")
MOTION = slice(3, 9)
"""Slice of the observation `state` in `motion`: velocity, and command minus velocity."""
_INFO = ("lateral_offset_m", "vertical_offset_m", "line_distance_m", "speed_m_s", "progress_m")


class PowerlineFleet(Fleet):
    """N drones on the line, each with its own wind; see `PowerlineEnv` for the arguments."""

    reasons: ClassVar[tuple[str, ...]] = REASONS
    truncates: ClassVar[tuple[bool, ...]] = (False,) * len(REASONS)

    def __init__(
        self,
        count: int,
        rules: str = "default",
        observation: str = "state",
        camera: str = "down",
        start: str = "anywhere",
        plant: str | None = None,
        wind_m_s: float = 0.0,
        gust_m_s: float = 0.0,
        actions: str = "discrete",
    ) -> None:
        """Allocate N drones; `begin` starts them."""
        check_name("rules", rules, ("default", "classic"))
        check_name("observation", observation, ("state", "depth"))
        check_name("camera", camera, CAMERAS)
        check_name("start", start, ("anywhere", "line"))
        check_name("plant", plant, (None, *PLANTS))
        check_actions(actions, ACTION_KINDS, rules)
        self.classic = classic = rules == "classic"
        check_range("wind_m_s", wind_m_s, 0.0, MAX_WIND_M_S)
        check_range("gust_m_s", gust_m_s, 0.0, 0.0 if classic else MAX_GUST_M_S)
        self.velocity_step_m_s = CLASSIC_VELOCITY_STEP_M_S if classic else VELOCITY_STEP_M_S
        super().__init__(
            count,
            _space(observation, classic),
            OBSERVATION_NAMES if observation == "state" else (),
            _controls(actions, self.velocity_step_m_s),
            CLASSIC_DECISION_S if classic else DECISION_S,
            noise_size=3 if gust_m_s else 0,
        )
        self._plant = PLANTS.index(plant or ("point" if classic else "quad"))
        self.are_changes = actions != "continuous"
        self._on_line = start == "line"
        self._wind_m_s, self._gust_m_s = wind_m_s, float(gust_m_s)
        self._shows_state = observation == "state"
        self.camera_view = camera
        self._camera: DroneCamera | None = None
        self._depth_m: dict[int, NDArray[np.float32]] = {}
        self._flights = np.zeros((count, FLIGHT_SIZE))
        self._bearings = np.zeros((count, len(_INFO)))
        self._started_at_m = np.zeros(count)
        self._seen = np.zeros((count, len(OBSERVATION_NAMES)), dtype=np.float32)

    def flight(self, i: int) -> Flight:
        """Return the state of a drone, NED."""
        return flight_at(self._flights[i])

    def drones_from(self, before: Flight) -> list[Drone]:
        """Return the states of the fleet's only drone after each 0.05 s of its last decision."""
        # The decision began in `before`. After the end of the episode, the drone keeps its state.
        after = self.flight(0)
        wind_m_s = plus(after.wind_m_s, after.gust_m_s)
        drones, drone = list[Drone](), before.drone
        for _ in range(round(self.step_duration_s / CHECK_S)):
            for part_s in (CHECK_S / 2, CHECK_S):
                has_ended = drone == after.drone
                going = (self._plant, drone, after.command_m_s, wind_m_s, part_s)
                drones.append(drone if has_ended else fly(*going))
            drone = drones[-1]
        return drones

    def begin(self, i: int, random: np.random.Generator, options: dict[str, Any] | None) -> None:
        """Start drone i; see "Starting State" of `PowerlineEnv`."""
        wind = draw_wind(random, self._wind_m_s)
        if options:
            flight = flight_from(options, wind, self.classic)
        elif self.classic:
            flight = start_on_line(random, self._plant, CLASSIC_FIRST_COMMAND_M_S, wind)
        elif self._on_line or random.random() < 0.5:
            flight = start_on_line(random, self._plant, FIRST_COMMAND_M_S, wind)
        else:
            flight = start_anywhere(random, wind)
        store_flight(flight, self._flights[i])
        self._started_at_m[i] = flight.furthest_m
        self.rewards[i], self.ends[i] = 0.0, GOING_ON
        observe(flight, self._seen[i])
        store_bearings(self._flights[i : i + 1], self._bearings[i : i + 1])
        self._depth_m.pop(i, None)

    def advance(self) -> None:
        """Advance all drones by a decision."""
        self._step()
        store_bearings(self._flights, self._bearings)
        self._depth_m.clear()

    def _kernel(self) -> tuple[Any, ...]:
        before = (self._plant, self._flights, self.commands)
        after = (self.rewards, self.ends, self._seen)
        if self.classic:
            return step_classic, *before, *after
        return step_flights, *before, self.are_changes, self._gust_m_s, self.noise, *after

    def observation(self, i: int) -> Any:
        """Return the observation of drone i."""
        if self._shows_state:
            return self._seen[i].copy()
        if self.classic:
            return encode_nearness(self.depth_image_m(i))[:, :, np.newaxis]
        depth = encode_depth(self.depth_image_m(i))[:, :, np.newaxis]
        return {"depth": depth, "motion": self._seen[i, MOTION].copy()}

    def observations(self) -> Any:
        """Return the observations of all drones."""
        if self._shows_state:
            return self._seen.copy()
        seen = [self.observation(i) for i in range(self.count)]
        if self.classic:
            return np.stack(seen)
        return {key: np.stack([each[key] for each in seen]) for key in ("depth", "motion")}

    def depth_image_m(self, i: int) -> NDArray[np.float32]:
        """Return distances (84, 84) along the rays of drone i in meters, infinite without a hit."""
        if i not in self._depth_m:
            if self._camera is None:
                self._camera = DroneCamera(self.camera_view)
            self._depth_m[i] = self._camera.image_m(self.flight(i).drone)
        return self._depth_m[i]

    def places(self) -> NDArray[np.float64]:
        """Return the positions of all drones, (N, 2) x and y in the map, meters."""
        # The map has ROS axes: y points west.
        return self._flights[:, :2] * (1.0, -1.0)

    def info(self, i: int) -> dict[str, Any]:
        """Return the `info` of drone i."""
        *numbers, along_m = self._bearings[i].tolist()
        values = (*numbers, along_m - self._started_at_m.item(i))
        return dict(zip(_INFO, values, strict=True))

    def infos(self) -> dict[str, NDArray[Any]]:
        """Return the `info` of all drones."""
        *numbers, along_m = self._bearings.T.copy()
        return dict(zip(_INFO, (*numbers, along_m - self._started_at_m), strict=True))


def _controls(actions: str, step_m_s: float) -> Controls:
    """Return the controls of a kind of actions; discrete ones change the velocity by a step."""
    if actions == "continuous":
        return Controls(tuple(f"velocity_{axis}" for axis in AXES), ("8 m/s",) * 3)
    changes = tuple(f"change_{axis}" for axis in AXES), ("1 m/s",) * 3
    if actions == "increments":
        return Controls(*changes)
    return Controls(*changes, ACTION_MEANINGS, step_m_s * DIRECTIONS)


def _space(observation: str, classic: bool) -> spaces.Space[Any]:
    if observation == "state":
        return spaces.Box(-OBSERVATION_LIMIT, OBSERVATION_LIMIT)
    depth = spaces.Box(0, 255, (*IMAGE_SHAPE, 1), np.uint8)
    if classic:
        return depth
    limit = OBSERVATION_LIMIT[MOTION]
    return spaces.Dict({"depth": depth, "motion": spaces.Box(-limit, limit)})


POSE_NAMES = ("x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s")
FIRST_POINT_NOISE_M = 0.2
NOISE_M = 1.0
LAST_START_M = 20.0  # Minimum distance of random starts from the line's end
MAX_SPEED_M_S = 5.0


def draw_wind(random: np.random.Generator, greatest_m_s: float) -> Vector:
    """Draw an episode's steady horizontal wind, with a random speed and direction."""
    if not greatest_m_s:
        return Vector(0.0, 0.0, 0.0)
    speed_m_s = random.uniform(0.0, greatest_m_s)
    toward_rad = random.uniform(-np.pi, np.pi)
    return Vector(float(speed_m_s * np.cos(toward_rad)), float(speed_m_s * np.sin(toward_rad)), 0.0)


def start_on_line(
    random: np.random.Generator, plant: int, command: tuple[float, float, float], wind: Vector
) -> Flight:
    """Return a flight that hovers near the first point, then follows a command for 5 s."""
    noise = random.uniform(-FIRST_POINT_NOISE_M, FIRST_POINT_NOISE_M, 3)
    position = Vector(*(POINTS_M[0] + noise).tolist())
    return approach(plant, position, Vector(*command), wind)


def start_anywhere(random: np.random.Generator, wind: Vector) -> Flight:
    """Return a flight from a random position, with the velocity rounded to 0.5 m/s."""
    along_m = float(random.uniform(0.0, LENGTH_M - LAST_START_M))
    point = point_on_line(along_m)
    speed_m_s = random.uniform(0.0, MAX_SPEED_M_S)
    steps = np.rint(speed_m_s * TANGENTS[nearest_on_line(point).leg] / VELOCITY_STEP_M_S)
    # The factor 1 / sqrt(3) limits the length of the offset vector to NOISE_M.
    noise = random.uniform(-NOISE_M, NOISE_M, 3) / np.sqrt(3.0)
    position = Vector(*np.add(point, noise).tolist())
    return begin(position, Vector(*(VELOCITY_STEP_M_S * steps).tolist()), wind)


def flight_from(options: dict[str, Any], wind: Vector, classic: bool) -> Flight:
    """Return the starting state in the options of `reset`."""
    pose = read_pose(options, POSE_NAMES, least=3)
    position, velocity = Vector(*pose[:3]), Vector(*pose[3:])
    check_range("a pose's speed in m/s", norm(velocity), 0.0, MAX_COMMAND_M_S)
    place = nearest_on_line(position)
    end = classic_end(position, collides(position)) if classic else end_of(position, place)
    if end != FLYING:
        raise UsageError(
            f"pose {tuple(pose[:3])} ends the episode at once: {REASONS[end]},"
            f" {place.distance_m:.1f} m from the line (z points down)"
        )
    return begin(position, velocity, wind)
