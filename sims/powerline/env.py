"""Gymnasium environments of the powerline sim."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.camera import focal_lengths
from mcaprl.sims.drawing.scene import Frame, Shape
from mcaprl.sims.powerline import scene as powerline_scene
from mcaprl.sims.powerline.camera import IMAGE_SHAPE, LENS
from mcaprl.sims.powerline.fleet import PowerlineFleet
from mcaprl.sims.powerline.rules import DECISION_S, Flight
from mcaprl.sims.vehicle.batched import BatchedEnv
from mcaprl.sims.vehicle.env import RENDER_MODES, RenderMode, VehicleEnv

if TYPE_CHECKING:
    from mcaprl.sims.powerline.scene import PowerlineView

METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": round(1 / DECISION_S)}


class PowerlineEnv(VehicleEnv[PowerlineFleet, "PowerlineView"]):
    """Flight of a drone along a power line.

    ## Description

    The agent commands the velocity of a drone that follows a line of four legs (71, 146, 198 and
    206 m) over hilly ground, with a tower under each corner and three conductors 6 m below the
    line. The drone is a quadrotor with controllers, or a point mass that follows the command with a
    lag; it always faces north. Results are bit-identical for the same seed and actions.

    Actions, observations and poses use the axes of the published line, NED: x north, y east, z
    **down**; meters and m/s. Data for viewers (telemetry, scene, frames, and the offsets in `info`)
    use ROS axes: x north, y west, z up; y and z have the opposite sign.

    ## Action Space

    `actions="discrete"`: `Discrete(7)`. Each action changes the last commanded velocity by 0.5 m/s;
    a change that would exceed 8 m/s is ignored. One decision lasts 0.5 s.

    | Action | Meaning |
    |---|---|
    | 0 | faster north (+x) |
    | 1 | faster east (+y) |
    | 2 | faster down (+z) |
    | 3 | faster south (-x) |
    | 4 | faster west (-y) |
    | 5 | faster up (-z) |
    | 6 | no change of the command |

    `actions="continuous"`, which is the default of `mcaprl/PowerlineContinuous-v0`: `Box(-1, 1)` of
    3 float32, the commanded velocity north, east and down in units of 8 m/s. A longer vector is
    shortened to 8 m/s.

    `actions="increments"`: `Box(-1, 1)` of 3 float32, the change of the commanded velocity north,
    east and down in m/s. The discrete actions are points of this space.

    ## Observation Space

    `observation="state"`: `Box` of 18 float32.

    | Index | Observation | Unit | Limit |
    |---|---|---|---|
    | 0-2 | position relative to the nearest point of the line: x, y, z | 7 m | 2 |
    | 3-5 | velocity | 5 m/s | 4 |
    | 6-8 | command minus velocity | 1 m/s | 8 |
    | 9-11 | direction of the leg, a unit vector | 1 | 1 |
    | 12-14 | direction of the next leg | 1 | 1 |
    | 15 | distance to the leg's end, at most 60 m | 60 m | 1 |
    | 16 | exp(-distance to the leg's end / 10 m) | 1 | 1 |
    | 17 | distance along the line to the furthest point so far | 10 m | 10 |

    `observation="depth"`: a `Dict` of two parts. `depth`, (84, 84, 1) uint8, is the camera's depth,
    encoded by `mcaprl.sims.drawing.depth.encode_depth`; it is 255 where there is no surface.
    `motion`, 6 float32, has the values 3 to 8 of the table. Conductors are drawn one pixel wide to
    be visible. With `rules="classic"`, the observation is only the image, encoded by
    `encode_nearness`.

    ## Rewards

    The reward is min(x, 2 - x) exp(-d / 4 m) with x = ds / 2.5 m. The drone is at distance d from
    the line, and ds is its progress along the line beyond the furthest point so far. The reward is
    highest at 5 m/s. Finishing adds 5. If the drone leaves the line or collides, the
    reward is -5 instead.

    ## Starting State

    `start="line"`: the drone has flown for 5 s with the command (1, -0.5, -1) m/s from the first
    point of the line, with an offset of up to 0.2 m on each axis.
    `start="anywhere"`: half of the episodes start as with `"line"`. The other half start at a
    random position on the line, except its last 20 m, with an offset of up to 1 m. The drone flies
    along the line at 0 to 5 m/s; the velocity is rounded to 0.5 m/s on each axis.
    `reset(options={"pose": (x_m, y_m, z_m)})` starts at that pose. Three more numbers set the
    velocity in m/s, which is also the first command.

    ## Episode End

    An episode terminates with `info["reason"]` = `off_line` (more than 7 m from the line),
    `collision` (less than 0.6 m from a conductor, 1.2 m from the middle of a tower's mast or arm,
    or 0.3 m from the ground) or `finished` (1 m before the line's end). It is truncated after 400
    steps.

    `info` contains lateral_offset_m (left positive), vertical_offset_m (up positive),
    line_distance_m, speed_m_s and progress_m (distance along the line since the start).

    ## Classic Rules

    `rules="classic"` are the published rules, by default for a point mass that follows its command
    with a lag of 0.5 s. A decision lasts 5 s; actions change the *measured* velocity by
    0.25 m/s. The reward is (exp(-d) - 0.5) + (speed - 0.5), with the distance d to the nearest of
    the *infinite* lines through the legs. An episode starts after 5 s of flight with the
    command (1, -0.67, -0.8) m/s. It terminates beyond 7 m with the reward -10, and at a collision
    with the reward -100. Known faults:

    - Speed is rewarded in any direction: flying back and forth has a higher return than following
      the line.
    - Flying past the first tower along the extension of the first leg is rewarded for over 100 m.
    - The line has no end: flying beyond the last tower is also rewarded.
    - Hovering on the line costs nothing and never ends the episode; flying backward is rewarded
      like flying forward.
    - Actions change the measured velocity, so the effects of gusts and lag on the velocity persist
      in the next command.
    - Decisions of 5 s are too long for corrections: at 5 m/s, the drone flies 25 m, but an episode
      terminates 7 m from the line.
    - The image encoding spends half of its values on distances of 1 to 2 m.

    The world and the lag differ from the published ones, and images are downsampled by averaging
    instead of interpolation. A collision stops the drone.

    ## Arguments

    - `rules`: `"default"` or `"classic"`.
    - `observation`: `"state"` or `"depth"`.
    - `camera`: `"down"` or `"front"`; 90 degrees wide, fixed to the body.
    - `start`: `"anywhere"` or `"line"`; the classic rules always start on the line.
    - `plant`: `"quad"` or `"point"`; None means `"quad"`, or `"point"` in the classic rules.
    - `wind_m_s`: maximum steady wind, 0 to 8; speed and direction are random in each episode.
    - `gust_m_s`: standard deviation of the gusts on each axis, 0 to 3; 0 in the classic rules.
      Wind and gusts have no effect on a point mass.
    - `actions`: `"discrete"`, `"continuous"` or `"increments"`; only `"discrete"` in the classic
      rules.
    - `render_mode`: None, `"human"` or `"rgb_array"`.

    ## Version History

    - v0: first version.
    """

    metadata = METADATA
    fleet_type = PowerlineFleet
    success_reasons = ("finished",)
    view_settings: ClassVar[dict[str, float]] = {
        "distance_m": 20.0,
        "tilt_deg": 72.0,
        "world_m": 350.0,
        "world_x_m": 270.0,
        "world_y_m": -40.0,
        "depth_min_m": 8.0,
        "depth_max_m": 56.0,
        "speed_m_s": 8.0,
    }

    @property
    def flight(self) -> Flight:
        """State of the drone, NED."""
        return self.fleet.flight(0)

    @property
    def place(self) -> tuple[float, ...]:
        """Current position of the drone, NED."""
        return self.flight.drone.position_m

    def telemetry(self) -> dict[str, float]:
        """Return the drone's state as named numbers, in ROS axes; the names include the units."""
        return {**powerline_scene.telemetry(self.flight), **self.fleet.info(0)}

    def depth_image_m(self) -> NDArray[np.float32]:
        """Return distances (84, 84) along the rays in meters, infinite where a ray hits nothing."""
        return self.fleet.depth_image_m(0)

    def depth_focal_px(self) -> tuple[float, float]:
        """Return the focal lengths of the depth image, in pixel widths and pixel heights."""
        return focal_lengths(LENS, IMAGE_SHAPE)

    def static_scene(self) -> Sequence[Shape]:
        """Return the shapes that never change; the drone's shapes are in the frame `drone`."""
        return powerline_scene.static_shapes()

    def scene(self) -> Sequence[Shape]:
        """Return the shapes that change with each step."""
        return powerline_scene.moving_shapes(self.flight, self.trail)

    def map_scene(self) -> Sequence[Shape]:
        """Return the route and the towers, large enough for a view of the whole world."""
        return powerline_scene.map_shapes()

    def static_frames(self) -> Sequence[Frame]:
        """Return the camera's frame, relative to the drone: x right, y down, z along the view."""
        return (powerline_scene.camera_frame(self.fleet.camera_view),)

    def frames(self) -> Sequence[Frame]:
        """Return the drone's level frame in the map, and the body's frame in the level frame."""
        return powerline_scene.drone_frames(self.flight.drone)

    def _state(self) -> Flight:
        return self.flight

    def _moments(self, before: Flight, command: Sequence[float]) -> list[Sequence[Frame]]:
        return [powerline_scene.drone_frames(drone) for drone in self.fleet.drones_from(before)]

    def _open_view(self, render_mode: RenderMode) -> PowerlineView:
        from mcaprl.sims.powerline.scene import PowerlineView

        return PowerlineView(render_mode)

    def _draw(self, view: PowerlineView) -> NDArray[np.uint8]:
        return view.draw(self.flight, self.trail, self.fleet.rewards.item())


class BatchedPowerlineEnv(BatchedEnv):
    """Vectorized environment of N drones, each with its own wind; see `PowerlineEnv`."""

    fleet_type = PowerlineFleet
