"""Settings of algorithms: frozen dataclasses that validate themselves, with help for each field.

The string below a field describes the field. It is also the help of the command-line option.
"""

from __future__ import annotations

import ast
import functools
import inspect
import numbers
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields, is_dataclass
from typing import Any, get_type_hints

from mcaprl.errors import UsageError

_MAX_FRAME_STACK = 1_000
_KINDS: dict[object, str] = {
    bool: "true or false",
    int: "an integer",
    str: "a text",
    tuple[int, ...]: "a list of integers",
}
"""What the values of a field must be, by its type."""


@dataclass(frozen=True)
class Settings:
    """Settings of all algorithms, offline and online; subclasses choose their own defaults.

    Raises:
        UsageError: A setting is outside its range.
    """

    learning_rate: float = 1e-3
    """initial learning rate of Adam"""
    final_learning_rate_fraction: float = 1.0
    """final learning rate as a fraction of the initial one; the decay is linear"""
    hidden: tuple[int, ...] = (256, 256)
    """widths of the hidden layers; for images, of the layers after the convolutions"""
    frame_stack: int = 1
    """number of successive observations that the network receives"""
    checkpoint_interval: int = 1_000
    """number of updates (offline) or environment steps (online) between checkpoints"""

    def __post_init__(self) -> None:
        """Validate the types and ranges of the settings."""
        for name, kind in get_type_hints(type(self)).items():
            self._require(name, _is_of(getattr(self, name), kind), _KINDS.get(kind, "a number"))
        self._require_positive("frame_stack", "checkpoint_interval")
        allowed = f"at most {_MAX_FRAME_STACK}"
        self._require("frame_stack", self.frame_stack <= _MAX_FRAME_STACK, allowed)
        self._require("learning_rate", self.learning_rate > 0, "above 0")
        self._require_fraction("final_learning_rate_fraction")
        self._require("hidden", all(width >= 1 for width in self.hidden), "widths of at least 1")

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON types; `settings_from_json` is the inverse."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}

    def _require(self, name: str, holds: bool, allowed: str) -> None:
        if not holds:
            raise UsageError(f"{name} must be {allowed}, got {getattr(self, name)}")

    def _require_positive(self, *names: str) -> None:
        for name in names:
            self._require(name, getattr(self, name) >= 1, "at least 1")

    def _require_fraction(self, *names: str) -> None:
        for name in names:
            self._require(name, 0 <= getattr(self, name) <= 1, "within [0, 1]")


def _is_of(value: object, kind: object) -> bool:
    """Return whether a value has the type of a field; fields of other types are not checked."""
    if kind == tuple[int, ...]:
        return isinstance(value, tuple | list) and all(_is_of(each, int) for each in value)
    if kind not in (int, float):
        return not isinstance(kind, type) or isinstance(value, kind)
    number = numbers.Integral if kind is int else numbers.Real
    # Larger integers cannot be converted to a float.
    is_large = isinstance(value, int) and abs(value) > sys.float_info.max
    return isinstance(value, number) and not isinstance(value, bool) and not is_large


def check_settings(algo: str, config: Settings | type[Settings], given: Iterable[str]) -> None:
    """Check that an algorithm has the given settings."""
    known = [field.name for field in fields(config)]
    for name in given:
        if name not in known:
            options = ", ".join(f"`{each}=`" for each in known)
            raise UsageError(f"{algo} has no setting `{name}=`; it has {options}")


def settings_from_json(found: object) -> dict[str, Any]:
    """Return the settings in a `config.json`, with lists converted to tuples."""
    settings = found if isinstance(found, dict) else {}
    return {k: tuple(v) if isinstance(v, list) else v for k, v in settings.items()}


def flag(name: str) -> str:
    """Return the command line option of a setting.

    >>> flag("batch_size")
    '--batch-size'
    """
    return f"--{name.replace('_', '-')}"


def field_help(config_type: type) -> dict[str, str]:
    """Return the help texts of a dataclass by the names of the fields, inherited fields first."""
    assert is_dataclass(config_type)
    lines: dict[str, str] = {}
    for base in reversed(config_type.__mro__):
        if is_dataclass(base):
            lines |= _lines_under_fields(base)
    return {field.name: lines[field.name] for field in fields(config_type) if field.name in lines}


def _lines_under_fields(config_type: type) -> dict[str, str]:
    tree = _classes_of(config_type.__module__)[config_type.__qualname__]
    lines = {}
    for field, below in zip(tree.body, tree.body[1:], strict=False):
        match field, below:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(text))),
            ):
                lines[name] = inspect.cleandoc(text)
    return lines


@functools.cache
def _classes_of(module: str) -> dict[str, ast.ClassDef]:
    """Return the parsed classes of a module by name: Python keeps no docstrings of fields."""
    found: dict[str, ast.ClassDef] = {}
    parts: list[tuple[str, ast.AST]] = [("", ast.parse(inspect.getsource(sys.modules[module])))]
    while parts:
        prefix, node = parts.pop()
        for child in ast.iter_child_nodes(node):
            name = prefix
            if isinstance(child, ast.ClassDef):
                name = f"{prefix}{child.name}."
                found[name.removesuffix(".")] = child
            elif isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                name = f"{prefix}{child.name}.<locals>."
            parts.append((name, child))
    return found
