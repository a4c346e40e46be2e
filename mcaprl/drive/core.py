"""Driving of a robot, step by step: what `Driver` and an exported node have in common.

This module, and what it imports to run, needs nothing but NumPy; see `node`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from copy import deepcopy
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from mcaprl.errors import LogError, PolicyError, UsageError
from mcaprl.recorder.bags.values import ABSENT, Step, steps_of, value_at
from mcaprl.recorder.mapping.align import NS_PER_S
from mcaprl.recorder.mapping.live import EpisodeState, LiveEpisodes, LiveStep, LiveSteps
from mcaprl.recorder.mapping.runs import TIME_LIMIT

LATE = "the command was late"  # Reason of a stop command that replaced a late command


class Command(NamedTuple):
    """What to publish at one step."""

    # Message of each commanded topic, as nested dicts: the stop command if there is a reason.
    messages: dict[str, dict[str, Any]]
    reason: str  # Why the robot has to stop; empty if the policy drives
    is_fatal: bool  # Whether the reason is an error, so that waiting does not help
    time_ns: int
    action: Any = None  # Action of the policy; None if there is a reason
    observation: Any = None  # Observation, as in the training; None if it is not complete
    # Log probability of the action, 0 for a policy that selects the best one of a finite number;
    # NaN if the command was limited, or has no density.
    log_prob: float = math.nan


Message = dict[str, Any]
Values = tuple[float | str, ...]
_LONGEST_S = 1.0  # Longest time for which a command may change at the limit, after a pause


class CommandField(NamedTuple):
    """A field of a command, with `size` elements; its `kind` is that of a number or text."""

    topic: str
    path: str
    names_path: str
    names: list[str]
    is_array: bool
    size: int
    kind: str


class CommandMessages:
    """Messages of actions, within limits."""

    is_finite = False  # Whether there is a table of the commands of all actions

    def __init__(self, fields: list[CommandField], templates: dict[str, Message]) -> None:
        """Store the fields; the caller sets the table, the limits and the stop command."""
        # Message of each topic with zeros.
        self.fields, self.templates, self.topics = fields, templates, tuple(templates)
        self._kinds = [field.kind for field in fields for _ in range(field.size)]
        self._table: list[Values] | None = None
        self._low: Any = None
        self._high: Any = None
        self._most: Any = None
        self._stop: Values = ()

    @classmethod
    def of_plain(cls, found: dict[str, Any]) -> CommandMessages:
        """Return the messages that `Commands.plain` describes."""
        made = cls([CommandField(*field) for field in found["fields"]], found["templates"])
        made._stop = tuple(found["stop"])
        limits = [None if each is None else np.array(each) for each in found["limits"]]
        made._low, made._high, made._most = limits
        if found["table"] is not None:
            made._table = [tuple(each) for each in found["table"]]
        made.is_finite = made._table is not None
        made.reset()
        return made

    @property
    def stop(self) -> dict[str, Message]:
        """Messages of the stop command."""
        return self._built(self._stop, 0)

    def reset(self) -> None:
        """Assume that the robot is stopped."""
        self._last = self._stop
        self._last_ns: int | None = None

    def stopped(self, time_ns: int) -> dict[str, Message]:
        """Return the stop command."""
        self._last, self._last_ns = self._stop, time_ns
        return self._built(self._stop, time_ns)

    def messages(self, action: Any, time_ns: int) -> tuple[dict[str, Message], bool]:
        """Return the messages of an action, and whether they are another action's as well."""
        wanted = self._command_of(action)
        values = self._limited(wanted, time_ns)
        self._last, self._last_ns = values, time_ns
        return self._built(values, time_ns), values != wanted

    def _command_of(self, action: Any) -> Values:
        if self._table is not None:
            return self._table[int(action)]
        return self._rounded(tuple(np.asarray(action, np.float64).ravel().tolist()))

    def _limited(self, command: Values, time_ns: int) -> Values:
        """Return a command within the limits of its values and of their change."""
        if self._low is None and self._high is None and self._most is None:
            return command
        if any(isinstance(each, str) for each in command):
            return command
        values = np.array(command, np.float64)
        low = values if self._low is None else self._low
        high = values if self._high is None else self._high
        values = np.minimum(np.maximum(values, low), high)
        if self._most is not None:
            last = np.array(self._last, np.float64)
            elapsed_s = 0.0 if self._last_ns is None else (time_ns - self._last_ns) / NS_PER_S
            most = self._most * min(elapsed_s, _LONGEST_S)
            values = np.clip(values, last - most, last + most)
        return self._rounded(tuple(values.tolist()))

    def _rounded(self, command: Values) -> Values:
        """Return the values as the fields of the message store them."""
        return tuple(_stored(each, kind) for each, kind in zip(command, self._kinds, strict=True))

    def _built(self, command: Values, time_ns: int) -> dict[str, Message]:
        found = deepcopy(self.templates)
        for message in found.values():
            if isinstance(stamp := message.get("header", {}).get("stamp"), dict):
                stamp["sec"], stamp["nanosec"] = divmod(time_ns, int(NS_PER_S))
        first = 0
        for field in self.fields:
            values = command[first : first + field.size]
            _set_field(found[field.topic], field, [_published(each, field.kind) for each in values])
            first += field.size
        return found


