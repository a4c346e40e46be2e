"""A robot that knows nothing of policies: a car or a drone, seen as topics of DDS.

    python robot.py lane continuous --pilot --bag bag     its pilot drives; a ROS 2 bag is written
    python robot.py lane continuous --bag drive           whoever publishes /cmd_vel drives

/odom       nav_msgs/Odometry: pose in the map, and velocity
/scan       sensor_msgs/LaserScan of the car: 7 rays, from 30 degrees right to 30 degrees left
/depth      sensor_msgs/Image of the drone: depth in millimeters, at every tenth step
/score      std_msgs/Float32: sum of the rewards in this episode
/status     std_msgs/UInt8: 0 waits, 1 drives, 2 crashed, 3 arrived or ran out of time
/track      std_msgs/Float32MultiArray: where lane or power line are; the last message of a step
/cmd_vel    geometry_msgs/Twist, subscribed. Car: linear.x is the pedal and angular.z the steering,
            -1 to 1, or the speed and the steering of a button. Drone: velocity in m/s, or for the
            buttons, its change while angular.z is 1. Without a command for 0.5 s, it brakes.

Only the physics are those of the sims of mcaprl. A step of the sim takes `--period` seconds.
"""

from __future__ import annotations

import argparse
import math
import os
import random
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import messages as m
import numpy as np
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import mcaprl
from mcaprl.sims import make_pilot

