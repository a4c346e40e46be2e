"""The lane sim as a Gymnasium environment."""

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
from mcaprl.sims import lane_scene
from mcaprl.sims.arguments import check_action, check_name, pose_from
from mcaprl.sims.bicycle import Motion
from mcaprl.sims.camera import level_axes
from mcaprl.sims.depth import DepthCamera, encode_depth
from mcaprl.sims.geometry import leg_at, point_at, project
from mcaprl.sims.lane_camera import lane_camera
from mcaprl.sims.lane_course import (
    CAMERA_FORWARD_M,
    CAMERA_HEIGHT_M,
    COURSE,
    LANE_HALF_WIDTH_M,
)
from mcaprl.sims.lane_rules import (
    ACTION_MEANINGS,
    DECISION_S,
    DRIVING,
    MAX_SPEED_M_S,
    OBSERVATION_LIMIT,
    OBSERVATION_NAMES,
    REASONS,
    Car,
    located,
    observe,
    step_cars,
    wheel_angle,
)
from mcaprl.sims.scene import Frame, Shape

if TYPE_CHECKING:
    from mcaprl.sims.lane_view import LaneView

RULES = ("default",)
OBSERVATIONS = ("state", "depth")
STARTS = ("anywhere", "line")
RENDER_MODES = ("human", "rgb_array")
METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": round(1 / DECISION_S)}
DEPTH_SHAPE = (84, 84, 1)
START_LINE_M = 2.0
CLEAR_AFTER_CORNER_M = 2.0
CLEAR_BEFORE_CORNER_M = 8.0
"""Random starts keep clear of corners: nearer than that, some cars cannot turn in time."""
TRAIL_LENGTH = 40


