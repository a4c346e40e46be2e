"""Driving of a robot by a trained policy, with the mapping that the policy was trained with.

`Driver` knows no transport: whoever has the messages pushes them, and publishes the commands.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
from gymnasium import spaces

from mcaprl.base_policy import BasePolicy
from mcaprl.drive.commands import Commands
from mcaprl.drive.core import Command, DriverCore
from mcaprl.drive.record import DriveLog
from mcaprl.errors import LogError, PolicyError, UsageError
from mcaprl.files import read_json
from mcaprl.recorder.bags.bag import open_bag
from mcaprl.recorder.bags.protobuf import ProtobufDecoder
from mcaprl.recorder.bags.source import Definition
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
from mcaprl.runs import ROBOT_NAME

_STEP_NS = 100_000_000
_LEARNED = ("time", "clock", "observation", "stack", "action")
"""Keys of a mapping that a policy was trained with."""


class Driver(DriverCore):
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
        policy, found = _loaded(run)
        robot, place = _robot_of(run, found, mapping, bag)
        self._topics = Topics(robot.topics)
        self._plan = Plan(
            self._topics,
            robot.mapping.without_labels(),
            place,
            trust_code=trust_code,
            packets_ns=robot.packets_ns,
        )
        live = LiveSteps(self._plan, robot.shapes)
        commands = Commands(self._plan, policy)
        self._robot_commands = commands
        _check_fits(policy, robot)
        super().__init__(
            self._plan, live, LiveEpisodes(self._plan, policy.frame_stack), commands, policy
        )
        self.definitions: dict[str, Definition] = {
            name: robot.topics[name] for name in (*self.inputs, *self.outputs)
        }
        self._robot, self._log = robot, cast("DriveLog | None", None)

    def record(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Record from now on: a log of this package, with the robot's topics beside it.

        Args:
            path: MCAP file to write.
            overwrite: Whether an existing file is replaced.

        Raises:
            UsageError: The command that stops the robot is not an action of the mapping.
            OutputExistsError: The file exists.
        """
        self.close()
        is_late = self._episodes.is_late
        self._log = DriveLog(
            path,
            self._plan,
            self._robot,
            self.policy,
            self._robot_commands,
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

    def _decoded(self, topic: str, message: Any) -> Any:
        decoder = self._topics.decoders[topic]
        if isinstance(message, bytes):
            try:
                return decoder.decode(message)
            except LogError as error:
                raise UsageError(f"{topic}: {error}") from error
        if isinstance(decoder, ProtobufDecoder) and hasattr(message, "DESCRIPTOR"):
            return decoder.wrapped(message)
        return message

    def _pushed(self, topic: str, message: Any, stamp_ns: int) -> None:
        if self._log is not None:
            self._log.add(topic, message, stamp_ns)

    def _commanded(self, step: LiveStep, state: EpisodeState, found: Command, now_ns: int) -> None:
        if self._log is None:
            return
        # A command that is aligned with the steps must not come before its step.
        at_ns = max(now_ns, found.time_ns + (self.mapping.action.align == "during"))
        for topic, message in found.messages.items():
            self._log.add(topic, message, at_ns)
        self._log.see(step, state, self._robot_commands.action_of(), float(np.exp(found.log_prob)))


def _check_fits(policy: BasePolicy, robot: Robot) -> None:
    """Check that the policy has the observations of the mapping, as far as they are known."""
    space = policy.observation_space
    state = space[STATE] if isinstance(space, spaces.Dict) and STATE in space.spaces else space
    names = [n for n, each in robot.mapping.observation.items() if each.pixels is None]
    if not isinstance(state, spaces.Box) or not all(name in robot.shapes for name in names):
        return
    count = sum(math.prod(robot.shapes[name]) for name in names) * robot.mapping.stack
    if names and state.shape != (count,):
        raise PolicyError(
            f"{policy.name} was trained with another mapping: it observes {state.shape}"
            f" numbers, the mapping has {count}"
        )


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


_FREE = ("representatives", "box")  # Keys of an action that the data completes


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
