"""Tests that errors are one line, and the same line in another process."""

from __future__ import annotations

import pickle

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
        assert kind.__name__ in errors.__doc__ or not kind.__module__.startswith("mcaprl")


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
