"""The loop that drives a robot: messages in, one step after another, commands out.

Messages come in threads of the transport and wait in a bounded queue. The loop pushes them to the
driver, and publishes a command at each step. A second thread publishes the stop command if the loop
does not publish in time, whatever it waits for.
"""

from __future__ import annotations

import gc
import math
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from mcaprl._interrupt import raise_interrupt
from mcaprl.drive.core import LATE
from mcaprl.drive.driver import Driver
from mcaprl.drive.transports import Transport, Wire
from mcaprl.drive.transports.bag import BagTransport, Compared
from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.bags.source import Definition
from mcaprl.recorder.bags.values import value_at

DEADLINE_S = 0.1
"""Longest time from the message of a step to its command, if the mapping has no fixed rate."""
SILENCE_S = 0.5
"""Time without a step, or without a message of the enabling topic, after which the robot stops."""
_QUEUE, _SAMPLES, _REPEATS = 10_000, 10_000, 4
_CHECK_S, _STATUS_S, _PAUSE_S = 0.1, 0.25, 0.01
_NS_PER_S, _NS_PER_MS = 1e9, 1e6


@dataclass(frozen=True)
class TopicStatus:
    """Messages of a topic.

    Attributes:
        name: Name of the topic.
        type_name: Type of its messages.
        count: Number of messages.
        rate_hz: Messages per second, over the whole drive.
        age_s: Age of the last message, seconds; NaN without one.
    """

    name: str
    type_name: str
    count: int
    rate_hz: float
    age_s: float


@dataclass(frozen=True)
class DriveStatus:
    """What a drive did so far.

    Attributes:
        state: `driving`, or why the robot is not driven.
        duration_s: Time since the first message, seconds.
        steps: Number of steps.
        driven: Number of steps at which the policy commanded the robot.
        missed: Number of commands that were late, and replaced by the stop command.
        dropped: Number of messages that came faster than they could be used.
        latency_p50_ms: Median time from the message or the tick of a step to its command,
            milliseconds; NaN without a step.
        latency_p99_ms: 99th percentile.
        topics: Each topic that the policy needs.
        compared: At the end of a bag, its commands beside those of the policy.
    """

    state: str
    duration_s: float
    steps: int
    driven: int
    missed: int
    dropped: int
    latency_p50_ms: float
    latency_p99_ms: float
    topics: tuple[TopicStatus, ...]
    compared: tuple[Compared, ...] = ()


class Enable:
    """Deadman switch: a field of a topic that allows the policy to drive while it is true."""

    def __init__(self, path: str, known: dict[str, Definition]) -> None:
        """Find a topic of a Bool, or a field such as `/joy.buttons[4]`, of `known` definitions."""
        self.topic, _, field = path.partition(".")
        name = "sensor_msgs/msg/Joy" if field.startswith(("buttons", "axes")) else ""
        self.field, name = field or "data", name or "std_msgs/msg/Bool"
        if not self.topic.startswith("/") or (
            self.topic not in known and self.field != "data" and "Joy" not in name
        ):
            raise UsageError(
                f"`enable='{path}'` is neither the topic of a Bool, such as '/enable', nor a button"
                " of a Joy, such as '/joy.buttons[4]'"
            )
        self.definition = known.get(self.topic, Definition(name, "cdr"))
        self._last_ns, self._is_on = -math.inf, False

    def push(self, message: Any, stamp_ns: int) -> None:
        """Use a message of the topic."""
        value = value_at(message, self.field)
        if not isinstance(value, bool | int | float | np.number | np.bool_):
            raise UsageError(f"a message of {self.topic} has no switch {self.field}")
        self._last_ns, self._is_on = stamp_ns, float(value) > 0.5

    def allows(self, now_ns: int) -> bool:
        """Return whether the switch is held; without new messages it is not."""
        return self._is_on and now_ns - self._last_ns <= SILENCE_S * _NS_PER_S


