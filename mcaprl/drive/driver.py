"""Driving of a robot by a trained policy, with the mapping that the policy was trained with.

`Driver` knows no transport: whoever has the messages pushes them, and publishes the commands.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self, cast

import numpy as np
from gymnasium import spaces

from mcaprl.base_policy import BasePolicy
from mcaprl.drive.commands import Commands
from mcaprl.drive.record import DriveLog
from mcaprl.errors import LogError, PolicyError, UsageError
from mcaprl.files import read_json
from mcaprl.recorder.bags.bag import open_bag
from mcaprl.recorder.bags.protobuf import ProtobufDecoder
from mcaprl.recorder.bags.source import Definition
from mcaprl.recorder.bags.values import ABSENT, value_at
from mcaprl.recorder.mapping.align import NS_PER_S
from mcaprl.recorder.mapping.config import Mapping as RobotMapping
from mcaprl.recorder.mapping.config import Place, load_mapping
from mcaprl.recorder.mapping.live import (
    STATE,
    EpisodeState,
    LiveEpisodes,
    LiveStep,
    LiveSteps,
    Topics,
)
from mcaprl.recorder.mapping.plan import Plan
from mcaprl.recorder.mapping.robot import Robot
from mcaprl.recorder.mapping.runs import TIME_LIMIT
from mcaprl.runs import ROBOT_NAME

_STEP_NS = 100_000_000
_LEARNED = ("time", "clock", "observation", "stack", "action")
"""Keys of a mapping that a policy was trained with."""


class Command(NamedTuple):
    """What to publish at one step.

    Attributes:
        messages: Message of each commanded topic, as nested dicts: the stop command if there is a
            reason.
        reason: Why the robot has to stop; empty if the policy drives.
        is_fatal: Whether the reason is an error, so that waiting does not help.
        time_ns: Time of the step.
        action: Action of the policy; None if there is a reason.
        observation: Observation, as in the training; None if it is not complete.
        log_prob: Log probability of the action, 0 for a policy that selects the best one of a
            finite number; NaN if the command was limited, or has no density.
    """

    messages: dict[str, dict[str, Any]]
    reason: str
    is_fatal: bool
    time_ns: int
    action: Any = None
    observation: Any = None
    log_prob: float = math.nan


class Driver:
    """A trained policy that drives a robot, message by message.

    Attributes:
        inputs: Message type of each topic that the policy needs, as in the bag.
        outputs: Message type of each topic that it commands.
        definitions: Definition of the type of each of these topics.
        period_ns: Time between two steps in nanoseconds; None for a step at each message of
            `clock_topic`.
        clock_topic: Topic with one message for each step; None for a fixed rate.
        mapping: Mapping that the policy was trained with.
        policy: Policy that selects the actions.
        stop: Message of each commanded topic that stops the robot.
    """

    def __init__(
        self,
        run: Any,
        *,
        mapping: str | Path | Mapping[str, Any] | None = None,
        bag: str | Path | Sequence[str | Path] | None = None,
        trust_code: bool = False,
    ) -> None:
        """Load the policy, and prepare its inputs and commands.

        Args:
            run: Run folder, or folder of one seed, that was trained from a bag; or a policy.
            mapping: Mapping file that replaces that of the run. It may change what is not learned,
                such as `drive`; None for that of the run. For a policy, this is `Dataset.robot`.
            bag: Bag that has the topics, for a run that does not contain their types.
            trust_code: Whether the mapping may name a Python function.

        Raises:
            PolicyError: The path has no policy, or the policy was trained with another mapping.
            UsageError: The mapping is missing, looks ahead, or has no command to stop the robot.
        """
        self.policy, found = _loaded(run)
        robot, place = _robot_of(run, found, mapping, bag)
        self.mapping = robot.mapping
        self._topics = Topics(robot.topics)
        self._plan = Plan(self._topics, robot.mapping, place, trust_code=trust_code)
        self._live = LiveSteps(self._plan, robot.shapes)
        self._commands = Commands(self._plan, self.policy)
        self._check_fits(robot)
        self._episodes = LiveEpisodes(self._plan, self.policy.frame_stack)
        topics, outputs = self._live.topics, self._commands.topics
        self.inputs = {name: self._topics.topics[name].type_name for name in topics}
        self.outputs = {name: self._topics.topics[name].type_name for name in outputs}
        self.definitions: dict[str, Definition] = {
            name: robot.topics[name] for name in (*self.inputs, *self.outputs)
        }
        rate_hz, self.clock_topic = robot.mapping.clock.rate_hz, robot.mapping.clock.topic
        self.period_ns = None if rate_hz is None else round(NS_PER_S / rate_hz)
        self.stop = self._commands.stop
        self._robot, self._log = robot, cast("DriveLog | None", None)
        self.begin()

    def begin(self) -> None:
        """Drop all messages and the episode, and drive on after a terminal state."""
        self._live.reset()
        self._episodes.reset()
        self.policy.begin()
        self._is_over = False
        self._last_ns: int | None = None
        self._commands.reset()

    def record(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Record from now on: a log of this package, with the robot's topics beside it.

        Args:
            path: MCAP file to write.
            overwrite: Whether an existing file is replaced.

        Raises:
            UsageError: The command that stops the robot is no action of the mapping.
            OutputExistsError: The file exists.
        """
        self.close()
        is_late = self._episodes.is_late
        self._log = DriveLog(
            path,
            self._plan,
            self._robot,
            self.policy,
            self._commands,
            is_late=is_late,
            overwrite=overwrite,
        )

    def close(self) -> None:
        """End the open episode of the log, and finish the log; closing twice is harmless."""
        log, self._log = self._log, None
        if log is not None:
            log.close(self._live.last_ns)

    def __enter__(self) -> Self:
        """Return the driver."""
        return self

    def __exit__(self, *_: object) -> None:
        """Finish the log."""
        self.close()

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
        decoder = self._topics.decoders[topic]
        given = message
        if isinstance(message, bytes):
            try:
                message = decoder.decode(message)
            except LogError as error:
                raise UsageError(f"{topic}: {error}") from error
        self._check_type(topic, message)
        if isinstance(decoder, ProtobufDecoder) and hasattr(message, "DESCRIPTOR"):
            message = decoder.wrapped(message)
        self._live.push(topic, message, stamp_ns, publish_ns)
        if self._log is not None:
            self._log.add(topic, given, stamp_ns)

    def command(self, now_ns: int, *, enabled: bool = True) -> Command:
        """Return what to publish at a step.

        For a fixed rate, the step is at `now_ns`, which should be `next_step_ns`; otherwise it is
        at the last message of `clock_topic`.

        Args:
            now_ns: Time in nanoseconds, on the clock of the stamps.
            enabled: Whether the policy may drive; if not, the stop command is returned.
        """
        time_ns = now_ns if self.clock_topic is None else self._live.clock_ns
        if time_ns is None:
            return self._stopped(now_ns, f"no message of {self.clock_topic} yet")
        step, state = None, None
        try:
            step = self._live.step(time_ns)
            state = self._episodes.see(step, acts=enabled and not self._is_over)
            found = self._driven(step, state, enabled)
        except (UsageError, LogError, PolicyError) as error:
            found = self._stopped(time_ns, str(error), is_fatal=True)
        self._last_ns = time_ns
        if self._log is not None and step is not None and state is not None:
            # A command that is aligned with the steps must not come before its step.
            at_ns = max(now_ns, time_ns + (self.mapping.action.align == "during"))
            for topic, message in found.messages.items():
                self._log.add(topic, message, at_ns)
            behavior = np.exp(found.log_prob)
            self._log.see(step, state, self._commands.action_of(), float(behavior))
        return found

    @property
    def next_step_ns(self) -> int | None:
        """Time of the next step at a fixed rate, as in a bag; None before the first message."""
        first_ns, rate_hz = self._live.anchor_ns, self.mapping.clock.rate_hz
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
        is_finite = isinstance(self.policy.action_space, spaces.Discrete)
        log_prob = 0.0 if is_finite and not is_changed else math.nan
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
            if age_s > cast(float, timeout_s):
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
        if found or self.definitions[topic].encoding in ("json", "protobuf"):
            return
        for name in self._live.fields.get(topic, ()):
            value = value_at(message, name)
            if value is None or value is ABSENT:
                raise UsageError(f"a message of {topic} ({wanted}) has no field {name}")

    def _check_fits(self, robot: Robot) -> None:
        """Check that the policy has the observations of the mapping, as far as they are known."""
        space = self.policy.observation_space
        state = space[STATE] if isinstance(space, spaces.Dict) and STATE in space.spaces else space
        names = [n for n, each in robot.mapping.observation.items() if each.image is None]
        if not isinstance(state, spaces.Box) or not all(name in robot.shapes for name in names):
            return
        count = sum(math.prod(robot.shapes[name]) for name in names) * robot.mapping.stack
        if names and state.shape != (count,):
            raise PolicyError(
                f"{self.policy.name} was trained with another mapping: it observes {state.shape}"
                f" numbers, the mapping has {count}"
            )


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


