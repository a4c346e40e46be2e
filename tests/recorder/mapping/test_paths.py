"""Paths of fields in bags of every format: elements inside arrays, and arrays of any length."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.mapping.align import padded, pooled
from mcaprl.recorder.mapping.config import parse_mapping
from mcaprl.recorder.mapping.read import MappedBag, read_bag, read_open_bag
from tests.support.memory_bag import MemoryBag
from tests.support.nested_bags import FORMATS, SCHEMA, motors, write_json

MESSAGES = [
    {
        "motors": motors(("a", step + 0.25), ("b", step + 0.5), ("c", step + 0.75)),
        "joint_names": ["a", "b"],
        "position": [float(step), 2.0 * step, 3.0 * step, 7.0],
        "points": [{"positions": [step + 1.0, step + 2.0]}, {"positions": [step + 3.0, 9.0]}],
        "ranges": [float(step)] * (step + 2),
        "command": float(step % 2),
    }
    for step in range(4)
]
# By path: the values in the message of step 1.
PATHS: dict[str, list[float]] = {
    "/low.motors[2].q": [1.75],
    "/low.motors[-1].q": [1.75],
    "/low.motors[0:2].q": [1.25, 1.5],
    "/low.motors[::2].q": [1.25, 1.75],
    "/low.motors[:].q": [1.25, 1.5, 1.75],
    "/low.motors[].q": [1.25, 1.5, 1.75],
    "/low.motors.q": [1.25, 1.5, 1.75],
    "/low.motors[1].pos": [1.5, -1.5],
    "/low.motors[1].pos[1]": [-1.5],
    "/low.motors[1:].pos[1]": [-1.5, -1.75],
    "/low.motors[0:2].pos": [1.25, -1.25, 1.5, -1.5],
    "/low.motors[1:][1].q": [1.75],
    "/low.points[0].positions": [2, 3],
    "/low.points[1].positions[0]": [4],
    "/low.points[:].positions": [2, 3, 4, 9],
    "/low.position[::3]": [1, 7],
    "/low.position[::3][0]": [1],
    "/low.position[1:][0:2]": [2, 3],
    "/low.ranges[0]": [1],
    "/low.ranges[0:2]": [1, 1],
    "/low.ranges[-1]": [1],
}


def mapping(observation: dict[str, Any], **parts: Any) -> Any:
    return parse_mapping(
        {
            "clock": {"topic": "/low"},
            "observation": {"x": observation},
            "action": {"field": "/low.command"},
            **parts,
        }
    )


@pytest.fixture(scope="module", params=FORMATS)
def bag(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return FORMATS[request.param](tmp_path_factory.mktemp("nested"), MESSAGES)


def test_every_form_of_a_path_in_every_format(bag: Path) -> None:
    for path, expected in PATHS.items():
        data = read_bag(bag, mapping({"field": path})).dataset
        assert data.observations[1].tolist() == expected, path
        assert len(data.observations) == 3


def test_elements_that_no_message_has_name_the_longest_array(bag: Path) -> None:
    for path, count in (
        ("/low.motors[3].q", 3),
        ("/low.points[-3].positions", 2),
        ("/low.ranges[9]", 5),
        ("/low.points[0].positions[2]", 2),
    ):
        with pytest.raises(UsageError, match=rf"{re.escape(path)}: .* {count} elements; index 0"):
            read_bag(bag, mapping({"field": path}))


def test_wrong_paths_are_one_line(bag: Path) -> None:
    for path in (
        "/low.motors",
        "/low.motors[0]",
        "/low.motors[0].name.x",
        "/low.motors[0].name",
        "/low.joint_names",
        "/low.position[",
        "/low.position[0",
        "/low.position[]",
        "/low.position[0]x",
        "/low.position[::0]",
        f"/low.position[{'9' * 5000}]",
        f"/low.position{'[0]' * 100}",
        "/low..position",
        "/low.position[4:]",
        "/low.motors[3:].q",
        "/low.command[0]",
        "/low.command[0:1].q",
    ):
        with pytest.raises((UsageError, LogError)) as error:
            read_bag(bag, mapping({"field": path}))
        assert "\n" not in str(error.value), path
        assert len(str(error.value)) < 600, path


def test_arrays_of_different_lengths_need_a_choice(bag: Path) -> None:
    with pytest.raises(UsageError, match=r"of 2 to 5 elements: .* such as \[0:2\], or set `pad`"):
        read_bag(bag, mapping({"field": "/low.ranges"}))
    found = read_bag(bag, mapping({"field": "/low.ranges", "pad": 4, "missing": -1})).dataset
    assert found.frames.tolist() == [[0, 0, -1, -1], [1, 1, 1, -1], [2, 2, 2, 2], [3, 3, 3, 3]]
    for kind in ("min", "max", "mean"):
        pool = {"field": "/low.ranges", "pool": kind, "to": 2}
        data = read_bag(bag, mapping(pool)).dataset
        assert data.frames.tolist() == [[0, 0], [1, 1], [2, 2], [3, 3]]


def test_an_element_that_a_message_lacks_is_missing(bag: Path) -> None:
    last = {"field": "/low.ranges[2]"}
    found = read_bag(bag, mapping(last))
    assert found.dataset.frames.ravel().tolist() == [1, 2, 3]
    assert found.report.fields["x"].missing == 0.25
    part = {"field": "/low.ranges[1:4]", "missing": -7}
    data = read_bag(bag, mapping(part)).dataset
    assert data.frames.tolist() == [[0, -7, -7], [1, 1, -7], [2, 2, 2], [3, 3, 3]]


def test_vectors_are_commands(bag: Path) -> None:
    box = {"fields": ["/low.position[0:3]", "/low.command"], "box": {"low": -1, "high": [9] * 4}}
    data = read_bag(bag, mapping({"field": "/low.command"}, action=box)).dataset
    assert data.actions.tolist() == [[0, 0, 0, 0], [1, 2, 3, 1], [2, 4, 6, 0]]
    action: Any = data.action_space
    assert action.low.tolist() == [-1] * 4
    with pytest.raises(UsageError, match="action: high needs 5 entries, one for each element of t"):
        read_bag(
            bag,
            mapping(
                {"field": "/low.command"},
                action={**box, "fields": ["/low.position", "/low.command"]},
            ),
        )
    bins = {"fields": ["/low.motors[0:2].q"], "edges": [[1], [2, 3]]}
    found = read_bag(bag, mapping({"field": "/low.command"}, action=bins))
    assert found.dataset.actions.tolist() == [0, 3, 4]
    assert found.dataset.action_names[4] == "q[0] from 1 and q[1] 2 to 3"
    with pytest.raises(
        UsageError, match=r"has 2 elements; choose one of them, such as (\S+)$"
    ) as e:
        read_bag(
            bag,
            mapping({"field": "/low.command"}, action={"field": "/low.motors[1:3].q"}),
        )
    assert str(e.value).endswith("/low.motors[1].q")


def test_maps_are_read_by_their_keys(tmp_path: Path) -> None:
    messages = [{"gains": {"left": step + 0.5, "a.b": 1.0}, "command": 0.0} for step in range(3)]
    # The protobuf message of the last step has no such key, which is no update.
    messages.append({"gains": {"a.b": 2.0}, "command": 0.0})
    for write in (FORMATS["protobuf"], FORMATS["JSON"]):
        path = write(tmp_path, messages)
        for field in ("/low.gains[left]", "/low.gains.left", '/low.gains["left"]'):
            data = read_bag(path, mapping({"field": field})).dataset
            assert data.frames.ravel().tolist() == [0.5, 1.5, 2.5, 2.5]
        data = read_bag(path, mapping({"field": "/low.gains['a.b']"})).dataset
        assert data.frames.ravel().tolist() == [1, 1, 1, 2]


PARTIAL: list[dict[str, Any]] = [
    {"command": 0, "x": 1.0, "a": [1, 2], "q": {"x": 0, "y": 0, "z": 0, "w": 1}, "s": "go"},
    {"command": 1},
    {
        "command": 0,
        "x": 3.0,
        "a": [3, 4],
        "q": {"x": 0, "y": 0, "z": math.sqrt(0.5), "w": math.sqrt(0.5)},
        "s": "stop",
    },
    {"command": 1, "a": []},
    {"command": 0, "x": None, "a": None, "q": None, "s": None},
]


@pytest.mark.parametrize("schema", [None, SCHEMA])
def test_a_message_that_omits_a_key_keeps_the_last_value(tmp_path: Path, schema: Any) -> None:
    path = write_json(tmp_path / "partial.mcap", PARTIAL, schema)
    nan = math.nan
    for observation, expected in (
        ({"field": "/low.x", "missing": -1}, [1, 1, 3, 3, -1]),
        ({"field": "/low.a[1]", "missing": -1}, [2, 2, 4, -1, -1]),
        ({"field": "/low.a[0]", "missing": -1, "tolerance_s": 0.5}, [1, -1, 3, -1, -1]),
        ({"field": "/low.q", "as": "yaw", "missing": -1}, [0, 0, math.pi / 2, math.pi / 2, -1]),
    ):
        data = read_bag(path, mapping(observation)).dataset
        np.testing.assert_allclose(data.frames.ravel(), expected, rtol=1e-6)
    vectors = read_bag(path, mapping({"field": "/low.a", "missing": -1})).dataset
    assert vectors.frames.tolist() == [[1, 2], [1, 2], [3, 4], [-1, -1], [-1, -1]]
    found = read_bag(path, mapping({"field": "/low.x"}))
    assert found.dataset.frames.ravel().tolist() == [1, 1, 3, 3]
    assert found.report.fields["x"].max_age_s == 1
    parts = {"fields": {"s": {"field": "/low.s"}}, "reward": "2 if s == 'go' else 1"}
    data = read_bag(path, mapping({"field": "/low.command"}, **parts)).dataset
    np.testing.assert_array_equal(data.rewards, [2, 2, 1, 1, nan][: len(data.rewards)])


def test_fields_that_no_message_has_are_refused_if_there_is_a_schema(tmp_path: Path) -> None:
    path = write_json(tmp_path / "typo.mcap", [{"command": 0, "more": 1}] * 3, SCHEMA)
    with pytest.raises(UsageError, match=r"has no field 'commandd'; nearest: command"):
        read_bag(path, mapping({"field": "/low.commandd"}))
    path_of_typo = write_json(
        tmp_path / "a.mcap", [{"a": [{"x": 1}] * k, "command": 0} for k in range(3)]
    )
    with pytest.raises(UsageError, match=r"/low.a\[0\].y has no value in any message: the mess"):
        read_bag(path_of_typo, mapping({"field": "/low.a[0].y"}))
    # The schema does not list this field, but the messages have it.
    assert (
        read_bag(path, mapping({"field": "/low.more"})).dataset.frames.ravel().tolist() == [1] * 3
    )


def scan(rows: list[list[float]], **observation: Any) -> MappedBag:
    times = list(range(len(rows)))
    bag = MemoryBag({"/low": (times, {"r": rows, "command": [0.0] * len(rows)})})
    return read_open_bag(bag, mapping({"field": "/low.r", **observation}))


def test_single_infinite_elements_are_replaced_or_clipped() -> None:
    rows = [[1.0, math.inf, 3.0], [math.nan, 2.0, -math.inf], [1.0, 2.0, 1e300]]
    assert scan(rows, missing=-1).dataset.frames.tolist() == [[1, -1, 3], [-1, 2, -1], [1, 2, -1]]
    clipped = scan(rows, missing=-1, clip=[0, 10]).dataset
    assert clipped.frames.tolist() == [[1, 10, 3], [-1, 2, 0], [1, 2, 10]]
    rows[1][0] = 0.5
    assert scan(rows, clip=[0, 10]).dataset.frames[1].tolist() == [0.5, 2, 0]
    assert scan(rows, clip=[0, 10], align="linear").dataset.frames[0].tolist() == [1, 10, 3]


def test_infinite_elements_are_named() -> None:
    rows = [[1.0, math.inf, 3.0, math.inf]] * 4
    with pytest.raises(
        LogError,
        match=r"x \(/low\) is not finite at 100% of the steps \(elements 1, 3 of 4, for ex",
    ):
        scan(rows)
    report = scan([[1.0, math.inf if step else 2.0, 3.0] for step in (0, 0, 0, 1)]).report
    assert report.fields["x"].elements == (1,)
    assert "missing 25.0% (element 1)" in str(report.fields["x"])


def test_sectors_by_hand() -> None:
    inf, nan = math.inf, math.nan
    rows = [np.array(row, np.float64) for row in ([3, 1, nan, 5, inf, 2, 8], [4], [nan, inf], [])]
    # The three sectors of seven elements begin at 0, 2 and 4.
    expected = {
        "min": [[1, 5, 2], [4, 4, 4], [nan, nan, inf], [nan] * 3],
        "max": [[3, 5, inf], [4, 4, 4], [nan, nan, inf], [nan] * 3],
        "mean": [[2, 5, 5], [4, 4, 4], [nan] * 3, [nan] * 3],
    }
    for kind, values in expected.items():
        np.testing.assert_array_equal(pooled(rows, kind, 3), values)


@given(st.lists(st.lists(st.floats(-9, 9), max_size=9), max_size=5), st.integers(1, 12))
def test_sectors_and_padding_equal_a_slow_reference(values: list[list[float]], count: int) -> None:
    rows = [np.array(row, np.float64) for row in values]
    expected = np.full((len(rows), count), np.nan)
    filled = np.full((len(rows), count), np.nan)
    for place, row in enumerate(values):
        for k in range(count if row else 0):
            first, last = k * len(row) // count, (k + 1) * len(row) // count
            expected[place, k] = min(row[first : max(last, first + 1)])
        for k, value in enumerate(row[:count]):
            filled[place, k] = value
    np.testing.assert_array_equal(pooled(rows, "min", count), expected)
    np.testing.assert_array_equal(padded(rows, count), filled)


@pytest.mark.parametrize(
    ("observation", "expected"),
    [
        ({"pad": 3}, "pad needs `missing`"),
        ({"pad": 10**9, "missing": 0}, "less than or equal to 65536"),
        ({"pool": "min"}, "give both pool and to"),
        ({"to": 3}, "give both pool and to"),
        ({"pool": "min", "to": 3, "pad": 3, "missing": 0}, "give one of names, pad and pool"),
        ({"names": ["a", "b", "a"]}, "the name 'a' is given twice"),
        ({"names_from": "x"}, "names_from needs `names`"),
        ({"as": "count", "names": ["a"]}, "names is for a `field` without `as` only"),
        ({"missing": math.nan}, "missing: Input should be a finite number"),
        ({"missing": 1e39}, "missing: Input should be less than or equal to 3402"),
        ({"clip": [0, math.nan]}, "clip must be the lowest value"),
        ({"scale": math.inf}, "scale: Input should be a finite number"),
    ],
)
def test_impossible_elements_are_refused(observation: dict[str, Any], expected: str) -> None:
    with pytest.raises(UsageError, match=re.escape(expected)):
        mapping({"field": "/low.r", **observation})


def test_arrays_of_arrays_are_read_by_row(tmp_path: Path) -> None:
    for rows in ([[1, 2], [3, 4]], [[1, 2], [3]], [[[1]]]):
        path = write_json(tmp_path / "grid.mcap", [{"grid": rows, "command": 0}] * 3)
        with pytest.raises(UsageError, match=r"/low.grid is not a number, but an array of arrays"):
            read_bag(path, mapping({"field": "/low.grid"}))
    path = write_json(tmp_path / "grid.mcap", [{"grid": [[1, 2], [3]], "command": 0}] * 3)
    data = read_bag(path, mapping({"field": "/low.grid[0]"})).dataset
    assert data.frames.tolist() == [[1, 2]] * 3
    data = read_bag(path, mapping({"field": "/low.grid[1][0]"})).dataset
    assert data.frames.ravel().tolist() == [3] * 3