class Loop:
    """A drive of a robot."""

    def __init__(
        self,
        driver: Driver,
        transport: Transport,
        *,
        enable: str | None = None,
        dry_run: bool = False,
        deadline_s: float | None = None,
    ) -> None:
        """Prepare the drive; see `mcaprl.drive_robot`."""
        self._driver, self._transport, self._is_dry = driver, transport, dry_run
        definitions = driver.definitions
        self._enable = None if enable is None else Enable(enable, definitions)
        given = {topic: definitions[topic] for topic in driver.inputs}
        if self._enable is not None:
            given[self._enable.topic] = self._enable.definition
        self._is_live, code = bool(transport.encoding), transport.encoding
        self._inputs = {topic: Wire(topic, each, code) for topic, each in given.items()}
        self._outputs = {topic: Wire(topic, definitions[topic], code) for topic in driver.outputs}
        period_s = math.inf if driver.period_ns is None else driver.period_ns / _NS_PER_S
        self._deadline_s = deadline_s or min(period_s, DEADLINE_S)
        # The stop command is due if nothing was published for this time.
        self._silence_s = (driver.mapping.drive.timeout_s or SILENCE_S) + self._deadline_s
        self._arrived: deque[tuple[str, Any, int]] = deque(maxlen=_QUEUE)
        self._has_arrived = threading.Event()
        self._lock, self._is_over = threading.Lock(), threading.Event()
        self._last: dict[str, int] = {}
        self._counts = dict.fromkeys(given, 0)
        self._dropped = self._steps = self._driven = self._missed = 0
        self._latencies_ms: deque[float] = deque(maxlen=_SAMPLES)
        self._first_ns: int | None = None
        # Time of the last command other than stop; None if the robot was stopped.
        self._moved_ns: int | None = None
        self._repeats = 0
        self._state = "waiting for messages"
        self._given = given
        self._warm_up()

    def run(
        self,
        *,
        duration_s: float | None = None,
        on_status: Callable[[DriveStatus], None] = lambda _: None,
    ) -> DriveStatus:
        """Drive until the time is over, the bag ends, or an error or signal."""
        # Then publish the stop.
        transport = self._transport
        watch = threading.Thread(target=self._watch, daemon=True)
        due_s = checked_s = 0.0
        is_open = False
        # A full garbage collection of what libraries created stops all threads for 0.1 s and more.
        gc.collect()
        gc.freeze()
        try:
            with _signals():
                transport.open(self._inputs, self._outputs, self._receive)
                is_open = True
                ends_s = math.inf if duration_s is None else time.monotonic() + duration_s
                if self._is_live:
                    watch.start()
                for arrived in self._messages():
                    now_s = time.monotonic()
                    try:
                        if arrived is not None:
                            self._take(*arrived)
                        else:
                            self._step_until(transport.now_ns())
                        if now_s >= checked_s:
                            transport.check()
                            checked_s = now_s + _CHECK_S
                    except UsageError as error:
                        # The robot, not the request, is at fault.
                        raise LogError(str(error)) from error
                    if now_s >= due_s:
                        on_status(self.status())
                        due_s = now_s + _STATUS_S
                    if now_s >= ends_s:
                        break
        finally:
            self._is_over.set()
            with suppress(Exception):
                self._stop()
                for _ in range(self._repeats):
                    time.sleep(_PAUSE_S if self._is_live else 0.0)
                    self._publish(self._driver.stop)
            if is_open:
                transport.close()
            self._driver.close()
            gc.unfreeze()
            on_status(self.status())
        return self.status()

    def _warm_up(self) -> None:
        """Use what imports, generates code or allocates memory at its first call."""
        if not self._is_live:
            return
        for wire in (*self._inputs.values(), *self._outputs.values()):
            wire.decode(wire.encode({}))
        space = self._driver.policy.observation_space
        if space is not None:
            self._driver.policy.act(batched(space.sample()))
            self._driver.policy.begin()

    def status(self) -> DriveStatus:
        """Return what the drive did so far."""
        now_ns = self._transport.now_ns()
        first_ns = now_ns if self._first_ns is None else self._first_ns
        duration_s = (now_ns - first_ns) / _NS_PER_S
        latencies = list(self._latencies_ms) or [math.nan]
        p50_ms, p99_ms = np.percentile(latencies, [50, 99]).tolist()
        topics = tuple(
            TopicStatus(
                topic,
                each.type_name,
                self._counts[topic],
                self._counts[topic] / duration_s if duration_s > 0 else math.nan,
                (now_ns - self._last[topic]) / _NS_PER_S if topic in self._last else math.nan,
            )
            for topic, each in self._given.items()
        )
        compared: tuple[Compared, ...] = ()
        if isinstance(self._transport, BagTransport) and self._is_over.is_set():
            compared = tuple(self._transport.compared)
        return DriveStatus(
            self._state, duration_s, self._steps, self._driven, self._missed, self._dropped,
            p50_ms, p99_ms, topics, compared,
        )  # fmt: skip

    def _receive(self, topic: str, data: Any, stamp_ns: int) -> None:
        """Put a message into the queue, in a thread of the transport."""
        if len(self._arrived) == _QUEUE:
            self._dropped += 1
        self._arrived.append((topic, data, stamp_ns))
        self._has_arrived.set()

    def _messages(self) -> Iterator[tuple[str, Any, int] | None]:
        """Yield messages as they come, and None when a step is due or nothing comes."""
        transport = self._transport
        if isinstance(transport, BagTransport):
            yield from transport.messages()
            return
        while True:
            if self._arrived:
                topic, data, stamp_ns = self._arrived.popleft()
                wire = self._inputs[topic]
                is_raw = wire.is_own and topic in self._driver.inputs
                yield topic, data if is_raw else wire.decode(data), stamp_ns
                continue
            self._has_arrived.clear()
            due_ns = self._driver.next_step_ns
            wait_s = _CHECK_S
            if due_ns is not None:
                wait_s = min(wait_s, (due_ns - transport.now_ns()) / _NS_PER_S)
            if self._arrived or wait_s <= 0.0 or not self._has_arrived.wait(wait_s):
                yield None

    def _take(self, topic: str, message: Any, stamp_ns: int) -> None:
        self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        if topic in self._counts:
            self._counts[topic] += 1
            self._last[topic] = stamp_ns
        # A step at a fixed rate sees the messages before it alone.
        self._step_until(stamp_ns)
        if self._enable is not None and topic == self._enable.topic:
            is_raw = isinstance(message, bytes)
            decoded = self._inputs[topic].decode(message) if is_raw else message
            self._enable.push(decoded, stamp_ns)
        if topic in self._driver.inputs:
            self._driver.push(topic, message, stamp_ns)
        if topic == self._driver.clock_topic:
            self._step(stamp_ns)

    def _step_until(self, now_ns: int) -> None:
        while (due_ns := self._driver.next_step_ns) is not None and due_ns < now_ns:
            self._step(due_ns)

    def _step(self, step_ns: int) -> None:
        """Take a step, and publish its command; raise the reason if waiting does not help."""
        allowed = self._enable is None or self._enable.allows(self._transport.now_ns())
        began_s = time.perf_counter()

        def late_s() -> float:
            if not self._is_live:
                return time.perf_counter() - began_s
            return (self._transport.now_ns() - step_ns) / _NS_PER_S

        command = self._driver.command(
            step_ns, enabled=allowed, is_late=lambda: self._is_live and late_s() > self._deadline_s
        )
        self._steps += 1
        self._latencies_ms.append(late_s() * 1e3)
        self._state = command.reason or "driving"
        if command.reason:
            self._missed += command.reason == LATE
            self._stop()
        else:
            self._driven += 1
            with self._lock:
                self._moved_ns = self._transport.now_ns()
                self._publish(command.messages)
        if command.is_fatal:
            raise LogError(command.reason)

    def _stop(self) -> None:
        """Publish the stop command if the robot was moved."""
        # While a person does not enable the policy, other nodes may command the robot.
        with self._lock:
            if self._moved_ns is not None:
                self._moved_ns, self._repeats = None, _REPEATS
                self._publish(self._driver.stop)

    def _publish(self, messages: dict[str, dict[str, Any]]) -> None:
        for topic, message in messages.items() if not self._is_dry else ():
            self._transport.publish(topic, self._outputs[topic].encode(message))

    def _watch(self) -> None:
        """Stop the robot if the loop does not command it in time; runs in a thread."""
        while not self._is_over.wait(self._deadline_s / 4):
            with self._lock:
                moved_ns = self._moved_ns
                if moved_ns is None and self._repeats > 0:
                    # One message may be lost.
                    self._repeats -= 1
                    self._publish(self._driver.stop)
            if moved_ns is None:
                continue
            silent_s = (self._transport.now_ns() - moved_ns) / _NS_PER_S
            if silent_s > self._silence_s:
                self._missed += 1
                self._state = f"no step for {silent_s:.3g} s"
                self._stop()


def batched(observation: Any) -> Any:
    """Return an observation, which may be a dict, as a batch of one."""
    if isinstance(observation, dict):
        return {key: np.asarray(part)[np.newaxis] for key, part in observation.items()}
    return np.asarray(observation)[np.newaxis]


class _signals:
    """Context manager that turns SIGTERM, which ends a program at once, into an exception."""

    def __enter__(self) -> None:
        self._is_set = (
            threading.current_thread() is threading.main_thread()
            and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
        )
        if self._is_set:
            signal.signal(signal.SIGTERM, raise_interrupt)

    def __exit__(self, *_: object) -> None:
        if self._is_set:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