def _plain(name: str) -> tuple[str, str]:
    """Return package and name of a type, whose form depends on the library."""
    parts = [part for part in name.replace("::", "/").replace(".", "/").split("/") if part]
    return parts[0], parts[-1].rstrip("_")


def _loaded(run: Any) -> tuple[BasePolicy, Path | None]:
    """Return a policy, and its run folder."""
    if isinstance(run, BasePolicy):
        return run, None
    from mcaprl.offline.policy import read_policy
    from mcaprl.runs import policy_files

    folder = Path(run)
    files = policy_files(folder)
    if not files or files[0].suffix != ".json":
        raise PolicyError(f"{folder} has no policy that can drive: pass a run that was trained")
    return read_policy(files[0].parent), folder


def _robot_of(run: Any, folder: Path | None, mapping: Any, bag: Any) -> tuple[Robot, Place]:
    """Return mapping, topics and shapes of a run, or of other files."""
    if isinstance(mapping, Mapping) and "topics" in mapping:
        return Robot.from_json(mapping, "mapping"), Place()
    places = [] if folder is None else [folder / ROBOT_NAME, folder.parent / ROBOT_NAME]
    path = next((each for each in places if each.exists()), None)
    robot = None if path is None else Robot.from_json(read_json(path, PolicyError), str(path))
    given, place = (None, Place()) if mapping is None else load_mapping(mapping)
    if given is None and robot is None:
        raise UsageError(
            f"{run} has no {ROBOT_NAME}, because it was not trained from a bag, or by an earlier"
            " version: pass `mapping=` and `bag=`, or train again"
        )
    if robot is not None and given is not None:
        _check_same(robot.mapping, given, place)
        kept = {"action": given.action.model_copy(update={"box": robot.mapping.action.box})}
        given = given.model_copy(update=kept)
    if robot is not None and given is not None:
        robot = robot._replace(mapping=given)
    if robot is None:
        assert given is not None, "one of them is known"
        if bag is None:
            raise UsageError(f"{run} does not contain the types of the topics: pass `bag=`")
        with open_bag(bag, definitions=given.definitions) as opened:
            robot = Robot.of_plan(Plan(opened, given, place, trust_code=True), {}, _STEP_NS)
    return robot, place


def _check_same(trained: RobotMapping, given: RobotMapping, place: Place) -> None:
    """Check that two mappings have the same observations and actions."""
    for key in _LEARNED:
        old, new = ({key: each.model_dump(by_alias=True)[key]} for each in (trained, given))
        difference = _first_difference(old, new)
        if difference:
            keys, was, now = difference
            raise PolicyError(
                f"{place.of(*keys)} is {now!r}, but the policy was trained with {was!r}: it is a"
                " policy of another mapping"
            )


_FREE = ("representatives", "box")
"""Keys of an action that the data completes."""


def _first_difference(
    old: Any, new: Any, keys: tuple[Any, ...] = ()
) -> tuple[tuple[Any, ...], Any, Any] | None:
    if isinstance(old, dict) and isinstance(new, dict):
        for key in {**old, **new}:
            if keys == ("action",) and key in _FREE:
                continue
            found = _first_difference(old.get(key), new.get(key), (*keys, key))
            if found:
                return found
        return None
    return None if old == new else (keys, old, new)


Driver.__module__ = "mcaprl"
