"""Values of fields in messages that hold anything, and their columns."""

from __future__ import annotations

import json
import math
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcaprl.errors import UsageError
from mcaprl.recorder.bags.bag import open_bag
from mcaprl.recorder.bags.values import (
    ABSENT,
    Lack,
    column_of,
    kind_at,
    path_text,
    steps_of,
    value_at,
)
from tests.support.nested_bags import write_json

TIME = {"sec": "integer", "nsec": "integer"}
SCHEMA = {
    "type": "object",
    "properties": {
        "data": {"type": "string", "contentEncoding": "base64"},
        "stamp": {"type": "object", "properties": {key: {"type": TIME[key]} for key in TIME}},
        "x": {"type": "number"},
    },
}
ODD: list[Any] = [
    10**10,
    -1,
    1.5,
    "a",
    "!!!!",
    [999],
    [-1],
    [[1]],
    {},
    True,
    None,
    math.nan,
    math.inf,
    10**400,
]


def column(tmp_path: Path, name: str, values: list[Any], *, schema: bool = True) -> Any:
    path = write_json(
        tmp_path / "odd.mcap", [{name: value} for value in values], SCHEMA if schema else None
    )
    with closing(open_bag(path)) as bag:
        return bag.read("/low", [name]).columns[name]


@pytest.mark.parametrize("odd", ODD, ids=[json.dumps(odd)[:12] for odd in ODD])
def test_bytes_that_are_something_else_are_missing(odd: Any, tmp_path: Path) -> None:
    found = column(tmp_path, "data", ["AQI=", odd, [3, 4]])
    assert found.tolist() == [b"\1\2", None, b"\3\4"]
    column(tmp_path, "data", [odd])


@pytest.mark.parametrize(
    "odd",
    [
        *(odd for odd in ODD if odd not in (10**10, -1)),
        *(
            {"sec": sec, "nsec": 0}
            for sec in ("abc", None, [1], math.nan, 1e300, 10**39, -math.inf)
        ),
        {"sec": 0, "nsec": "9" * 40},
        {"sec": 2**62, "nsec": 0},
    ],
    ids=lambda odd: json.dumps(odd)[:20],
)
def test_times_that_are_something_else_are_missing(odd: Any, tmp_path: Path) -> None:
    good = [{"sec": 1, "nsec": 5}, {"sec": "2", "nsec": 0}, {"sec": 0.5, "nsec": 0}]
    expected = [1_000_000_005, 2_000_000_000, 500_000_000]
    assert column(tmp_path, "stamp", good).tolist() == expected
    found = column(tmp_path, "stamp", [*good, odd])
    np.testing.assert_array_equal(found, [*expected, np.nan])
    column(tmp_path, "stamp", [odd])


@pytest.mark.parametrize("schema", [False, True])
def test_any_json_value_makes_a_column(schema: bool, tmp_path: Path) -> None:
    for values in (
        [10**400, 1, -(10**400)],
        [2**63, -1, 2**64],
        [[10**400, 1]] * 2,
        [[[1, 2], [3, 4]]] * 2,
        [[[[1]]]] * 2,
        [[1, [2]], [[1], 2]],
        [[1, 2], [3]],
        [[1, None], [2, 3]],
        [[], [1]],
        [[{"a": 1}]] * 2,
        [["a", "b"]] * 2,
        [{"a": 1}] * 2,
        [1, "a", None, [1], {"b": 2}],
        [True, 1, 2.5],
        [None, None],
        ["1", 1],
    ):
        found = column(tmp_path, "x", values, schema=schema)
        assert len(found) == len(values), values
        assert found.ndim == 1 or found.dtype.kind in "biuf"


def test_integers_that_int64_cannot_hold_are_floats() -> None:
    assert column_of([10**400, 1, -(10**400)], "").tolist() == [math.inf, 1, -math.inf]
    assert column_of([2**63, -1], "").tolist() == [2.0**63, -1]
    assert column_of([2**62, -1], "").tolist() == [2**62, -1]


def test_values_by_hand() -> None:
    message = {"a": {"b": [1, 2, 3]}, "c": [{"d": 1}, {"d": None}, {}], "e": None, "x.y": 4}
    for path, expected in (
        ("a.b[1]", 2),
        ("a.b[-1]", 3),
        ("a.b[::2]", [1, 3]),
        ("a.b[1:][0]", 2),
        ("c[0].d", 1),
        ("c[1].d", None),
        ("c[2].d", ABSENT),
        ("e.f.g", None),
        ("e[0]", None),
        ("a.z", ABSENT),
        ("a.z.b[3]", ABSENT),
        ("['x.y']", 4),
        (f"a['{'9' * 5000}']", ABSENT),
    ):
        assert value_at(message, path) == expected, path
    for path, length in (("a.b[3]", 3), ("c[-4].d", 3), ("a[0]", -1), ("a.b[0][0]", -1)):
        found = value_at(message, path)
        assert isinstance(found, Lack), path
        assert found.length in (length, -1)
    np.testing.assert_array_equal(value_at(message, "c[:].d"), [1, np.nan, np.nan])
    np.testing.assert_array_equal(value_at(message, "c.d"), [1, np.nan, np.nan])
    assert value_at(message, "c[3:].d").shape == (0,)


def test_entries_of_maps_that_are_arrays_are_read_by_their_keys() -> None:
    gains = [
        {"key": "left", "value": 2},
        {"key": 3, "value": {"x": 4}},
        {"key": "n", "value": None},
    ]
    message = {"gains": gains}
    for path, expected in (
        ("gains[left]", 2),
        ("gains.left", 2),
        ("gains['3'].x", 4),
        ("gains.n", None),
        ("gains.right", ABSENT),
    ):
        assert value_at(message, path) == expected, path
    assert value_at(message, "gains.key") == ["left", 3, "n"]


def test_the_kind_of_a_field_in_arrays() -> None:
    fields = {
        "m": "demo/Motor[]",
        "m[].mode": "uint8[]",
        "m[].raw": "uint8[][]",
        "m[].at": "time[]",
        "raw": "uint8[]",
    }
    for path, expected in (
        ("m[0].mode", "uint8"),
        ("m[0].raw", "uint8[]"),
        ("m[0].at", "time"),
        ("m[:].mode", ""),
        ("raw", "uint8[]"),
        ("raw[@]", ""),
        ("raw[0]", ""),
        ("none", ""),
    ):
        assert kind_at(fields, path) == expected, path


@pytest.mark.parametrize(
    "path",
    ["a[", "a]", "a..b", ".a", "a.", "a[0]b", "a[::0]", f"a[{'1' * 5000}]", "a[0]" * 40, "[[0]]"],
)
def test_wrong_paths_are_one_line(path: str) -> None:
    with pytest.raises(UsageError) as error:
        steps_of(path)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 400


_limits = st.none() | st.integers(-(10**17), 10**17)
_slices = st.builds(slice, _limits, _limits, _limits.filter(lambda step: step != 0))
_keys = st.text("ab.[]:3 @", max_size=4)


@given(st.lists(_keys | st.integers(-(10**17), 10**17) | _slices, max_size=6))
def test_a_path_is_parsed_as_it_was_written(steps: list[Any]) -> None:
    assert list(steps_of(path_text(steps))) == steps
