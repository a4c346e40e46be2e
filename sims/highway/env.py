"""Gymnasium environment of the highway-lane sim, a wrapper around highway-env, and its pilot."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np
from gymnasium import spaces
from highway_env.envs.lane_keeping_env import LaneKeepingEnv
from highway_env.envs.racetrack_env import RacetrackEnv, RacetrackEnvOval
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.sims.drawing.scene import Frame, Shape
from mcaprl.sims.drawing.shapes import car_frame, car_moments
from mcaprl.sims.drawing.top_view import Body, FollowView
from mcaprl.sims.highway import scene as highway_scene
from mcaprl.sims.highway.scene import FLIP, Car, Course, Place, courses_of
from mcaprl.sims.vehicle.controls import KINDS, Controls, Pose, check_actions, check_name, pose_from
from mcaprl.sims.vehicle.env import RENDER_MODES, RenderedEnv, RenderMode, ScriptedPilot, before_end

Floats = NDArray[np.float64]

VIEW_M = 80.0  # Width of the ground in the rendered image
METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 10}
ROADS: Final[dict[str, type]] = {
    "lane-keeping-v0": LaneKeepingEnv,
    "racetrack-v0": RacetrackEnv,
    "racetrack-oval-v0": RacetrackEnvOval,
}
"""Classes of highway-env's environments, by their ids."""

ACTION_MEANINGS = ("straight", "right", "left", "slightly right", "slightly left")
STEERING_RAD = np.radians([0.0, -24.0, 24.0, -6.0, 6.0])
"""Angle of the front wheels for each action; left is positive."""
_PARTS = ("steering",), ("full right | full left",)
CONTROLS: Final = {
    "discrete": Controls(*_PARTS, ACTION_MEANINGS, STEERING_RAD[:, np.newaxis]),
    "continuous": Controls(*_PARTS),
}
"""Controls by the argument `actions`. Commands of discrete actions are in radians."""
LOOKAHEADS_M = (5.0, 10.0, 20.0, 40.0)
SEEN_AHEAD_M = 50.0
OBSERVATION_NAMES = (
    "offset",
    "heading_error",
    "speed",
    "lateral_speed",
    "yaw_rate",
    *(f"{axis}_{ahead:.0f}m" for ahead in LOOKAHEADS_M for axis in ("forward", "left")),
    "other_forward",
    "other_left",
)
OBSERVATION_LIMIT = 4.0
TRAIL_LENGTH = 40
_VIEW: Final = {"distance_m": 22.0, "tilt_deg": 73.0, "speed_m_s": 15.0}
_PANEL_RATIO, _MARGIN = 2.0, 1.1
"""Width of the panel with the view from above, relative to its height, and size of the view,
relative to that of the road."""
# The observation of highway-env is not used; an empty one saves time.
_NO_OBSERVATION = {"type": "AttributesObservation", "attributes": []}


