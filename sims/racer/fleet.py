"""Fleet of the racer sim: starting states, steps and observations of N cars."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.compiled import compiled, ready
from mcaprl.errors import UsageError
from mcaprl.sims.geometry import leg_at, point_at
from mcaprl.sims.racer.block import StepResult, car_info, step_cars, step_only_car
from mcaprl.sims.racer.course import (
    HALF_WIDTH_PX,
    IMAGE_HEIGHT_PX,
    METERS_PER_PX,
    STARTED_AT,
    Car,
    Track,
    make_track,
    placed,
    store_car,
)
from mcaprl.sims.racer.rules import (
    ACTION_COMMANDS,
    ACTION_MEANINGS,
    COMMAND_UNITS,
    MAX_SPEED_M_S,
    OBSERVATION_NAMES,
    REASONS,
    STEP_S,
    TRUNCATES,
    Command,
    observe,
    walls_hit,
)
from mcaprl.sims.vehicle.controls import Controls, check_actions, check_name, pose_from
from mcaprl.sims.vehicle.fleet import CAR_INFO, GOING_ON, Fleet, Generators, draw, spread

_EVERY = tuple(range(len(ACTION_COMMANDS)))
ACTION_SETS: dict[object, tuple[int, ...]] = {
    "discrete": _EVERY,
    9: _EVERY,
    8: _EVERY[1:],
    5: _EVERY[:5],
}
_INFO = (*CAR_INFO, "gates_passed")
_ONLY = np.zeros(1, dtype=np.int64)  # Index of the only car of a fleet of one, as an array


class RacerFleet(Fleet):
    """N cars on one track; see `RacerEnv` for the arguments."""

    reasons: ClassVar[tuple[str, ...]] = REASONS
    truncates: ClassVar[tuple[bool, ...]] = TRUNCATES

    def __init__(
        self,
        count: int,
        rules: str = "default",
        observation: str = "rays",
        start: str | None = None,
        actions: int | str = "discrete",
        drift: bool = False,
        track_seed: int | None = None,
    ) -> None:
        """Allocate N cars; `begin` starts them."""
        check_name("rules", rules, ("default", "classic"))
        check_name("observation", observation, ("rays",))
        check_name("start", start, (None, "anywhere", "line"))
        check_actions(actions, (*ACTION_SETS, "continuous"), rules)
        check_name("drift", drift, (False, True))
        self.classic = rules == "classic"
        self.track = _track_of(track_seed)
        self.action_set = np.array(ACTION_SETS.get(actions, ()), dtype=np.int64)
        super().__init__(
            count,
            spaces.Box(-1.0, 1.0, (len(OBSERVATION_NAMES),), np.float32),
            OBSERVATION_NAMES,
            _controls(self.action_set),
            STEP_S,
        )
        on_line = start == "line" or (self.classic and start is None)
        self._kind = ANYWHERE if not on_line else EXACTLY if self.classic else ON_LINE
        self._randoms = Generators(count)
        self._drift = bool(drift)
        self._cars = np.zeros((count, STARTED_AT + 1))
        self._seen = np.zeros((count, len(OBSERVATION_NAMES)), dtype=np.float32)

    def car(self, i: int) -> Car:
        """Return the state of a car."""
        return Car._make(self._cars[i, :STARTED_AT].tolist())

    def begin(self, i: int, random: np.random.Generator, options: dict[str, Any] | None) -> None:
        """Start car i; see "Starting State" of `RacerEnv`."""
        self._randoms.use(i, random)
        if not options:
            self._begin_chosen(np.array([i]))
            return
        car, row = car_from(self.track, options), self._cars[i]
        store_car(car, row)
        row[STARTED_AT] = car.along_m
        observe(self.track, car, self.classic, self._seen[i])
        self.rewards[i], self.ends[i], self.commands[i] = 0.0, GOING_ON, 0.0

    def begin_all(self, chosen: NDArray[np.int64], randoms: Sequence[np.random.Generator]) -> None:
        """Start episodes of the chosen cars."""
        self._randoms.complete(chosen, randoms)
        self._begin_chosen(chosen)

    def _begin_chosen(self, chosen: NDArray[np.int64]) -> None:
        """Start episodes of the chosen cars, which all have a generator."""
        self._start_chosen(chosen)
        self.rewards[chosen], self.ends[chosen], self.commands[chosen] = 0.0, GOING_ON, 0.0

    def start_one(
        self, random: np.random.Generator, options: dict[str, Any] | None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode of the only car of the fleet."""
        if options:
            return super().start_one(random, options)
        self._randoms.use(0, random)
        self._start_chosen(_ONLY)
        self.rewards[0], self.ends[0], self.commands[0] = 0.0, GOING_ON, 0.0
        return self._observe_only(), self.info(0)

    def advance(self) -> None:
        """Advance all cars by one step."""
        self._step()

    def step_one(self, command: Sequence[float]) -> tuple[Any, float, int, dict[str, Any]]:
        """Advance the car of a one-car fleet; one compiled call computes reward, end and `info`."""
        reward, end, offset_m, heading_error_rad, speed_m_s, progress_m, gates = self._drive_only(
            *command
        )
        # A dict display is faster than `dict(zip(_INFO, ...))`.
        info = {
            "lateral_offset_m": offset_m,
            "heading_error_rad": heading_error_rad,
            "speed_m_s": speed_m_s,
            "progress_m": progress_m,
            "gates_passed": gates,
        }
        return self._observe_only(), reward, end, info

    def _kernel(self) -> tuple[Any, ...]:
        return step_cars, *self._arguments

    @property
    def _arguments(self) -> tuple[Any, ...]:
        outcome = (self.rewards, self.ends, self._seen)
        return (self.track, self._cars, self.commands, *outcome, self.classic, self._drift)

    @cached_property
    def _start_chosen(self) -> Callable[[NDArray[np.int64]], None]:
        arrays = (self._randoms.addresses, self._cars, self._seen)
        return ready(start_cars, self.track, self.classic, self._kind, *arrays, examples=(_ONLY,))

    # Only a fleet of one car uses `_drive_only`.

    @cached_property
    def _drive_only(self) -> Callable[[float, float], StepResult]:
        return ready(step_only_car, *self._arguments, examples=(0.0, 0.0))

    def places(self) -> NDArray[np.float64]:
        """Return the positions of all cars, (N, 2) x and y in the map, meters."""
        x_px, y_px = self._cars[:, 0], self._cars[:, 1]
        return METERS_PER_PX * np.column_stack([x_px, IMAGE_HEIGHT_PX - y_px])

    def info(self, i: int) -> dict[str, Any]:
        """Return the `info` of car i."""
        values = np.empty((5, 1))
        car_info(self._cars[i : i + 1], values)
        *numbers, gates = values[:, 0].tolist()
        return dict(zip(_INFO, (*numbers, int(gates)), strict=True))

    def infos(self) -> dict[str, NDArray[Any]]:
        """Return the `info` of all cars."""
        values = np.empty((5, self.count))
        car_info(self._cars, values)
        return dict(zip(_INFO, (*values[:4], values[4].astype(np.int64)), strict=True))


