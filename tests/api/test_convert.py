"""Tests of `convert`, and of the commands that read bags by a mapping."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import LogError, OutputExistsError, UnknownNameError, UsageError
from mcaprl.recorder.bags.bag import copy_topics
from mcaprl.recorder.mapping.config import load_mapping
from tests.support.bags import (
    START_NS,
    STEP_NS,
    STEPS,
    Channel,
    integers,
    numbers,
    speed,
    turn,
    write_channels,
    write_rosbag1,
    write_rosbag2,
)

MAPPING = """\
clock: {rate_hz: 10}
observation:
  speed: {field: /odom.twist.twist.linear.x}
  yaw: {field: /odom.pose.pose.orientation, as: yaw}
  place: {transform: base, in: odom}
action:
  fields: [/cmd_vel.linear.x, /cmd_vel.angular.z]
  actions: {left: [1, 1], right: [1, -1]}
reward: next(speed) - speed
episodes: {terminated: speed > 5}
meta: {policy: operator}
"""
OWN_TOPICS = {"/rl/step", "/rl/episode", "/rl/phase", "/rosout", "/telemetry"}


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    (tmp_path / "robot.yaml").write_text(MAPPING)
    return write_rosbag2(tmp_path / "bag")


def test_a_bag_is_opened_by_a_mapping(bag: Path, tmp_path: Path) -> None:
    data = mcaprl.open(bag, mapping=tmp_path / "robot.yaml")
    # The speed is 0.5 k at step k, so step 11 is the terminal step.
    assert len(data) == STEPS - 1
    np.testing.assert_allclose(data.observations[:, 0], [speed(k) for k in range(STEPS - 1)])
    np.testing.assert_allclose(data.observations[:, 1], 0.1 * np.arange(STEPS - 1), rtol=1e-5)
    np.testing.assert_allclose(data.observations[:, 2], np.arange(STEPS - 1), rtol=1e-6)
    assert data.observation_names == ("speed", "yaw", "place_x", "place_y", "place_yaw")
    assert data.actions.tolist() == [int(turn(k) < 0) for k in range(STEPS - 1)]
    assert data.rewards.tolist() == [0.5] * (STEPS - 1)
    assert data.terminated.tolist() == [False] * (STEPS - 2) + [True]
    assert data.episodes[0].policy == "operator"
    kept = pickle.loads(pickle.dumps(data.filter(lambda episode: True)))
    assert kept.origin.mapping["reward"] == "next(speed) - speed"
    assert kept.origin.report.steps == STEPS - 1
    with pytest.raises(UsageError, match="are for logs, not for a mapping"):
        mcaprl.open(bag, mapping=tmp_path / "robot.yaml", columns=[])


def test_a_converted_bag_is_an_equal_log(bag: Path, tmp_path: Path) -> None:
    out = tmp_path / "robot.mcap"
    data = mcaprl.open(bag, mapping=tmp_path / "robot.yaml")
    found = mcaprl.convert(data, out)
    assert mcaprl.open(out).fingerprint == found.dataset.fingerprint
    assert not mcaprl.check(out).problems
    with pytest.raises(OutputExistsError):
        mcaprl.convert(lambda: pytest.fail("read too early"), out)
    with pytest.raises(UsageError, match=r"x.mcap has the suffix of logs: .* for `to='npz'`"):
        mcaprl.convert(out, tmp_path / "x.mcap", to="npz")
    with pytest.raises(UsageError, match="the format is not clear from the name"):
        mcaprl.convert(data, tmp_path / "robot.unknown")
    pytest.importorskip("pyarrow")
    mcaprl.convert(out, tmp_path / "robot.parquet")
    assert mcaprl.open(tmp_path / "robot.parquet").fingerprint == data.fingerprint


def test_every_form_of_bag_gives_the_same_log(bag: Path, tmp_path: Path) -> None:
    mapping = tmp_path / "robot.yaml"
    expected = mcaprl.open(bag, mapping=mapping).fingerprint
    others = [write_rosbag2(tmp_path / "sqlite", "sqlite3"), write_rosbag1(tmp_path / "one.bag")]
    assert [mcaprl.open(path, mapping=mapping).fingerprint for path in others] == [expected] * 2


def test_commands_read_a_bag_by_a_mapping(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mapping = ["--mapping", str(tmp_path / "robot.yaml")]
    assert run(["info", str(bag), *mapping, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == STEPS - 1
    assert run(["check", str(bag), *mapping]) == 0
    assert "1 file checked, no problems" in capsys.readouterr().out
    assert run(["convert", str(bag), *mapping, "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert "11 of 12 steps of the clock" in shown
    assert "6 left, 5 right" in shown
    (first,) = [line for line in shown.splitlines() if line.startswith("│ 0 ")]
    assert [cell.strip() for cell in first.split("│")[1:-1]] == [
        *("0", "0", "0", "0", "-1", "0", "left", "0.5", "")
    ]
    out = str(tmp_path / "out.mcap")
    assert run(["convert", str(bag), out, *mapping]) == 0
    assert f"{out}: 1 episode, 11 steps" in capsys.readouterr().out.replace("\n", "")
    run_folder = tmp_path / "run"
    request = ["train-offline", str(bag), *mapping, "--out", str(run_folder), "--algo", "bc"]
    assert run([*request, "--updates", "3", "--batch-size", "4"]) == 0
    assert json.loads((run_folder / "mapping.json").read_text())["reward"] == "next(speed) - speed"
    assert "learning from 1 episode" in capsys.readouterr().out
    request = ["annotate", str(bag), *mapping, "--policy", str(run_folder)]
    assert run([*request, "--out", str(tmp_path / "values.mcap")]) == 0
    assert "/rl/values has the values of" in capsys.readouterr().out
    assert len(mcaprl.open(tmp_path / "values.mcap")) == STEPS - 1
    assert not list(tmp_path.glob(".*"))
    assert run([*request, "--scene", "--out", str(tmp_path / "scene.mcap")]) == 2
    assert "there is no sim to step" in capsys.readouterr().err
    (tmp_path / "robot.yaml").write_text(MAPPING.replace("terminated: speed > 5", "max_steps: 4"))
    estimate = ["evaluate", "random", "--data", str(bag), *mapping, "--updates", "2", "--json"]
    assert run(estimate) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 2


def _stored(path: Path, topic: str) -> list[tuple[object, ...]]:
    """Return times, encodings, schema and bytes of a topic, in the order of the file's times."""
    with path.open("rb") as file:
        return [
            (
                *(one.log_time, one.publish_time, one.data),
                *(channel.message_encoding, channel.metadata),
                schema and (schema.encoding, schema.name, schema.data),
            )
            for schema, channel, one in make_reader(file).iter_messages([topic])
        ]


