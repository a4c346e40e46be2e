"""Fleet of the lane sim: starting states, steps and observations of N cars."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.compiled import Arrays, array_at, compiled, ready, ready_at
from mcaprl.errors import UsageError
from mcaprl.sims.drawing.depth import encode_depth, encode_nearness
from mcaprl.sims.geometry import moving, project, wrap_angle
from mcaprl.sims.lane.block import car_info, observe_cars, step_cars, step_only_car
from mcaprl.sims.lane.camera import IMAGE_SHAPE, CarCamera
from mcaprl.sims.lane.classic import CLASSIC_DECISION_S, CLASSIC_SUBSTEPS, STRAIGHT, step_classic
from mcaprl.sims.lane.course import COURSE, LANE_HALF_WIDTH_M, NEXT_TURN
from mcaprl.sims.lane.rays import RAY_OBSERVATION_LIMIT, RAY_OBSERVATION_NAMES, observe_all_rays
from mcaprl.sims.lane.rules import (
    ACTION_COMMANDS,
    ACTION_MEANINGS,
    ALONG,
    COMMAND_UNITS,
    DECISION_S,
    DRIVING,
    MAX_SPEED_M_S,
    OBSERVATION_LIMIT,
    OBSERVATION_NAMES,
    REASONS,
    STARTED_AT,
    SUBSTEPS,
    Car,
    Command,
    drive,
    located,
    observe,
    store_car,
)
from mcaprl.sims.vehicle.controls import KINDS, Controls, check_actions, check_name, pose_from
from mcaprl.sims.vehicle.fleet import CAR_INFO, GOING_ON, Fleet, Generators, draw, spread

OBSERVATIONS = ("state", "depth", "depth-commands", "dashboard", "rays")
_NAMES = {"state": OBSERVATION_NAMES, "rays": RAY_OBSERVATION_NAMES}
MOTION = slice(2, 4)  # Indices of speed and steering in the observed state
STEERING_SEEN = 3  # Index of the last steering command in the observed state
COMMANDS = 32
"""Number of decisions whose commands are observed with `depth-commands`: 8 s by default."""

CONTROLS = {
    "discrete": Controls(
        Command._fields, COMMAND_UNITS, ACTION_MEANINGS, np.array(ACTION_COMMANDS)
    ),
    "continuous": Controls(Command._fields, COMMAND_UNITS),
}
"""Controls by the argument `actions`."""

Step = Callable[[Sequence[float]], tuple[Any, float, int, dict[str, Any]]]
"""Step of a fleet of one car; see `Fleet.step_one`."""


class LaneFleet(Fleet):
    """N cars on the course; takes the same arguments as `LaneKeepingEnv`."""

    reasons: ClassVar[tuple[str, ...]] = REASONS
    truncates: ClassVar[tuple[bool, ...]] = (False,) * len(REASONS)

    def __init__(
        self,
        count: int,
        rules: str = "default",
        observation: str = "state",
        start: str | None = None,
        actions: str = "discrete",
    ) -> None:
        """Allocate N cars; `begin` starts them."""
        check_name("rules", rules, ("default", "classic", "classic-code"))
        check_name("observation", observation, OBSERVATIONS)
        check_name("start", start, (None, "anywhere", "line"))
        check_actions(actions, KINDS, rules)
        self._classic, self._by_code = rules != "default", rules == "classic-code"
        self.has_barriers = not self._classic
        self._on_line = start == "line" or (self._classic and start is None)
        super().__init__(
            count,
            _space(observation, 1.0 if actions == "discrete" else 2.0),
            _NAMES.get(observation, ()),
            CONTROLS[actions],
            CLASSIC_DECISION_S if self._classic else DECISION_S,
        )
        self._cars = np.zeros((count, STARTED_AT + 1))
        self._randoms = Generators(count)
        self._states = np.zeros((count, len(OBSERVATION_NAMES)), dtype=np.float32)
        self._rays = np.zeros((count, len(RAY_OBSERVATION_NAMES)), dtype=np.float32)
        # Acceleration and steering of the last decisions, newest first; 0 before the start.
        self._commands = np.zeros((count, COMMANDS, 2), dtype=np.float32)
        self.has_rays, self._has_dashboard = observation == "rays", observation == "dashboard"
        self._has_commands = observation == "depth-commands"
        self._has_images = observation == "depth" or self._has_commands or self._has_dashboard
        self._seen = self._rays if self.has_rays else self._states
        self._has_fast_step = observation in ("state", "rays") and not self._classic
        self._encode = encode_nearness if self._classic else encode_depth
        self._camera: CarCamera | None = None
        self._depth_m: dict[int, NDArray[np.float32]] = {}

    def car(self, i: int) -> Car:
        """Return the state of a car."""
        return Car._make(self._cars[i, :STARTED_AT].tolist())

    def substeps(self, before: Car, command: Sequence[float]) -> list[Car]:
        """Return the states of a car after each 0.05 s of a decision; the last is at the end."""
        wanted = Command(*command)
        if not self._classic:
            return [drive(before, wanted, 1 + k) for k in range(SUBSTEPS)]
        cars = [before]
        for _ in range(CLASSIC_SUBSTEPS):
            cars.append(drive(cars[-1], wanted, 1))
        return cars[1:]

    def begin(self, i: int, random: np.random.Generator, options: dict[str, Any] | None) -> None:
        """Start car i; see "Starting State" of `LaneKeepingEnv`."""
        self._randoms.use(i, random)
        if not options:
            self._begin_chosen(np.array([i]))
            return
        car, row = car_from(options), self._cars[i]
        store_car(car, row)
        row[STARTED_AT] = row[ALONG]
        observe(car, self._states[i])
        if self.has_rays:
            observe_all_rays(self._cars[i : i + 1], self._rays[i : i + 1], self.has_barriers)
        self.rewards[i], self.ends[i] = 0.0, GOING_ON
        self._commands[i] = 0.0
        self._depth_m.pop(i, None)

    def begin_all(self, chosen: NDArray[np.int64], randoms: Sequence[np.random.Generator]) -> None:
        """Start episodes of the chosen cars."""
        self._randoms.complete(chosen, randoms)
        self._begin_chosen(chosen)

    def _begin_chosen(self, chosen: NDArray[np.int64]) -> None:
        """Start episodes of the chosen cars, which all have a generator."""
        self._start_chosen(chosen)
        if self.has_rays:
            seen = np.empty((len(chosen), self._rays.shape[1]), dtype=np.float32)
            observe_all_rays(self._cars[chosen], seen, self.has_barriers)
            self._rays[chosen] = seen
        if self._has_commands:
            self._commands[chosen] = 0.0
        if self._depth_m:
            for i in chosen.tolist():
                self._depth_m.pop(i, None)

    def advance(self) -> None:
        """Advance each car by one decision."""
        self._step()
        if self._has_commands:
            self._commands[:, 1:] = self._commands[:, :-1]
            self._commands[:, 0, 0] = self.commands[:, 0]
            self._commands[:, 0, 1] = self._states[:, STEERING_SEEN]
        if self.has_rays:
            observe_all_rays(self._cars, self._rays, self.has_barriers)
        if self._depth_m:
            self._depth_m.clear()

    @cached_property
    def step_one(self) -> Step:
        """Function that advances the only car of the fleet, compiled on first use."""
        if not self._has_fast_step:
            return super().step_one
        # A function with local variables is faster than a method with attributes.
        arrays = (self._cars[0], self.rewards, self.ends, self._states[0])
        drive, seen = ready_at(step_only_car, arrays, examples=(0.0, 0.0)), self._seen_only
        depth_m = self._depth_m

        def step(command: Sequence[float]) -> tuple[Any, float, int, dict[str, Any]]:
            reward, end, offset_m, heading_error_rad, speed_m_s, progress_m = drive(*command)
            if depth_m:
                depth_m.clear()
            # A dict display is faster than `dict(zip(CAR_INFO, ...))`.
            info = {
                "lateral_offset_m": offset_m,
                "heading_error_rad": heading_error_rad,
                "speed_m_s": speed_m_s,
                "progress_m": progress_m,
            }
            return seen(), reward, end, info

        return step

    def start_one(
        self, random: np.random.Generator, options: dict[str, Any] | None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode of the only car of the fleet."""
        if options:
            return super().start_one(random, options)
        self._randoms.use(0, random)
        offset_m, heading_error_rad, speed_m_s = self._start_only()
        if self._depth_m:
            self._depth_m.clear()
        if self._has_commands:
            self._commands[0] = 0.0
        seen = self.observation(0) if self._has_images else self._seen_only()
        info = {
            "lateral_offset_m": offset_m,
            "heading_error_rad": heading_error_rad,
            "speed_m_s": speed_m_s,
            "progress_m": 0.0,
        }
        return seen, info

    def _kernel(self) -> tuple[Any, ...]:
        arrays = (self._cars, self.commands, self.rewards, self.ends, self._states)
        return (step_classic, *arrays, self._by_code) if self._classic else (step_cars, *arrays)

    @cached_property
    def _start_chosen(self) -> Callable[[NDArray[np.int64]], None]:
        kind = (self._on_line, self._classic)
        outputs = (self._cars, self.rewards, self.ends, self._states)
        examples = (np.zeros(0, dtype=np.int64),)
        return ready(start_cars, self._randoms.addresses, *kind, *outputs, examples=examples)

    # Only a fleet of one car uses the next functions.

    @cached_property
    def _start_only(self) -> Callable[[], tuple[float, float, float]]:
        arrays = (self._randoms.addresses, self._cars[0], self.rewards, self.ends, self._states[0])
        return ready_at(start_only_car, arrays, self._on_line, self._classic)

    @cached_property
    def _seen_only(self) -> Callable[[], NDArray[np.float32]]:
        copy = self._observe_only
        if not self.has_rays:
            return copy
        observe_rays = ready(observe_all_rays, self._cars, self._rays, self.has_barriers)

        def see() -> NDArray[np.float32]:
            observe_rays()
            return copy()

        return see

    def observation(self, i: int) -> Any:
        """Return the observation of car i."""
        if not self._has_images:
            return self._seen[i].copy()
        depth = self._encode(self.depth_image_m(i))[:, :, np.newaxis]
        numbers = {key: part[i] for key, part in self._numbers().items()}
        return {"depth": depth, **numbers} if numbers else depth

    def observations(self) -> Any:
        """Return the observations of all cars."""
        if not self._has_images:
            return self._seen.copy()
        images_m = np.stack([self.depth_image_m(i) for i in range(self.count)])
        depth = self._encode(images_m)[..., np.newaxis]
        numbers = self._numbers()
        return {"depth": depth, **numbers} if numbers else depth

    def _numbers(self) -> dict[str, NDArray[np.float32]]:
        """Return the non-image arrays of Dict observations by key; empty for other observations."""
        if self._has_dashboard:
            return {"motion": self._motions()}
        if self._has_commands:
            return {"commands": self._commands.reshape(self.count, -1).copy()}
        return {}

    def _motions(self) -> NDArray[np.float32]:
        """Return an (N, 3) array: speed, last steering command and direction of the next turn."""
        along_m = self._cars[:, ALONG] % COURSE.length_m
        legs = np.searchsorted(COURSE.along_m, along_m, side="right") - 1
        turns = NEXT_TURN[np.minimum(legs, len(NEXT_TURN) - 1)]
        return np.column_stack([self._states[:, MOTION], turns]).astype(np.float32)

    def depth_image_m(self, i: int) -> NDArray[np.float32]:
        """Return the image of car i: (84, 84) distances along each ray, meters."""
        if i not in self._depth_m:
            if self._camera is None:
                self._camera = CarCamera(has_barriers=self.has_barriers)
            self._depth_m[i] = self._camera.image_m(self.car(i))
        return self._depth_m[i]

    def places(self) -> NDArray[np.float64]:
        """Return the positions of all cars, (N, 2) x and y in the map, meters."""
        return self._cars[:, :2].copy()

    def info(self, i: int) -> dict[str, Any]:
        """Return the `info` of car i."""
        return {key: values.item(i) for key, values in self.infos().items()}

    def infos(self) -> dict[str, NDArray[Any]]:
        """Return the `info` of all cars."""
        values = np.empty((len(CAR_INFO), self.count))
        car_info(self._cars, values)
        return dict(zip(CAR_INFO, values, strict=True))


