"""Commands of a robot: the messages of actions, the inverse of what a mapping does with a bag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.base_policy import BasePolicy
from mcaprl.drive.core import CommandField, CommandMessages, Message
from mcaprl.errors import PolicyError, UsageError
from mcaprl.recorder.bags.bag import TopicInfo
from mcaprl.recorder.bags.values import NUMBERS, general_path, path_text
from mcaprl.recorder.format.metadata import Command
from mcaprl.recorder.mapping.actions import Actions, CommandPart, actions_of, unit_of
from mcaprl.recorder.mapping.observe import Values
from mcaprl.recorder.mapping.plan import Plan, Wanted
from mcaprl.recorder.mapping.steps import command_part

_RATES = ("m/s", "rad/s", "m/s^2", "rad/s^2", "N", "N m")


class Commands(CommandMessages):
    """Messages of actions."""

    def __init__(self, plan: Plan, policy: BasePolicy) -> None:
        """Find the command of each action, and the limits."""
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
        infos = plan.bag.topics
        topics = dict.fromkeys(field.topic for field in self._fields)
        super().__init__(
            [field.described for field in self._fields],
            {topic: _zeros(infos[topic].fields) for topic in topics},
        )
        self._table = self._known_commands(policy)
        self._low, self._high, self._most = map(self._limit, ("low", "high", "max_change"))
        self._stop = self._stop_values()
        self.is_finite = self._table is not None
        self.reset()

    @property
    def plain(self) -> dict[str, Any]:
        """What `CommandMessages` needs, as JSON types."""
        return {
            "fields": [list(field) for field in self.fields],
            "templates": self.templates,
            "table": self._table,
            "stop": self._stop,
            "limits": [
                None if each is None else each.tolist()
                for each in (self._low, self._high, self._most)
            ],
        }

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

    def _units(self) -> list[str]:
        """Return the unit of each element by the type of its message."""
        return [field.unit for field in self._fields for _ in range(field.size)]

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
            outside = (zero < low) | (zero > high)
            # A velocity of 0 stops a robot, also if it is no command of the policy.
            is_rate = np.array([unit in _RATES for unit in self._units()])
            if not is_command or (outside & ~is_rate).any():
                raise UsageError(
                    f"{place}: 0 does not stop the robot: set the value of each element,"
                    " or the name of an action"
                )
            return self._rounded(tuple(zero.tolist()))
        if isinstance(given, str):
            names = list(self._action.actions or self._action.numbers)
            if given in names and self._table is not None:
                k = self._action.numbers.get(given, names.index(given))
                return self._table[k]
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


class _Field:
    """A field of the command, which has one or more elements."""

    def __init__(self, wanted: Wanted, info: TopicInfo, size: int | None) -> None:
        path = wanted.source.path
        assert path is not None, "commands are fields"
        self._wanted, self._type_name, self._steps = wanted, info.type_name, list(path.steps)
        self.topic, self.is_array, self.size = path.topic, size is not None, size or 1
        label = str(path).removeprefix(path.topic).lstrip(".")
        self.unit = unit_of(info.type_name, label)
        self.kind = info.fields.get(general_path(path.field), "float64").partition("[")[0]

    def part(self, values: NDArray[Any]) -> CommandPart:
        """Return N commands (N, K) or (N,) as those of a bag."""
        nothing = np.zeros(len(values), np.bool_)
        found = Values(values, nothing, np.zeros(len(values)))
        return command_part(self._wanted, found, self._type_name)

    @property
    def described(self) -> CommandField:
        """The field, without its topic's type."""
        names = self._wanted.quantity.names
        return CommandField(
            self.topic,
            path_text(self._steps),
            self._wanted.source.names,
            list(names) if isinstance(names, list) else [],
            self.is_array,
            self.size,
            self.kind,
        )


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
