"""Generated message types: definitions, encoded bytes and names."""

from __future__ import annotations

import math
import re
import struct
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import mcaprl
from mcaprl.errors import SpaceError
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.messages import EpisodeSummary
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.schema import (
    action_constants,
    image_dtype,
    is_intact,
    message_dtype,
    step_schema,
    telemetry_schema,
)
from mcaprl.recorder.format.spaces import observation_leaves
from tests.support.recordings import MIXED_SPACE, KnownCommands


def test_step_definition_by_hand() -> None:
    box = spaces.Box(-1, 1, (3,), np.float32)
    name, text = step_schema(box, spaces.Discrete(4))
    assert text.splitlines() == [
        "float64 reward",
        "int64 action",
        "float32[3] observation",
        "float32 behavior_prob",
        "uint32 episode",
        "uint32 step",
        "bool terminated",
        "bool truncated",
        "bool final",
    ]
    dtype = message_dtype(text)
    assert dtype is not None
    assert dtype.itemsize == 4 + 8 + 8 + 12 + 4 + 4 + 4 + 3
    assert is_intact(name, text.encode())
    assert not is_intact(name, text.replace("[3]", "[2]").encode())
    assert is_intact("other_msgs/msg/Step", b"anything")


def test_a_row_of_commands_by_hand(log_path: Path) -> None:
    """The bytes of two records: all fields in order, without padding."""
    with closing(mcaprl.RecordMcap(KnownCommands(), log_path, compression="none")) as env:
        env.reset()
        env.behavior_log_prob = -2.5
        env.step(np.array([0.5, 2], np.float32))
    reader = McapReader(log_path)
    (channel,) = reader.channels_of("/rl/step")
    assert reader.schema_of(channel).data.decode().splitlines() == [
        "float64 reward",
        "# steering (-1 right, 1 left)",
        "# speed (0 to 2.5 m/s)",
        "float32[2] action",
        "float32[2] observation",
        "float32 behavior_log_prob",
        "uint32 episode",
        "uint32 step",
        "bool terminated",
        "bool truncated",
        "bool final",
    ]
    with log_path.open("rb") as file:
        found = [m.data for _, _, m in make_reader(file).iter_messages(topics=["/rl/step"])]
    head, ends = bytes([0, 1, 0, 0]), [bytes([0, 1, 0]), bytes([0, 0, 1])]
    assert found == [
        head + struct.pack("<d2f2ff2I", 1, 0.5, 2, 0, 0, -2.5, 0, 0) + ends[0],
        head + struct.pack("<d2f2ff2I", 0, 0, 0, 0.25, 0.25, math.nan, 0, 1) + ends[1],
    ]


def test_the_column_depends_on_the_action_space() -> None:
    box = spaces.Box(-1, 1, (3,), np.float32)
    for action, name in (
        (spaces.Box(-1, 1, (2,), np.float64), "behavior_log_prob"),
        (spaces.Box(-1, 1, (), np.float16), "behavior_log_prob"),
        (spaces.Box(-1, 1, (2,), np.int64), "behavior_prob"),
        (spaces.MultiDiscrete([2, 3]), "behavior_prob"),
        (spaces.MultiBinary(3), "behavior_prob"),
    ):
        assert f"float32 {name}\n" in step_schema(box, action)[1]


@pytest.mark.parametrize(
    ("names", "units", "labels"),
    [
        (("a", "b"), (), ["a (-1 to 1)", "b (0 to 2.5)"]),
        (("a", "b"), ("m/s", ""), ["a (-1 to 1 m/s)", "b (0 to 2.5)"]),
        (("a", "b"), ("right | left", "x"), ["a (-1 right, 1 left)", "b (0 to 2.5 x)"]),
        (("a", "b"), ("m/s",), ["a (-1 to 1)", "b (0 to 2.5)"]),
        (("a", "b", "c"), (), []),
        ((), ("m/s", "m/s"), []),
    ],
)
def test_labels_have_bounds_and_units(
    names: tuple[str, ...], units: tuple[str, ...], labels: list[str]
) -> None:
    space = KnownCommands().action_space
    metadata = LogMetadata(space, space, action_part_names=names, action_units=units)
    assert list(metadata.action_labels()) == labels
    again = LogMetadata.from_strings(metadata.to_strings())
    assert (again.action_part_names, again.action_units) == (names, units)