def _set_field(message: Message, field: CommandField, values: list[Any]) -> None:
    steps = list(steps_of(field.path))
    at = next((k for k, step in enumerate(steps) if isinstance(step, slice)), None)
    if field.names:
        _set(message, list(steps_of(field.names_path)), list(field.names))
    if at is None:
        _set(message, steps, values if field.is_array else values[0])
        return
    chosen: Any = steps[at]
    first, step = chosen.start or 0, chosen.step or 1
    for k, value in enumerate(values):
        _set(message, [*steps[:at], first + k * step, *steps[at + 1 :]], value)


def _set(message: Any, steps: list[Step], value: Any) -> None:
    """Set a part of nested dicts and lists, which grow as needed."""
    for step, after in zip(steps, [*steps[1:], None], strict=True):
        if isinstance(step, int):
            message += [{} if isinstance(after, str) else 0 for _ in range(len(message), step + 1)]
        if after is None:
            message[step] = value
        elif isinstance(message, dict):
            message = message.setdefault(step, [] if isinstance(after, int) else {})
        else:
            message = message[step]


def _stored(value: float | str, kind: str) -> float | str:
    if isinstance(value, str) or kind == "string":
        return value
    if kind == "bool":
        return float(value != 0)
    if re.fullmatch(r"u?int\d+", kind):
        limits = np.iinfo(kind)
        return float(min(max(round(value), limits.min), limits.max))
    return float(np.float32(value)) if kind == "float32" else float(value)


def _published(value: float | str, kind: str) -> Any:
    """Return a value as the type of Python that libraries of messages expect."""
    if isinstance(value, str) or kind.startswith(("float", "double")):
        return value
    return bool(value) if kind == "bool" else int(value)