class HighwayLaneEnv(RenderedEnv[FollowView]):
    """Lane keeping on a road of highway-env.

    ## Description

    The agent steers a car whose speed is fixed. Roads, cars and rewards are those of highway-env.
    In `lane-keeping-v0`, a car with tire slip follows a road of 480 m that is first straight and
    then winding. The two closed racetracks have several lanes and a slower car. Edouard Leurent,
    "An environment for autonomous driving decision-making",
    https://github.com/Farama-Foundation/HighwayEnv, 2018.

    A decision lasts 0.1 s of simulated time, or 0.2 s on racetracks. Results are bit-identical for
    the same seed and actions. Axes are right-handed with z up; x and y are in meters. y and angles
    have the opposite sign from highway-env, so left is positive.

    ## Action Space

    `actions="discrete"`: `Discrete(5)`, the angle of the front wheels.

    | Action | Meaning | Steering |
    |---|---|---|
    | 0 | straight | 0 |
    | 1 | right | 24 degrees to the right |
    | 2 | left | 24 degrees to the left |
    | 3 | slightly right | 6 degrees to the right |
    | 4 | slightly left | 6 degrees to the left |

    `actions="continuous"`, which is the default of `mcaprl/HighwayLaneContinuous-v0`: `Box(-1, 1)`
    of 1 float32, the steering angle as a fraction of highway-env's maximum, left positive. The
    maximum is 60 degrees in `lane-keeping-v0` and 45 degrees on racetracks.

    ## Observation Space

    `observation="state"`: `Box(-4, 4)` of 15 float32; values are clipped to these bounds.

    | Index | Observation | Unit |
    |---|---|---|
    | 0 | distance from the middle of the lane, left positive | half the lane's width |
    | 1 | heading error, left positive | pi / 2 rad |
    | 2 | speed | 10 m/s |
    | 3 | lateral speed of a car with tire slip, left positive | 5 m/s |
    | 4 | yaw rate of a car with tire slip, left positive | 2 rad/s |
    | 5, 6 | the lane's middle 5 m ahead: forward, left of the car | 5 m |
    | 7, 8 | 10 m ahead | 10 m |
    | 9, 10 | 20 m ahead | 20 m |
    | 11, 12 | 40 m ahead | 40 m |
    | 13, 14 | nearest other car within 50 m: forward, left; (1, 0) if there is none | 50 m |

    ## Rewards

    The rewards are those of highway-env; d is the distance from the middle of the lane. Lane
    keeping: 1 - (d / 10 m)^2, where d refers to the lane to follow. Racetracks: 1 / (1 + 4 d^2),
    minus 0.3 for full steering, scaled to the range 0 to 1. Off a racetrack, the reward is 0.

    ## Starting State

    `start="line"`: the starting state of highway-env, which is constant in lane keeping.
    `start="anywhere"`: a random position on the road with an offset of up to 1.5 m and 0.2 rad. The
    position is at least 20 m from other cars, and 60 m from the end of an open road.
    `reset(options={"pose": (x_m, y_m, yaw_rad)})` starts at that pose; the speed in m/s may follow
    as a fourth number.

    ## Episode End

    Terminated with `info["reason"]` = `off_lane` (the car's center is on no lane), `collision`, or
    `finished` (5 m before the end of an open road). Truncated after 700 steps. Racetracks are also
    truncated, with the reason `time_limit`, after highway-env's limit of 300 s.

    `info` contains lateral_offset_m, heading_error_rad, speed_m_s and progress_m (distance along
    the road since the start; on a racetrack along its first lane, over all laps).

    In highway-env itself, lane keeping never terminates, is truncated after 200 steps or 166 m, and
    has noisy observations.

    ## Arguments

    - `road`: `"lane-keeping-v0"`, `"racetrack-v0"` or `"racetrack-oval-v0"`.
    - `rules`: `"default"`.
    - `observation`: `"state"`.
    - `start`: `"anywhere"` or `"line"`.
    - `actions`: `"discrete"` or `"continuous"`.
    - `render_mode`: None, `"human"` or `"rgb_array"`.

    ## Version History

    - v0: first version.
    """

    metadata = METADATA
    success_reasons: ClassVar[tuple[str, ...]] = ("finished", "time_limit")
    observation_names = OBSERVATION_NAMES

    def __init__(
        self,
        road: str = "lane-keeping-v0",
        rules: str = "default",
        observation: str = "state",
        start: str = "anywhere",
        render_mode: RenderMode | None = None,
        actions: str = "discrete",
    ) -> None:
        """Make the environment; see "Arguments" of the class."""
        check_name("road", road, tuple(ROADS))
        check_name("rules", rules, ("default",))
        check_name("observation", observation, ("state",))
        check_name("start", start, ("anywhere", "line"))
        check_actions(actions, KINDS, rules)
        super().__init__(render_mode)
        self._inner: Any = ROADS[road](config={"observation": _NO_OBSERVATION})
        frequency_hz = self._inner.config["policy_frequency"]
        self.step_duration_s = 1.0 / frequency_hz
        self.metadata = {**METADATA, "render_fps": frequency_hz}
        self.courses = courses_of(self._inner.road.network)
        self.view_settings = {**_VIEW, **_view_from_above(self.courses)}
        self.steering_range_rad = float(self._inner.action_type.steering_range[1])
        self.controls = controls = CONTROLS[actions]
        self.action_space, self.action_meanings = controls.space, controls.meanings
        self.action_part_names, self.action_units = controls.parts
        self.observation_space = spaces.Box(
            -OBSERVATION_LIMIT, OBSERVATION_LIMIT, (len(OBSERVATION_NAMES),), np.float32
        )
        self._start = start
        self._progress_m = 0.0
        self._steering_rad = 0.0
        self._reward = 0.0
        self._trail_m: deque[tuple[float, float]] = deque(maxlen=TRAIL_LENGTH)
        # State of the car before the last step.
        self._before: Car | None = None
        self._locate()

    @property
    def car(self) -> Car:
        """Car that the agent drives."""
        return self._car

    @property
    def others(self) -> tuple[Car, ...]:
        """Other cars."""
        own = self._inner.vehicle
        return tuple(_car_of(each) for each in self._inner.road.vehicles if each is not own)

    @property
    def course(self) -> Course:
        """Center line of the car's lane."""
        return self.courses[self._lane]

    @property
    def place(self) -> Place:
        """Point of the lane that is nearest to the car."""
        return self._place

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; see "Starting State"."""
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**31))
        self._inner.reset(seed=seed)
        # The inner environment keeps all states in this list, which would grow without limit.
        getattr(self._inner, "trajectory", []).clear()
        self._locate()
        car, others = self._car, self.others
        if options:
            self._put(pose_from_options(options, self.courses, others, car))
        elif self._start == "anywhere":
            self._put(drawn_pose(self.np_random, self.courses, others, car.speed_m_s))
        self._progress_m, self._steering_rad, self._reward = 0.0, 0.0, 0.0
        self._trail_m.clear()
        self._before = None
        return self._observe(), self._info()

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Advance the car by one decision."""
        (steering,) = self.controls.read(action)
        is_share = self.controls.commands is None
        self._steering_rad = steering * self.steering_range_rad if is_share else steering
        # highway-env's angles are clockwise.
        share = -self._steering_rad / self.steering_range_rad
        _, reward, _, is_over, _ = self._inner.step(np.array([share]))
        self._before, before_m = self._car, self._along_m
        self._locate()
        self._progress_m += self._moved_m(before_m)
        self._reward = float(reward)
        reason = self._reason()
        info = self._info()
        if reason or is_over:
            info["reason"] = reason or "time_limit"
        return self._observe(), self._reward, bool(reason), bool(is_over and not reason), info

    def _reason(self) -> str:
        """Return the reason why the episode terminates; empty if it continues."""
        if self._inner.vehicle.crashed:
            return "collision"
        if abs(self._place.offset_m) > self.course.half_width_m:
            return "off_lane"
        left_m = self.course.length_m - self._place.along_m
        return "finished" if not self.course.is_closed and left_m < LOOKAHEADS_M[0] else ""

    def _locate(self) -> None:
        """Read the inner environment's car; find the nearest course and the position on it."""
        self._car = _car_of(self._inner.vehicle)
        places = [course.nearest(self._car.x_m, self._car.y_m) for course in self.courses]
        self._lane = int(np.argmin([abs(place.offset_m) for place in places]))
        self._place, self._along_m = places[self._lane], places[0].along_m

    def _moved_m(self, before_m: float) -> float:
        """Return how far, in meters, the car moved along the first lane since `before_m`."""
        moved_m, length_m = self._along_m - before_m, self.courses[0].length_m
        if self.courses[0].is_closed:
            moved_m = (moved_m + length_m / 2) % length_m - length_m / 2
        return moved_m

    def _put(self, pose: Pose) -> None:
        """Move the car of the inner environment to a pose."""
        vehicle = self._inner.vehicle
        vehicle.position = np.array([pose.x_m, pose.y_m]) * FLIP
        vehicle.heading, vehicle.speed = -pose.yaw_rad, pose.speed_m_s
        vehicle.on_state_update()
        self._locate()

    def _observe(self) -> NDArray[np.float32]:
        """Append the position to the trail, render in mode `human`, and return the observation."""
        self._trail_m.append((self._car.x_m, self._car.y_m))
        if self.render_mode == "human":
            self.render()
        vehicle = self._inner.vehicle
        seen = [
            self._place.offset_m / self.course.half_width_m,
            self._heading_error_rad() / (math.pi / 2),
            self._car.speed_m_s / 10.0,
            -float(getattr(vehicle, "lateral_speed", 0.0)) / 5.0,
            -float(getattr(vehicle, "yaw_rate", 0.0)) / 2.0,
        ]
        for ahead_m in LOOKAHEADS_M:
            forward_m, left_m = self._car.to_body_frame(
                self.course.point(self._place.along_m + ahead_m)
            )
            seen += [forward_m / ahead_m, left_m / ahead_m]
        near = [self._car.to_body_frame((car.x_m, car.y_m)) for car in self.others]
        nearest = min(near, key=lambda at: math.hypot(*at), default=(math.inf, 0.0))
        is_near = math.hypot(*nearest) < SEEN_AHEAD_M
        seen += [part / SEEN_AHEAD_M for part in nearest] if is_near else [1.0, 0.0]
        clipped = np.clip(seen, -OBSERVATION_LIMIT, OBSERVATION_LIMIT)
        return clipped.astype(np.float32)

    def _heading_error_rad(self) -> float:
        return (self._car.yaw_rad - self._place.yaw_rad + math.pi) % (2 * math.pi) - math.pi

    def _info(self) -> dict[str, Any]:
        return {
            "lateral_offset_m": self._place.offset_m,
            "heading_error_rad": self._heading_error_rad(),
            "speed_m_s": self._car.speed_m_s,
            "progress_m": self._progress_m,
        }

    def telemetry(self) -> dict[str, float]:
        """Return the state of the car as named numbers; each name ends in its unit."""
        place = {"x_m": self._car.x_m, "y_m": self._car.y_m, "yaw_rad": self._car.yaw_rad}
        return {**place, **self._info(), "steering_rad": self._steering_rad}

    def static_scene(self) -> Sequence[Shape]:
        """Return the shapes that never change; the car's shapes are in the frame `car`."""
        return highway_scene.static_shapes(self._inner.road.network, self.courses)

    def scene(self) -> Sequence[Shape]:
        """Return the shapes that change with each step."""
        aims_m = [self.course.point(self._place.along_m + ahead) for ahead in LOOKAHEADS_M]
        return highway_scene.moving_shapes(
            self._car, self.others, self._trail_m, aims_m, self._steering_rad
        )

    def static_frames(self) -> Sequence[Frame]:
        """Return an empty tuple, because the car has no sensors."""
        return ()

    def frames(self) -> Sequence[Frame]:
        """Return the car's frame in the map."""
        return (car_frame(*self._car.pose),)

    def motion(self) -> list[tuple[float, Sequence[Frame]]]:
        """Return the car's frames within the last step, on an arc from its first to its last pose.

        Each element consists of the seconds before the end of the step, and the frames at that
        time. Elements are in order of time, at most 0.05 s apart. After `reset`, the list is empty.
        """
        if self._before is None:
            return []
        moments = car_moments(self._before.pose, self._car.pose, self.step_duration_s)
        return before_end(moments, self.step_duration_s)

    def _open_view(self, render_mode: RenderMode) -> FollowView:
        frames_per_s = self.metadata["render_fps"]
        return FollowView(render_mode, "highway-lane", self.static_scene(), VIEW_M, frames_per_s)

    def _draw(self, view: FollowView) -> NDArray[np.uint8]:
        car, offset_m = self._car, self._place.offset_m
        text = f"{car.speed_m_s:4.1f} m/s   offset {offset_m:+.2f} m   reward {self._reward:+.2f}"
        view.draw(self.scene(), Body("car", car.x_m, car.y_m, car.yaw_rad), text)
        return view.show()