class LaneKeepingEnv(gym.Env[NDArray[Any], Any]):
    """A car that learns to keep its lane through a town.

    ## Description

    A car follows a course of streets with sharp corners: two squares that share a leg, 1,026 m in
    all, the first driven clockwise and the second counter-clockwise. Guard rails and houses stand
    beside the streets. The car is a kinematic bicycle with a wheelbase of 2.7 m; one decision
    lasts 0.25 s of simulated time. The same seed and actions give the same bits.

    Axes are right-handed with z up, x and y in metres; angles grow counter-clockwise, so left is
    positive.

    ## Action Space

    `Discrete(6)`. All but 0 accelerate with 4 (1 - v / 30) m/s^2. The largest steering angle is
    40 degrees, falling to 70 % at 120 km/h, and limited to 9 m/s^2 sideways.

    | Action | Meaning | Steering |
    |---|---|---|
    | 0 | brake with 8 m/s^2 | as last |
    | 1 | straight | 0 |
    | 2 | right | 50 % to the right |
    | 3 | left | 50 % to the left |
    | 4 | slightly right | 25 % to the right |
    | 5 | slightly left | 25 % to the left |

    ## Observation Space

    `observation="state"`: `Box` of 12 float32.

    | Index | Observation | Unit | Limit |
    |---|---|---|---|
    | 0 | distance from the path, left positive | 3.5 m | 4 |
    | 1 | heading error, left positive | pi / 2 rad | 2 |
    | 2 | speed | 30 m/s | 1 |
    | 3 | last steering command, left positive | 50 % | 1 |
    | 4, 5 | path point 5 m ahead: forward, left of the car | 5 m | 4 |
    | 6, 7 | path point 10 m ahead | 10 m | 4 |
    | 8, 9 | path point 20 m ahead | 20 m | 4 |
    | 10, 11 | path point 40 m ahead | 40 m | 4 |

    `observation="depth"`: `Box` of (84, 84, 1) uint8, the front camera's depth in the log code of
    `mcaprl.sims.depth.encode_depth`; 255 where there is nothing.

    ## Rewards

    ds / 7.5 m (1 - (d / 3.5 m)^2 / 2): progress ds along the path, less at distance d from it.
    -5 for leaving the lane or stalling.

    ## Starting State

    `start="anywhere"`: a random place on the path, at least 2 m after and 8 m before a corner, up
    to 1.5 m and 0.2 rad off, at 0 to 10 m/s.
    `start="line"`: 2 m into the course, up to 0.3 m and 0.05 rad off, at rest.
    `reset(options={"pose": (x_m, y_m, yaw_rad)})`, or with a fourth number for the speed in m/s,
    starts there instead.

    ## Episode End

    Terminated with `info["reason"]` = `off_lane` (more than 3.5 m from the path) or `stall`
    (slower than 1 m/s for 3 s). Truncated after 400 steps.

    `info` has lateral_offset_m, heading_error_rad, speed_m_s and progress_m (along the path since
    the start, growing over the laps).

    ## Arguments

    - `rules`: `"default"`.
    - `observation`: `"state"` or `"depth"`.
    - `start`: `"anywhere"` or `"line"`.
    - `render_mode`: None, `"human"` or `"rgb_array"`.

    ## Version History

    - v0: first version.
    """

    metadata = METADATA
    action_meanings: ClassVar[tuple[str, ...]] = ACTION_MEANINGS
    step_duration_s: ClassVar[float] = DECISION_S

    def __init__(
        self,
        rules: str = "default",
        observation: str = "state",
        start: str = "anywhere",
        render_mode: Literal["human", "rgb_array"] | None = None,
    ) -> None:
        """See "Arguments" above.

        Raises:
            UnknownNameError: an argument has a value that is not in its list.
        """
        check_name("rules", rules, RULES)
        check_name("observation", observation, OBSERVATIONS)
        check_name("start", start, STARTS)
        if render_mode is not None:
            check_name("render_mode", render_mode, RENDER_MODES)
        self.render_mode = self._render_mode = render_mode
        self.observation_names = OBSERVATION_NAMES if observation == "state" else ()
        self.action_space = spaces.Discrete(len(ACTION_MEANINGS))
        self.observation_space = (
            spaces.Box(-OBSERVATION_LIMIT, OBSERVATION_LIMIT)
            if observation == "state"
            else spaces.Box(0, 255, DEPTH_SHAPE, np.uint8)
        )
        self._start = start
        self._shows_state = observation == "state"
        self._car = Car(*[0.0] * len(Car._fields))
        self._cars = np.zeros((1, len(self._car)))
        self._actions = np.zeros(1, dtype=np.int64)
        self._rewards = np.zeros(1)
        self._ends = np.zeros(1, dtype=np.int64)
        self._observations = np.zeros((1, len(OBSERVATION_NAMES)), dtype=np.float32)
        self._started_at_m = 0.0
        self._trail_m: deque[tuple[float, float]] = deque(maxlen=TRAIL_LENGTH)
        self._camera: DepthCamera | None = None
        self._depth_m: NDArray[np.float32] | None = None
        self._view: LaneView | None = None

    @property
    def car(self) -> Car:
        """The whole state of the car."""
        return self._car

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Start an episode; see "Starting State".

        Raises:
            UsageError: `options` has an unknown key, or a pose that is not on the lane.
        """
        super().reset(seed=seed)
        self._car = self._start_car() if not options else _car_from(options)
        self._cars[0] = self._car
        self._rewards[0] = 0.0
        observe(self._car, self._observations[0])
        self._started_at_m = self._car.along_m
        self._trail_m.clear()
        return self._seen(), self._info()

    def step(
        self, action: int | np.integer[Any]
    ) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        """Drive on for 0.25 s.

        Raises:
            UsageError: the action is not 0 to 5.
        """
        check_action(action, len(ACTION_MEANINGS))
        self._actions[0] = action
        step_cars(self._cars, self._actions, self._rewards, self._ends, self._observations)
        self._car = Car._make(self._cars[0].tolist())
        reward, end, info = self._rewards.item(), self._ends.item(), self._info()
        if end != DRIVING:
            info["reason"] = REASONS[end]
        return self._seen(), reward, end != DRIVING, False, info

    def _start_car(self) -> Car:
        """Draw a start."""
        draw = self.np_random.uniform
        if self._start == "line":
            along_m, speed_m_s = START_LINE_M, 0.0
            offset_m, error_rad = draw(-0.3, 0.3), draw(-0.05, 0.05)
        else:
            along_m, speed_m_s = self._clear_place_m(), draw(0.0, 10.0)
            offset_m, error_rad = draw(-1.5, 1.5), draw(-0.2, 0.2)
        x_m, y_m = point_at(COURSE, along_m)
        place = project(COURSE, x_m, y_m, along_m, along_m)
        motion = Motion(
            x_m - offset_m * math.sin(place.yaw_rad),
            y_m + offset_m * math.cos(place.yaw_rad),
            place.yaw_rad + error_rad,
            speed_m_s,
        )
        return located(motion, 0.0, along_m, 0.0)

    def _clear_place_m(self) -> float:
        """Draw a place on the path that is not close to a corner, metres along it."""
        while True:
            along_m = float(self.np_random.uniform(0.0, COURSE.length_m))
            leg = leg_at(COURSE, along_m)
            after_m, before_m = along_m - COURSE.along_m[leg], COURSE.along_m[leg + 1] - along_m
            if after_m >= CLEAR_AFTER_CORNER_M and before_m >= CLEAR_BEFORE_CORNER_M:
                return along_m

    def _seen(self) -> NDArray[Any]:
        """Give the observation, and take note of the place for what is drawn."""
        self._depth_m = None
        self._trail_m.append((self._car.x_m, self._car.y_m))
        if self.render_mode == "human":
            self.render()
        if self._shows_state:
            observation: NDArray[np.float32] = self._observations[0].copy()
            return observation
        return encode_depth(self.depth_image_m())[:, :, np.newaxis]

    def _info(self) -> dict[str, Any]:
        car = self._car
        return {
            "lateral_offset_m": car.offset_m,
            "heading_error_rad": car.heading_error_rad,
            "speed_m_s": car.speed_m_s,
            "progress_m": car.along_m - self._started_at_m,
        }

    def telemetry(self) -> dict[str, float]:
        """Give the car's state by name; the units are in the names."""
        car = self._car
        return {
            "x_m": car.x_m,
            "y_m": car.y_m,
            "yaw_rad": car.yaw_rad,
            "speed_m_s": car.speed_m_s,
            "lateral_offset_m": car.offset_m,
            "heading_error_rad": car.heading_error_rad,
            "progress_m": car.along_m - self._started_at_m,
            "steering_rad": wheel_angle(car.steering, car.speed_m_s),
        }

    def depth_image_m(self) -> NDArray[np.float32]:
        """Give the front camera's (84, 84) distances along each ray, metres; inf is nothing."""
        if self._depth_m is None:
            if self._camera is None:
                self._camera = lane_camera()
            car = self._car
            position = (
                car.x_m + CAMERA_FORWARD_M * math.cos(car.yaw_rad),
                car.y_m + CAMERA_FORWARD_M * math.sin(car.yaw_rad),
                CAMERA_HEIGHT_M,
            )
            self._depth_m = self._camera.image_m(position, level_axes(car.yaw_rad))
        return self._depth_m

    def static_scene(self) -> Sequence[Shape]:
        """Give the shapes that never change, those of the car's body in the frame `car`."""
        return lane_scene.static_shapes()

    def scene(self) -> Sequence[Shape]:
        """Give the shapes that change with each step."""
        return lane_scene.moving_shapes(self._car, self._trail_m)

    def static_frames(self) -> Sequence[Frame]:
        """Give the camera's frame in the car: optical axes, z along the view, x right, y down."""
        return (lane_scene.camera_frame(),)

    def frames(self) -> Sequence[Frame]:
        """Give the car's frame in the map."""
        return (lane_scene.car_frame(self._car),)

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the car from above: give (H, W, 3) uint8 for `rgb_array`, show it for `human`."""
        if self._render_mode is None:
            return None
        if self._view is None:
            from mcaprl.sims.lane_view import LaneView

            self._view = LaneView(self._render_mode)
        image = self._view.draw(self._car, np.array(self._trail_m), float(self._rewards[0]))
        return image if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._view is not None:
            self._view.close()
            self._view = None


def _car_from(options: dict[str, Any]) -> Car:
    """Read a start from the options of `reset`."""
    pose = pose_from(options, 0.0, MAX_SPEED_M_S)
    place = project(COURSE, pose.x_m, pose.y_m, 0.0, COURSE.length_m)
    if abs(place.offset_m) > LANE_HALF_WIDTH_M:
        raise UsageError(
            f"pose ({pose.x_m}, {pose.y_m}) is {abs(place.offset_m):.1f} m from the path:"
            f" at most {LANE_HALF_WIDTH_M} m is on the lane"
        )
    return located(Motion(*pose), 0.0, place.along_m, 0.0)
