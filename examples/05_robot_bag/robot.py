"""Topics that a car with a lane detector publishes while it drives; mcaprl defines none of them.

/odom           nav_msgs/Odometry at 50 Hz: pose and speed
/joint_states   sensor_msgs/JointState at 20 Hz: commanded position of the steering joint
/lane           std_msgs/Float32MultiArray at 4 Hz, a lane detector: offset and heading error from
                the middle of the lane, distance along the route, and four points of the lane ahead
/cmd_vel        geometry_msgs/Twist at 20 Hz: what the controller wants, chosen after each message
                of the lane detector; linear.x is the pedal, from full brake (-1) to full throttle
                (1), and angular.z the steering, from full right (-1) to full left (1)
/e_stop         std_msgs/Bool: true when a safety monitor stops the car
/camera/depth   sensor_msgs/Image at 10 Hz: depth in millimeters
/diagnostics    diagnostic_msgs/DiagnosticArray at 1 Hz

A car with six buttons, instead of a pedal and a steering wheel, publishes the speed in m/s and the
steering of its button; see `BUTTONS`.

A message is a dict with the fields of its type; fields that are left out are zero.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mcaprl.sims import CarCamera

TYPES = {
    "/odom": "nav_msgs/msg/Odometry",
    "/joint_states": "sensor_msgs/msg/JointState",
    "/lane": "std_msgs/msg/Float32MultiArray",
    "/cmd_vel": "geometry_msgs/msg/Twist",
    "/e_stop": "std_msgs/msg/Bool",
    "/camera/depth": "sensor_msgs/msg/Image",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
PAUSE_S = 5.0
"""Time between two drives, in seconds."""
BUTTONS = (
    ("brake", 0.0, 0.0),
    ("straight", 30.0, 0.0),
    ("right", 30.0, -0.5),
    ("left", 30.0, 0.5),
    ("slightly right", 30.0, -0.25),
    ("slightly left", 30.0, 0.25),
)
"""Name, speed in m/s and steering (fraction of the maximum angle, left positive) of each button."""
_STEP_S, _SUBSTEP_S = 0.25, 0.05
_LOOKAHEADS_M = np.repeat([5.0, 10.0, 20.0, 40.0], 2)
_FULL_STEERING_RAD = math.radians(40.0)
_ODOMETRY_S, _COMMAND_S, _IMAGE_S, _DIAGNOSTICS_S = 0.02, 0.05, 0.1, 1.0
_JITTER_S = 0.004
"""Largest delay between a measurement and its recording, in seconds."""
_LANE_DELAY_S = 0.010
_COMMAND_DELAY_S = 0.012
_FAR_MM = 65_535


class Message(NamedTuple):
    """A recorded message.

    Attributes:
        time_s: Time of recording since the start of the drive, seconds.
        topic: Name of a topic in `TYPES`.
        content: Fields of the message.
    """

    time_s: float
    topic: str
    content: dict[str, Any]


class Drive:
    """One drive of the car in the lane sim."""

    def __init__(self, env: gym.Env[Any, Any], seed: int, actions: NDArray[Any]) -> None:
        """Drive the car.

        Args:
            env: Lane sim with its default rules, and the kind of actions.
            seed: Seed of the start.
            actions: Buttons (T,), or pedal and steering (T, 2), of the controller; each lasts
                0.25 s.
        """
        self._random = np.random.default_rng(seed)
        self._wanted = [_wanted(action) for action in actions.tolist()]
        sim: Any = env.unwrapped
        seen, _ = env.reset(seed=seed)
        self._lanes = [_lane(sim.car, seen)]
        self._cars = [sim.car]
        self._stopped = False
        for action in actions:
            self._cars += sim.fleet.substeps(sim.car, sim.fleet.controls.read(action))
            seen, _, self._stopped, _, _ = env.step(action)
            self._lanes.append(_lane(sim.car, seen))

    @property
    def duration_s(self) -> float:
        """Length of the drive, seconds."""
        return len(self._wanted) * _STEP_S

    def messages(self, camera: CarCamera, start_ns: int) -> list[Message]:
        """Return all messages in the order of recording.

        Args:
            camera: Camera at the front of the car.
            start_ns: Start time for the header stamps, nanoseconds.
        """
        parts = (
            self._odometry(start_ns),
            self._joints(start_ns),
            self._lane(),
            self._commands(),
            self._stops(),
            self._images(camera, start_ns),
            self._diagnostics(start_ns),
        )
        return sorted(message for part in parts for message in part)

    def _odometry(self, start_ns: int) -> Iterator[Message]:
        for time_s in self._times(_ODOMETRY_S):
            car = self._car(time_s)
            pose = {
                "position": {"x": car.x_m, "y": car.y_m},
                "orientation": {"z": math.sin(car.yaw_rad / 2), "w": math.cos(car.yaw_rad / 2)},
            }
            yield self._measured(
                time_s,
                "/odom",
                {
                    "header": _header(start_ns, time_s, "odom"),
                    "child_frame_id": "base_link",
                    "pose": {"pose": pose},
                    "twist": {"twist": {"linear": {"x": car.speed_m_s}}},
                },
            )

    def _joints(self, start_ns: int) -> Iterator[Message]:
        for time_s in self._times(_COMMAND_S):
            content = {
                "header": _header(start_ns, time_s, ""),
                "name": ["steering"],
                "position": [self._car(time_s).steering * _FULL_STEERING_RAD],
            }
            yield self._measured(time_s, "/joint_states", content)

    def _lane(self) -> Iterator[Message]:
        for step, data in enumerate(self._lanes):
            yield Message(step * _STEP_S + _LANE_DELAY_S, "/lane", {"data": data})

    def _commands(self) -> Iterator[Message]:
        for step, (forward, turn) in enumerate(self._wanted):
            content = {"linear": {"x": forward}, "angular": {"z": turn}}
            for repeat in range(round(_STEP_S / _COMMAND_S)):
                time_s = step * _STEP_S + repeat * _COMMAND_S + _COMMAND_DELAY_S
                yield Message(time_s, "/cmd_vel", content)

    def _stops(self) -> Iterator[Message]:
        yield Message(0.0, "/e_stop", {"data": False})
        if self._stopped:
            yield Message(self.duration_s, "/e_stop", {"data": True})

    def _images(self, camera: CarCamera, start_ns: int) -> Iterator[Message]:
        for time_s in self._times(_IMAGE_S):
            depth_mm = np.minimum(camera.image_m(self._car(time_s)) * 1000, _FAR_MM)
            pixels = depth_mm.round().astype("<u2")
            content = {
                "header": _header(start_ns, time_s, "camera"),
                "height": pixels.shape[0],
                "width": pixels.shape[1],
                "encoding": "16UC1",
                "step": 2 * pixels.shape[1],
                "data": pixels.tobytes(),
            }
            yield self._measured(time_s, "/camera/depth", content)

    def _diagnostics(self, start_ns: int) -> Iterator[Message]:
        for time_s in self._times(_DIAGNOSTICS_S):
            status = {"name": "drive", "message": "OK", "hardware_id": "car"}
            content = {"header": _header(start_ns, time_s, ""), "status": [status]}
            yield self._measured(time_s, "/diagnostics", content)

    def _times(self, period_s: float) -> list[float]:
        count = math.floor(self.duration_s / period_s + 1e-9)
        return [number * period_s for number in range(count + 1)]

    def _measured(self, time_s: float, topic: str, content: dict[str, Any]) -> Message:
        delay_s = float(self._random.uniform(0.0, _JITTER_S))
        return Message(time_s + delay_s, topic, content)

    def _car(self, time_s: float) -> Any:
        """Return the car at a time, interpolated between two substeps of the sim."""
        number, share = divmod(time_s / _SUBSTEP_S + 1e-9, 1.0)
        low = self._cars[int(number)]
        if share < 1e-6:
            # A measurement at the time of a decision shows the state before the new action.
            return low
        high = self._cars[int(number) + 1]
        turn = math.remainder(high.yaw_rad - low.yaw_rad, 2 * math.pi)
        return high._replace(
            x_m=low.x_m + share * (high.x_m - low.x_m),
            y_m=low.y_m + share * (high.y_m - low.y_m),
            yaw_rad=low.yaw_rad + share * turn,
            speed_m_s=low.speed_m_s + share * (high.speed_m_s - low.speed_m_s),
        )


def _wanted(action: Any) -> tuple[float, float]:
    """Return linear.x and angular.z of the command of an action."""
    return BUTTONS[action][1:] if isinstance(action, int) else (action[0], action[1])


def _lane(car: Any, seen: NDArray[np.float32]) -> list[float]:
    """Return the data of the topic `/lane`, in meters and radians."""
    ahead_m = seen[4:] * _LOOKAHEADS_M
    return [car.offset_m, car.heading_error_rad, car.along_m, *ahead_m.tolist()]


def _header(start_ns: int, time_s: float, frame: str) -> dict[str, Any]:
    stamp_ns = start_ns + round(time_s * 1e9)
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame}
