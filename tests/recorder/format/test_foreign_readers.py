"""Other libraries read our logs and return the same values as our reader."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from mcap.reader import NonSeekingReader, SeekingReader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

import mcaprl
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.format.messages import EpisodeSummary
from mcaprl.recorder.format.schema import stored_dtype
from mcaprl.recorder.format.spaces import observation_leaves
from mcaprl.recorder.viewer.annotate import annotated_copy
from mcaprl.recorder.viewer.playback import moments_of_episode
from mcaprl.sims import make_sim
from tests.conftest import need
from tests.support.paths import NODE
from tests.support.recordings import MIXED_SPACE, KnownCommands, leaves_of, record

Messages = dict[str, list[tuple[int, Any]]]


_COMMANDS = spaces.Box(-1, 1, (2, 2), np.float64)


@pytest.fixture(
    scope="module",
    params=[*((name, spaces.Discrete(5)) for name in ("zstd", "lz4", "none")), ("zstd", _COMMANDS)],
    ids=["zstd", "lz4", "none", "densities"],
)
def log(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record two image topics, and vectors of all dtypes with NaN and infinity.

    Each topic has several chunks.
    """
    path = tmp_path_factory.mktemp("foreign") / "log.mcap"
    compression, actions = request.param
    record(path, MIXED_SPACE, actions, [120, 1, 33], compression=compression)
    return path


def ours(path: Path) -> dict[str, dict[str, np.ndarray[Any, Any]]]:
    """Read each topic with our reader, as one array per field."""
    dataset = mcaprl.open(path)
    leaves = observation_leaves(dataset.observation_space)
    topics: dict[str, dict[str, np.ndarray[Any, Any]]] = {}
    step: dict[str, list[Any]] = defaultdict(list)
    images: dict[str, list[Any]] = defaultdict(list)
    for episode in dataset.episodes:
        last = episode.length
        for row in range(last + 1):
            final = row == last
            source = episode.next_observations if final else episode.observations
            index = row - 1 if final else row
            for leaf, array in zip(leaves, leaves_of(source), strict=True):
                (images if leaf.encoding else step)[leaf.name].append(array[index])
            step["reward"].append(0.0 if final else episode.rewards[row])
            action = episode.actions[index]
            step["action"].append(np.zeros_like(action) if final else action)
            step[dataset.behavior_field.name].append(np.nan if final else episode.behavior[row])
            step["terminated"].append(not final and episode.terminated[row])
            step["truncated"].append(not final and episode.truncated[row])
            step["final"].append(final)
            step["episode"].append(episode.index)
            step["step"].append(row)
    topics["/rl/step"] = {name: np.array(values) for name, values in step.items()}
    for leaf in leaves:
        if leaf.encoding:
            topics[leaf.topic] = {"data": np.array(images[leaf.name])}
    summaries = [episode.summary._asdict() for episode in dataset.episodes]
    topics["/rl/episode"] = {
        name: np.array([summary[name] for summary in summaries]) for name in EpisodeSummary._fields
    }
    return topics


def by_mcap_indexed(path: Path) -> Messages:
    with path.open("rb") as file:
        return _by_mcap(
            SeekingReader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        )


def by_mcap_streaming(path: Path) -> Messages:
    with path.open("rb") as file:
        reader = NonSeekingReader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return _by_mcap(reader)


def _by_mcap(reader: SeekingReader | NonSeekingReader) -> Messages:
    messages: Messages = defaultdict(list)
    for _, channel, message, decoded in reader.iter_decoded_messages():
        messages[channel.topic].append((message.log_time, decoded))
    return messages


def by_rosbags(path: Path) -> Messages:
    messages: Messages = defaultdict(list)
    with AnyReader([path]) as bag:
        for connection, time_ns, data in bag.messages():
            decoded = bag.deserialize(data, connection.msgtype)
            messages[connection.topic].append((time_ns, decoded))
    return messages