@pytest.fixture
def mixed(tmp_path: Path) -> Path:
    """Return a bag with topics in ROS 2 messages, JSON, and an encoding that cannot be read."""
    (tmp_path / "robot.yaml").write_text(MAPPING)
    (part,) = write_rosbag2(tmp_path / "part").glob("*.mcap")
    with part.open("rb") as file, (tmp_path / "mixed.mcap").open("wb") as target:
        writer, ids = Writer(target, chunk_size=2000), dict[str, int]()
        writer.start()
        for schema, channel, one in make_reader(file).iter_messages():
            if channel.topic not in ids:
                assert schema is not None
                text = writer.register_schema(schema.name, schema.encoding, schema.data)
                given = (channel.topic, channel.message_encoding, text, channel.metadata)
                ids[channel.topic] = writer.register_channel(*given)
            writer.add_message(ids[channel.topic], one.log_time, one.data, one.log_time - 5)
        image = writer.register_schema("foxglove.CompressedVideo", "jsonschema", b"{}")
        scan = writer.register_schema("sensor_msgs/msg/LaserScan", "ros2msg", b"float32 range_min")
        for topic, encoding, number in (
            *(("/battery", "json", 0), ("/secret", "weird", 0), ("/rl/step", "json", 0)),
            *(("/front", "json", image), ("/scan", "cdr", scan), ("/rosout", "json", 0)),
        ):
            channel_id = writer.register_channel(topic, encoding, number)
            for k in range(3):
                writer.add_message(channel_id, START_NS + k * STEP_NS, b'{"v": %d}' % k, START_NS)
        writer.finish()
    return tmp_path / "mixed.mcap"


