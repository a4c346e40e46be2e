"""Faults that are planted into bags are found by kind and place; clean bags have no problems."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from click.testing import CliRunner

import mcaprl
from mcaprl.cli import cli
from mcaprl.recorder.mapping import topic_quality
from mcaprl.recorder.mapping.topic_quality import topic_flaws
from tests.support import robots
from tests.support.damage.planted_bags import (
    BAG_FAULTS,
    blacken,
    clean_robot,
    repeat,
    slow,
    topic_of,
)
from tests.support.robots import Robot, Topic

SECONDS = 12
TOGETHER = [
    [name for name in BAG_FAULTS if name != "black, /camera" and "compressed" not in name],
    ["black, /camera", "frozen, /camera/compressed"],
]
WRITERS = [robots.write_mcap, robots.write_bag, robots.write_sqlite, robots.write_json]


@pytest.fixture(scope="module")
def robot() -> Robot:
    """Return a robot without faults."""
    return clean_robot(1, seconds=SECONDS)


def part(robot: Robot, *names: str) -> Robot:
    """Return a copy of some topics."""
    return Robot([copy.deepcopy(topic_of(robot, name)) for name in names], robot.types)


def problems(path: Path) -> list[Any]:
    """Return the findings that are no notes."""
    return [one for one in quality(path) if one.severity == "problem"]


def facts(path: Path) -> Any:
    """Return facts about a bag, with its quality."""
    return mcaprl.info(path, quality=True)


def quality(path: Path) -> list[Any]:
    """Return all findings."""
    found: list[Any] = facts(path).quality
    return found


def found_in(path: Path) -> list[tuple[Any, ...]]:
    return sorted(
        (flaw.kind, place.topic, place.first, place.last)
        for flaw in problems(path)
        for place in flaw.places
    )


@pytest.mark.parametrize("is_sim", [False, True])
def test_clean_bags_have_no_problems(tmp_path: Path, is_sim: bool) -> None:
    for seed in (4, 5):
        bag = clean_robot(seed, is_sim=is_sim, seconds=SECONDS)
        assert problems(robots.write_mcap(bag, tmp_path / f"{seed}.mcap")) == []


@pytest.mark.parametrize("names", TOGETHER)
def test_planted_faults_are_found_at_their_messages(
    robot: Robot, tmp_path: Path, names: list[str]
) -> None:
    bag, planted = copy.deepcopy(robot), []
    for name in names:
        place = BAG_FAULTS[name](bag, np.random.default_rng(0))
        assert place is not None
        planted.append((name.split(",")[0], *place))
    path = robots.write_mcap(bag, tmp_path / "bag.mcap")
    assert found_in(path) == sorted(planted)
    for flaw in problems(path):
        (place,) = flaw.places
        times = [t for t, _ in topic_of(bag, place.topic).messages]
        assert (place.from_s, place.to_s) == pytest.approx((times[place.first], times[place.last]))
        assert flaw.next
        assert flaw.plot is not None
        ((low, high),) = flaw.plot.spans
        assert (low, high) == pytest.approx((place.from_s, place.to_s))
        assert min(flaw.plot.x) <= low <= high <= max(flaw.plot.x)


@pytest.mark.parametrize("write", WRITERS)
def test_stamps_and_numbers_do_not_hide_a_repetition(
    robot: Robot, tmp_path: Path, write: Callable[[Robot, Path], Path]
) -> None:
    bag = part(robot, "/imu")
    repeat(bag, "/imu", 200, 30)
    path = write(bag, tmp_path / "bag.mcap")
    assert found_in(path) == [("repeated", "/imu", 200, 229)]
    (flaw,) = problems(path)
    assert flaw.figure == 30
    assert flaw.share == pytest.approx(30 / 600)


def test_stamps_within_lists_of_messages_do_not_count(robot: Robot, tmp_path: Path) -> None:
    """As in `/tf`, whose transforms have headers."""
    messages = []
    for k, (t, values) in enumerate(topic_of(robot, "/odom").messages[:200]):
        place = {"translation": {"x": 0.1 * max(k, 150) if k >= 100 else 0.1 * k}}
        transform = {"header": values["header"], "child_frame_id": "base", "transform": place}
        messages.append((t, {"transforms": [transform]}))
    for k in range(100, 150):
        messages[k] = (messages[k][0], copy.deepcopy(messages[k][1]))
        messages[k][1]["transforms"][0]["transform"] = {"translation": {"x": 9.9}}
    path = tmp_path / "bag.mcap"
    robots.write_mcap(Robot([Topic("/tf", "tf2_msgs/msg/TFMessage", messages)]), path)
    found = facts(path)
    assert found.looked["/tf"].compared == 200
    assert [(one.first, one.last) for flaw in found.quality for one in flaw.places] == [(100, 149)]


def test_at_rest_constant_or_set_in_steps_is_no_fault(tmp_path: Path) -> None:
    """A position at rest goes on smoothly, also if the speed is set within a step."""
    speeds = np.repeat([0.0, 0.02, 0.0, -0.03, 0.05, 0.0], 60)
    places = np.cumsum(speeds)
    kinds = {
        "/rest": places,
        "/constant": np.full(360, 2.0),
        "/steps": np.repeat(np.random.default_rng(0).normal(size=36), 10),
        "/last": np.minimum(np.arange(360), 300) * 0.1,
        "/state": np.arange(360) // 6 % 2.0,
    }
    bag = Robot([])
    for name, values in kinds.items():
        messages = [(0.1 * k, {"data": value}) for k, value in enumerate(values.tolist())]
        bag.topics.append(Topic(name, "std_msgs/msg/Float64", messages))
    found = quality(robots.write_mcap(bag, tmp_path / "bag.mcap"))
    assert [(flaw.severity, flaw.what.split(":")[0], flaw.figure) for flaw in found] == [
        ("note", "/steps", 10)
    ]


def test_a_sensor_that_is_slower_than_its_topic_is_a_note(robot: Robot, tmp_path: Path) -> None:
    bag = part(robot, "/imu", "/camera")
    slow(bag, "/imu", 4)
    slow(bag, "/camera", 2)
    found = quality(robots.write_mcap(bag, tmp_path / "bag.mcap"))
    assert {(one.severity, one.kind, one.figure) for one in found} == {
        ("note", "repeated", 4),
        ("note", "frozen", 2),
    }
    assert found[0].share == pytest.approx(0.75, abs=0.01)


def test_two_recordings_are_not_compared_with_each_other(robot: Robot, tmp_path: Path) -> None:
    """The second begins with four messages that are the last of the first."""
    first, second = part(robot, "/imu"), part(robot, "/imu")
    first.topics[0].messages[300:] = []
    second.topics[0].messages[:295] = []
    repeat(first, "/imu", 298, 2)
    for k in range(5):
        t, values = second.topics[0].messages[k]
        held = {**first.topics[0].messages[-1][1], "header": values["header"]}
        second.topics[0].messages[k] = (t + 10, held)
    second.topics[0].messages[5:] = [(t + 10, v) for t, v in second.topics[0].messages[5:]]
    robots.write_mcap(first, tmp_path / "a.mcap")
    robots.write_mcap(second, tmp_path / "b.mcap")
    assert problems(tmp_path) == []


def video_of(frames: list[np.ndarray[Any, Any]]) -> Robot:
    """Return a robot with a video in H.264."""
    context: Any = av.CodecContext.create("libx264", "w")
    context.height, context.width = frames[0].shape[:2]
    context.pix_fmt, context.gop_size, context.max_b_frames = "yuv420p", 15, 0
    context.time_base, context.framerate = Fraction(1, 10), Fraction(10)
    context.options = {"preset": "ultrafast", "tune": "zerolatency"}
    packets = []
    for number, pixels in enumerate(frames):
        frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
        frame.pts = number
        packets += [bytes(each) for each in context.encode(frame)]
    kind = "foxglove_msgs/msg/CompressedVideo"
    text = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format"
    messages = [
        (0.1 * k, {"format": "h264", "data": np.frombuffer(data, np.uint8)})
        for k, data in enumerate(packets)
    ]
    return Robot([Topic("/video", kind, messages)], {kind: text})


def test_frames_of_a_video_are_compared_after_decoding(robot: Robot, tmp_path: Path) -> None:
    bag = part(robot, "/camera")
    frames = [v["data"].reshape(36, 48, 3) for _, v in topic_of(bag, "/camera").messages]
    assert problems(robots.write_mcap(video_of(frames), tmp_path / "clean.mcap")) == []
    name, first, last = BAG_FAULTS["frozen, /camera"](bag, np.random.default_rng(0)) or ("", 0, 0)
    dark = 5 if first > 20 else 100
    blacken(bag, name, dark, 6)
    frames = [v["data"].reshape(36, 48, 3) for _, v in topic_of(bag, "/camera").messages]
    path = robots.write_mcap(video_of(frames), tmp_path / "bad.mcap")
    assert found_in(path) == [
        ("black", "/video", dark, dark + 5),
        ("frozen", "/video", first, last),
    ]


def test_large_topics_are_read_in_part_and_it_is_said(
    robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = part(robot, "/imu", "/camera/compressed")
    blacken(bag, "/camera/compressed", 50, 3)
    path = robots.write_mcap(bag, tmp_path / "bag.mcap")
    size = len(topic_of(bag, "/camera/compressed").messages)
    monkeypatch.setattr(topic_quality, "_FRAMES", 40)
    monkeypatch.setattr(topic_quality, "_MESSAGES", 100)
    monkeypatch.setattr(topic_quality, "_BYTES", 1 << 15)
    found = facts(path)
    camera, imu = found.looked["/camera/compressed"], found.looked["/imu"]
    assert (camera.messages, imu.messages) == (size, 600)
    assert 20 <= camera.compared <= 40
    assert camera.decoded <= 48
    assert 80 <= imu.compared <= 100
    text = dict(found.rows())
    assert text["compared"] == f"{camera.compared + imu.compared} of {size + 600} messages"
    assert text["decoded"] == f"{camera.decoded} of {size} frames"


def test_a_mapped_bag_and_its_log_have_the_same_faults_of_the_camera(
    robot: Robot, tmp_path: Path
) -> None:
    """Message k is step k of the episode: the camera is the clock."""
    bag = part(robot, "/odom", "/cmd_vel", "/camera")
    repeat(bag, "/camera", 91, 12)
    blacken(bag, "/camera", 30, 5)
    path = robots.write_mcap(bag, tmp_path / "bag.mcap")
    mapping = {
        "clock": {"topic": "/camera"},
        "observation": {"camera": {"image": "/camera"}},
        "action": {"fields": ["/cmd_vel.linear.x"], "box": {"low": -1, "high": 1}},
    }
    data = mcaprl.open(path, mapping=mapping)
    data.save(log := tmp_path / "log.mcap")
    for source in (data, log):
        flaws = mcaprl.info(source, quality=True).quality or []
        places = {one.kind: one.places[0][1:3] for one in flaws if "image" in one.what}
        assert places == {"black": (30, 34), "frozen": (90, 101)}
    assert found_in(path) == [("black", "/camera", 30, 34), ("frozen", "/camera", 91, 102)]


def test_what_cannot_be_decoded_is_a_note(robot: Robot, tmp_path: Path) -> None:
    bag = part(robot, "/camera")
    for _, values in topic_of(bag, "/camera").messages:
        values["encoding"] = "odd"
    (flaw,) = quality(robots.write_mcap(bag, tmp_path / "bag.mcap"))
    assert (flaw.severity, flaw.kind) == ("note", "not compared")
    assert "encoding 'odd'" in flaw.effect


def test_the_command_and_the_page_show_the_findings(robot: Robot, tmp_path: Path) -> None:
    bag = part(robot, "/imu", "/camera")
    repeat(bag, "/imu", 200, 30)
    blacken(bag, "/camera", 40, 5)
    path = str(robots.write_mcap(bag, tmp_path / "bag.mcap"))
    page = tmp_path / "page"
    run = CliRunner().invoke(cli, ["info", path, "--quality", "--json", "--report", str(page)])
    found = json.loads(run.stdout)
    assert found == json.loads((page / "bag.json").read_text())
    assert [one["kind"] for one in found["quality"]] == ["repeated", "black"]
    assert found["quality"][0]["places"][0]["topic"] == "/imu"
    assert found["looked"]["/camera"] == {"messages": 120, "compared": 120, "decoded": 120}
    html = (page / "index.html").read_text()
    assert html.count("<svg") == 2
    assert "5 frames are of one color" in html
    text = CliRunner().invoke(cli, ["info", path, "--quality"]).stdout
    assert "messages 200 to 229, 4.00 to 4.58 s" in " ".join(text.split())


def test_times_of_topics() -> None:
    """Of 100 messages at 10 Hz three are lost after the 50th; the clock goes back by 2 s."""
    times = np.arange(100, dtype=np.int64) * 10**8
    same = np.zeros(100, np.int64)
    assert topic_flaws("/odom", times, same) == []
    lost = times + np.where(np.arange(100) >= 50, 3 * 10**8, 0)
    (drops,) = topic_flaws("/odom", lost, same)
    assert (drops.kind, drops.figure, drops.where) == ("drops", 3, "message 49, 4.90 s")
    (clock,) = topic_flaws("/odom", times - np.where(np.arange(100) >= 50, 2 * 10**9, 0), same)
    assert clock.kind == "clock"
    assert clock.figure == pytest.approx(1.9)
    assert topic_flaws("/odom", lost, (np.arange(100) >= 50).astype(np.int64)) == []


def test_events_without_a_rate_are_not_evaluated() -> None:
    times = np.cumsum(np.random.default_rng(0).exponential(1e9, 300)).astype(np.int64)
    assert topic_flaws("/event", times, np.zeros(300, np.int64)) == []
