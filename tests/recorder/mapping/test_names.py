"""Elements that are selected by name, whatever their order and publisher."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mcaprl.errors import UsageError
from mcaprl.recorder.bags.values import names_of
from mcaprl.recorder.mapping.config import parse_mapping
from mcaprl.recorder.mapping.read import read_bag, read_open_bag
from tests.support.memory_bag import MemoryBag
from tests.support.nested_bags import FORMATS, motors, write_json

# The order of the names changes, and the gripper is in other messages than the arm.
ORDERS = [
    {"joint_names": ["a", "b"], "position": [1.0, 2.0], "motors": motors(("a", 1), ("b", 2))},
    {"joint_names": ["g"], "position": [30.0], "motors": motors(("g", 30))},
    {"joint_names": ["b", "a"], "position": [20.0, 10.0], "motors": motors(("b", 20), ("a", 10))},
    {"joint_names": ["g"], "position": [31.0], "motors": motors(("g", 31))},
    {"joint_names": ["a", "b"], "position": [3.0, 4.0], "motors": motors(("a", 3), ("b", 4))},
]


def mapping(observation: dict[str, Any], **parts: Any) -> Any:
    return parse_mapping(
        {
            "clock": {"topic": "/low"},
            "observation": {"q": observation},
            "action": {"field": "/low.command"},
            **parts,
        }
    )


@pytest.fixture(scope="module", params=FORMATS)
def bag(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    messages = [{**message, "command": 0.0} for message in ORDERS]
    return FORMATS[request.param](tmp_path_factory.mktemp("named"), messages)


@pytest.mark.parametrize("field", ["/low.position", "/low.motors[:].q", "/low.motors.q"])
def test_each_element_is_that_of_the_last_message_with_its_name(bag: Path, field: str) -> None:
    by_name = {"field": field, "names": ["g", "a", "b"]}
    found = read_bag(bag, mapping(by_name))
    # No message has the gripper before the second one.
    assert found.dataset.frames.tolist() == [[30, 1, 2], [30, 10, 20], [31, 10, 20], [31, 3, 4]]
    assert found.dataset.observation_names == ("q_g", "q_a", "q_b")
    assert found.report.fields["q"].missing == pytest.approx(0.2)
    # The oldest of the three elements is from the message before, or of this time.
    assert found.report.fields["q"].max_age_s == 1
    one = read_bag(bag, mapping({"field": field, "names": "a"}, reward="next(q) - q")).dataset
    assert one.observations.ravel().tolist() == [1, 1, 10, 10]
    assert one.rewards.tolist() == [0, 9, 0, -7]


def test_the_age_is_that_of_the_oldest_element(bag: Path) -> None:
    by_name = {"field": "/low.position", "names": ["a", "g"], "tolerance_s": 0.5, "missing": -1}
    data = read_bag(bag, mapping(by_name)).dataset
    assert data.frames.tolist() == [[1, -1], [-1, 30], [10, -1], [-1, 31], [3, -1]]


@pytest.mark.parametrize(
    "field",
    [
        "/low.position",
        "/low.position[0]",
        "/low.position[0:1]",
        "/low.motors[0].q",
        "/low.motors.q",
    ],
)
def test_names_that_change_are_refused(bag: Path, field: str) -> None:
    with pytest.raises(UsageError) as error:
        read_bag(bag, mapping({"field": field}))
    assert f"observation.q: {field}".replace("motors.q", "motors") in str(error.value)
    assert "the names of the elements change: [a" in str(error.value)
    assert "[g] in message 1: select them by `names: [a" in str(error.value)
    action = {"fields": [field], "box": {"low": -1, "high": 1}}
    with pytest.raises(UsageError, match=r"action: .* the names of the elements change"):
        read_bag(bag, mapping({"field": "/low.command"}, action=action))


def test_positions_are_used_if_the_mapping_says_so(bag: Path) -> None:
    data = read_bag(bag, mapping({"field": "/low.position[0]", "names": []})).dataset
    assert data.frames.ravel().tolist() == [1, 30, 20, 31, 3]


def test_commands_are_selected_by_name(bag: Path) -> None:
    action = {"fields": ["/low.position"], "names": ["b", "g"], "edges": [[10], [30.5]]}
    data = read_bag(bag, mapping({"field": "/low.command"}, action=action)).dataset
    assert data.actions.tolist() == [0, 2, 3]
    assert data.action_names[2] == "b from 10 and g below 30.5"
    action = {"fields": ["/low.position"], "names": ["b", "g"], "box": {"low": 0, "high": 99}}
    data = read_bag(bag, mapping({"field": "/low.command"}, action=action)).dataset
    assert data.action_labels == ("b (0 to 99)", "g (0 to 99)")


def test_unknown_names_list_the_nearest(bag: Path) -> None:
    with pytest.raises(UsageError, match=r"no message has an element 'aa'; nearest: a"):
        read_bag(bag, mapping({"field": "/low.position", "names": ["aa"]}))
    with pytest.raises(UsageError, match=r"no (message has an element|names)|has no names beside"):
        read_bag(bag, mapping({"field": "/low.ranges", "names": ["a"]}))
    with pytest.raises(UsageError, match="`names` selects the elements; remove the index"):
        read_bag(bag, mapping({"field": "/low.position[0]", "names": ["a"]}))


def test_names_may_be_in_another_field(bag: Path) -> None:
    by_name = {"field": "/low.position", "names": ["a"], "names_from": "motors[:].name"}
    data = read_bag(bag, mapping(by_name)).dataset
    assert data.frames.ravel().tolist() == [1, 1, 10, 10, 3]


def test_constant_names_need_no_selection(bag: Path) -> None:
    # The gripper has the name `g` in both of its messages.
    times = [0, 1, 2]
    columns = {"name": [["a", "b"]] * 3, "position": [[1.0, 2.0]] * 3, "command": [0.0] * 3}
    kinds = {"/low.name": "string[]", "/low.position": "float64[]"}
    data = read_open_bag(
        MemoryBag({"/low": (times, columns)}, kinds), mapping({"field": "/low.position"})
    ).dataset
    assert data.frames.tolist() == [[1, 2]] * 3
    assert data.observation_names == ("q_0", "q_1")


def test_a_name_twice_in_a_message_is_refused() -> None:
    columns = {"name": [["a", "a"]] * 3, "position": [[1.0, 2.0]] * 3, "command": [0.0] * 3}
    kinds = {"/low.name": "string[]", "/low.position": "float64[]"}
    bag = MemoryBag({"/low": ([0, 1, 2], columns)}, kinds)
    with pytest.raises(UsageError, match="message 0 has the name 'a' twice"):
        read_open_bag(bag, mapping({"field": "/low.position", "names": ["a"]}))


DYNAMIC = {
    "joint_names": ["hip", "knee"],
    "interface_values": [
        {"interface_names": ["position", "effort"], "values": [1.0, 2.0]},
        {"interface_names": ["effort"], "values": [3.0]},
    ],
    "command": 0.0,
}


def test_names_of_arrays_in_arrays_are_joined(tmp_path: Path) -> None:
    turned = {
        "joint_names": ["knee", "hip"],
        "interface_values": [
            {"interface_names": ["effort"], "values": [30.0]},
            {"interface_names": ["effort", "position"], "values": [20.0, 10.0]},
        ],
        "command": 0.0,
    }
    path = write_json(tmp_path / "dynamic.mcap", [DYNAMIC, turned, DYNAMIC])
    field = "/low.interface_values[:].values"
    by_name = {"field": field, "names": ["hip/position", "knee/effort"]}
    data = read_bag(path, mapping(by_name)).dataset
    assert data.frames.tolist() == [[1, 3], [10, 30], [1, 3]]
    assert data.observation_names == ("q_hip/position", "q_knee/effort")
    with pytest.raises(UsageError, match=re.escape("[hip/position, hip/effort, knee/effort] in")):
        read_bag(path, mapping({"field": field}))


@pytest.mark.parametrize(
    ("message", "path", "expected"),
    [
        (DYNAMIC, "interface_values[1].values", ["effort"]),
        (DYNAMIC, "interface_values[:].values", ["hip/position", "hip/effort", "knee/effort"]),
        ({"names": ["a", "b"], "v": [1, 2]}, "v[1]", ["b"]),
        ({"names": ["a", "b"], "v": [1, 2]}, "v[0:1]", ["a"]),
        ({"names": ["a", "b"], "v": [1, 2, 3]}, "v", None),
        ({"items": [{"name": "a", "v": 1}, {"name": "b", "v": 2}]}, "items[1:].v", ["b"]),
        ({"items": [{"key": "a", "value": 1}]}, "items.value", ["a"]),
        ({"items": [{"v": 1}]}, "items[:].v", None),
        ({"joint_names": ["a", "b"], "points": [{"p": [1, 2]}]}, "points[0].p", ["a", "b"]),
        ({"joint_names": ["a"], "points": [{"p": [1]}, {"p": [2]}]}, "points[1].p", ["a"]),
        ({"name": ["a"], "pose": [{"x": 1}]}, "pose[:].x", ["a"]),
        ({"name": ["a"], "v": 1}, "v", None),
        ({"name": ["a"]}, "v[3].x", None),
        ({"name": "a", "v": [1]}, "v", None),
    ],
)
def test_names_by_convention(message: Any, path: str, expected: list[str] | None) -> None:
    assert names_of(message, path) == expected


def test_an_element_that_omits_its_value_keeps_the_last_one(tmp_path: Path) -> None:
    messages: list[dict[str, Any]] = [
        {"items": [{"name": "a", "v": 1}, {"name": "b", "v": 2}], "command": 0},
        {"items": [{"name": "b", "v": None}, {"name": "a"}], "command": 0},
        {"items": [], "command": 0},
        {"command": 0},
        {"items": [{"name": "b", "v": 3}], "command": 0},
    ]
    path = write_json(tmp_path / "items.mcap", messages)
    by_name = {"field": "/low.items[:].v", "names": ["b", "a"], "missing": -1}
    data = read_bag(path, mapping(by_name)).dataset
    assert data.frames.tolist() == [[2, 1], [-1, 1], [-1, 1], [-1, 1], [3, 1]]


def test_an_element_of_nan_is_missing() -> None:
    columns = {
        "name": [["a", "b"], ["b"], ["a", "b"]],
        "position": [[1.0, math.nan], [5.0], [2.0, 6.0]],
        "command": [0.0] * 3,
    }
    kinds = {"/low.name": "string[]", "/low.position": "float64[]"}
    bag = MemoryBag({"/low": ([0, 1, 2], columns)}, kinds)
    by_name = {"field": "/low.position", "names": ["a", "b"], "missing": -1}
    data = read_open_bag(bag, mapping(by_name)).dataset
    np.testing.assert_array_equal(data.frames, [[1, -1], [1, 5], [2, 6]])
    by_name = {"field": "/low.position", "names": ["a"], "align": "linear"}
    data = read_open_bag(bag, mapping(by_name)).dataset
    assert data.frames.ravel().tolist() == [1, 1.5, 2]
