"""The powerline sim as a Gymnasium environment."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.sims import powerline_scene
from mcaprl.sims.arguments import check_action, check_name, check_range
from mcaprl.sims.depth import encode_depth, encode_nearness
from mcaprl.sims.powerline_camera import CAMERAS, IMAGE_SHAPE, DroneCamera
from mcaprl.sims.powerline_classic import (
    CLASSIC_DECISION_S,
    CLASSIC_FIRST_COMMAND_M_S,
    CLASSIC_VELOCITY_STEP_M_S,
    step_classic,
)
from mcaprl.sims.powerline_rules import (
    ACTION_MEANINGS,
    DECISION_S,
    FIRST_COMMAND_M_S,
    FLIGHT_SIZE,
    FLYING,
    OBSERVATION_LIMIT,
    OBSERVATION_NAMES,
    REASONS,
    VELOCITY_STEP_M_S,
    Flight,
    flight_at,
    observe,
    step_flights,
    store_flight,
)
from mcaprl.sims.powerline_start import draw_wind, flight_from, start_anywhere, start_on_line
from mcaprl.sims.quadrotor import PLANTS
from mcaprl.sims.scene import Frame, Shape
from mcaprl.sims.vectors import Vector

if TYPE_CHECKING:
    from mcaprl.sims.powerline_view import PowerlineView

RULES = ("default", "classic")
OBSERVATIONS = ("state", "depth")
STARTS = ("anywhere", "line")
RENDER_MODES = ("human", "rgb_array")
METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": round(1 / DECISION_S)}
MAX_WIND_M_S = 8.0
MAX_GUST_M_S = 3.0
TRAIL_LENGTH = 60


class PowerlineEnv(gym.Env[Any, Any]):
    """A drone that learns to follow a power line.

    ## Description

    A drone follows a line of four legs (71, 146, 198 and 206 m) over hilly ground. A tower stands
    under each corner, and three conductors hang 6 m below the line. The drone is a quadrotor with
    controllers that follow a commanded velocity, or a point that does so with a lag. It keeps its
    nose to the north. The same seed and actions give the same bits.

    Actions, observations and poses have the axes of the published line, NED: x north, y east, z
    **down**; metres and m/s. What viewers read (telemetry, scene, frames, and `info`'s offsets) has
    ROS axes: x north, y west, z up; y and z change sign.

    ## Action Space

    `Discrete(7)`. Each changes the last commanded velocity by 0.5 m/s; a command beyond 8 m/s is
    not taken. One decision lasts 0.5 s.

    | Action | Meaning |
    |---|---|
    | 0 | faster north (+x) |
    | 1 | faster east (+y) |
    | 2 | faster down (+z) |
    | 3 | faster south (-x) |
    | 4 | faster west (-y) |
    | 5 | faster up (-z) |
    | 6 | no change: fly on, without slowing down |

    ## Observation Space

    `observation="state"`: `Box` of 18 float32.

    | Index | Observation | Unit | Limit |
    |---|---|---|---|
    | 0-2 | position, from the nearest point of the line: x, y, z | 7 m | 2 |
    | 3-5 | velocity | 5 m/s | 4 |
    | 6-8 | command minus velocity | 1 m/s | 8 |
    | 9-11 | direction of the leg, a unit vector | 1 | 1 |
    | 12-14 | direction of the next leg | 1 | 1 |
    | 15 | distance to the leg's end, at most 60 m | 60 m | 1 |
    | 16 | exp(-distance to the leg's end / 10 m) | 1 | 1 |
    | 17 | how far behind the furthest point so far | 10 m | 10 |

    `observation="depth"`: a `Dict` of `depth`, (84, 84, 1) uint8, the camera's picture in the log
    code of `mcaprl.sims.depth.encode_depth`, 255 where there is nothing; and `motion`, 6 float32,
    rows 3 to 8 of the table. Conductors are drawn one pixel wide, or none would be seen. With
    `rules="classic"` it is the picture alone, in the code of `encode_nearness`.

    ## Rewards

    min(ds / 2.5 m, 1) exp(-d / 4 m) for progress ds along the line beyond the furthest point so
    far, at distance d from it. 5 more for finishing, -5 for leaving the line or a collision.

    ## Starting State

    `start="line"`: at the first point, up to 0.2 m off on each axis, then 5 s at (1, -0.5, -1) m/s.
    `start="anywhere"`: half of the episodes so; the others anywhere on the line but for its last
    20 m, up to 1 m off, along the line at 0 to 5 m/s, rounded to 0.5 m/s on each axis.
    `reset(options={"pose": (x_m, y_m, z_m)})`, or with three more numbers for the velocity in m/s,
    starts there instead, the velocity being the first command.

    ## Episode End

    Terminated with `info["reason"]` = `off_line` (more than 7 m from the line), `collision` (less
    than 0.6 m from a conductor, 1.2 m from the middle of a tower's mast or arm, 0.3 m from the
    ground) or `finished` (1 m before the line's end). Truncated after 400 steps.

    `info` has lateral_offset_m (left positive), vertical_offset_m (up positive), line_distance_m,
    speed_m_s and progress_m (along the line since the start).

    ## Classic Rules

    `rules="classic"` is the system as it was published, on a point that lags 0.5 s behind its
    command: a decision each 5 s; actions change the *measured* velocity by 0.25 m/s; the reward is
    (exp(-d) - 0.5) + (speed - 0.5), with d to the nearest of the *endless* straight lines through
    the legs; -10 and the end beyond 7 m; -100 and the end for a collision. It starts with 5 s at
    (1, -0.67, -0.8) m/s. Its faults:

    - The speed is paid in any direction: flying to and fro earns more than following the line.
    - Coasting past the first tower, along the first leg's extension, is paid for 100 m and more.
    - No end of the line: flying on beyond the last tower is paid, too.
    - Hovering on the line costs nothing and never ends; backwards is as good as forwards.
    - Changing the measured velocity makes commands drift: whatever a gust or a lag leaves is kept.
    - In 5 s, nothing can be corrected: 25 m at 5 m/s, three and a half times the width allowed.
    - The picture's code spends half of its values on 1 to 2 m.

    Ours are the world, the point's lag, and the picture's averaging where the published one
    interpolates. A flight stops where it collides.

    ## Arguments

    - `rules`: `"default"` or `"classic"`.
    - `observation`: `"state"` or `"depth"`.
    - `camera`: `"down"` or `"front"`; 90 degrees wide, fixed to the body.
    - `start`: `"anywhere"` or `"line"`; classic rules know only the latter.
    - `plant`: `"quad"`, `"point"`, or None for the rules' own: quad, and point for classic.
    - `wind_m_s`: greatest steady wind, 0 to 8; an episode's is drawn up to it, from any side.
    - `gust_m_s`: standard deviation on each axis of the gusts, 0 to 3. No wind moves a point.
    - `render_mode`: None, `"human"` or `"rgb_array"`.

    ## Version History

    - v0: first version.
    """

    metadata = METADATA
    action_meanings: ClassVar[tuple[str, ...]] = ACTION_MEANINGS

    def __init__(
        self,
        rules: str = "default",
        observation: str = "state",
        camera: str = "down",
        start: str = "anywhere",
        plant: str | None = None,
        wind_m_s: float = 0.0,
        gust_m_s: float = 0.0,
        render_mode: Literal["human", "rgb_array"] | None = None,
    ) -> None:
        """See "Arguments" above.

        Raises:
            UnknownNameError: an argument has a value that is not in its list.
            UsageError: a number is outside its range, or the classic rules are to have gusts.
        """
        classic = rules == "classic"
        plant = plant or ("point" if classic else "quad")
        check_name("rules", rules, RULES)
        check_name("observation", observation, OBSERVATIONS)
        check_name("camera", camera, CAMERAS)
        check_name("start", start, STARTS)
        check_name("plant", plant, PLANTS)
        check_name("render_mode", render_mode or RENDER_MODES[0], RENDER_MODES)
        check_range("wind_m_s", wind_m_s, 0.0, MAX_WIND_M_S)
        check_range("gust_m_s", gust_m_s, 0.0, 0.0 if classic else MAX_GUST_M_S)
        self.rules = rules
        self.velocity_step_m_s = CLASSIC_VELOCITY_STEP_M_S if classic else VELOCITY_STEP_M_S
        self.step_duration_s = CLASSIC_DECISION_S if classic else DECISION_S
        self.render_mode = self._render_mode = render_mode
        self.observation_names = OBSERVATION_NAMES if observation == "state" else ()
        self.action_space = spaces.Discrete(len(ACTION_MEANINGS))
        self.observation_space = _space(observation, classic)
        self._classic = classic
        self._plant = PLANTS.index(plant)
        self._start = start
        self._wind_m_s, self._gust_m_s = wind_m_s, gust_m_s
        self._shows_state = observation == "state"
        self._row = np.zeros((1, FLIGHT_SIZE))
        self._flight = flight_at(self._row[0])
        self._actions = np.zeros(1, dtype=np.int64)
        self._noise = np.zeros((1, 3))
        self._rewards = np.zeros(1)
        self._ends = np.zeros(1, dtype=np.int64)
        self._observations = np.zeros((1, len(OBSERVATION_NAMES)), dtype=np.float32)
        self._started_at_m = 0.0
        self._trail_m: deque[Vector] = deque(maxlen=TRAIL_LENGTH)
        self._camera_view = camera
        self._camera: DroneCamera | None = None
        self._depth_m: NDArray[np.float32] | None = None
        self._view: PowerlineView | None = None

    @property
    def flight(self) -> Flight:
        """The whole state of the drone, NED."""
        return self._flight

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; see "Starting State".

        Raises:
            UsageError: `options` has an unknown key, or a pose that is not free and near the line.
        """
        super().reset(seed=seed)
        wind = draw_wind(self.np_random, self._wind_m_s)
        if options:
            self._flight = flight_from(options, wind, self._classic)
        elif self._classic:
            self._flight = start_on_line(
                self.np_random, self._plant, CLASSIC_FIRST_COMMAND_M_S, wind
            )
        elif self._start == "line" or self.np_random.random() < 0.5:
            self._flight = start_on_line(self.np_random, self._plant, FIRST_COMMAND_M_S, wind)
        else:
            self._flight = start_anywhere(self.np_random, wind)
        store_flight(self._flight, self._row[0])
        self._rewards[0] = 0.0
        observe(self._flight, self._observations[0])
        self._started_at_m = self._flight.furthest_m
        self._trail_m.clear()
        return self._seen(), self._info()

    def step(self, action: int | np.integer[Any]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Fly on for a decision: 0.5 s, or 5 s with classic rules.

        Raises:
            UsageError: the action is not 0 to 6.
        """
        check_action(action, len(ACTION_MEANINGS))
        self._actions[0] = action
        rewards, ends, seen = self._rewards, self._ends, self._observations
        if self._classic:
            step_classic(self._plant, self._row, self._actions, rewards, ends, seen)
        else:
            if self._gust_m_s:
                self._noise[0] = self.np_random.standard_normal(3)
            step_flights(
                self._plant,
                self._row,
                self._actions,
                self._gust_m_s,
                self._noise,
                rewards,
                ends,
                seen,
            )
        self._flight = flight_at(self._row[0])
        reward, end, info = rewards.item(), ends.item(), self._info()
        if end != FLYING:
            info["reason"] = REASONS[end]
        return self._seen(), reward, end != FLYING, False, info

    def _seen(self) -> Any:
        """Give the observation, and take note of the place for what is drawn."""
        self._depth_m = None
        self._trail_m.append(self._flight.drone.position_m)
        if self.render_mode == "human":
            self.render()
        if self._shows_state:
            return self._observations[0].copy()
        if self._classic:
            return encode_nearness(self.depth_image_m())[:, :, np.newaxis]
        depth = encode_depth(self.depth_image_m())[:, :, np.newaxis]
        return {"depth": depth, "motion": self._observations[0, 3:9].copy()}

    def _info(self) -> dict[str, Any]:
        names = ("lateral_offset_m", "vertical_offset_m", "line_distance_m", "speed_m_s")
        telemetry = self.telemetry()
        return {name: telemetry[name] for name in (*names, "progress_m")}

    def telemetry(self) -> dict[str, float]:
        """Give the drone's state by name, in ROS axes; the units are in the names."""
        return powerline_scene.telemetry(self._flight, self._started_at_m)

    def depth_image_m(self) -> NDArray[np.float32]:
        """Give the camera's (84, 84) distances along each ray, metres; inf is nothing."""
        if self._depth_m is None:
            if self._camera is None:
                self._camera = DroneCamera(self._camera_view)
            self._depth_m = self._camera.image_m(self._flight.drone)
        return self._depth_m

    def static_scene(self) -> Sequence[Shape]:
        """Give the shapes that never change, those of the drone's body in the frame `drone`."""
        return powerline_scene.static_shapes()

    def scene(self) -> Sequence[Shape]:
        """Give the shapes that change with each step."""
        return powerline_scene.moving_shapes(self._flight, list(self._trail_m))

    def static_frames(self) -> Sequence[Frame]:
        """Give the camera's frame in the drone: optical axes, z along the view, x right, y down."""
        return (powerline_scene.camera_frame(self._camera_view),)

    def frames(self) -> Sequence[Frame]:
        """Give the drone's place in the map, level, and its attitude there."""
        return powerline_scene.drone_frames(self._flight.drone)

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the drone from above: give (H, W, 3) uint8 for `rgb_array`, show it for `human`."""
        if self._render_mode is None:
            return None
        if self._view is None:
            from mcaprl.sims.powerline_view import PowerlineView

            self._view = PowerlineView(self._render_mode)
        image = self._view.draw(self._flight, list(self._trail_m), float(self._rewards[0]))
        return image if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._view is not None:
            self._view.close()
            self._view = None


def _space(observation: str, classic: bool) -> spaces.Space[Any]:
    if observation == "state":
        return spaces.Box(-OBSERVATION_LIMIT, OBSERVATION_LIMIT)
    depth = spaces.Box(0, 255, (*IMAGE_SHAPE, 1), np.uint8)
    if classic:
        return depth
    limit = OBSERVATION_LIMIT[3:9]
    return spaces.Dict({"depth": depth, "motion": spaces.Box(-limit, limit)})