def test_labels_without_finite_bounds_have_the_unit_alone() -> None:
    space = spaces.Box(np.array([-np.inf, -1]), np.array([1, np.inf]), dtype=np.float64)
    metadata = LogMetadata(space, space, action_part_names=("a", "b"), action_units=("m", ""))
    assert metadata.action_labels() == ("a (m)", "b")


def test_different_spaces_have_different_type_names() -> None:
    box, larger = (spaces.Box(-1, 1, (n,), np.float32) for n in (3, 4))
    assert step_schema(box, spaces.Discrete(4))[0] == step_schema(box, spaces.Discrete(5))[0]
    assert step_schema(box, spaces.Discrete(4))[0] != step_schema(larger, spaces.Discrete(4))[0]


def test_constants_name_the_discrete_actions() -> None:
    box = spaces.Box(-1, 1, (3,), np.float32)
    plain = step_schema(box, spaces.Discrete(3))
    name, text = step_schema(box, spaces.Discrete(3), {0: "brake", 1: "go (+x)", 2: "Go!"})
    assert text.splitlines()[1:5] == [
        "int64 BRAKE=0",
        "int64 GO=1",
        "int64 GO_2=2",
        "int64 action",
    ]
    assert name != plain[0]
    assert message_dtype(text) == message_dtype(plain[1])
    assert is_intact(name, text.encode())


@given(st.dictionaries(st.integers(-(2**31), 2**31), st.text(max_size=12), max_size=8))
def test_constants_are_distinct_names_of_ros(names: dict[int, str]) -> None:
    found = action_constants(names)
    assert all(re.fullmatch("[A-Z][A-Z0-9]*(_[A-Z0-9]+)*", word) for word in found)
    assert len(set(found.values())) == len(found)
    assert set(found.values()) <= set(names)


def test_numbers_are_no_names() -> None:
    assert action_constants({0: "0", 1: "1"}) == {}
    assert action_constants({0: "90 degrees", 1: "straße"}) == {
        "ACTION_90_DEGREES": 0,
        "STRASSE": 1,
    }


def test_field_names_of_dict_leaves() -> None:
    names = {leaf.path: leaf.name for leaf in observation_leaves(MIXED_SPACE)}
    assert names[("joints", "q")] == "observation_joints_q"
    assert names[("Ünïcode key!",)] == "observation_n_code_key"
    assert names[("camera",)] == "camera"
    doubled = spaces.Dict({"a b": spaces.Discrete(2), "a_b": spaces.Discrete(2)})
    assert [leaf.name for leaf in observation_leaves(doubled)] == [
        "observation_a_b",
        "observation_a_b_2",
    ]


def test_image_needs_size_and_uint8() -> None:
    cases = [
        ((84, 84, 1), np.uint8, "mono8"),
        ((84, 84), np.uint8, "mono8"),
        ((9, 8, 3), np.uint8, "rgb8"),
        ((9, 8, 4), np.uint8, "rgba8"),
        ((4, 84, 84), np.uint8, None),
        ((7, 84, 3), np.uint8, None),
        ((84, 84, 3), np.uint16, None),
    ]
    for shape, dtype, encoding in cases:
        (leaf,) = observation_leaves(spaces.Box(0, 255, shape, dtype))
        assert leaf.encoding == encoding, f"{shape} {dtype}"


FIELDS = {"float64": 8, "int64": 8, "float32": 4, "uint16": 2, "uint8": 1, "bool": 1}


@given(
    st.lists(st.tuples(st.sampled_from(list(FIELDS)), st.integers(0, 3)), min_size=1, max_size=8)
)
def test_fixed_length_messages_equal_those_of_rosbags(fields: list[tuple[str, int]]) -> None:
    """Encode fields in any order, and thus with padding; each field has a distinct value."""
    text = "".join(
        f"{kind}{f'[{count}]' if count else ''} f{number}\n"
        for number, (kind, count) in enumerate(fields)
    )
    dtype = message_dtype(text)
    assert dtype is not None
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, "any_msgs/msg/Any"))
    values: dict[str, Any] = {}
    ours = np.zeros((), dtype)
    ours["encapsulation"] = 0x0100
    for number, (kind, count) in enumerate(fields):
        one = number % 2
        values[f"f{number}"] = (
            np.full(count, one, kind) if count else (bool(one) if kind == "bool" else one)
        )
        ours[f"f{number}"] = one
    theirs = store.serialize_cdr(store.types["any_msgs/msg/Any"](**values), "any_msgs/msg/Any")
    assert ours.tobytes() == bytes(theirs)


