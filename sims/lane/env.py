"""Gymnasium environments of the lane sim."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.camera import focal_lengths
from mcaprl.sims.drawing.scene import Frame, Shape
from mcaprl.sims.drawing.shapes import car_frame
from mcaprl.sims.drawing.top_view import Body, FollowView
from mcaprl.sims.lane import scene as lane_scene
from mcaprl.sims.lane.camera import IMAGE_SHAPE, LENS
from mcaprl.sims.lane.fleet import LaneFleet
from mcaprl.sims.lane.rules import DECISION_S, Car, wheel_angle
from mcaprl.sims.vehicle.batched import BatchedEnv
from mcaprl.sims.vehicle.env import RENDER_MODES, RenderMode, VehicleEnv

VIEW_M = 55.0  # Width of the ground in the rendered image
METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": round(1 / DECISION_S)}


class LaneKeepingEnv(VehicleEnv[LaneFleet, FollowView]):
    """Lane keeping on the streets of a town.

    ## Description

    The agent drives a car along streets with sharp corners, between guard rails and houses. The
    course is 1,026 m long. It consists of two squares that share a leg; the first is driven
    clockwise, the second counter-clockwise. The car is a kinematic bicycle with a wheelbase of
    2.7 m. One decision lasts 0.25 s of simulated time. Results are bit-identical for the same seed
    and actions.

    Axes are right-handed with z up; x and y are in meters. Angles are counter-clockwise, so left
    is positive.

    The leg that both squares share looks the same on both, but ends with a right turn on the first
    square and with a left turn on the second. Barriers, 3 m high, therefore close the streets of
    the other square at both ends of this leg.

    ## Action Space

    `actions="discrete"`: `Discrete(6)`. Actions 1 to 5 accelerate with 4 (1 - v / 30) m/s^2. The
    maximum steering angle is 40 degrees at rest and decreases to 28 degrees at 120 km/h; the
    lateral acceleration is limited to 9 m/s^2.

    | Action | Meaning | Steering |
    |---|---|---|
    | 0 | brake with 8 m/s^2 | unchanged |
    | 1 | straight | 0 |
    | 2 | right | 50 % to the right |
    | 3 | left | 50 % to the left |
    | 4 | slightly right | 25 % to the right |
    | 5 | slightly left | 25 % to the left |

    `actions="continuous"`, which is the default of `mcaprl/LaneKeepingContinuous-v0`: `Box(-1, 1)`
    of 2 float32.

    | Index | Part | 1 | -1 |
    |---|---|---|---|
    | 0 | pedal | accelerate with 4 (1 - v / 30) m/s^2 | brake with 8 m/s^2 |
    | 1 | steering | maximum angle to the left | maximum angle to the right |

    Accelerations are proportional to the pedal on each side of 0, where the car rolls. The discrete
    actions are points of this space: pedal -1 or 1, and steering 0, 0.25 or 0.5.

    ## Observation Space

    `observation="state"`: `Box` of 12 float32.

    | Index | Observation | Unit | Limit |
    |---|---|---|---|
    | 0 | distance from the path, left positive | 3.5 m | 4 |
    | 1 | heading error, left positive | pi / 2 rad | 2 |
    | 2 | speed | 30 m/s | 1 |
    | 3 | last steering command, left positive | 50 % | 1; 2 if continuous |
    | 4, 5 | path point 5 m ahead: forward, left of the car | 5 m | 4 |
    | 6, 7 | path point 10 m ahead | 10 m | 4 |
    | 8, 9 | path point 20 m ahead | 20 m | 4 |
    | 10, 11 | path point 40 m ahead | 40 m | 4 |

    `observation="depth"`: `Box` of (84, 84, 1) uint8, the front camera's depth, encoded by
    `mcaprl.sims.drawing.depth.encode_depth`; 255 where there is no surface.

    `observation="dashboard"`: a `Dict` with two entries. `depth` is the same image. `motion` has 3
    float32: speed and steering as in rows 2 and 3 of the table, and the direction of the next turn,
    1 left or -1 right. A single image shows neither the speed nor the direction of the next turn.

    `observation="depth-commands"`: a `Dict` with two entries. `depth` is the same image. `commands`
    has 64 float32: two numbers for each of the last 32 decisions, newest first. The first number is
    the pedal: -1 for braking and 1 for accelerating. The second number is the steering command as
    in row 3 of the table; the action `brake` does not change it. Both are 0 before the start of the
    episode. The image is the only measurement, because an agent knows its own commands. The
    commands determine the speed, except for the influence of the speed at the start, which
    decreases with time.

    `observation="rays"`: `Box` of 20 float32.

    | Index | Observation | Unit | Limit |
    |---|---|---|---|
    | 0 to 15 | distance to the next rail, barrier or house | see below | 0 to 1 |
    | 16 | speed | 30 m/s | 0 to 1 |
    | 17 | last steering command, left positive | 50 % | 1; 2 if continuous |
    | 18, 19 | path point 20 m ahead: forward, left of the car | 20 m | 4 |

    The rays start at the car's center, in the directions 0, 10, -10, 20, -20, 30, -30, 45, -45, 60,
    -60, 90, -90, 135, -135 and 180 degrees; left is positive. A distance d is encoded as
    ln(1 + d / 1 m) / ln(101), and as 1 beyond 100 m. At a crossing, the path point
    indicates the street to take.

    ## Rewards

    The reward is ds / 7.5 m (1 - (d / 3.5 m)^2 / 2), where ds is the progress along the path and d
    the distance from it. A step that leaves the lane or stalls has the reward -5.

    ## Starting State

    `start="anywhere"`: a random position on the path, at least 2 m after and 8 m before a corner,
    with an offset of up to 1.5 m and 0.2 rad, at 0 to 10 m/s.
    `start="line"`: 2 m from the start of the course, with an offset of up to 0.3 m and 0.05 rad, at
    rest.
    `reset(options={"pose": (x_m, y_m, yaw_rad)})` starts at that pose; the speed in m/s may follow
    as a fourth number.

    ## Episode End

    Terminated with `info["reason"]` = `off_lane` (more than 3.5 m from the path) or `stall`
    (slower than 1 m/s for 3 s). Truncated after 400 steps.

    `info` contains lateral_offset_m, heading_error_rad, speed_m_s and progress_m (distance along
    the path since the start, over all laps).

    ## Classic Rules

    `rules="classic"` and `"classic-code"` are the published rules. A decision lasts one second. Let
    v be the speed in m/s, and d the distance in meters to the nearest of the *infinite* lines
    through the legs. The reward is (exp(-3 d) - 0.5) + ((v - 10) / (300 - 10) - 0.5), but -3 beyond
    3.5 m. An episode terminates if the reward is below -1 (`off_lane` beyond 3.5 m, else
    `low_reward`). In the published text (`"classic"`), it also terminates at 5 m/s or less without
    braking (`slow`). In the published code (`"classic-code"`), it also terminates if the car
    touches a rail or a house during action 1, straight (`collision`). An episode starts on the
    start line, after one second straight ahead. `depth` is encoded by `encode_nearness`. Known
    faults:

    - Speed is divided by about 300 m/s, so its term is always near -0.5. The reward is near 0 for a
      fast car in the middle of the lane, and below -0.5 per second at an offset of 0.3 m. A whole
      lap has a return far below -3, but leaving the road at once has a return of only -3.
    - The limit of -1 on the reward is a second limit on the distance. It is 1.1 m at rest and
      increases with the speed; at 10 m/s or more, there is no second limit.
    - The lines are infinite. A car that leaves the course along the extension of a leg gets the
      same reward as on the course.
    - Standing still with the brake never ends an episode, and costs less than most driving.
    - In the published code, a collision ends an episode only during the action straight.
    - A decision of one second is too long for corrections: at 15 m/s, any steering action makes
      the car leave the lane.
    - There are no barriers, so a camera image does not show which street to take at the end of the
      shared leg.
    - The image encoding uses half of its values for distances of 1 to 2 m.

    The car and the town differ from the published ones, and images are downsampled by averaging
    instead of interpolation. Rails and houses do not stop a car.

    ## Arguments

    - `rules`: `"default"`, `"classic"` or `"classic-code"`.
    - `observation`: `"state"`, `"depth"`, `"depth-commands"`, `"dashboard"` or `"rays"`.
    - `start`: `"anywhere"` or `"line"`; None means `"anywhere"`, or `"line"` in the classic rules.
    - `actions`: `"discrete"` or `"continuous"`; only `"discrete"` in the classic rules.
    - `render_mode`: None, `"human"` or `"rgb_array"`.

    ## Version History

    - v0: first version.
    """

    metadata = METADATA
    fleet_type = LaneFleet
    success_reasons = ("time_limit",)
    view_settings: ClassVar[dict[str, float]] = {
        "distance_m": 22.0,
        "tilt_deg": 73.0,
        "world_m": 190.0,
        "world_x_m": 65.0,
        "world_y_m": 1.5,
        "world_turn_deg": 90.0,
        "depth_min_m": 3.0,
        "depth_max_m": 56.0,
        "speed_m_s": 30.0,
    }

    @property
    def car(self) -> Car:
        """State of the car."""
        return self.fleet.car(0)

    @property
    def place(self) -> tuple[float, ...]:
        """Current position of the car: x and y in the map."""
        car = self.car
        return car.x_m, car.y_m

    def telemetry(self) -> dict[str, float]:
        """Return the state of the car as named numbers; each name ends in its unit."""
        car = self.car
        return {
            "x_m": car.x_m,
            "y_m": car.y_m,
            "yaw_rad": car.yaw_rad,
            **self.fleet.info(0),
            "steering_rad": wheel_angle(car.steering, car.speed_m_s),
        }

    def depth_image_m(self) -> NDArray[np.float32]:
        """Return the front camera's image: (84, 84) distances along each ray, meters."""
        return self.fleet.depth_image_m(0)

    def depth_focal_px(self) -> tuple[float, float]:
        """Return the focal lengths of the depth image, in pixel widths and pixel heights."""
        return focal_lengths(LENS, IMAGE_SHAPE)

    def static_scene(self) -> Sequence[Shape]:
        """Return the shapes that never change; the car's shapes are in the frame `car`."""
        return lane_scene.static_shapes()

    def scene(self) -> Sequence[Shape]:
        """Return the shapes that change with each step."""
        return lane_scene.moving_shapes(
            self.car, self.trail, has_rays=self.fleet.has_rays, has_barriers=self.fleet.has_barriers
        )

    def static_frames(self) -> Sequence[Frame]:
        """Return the camera's frame in the car: x right, y down, z along the view."""
        return (lane_scene.camera_frame(),)

    def frames(self) -> Sequence[Frame]:
        """Return the car's frame in the map."""
        return _frames_of(self.car)

    def _state(self) -> Car:
        return self.car

    def _moments(self, before: Any, command: Sequence[float]) -> list[Sequence[Frame]]:
        return [_frames_of(car) for car in self.fleet.substeps(before, command)]

    def _open_view(self, render_mode: RenderMode) -> FollowView:
        frames_per_s = self.metadata["render_fps"]
        return FollowView(render_mode, "lane", self.static_scene(), VIEW_M, frames_per_s)

    def _draw(self, view: FollowView) -> NDArray[np.uint8]:
        car, reward = self.car, self.fleet.rewards.item()
        text = (
            f"{car.speed_m_s:4.1f} m/s   offset {car.offset_m:+.2f} m   "
            f"at {car.along_m:.0f} m   reward {reward:+.2f}"
        )
        view.draw(self.scene(), Body("car", car.x_m, car.y_m, car.yaw_rad), text)
        return view.show()


class BatchedLaneKeepingEnv(BatchedEnv):
    """Vectorized environment of N cars; takes the same arguments as `LaneKeepingEnv`."""

    fleet_type = LaneFleet


def _frames_of(car: Car) -> tuple[Frame]:
    return (car_frame(car.x_m, car.y_m, car.yaw_rad),)
