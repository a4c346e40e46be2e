"""Settings of training: frozen dataclasses that check their values, with help for each field.

The string under a field (see `TrainingConfig` in `offline/algorithms/config.py`) describes it; the
command line prints that string as the help of the field's option.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

from mcaprl.errors import UsageError


@dataclass(frozen=True)
class Settings:
    """Base class of all settings."""

    def _require(self, name: str, holds: bool, allowed: str) -> None:
        """Refuse an invalid value of a field.

        Raises:
            UsageError: `holds` is false.
        """
        if not holds:
            raise UsageError(f"{name} must be {allowed}, got {getattr(self, name)}")


def check_settings(algo: str, config: Settings | type[Settings], given: Iterable[str]) -> None:
    """Refuse settings that an algorithm does not have.

    Args:
        algo: Name of the algorithm.
        config: Settings of the algorithm, or their type.
        given: Names of the settings that the user gave.

    Raises:
        UsageError: A name is not a field of `config`.
    """
    known = [field.name for field in fields(config)]
    for name in given:
        if name not in known:
            options = ", ".join(map(flag, known))
            raise UsageError(f"{algo} has no setting {flag(name)}; it has {options}")


def plain_settings(found: object) -> dict[str, Any]:
    """Return settings that were read from JSON, with tuples instead of lists."""
    settings = found if isinstance(found, dict) else {}
    return {k: tuple(v) if isinstance(v, list) else v for k, v in settings.items()}


def flag(name: str) -> str:
    """Return the command-line option of a setting.

    >>> flag("batch_size")
    '--batch-size'
    """
    return f"--{name.replace('_', '-')}"


def field_help(config_type: type) -> dict[str, str]:
    """Return the string under each field of a config dataclass, inherited fields first.

    Args:
        config_type: Dataclass whose source file is available.

    Returns:
        Strings by field name, in the order of the fields.
    """
    assert is_dataclass(config_type)
    lines: dict[str, str] = {}
    for base in reversed(config_type.__mro__):
        if is_dataclass(base):
            lines |= _lines_under_fields(base)
    return {field.name: lines[field.name] for field in fields(config_type) if field.name in lines}


def _lines_under_fields(config_type: type) -> dict[str, str]:
    """Parse the strings from the source, since Python does not store docstrings of fields."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(config_type))).body[0]
    assert isinstance(tree, ast.ClassDef)
    lines = {}
    for field, below in zip(tree.body, tree.body[1:], strict=False):
        match field, below:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(text))),
            ):
                lines[name] = inspect.cleandoc(text)
    return lines
