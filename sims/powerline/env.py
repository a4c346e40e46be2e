"""The powerline sim as a Gymnasium environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.scene import Frame, Shape
from mcaprl.sims.powerline import scene as powerline_scene
from mcaprl.sims.powerline.fleet import PowerlineFleet
from mcaprl.sims.powerline.rules import DECISION_S, Flight
from mcaprl.sims.vehicle.batched import BatchedEnv
from mcaprl.sims.vehicle.env import RENDER_MODES, RenderMode, VehicleEnv

if TYPE_CHECKING:
    from mcaprl.sims.powerline.view import PowerlineView

METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": round(1 / DECISION_S)}


class PowerlineEnv(VehicleEnv[PowerlineFleet, "PowerlineView"]):
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

    `observation="depth"`: a `Dict` of `depth`, (84, 84, 1) uint8, the camera's image in the
    logarithmic code of `mcaprl.sims.drawing.depth.encode_depth`, 255 where there is nothing; and
    `motion`, 6 float32, rows 3 to 8 of the table. Conductors are drawn one pixel wide, or none
    would be seen. With `rules="classic"` it is the image alone, in the code of `encode_nearness`.

    ## Rewards

    min(x, 2 - x) exp(-d / 4 m) with x = ds / 2.5 m, for progress ds along the line beyond the
    furthest point so far, at distance d from it: 5 m/s are paid best, and what is faster is paid
    less. 5 more for finishing, -5 for leaving the line or a collision.

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
    success_reasons = ("finished",)

    def __init__(
        self,
        rules: str = "default",
        observation: str = "state",
        camera: str = "down",
        start: str = "anywhere",
        plant: str | None = None,
        wind_m_s: float = 0.0,
        gust_m_s: float = 0.0,
        render_mode: RenderMode | None = None,
    ) -> None:
        """See "Arguments" above.

        Raises:
            UnknownNameError: an argument has a value that is not in its list.
            UsageError: a number is outside its range, or the classic rules are to have gusts.
        """
        fleet = PowerlineFleet(1, rules, observation, camera, start, plant, wind_m_s, gust_m_s)
        super().__init__(fleet, render_mode)
        self._camera = camera

    @property
    def flight(self) -> Flight:
        """The whole state of the drone, NED."""
        return self.fleet.flight(0)

    @property
    def place(self) -> tuple[float, ...]:
        """Where the drone is now, NED."""
        return self.flight.drone.position_m

    def telemetry(self) -> dict[str, float]:
        """Give the drone's state by name, in ROS axes; the units are in the names."""
        return {**powerline_scene.telemetry(self.flight), **self.fleet.info(0)}

    def depth_image_m(self) -> NDArray[np.float32]:
        """Give the camera's (84, 84) distances along each ray, metres; inf is nothing."""
        return self.fleet.depth_image_m(0)

    def static_scene(self) -> Sequence[Shape]:
        """Give the shapes that never change, those of the drone's body in the frame `drone`."""
        return powerline_scene.static_shapes()

    def scene(self) -> Sequence[Shape]:
        """Give the shapes that change with each step."""
        return powerline_scene.moving_shapes(self.flight, self.trail)

    def static_frames(self) -> Sequence[Frame]:
        """Give the camera's frame in the drone: optical axes, z along the view, x right, y down."""
        return (powerline_scene.camera_frame(self._camera),)

    def frames(self) -> Sequence[Frame]:
        """Give the drone's place in the map, level, and its attitude there."""
        return powerline_scene.drone_frames(self.flight.drone)

    def _open_view(self, render_mode: RenderMode) -> PowerlineView:
        from mcaprl.sims.powerline.view import PowerlineView

        return PowerlineView(render_mode)

    def _draw(self, view: PowerlineView) -> NDArray[np.uint8]:
        return view.draw(self.flight, self.trail, self.fleet.rewards.item())


class BatchedPowerlineEnv(BatchedEnv):
    """Many drones at once, each in a wind of its own; see `PowerlineEnv`."""

    fleet_type = PowerlineFleet
