"""Commands of a robot: the messages of actions, the inverse of what a mapping does with a bag."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.base_policy import BasePolicy
from mcaprl.errors import PolicyError, UsageError
from mcaprl.recorder.bags.bag import TopicInfo
from mcaprl.recorder.bags.values import NUMBERS, Step, general_path, steps_of
from mcaprl.recorder.format.metadata import Command
from mcaprl.recorder.mapping.actions import Actions, CommandPart, actions_of
from mcaprl.recorder.mapping.align import NS_PER_S
from mcaprl.recorder.mapping.observe import Values
from mcaprl.recorder.mapping.plan import Plan, Wanted
from mcaprl.recorder.mapping.steps import command_part

Message = dict[str, Any]
_LONGEST_S = 1.0
"""Longest time for which a command may change at the limit, after a pause."""


class Commands:
    """Messages of actions.

    Attributes:
        topics: Topics of the messages.
        stop: Messages of the stop command.
    """

    def __init__(self, plan: Plan, policy: BasePolicy) -> None:
        """Find the command of each action, and the limits.

        Raises:
            PolicyError: The policy has other actions than the mapping.
            UsageError: The mapping has no command of an action, or none that stops the robot.
        """
        self._plan, self._action, self._drive = plan, plan.mapping.action, plan.mapping.drive
        if plan.expressions:
            raise UsageError(
                f"{plan.place.of('action', 'expressions')}: expressions cannot be turned into"
                " commands: use `fields` to drive a robot"
            )
        self._space = policy.action_space
        sizes = _sizes(plan.commands, self._space)
        self._fields = [
            _Field(wanted, plan.bag.topics[wanted.source.topic], size)
            for wanted, size in zip(plan.commands, sizes, strict=True)
        ]
        self._kinds = [field.kind for field in self._fields for _ in range(field.size)]
        self.topics = tuple(dict.fromkeys(field.topic for field in self._fields))
        self._commands = self._known_commands(policy)
        self._low, self._high, self._most = map(self._limit, ("low", "high", "max_change"))
        self._stop = self._stop_values()
        self.stop = self._built(self._stop, 0)
        self.reset()

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

    def action_of(self, values: Command | None = None) -> Any:
        """Return the action of a command in the mapping, by default of the last command."""
        found = self._actions([self._last if values is None else values])
        return found.values[0]

    @property
    def described(self) -> Actions:
        """Space, names and units of the actions, as in a dataset."""
        return self._actions([self._stop])

    def _actions(self, commands: Sequence[Command]) -> Actions:
        parts, first = [], 0
        for field in self._fields:
            columns = [command[first : first + field.size] for command in commands]
            first += field.size
            is_text = isinstance(columns[0][0], str)
            values = np.array(columns, object if is_text else np.float64)
            parts.append(field.part(values if field.is_array else values[:, 0]))
        return actions_of(self._action, parts)

    def _known_commands(self, policy: BasePolicy) -> list[Command] | None:
        """Return the command of each discrete action; None for a Box."""
        if isinstance(self._space, spaces.Box) != (self._action.box is not None):
            raise PolicyError(
                f"{policy.name} was trained with another mapping: its actions are {self._space}"
            )
        if not isinstance(self._space, spaces.Discrete):
            return None
        known = policy.action_commands
        count = int(self._space.n)
        names = self._action.actions
        if known is None and self._action.field is not None and not self._action.names:
            return [(float(k),) for k in range(count)]
        if known is None and names:
            commands: Sequence[Command | None] = [tuple(each) for each in names.values()]
        elif known is None:
            raise PolicyError(f"{policy.name} has no commands of its actions: train it again")
        else:
            commands = known.commands
        size = sum(field.size for field in self._fields)
        unknown = [k for k, each in enumerate(commands) if each is None or len(each) != size]
        if len(commands) != count or unknown:
            which = f"no command of action {unknown[0]}" if unknown else f"{len(commands)} commands"
            raise UsageError(
                f"{self._plan.place.of('action')}: {which}; the policy has {count} actions: set"
                " `representatives`"
            )
        found = [self._rounded(each) for each in commands if each is not None]
        self._check_commands(found)
        return found

    def _check_commands(self, commands: list[Command]) -> None:
        """Check that the mapping turns the command of each action into this action."""
        actions = self._actions(commands)
        wrong = np.flatnonzero(actions.values != np.arange(len(commands)))
        if len(wrong):
            k = int(wrong[0])
            raise UsageError(
                f"{self._plan.place.of('action')}: the command {list(commands[k])} of action {k} is"
                f" that of action {int(actions.values[k])}: set `representatives`"
            )

    def _limit(self, name: str) -> NDArray[np.float64] | None:
        given, count = getattr(self._drive, name), len(self._kinds)
        if given is None and name in ("low", "high") and isinstance(self._space, spaces.Box):
            given = getattr(self._space, name).ravel().tolist()
        if given is None:
            return None
        found = np.array(given, np.float64)
        if found.ndim and len(found) != count:
            raise UsageError(
                f"{self._plan.place.of('drive', name)} has {len(found)} entries; the command has"
                f" {count} elements"
            )
        return np.broadcast_to(found, count)

    def _stop_values(self) -> Command:
        given, place = self._drive.stop, self._plan.place.of("drive", "stop")
        are_numbers = all(kind != "string" for kind in self._kinds)
        if given is None:
            is_command = self._action.field is None and are_numbers
            low = -np.inf if self._low is None else self._low
            high = np.inf if self._high is None else self._high
            zero = np.zeros(len(self._kinds))
            if not is_command or ((zero < low) | (zero > high)).any():
                raise UsageError(
                    f"{place}: 0 does not stop the robot: set the value of each element,"
                    " or the name of an action"
                )
            return self._rounded(tuple(zero.tolist()))
        if isinstance(given, str):
            names = list(self._action.actions or self._action.numbers)
            if given in names and self._commands is not None:
                k = self._action.numbers.get(given, names.index(given))
                return self._commands[k]
            if len(self._kinds) != 1 or are_numbers:
                raise UsageError(
                    f"{place}: no action is named '{given}'; names: {', '.join(names)}"
                )
            return (given,)
        if len(given) != len(self._kinds):
            raise UsageError(
                f"{place} has {len(given)} values; the command has {len(self._kinds)} elements"
            )
        return self._rounded(tuple(given))

    def _command_of(self, action: Any) -> Command:
        if self._commands is not None:
            return self._commands[int(action)]
        return self._rounded(tuple(np.asarray(action, np.float64).ravel().tolist()))

    def _limited(self, command: Command, time_ns: int) -> Command:
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

    def _rounded(self, command: Command) -> Command:
        """Return the values as the fields of the message store them."""
        return tuple(_stored(each, kind) for each, kind in zip(command, self._kinds, strict=True))

    def _built(self, command: Command, time_ns: int) -> dict[str, Message]:
        found = {topic: _empty(self._plan.bag.topics[topic], time_ns) for topic in self.topics}
        first = 0
        for field in self._fields:
            field.set(found[field.topic], list(command[first : first + field.size]))
            first += field.size
        return found


class _Field:
    """A field of the command, which has one or more elements."""

    def __init__(self, wanted: Wanted, info: TopicInfo, size: int | None) -> None:
        path = wanted.source.path
        assert path is not None, "commands are fields"
        self._wanted, self._type_name, self._steps = wanted, info.type_name, list(path.steps)
        self.topic, self.is_array, self.size = path.topic, size is not None, size or 1
        self.kind = info.fields.get(general_path(path.field), "float64").partition("[")[0]

    def part(self, values: NDArray[Any]) -> CommandPart:
        """Return N commands (N, K) or (N,) as those of a bag."""
        nothing = np.zeros(len(values), np.bool_)
        found = Values(values, nothing, np.zeros(len(values)))
        return command_part(self._wanted, found, self._type_name)

    def set(self, message: Message, values: Sequence[float | str]) -> None:
        """Set the field of a message."""
        found = [_published(value, self.kind) for value in values]
        steps, names = self._steps, self._wanted.quantity.names
        at = next((k for k, step in enumerate(steps) if isinstance(step, slice)), None)
        if isinstance(names, list) and names:
            _set(message, list(steps_of(self._wanted.source.names)), list(names))
        if at is None:
            _set(message, steps, found if self.is_array else found[0])
            return
        chosen = cast(slice, steps[at])
        first, step = chosen.start or 0, chosen.step or 1
        for k, value in enumerate(found):
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


def _sizes(commands: Sequence[Wanted], space: Any) -> list[int | None]:
    """Return the number of elements of each field; None for a number."""
    found: list[int | None] = []
    for wanted in commands:
        path, names = wanted.source.path, wanted.quantity.names
        assert path is not None, "commands are fields"
        slices = [step for step in path.steps if isinstance(step, slice)]
        if isinstance(names, list) and names:
            found.append(len(names))
        elif path.is_bounded:
            (one,) = slices
            found.append(len(range(one.start or 0, one.stop or 0, one.step or 1)))
        else:
            found.append(0 if slices else None)
    # One field may have any number of elements, which the policy shows.
    total = int(np.prod(space.shape)) if isinstance(space, spaces.Box) else len(found)
    left = total - sum(1 if each is None else each for each in found)
    if left > 0:
        k = found.index(0) if 0 in found else found.index(None) if None in found else 0
        found[k] = left + (0 if found[k] == 0 else 1)
    return found


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


def _empty(info: TopicInfo, time_ns: int) -> Message:
    """Return a message with zeros, and the time in its header."""
    found = _zeros(info.fields)
    if isinstance(stamp := found.get("header", {}).get("stamp"), dict):
        stamp["sec"], stamp["nanosec"] = divmod(time_ns, int(NS_PER_S))
    return found


def _zeros(fields: Mapping[str, str]) -> Message:
    """Return the fields as nested dicts with zeros; see `TopicInfo.fields`."""
    found: Message = {}
    for path, kind in fields.items():
        if "[]" in path or fields.get(path.rpartition(".")[0]) == "time":
            continue
        inner = {
            each.removeprefix(f"{path}[]."): one.removesuffix("[]")
            for each, one in fields.items()
            if each.startswith(f"{path}[].")
        }
        names = path.split(".")
        parent = found
        for name in names[:-1]:
            parent = parent.setdefault(name, {})
        # A rotation by nothing.
        is_w = names[-1] == "w" and set(parent) == set("xyz")
        parent[names[-1]] = 1.0 if is_w else _zero(kind, inner)
    return found


def _zero(kind: str, inner: Mapping[str, str]) -> Any:
    element, bracket, rest = kind.partition("[")
    if bracket:
        count = int(rest.split("]")[0] or 0)
        return [_zeros(inner) if inner else _zero(element, {}) for _ in range(count)]
    if element == "time":
        return {"sec": 0, "nanosec": 0}
    if element == "bool":
        return False
    if element.rstrip("0123456789") in NUMBERS:
        return 0.0 if element.startswith(("float", "double")) else 0
    return "" if element == "string" else {}