def _car_of(vehicle: Any) -> Car:
    x_m, y_m = (vehicle.position * FLIP).tolist()
    return Car(
        x_m=x_m,
        y_m=y_m,
        yaw_rad=-float(vehicle.heading),
        speed_m_s=float(vehicle.speed),
        length_m=vehicle.LENGTH,
        width_m=vehicle.WIDTH,
    )


def _view_from_above(courses: Sequence[Course]) -> dict[str, float]:
    """Return height and center of a view from above that shows the whole road, meters."""
    points_m = np.concatenate([course.points_m for course in courses])
    low_m, high_m = points_m.min(axis=0), points_m.max(axis=0)
    width_m, height_m = high_m - low_m
    x_m, y_m = (low_m + high_m) / 2
    return {
        "world_m": round(_MARGIN * max(height_m, width_m / _PANEL_RATIO)),
        "world_x_m": round(x_m),
        "world_y_m": round(y_m),
    }


FASTEST_M_S = 15.0
FREE_M = 20.0  # Minimum distance of random starts from other cars
LAST_START_M = 60.0  # Minimum distance of random starts from the end of a road


def drawn_pose(
    random: np.random.Generator, courses: Sequence[Course], others: Sequence[Car], speed_m_s: float
) -> Pose:
    """Draw a pose away from other cars, up to 1.5 m and 0.2 rad off the middle of a lane."""
    course = courses[int(random.integers(len(courses)))]
    last_m = course.length_m - (0.0 if course.is_closed else LAST_START_M)
    while True:
        along_m = random.uniform(0.0, last_m)
        offset_m, error_rad = random.uniform(-1.5, 1.5), random.uniform(-0.2, 0.2)
        x_m, y_m = course.point(along_m)
        yaw_rad = course.nearest(x_m, y_m).yaw_rad
        x_m -= offset_m * math.sin(yaw_rad)
        y_m += offset_m * math.cos(yaw_rad)
        if _is_free(x_m, y_m, others, FREE_M):
            return Pose(x_m, y_m, yaw_rad + error_rad, speed_m_s)