def _controls(action_set: NDArray[np.int64]) -> Controls:
    """Return the controls with these discrete actions, or continuous ones if there are none."""
    if not len(action_set):
        return Controls(Command._fields, COMMAND_UNITS)
    meanings = tuple(ACTION_MEANINGS[action] for action in action_set)
    commands = np.array(ACTION_COMMANDS)[action_set]
    return Controls(Command._fields, COMMAND_UNITS, meanings, commands)


def _track_of(seed: int | None) -> Track:
    if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int) or seed < 0):
        raise UsageError(f"track_seed must be None or an integer of at least 0, not {seed!r}")
    return make_track(seed)


ANYWHERE, ON_LINE, EXACTLY = 4, 2, 0  # Number of random numbers for each kind of start
SEARCH_M = 10.0
"""Search window for the nearest path point: maximum distance from the path point of the start."""


@compiled
def start_on_line(track: Track, shares: NDArray[np.float64]) -> Car:
    """Return a car at rest near the start line; two random numbers set its offset and heading."""
    x_px, y_px, heading_rad = track.start_px
    left_px, left_rad = spread(shares[0], 3.0), spread(shares[1], 0.05)
    x_px += left_px * math.sin(heading_rad)
    y_px -= left_px * math.cos(heading_rad)
    return placed(track, x_px, y_px, heading_rad - left_rad, 0.0, 0.0, SEARCH_M)


@compiled
def start_anywhere(track: Track, shares: NDArray[np.float64]) -> Car:
    """Return a car on the track; four random numbers set position, speed, offset and heading."""
    along_m, speed_px = track.path.length_m * shares[0], 6.0 * shares[1]
    left_px, left_rad = spread(shares[2], 12.0), spread(shares[3], 0.2)
    x_m, y_m = point_at(track.path, along_m)
    heading_rad = -track.path.yaw_rad[leg_at(track.path, along_m)]
    x_px = x_m / METERS_PER_PX + left_px * math.sin(heading_rad)
    y_px = IMAGE_HEIGHT_PX - y_m / METERS_PER_PX - left_px * math.cos(heading_rad)
    return placed(track, x_px, y_px, heading_rad - left_rad, speed_px, along_m, SEARCH_M)


@compiled
def start_cars(
    track: Track,
    classic: bool,
    kind: int,
    addresses: NDArray[np.intp],
    cars: NDArray[np.float64],
    observations: NDArray[np.float32],
    chosen: NDArray[np.int64],
) -> None:
    """Start the `chosen` (K,) of N cars (N, 13), and write their observations (N, 19)."""
    # A row has a `Car`, then the distance along the path at which it starts.
    shares = np.empty(kind)
    for i in chosen:
        draw(addresses[i], shares)
        if kind == ANYWHERE:
            car = start_anywhere(track, shares)
        elif kind == ON_LINE:
            car = start_on_line(track, shares)
        else:
            car = placed(track, *track.start_px, 0.0, 0.0, SEARCH_M)
        store_car(car, cars[i])
        cars[i, STARTED_AT] = car.along_m
        observe(track, car, classic, observations[i])


def car_from(track: Track, options: dict[str, Any]) -> Car:
    """Return the starting state in the options of `reset`."""
    pose = pose_from(options, -MAX_SPEED_M_S, MAX_SPEED_M_S)
    x_px, y_px = pose.x_m / METERS_PER_PX, IMAGE_HEIGHT_PX - pose.y_m / METERS_PER_PX
    speed_px = pose.speed_m_s * STEP_S / METERS_PER_PX
    car = placed(track, x_px, y_px, -pose.yaw_rad, speed_px, 0.0)
    half_width_m = HALF_WIDTH_PX * METERS_PER_PX
    if abs(car.offset_m) > half_width_m or walls_hit(track, car):
        raise UsageError(
            f"pose ({pose.x_m}, {pose.y_m}) is {abs(car.offset_m):.1f} m from the middle of the"
            f" track: the whole car must be inside the walls at {half_width_m} m"
        )
    return car