class DriverCore:
    """A policy that drives a robot; see `Driver`."""

    def __init__(
        self, plan: Any, live: LiveSteps, episodes: LiveEpisodes, commands: Any, policy: Any
    ) -> None:
        """Connect the parts."""
        self.policy, self.mapping = policy, plan.mapping
        self._plan, self._live, self._episodes, self._commands = plan, live, episodes, commands
        topics = plan.bag.topics
        self.inputs = {name: topics[name].type_name for name in live.topics}
        self.outputs = {name: topics[name].type_name for name in commands.topics}
        rate_hz, self.clock_topic = plan.mapping.clock.rate_hz, plan.mapping.clock.topic
        self.period_ns = None if rate_hz is None else round(NS_PER_S / rate_hz)
        self.stop = commands.stop
        self.begin()

    def begin(self) -> None:
        """Drop all messages and the episode, and drive on after a terminal state."""
        self._live.reset()
        self._episodes.reset()
        self.policy.begin()
        self._is_over = False
        self._last_ns: int | None = None
        self._commands.reset()

    def push(self, topic: str, message: Any, stamp_ns: int, publish_ns: int | None = None) -> None:
        """Use a message of one of the `inputs`, in the order in which they come.

        Args:
            topic: Name of the topic.
            message: Message of rclpy, rospy, rosbags or protobuf, nested dicts with the same
                fields, or the bytes of a message in the encoding of the bag.
            stamp_ns: Time at which it came, nanoseconds; the log_time of a bag.
            publish_ns: Time at which it was published, for a mapping that uses it.

        Raises:
            UsageError: The topic is not needed, or the message has another type or lacks a field.
        """
        if topic not in self.inputs:
            raise UsageError(f"{topic} is not needed; topics: {', '.join(self.inputs)}")
        self._check_type(topic, message)
        self._live.push(topic, self._decoded(topic, message), stamp_ns, publish_ns)
        self._pushed(topic, message, stamp_ns)

    def _decoded(self, topic: str, message: Any) -> Any:
        """Return a message whose fields can be read."""
        return message

    def _pushed(self, topic: str, message: Any, stamp_ns: int) -> None:
        """Do something with a message that was used."""

    def _commanded(self, step: LiveStep, state: EpisodeState, found: Command, now_ns: int) -> None:
        """Do something with a command."""

    def command(
        self, now_ns: int, *, enabled: bool = True, is_late: Callable[[], bool] = lambda: False
    ) -> Command:
        """Return what to publish at a step.

        For a fixed rate, the step is at `now_ns`, which should be `next_step_ns`; otherwise it is
        at the last message of `clock_topic`.

        Args:
            now_ns: Time in nanoseconds, on the clock of the stamps.
            enabled: Whether the policy may drive; if not, the stop command is returned.
            is_late: Function that is called when the policy has decided; if it returns true, the
                stop command is returned and recorded instead.
        """
        time_ns = now_ns if self.clock_topic is None else self._live.clock_ns
        lack = self._live.lack
        if time_ns is None or (lack and self.clock_topic is not None):
            self.policy.interrupt()
            return self._stopped(now_ns, lack or f"no message of {self.clock_topic} yet")
        step, state = None, None
        try:
            step = self._live.step(time_ns)
            state = self._episodes.see(step, acts=enabled and not self._is_over)
            found = self._driven(step, state, enabled)
            if not found.reason and is_late():
                found = self._stopped(time_ns, LATE, False, found.observation)
        except (UsageError, LogError, PolicyError) as error:
            found = self._stopped(time_ns, str(error), is_fatal=True)
        self._last_ns = time_ns
        if step is not None and state is not None:
            self._commanded(step, state, found, now_ns)
        return found

    @property
    def next_step_ns(self) -> int | None:
        """Time of the next step at a fixed rate, as in a bag; None before the first message."""
        first_ns = self._live.anchor_ns
        rate_hz: float | None = self.mapping.clock.rate_hz
        if first_ns is None or rate_hz is None:
            return None
        period_ns = NS_PER_S / rate_hz
        before_ns = first_ns - 1 if self._last_ns is None else self._last_ns
        k = max(0, math.floor((before_ns - first_ns) / period_ns))
        while first_ns + round(k * period_ns) <= before_ns:
            k += 1
        return first_ns + round(k * period_ns)

    def _driven(self, step: LiveStep, state: EpisodeState, enabled: bool) -> Command:
        if state.began:
            self.policy.begin()
        observation = state.observation
        reason, is_fatal = step.reason, step.is_fatal
        if not reason and (old := self._too_old(step)):
            reason = old
        if not reason and not enabled:
            reason = "the policy is not enabled"
        if not reason:
            reason = self._why_stopped(state)
        if reason:
            # What was predicted before is for steps in which the robot did not stop.
            self.policy.interrupt()
            return self._stopped(step.time_ns, reason, is_fatal, observation)
        assert observation is not None, "a step without a reason is usable"
        batch = (
            {key: part[np.newaxis] for key, part in observation.items()}
            if isinstance(observation, dict)
            else observation[np.newaxis]
        )
        action = self.policy.act(batch)[0]
        if not np.isfinite(action).all():
            reason = "the policy's action is not finite"
            return self._stopped(step.time_ns, reason, True, observation)
        messages, is_changed = self._commands.messages(action, step.time_ns)
        is_sure = self._commands.is_finite and not is_changed
        log_prob = 0.0 if is_sure else math.nan
        return Command(messages, "", False, step.time_ns, action, observation, log_prob)

    def _why_stopped(self, state: EpisodeState) -> str:
        if state.ended is not None and state.ended.terminated and not self.mapping.drive.restart:
            self._is_over = True
        if self._is_over:
            return "the episode ended in a terminal state: start again to drive on"
        if state.is_open or (state.ended is not None and state.ended.reason == TIME_LIMIT):
            return ""
        return "no episode runs: `begin` of the mapping waits, or an end holds"

    def _too_old(self, step: LiveStep) -> str:
        timeout_s = self.mapping.drive.timeout_s
        for name in self._plan.required if timeout_s is not None else ():
            age_s = float(step.quantities[name].age_s[0])
            if timeout_s is not None and age_s > timeout_s:
                topic = self._plan.quantities[name].source.topic
                return f"{name}: the last message of {topic} is {age_s:.3g} s old"
        return ""

    def _stopped(
        self, time_ns: int, reason: str, is_fatal: bool = False, observation: Any = None
    ) -> Command:
        messages = self._commands.stopped(time_ns)
        return Command(messages, reason, is_fatal, time_ns, None, observation)

    def _check_type(self, topic: str, message: Any) -> None:
        wanted, found = self.inputs[topic], type_of(message)
        if found and _plain(found) != _plain(wanted):
            raise UsageError(f"{topic} has messages of {found}, but the mapping needs {wanted}")
        # The bytes of a message, and messages with absent fields, are checked when they are read.
        is_open = self._plan.bag.topics[topic].encoding in ("json", "protobuf")
        if found or is_open or isinstance(message, bytes):
            return
        for name in self._live.fields.get(topic, ()):
            value = value_at(message, name)
            if value is None or value is ABSENT:
                raise UsageError(f"a message of {topic} ({wanted}) has no field {name}")


def type_of(message: Any) -> str:
    """Return the type of a message of rclpy, rospy, rosbags, cyclonedds or protobuf; else ''."""
    for name in ("__msgtype__", "_type", "__idl_typename__"):
        if isinstance(found := getattr(message, name, None), str):
            return found
    if (descriptor := getattr(message, "DESCRIPTOR", None)) is not None:
        return str(getattr(descriptor, "full_name", ""))
    if hasattr(message, "get_fields_and_field_types"):
        own = type(message)
        return f"{own.__module__.split('.')[0]}/msg/{own.__name__}"
    return ""


@lru_cache(maxsize=256)
def _plain(name: str) -> tuple[str, str]:
    """Return package and name of a type, whose form depends on the library."""
    parts = [part for part in name.replace("::", "/").replace(".", "/").split("/") if part]
    return parts[0], parts[-1].rstrip("_")