def pose_from_options(
    options: dict[str, Any], courses: Sequence[Course], others: Sequence[Car], own: Car
) -> Pose:
    """Return the pose from the options of `reset`. The default speed is the car's current speed."""
    pose = pose_from(options, 0.0, FASTEST_M_S)
    if len(options["pose"]) < len(Pose._fields):
        pose = pose._replace(speed_m_s=own.speed_m_s)
    offset_m = min(abs(course.nearest(pose.x_m, pose.y_m).offset_m) for course in courses)
    half_width_m = courses[0].half_width_m
    if offset_m > half_width_m:
        raise UsageError(
            f"pose ({pose.x_m}, {pose.y_m}) is {offset_m:.1f} m from the middle of a lane:"
            f" the lane's edge is at {half_width_m} m"
        )
    if not _is_free(pose.x_m, pose.y_m, others, own.length_m):
        raise UsageError(f"pose ({pose.x_m}, {pose.y_m}) is occupied by another car")
    return pose


def _is_free(x_m: float, y_m: float, others: Sequence[Car], clear_m: float) -> bool:
    return all(math.hypot(x_m - car.x_m, y_m - car.y_m) > clear_m for car in others)


PURSUIT_M, CONTINUOUS_PURSUIT_M = 10.0, 4.0
"""Lookahead distance along the lane for discrete and continuous actions."""
ROOM_M = 30.0
"""Free distance ahead below which the pilot changes to the lane with the most free distance."""
BESIDE_M = 9.0  # A car that follows at less than this distance also blocks its lane