@pytest.mark.parametrize("text", ["string name\n", "float32[] data\n", "geometry_msgs/Point p\n"])
def test_variable_length_types_have_no_dtype(text: str) -> None:
    assert message_dtype(text) is None


def test_comments_and_constants_take_no_bytes() -> None:
    dtype = message_dtype("# nothing\nuint8 A=1\nuint8 x # one byte\n\n")
    assert dtype is not None
    assert dtype.names == ("encapsulation", "x")
    assert dtype.itemsize == 5


@given(st.integers(1, 9), st.integers(1, 9), st.sampled_from(["a", "camera", "x/y_z"]))
def test_image_layout_equals_that_of_rosbags(height: int, width: int, frame: str) -> None:
    from mcaprl.recorder.format.schema import fill_image_constants

    dtype = image_dtype(height, width, 3, "rgb8", frame)
    ours = np.zeros(1, dtype)
    fill_image_constants(ours, height, width, "rgb8", frame)
    pixels = np.arange(height * width * 3, dtype=np.uint8)
    ours["sec"], ours["nanosec"], ours["data"] = 5, 7, pixels
    image = messages.new(
        "sensor_msgs/msg/Image",
        header=messages.header(5 * 10**9 + 7, frame),
        height=height,
        width=width,
        encoding="rgb8",
        is_bigendian=0,
        step=3 * width,
        data=pixels,
    )
    assert ours.tobytes() == messages.encode(image)


@pytest.mark.parametrize("name", ["Speed m/s", "2nd", "a__b", "a_", "größe"])
def test_telemetry_names_must_be_ros_field_names(name: str) -> None:
    with pytest.raises(SpaceError, match="not a ROS field name"):
        telemetry_schema(["speed_m_s", name])


@pytest.mark.parametrize(
    "text", ["float32 x\nfloat32 x\n", "float32[99999999999999999999] x\n", "uint8 encapsulation\n"]
)
def test_invalid_definitions_have_no_dtype(text: str) -> None:
    assert message_dtype(text) is None


def test_unsupported_spaces_are_refused() -> None:
    discrete = spaces.Discrete(2)
    cases = [
        (spaces.Tuple([discrete]), "observation is a Tuple space"),
        (spaces.Dict({"x": spaces.Graph(discrete, None)}), r"observation\['x'\] is a Graph space"),
        (spaces.Box(-1, 1, (0,)), "has no elements"),
        (spaces.Dict({}), "empty Dict"),
    ]
    for space, message in cases:
        with pytest.raises(SpaceError, match=message):
            step_schema(space, discrete)


def test_each_action_has_one_name() -> None:
    box = spaces.Box(-1, 1, (2,), np.float32)

    def names(space: spaces.Space[Any], *meanings: str) -> dict[int, str]:
        return LogMetadata(box, space, action_meanings=meanings).action_names()

    assert names(spaces.Discrete(2, start=5), "left", "right") == {5: "left", 6: "right"}
    assert names(spaces.Discrete(2), "left", "left") == {0: "0", 1: "1"}
    assert names(spaces.Discrete(2), "left") == {0: "0", 1: "1"}
    assert names(box, "left") == {}


@given(
    st.text(max_size=9),
    st.text(max_size=9),
    st.text(max_size=9),
    st.integers(0, 2**62),
    st.none() | st.integers(0, 2**62),
)
def test_episode_messages_equal_those_of_rosbags(
    reason: str, policy: str, options: str, time_ns: int, seed: int | None
) -> None:
    summary = EpisodeSummary(
        7, 9, -2.5, True, False, time_ns, time_ns + 9, reason, policy, 0.25, seed, options
    )
    fields = {**summary._asdict(), "seed": -1 if seed is None else seed}
    episode = messages.new(messages.EPISODE_TYPE, **fields)
    assert summary.to_message() == messages.encode(episode)
    line = messages.new(
        messages.LOG_TYPE,
        stamp=messages.stamp(time_ns % 2**60),
        level=20,
        name="mcaprl",
        msg=reason,
        file="",
        function="",
        line=0,
    )
    assert messages.log_message(time_ns % 2**60, reason) == messages.encode(line)