def _space(observation: str, steering: float) -> spaces.Space[Any]:
    """Return the space of an observation; `steering` is the limit of the observed steering."""
    depth = spaces.Box(0, 255, (*IMAGE_SHAPE, 1), np.uint8)
    if observation == "depth":
        return depth
    if observation == "depth-commands":
        limits = np.tile(np.array([1.0, steering], np.float32), COMMANDS)
        return spaces.Dict({"depth": depth, "commands": spaces.Box(-limits, limits)})
    if observation == "dashboard":
        ends = np.array([[0, -steering, -1], [1, steering, 1]], dtype=np.float32)
        return spaces.Dict({"depth": depth, "motion": spaces.Box(*ends)})
    if observation == "state":
        limit = OBSERVATION_LIMIT.copy()
        limit[STEERING_SEEN] = steering
        return spaces.Box(-limit, limit)
    limit = RAY_OBSERVATION_LIMIT.copy()
    limit[-3] = steering
    low = -limit
    low[:-3] = 0.0
    return spaces.Box(low, limit)


SHARES = 4  # Number of random numbers for a start; a start on the line uses the first two
LINE_M = 2.0  # Distance of the start line along the path
AFTER_CORNER_M, BEFORE_CORNER_M = 2.0, 8.0
"""Minimum distances of random starts after and before corners, so that cars can turn in time."""
FASTEST_START_M_S = 10.0

