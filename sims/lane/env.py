"""The lane sim as a Gymnasium environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.scene import Frame, Shape
from mcaprl.sims.lane import scene as lane_scene
from mcaprl.sims.lane.fleet import LaneFleet
from mcaprl.sims.lane.rules import DECISION_S, Car, wheel_angle
from mcaprl.sims.vehicle.batched import BatchedEnv
from mcaprl.sims.vehicle.env import RENDER_MODES, RenderMode, VehicleEnv

if TYPE_CHECKING:
    from mcaprl.sims.lane.view import LaneView

METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": round(1 / DECISION_S)}


class LaneKeepingEnv(VehicleEnv[LaneFleet, "LaneView"]):
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
    `mcaprl.sims.drawing.depth.encode_depth`; 255 where there is nothing.

    `observation="dashboard"`: a `Dict` of `depth`, the same picture, and `motion`, 3 float32: rows
    2 and 3 of the table, and which way the course turns at the next corner, 1 left or -1 right. One
    picture alone tells neither the speed nor, where a street ends, where to go.

    `observation="rays"`: `Box` of 20 float32.

    | Index | Observation | Unit | Limit |
    |---|---|---|---|
    | 0 to 15 | distance to the next rail or house | see below | 0 to 1 |
    | 16 | speed | 30 m/s | 0 to 1 |
    | 17 | last steering command, left positive | 50 % | 1 |
    | 18, 19 | path point 20 m ahead: forward, left of the car | 20 m | 4 |

    The rays leave the car's middle at 0, 10, -10, 20, -20, 30, -30, 45, -45, 60, -60, 90, -90, 135,
    -135 and 180 degrees; left is positive. A distance of d metres is observed as
    ln(1 + d / 1 m) / ln(101), and as 1 beyond 100 m. Rays show where the streets are, and the path
    point which one to take.

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

    ## Classic Rules

    `rules="classic"` and `"classic-code"` are the system as it was published: a decision each
    second; the reward is (exp(-3 d) - 0.5) + ((v - 10) / (300 - 10) - 0.5) at v m/s, with d to the
    nearest of the *endless* straight lines through the legs, and -3 beyond 3.5 m. Terminated where
    the reward is less than -1 (`off_lane` beyond 3.5 m, else `low_reward`); and, by the published
    text (`"classic"`), at 5 m/s or less without braking (`slow`), or, by the published code
    (`"classic-code"`), where the car touches a rail or a house while it drives straight ahead,
    action 1 (`collision`). It starts on the line, with a second straight ahead. `depth` is in the
    code of `encode_nearness`. Their faults:

    - Speed is measured against 300 m/s, so that its term is near -0.5 for ever: even in the middle
      of the lane, a fast car earns almost nothing, and 0.3 m beside it loses more than half a point
      a second. A whole lap scores far below leaving the road at once, which costs 3.
    - "Reward less than -1" is a second, hidden lane: 1.1 m to each side at rest, growing with the
      speed, and gone at 10 m/s.
    - The lines are endless: driving off along the extension of a leg is paid like driving on it.
    - Braking to a stand never ends, and costs less than many a drive.
    - By the code, driving through a wall is over only when driving straight ahead.
    - In a second, nothing can be corrected: at 15 m/s, the slightest steering leaves the lane.
    - The picture's code spends half of its values on 1 to 2 m.

    Ours are the car, the town, and the picture's averaging where the published one interpolates.
    Rails and houses do not stop a car.

    ## Arguments

    - `rules`: `"default"`, `"classic"` or `"classic-code"`.
    - `observation`: `"state"`, `"depth"`, `"dashboard"` or `"rays"`.
    - `start`: `"anywhere"` or `"line"`; None is `"anywhere"`, in the classic rules `"line"`.
    - `render_mode`: None, `"human"` or `"rgb_array"`.

    ## Version History

    - v0: first version.
    """

    metadata = METADATA
    success_reasons = ("time_limit",)

    def __init__(
        self,
        rules: str = "default",
        observation: str = "state",
        start: str | None = None,
        render_mode: RenderMode | None = None,
    ) -> None:
        """See "Arguments" above.

        Raises:
            UnknownNameError: an argument has a value that is not in its list.
        """
        super().__init__(LaneFleet(1, rules, observation, start), render_mode)
        self._has_rays = observation == "rays"

    @property
    def car(self) -> Car:
        """The whole state of the car."""
        return self.fleet.car(0)

    @property
    def place(self) -> tuple[float, ...]:
        """Where the car is now: x and y in the map."""
        car = self.car
        return car.x_m, car.y_m

    def telemetry(self) -> dict[str, float]:
        """Give the car's state by name; the units are in the names."""
        car = self.car
        return {
            "x_m": car.x_m,
            "y_m": car.y_m,
            "yaw_rad": car.yaw_rad,
            **self.fleet.info(0),
            "steering_rad": wheel_angle(car.steering, car.speed_m_s),
        }

    def depth_image_m(self) -> NDArray[np.float32]:
        """Give the front camera's (84, 84) distances along each ray, metres; inf is nothing."""
        return self.fleet.depth_image_m(0)

    def static_scene(self) -> Sequence[Shape]:
        """Give the shapes that never change, those of the car's body in the frame `car`."""
        return lane_scene.static_shapes()

    def scene(self) -> Sequence[Shape]:
        """Give the shapes that change with each step."""
        return lane_scene.moving_shapes(self.car, self.trail, self._has_rays)

    def static_frames(self) -> Sequence[Frame]:
        """Give the camera's frame in the car: optical axes, z along the view, x right, y down."""
        return (lane_scene.camera_frame(),)

    def frames(self) -> Sequence[Frame]:
        """Give the car's frame in the map."""
        return (lane_scene.car_frame(self.car),)

    def _open_view(self, render_mode: RenderMode) -> LaneView:
        from mcaprl.sims.lane.view import LaneView

        return LaneView(render_mode)

    def _draw(self, view: LaneView) -> NDArray[np.uint8]:
        return view.draw(self.car, self.scene(), self.fleet.rewards.item())


class BatchedLaneKeepingEnv(BatchedEnv):
    """Many cars at once; see `LaneKeepingEnv`, whose arguments it has."""

    fleet_type = LaneFleet