def node_lines(script: str, path: Path) -> list[Any]:
    """Return the JSON lines that a script in `tests/node` prints for a log."""
    need(shutil.which("node") is not None, "Node is not installed")
    need((NODE / "node_modules").is_dir(), "packages of tests/node are not installed: npm ci")
    command = ["node", str(NODE / script), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def by_node(path: Path) -> Messages:
    messages: Messages = defaultdict(list)
    for found in node_lines("dump.mjs", path):
        messages[found["topic"]].append((int(found["logTime"]), found["value"]))
    return messages


READERS = [by_mcap_indexed, by_mcap_streaming, by_rosbags, by_node]


@pytest.mark.parametrize("read", READERS)
def test_every_reader_returns_the_recorded_values(
    log: Path, read: Callable[[Path], Messages]
) -> None:
    found, expected = read(log), ours(log)
    for topic, fields in expected.items():
        for name, column in fields.items():
            values = [_field(message, name) for _, message in found[topic]]
            _assert_equal(values, column, f"{topic}.{name}")
    times = {topic: [time for time, _ in messages] for topic, messages in found.items()}
    for topic in expected:
        assert (np.diff(times[topic]) > 0).all(), f"log_time of {topic} does not rise"
        if topic != "/rl/episode":
            assert times[topic] == times["/rl/step"]


@pytest.mark.parametrize("read", READERS)
def test_names_of_the_parts_of_an_action_are_comments(
    read: Callable[[Path], Messages], tmp_path: Path
) -> None:
    env = KnownCommands()
    env.action_part_names, env.action_units = ("Lenkung \u00e4\n", "speed"), ("right | left", "m/s")
    path = tmp_path / "commands.mcap"
    with closing(mcaprl.RecordMcap(env, path)) as recorder:
        recorder.reset()
        recorder.behavior_log_prob = 7.25
        recorder.step(np.array([0.5, 2], np.float32))
        recorder.step(np.array([-1, 0], np.float32))
    reader = McapReader(path)
    text = reader.schema_of(reader.channels_of("/rl/step")[0]).data.decode()
    assert "# Lenkung ? (-1 right, 1 left)\n# speed (0 to 2.5 m/s)\nfloat32[2] action\n" in text
    steps = [message for _, message in read(path)["/rl/step"]]
    assert [list(_field(step, "action")) for step in steps] == [[0.5, 2], [-1, 0], [0, 0]]
    densities = [float(_field(step, "behavior_log_prob")) for step in steps]
    np.testing.assert_array_equal(densities, [7.25, np.nan, np.nan])


@pytest.fixture(scope="module")
def scene_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record the lane sim with its scene."""
    path = tmp_path_factory.mktemp("foreign") / "lane.mcap"
    with closing(mcaprl.RecordMcap(make_sim("lane"), path)) as env:
        env.reset(seed=0)
        for _ in range(3):
            env.step(1)
    return path


def test_viewers_find_the_names_of_the_actions(scene_log: Path, tmp_path: Path) -> None:
    annotated = tmp_path / "annotated.mcap"
    values: dict[str, Any] = {"q": np.zeros((3, 6)), "preference": np.full((3, 6), 1 / 6)}
    values |= {name: np.zeros(3) for name in ("value", "advantage", "td_error", "entropy")}
    values |= {"policy_action": np.zeros(3, np.int64), "agrees": np.zeros(3, bool)}
    with annotated_copy(scene_log, annotated) as copy:
        copy.add_values(
            "/rl/values", [(mcaprl.open(scene_log).episodes[0].log_time_ns[:-1], values)]
        )
    actions = [["BRAKE", 0], ["STRAIGHT", 1], ["RIGHT", 2], ["LEFT", 3]]
    actions += [["SLIGHTLY_RIGHT", 4], ["SLIGHTLY_LEFT", 5]]
    found = {each["topic"]: each["constants"] for each in node_lines("constants.mjs", annotated)}
    assert found["/rl/step"] == found["/rl/values"] == actions
    assert not mcaprl.check(annotated).problems


@pytest.mark.parametrize("read", READERS)
def test_markers_and_frames_pass_through(scene_log: Path, read: Callable[[Path], Messages]) -> None:
    found = read(scene_log)
    (episode,) = mcaprl.open(scene_log).episodes
    moments = list(moments_of_episode(McapReader(scene_log), episode))
    assert [time for time, _ in found["/scene"]] == episode.log_time_ns.tolist()
    for topic, parts in (("/scene", "moving"), ("/scene/static", "static")):
        for (_, array), moment in zip(found[topic], moments, strict=False):
            shapes = {shape.name: shape for shape in getattr(moment, parts)}
            markers = {_field(m, "ns"): m for m in _field(array, "markers") if _field(m, "ns")}
            assert markers.keys() == shapes.keys()
            for name, marker in markers.items():
                points = [[_field(p, axis) for axis in "xyz"] for p in _field(marker, "points")]
                assert points == shapes[name].points.tolist(), name
                assert _field(_field(marker, "header"), "frame_id") == shapes[name].frame
    for (_, tree), moment in zip(found["/tf"], moments, strict=True):
        # Only the first transform is compared; the others are the later poses until the next step.
        transform = _field(tree, "transforms")[0]
        translation = _field(_field(transform, "transform"), "translation")
        assert tuple(_field(translation, axis) for axis in "xyz") == moment.frames[0].position


def test_streaming_reads_all_topics(log: Path) -> None:
    counts = {topic: len(messages) for topic, messages in by_mcap_streaming(log).items()}
    indexed = {topic: len(messages) for topic, messages in by_mcap_indexed(log).items()}
    assert counts == indexed
    assert counts["/rosout"] == 6


def test_doctor_reports_no_problem(log: Path) -> None:
    doctor = Path(sys.executable).with_name("pymcap-cli")
    need(doctor.exists(), "pymcap-cli is not installed")
    done = subprocess.run(
        [str(doctor), "doctor", str(log)], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "passed" in done.stdout


def _field(message: Any, name: str) -> Any:
    return message[name] if isinstance(message, dict) else getattr(message, name)


def _assert_equal(values: list[Any], column: np.ndarray[Any, Any], where: str) -> None:
    """Compare numbers bit for bit in the dtype of our column, and strings and None with `==`."""
    assert len(values) == len(column), f"{where}: {len(values)} messages, not {len(column)}"
    if column.dtype.kind in "OU":
        assert [_known(value) for value in values] == column.tolist(), where
        return
    dtype = stored_dtype(column.dtype)
    # Convert one element at a time, because NumPy would convert a list of big integers to float.
    lists = [list(value) if isinstance(value, bytes) else value for value in values]
    flat = [_number(part, dtype) for value in lists for part in np.ravel(value).tolist()]
    actual = np.array(flat, dtype)
    expected = column.astype(dtype).ravel()
    assert actual.tobytes() == expected.tobytes(), where


def _number(value: Any, dtype: np.dtype[Any]) -> Any:
    return int(value) if dtype.kind in "iub" else float(value)


def _known(value: Any) -> Any:
    """Convert text to an integer, and -1 to None: `/rl/episode` stores -1 if there is no seed."""
    if isinstance(value, str) and value.lstrip("-").isdigit():
        value = int(value)
    return None if value == -1 else value
