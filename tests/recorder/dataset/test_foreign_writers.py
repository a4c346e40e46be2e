"""Logs of other writers: all code paths of the reader return the same values."""

from __future__ import annotations

import importlib.util
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer

import mcaprl
from mcaprl.errors import CorruptLogError, LogError
from mcaprl.recorder.columns.cdr import MessageType
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.topic import Topic
from tests.conftest import need
from tests.support.foreign_logs import (
    MCAP_OPTIONS,
    PLAIN,
    VARIABLE,
    Codec,
    Steps,
    plain_messages,
    steps_of,
    variable_messages,
    write_with_foxglove,
    write_with_mcap,
    write_with_rosbags,
)
from tests.support.recordings import assert_same_bits

LENGTHS = [7, 1, 30, 12]
STEPS = steps_of(LENGTHS)
TEXTS = {
    "one-length": lambda row: "gripper",
    "some-lengths": lambda row: "ab" * (row % 3),
    "many-lengths": lambda row: "x" * row,
}


def assert_reads(path: Path, steps: Steps = STEPS, *, lengths: list[int] = LENGTHS) -> None:
    """Check that the file contains these transitions, and that its spaces contain them."""
    data = mcaprl.open(path)
    fields, actual = steps.fields, steps.actual
    following = np.roll(actual, 1)
    assert [episode.length for episode in data.episodes] == lengths
    assert_same_bits(data.rewards, fields["reward"][actual])
    assert_same_bits(data.actions, fields["action"][actual])
    assert_same_bits(data.observations, fields["observation"][actual])
    assert_same_bits(data.next_observations, fields["observation"][following])
    assert_same_bits(data.terminated, fields["terminated"][actual])
    times = np.concatenate([episode.log_time_ns for episode in data.episodes])
    assert_same_bits(times, steps.times)
    assert data.observation_space == spaces.Box(-np.inf, np.inf, (3,), np.float32)
    assert data.action_space == spaces.Discrete(5)


@pytest.mark.parametrize("options", MCAP_OPTIONS.values(), ids=MCAP_OPTIONS)
@pytest.mark.parametrize("noise", [True, False], ids=["interleaved", "alone"])
def test_mcap_writer(log_path: Path, options: dict[str, Any], noise: bool) -> None:
    write_with_mcap(log_path, plain_messages(STEPS), noise=noise, **options)
    assert_reads(log_path)
    assert np.all(mcaprl.open(log_path).behavior_probs == 0.25)


@pytest.mark.parametrize("text_of", TEXTS.values(), ids=TEXTS)
@pytest.mark.parametrize("big_endian", [False, True], ids=["little", "big"])
def test_variable_messages(log_path: Path, text_of: Any, big_endian: bool) -> None:
    messages = variable_messages(STEPS, text_of, big_endian=big_endian)
    write_with_mcap(log_path, messages, VARIABLE)
    assert_reads(log_path)
    assert np.isnan(mcaprl.open(log_path).behavior_probs).all(), "not reported"


def test_big_endian(log_path: Path) -> None:
    big, little = plain_messages(STEPS, big_endian=True), plain_messages(STEPS)
    write_with_mcap(log_path, big)
    assert_reads(log_path)
    mixed = [(big, little)[row % 2][row] for row in range(len(big))]
    write_with_mcap(log_path, mixed)
    assert_reads(log_path)


def test_padded_payloads(log_path: Path) -> None:
    messages = plain_messages(STEPS)
    write_with_mcap(log_path, [(time, data + b"\0" * 3) for time, data in messages])
    assert_reads(log_path)
    padded = [(time, data + b"\0" * (row % 4)) for row, (time, data) in enumerate(messages)]
    write_with_mcap(log_path, padded)
    assert_reads(log_path)


@pytest.mark.parametrize("wrong", [b"\0" * 4, b""], ids=["too-long", "too-short"])
def test_messages_that_contradict_their_schema(log_path: Path, wrong: bytes) -> None:
    messages = plain_messages(STEPS)
    time_ns, data = messages[5]
    messages[5] = (time_ns, data + wrong if wrong else data[:-4])
    write_with_mcap(log_path, messages)
    with pytest.raises(
        CorruptLogError, match=r"/rl/step at log_time .*: cannot decode .* as robot_msgs"
    ):
        mcaprl.open(log_path)


