"""The racer sim as a Gymnasium environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims.drawing.scene import Frame, Shape
from mcaprl.sims.racer import scene as racer_scene
from mcaprl.sims.racer.car import Racer
from mcaprl.sims.racer.fleet import RacerFleet
from mcaprl.sims.racer.rules import STEP_S
from mcaprl.sims.racer.track import Track
from mcaprl.sims.vehicle.batched import BatchedEnv
from mcaprl.sims.vehicle.env import RENDER_MODES, RenderMode, VehicleEnv

if TYPE_CHECKING:
    from mcaprl.sims.racer.view import RacerView

METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": round(1 / STEP_S)}


class RacerEnv(VehicleEnv[RacerFleet, "RacerView"]):
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
    success_reasons = ("time_limit",)

    def __init__(
        self,
        rules: str = "default",
        observation: str = "rays",
        start: str | None = None,
        actions: int = 9,
        drift: bool = False,
        track_seed: int | None = None,
        render_mode: RenderMode | None = None,
    ) -> None:
        """See "Arguments" above.

        Raises:
            UnknownNameError: an argument has a value that is not in its list.
            UsageError: the track's seed is not a whole number of 0 or more.
        """
        fleet = RacerFleet(1, rules, observation, start, actions, drift, track_seed)
        super().__init__(fleet, render_mode)

    @property
    def car(self) -> Racer:
        """The whole state of the car."""
        return self.fleet.car(0)

    @property
    def track(self) -> Track:
        """What it drives on."""
        return self.fleet.track

    @property
    def place(self) -> tuple[float, ...]:
        """Where the car is now: x and y in the map."""
        return racer_scene.car_frame(self.car).position[:2]

    def telemetry(self) -> dict[str, float]:
        """Give the car's state by name; the units are in the names."""
        x_m, y_m = self.place
        told = {name: float(value) for name, value in self.fleet.info(0).items()}
        return {"x_m": x_m, "y_m": y_m, "yaw_rad": -self.car.heading_rad, **told}

    def static_scene(self) -> Sequence[Shape]:
        """Give the shapes that never change, those of the car's body in the frame `car`."""
        return racer_scene.static_shapes(self.track)

    def scene(self) -> Sequence[Shape]:
        """Give the shapes that change with each step."""
        return racer_scene.moving_shapes(self.track, self.car, self.trail)

    def static_frames(self) -> Sequence[Frame]:
        """Give no frames: nothing is fixed to the car but its body."""
        return ()

    def frames(self) -> Sequence[Frame]:
        """Give the car's frame in the map."""
        return (racer_scene.car_frame(self.car),)

    def _open_view(self, render_mode: RenderMode) -> RacerView:
        from mcaprl.sims.racer.view import RacerView

        return RacerView(render_mode, self.track)

    def _draw(self, view: RacerView) -> NDArray[np.uint8]:
        return view.draw(self.car, self.trail, self.fleet.last_actions.item())


class BatchedRacerEnv(BatchedEnv):
    """Many cars at once; see `RacerEnv`, whose arguments it has."""

    fleet_type = RacerFleet
