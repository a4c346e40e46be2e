"""Tests that errors are one line, and the same line in another process."""

from __future__ import annotations

import ast
import pickle
import re
from pathlib import Path

import pytest

from mcaprl import errors


def subclasses(of: type[errors.McaprlError]) -> list[type[errors.McaprlError]]:
    found = [of]
    for one in of.__subclasses__():
        found += subclasses(one)
    return found


@pytest.mark.parametrize("kind", subclasses(errors.McaprlError))
def test_every_error_can_be_pickled(kind: type[errors.McaprlError]) -> None:
    if kind is errors.UnknownNameError:
        error: errors.McaprlError = errors.UnknownNameError("sim", "lan", ["lane"], ["land"])
    else:
        error = kind("what, where, what to do")
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again)) == (kind, str(error))
    assert kind.exit_code in (1, 2)


def test_a_message_that_quotes_lines_is_one_line() -> None:
    assert str(errors.LogError("a.mcap: no:\n  line 2\n")) == "a.mcap: no: line 2 "


def test_every_error_is_in_the_diagram() -> None:
    assert errors.__doc__ is not None
    for kind in subclasses(errors.McaprlError):
        assert kind.__name__ in errors.__doc__


def test_nearest_names_come_first() -> None:
    error = errors.UnknownNameError("policy", "pilt", ["pilot", "random"], ["walker"])
    assert str(error) == "unknown policy 'pilt': did you mean pilot? known: pilot, random"
    none = errors.UnknownNameError("policy", "zzz", ["pilot", "random"])
    assert str(none) == "unknown policy 'zzz': known: pilot, random"


def test_a_missing_extra_names_the_install_command() -> None:
    with pytest.raises(errors.MissingExtraError) as reported:
        errors.import_extra("no_such_module.inner", "sims")
    assert str(reported.value) == "no_such_module is not installed: pip install 'mcaprl[sims]'"
    assert errors.import_extra("json", "sims").dumps([1]) == "[1]"


def test_functions_name_their_arguments_and_not_options() -> None:
    root, found = Path(__file__).parents[1], list[str]()
    for folder in ("mcaprl", "recorder", "sims", "offline", "online"):
        for path in (root / folder).rglob("*.py"):
            found += [f"{path}: {text}" for text in texts(path) if names_option(text)]
    assert found == []


def names_option(text: str) -> bool:
    """Return whether a text names an option, except in a whole command or a style sheet."""
    return (
        re.search(r"(?<!var\()--[a-z]", re.sub(r"(mcaprl|pip|ray) [^;,`]*", "", text)) is not None
    )


def test_options_are_found() -> None:
    assert names_option("a.mcap exists; pass --overwrite")
    assert names_option("convert it by `mcaprl convert A B --to npz`, or omit (--to)")
    assert not names_option("`mcaprl recover {} b.mcap --keep-unfinished` keeps it")
    assert not names_option("a -- b")


def texts(path: Path) -> list[str]:
    """Return the strings of a module that are not docstrings; `{}` replaces values."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    parts = {
        id(part)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr | ast.JoinedStr)
        for part in (node.values if isinstance(node, ast.JoinedStr) else [node.value])
    }
    joined = [
        "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
        for node in ast.walk(tree)
        if isinstance(node, ast.JoinedStr)
    ]
    return joined + [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts
    ]