def test_other_encapsulations_are_refused(log_path: Path) -> None:
    xcdr2 = [(time_ns, b"\0\7" + data[2:]) for time_ns, data in plain_messages(STEPS)]
    write_with_mcap(log_path, xcdr2)
    with pytest.raises(CorruptLogError, match="encapsulation"):
        mcaprl.open(log_path)


def test_messages_out_of_order(log_path: Path) -> None:
    messages = plain_messages(STEPS)
    order = np.random.default_rng(0).permutation(len(messages)).tolist()
    write_with_mcap(log_path, [messages[row] for row in order])
    assert_reads(log_path)


def test_two_channels_of_one_topic(log_path: Path) -> None:
    write_with_mcap(log_path, plain_messages(STEPS), channels=lambda row: row % 2)
    assert len(McapReader(log_path).channels_of("/rl/step")) == 2
    assert_reads(log_path)


def test_two_robots_record_at_the_same_time(log_path: Path) -> None:
    """Read the episodes of one channel after those of another channel with the same times."""
    first, second = steps_of([4, 5]), steps_of([6, 3], seed=1)
    pairs = zip(plain_messages(first), plain_messages(second), strict=True)
    write_with_mcap(log_path, [m for pair in pairs for m in pair], channels=lambda row: row % 2)
    both = Steps(
        {name: np.concatenate([first.fields[name], second.fields[name]]) for name in first.fields},
        np.concatenate([first.times, second.times]),
    )
    assert_reads(log_path, both, lengths=[4, 5, 6, 3])


def test_two_channels_of_different_types(log_path: Path) -> None:
    """Read two channels whose fields have a different order; each has its own definition."""
    lines = PLAIN.splitlines(keepends=True)
    swapped = "".join([lines[1], lines[0], *lines[2:4], lines[5], lines[4], *lines[6:]])
    codecs = [Codec(PLAIN), Codec(swapped)]
    writer = Writer(str(log_path))
    writer.start("ros2")
    channels = []
    for codec in codecs:
        schema = writer.register_schema("robot_msgs/msg/Transition", "ros2msg", codec.text.encode())
        channels.append(writer.register_channel("/rl/step", "cdr", schema))
    for row, (time_ns, fields) in enumerate(STEPS.rows()):
        data = codecs[row % 2].encode(**fields)
        writer.add_message(channels[row % 2], time_ns, data, time_ns)
    writer.finish()
    assert_reads(log_path)


@pytest.mark.parametrize("messages", ["plain", "variable"])
def test_rosbags_writer(tmp_path: Path, messages: str) -> None:
    if messages == "plain":
        path = write_with_rosbags(tmp_path / "bag", plain_messages(STEPS))
    else:
        variable = variable_messages(STEPS, TEXTS["some-lengths"])
        path = write_with_rosbags(tmp_path / "bag", variable, VARIABLE)
    assert_reads(path)


@pytest.mark.parametrize("messages", ["plain", "variable"])
def test_foxglove_writer(log_path: Path, messages: str) -> None:
    need(importlib.util.find_spec("foxglove") is not None, "foxglove-sdk is not installed")
    if messages == "plain":
        write_with_foxglove(log_path, plain_messages(STEPS))
    else:
        write_with_foxglove(log_path, variable_messages(STEPS, TEXTS["many-lengths"]), VARIABLE)
    assert_reads(log_path)