class HighwayPilot(ScriptedPilot[HighwayLaneEnv]):
    """Scripted driver of the highway-lane sim's car."""

    def choose(self) -> int | list[float]:
        """Choose the action for the car's state by pure pursuit; see `mcaprl.sims.lane.pilot`."""
        car, course = self.sim.car, self._free_course()
        is_continuous = self.sim.controls.commands is None
        pursuit_m = CONTINUOUS_PURSUIT_M if is_continuous else PURSUIT_M
        along_m = course.nearest(car.x_m, car.y_m).along_m
        forward_m, left_m = car.to_body_frame(course.point(along_m + pursuit_m))
        # In highway-env, the wheelbase equals the car's length.
        slip_sine = car.length_m * left_m / (forward_m**2 + left_m**2)
        wanted_rad = math.atan(2.0 * math.tan(math.asin(min(max(slip_sine, -1.0), 1.0))))
        if is_continuous:
            return [min(max(wanted_rad / self.sim.steering_range_rad, -1.0), 1.0)]
        return int(np.argmin(np.abs(STEERING_RAD - wanted_rad)))

    def _free_course(self) -> Course:
        """Return the current lane if it is free for 30 m, else the lane with the most space."""
        own = self.sim.course
        if self._room_m(own) >= ROOM_M:
            return own
        return max(self.sim.courses, key=self._room_m)

    def _room_m(self, course: Course) -> float:
        """Return the distance along a lane to the next car on it."""
        car = self.sim.car
        here_m = course.nearest(car.x_m, car.y_m).along_m
        room_m = math.inf
        for other in self.sim.others:
            place = course.nearest(other.x_m, other.y_m)
            ahead_m = place.along_m - here_m
            if course.is_closed:
                ahead_m = (ahead_m + BESIDE_M) % course.length_m - BESIDE_M
            if abs(place.offset_m) < course.half_width_m and ahead_m > -BESIDE_M:
                room_m = min(room_m, ahead_m)
        return room_m
