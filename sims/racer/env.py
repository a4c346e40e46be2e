"""Gymnasium environments of the racer sim."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.scene import Frame, Shape
from mcaprl.sims.drawing.shapes import car_moments
from mcaprl.sims.racer import scene as racer_scene
from mcaprl.sims.racer.course import Car, Track
from mcaprl.sims.racer.fleet import RacerFleet
from mcaprl.sims.racer.rules import STEP_S, Command
from mcaprl.sims.vehicle.batched import BatchedEnv
from mcaprl.sims.vehicle.env import RENDER_MODES, RenderMode, VehicleEnv

if TYPE_CHECKING:
    from mcaprl.sims.racer.scene import RacerView

METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": round(1 / STEP_S)}


class RacerEnv(VehicleEnv[RacerFleet, "RacerView"]):
    """Racing around a walled track with ray sensors.

    ## Description

    The agent drives a car of 30 x 14 pixels counter-clockwise around a closed track, which is
    defined in a top view of 1000 x 600 pixels: 48 straight walls, about 83 pixels apart, and 37
    gates. The car turns by 15 degrees per step and drives at up to 10 pixels per step, forward or
    backward. Results are bit-identical for the same seed and actions.

    Rays, walls and rules use pixels of the image, y down. For viewers, poses and `info`, one pixel
    is 0.1 m and one step is 0.1 s, so that 1 pixel per step is 1 m/s. The map's axes are
    right-handed with z up, its origin is the image's lower left corner, and angles are
    counter-clockwise.

    ## Action Space

    `actions="discrete"`: `Discrete(9)`. The speed changes by 2 pixels per step.

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

    `actions=5` allows actions 0 to 4; `actions=8` allows all actions except `none`,
    renumbered from 0.

    `actions="continuous"`, which is the default of `mcaprl/RacerContinuous-v0`: `Box(-1, 1)` of 2
    float32. The discrete actions are points of this space.

    | Index | Part | 1 | -1 |
    |---|---|---|---|
    | 0 | acceleration | 2 pixels per step faster | 2 pixels per step slower |
    | 1 | turn | 15 degrees to the left | 15 degrees to the right |

    ## Observation Space

    `observation="rays"`: `Box(-1, 1)` of 19 float32, all without a unit.

    | Index | Observation |
    |---|---|
    | 0 to 7 | from the center: 0, -30, 30, 45, -45, 90, -90, 180 degrees; right is positive |
    | 8 to 13 | from the center: 10, -10, 135, -135, 20, -20 degrees |
    | 14, 15 | from the front's left corner to the left, from its right corner to the right |
    | 16, 17 | from the front's left and right corner, straight ahead |
    | 18 | speed / 10 pixels per step, forward is positive |

    A ray of d pixels to the nearest wall is observed as ln(1 + d / 10) / ln(101). The nearest 50
    pixels cover 39 % of this scale, but 5 % of the classic scale (1000 - d) / 1000; agents learn to
    complete laps in fewer steps with the logarithmic scale.

    ## Rewards

    The reward is +1 if the car's center passes the next gate, -1 for a crash, and otherwise 0.

    ## Starting State

    `start="anywhere"`: a random position on the track, with an offset of up to 12 pixels and 0.2
    rad from the center line. The speed is 0 to 6 pixels per step.
    `start="line"`: (50, 300) pixels, facing down in the image, with an offset of up to 3 pixels and
    0.05 rad. The car is at rest. On a random track, the car starts at the start
    of the track's path.
    `reset(options={"pose": (x_m, y_m, yaw_rad)})` starts at that pose; the speed in m/s may follow
    as a fourth number.

    ## Episode End

    An episode terminates with `info["reason"]` = `crash` if a wall intersects an edge of the car.
    It is truncated with `no_gate` after 100 steps without a gate, and with `time_limit` after 1,000
    steps.

    `info` contains lateral_offset_m, heading_error_rad, speed_m_s, progress_m (distance along the
    center line since the start, over all laps) and gates_passed.

    ## Classic Rules

    `rules="classic"` are the published rules, on a different track. They differ as follows:

    - Forward and back are swapped: `forward` drives in the direction opposite to ray 0, so that
      gates can only be passed with `back`. The observed speed is positive in the direction in
      which `forward` drives.
    - Rays that start at the front corners have lengths that are measured from the car's center. The
      sideways ray of the left corner points right, and the sideways ray of the right corner points
      left, so both rays cross the nose of the car.
    - The hit point of a ray is rounded down to whole pixels, so that a car in the middle of a
      straight observes unequal distances.
    - Rays are observed as (1000 - d) / 1000; five of six values are between 0.8 and 1.
    - A gate is passed if it is straight ahead of the car and within 20 pixels of the car's center
      (rounded down), hence before the car crosses the gate. A gate that the car crosses in any
      other way can never be passed.
    - The reward of a crash is -1 for each wall that is hit; at the joint of two walls, it is -2.
    - The start is always exactly on the line, at rest.
    - An episode is truncated after 10,000 steps.

    ## Arguments

    - `rules`: `"default"` or `"classic"`.
    - `observation`: `"rays"`.
    - `start`: `"anywhere"` or `"line"`; None means `"anywhere"`, or `"line"` in the classic rules.
    - `actions`: `"discrete"` or 9, 8, 5, or `"continuous"`, which the classic rules do not have.
    - `drift`: whether the direction of travel lags behind the heading. It turns toward the heading
      by at most 100 / (speed + 1) degrees per step.
    - `track_seed`: None for the default track, or the seed of a random track, at least 0.
    - `render_mode`: None, `"human"` or `"rgb_array"`.

    ## Version History

    - v0: first version.
    """

    metadata = METADATA
    fleet_type = RacerFleet
    success_reasons = ("time_limit",)
    view_settings: ClassVar[dict[str, float]] = {
        "distance_m": 15.0,
        "tilt_deg": 72.0,
        "world_m": 66.0,
        "world_x_m": 50.0,
        "world_y_m": 30.0,
        "speed_m_s": 10.0,
    }

    @property
    def car(self) -> Car:
        """State of the car."""
        return self.fleet.car(0)

    @property
    def track(self) -> Track:
        """Track of the car."""
        return self.fleet.track

    @property
    def place(self) -> tuple[float, ...]:
        """Current position of the car: x and y in the map."""
        return racer_scene.car_frame(self.car).position[:2]

    def telemetry(self) -> dict[str, float]:
        """Return the state of the car by name; names include the units."""
        x_m, y_m = self.place
        info = {name: float(value) for name, value in self.fleet.info(0).items()}
        return {"x_m": x_m, "y_m": y_m, "yaw_rad": -self.car.heading_rad, **info}

    def static_scene(self) -> Sequence[Shape]:
        """Return the shapes that never change; the car's shapes are in the frame `car`."""
        return racer_scene.static_shapes(self.track)

    def scene(self) -> Sequence[Shape]:
        """Return the shapes that change with each step."""
        return racer_scene.moving_shapes(self.track, self.car, self.trail)

    def static_frames(self) -> Sequence[Frame]:
        """Return an empty tuple, because the car has no sensor frame."""
        return ()

    def frames(self) -> Sequence[Frame]:
        """Return the car's frame in the map."""
        return (racer_scene.car_frame(self.car),)

    def _state(self) -> Car:
        return self.car

    def _moments(self, before: Car, command: Sequence[float]) -> list[Sequence[Frame]]:
        # By the rules, a car turns at once and then moves. A viewer shows an arc instead.
        start, end = racer_scene.pose_of(before), racer_scene.pose_of(self.car)
        return car_moments(start, end, self.step_duration_s)

    def _open_view(self, render_mode: RenderMode) -> RacerView:
        from mcaprl.sims.racer.scene import RacerView

        return RacerView(render_mode, self.track)

    def _draw(self, view: RacerView) -> NDArray[np.uint8]:
        return view.draw(self.car, self.trail, Command(*self.fleet.commands[0].tolist()))


class BatchedRacerEnv(BatchedEnv):
    """Vectorized environment of N cars; see `RacerEnv` for the arguments."""

    fleet_type = RacerFleet