_CLEAR_M: NDArray[np.float64] = np.concatenate(
    [[0.0], np.cumsum(np.diff(COURSE.along_m) - AFTER_CORNER_M - BEFORE_CORNER_M)]
)
"""(legs + 1,) length of the path up to each corner, counting only parts where random starts are
allowed."""


@compiled
def start_on_line(shares: NDArray[np.float64]) -> Car:
    """Return a car at rest near the start: offset up to 0.3 m, heading error up to 0.05 rad."""
    return beside(0, LINE_M, spread(shares[0], 0.3), spread(shares[1], 0.05), 0.0)


@compiled
def start_anywhere(shares: NDArray[np.float64]) -> Car:
    """Return a car near the path; four random numbers set position, offset, heading and speed."""
    clear_m = shares[0] * _CLEAR_M[-1]
    leg = 0
    while _CLEAR_M[leg + 1] <= clear_m:
        leg += 1
    rest_m = AFTER_CORNER_M + clear_m - _CLEAR_M[leg]
    offset_m, error_rad = spread(shares[1], 1.5), spread(shares[2], 0.2)
    return beside(leg, rest_m, offset_m, error_rad, FASTEST_START_M_S * shares[3])


@compiled
def beside(leg: int, rest_m: float, offset_m: float, error_rad: float, speed_m_s: float) -> Car:
    """Return a car beside a point of the path, with an offset and a heading error."""
    # The point, `rest_m` from the start of the leg, must be the path point nearest to the car.
    along_m = COURSE.along_m[leg] + rest_m
    cos, sin = COURSE.forward[leg]
    x_m = COURSE.points_m[leg, 0] + rest_m * cos - offset_m * sin
    y_m = COURSE.points_m[leg, 1] + rest_m * sin + offset_m * cos
    yaw_rad, error_rad = wrap_angle(COURSE.yaw_rad[leg] + error_rad), wrap_angle(error_rad)
    return Car(x_m, y_m, yaw_rad, speed_m_s, 0.0, along_m, offset_m, error_rad, 0.0)