def test_images_of_another_writer(log_path: Path) -> None:
    """Read a log with more images than records, and with a frame_id that changes in length."""
    from mcaprl.recorder.format import messages

    writer = Writer(str(log_path), chunk_size=3000)
    writer.start("ros2")
    schema = writer.register_schema("robot_msgs/msg/Transition", "ros2msg", PLAIN.encode())
    step = writer.register_channel("/rl/step", "cdr", schema)
    text = messages.definition("sensor_msgs/msg/Image")
    schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", text.encode())
    camera = writer.register_channel("/rl/observation/front", "cdr", schema)
    images = np.random.default_rng(0).integers(0, 256, (len(STEPS.times), 9, 11, 3), np.uint8)
    for (time_ns, data), image in zip(plain_messages(STEPS), images, strict=True):
        for late in (0, 5):
            message = messages.new(
                "sensor_msgs/msg/Image",
                header=messages.header(time_ns, "cam" * (1 + time_ns // 10**6 % 2)),
                height=9,
                width=11,
                encoding="rgb8",
                is_bigendian=0,
                step=33,
                data=(image + late).ravel(),
            )
            writer.add_message(camera, time_ns + late, messages.encode(message), time_ns)
        writer.add_message(step, time_ns, data, time_ns)
    writer.finish()
    found = mcaprl.open(log_path)
    assert isinstance(found.observation_space, spaces.Dict)
    assert found.observation_space["front"] == spaces.Box(0, 255, (9, 11, 3), np.uint8)
    assert_same_bits(found.observations["front"], images[STEPS.actual])
    assert_same_bits(found.observations["state"], STEPS.fields["observation"][STEPS.actual])


def test_an_image_topic_without_messages_is_reported(log_path: Path) -> None:
    from mcaprl.recorder.format import messages

    writer = Writer(str(log_path))
    writer.start("ros2")
    schema = writer.register_schema("robot_msgs/msg/Transition", "ros2msg", PLAIN.encode())
    step = writer.register_channel("/rl/step", "cdr", schema)
    text = messages.definition("sensor_msgs/msg/Image")
    schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", text.encode())
    writer.register_channel("/rl/observation/front", "cdr", schema)
    for time_ns, data in plain_messages(STEPS):
        writer.add_message(step, time_ns, data, time_ns)
    writer.finish()
    with pytest.raises(LogError, match="no images on /rl/observation/front"):
        mcaprl.open(log_path)


def test_missing_fields_are_reported(log_path: Path) -> None:
    text = PLAIN.replace("bool final\n", "").replace("float64 reward\n", "")
    codec = Codec(text)
    messages = [
        (time_ns, codec.encode(**{name: fields[name] for name in codec.fields}))
        for time_ns, fields in STEPS.rows()
    ]
    write_with_mcap(log_path, messages, text)
    with pytest.raises(LogError, match=r"/rl/step has no field reward, final"):
        mcaprl.open(log_path)


def test_no_observation(log_path: Path) -> None:
    text = PLAIN.replace("float32[3] observation\n", "")
    codec = Codec(text)
    messages = [
        (time_ns, codec.encode(**{name: fields[name] for name in codec.fields}))
        for time_ns, fields in STEPS.rows()
    ]
    write_with_mcap(log_path, messages, text)
    with pytest.raises(LogError, match=r"no field observation, and there are no images"):
        mcaprl.open(log_path)


def test_float32_rewards_are_summed_in_float64(log_path: Path) -> None:
    """Add rewards that float32 cannot add exactly: 2**24 + 1 would be 2**24."""
    text = PLAIN.replace("float64 reward", "float32 reward")
    codec, steps = Codec(text), steps_of([3])
    steps.fields["reward"] = np.array([2**24, 1, 1, 0], np.float32)
    messages = [(time_ns, codec.encode(**fields)) for time_ns, fields in steps.rows()]
    write_with_mcap(log_path, messages, text)
    assert mcaprl.open(log_path).episodes[0].total_reward == 2**24 + 2


def test_observations_of_several_lengths(log_path: Path) -> None:
    text = PLAIN.replace("float32[3]", "float32[]")
    codec = Codec(text)
    messages = [
        (time_ns, codec.encode(**{**fields, "observation": fields["observation"][: 3 - row // 20]}))
        for row, (time_ns, fields) in enumerate(STEPS.rows())
    ]
    write_with_mcap(log_path, messages, text)
    with pytest.raises(LogError, match=r"observation of /rl/step has shape \(2,\) at log_time"):
        mcaprl.open(log_path)


@pytest.mark.parametrize(
    ("message_encoding", "schema_encoding", "reported"),
    [
        ("json", "jsonschema", "messages of /rl/step have encoding 'json'"),
        ("cdr", "omgidl", "'omgidl'"),
    ],
)
def test_other_encodings(
    log_path: Path, message_encoding: str, schema_encoding: str, reported: str
) -> None:
    writer = Writer(str(log_path))
    writer.start()
    schema = writer.register_schema("Step", schema_encoding, b"{}")
    channel = writer.register_channel("/rl/step", message_encoding, schema)
    writer.add_message(channel, 0, b"{}", 0)
    writer.finish()
    with pytest.raises(LogError, match=reported):
        mcaprl.open(log_path)


NUMBERS = ["float64", "float32", "int64", "uint32", "int16", "uint8", "bool"]


@st.composite
def types_and_messages(draw: st.DrawFn) -> tuple[str, list[str], list[dict[str, Any]]]:
    """Generate a type of numbers, arrays, lists and strings, and messages of this type."""
    kinds = draw(st.lists(st.sampled_from([*NUMBERS, "string"]), min_size=1, max_size=8))
    shapes = [
        "" if kind == "string" else draw(st.sampled_from(["", "[3]", "[]", "[<=4]"]))
        for kind in kinds
    ]
    names = [f"f{number}" for number in range(len(kinds))]
    text = "".join(f"{k}{s} {n}\n" for k, s, n in zip(kinds, shapes, names, strict=True))
    counts = {name: draw(st.integers(0, 4)) for name in names}
    seed, several = draw(st.integers(0, 2**32)), draw(st.booleans())
    random = np.random.default_rng(seed)
    messages = []
    for _ in range(draw(st.integers(1, 6))):
        fields: dict[str, Any] = {}
        for kind, shape, name in zip(kinds, shapes, names, strict=True):
            if kind == "string":
                fields[name] = "é" * (int(random.integers(4)) if several else counts[name])
                continue
            dtype = np.dtype(kind)
            count = {"": 1, "[3]": 3}.get(shape, counts[name])
            values = np.frombuffer(random.bytes(count * dtype.itemsize), f"u{dtype.itemsize}")
            values = values % 2 == 1 if kind == "bool" else values.view(dtype)
            fields[name] = values if shape else values[0].item()
        messages.append(fields)
    return text, names, messages


@given(types_and_messages(), st.booleans(), st.integers(0, 3))
def test_columns_equal_what_rosbags_decodes(
    tmp_path_factory: pytest.TempPathFactory,
    drawn: tuple[str, list[str], list[dict[str, Any]]],
    big_endian: bool,
    padding: int,
) -> None:
    """The fast path and rosbags return the same bits for any type and byte order."""
    text, names, fields = drawn
    codec = Codec(text)
    encoded = [codec.encode(big_endian=big_endian, **f) + b"\0" * padding for f in fields]
    path = tmp_path_factory.getbasetemp() / "any.mcap"
    write_with_mcap(path, [(row, data) for row, data in enumerate(encoded)], text)
    columns = Topic(McapReader(path), "/rl/step").read(names)
    known = MessageType("robot_msgs/msg/Transition", text)
    for row, data in enumerate(encoded):
        message = known.decode(data)
        for name in names:
            expected = getattr(message, name)
            if isinstance(expected, str):
                assert columns[name][row] == expected == fields[row][name]
            else:
                assert_same_bits(columns[name][row], np.asarray(expected, columns[name].dtype))


@given(types_and_messages(), st.booleans())
def test_a_layout_is_found_for_every_message(
    drawn: tuple[str, list[str], list[dict[str, Any]]], big_endian: bool
) -> None:
    text, names, fields = drawn
    codec, known = Codec(text), MessageType("robot_msgs/msg/Transition", text)
    data = codec.encode(big_endian=big_endian, **fields[0])
    layout = known.layout(data, names)
    assert layout is not None
    assert layout.dtype.itemsize == len(data)
    assert layout.fits(np.frombuffer(data, layout.dtype))
    assert layout.dtype.fields is not None
    offsets = [layout.dtype.fields[name][1] for name in names]
    assert all(low <= high for low, high in pairwise(offsets))