def test_a_converted_bag_keeps_its_own_topics(mixed: Path, tmp_path: Path) -> None:
    mapping = ["--mapping", str(tmp_path / "robot.yaml")]
    plain, out, some = (tmp_path / f"{name}.mcap" for name in ("plain", "out", "some"))
    assert run(["convert", str(mixed), str(plain), *mapping]) == 0
    assert run(["convert", str(mixed), str(out), *mapping, "--keep-topics"]) == 0
    topics = {"/odom", "/tf", "/cmd_vel", "/camera/depth", "/joints", "/battery", "/secret"}
    # The lines of the robot remain alone on their topic.
    topics |= {"/front", "/scan", "/rosout"}
    for topic in topics:
        assert _stored(out, topic) == _stored(mixed, topic) != []
    with out.open("rb") as file:
        reader = make_reader(file)
        in_file = reader.iter_messages(topics, log_time_order=False)
        times = [one.log_time for _, _, one in in_file]
    assert times == sorted(times)
    assert set(mcaprl.open_bag(out).topics) == {*topics, *OWN_TOPICS}
    # As a dataset, the log is the one without these topics.
    data = mcaprl.open(out)
    assert data.fingerprint == mcaprl.open(plain).fingerprint
    assert data.metadata == mcaprl.open(plain).metadata
    assert not mcaprl.check(out).problems
    kept = ["--keep-topic", "/c*", "--keep-topic", "/tf"]
    assert run(["convert", str(mixed), str(some), *mapping, *kept]) == 0
    kept_topics = {"/cmd_vel", "/camera/depth", "/tf"}
    assert set(mcaprl.open_bag(some).topics) == {*kept_topics, *OWN_TOPICS}
    # The layout shows the camera beside the values.
    panels = mcaprl.layout(out)["configById"]
    assert panels["Image!/front"]["imageMode"]["imageTopic"] == "/front"
    assert list(panels["3D!robot"]["topics"]) == ["/scan"]
    assert panels["3D!robot"]["followTf"] == "base"
    assert panels["Plot!/odom"]["paths"][0]["value"] == "/odom.pose.pose.position.x"
    # Annotating keeps them, those of a log as those of a bag.
    mcaprl.train(data, tmp_path / "run", algo="bc", updates=2, batch_size=4)
    annotated: dict[str, Any] = {"policy": tmp_path / "run", "overwrite": True}
    of_bag = mcaprl.open(mixed, mapping=tmp_path / "robot.yaml")
    for source, keep_topics in ((out, False), (of_bag, True)):
        target = tmp_path / "values.mcap"
        mcaprl.annotate(source, target, keep_topics=keep_topics, **annotated)
        for topic in topics:
            assert _stored(tmp_path / "values.mcap", topic) == _stored(mixed, topic)
        assert len(_stored(tmp_path / "values.mcap", "/rl/values")) == len(data)
        assert mcaprl.open(tmp_path / "values.mcap").fingerprint == data.fingerprint


