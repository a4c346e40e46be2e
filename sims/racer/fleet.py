"""N cars of the racer sim as arrays: starts, steps and observations."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.sims.geometry.compiled import ready
from mcaprl.sims.racer.car import STARTED_AT, Racer, store_racer
from mcaprl.sims.racer.rules import (
    ACTION_MEANINGS,
    OBSERVATION_NAMES,
    REASONS,
    STEP_S,
    TRUNCATES,
    Told,
    observe,
    step_only_racer,
    step_racers,
    tell_racers,
)
from mcaprl.sims.racer.start import ANYWHERE, EXACTLY, ON_LINE, racer_from, start_racer
from mcaprl.sims.racer.track import METRES_PER_PX, PICTURE_HEIGHT_PX, Track, make_track
from mcaprl.sims.vehicle.arguments import check_name
from mcaprl.sims.vehicle.fleet import GOING_ON, Fleet

RULES = ("default", "classic")
OBSERVATIONS = ("rays",)
STARTS = ("anywhere", "line")
ACTION_SETS = {5: (0, 1, 2, 3, 4), 8: (1, 2, 3, 4, 5, 6, 7, 8), 9: tuple(range(9))}


class RacerFleet(Fleet):
    """N cars on one track; see `RacerEnv`, whose arguments it has."""

    reasons: ClassVar[tuple[str, ...]] = REASONS
    truncates: ClassVar[tuple[bool, ...]] = TRUNCATES

    def __init__(
        self,
        count: int,
        rules: str = "default",
        observation: str = "rays",
        start: str | None = None,
        actions: int = 9,
        drift: bool = False,
        track_seed: int | None = None,
    ) -> None:
        """Make N cars; each is to be started by `begin`.

        Raises:
            UnknownNameError: an argument has a value that is not in its list.
            UsageError: the track's seed is not a whole number of 0 or more.
        """
        check_name("rules", rules, RULES)
        check_name("observation", observation, OBSERVATIONS)
        check_name("start", start, (None, *STARTS))
        check_name("number of actions", actions, tuple(ACTION_SETS))
        check_name("drift", drift, (False, True))
        self.classic = rules == "classic"
        self.track = _track_of(track_seed)
        self.action_set = np.array(ACTION_SETS[actions], dtype=np.int64)
        super().__init__(
            count,
            spaces.Box(-1.0, 1.0, (len(OBSERVATION_NAMES),), np.float32),
            OBSERVATION_NAMES,
            tuple(ACTION_MEANINGS[action] for action in self.action_set),
            STEP_S,
        )
        self._numbers = ACTION_SETS[actions]
        self.last_actions = np.zeros(count, dtype=np.int64)
        on_line = start == "line" or (self.classic and start is None)
        # By what chance a car is started.
        self._shares = np.zeros(ANYWHERE if not on_line else EXACTLY if self.classic else ON_LINE)
        self._drift = bool(drift)
        self._cars = np.zeros((count, STARTED_AT + 1))
        self._seen = np.zeros((count, len(OBSERVATION_NAMES)), dtype=np.float32)

    def car(self, i: int) -> Racer:
        """Give the whole state of a car."""
        return Racer._make(self._cars[i, :STARTED_AT].tolist())

    def begin(self, i: int, random: np.random.Generator, options: dict[str, Any] | None) -> None:
        """Start car i; see "Starting State" of `RacerEnv`."""
        if options:
            car, row = racer_from(self.track, options), self._cars[i]
            store_racer(car, row)
            row[STARTED_AT] = car.along_m
            observe(self.track, car, self.classic, self._seen[i])
        else:
            random.random(out=self._shares)
            self._start_one(i)
        self.rewards[i], self.ends[i], self.last_actions[i] = 0.0, GOING_ON, 0

    def advance(self) -> None:
        """Drive on for one step."""
        self.action_set.take(self.actions, out=self.last_actions, mode="clip")
        self._step()

    def step_one(self, action: int) -> tuple[Any, float, int, dict[str, Any]]:
        """Drive on with the only car: all that is told of its state comes in one call."""
        reward, end, offset_m, heading_error_rad, speed_m_s, progress_m, gates = self._drive_only(
            self._numbers[action]
        )
        # As `_named`, which would be one more call.
        info = {
            "lateral_offset_m": offset_m,
            "heading_error_rad": heading_error_rad,
            "speed_m_s": speed_m_s,
            "progress_m": progress_m,
            "gates_passed": gates,
        }
        return self._observe_only(), reward, end, info

    def _kernel(self) -> tuple[Any, ...]:
        return step_racers, *self._arguments

    @property
    def _arguments(self) -> tuple[Any, ...]:
        outcome = (self.rewards, self.ends, self._seen)
        return (self.track, self._cars, self.last_actions, *outcome, self.classic, self._drift)

    @cached_property
    def _start_one(self) -> Callable[[int], None]:
        arrays = (self._shares, self._cars, self._seen)
        return ready(start_racer, self.track, self.classic, *arrays, examples=(0,))

    # Of a fleet of one, what its steps call.

    @cached_property
    def _drive_only(self) -> Callable[[int], Told]:
        return ready(step_only_racer, *self._arguments, examples=(0,))

    @cached_property
    def _observe_only(self) -> Callable[[], NDArray[np.float32]]:
        copy: Callable[[], NDArray[np.float32]] = self._seen[0].copy
        return copy

    def observation(self, i: int) -> NDArray[np.float32]:
        """Give the numbers that car i sees."""
        seen: NDArray[np.float32] = self._seen[i].copy()
        return seen

    def observations(self) -> NDArray[np.float32]:
        """Give what all cars see."""
        return self._seen.copy()

    def places(self) -> NDArray[np.float64]:
        """Give where all are, (N, 2) x and y in the map, metres."""
        x_px, y_px = self._cars[:, 0], self._cars[:, 1]
        return METRES_PER_PX * np.column_stack([x_px, PICTURE_HEIGHT_PX - y_px])

    def info(self, i: int) -> dict[str, Any]:
        """Give the `info` of car i."""
        told = np.empty((5, 1))
        tell_racers(self._cars[i : i + 1], told)
        offset_m, heading_error_rad, speed_m_s, progress_m, gates = told[:, 0].tolist()
        return _named(offset_m, heading_error_rad, speed_m_s, progress_m, int(gates))

    def infos(self) -> dict[str, NDArray[Any]]:
        """Give the `info` of all cars."""
        told = np.empty((5, self.count))
        tell_racers(self._cars, told)
        offset_m, heading_error_rad, speed_m_s, progress_m, gates = told
        return _named(offset_m, heading_error_rad, speed_m_s, progress_m, gates.astype(np.int64))


def _named(
    offset_m: Any, heading_error_rad: Any, speed_m_s: Any, progress_m: Any, gates: Any
) -> dict[str, Any]:
    """Name what is told of a car, or of all."""
    return {
        "lateral_offset_m": offset_m,
        "heading_error_rad": heading_error_rad,
        "speed_m_s": speed_m_s,
        "progress_m": progress_m,
        "gates_passed": gates,
    }


def _track_of(seed: int | None) -> Track:
    if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int) or seed < 0):
        raise UsageError(f"track_seed is None or a whole number of 0 or more, not {seed!r}")
    return make_track(seed)
