"""The racer sim as a Gymnasium environment."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.sims import racer_scene
from mcaprl.sims.arguments import check_action, check_name, pose_from
from mcaprl.sims.geometry import leg_at, point_at
from mcaprl.sims.racer_car import Racer, placed, racer_at
from mcaprl.sims.racer_rules import (
    ACTION_MEANINGS,
    CRASH,
    DRIVING,
    MAX_SPEED_PX,
    OBSERVATION_NAMES,
    REASONS,
    STEP_S,
    observe,
    step_racers,
    walls_hit,
)
from mcaprl.sims.racer_track import (
    HALF_WIDTH_PX,
    METRES_PER_PX,
    PICTURE_HEIGHT_PX,
    Track,
    make_track,
)
from mcaprl.sims.scene import Frame, Shape

if TYPE_CHECKING:
    from mcaprl.sims.racer_view import RacerView

RULES = ("default", "classic")
OBSERVATIONS = ("rays",)
STARTS = ("anywhere", "line")
RENDER_MODES = ("human", "rgb_array")
METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": round(1 / STEP_S)}
ACTION_SETS = {5: (0, 1, 2, 3, 4), 8: (1, 2, 3, 4, 5, 6, 7, 8), 9: tuple(range(9))}
MAX_SPEED_M_S = MAX_SPEED_PX * METRES_PER_PX / STEP_S
TRAIL_LENGTH = 40


class RacerEnv(gym.Env[NDArray[np.float32], Any]):
    """A car that learns to race around a track by the lengths of its rays.

    ## Description

    A car of 30 x 14 pixels drives counter-clockwise around a closed track, seen from above on a
    picture of 1000 x 600 pixels: 48 straight walls, about 83 pixels apart, and 37 gates. It turns
    by 15 degrees a step and may be as fast as 10 pixels a step, forward or backward. The same seed
    and actions give the same bits.

    Rays, walls and rules are in pixels of the picture, y down. For viewers, poses and `info`, one
    pixel is 0.1 m and one step is 0.1 s, so that 1 pixel a step is 1 m/s; the map's axes are
    right-handed with z up, its origin in the picture's lower left corner, and angles grow
    counter-clockwise.

    ## Action Space

    `Discrete(9)`. The speed changes by 2 pixels a step.

    | Action | Meaning | Speed | Turn |
    |---|---|---|---|
    | 0 | none | 0 | 0 |
    | 1 | forward | +2 | 0 |
    | 2 | left | 0 | 15 degrees to the left |
    | 3 | right | 0 | 15 degrees to the right |
    | 4 | back | -2 | 0 |
    | 5 | back right | -2 | 15 degrees to the right |
    | 6 | back left | -2 | 15 degrees to the left |
    | 7 | forward left | +2 | 15 degrees to the left |
    | 8 | forward right | +2 | 15 degrees to the right |

    `actions=5` has the first five of them; `actions=8` all but `none`, numbered from 0.

    ## Observation Space

    `observation="rays"`: `Box(-1, 1)` of 19 float32, all without a unit.

    | Index | Observation |
    |---|---|
    | 0 to 7 | from the centre: 0, -30, 30, 45, -45, 90, -90, 180 degrees; right is positive |
    | 8 to 13 | from the centre: 10, -10, 135, -135, 20, -20 degrees |
    | 14, 15 | from the front's left corner to the left, from its right corner to the right |
    | 16, 17 | from the front's left and right corner, straight ahead |
    | 18 | speed / 10 pixels a step, forward is positive |

    A ray of d pixels to the nearest wall is observed as ln(1 + d / 10) / ln(101), which spreads out
    the lengths that matter: a twentieth of the scale (1000 - d) / 1000 holds the nearest 50 pixels,
    but almost two fifths of this one. With it the first good laps are learnt sooner.

    ## Rewards

    +1 for the next gate, when the car's centre moves over it; -1 for a crash; else 0.

    ## Starting State

    `start="anywhere"`: a random place on the track, up to 12 pixels and 0.2 rad off its middle, at
    0 to 6 pixels a step.
    `start="line"`: at (50, 300) pixels heading down the picture, up to 3 pixels and 0.05 rad off,
    at rest; on other tracks where their path begins.
    `reset(options={"pose": (x_m, y_m, yaw_rad)})`, or with a fourth number for the speed in m/s,
    starts there instead.

    ## Episode End

    Terminated with `info["reason"]` = `crash`: a wall cuts an edge of the car. Truncated with
    `no_gate` after 100 steps without a gate, and with `time_limit` after 1,000 steps.

    `info` has lateral_offset_m, heading_error_rad, speed_m_s, progress_m (along the middle of the
    track since the start, growing over the laps) and gates_passed.

    ## Classic rules

    `rules="classic"` plays by the published rules, on a track of our own. They differ in:

    - Forward and back are swapped: `forward` drives against ray 0, which looks ahead, and gates
      can be passed by driving `back` only. The observed speed keeps the sign of `forward`.
    - The rays of the front's corners are measured from the car's centre. The sideways ones run
      across the nose: from the left corner to the right, and from the right one to the left.
    - What a ray hits is floored to whole pixels, so that a car in the middle of a straight sees
      unequal walls.
    - Rays are observed as (1000 - d) / 1000: five in six are between 0.8 and 1.
    - A gate counts when the car looks at it within 20 pixels of its centre (floored): before it is
      reached. One driven over without that look is never made up for.
    - A crash costs 1 for each wall that is hit, so two at a joint of walls.
    - The start is always the same: at the line, exactly, at rest.
    - An episode is truncated after 10,000 steps.

    ## Arguments

    - `rules`: `"default"` or `"classic"`.
    - `observation`: `"rays"`.
    - `start`: `"anywhere"` or `"line"`; None is `"anywhere"`, in the classic rules `"line"`.
    - `actions`: 5, 8 or 9.
    - `drift`: the car's course follows its heading by at most 100 / (speed + 1) degrees a step.
    - `track_seed`: None, or a number of 0 or more for a random track.
    - `render_mode`: None, `"human"` or `"rgb_array"`.

    ## Version History

    - v0: first version.
    """

    metadata = METADATA
    step_duration_s: ClassVar[float] = STEP_S

    def __init__(
        self,
        rules: str = "default",
        observation: str = "rays",
        start: str | None = None,
        actions: int = 9,
        drift: bool = False,
        track_seed: int | None = None,
        render_mode: Literal["human", "rgb_array"] | None = None,
    ) -> None:
        """See "Arguments" above.

        Raises:
            UnknownNameError: an argument has a value that is not in its list.
            UsageError: the track's seed is not a whole number of 0 or more.
        """
        check_name("rules", rules, RULES)
        check_name("observation", observation, OBSERVATIONS)
        check_name("start", start, (None, *STARTS))
        check_name("number of actions", actions, tuple(ACTION_SETS))
        check_name("drift", drift, (False, True))
        check_name("render_mode", render_mode, (None, *RENDER_MODES))
        self.render_mode = self._render_mode = render_mode
        self.classic = rules == "classic"
        self.actions = ACTION_SETS[actions]
        self.track = _track_of(track_seed)
        self.action_meanings = tuple(ACTION_MEANINGS[action] for action in self.actions)
        self.observation_names = OBSERVATION_NAMES
        self.action_space = spaces.Discrete(len(self.actions))
        self.observation_space = spaces.Box(-1.0, 1.0, (len(OBSERVATION_NAMES),), np.float32)
        self._start = start or ("line" if self.classic else "anywhere")
        self._drift = bool(drift)
        self._car = Racer(*[0.0] * len(Racer._fields))
        self._cars = np.zeros((1, len(self._car)))
        self._actions = np.zeros(1, dtype=np.int64)
        self._rewards = np.zeros(1)
        self._ends = np.zeros(1, dtype=np.int64)
        self._observations = np.zeros((1, len(OBSERVATION_NAMES)), dtype=np.float32)
        self._started_at_m = 0.0
        self._last_action = 0
        self._trail_m: deque[tuple[float, float]] = deque(maxlen=TRAIL_LENGTH)
        self._view: RacerView | None = None

    @property
    def car(self) -> Racer:
        """The whole state of the car."""
        return self._car

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; see "Starting State".

        Raises:
            UsageError: `options` has an unknown key, or a pose that is not on the track.
        """
        super().reset(seed=seed)
        self._car = self._start_car() if not options else self._car_from(options)
        self._cars[0] = self._car
        self._rewards[0], self._last_action = 0.0, 0
        observe(self.track, self._car, self.classic, self._observations[0])
        self._started_at_m = self._car.along_m
        self._trail_m.clear()
        return self._seen(), self._info()

    def step(
        self, action: int | np.integer[Any]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Drive on for one step.

        Raises:
            UsageError: there is no such action.
        """
        check_action(action, len(self.actions))
        self._last_action = self._actions[0] = self.actions[action]
        step_racers(
            self.track,
            self._cars,
            self._actions,
            self._rewards,
            self._ends,
            self._observations,
            self.classic,
            self._drift,
        )
        self._car = racer_at(self._cars[0])
        reward, end, info = self._rewards.item(), self._ends.item(), self._info()
        if end != DRIVING:
            info["reason"] = REASONS[end]
        return self._seen(), reward, end == CRASH, end not in (DRIVING, CRASH), info

    def _start_car(self) -> Racer:
        """Draw a start."""
        x_px, y_px, heading_rad = self.track.start_px
        if self._start == "line" and self.classic:
            return placed(self.track, x_px, y_px, heading_rad, 0.0, 0.0)
        draw, path = self.np_random.uniform, self.track.path
        along_m, speed_px, left_px, left_rad = 0.0, 0.0, draw(-3.0, 3.0), draw(-0.05, 0.05)
        if self._start == "anywhere":
            along_m, speed_px = draw(0.0, path.length_m), draw(0.0, 6.0)
            left_px, left_rad = draw(-12.0, 12.0), draw(-0.2, 0.2)
            x_px, y_px = _to_picture(*point_at(path, along_m))
            heading_rad = -path.yaw_rad[leg_at(path, along_m)]
        x_px += left_px * math.sin(heading_rad)
        y_px -= left_px * math.cos(heading_rad)
        return placed(self.track, x_px, y_px, heading_rad - left_rad, speed_px, along_m)

    def _car_from(self, options: dict[str, Any]) -> Racer:
        """Read a start from the options of `reset`."""
        pose = pose_from(options, -MAX_SPEED_M_S, MAX_SPEED_M_S)
        x_px, y_px = _to_picture(pose.x_m, pose.y_m)
        speed_px = pose.speed_m_s * STEP_S / METRES_PER_PX
        car = placed(self.track, x_px, y_px, -pose.yaw_rad, speed_px, 0.0)
        half_width_m = HALF_WIDTH_PX * METRES_PER_PX
        if abs(car.offset_m) > half_width_m or walls_hit(self.track, car):
            raise UsageError(
                f"pose ({pose.x_m}, {pose.y_m}) is {abs(car.offset_m):.1f} m from the middle of the"
                f" track: the whole car must be inside the walls, {half_width_m} m from it"
            )
        return car

    def _seen(self) -> NDArray[np.float32]:
        """Give the observation, and take note of the place for what is drawn."""
        place = self._place()
        self._trail_m.append((place["x_m"], place["y_m"]))
        if self.render_mode == "human":
            self.render()
        observation: NDArray[np.float32] = self._observations[0].copy()
        return observation

    def _info(self) -> dict[str, Any]:
        car = self._car
        return {
            "lateral_offset_m": car.offset_m,
            "heading_error_rad": car.heading_error_rad,
            "speed_m_s": car.speed_px * METRES_PER_PX / STEP_S,
            "progress_m": car.along_m - self._started_at_m,
            "gates_passed": int(car.gates),
        }

    def _place(self) -> dict[str, float]:
        x_m, y_m, _ = racer_scene.car_frame(self._car).position
        return {"x_m": x_m, "y_m": y_m, "yaw_rad": -self._car.heading_rad}

    def telemetry(self) -> dict[str, float]:
        """Give the car's state by name; the units are in the names."""
        return {**self._place(), **{name: float(value) for name, value in self._info().items()}}

    def static_scene(self) -> Sequence[Shape]:
        """Give the shapes that never change, those of the car's body in the frame `car`."""
        return racer_scene.static_shapes(self.track)

    def scene(self) -> Sequence[Shape]:
        """Give the shapes that change with each step."""
        return racer_scene.moving_shapes(self.track, self._car, self._trail_m)

    def static_frames(self) -> Sequence[Frame]:
        """Give no frames: nothing is fixed to the car but its body."""
        return ()

    def frames(self) -> Sequence[Frame]:
        """Give the car's frame in the map."""
        return (racer_scene.car_frame(self._car),)

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the track from above: give (600, 1000, 3) uint8 for `rgb_array`, or show it."""
        if self._render_mode is None:
            return None
        if self._view is None:
            from mcaprl.sims.racer_view import RacerView

            self._view = RacerView(self._render_mode, self.track)
        image = self._view.draw(self._car, self._trail_m, self._last_action)
        return image if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._view is not None:
            self._view.close()
            self._view = None


def _track_of(seed: int | None) -> Track:
    if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int) or seed < 0):
        raise UsageError(f"track_seed is None or a whole number of 0 or more, not {seed!r}")
    return make_track(seed)


def _to_picture(x_m: float, y_m: float) -> tuple[float, float]:
    """Give the picture coordinates of a map point."""
    return x_m / METRES_PER_PX, PICTURE_HEIGHT_PX - y_m / METRES_PER_PX