@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_the_mapping_names_topics_to_keep(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = MAPPING.replace("terminated: speed > 5", "max_steps: 4")
    (tmp_path / "robot.yaml").write_text(f'{text}keep: [/odom, "/c*/depth", /tf]\n')
    write = write_rosbag1 if kind == "ros1" else write_rosbag2
    bag = write(tmp_path / f"{kind}.bag")
    mapping = ["--mapping", str(tmp_path / "robot.yaml")]
    kept = {"/odom", "/tf", "/camera/depth"}
    for options, expected in (
        ([], kept),
        (["--keep-topic", "/joints"], {"/joints"}),
        (["--keep-topics"], {*kept, "/joints", "/cmd_vel"}),
        (["--no-keep-topics"], set()),
    ):
        out = tmp_path / "out.mcap"
        assert run(["convert", str(bag), str(out), "--overwrite", *mapping, *options]) == 0
        assert set(mcaprl.open_bag(out).topics) == {*expected, *OWN_TOPICS}
    out, some, part, both = (tmp_path / f"{name}.mcap" for name in ("kept", "some", "part", "both"))
    data = mcaprl.open(bag, mapping=tmp_path / "robot.yaml")
    mcaprl.convert(data, out)
    mcaprl.filter("episode == 1", out, some)
    mcaprl.slice(out, part, steps=(1, 6))
    mcaprl.filter("episode == 0", out, tmp_path / "first.mcap")
    mcaprl.merge([some, tmp_path / "first.mcap"], both)
    assert _stored(both, "/camera/depth") == _stored(out, "/camera/depth")
    # The last episode has all messages from its first step on.
    times = [one[0] for one in _stored(some, "/odom")]
    assert times == [START_NS + k * STEP_NS for k in range(5, STEPS)]
    for path in (out, some, part, both):
        assert not mcaprl.check(path).problems
        assert _stored(path, "/camera/depth")
        assert "Image!depth" in mcaprl.layout(path)["configById"]
    capsys.readouterr()
    # Wrong names are reported before anything is written, and a log is not written then.
    (tmp_path / "robot.yaml").write_text(f"{text}keep: [/tf, /camera/deth]\n")
    assert run(["convert", str(bag), *mapping, "--dry-run"]) == 0
    assert "unknown topic '/camera/deth': did you mean /camera/depth" in " ".join(
        capsys.readouterr().out.split()
    )
    assert run(["convert", str(bag), str(tmp_path / "new.mcap"), *mapping]) == 2
    expected_line = "unknown topic in `keep` of the mapping '/camera/deth': did you mean"
    assert expected_line in capsys.readouterr().err
    assert not (tmp_path / "new.mcap").exists()
    with pytest.warns(UserWarning, match="unknown topic '/camera/deth'"):
        data = mcaprl.open(bag, mapping=tmp_path / "robot.yaml")
    data.save(tmp_path / "plain.mcap", keep_topics=False)
    backwards = data._take([1, 0])
    with pytest.raises(LogError, match="the episodes are in another order"):
        backwards.save(tmp_path / "back.mcap", keep_topics="/tf")


@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_a_converted_bag_has_its_quantities_in_their_units(kind: str, tmp_path: Path) -> None:
    tree: dict[str, Any] = {
        "clock": {"rate_hz": 10},
        "observation": {
            "speed": {"field": "/odom.twist.twist.linear.x", "scale": 0.1, "clip": [0, 0.2]},
            "place": {"transform": "base", "in": "odom", "parts": ["x", "yaw", "qw"]},
            "hip": {"field": "/joints.position", "names": "hip"},
            "Knee__": {"field": "/joints.position", "names": "knee", "unit": "rad", "scale": 7},
            "joints": {"field": "/joints.position", "names": [], "elements": ["first", "second"]},
        },
        "fields": {
            "doubled": {"field": "/odom.pose.pose.position.x", "scale": 2},
            "hip_2": {"field": "/joints.position", "names": "hip", "scale": 2},
            "cov": {"field": "/odom.pose.covariance"},
        },
        "action": {"fields": ["/cmd_vel.angular.z"], "box": {"low": -1, "high": 1}},
        "reward": "next(speed)",
        "episodes": {"max_steps": 5},
    }
    write = write_rosbag1 if kind == "ros1" else write_rosbag2
    data = mcaprl.open(write(tmp_path / f"{kind}.bag"), mapping=tree)
    assert data.observation_names[-2:] == ("joints_first", "joints_second")
    data.save(tmp_path / "out.mcap")
    with mcaprl.open_bag(tmp_path / "out.mcap") as bag:
        assert bag.times("/telemetry").tolist() == bag.times("/rl/step").tolist()
        found = bag.read("/telemetry").columns
    expected: dict[str, list[float]] = {
        # The observed speed is at most 0.2, and so are the rewards.
        "return_so_far": [*np.cumsum([0, 0.05, 0.1, 0.15, 0.2, 0.2])],
        "speed_m_s": [speed(k) for k in range(STEPS)],
        "place_x_m": list(range(STEPS)),
        "place_yaw_rad": [0.1 * k for k in range(STEPS)],
        "knee_rad": [2.0] * STEPS,
        "doubled_m": list(range(STEPS)),
        "hip_2": [0.2 * k for k in range(STEPS)],
    }
    assert list(found) == list(expected)
    for name, values in expected.items():
        count = min(len(values), len(found[name]))
        np.testing.assert_allclose(found[name][:count], values[:count], rtol=1e-4, atol=1e-6)
    # Parts of the data have the numbers of their steps, and returns from 0.
    data._take([1]).save(tmp_path / "part.mcap")
    with mcaprl.open_bag(tmp_path / "part.mcap") as bag:
        part = bag.read("/telemetry").columns
    assert part["place_x_m"].tolist() == list(range(6, len(data) + 2))
    assert part["return_so_far"][0] == 0
    mcaprl.open(tmp_path / "out.mcap").save(tmp_path / "again.mcap")
    assert not mcaprl.check(tmp_path / "again.mcap").problems
    tree["observation"]["joints"]["elements"] = ["first"]
    with pytest.raises(UsageError, match="`elements` has 1 name, but the value has 2 elements"):
        mcaprl.open(tmp_path / f"{kind}.bag", mapping=tree)
    tree["observation"]["joints"]["names"] = ["hip"]
    with pytest.raises(UsageError, match="elements is for a `field`"):
        mcaprl.open(tmp_path / f"{kind}.bag", mapping=tree)


@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_a_converted_bag_says_how_each_episode_ended(kind: str, tmp_path: Path) -> None:
    # Episode 0 ends after 3 of the 11 steps with a reason, episode 1 at the next steps.
    text = MAPPING.replace("speed > 5", "speed == 1.5").replace(
        "episodes: {", "episodes: {reasons: {fast: speed > 1}, max_steps: 5, "
    )
    (tmp_path / "robot.yaml").write_text(text)
    write = write_rosbag1 if kind == "ros1" else write_rosbag2
    data = mcaprl.open(write(tmp_path / f"{kind}.bag"), mapping=tmp_path / "robot.yaml")
    out, again, some = (tmp_path / f"{name}.mcap" for name in ("out", "again", "some"))
    mcaprl.convert(data, out)
    mcaprl.convert(out, again)
    at_ns = [START_NS + k * STEP_NS for k in (0, 3, 4, 9)]
    lines = [
        "episode 0 begins, operator acts",
        "episode 0 ends after 3 steps: fast, return 1.5",
        "episode 1 begins, operator acts",
        "episode 1 ends after 5 steps: fast, return 2.5",
    ]
    for path in (out, again):
        with path.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            found = [
                (one.channel.topic, one.message.log_time, one.decoded_message)
                for one in reader.iter_decoded_messages(["/rosout", "/rl/phase"])
            ]
        assert [(t, m.msg) for name, t, m in found if name == "/rosout"] == [
            *zip(at_ns, lines, strict=True)
        ]
        phases = [(t, m.data) for name, t, m in found if name == "/rl/phase"]
        assert phases == [*zip(at_ns, ["running", "fast"] * 2, strict=True)]
        assert not mcaprl.check(path).problems
    mcaprl.filter("episode == 1", out, some)
    assert [one[0] for one in _stored(some, "/rosout")] == at_ns[2:]


@pytest.mark.parametrize("kind", ["sqlite3", "zstd", "ros1"])
def test_topics_of_older_bags_are_kept_with_their_definitions(kind: str, tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text(MAPPING)
    if kind == "ros1":
        bag = write_rosbag1(tmp_path / "one.bag")
    else:
        storage, packed = (kind, "") if kind == "sqlite3" else ("mcap", "MESSAGE")
        bag = write_rosbag2(tmp_path / "bag", storage, packed)
    data = mcaprl.open(bag, mapping=tmp_path / "robot.yaml")
    data.save(tmp_path / "out.mcap", keep_topics=["/odom", "/camera/*"])
    kept = mcaprl.open_bag(tmp_path / "out.mcap")
    assert set(kept.topics) == {"/camera/depth", "/odom", *OWN_TOPICS}
    odometry = kept.read("/odom", ["twist.twist.linear.x"])
    assert odometry.columns["twist.twist.linear.x"].tolist() == [speed(k) for k in range(STEPS)]
    assert odometry.log_time_ns.tolist() == [START_NS + k * STEP_NS for k in range(STEPS)]
    (depth,) = kept.read("/camera/depth", ["data"]).columns.values()
    assert [one[0] + 256 * one[1] for one in depth] == [1000 + k for k in range(STEPS)]
    if kind != "ros1":
        # So does another reader of MCAP.
        with (tmp_path / "out.mcap").open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            found = [one.decoded_message for one in reader.iter_decoded_messages(["/odom"])]
        assert [one.twist.twist.linear.x for one in found] == [speed(k) for k in range(STEPS)]
    assert mcaprl.open(tmp_path / "out.mcap").fingerprint == data.fingerprint


def test_topics_that_cannot_be_kept_are_clear_errors(bag: Path, tmp_path: Path) -> None:
    data = mcaprl.open(bag, mapping=tmp_path / "robot.yaml")
    out = tmp_path / "out.mcap"
    with pytest.raises(UnknownNameError, match="unknown topic '/camra'"):
        mcaprl.convert(data, out, keep_topics="/camra")
    with pytest.raises(UsageError, match=r"are kept in a log: name an output that ends in \.mcap"):
        mcaprl.convert(data, tmp_path / "out.npz", keep_topics=True)
    mcaprl.convert(data, out)
    with pytest.raises(UsageError, match="for data that were read from a bag by a mapping"):
        mcaprl.convert(out, tmp_path / "other.mcap", keep_topics=True)
    with pytest.raises(UsageError, match="annotate keeps all topics of a log"):
        mcaprl.annotate(out, tmp_path / "other.mcap", policy="run", keep_topics=True)
    twice = write_rosbag2(tmp_path / "twice")
    both = mcaprl.open([bag, twice], mapping=tmp_path / "robot.yaml")
    with pytest.raises(LogError, match="its recordings overlap in time"):
        mcaprl.convert(both, tmp_path / "other.mcap", keep_topics=True)
    odd = write_channels(
        tmp_path / "odd.mcap", [Channel("/odd", "robot/msg/Odd", "", [(0.0, b"1234")])]
    )
    with pytest.raises(LogError, match=r"/odd cannot be kept: .*definition"):
        copy_topics([odd], [], ["*"], cast(Any, None))
    assert sorted(path.name for path in tmp_path.glob("*.mcap")) == ["odd.mcap", "out.mcap"]


def test_requests_that_lack_something_are_clear_errors(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mapping = ["--mapping", str(tmp_path / "robot.yaml")]
    file = str(next(bag.glob("*.mcap")))
    for request in (
        ["convert", file, "out.mcap"],
        ["layout", file, "--out", "-"],
        ["replay", file],
    ):
        assert run(request) == 1
        assert "by `mcaprl convert BAG OUT.mcap --mapping FILE`" in capsys.readouterr().err
    assert run(["convert", str(bag), *mapping]) == 2
    assert "convert needs SRC and DST, or --dry-run" in capsys.readouterr().err
    (tmp_path / "robot.yaml").write_text(MAPPING.replace("/odom.twist", "/odom.twits", 1))
    assert run(["convert", str(bag), "x.mcap", *mapping]) == 2
    error = capsys.readouterr().err
    assert "robot.yaml:3: observation.speed: /odom (nav_msgs/msg/Odometry) has no field" in error
    assert "nearest: twist.twist.linear.x" in error
    assert not Path("x.mcap").exists()


def test_a_suggested_mapping_gives_a_dataset(bag: Path, tmp_path: Path) -> None:
    path = tmp_path / "suggested.yaml"
    text = mcaprl.suggest_mapping(bag)
    path.write_text(text)
    mapping, _ = load_mapping(path)
    assert mapping.action.fields == ["/cmd_vel.linear.x", "/cmd_vel.angular.z"]
    assert mapping.clock.rate_hz == 10
    assert "# camera: {image: /camera/depth, resize: [84, 84]}" in text
    assert "# keep: [/camera/depth, /odom, /tf]  # topics" in text
    data = mcaprl.open(bag, mapping=path)
    assert len(data) == STEPS - 1
    assert "odom_linear_x" in data.observation_names


@pytest.mark.parametrize(("form", "target"), [("npz", "lane.npz"), ("parquet", "lane")])
def test_a_killed_conversion_leaves_nothing_under_the_final_name(
    tmp_path: Path, form: str, target: str
) -> None:
    pytest.importorskip("pyarrow", reason="needs the extra tables")
    log, out = tmp_path / "lane.mcap", tmp_path / target
    mcaprl.record("lane", log, episodes=1)
    program = (
        "import os, mcaprl\n"
        f"from mcaprl.recorder.dataset.formats import {form} as module\n"
        "write = module.write\n"
        "def killed(*arguments, **options):\n"
        "    write(*arguments, **options)\n"
        "    os._exit(9)\n"
        "module.write = killed\n"
        f"mcaprl.convert({str(log)!r}, {str(out)!r}, to={form!r})\n"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 9
    assert not out.exists()
    mcaprl.convert(log, out, to=form)
    assert mcaprl.open(out).frames.tolist() == mcaprl.open(log).frames.tolist()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["lane.mcap", target])


def test_unknown_formats_list_those_that_are_known(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "lane.mcap"
    mcaprl.record("lane", log, episodes=1)
    assert run(["convert", str(log), str(tmp_path / "out"), "--to", "parqet"]) == 2
    error = capsys.readouterr().err
    assert "parquet" in error
    assert "lerobot" in error
    (tmp_path / "text.csv").write_text("a,b\n")
    assert run(["convert", str(tmp_path / "text.csv"), str(tmp_path / "out.mcap")]) == 1
    error = capsys.readouterr().err
    assert "text.csv is not an MCAP file" in error
    assert "nor is it a dataset of one of the formats lerobot, minari, parquet" in error


def test_a_dry_run_of_wide_and_nested_observations_fits(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wide = MAPPING.replace("  yaw:", "  cov: {field: /odom.pose.covariance}\n  yaw:")
    wide = wide.replace("action:\n", "  depth: {image: /camera/depth}\naction:\n", 1)
    (tmp_path / "robot.yaml").write_text(wide)
    mapping = ["--mapping", str(tmp_path / "robot.yaml")]
    assert run(["convert", str(bag), *mapping, "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 100
    (head,) = [line for line in shown.splitlines() if "┃ step" in line]
    names = [cell.strip() for cell in head.split("┃")[1:-1]]
    assert names[:4] == ["step", "depth", "speed", "cov_0"]
    assert names[-3:] == ["action", "reward", "end"]
    # The vector has 1 + 36 + 1 + 3 elements, of which `names` shows all but 5.
    assert f"{41 - (len(names) - 5)} more columns: " in shown
    assert "float32 4x6x1, mean 1" in shown


def test_a_dry_run_has_a_row_for_each_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # The second file begins before the end of the first one.
    for name, start in (("a.mcap", 0), ("b.mcap", 1)):
        channels = [numbers("/x", [(start + k / 10, k) for k in range(30)])]
        channels.append(integers("/cmd", [(start + k / 10, k % 2) for k in range(30)]))
        write_channels(tmp_path / name, channels)
    tree = {"clock": {"rate_hz": 10}, "observation": {"x": {"field": "/x.data"}}}
    mapping = {**tree, "action": {"field": "/cmd.data"}}
    (tmp_path / "m.yaml").write_text(json.dumps(mapping))
    paths = [str(tmp_path / name) for name in ("a.mcap", "b.mcap")]
    assert run(["convert", *paths, "--mapping", str(tmp_path / "m.yaml"), "--dry-run"]) == 0
    shown = capsys.readouterr().out
    rows = [line for line in shown.splitlines() if "0.0% 0.000 0.000" in line]
    assert [[cell.strip() for cell in row.split("│")[1:4]] for row in rows] == [
        ["0", "30", "29"],
        ["1", "30", "29"],
    ]
