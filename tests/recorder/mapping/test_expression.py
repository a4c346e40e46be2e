"""Expressions: results calculated by hand, and syntax that is refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcaprl.errors import UnknownNameError, UsageError
from mcaprl.recorder.mapping.expression import Expression

COLUMNS = {
    "speed": np.array([0.0, 1.0, 4.0, math.nan]),
    "mode": np.array(["go", "go", "stop", None], object),
    "pose": np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0]]),
    "on": np.array([1, 0, 1, 0]),
}
FOLLOWING = np.array([1, 2, 3, 3])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("speed + 1", [1, 2, 5, math.nan]),
        ("next(speed) - speed", [1, 3, math.nan, math.nan]),
        ("next(speed - 2 * pose[0])", [-5, -6, math.nan, math.nan]),
        ("pose[-1] // 4", [0, 1, 1, 2]),
        ("2 ** pose[0] % 5", [2, 3, 2, 3]),
        ("speed > 0.5 and on", [0, 0, 1, 0]),
        ("not on or speed > 2", [0, 1, 1, 1]),
        ("0 <= speed < 4", [1, 1, 0, math.nan]),
        # The last speed is missing.
        ("speed or 0", [0, 1, 1, math.nan]),
        ("speed or 1", [1, 1, 1, 1]),
        ("speed and 0", [0, 0, 0, 0]),
        ("speed and 1", [0, 1, 1, math.nan]),
        ("not speed", [1, 0, 0, math.nan]),
        ("speed != 0", [0, 1, 1, math.nan]),
        ("5 if speed else 6", [6, 5, 5, math.nan]),
        ("speed if on else 7", [0, 7, 4, 7]),
        ("isnan(speed) or speed > 2", [0, 0, 1, 1]),
        ("mode == 'go'", [1, 1, 0, math.nan]),
        ("mode != 'go'", [0, 0, 1, math.nan]),
        ("mode == ('go' if on else 'stop')", [1, 0, 0, math.nan]),
        ("1 if mode == 'stop' else -1", [-1, -1, 1, math.nan]),
        ("-abs(pose[0] - 4) / 2", [-1.5, -0.5, -0.5, -1.5]),
        ("min(pose[0], 3) + max(pose[1], 5)", [6, 8, 9, 11]),
        ("clip(pose[0], 2, 4)", [2, 3, 4, 4]),
        ("hypot(pose[0], 0) + atan2(0, 1)", [1, 3, 5, 7]),
        ("isnan(speed)", [0, 0, 0, 1]),
        ("9 ** 9 ** 9", [math.inf] * 4),
        ("1 / 0", [math.inf] * 4),
    ],
)
def test_values_by_hand(text: str, expected: list[float]) -> None:
    found = Expression(text).evaluate(COLUMNS, FOLLOWING)
    np.testing.assert_array_equal(found.astype(np.float64), expected)


@pytest.mark.parametrize(
    "text",
    [
        "speed.real",
        "__import__('os')",
        "().__class__",
        "[speed]",
        "lambda: 1",
        "speed[speed]",
        "speed[0:1]",
        "(lambda: 1)()",
        "abs(speed, key=1)",
        "abs(*speed)",
        "f'{speed}'",
        "speed if",
        "x := 1",
        "1j",
        "b'x'",
        "None",
        "speed @ speed",
        "~on",
        "speed in mode",
        "speed is 1",
        "'a' * 10",
        "mode + 'x'",
        "mode < 'x'",
        "mode == 1",
        "speed[0]",
        "pose",
        "'text'",
        "abs()",
        "next",
        "min + 1",
        "(" * 300 + "1" + ")" * 300,
        "+".join(["1"] * 3000),
        "-" * 200 + "1",
    ],
)
def test_anything_else_is_refused(text: str) -> None:
    with pytest.raises(UsageError):
        Expression(text).evaluate(COLUMNS, FOLLOWING)


def test_unknown_names_and_functions_list_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match=r"'sped': did you mean speed or"):
        Expression("sped + 1").evaluate(COLUMNS, FOLLOWING)
    with pytest.raises(UnknownNameError, match="unknown function 'exec'"):
        Expression("exec('1')")


def test_an_expression_lists_its_names() -> None:
    assert Expression("abs(next(a)) + b[0] if c else 'd' == e").names == set("abce")


@given(st.text(max_size=40))
def test_no_text_does_anything_but_evaluate_or_fail_clearly(text: str) -> None:
    try:
        found: Any = Expression(text).evaluate(COLUMNS, FOLLOWING)
    except UsageError:
        return
    assert found.shape == (4,)


@pytest.mark.parametrize(
    "text",
    ["1" * 400, f"-{'9' * 400}", f"x{'.b' * 1900}", f"x{'()' * 1900}", f"{'x[' * 900}0{']' * 900}"],
)
def test_large_numbers_and_deep_nesting_are_one_short_line(text: str) -> None:
    with pytest.raises(UsageError) as error:
        Expression(text)
    assert len(str(error.value)) < 700
