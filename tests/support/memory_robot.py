"""A robot in memory: a transport, a policy and a mapping for tests of the loop that drives."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from mcaprl import Driver
from mcaprl.base_policy import BasePolicy
from mcaprl.drive.transports import Receive, Wire
from tests.support.bags import START_NS, STORE2, messages

MAPPING: dict[str, Any] = {
    "clock": {"topic": "/joints"},
    "observation": {
        "speed": {"field": "/odom.twist.twist.linear.x", "tolerance_s": 0.3},
        "knee": {"field": "/joints.position[0:2]"},
    },
    "action": {
        "fields": ["/cmd_vel.linear.x", "/cmd_vel.angular.z"],
        "box": {"low": -1, "high": 1},
    },
}
TURN = 0.5


class Cruise(BasePolicy):
    """Policy that turns by .5; `delay_s` is the time that it thinks."""

    name = "cruise"
    action_space = spaces.Box(-1, 1, (2,), np.float32)
    delay_s = 0.0

    def act(self, observations: Any) -> Any:
        """Return the same action for each observation."""
        time.sleep(self.delay_s)
        is_dict = isinstance(observations, dict)
        count = len(next(iter(observations.values())) if is_dict else observations)
        return np.tile(np.array([1.0, TURN], np.float32), (count, 1))


def driver(bag: Path, policy: BasePolicy | None = None, **changes: Any) -> Driver:
    """Return a driver of the robot of `bags.write_rosbag2`."""
    return Driver(policy or Cruise(), mapping={**MAPPING, **changes}, bag=bag)


@lru_cache
def _encoded() -> list[tuple[str, int, bytes]]:
    return [
        (topic, time_ns, bytes(STORE2.serialize_cdr(message, message.__msgtype__)))
        for topic, time_ns, message in messages(STORE2)
    ]


class MemoryTransport:
    """Transport whose messages come from a script, and whose commands are stored."""

    encoding = "cdr"

    def __init__(self, script: Callable[[MemoryTransport], None]) -> None:
        """Store the script, which runs in a thread and ends the drive by an interrupt or error."""
        self._script, self.sent = script, list[tuple[str, Any]]()
        self.is_closed, self.problem = False, ""

    def open(
        self, inputs: Mapping[str, Wire], outputs: Mapping[str, Wire], receive: Receive
    ) -> None:
        """Start the script."""
        self.inputs, self._outputs, self.receive = inputs, outputs, receive
        _encoded()
        threading.Thread(target=self._script, args=(self,), daemon=True).start()

    def send(self, step: int, *topics: str) -> None:
        """Send the messages of a step of the bag, now."""
        start_ns = START_NS + step * 100_000_000
        for topic, time_ns, data in _encoded():
            if topic in topics and start_ns <= time_ns < start_ns + 100_000_000:
                self.receive(topic, data, self.now_ns())

    def publish(self, topic: str, data: bytes) -> None:
        """Store a command."""
        self.sent.append((topic, self._outputs[topic].decode(data)))

    @property
    def turns(self) -> list[float]:
        """Angular velocity of each command."""
        return [message.angular.z for _, message in self.sent]

    def check(self) -> None:
        """Raise the problem that the script found."""
        from mcaprl.errors import UsageError

        if self.problem:
            raise UsageError(self.problem)

    def now_ns(self) -> int:
        """Return the time."""
        return time.time_ns()

    def close(self) -> None:
        """Remember that the transport is closed."""
        self.is_closed = True
