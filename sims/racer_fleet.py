"""N cars of the racer sim as arrays: starts, steps and observations."""

from __future__ import annotations

from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.sims.arguments import check_name
from mcaprl.sims.fleet import GOING_ON, Fleet
from mcaprl.sims.racer_car import Racer, store_racer
from mcaprl.sims.racer_rules import (
    ACTION_MEANINGS,
    OBSERVATION_NAMES,
    REASONS,
    STEP_S,
    TRUNCATES,
    observe,
    step_racers,
)
from mcaprl.sims.racer_start import ANYWHERE, EXACTLY, ON_LINE, racer_from, start_racer
from mcaprl.sims.racer_track import METRES_PER_PX, PICTURE_HEIGHT_PX, Track, make_track

RULES = ("default", "classic")
OBSERVATIONS = ("rays",)
STARTS = ("anywhere", "line")
ALONG = Racer._fields.index("along_m")
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
        self.last_actions = np.zeros(count, dtype=np.int64)
        on_line = start == "line" or (self.classic and start is None)
        self._start = ANYWHERE if not on_line else EXACTLY if self.classic else ON_LINE
        self._drift = bool(drift)
        self._cars = np.zeros((count, len(Racer._fields)))
        self._started_at_m = np.zeros(count)
        self._seen = np.zeros((count, len(OBSERVATION_NAMES)), dtype=np.float32)

    def car(self, i: int) -> Racer:
        """Give the whole state of a car."""
        return Racer._make(self._cars[i].tolist())

    def begin(self, i: int, random: np.random.Generator, options: dict[str, Any] | None) -> None:
        """Start car i; see "Starting State" of `RacerEnv`."""
        row, seen = self._cars[i], self._seen[i]
        if options:
            car = racer_from(self.track, options)
            store_racer(car, row)
            observe(self.track, car, self.classic, seen)
        else:
            start_racer(self.track, random.random(self._start), self.classic, row, seen)
        self._started_at_m[i] = row[ALONG]
        self.rewards[i], self.ends[i], self.last_actions[i] = 0.0, GOING_ON, 0

    def advance(self) -> None:
        """Drive on for one step."""
        self.action_set.take(self.actions, out=self.last_actions, mode="clip")
        self._step()

    def _kernel(self) -> tuple[Any, ...]:
        return (
            step_racers,
            self.track,
            self._cars,
            self.last_actions,
            self.rewards,
            self.ends,
            self._seen,
            self.classic,
            self._drift,
        )

    # Views of each row, made once: a single environment reads one of each in every step.

    @cached_property
    def _car_rows(self) -> list[NDArray[np.float64]]:
        return list(self._cars)

    @cached_property
    def _seen_rows(self) -> list[NDArray[np.float32]]:
        return list(self._seen)

    def observation(self, i: int) -> NDArray[np.float32]:
        """Give the numbers that car i sees."""
        return self._seen_rows[i].copy()

    def observations(self) -> NDArray[np.float32]:
        """Give what all cars see."""
        return self._seen.copy()

    def places(self) -> NDArray[np.float64]:
        """Give where all are, (N, 2) x and y in the map, metres."""
        x_px, y_px = self._cars[:, 0], self._cars[:, 1]
        return METRES_PER_PX * np.column_stack([x_px, PICTURE_HEIGHT_PX - y_px])

    def info(self, i: int) -> dict[str, Any]:
        """Give the `info` of car i."""
        described = _described(self._car_rows[i].tolist(), self._started_at_m.item(i))
        described["gates_passed"] = int(described["gates_passed"])
        return described

    def infos(self) -> dict[str, NDArray[Any]]:
        """Give the `info` of all cars."""
        described = _described(self._cars.T, self._started_at_m)
        described["gates_passed"] = described["gates_passed"].astype(np.int64)
        return {name: column.copy() for name, column in described.items()}


def _described(car: Any, started_at_m: Any) -> dict[str, Any]:
    """Name what is told of a car, or of all: 12 numbers, or as many columns."""
    _, _, _, _, speed_px, _, gates, _, _, along_m, offset_m, heading_error_rad = car
    return {
        "lateral_offset_m": offset_m,
        "heading_error_rad": heading_error_rad,
        "speed_m_s": speed_px * METRES_PER_PX / STEP_S,
        "progress_m": along_m - started_at_m,
        "gates_passed": gates,
    }


def _track_of(seed: int | None) -> Track:
    if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int) or seed < 0):
        raise UsageError(f"track_seed is None or a whole number of 0 or more, not {seed!r}")
    return make_track(seed)