LOOPBACK = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>60</MaxAutoParticipantIndex><Peers><Peer Address="127.0.0.1"/></Peers>
</Discovery></Domain></CycloneDDS>"""
TOPICS = {
    "/odom": m.Odometry, "/scan": m.LaserScan, "/depth": m.Image, "/score": m.Float32,
    "/status": m.UInt8, "/track": m.Float32MultiArray, "/cmd_vel": m.Twist,
}  # fmt: skip
WAITS, DRIVES, CRASHED, DONE = range(4)
# Twist of each action: linear.x, y and z, and angular.z.
BUTTONS = {
    "lane": [(0, 0, 0, 0), *((30, 0, 0, turn) for turn in (0, -0.5, 0.5, -0.25, 0.25))],
    "powerline": [
        (0.5, 0, 0, 1), (0, -0.5, 0, 1), (0, 0, -0.5, 1), (-0.5, 0, 0, 1), (0, 0.5, 0, 1),
        (0, 0, 0.5, 1), (0, 0, 0, 1),
    ],
}  # fmt: skip
# Units of a continuous action: the car's pedal and steering; the drone's m/s, with y left and z up.
UNITS = {"lane": [(0, 1.0), (3, 1.0)], "powerline": [(0, 8.0), (1, -8.0), (2, -8.0)]}
BRAKES = {"lane": (0, [-1.0, 0.0]), "powerline": (6, [0.0, 0.0, 0.0])}
RAYS = [6, 4, 2, 0, 1, 3, 5]
PATIENCE_S = 0.5
STORE = get_typestore(Stores.ROS2_HUMBLE)


class Robot:
    """The body of the robot."""

    def __init__(self, sim: str, actions: str) -> None:
        """Build the car (`lane`) or the drone (`powerline`)."""
        self.sim, self.is_discrete = sim, actions == "discrete"
        self.env = mcaprl.make_sim(sim, actions=actions)
        self.pilot = make_pilot(self.env)
        self.scanner = None
        if sim == "lane":
            self.scanner = mcaprl.make_sim(sim, actions=actions, observation="rays")
        self.score, self.step, self.status = 0.0, 0, WAITS

    def begin(self, seed: int) -> None:
        """Put the robot at the start of an episode."""
        self.seen, _ = self.env.reset(seed=seed)
        if self.scanner is not None:
            self.rays, _ = self.scanner.reset(seed=seed)
        self.score, self.step, self.status = 0.0, 0, DRIVES

    def act(self, action: Any, limit: int) -> None:
        """Move for one step."""
        self.seen, reward, crashed, over, info = self.env.step(action)
        if self.scanner is not None:
            self.rays, *_ = self.scanner.step(action)
        self.score, self.step = self.score + float(reward), self.step + 1
        arrived = info.get("reason") == "finished"
        if crashed or over or self.step >= limit:
            self.status = CRASHED if crashed and not arrived else DONE

    def twist(self, action: Any) -> tuple[float, ...]:
        """Return the Twist of an action: linear.x, y, z and angular.z."""
        if self.is_discrete:
            return BUTTONS[self.sim][int(action)]
        found = [0.0] * 4
        for (where, unit), value in zip(UNITS[self.sim], action.tolist(), strict=True):
            found[where] = unit * value
        return tuple(found)

    def action(self, twist: tuple[float, ...] | None) -> Any:
        """Return the action of a Twist; brake without one, or if the drone's buttons are up."""
        button, stick = BRAKES[self.sim]
        if not self.is_discrete:
            values = stick if twist is None else [twist[at] / unit for at, unit in UNITS[self.sim]]
            return np.clip(np.array(values, np.float32), -1, 1)
        if twist is None or (self.sim == "powerline" and not twist[3]):
            return button
        return int(np.argmin([math.dist(twist, each) for each in BUTTONS[self.sim]]))

    def sense(self, stamp_ns: int) -> Iterator[tuple[str, Any]]:
        """Yield what the sensors of a step publish; the clock of the policies is the last."""
        header = m.Header(m.Time(stamp_ns // 10**9, stamp_ns % 10**9), "base")
        where, seen = self.env.unwrapped.telemetry(), [float(each) for each in self.seen]
        yaw = where.get("yaw_rad", 0.0)
        odometry = m.Odometry(header, "base")
        odometry.pose.pose.position = m.Point(where["x_m"], where["y_m"], where.get("z_m", 0.0))
        odometry.pose.pose.orientation = m.Quaternion(0, 0, math.sin(yaw / 2), math.cos(yaw / 2))
        if self.scanner is not None:
            odometry.twist.twist.linear.x, track = where["speed_m_s"], seen[:2] + seen[3:]
            ranges = [101.0 ** float(self.rays[ray]) - 1.0 for ray in RAYS]
            step = math.radians(10)
            yield "/scan", m.LaserScan(header, -3 * step, 3 * step, step, 0, 0, 0, 100, ranges)
        else:
            north, east, down = (5 * each for each in seen[3:6])
            odometry.twist.twist.linear = m.Vector3(north, -east, -down)
            track = seen[:3] + seen[6:]
            if self.step % 10 == 0:
                depth = np.minimum(self.env.unwrapped.depth_image_m() * 1000, 65535).astype("<u2")
                data = list(depth.tobytes())
                yield "/depth", m.Image(header, *depth.shape, "16UC1", 0, 2 * depth.shape[1], data)
        yield "/odom", odometry
        yield "/score", m.Float32(self.score)
        yield "/status", m.UInt8(self.status)
        yield "/track", m.Float32MultiArray(data=track)


class Bus:
    """The robot's clock, its end of DDS on this machine alone, and its recorder."""

    def __init__(self, given: argparse.Namespace) -> None:
        """Open the bag, and join the domain unless its pilot drives."""
        self._given, self._chance = given, random.Random(given.seed)
        self._cycle, self._period_ns = 0, round(given.period * 1e9)
        self._held, self._held_ns, self.is_live = None, 0, not given.pilot
        self._start_ns = self._at_ns = time.time_ns() if self.is_live else 1_700_000_000 * 10**9
        self._bag = given.bag and Writer(given.bag, version=9, storage_plugin=StoragePlugin.MCAP)
        if self._bag:
            self._bag.open()
            self._connections = {
                topic: self._bag.add_connection(topic, ros_name(kind), typestore=STORE)
                for topic, kind in TOPICS.items()
            }
        if self.is_live:
            self._domain = Domain(given.domain, LOOPBACK)
            part = self._part = DomainParticipant(given.domain)
            sensors = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(5))
            self._writers = {
                topic: DataWriter(part, Topic(part, f"rt{topic}", kind), qos=sensors)
                for topic, kind in TOPICS.items()
                if topic != "/cmd_vel"
            }
            commands = Qos(Policy.Reliability.Reliable(10**8), Policy.History.KeepLast(10))
            self._reader = DataReader(part, Topic(part, "rt/cmd_vel", m.Twist), qos=commands)

    @property
    def is_driven(self) -> bool:
        """Whether anybody may command the robot."""
        return not self.is_live or bool(self._reader.get_matched_publications())

    def send(self, robot: Robot) -> None:
        """Begin a step: publish what the sensors see, late by the jitter, and lose some of it."""
        given, self._at_ns = self._given, self._start_ns + self._cycle * self._period_ns
        if self.is_live and (late_ns := time.time_ns() - self._at_ns) > self._period_ns:
            self._start_ns, self._at_ns = self._start_ns + late_ns, self._at_ns + late_ns
        self._cycle += 1
        for topic, message in robot.sense(self._at_ns):
            self._at_ns += round(self._chance.uniform(0, given.jitter) * 1e9)
            lost = self._chance.random() < given.drop and topic in ("/odom", "/scan", "/depth")
            if lost or (topic == given.dies and self._cycle > given.after):
                continue
            if self.is_live:
                time.sleep(max(0.0, (self._at_ns - time.time_ns()) / 1e9))
                self._writers[topic].write(message)
            self._record(topic, message)

    def command(self, twist: tuple[float, ...]) -> None:
        """Record the command of the robot's own pilot, which takes 3 ms."""
        self._at_ns += 3_000_000
        self._record("/cmd_vel", m.Twist(m.Vector3(*twist[:3]), m.Vector3(0, 0, twist[3])))

    def listen(self) -> tuple[float, ...] | None:
        """Wait for the end of the step; return the Twist in force, or None if it is too old."""
        end_ns = self._start_ns + self._cycle * self._period_ns
        while True:
            for found in self._reader.take(10):
                if isinstance(found, m.Twist):
                    linear, self._held_ns = found.linear, time.time_ns()
                    self._held = (linear.x, linear.y, linear.z, found.angular.z)
                    self._record("/cmd_vel", found)
            if time.time_ns() >= end_ns:
                return self._held if time.time_ns() - self._held_ns < PATIENCE_S * 1e9 else None
            time.sleep(0.001)

    def close(self) -> None:
        """Finish the bag."""
        if self._bag:
            self._bag.close()

    def _record(self, topic: str, message: Any) -> None:
        if self._bag:
            at_ns = time.time_ns() if self.is_live else self._at_ns
            self._bag.write(self._connections[topic], at_ns, message.serialize())


def ros_name(kind: Any) -> str:
    """Return the name of a type in ROS."""
    return kind.__idl_typename__.replace("::dds_::", "::").rstrip("_").replace("::", "/")


def drive(robot: Robot, bus: Bus, given: argparse.Namespace) -> list[float]:
    """Drive all episodes, by the pilot or by whoever publishes commands; return the scores."""
    random_, scores = np.random.default_rng(given.seed), []
    robot.begin(given.seed)
    robot.status = WAITS
    patient_until_s = time.monotonic() + given.patience
    while not bus.is_driven:
        if time.monotonic() > patient_until_s:
            sys.exit("nobody commands the robot")
        bus.send(robot)
        bus.listen()
    for episode in range(given.episodes):
        robot.begin(given.seed + episode)
        noise = given.noise * (1 if robot.is_discrete else random_.random())
        bus.send(robot)
        while robot.status == DRIVES:
            if bus.is_live:
                action = robot.action(bus.listen())
            else:
                action = explored(robot, noise, random_)
                bus.command(robot.twist(action))
            robot.act(action, given.limit)
            bus.send(robot)
        if bus.is_live:
            bus.listen()
        scores.append(robot.score)
    return scores


def explored(robot: Robot, noise: float, random_: np.random.Generator) -> Any:
    """Return the pilot's action with noise: Gaussian, or another button with this probability."""
    action = robot.pilot.act(robot.seen[np.newaxis])[0]
    if robot.is_discrete:
        return random_.integers(len(BUTTONS[robot.sim])) if random_.random() < noise else action
    return np.clip(action + random_.normal(0, noise, action.shape), -1, 1).astype(np.float32)


def main() -> None:
    """Read the command line, drive, and compare the scores with those of the pilot."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("sim", choices=BUTTONS)
    parser.add_argument("actions", choices=["discrete", "continuous"])
    parser.add_argument("--pilot", action="store_true", help="the robot's own pilot drives")
    parser.add_argument("--noise", type=float, default=0.0, help="exploration of the pilot")
    parser.add_argument("--bag", type=Path, help="folder of the bag that the robot records")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--limit", type=int, default=400, help="steps of an episode")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--period", type=float, default=0.05, help="seconds of a step")
    parser.add_argument("--jitter", type=float, default=0.001, help="most seconds of delay")
    parser.add_argument("--drop", type=float, default=0.01, help="share of lost measurements")
    parser.add_argument("--dies", help="topic of a sensor that dies")
    parser.add_argument("--after", type=int, default=100, help="step after which it dies")
    parser.add_argument("--patience", type=float, default=60, help="seconds to wait for a driver")
    parser.add_argument("--domain", type=int, default=int(os.environ.get("ROS_DOMAIN_ID", 0)))
    given = parser.parse_args()
    robot, bus = Robot(given.sim, given.actions), Bus(given)
    try:
        scores = drive(robot, bus, given)
    finally:
        bus.close()
    found = np.mean(scores)
    given.pilot, given.noise, given.bag = True, 0.0, None
    best = np.mean(drive(robot, Bus(given), given))
    print(f"return {found:.1f}, its pilot's {best:.1f}: score {found / best:.2f}")


if __name__ == "__main__":
    main()
