"""Commands that discrete actions stand for, so that a policy's action can be sent to a robot."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

Command = tuple[float | str, ...]
"""Values of the fields of a command: numbers or texts."""


@dataclass(frozen=True)
class ActionCommands:
    """Command of each discrete action.

    Attributes:
        fields: Paths of the K fields of a command, such as `/cmd_vel.linear.x`.
        commands: K values for each action, in the order of the actions; None if unknown.
    """

    fields: tuple[str, ...]
    commands: tuple[Command | None, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the fields and commands as JSON types."""
        commands = [None if each is None else list(each) for each in self.commands]
        return {"fields": list(self.fields), "commands": commands}

    @classmethod
    def from_json(cls, found: Any, count: int) -> ActionCommands:
        """Check JSON types that `to_json` returned; `count` is the number of actions."""
        fields = found.get("fields") if isinstance(found, Mapping) else None
        commands = found.get("commands") if isinstance(found, Mapping) else None
        if not (isinstance(fields, list) and all(isinstance(each, str) for each in fields)):
            raise ValueError("the fields of action_commands are not a list of texts")
        if not (isinstance(commands, list) and len(commands) == count):
            raise ValueError(f"action_commands does not have {count} commands")
        return cls(tuple(fields), tuple(_command(each, len(fields)) for each in commands))

    def by_name(self, names: Mapping[int, str]) -> dict[str, Command | None]:
        """Return the commands by the names of their actions, which `names` has by index."""
        return {names.get(k, str(k)): command for k, command in enumerate(self.commands)}


def _command(found: Any, count: int) -> Command | None:
    if found is None:
        return None
    if not (isinstance(found, list) and len(found) == count and all(map(_is_value, found))):
        raise ValueError(f"a command of action_commands is not {count} numbers or texts")
    return tuple(found)


def _is_value(found: Any) -> bool:
    if isinstance(found, bool):
        return False
    return isinstance(found, str) or (isinstance(found, int | float) and math.isfinite(found))