@compiled
def start_at_random(shares: NDArray[np.float64], on_line: bool, classic: bool) -> Car:
    """Return a car at the start of an episode."""
    if not on_line:
        return start_anywhere(shares)
    car = start_on_line(shares)
    return drive(car, ACTION_COMMANDS[STRAIGHT], CLASSIC_SUBSTEPS) if classic else car


@compiled
def start_only_car(arrays: Arrays, on_line: bool, classic: bool) -> tuple[float, float, float]:
    """Start a car like `start_cars`; return its offset, heading error and speed."""
    shares = np.empty(SHARES)
    draw(array_at(arrays, 0, (1,), np.intp)[0], shares)
    car = start_at_random(shares, on_line, classic)
    row = array_at(arrays, 1, (STARTED_AT + 1,), np.float64)
    store_car(car, row)
    row[STARTED_AT] = car.along_m
    array_at(arrays, 2, (1,), np.float64)[0] = 0.0
    array_at(arrays, 3, (1,), np.int64)[0] = DRIVING
    observe(car, array_at(arrays, 4, (len(OBSERVATION_NAMES),), np.float32))
    return car.offset_m, car.heading_error_rad, car.speed_m_s


@compiled
def start_cars(
    addresses: NDArray[np.intp],
    on_line: bool,
    classic: bool,
    cars: NDArray[np.float64],
    rewards: NDArray[np.float64],
    ends: NDArray[np.int64],
    observations: NDArray[np.float32],
    chosen: NDArray[np.int64],
) -> None:
    """Start the `chosen` (K,) of N cars (N, 10): a `Car`, then its distance along the path."""
    # A classic car on the start line first drives straight ahead for a second.
    shares = np.empty(SHARES)
    for i in chosen:
        draw(addresses[i], shares)
        car = start_at_random(shares, on_line, classic)
        store_car(car, cars[i])
        cars[i, STARTED_AT] = car.along_m
        rewards[i], ends[i] = 0.0, DRIVING
    observe_cars(cars, observations, chosen)


def car_from(options: dict[str, Any]) -> Car:
    """Return the starting state in the options of `reset`."""
    pose = pose_from(options, 0.0, MAX_SPEED_M_S)
    place = project(COURSE, pose.x_m, pose.y_m, 0.0, COURSE.length_m)
    if abs(place.offset_m) > LANE_HALF_WIDTH_M:
        raise UsageError(
            f"pose ({pose.x_m}, {pose.y_m}) is {abs(place.offset_m):.1f} m from the path:"
            f" the lane's edge is at {LANE_HALF_WIDTH_M} m"
        )
    return located(moving(*pose), 0.0, place.along_m, 0.0)
