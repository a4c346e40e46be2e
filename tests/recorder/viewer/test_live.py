"""The live server, tested with a viewer, and the player's clock."""

from __future__ import annotations

import base64
import hashlib
import importlib.util
import json
import math
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

import mcaprl
from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.messages import EpisodeSummary
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.record.layout import layout_of
from mcaprl.recorder.viewer.annotate import layout_of_log
from mcaprl.recorder.viewer.foxglove_server import prefixed_message, prefixes_of, side_by_side
from mcaprl.recorder.viewer.live_stream import LiveStep, LiveStream
from mcaprl.recorder.viewer.playback import Played, Player, Track
from mcaprl.sims import make_sim
from tests.conftest import need
from tests.support.paths import NODE
from tests.support.watcher import Watcher

START_NS = 1_700_000_000 * 10**9
STEP_NS = 250_000_000


def record(path: Path, seeds: tuple[int, ...], steps: int = 20) -> Path:
    with closing(mcaprl.RecordMcap(make_sim("lane"), path, start_time_ns=START_NS)) as env:
        for seed in seeds:
            env.reset(seed=seed)
            for _ in range(steps):
                env.step(1)
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("live") / "lane.mcap", (0, 1, 2), 8)


def topics_of(player: Player, played: list[Played]) -> list[str]:
    return [player.tracks[m.track].reader.channels[m.channel_id].topic for m in played]


def test_playback_yields_every_message_once_in_order(log: Path) -> None:
    reader = McapReader(log)
    player = Player([Track(reader)], speed=3.0, playing=True)
    played = [message for _ in range(200) for message in player.advance(0.05)]
    assert player.ended
    assert not player.playing
    times = [message.time_ns for message in played]
    assert times == sorted(times)
    expected = [
        (channel.id, *message)
        for channel in reader.channels.values()
        for message in reader.messages(channel)
    ]
    assert sorted((m.channel_id, m.time_ns, m.data) for m in played) == sorted(expected)


def test_clock_pauses_seeks_and_restarts(log: Path) -> None:
    player = Player([Track(McapReader(log))])
    assert player.advance(1.0) == []
    player.seek(START_NS + 4 * STEP_NS)
    player.playing = True
    due = player.advance(0.25)
    last = [message for message in due if message.time_ns == START_NS + 5 * STEP_NS]
    assert topics_of(player, last) == ["/rl/step", "/scene", "/tf", "/telemetry"]
    assert set(topics_of(player, [m for m in due if m not in last])) <= {"/tf"}
    assert min(message.time_ns for message in due) > START_NS + 4 * STEP_NS
    player.seek(0)
    assert player.time_ns == player.start_ns == START_NS
    player.seek(2**63)
    assert player.time_ns == player.end_ns
    player.loops = True
    player.advance(0.1)
    assert player.playing


def test_the_current_state_is_the_last_message_of_each_topic(log: Path) -> None:
    player = Player([Track(McapReader(log))])
    player.seek(START_NS + 3 * STEP_NS + 1)
    seen = dict(
        zip(topics_of(player, player.current_messages()), player.current_messages(), strict=True)
    )
    assert seen["/scene"].time_ns == seen["/rl/step"].time_ns == START_NS + 3 * STEP_NS
    assert seen["/scene/static"].time_ns == START_NS
    assert "/rl/episode" not in seen, "no episode has ended yet"


def test_one_episode(log: Path) -> None:
    first, last = mcaprl.open(log).episodes[1].log_time_ns[[0, -1]].tolist()
    player = Player([Track(McapReader(log), (first, last))], playing=True)
    times = [message.time_ns for message in player.advance(60)]
    assert (times[0], times[-1]) == (first, last)
    player.seek(first)
    assert "/scene/static" in topics_of(player, player.current_messages()), (
        "what came before is part of it"
    )


def test_two_logs_share_their_time(log: Path, tmp_path: Path) -> None:
    other = record(tmp_path / "other.mcap", (5,), 4)
    first, last = mcaprl.open(log).episodes[2].log_time_ns[[0, -1]].tolist()
    player = Player([Track(McapReader(other)), Track(McapReader(log), (first, last))])
    player.playing = True
    due = player.advance(2 * STEP_NS / 1e9)
    steps = [m for m, topic in zip(due, topics_of(player, due), strict=True) if topic == "/rl/step"]
    assert [(m.track, (m.time_ns - START_NS) // STEP_NS) for m in steps] == [
        (0, 0),
        (1, 0),
        (0, 1),
        (1, 1),
        (0, 2),
        (1, 2),
    ]
    assert player.end_ns == START_NS + last - first


def test_frames_of_two_logs_have_different_names(log: Path) -> None:
    reader = McapReader(log)
    for topic, type_name in (
        ("/tf", "tf2_msgs/msg/TFMessage"),
        ("/tf_static", "tf2_msgs/msg/TFMessage"),
        ("/scene", "visualization_msgs/msg/MarkerArray"),
    ):
        _, data = next(reader.messages(reader.channels_of(topic)[0]))
        moved = messages.decode(prefixed_message(data, type_name, "b", 10**9), type_name)
        frames = {part.header.frame_id for part in getattr(moved, "transforms", [])}
        frames |= {part.child_frame_id for part in getattr(moved, "transforms", [])}
        frames |= {part.header.frame_id for part in getattr(moved, "markers", [])}
        assert frames <= {"map", "b/car", "b/camera"}
        if topic == "/tf":
            assert moved.transforms[0].header.stamp.sec == START_NS // 10**9 + 1


def test_layouts_are_combined_side_by_side(log: Path) -> None:
    layout = layout_of_log(McapReader(log))
    both = side_by_side([layout, layout], ["a", "b"])
    panels = both["configById"]
    # The panels of both logs are in the same panel of tabs.
    assert len(panels) == 2 * len(layout["configById"]) - 1
    assert panels["3D!b scene"]["followTf"] == "b/car"
    assert panels["3D!b scene"]["topics"].keys() == {"/b/scene", "/b/scene/static"}
    reward = panels["Plot!a reward"]["paths"][0]["value"]
    assert reward == "/a/rl/step{final==false}.reward"
    assert panels["Gauge!b speed"]["path"] == "/b/telemetry.speed_m_s"
    assert panels["RawMessages!a step"]["topicPath"] == "/a/rl/step"
    assert {tab["title"] for tab in panels["Tab!screens"]["tabs"]} == {"Drive", "Learning", "Data"}
    assert panels["Tab!a numbers"]["tabs"][0]["layout"].startswith("Plot!a ")
    assert panels["RosOut!b log"]["topicToRender"] == "/b/rosout"
    assert side_by_side([layout], [""]) == layout
    assert prefixes_of([log, log]) == ["lane", "lane_2"]
    assert "3D!scene" not in layout_of(mcaprl.open(log)._description, [])["configById"]


def test_a_log_of_an_hour_plays_from_anywhere(tmp_path: Path) -> None:
    """The player keeps a few chunks in memory, and reads all else from the mapped file."""
    steps = 60_000
    path = tmp_path / "long.mcap"
    zeros = np.zeros((steps, 4), np.float32)
    ends = np.arange(1, steps + 1) % 600 == 0
    mcaprl.Dataset.from_arrays(
        observations=zeros,
        actions=np.zeros(steps, np.int64),
        rewards=np.arange(steps, dtype=np.float64),
        terminated=ends,
        truncated=np.zeros(steps, bool),
        next_observations=zeros,
    ).save(path)
    track = Track(McapReader(path))
    rows = track._topics[0].ranges[0].index
    assert not rows.flags.owndata, "the index is a view of the file"
    player = Player([track])
    middle = (player.start_ns + player.end_ns) // 2
    player.seek(middle)
    assert any(middle - m.time_ns < 10**9 for m in player.current_messages())
    player.playing = True
    assert len(player.advance(1.0)) >= 10
    assert track._records.cache_info().currsize <= 3


def viewer_is_there() -> None:
    need(shutil.which("node") is not None, "node is not installed")
    installed = (NODE / "node_modules" / "@foxglove" / "ws-protocol").exists()
    need(installed, "run `npm ci` in tests/node")
    need(importlib.util.find_spec("foxglove") is not None, "foxglove-sdk is not installed")


def _hear_signals() -> None:
    """Restore default handlers, since pytest ignores signals in the background or under nohup."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def look(
    arguments: list[str], plan: list[list[Any]], how: signal.Signals = signal.SIGINT
) -> tuple[Any, list[str]]:
    """Run the server and a scripted viewer; return what they received and printed.

    Args:
        arguments: Arguments of `replay`.
        plan: Actions of the viewer.
        how: Signal that ends the server.
    """
    command = [sys.executable, "-m", "mcaprl.cli", "replay", *arguments, "--port", "0"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, preexec_fn=_hear_signals
    ) as server:
        assert server.stdout is not None
        lines = [server.stdout.readline() for _ in range(4)]
        try:
            address = re.search(r"ws://127\.0\.0\.1:\d+", lines[1])
            assert address is not None, lines
            layout = re.search(r"/\S+\.json", lines[2])
            assert layout is not None
            assert json.loads(Path(layout[0]).read_text())["configById"]
            viewer = ["node", str(NODE / "viewer.mjs"), address[0], json.dumps(plan)]
            seen = subprocess.run(viewer, capture_output=True, text=True, timeout=60, check=True)
        finally:
            server.send_signal(how)
            try:
                rest, _ = server.communicate(timeout=30)
            finally:
                server.kill()
    assert server.returncode == 0
    assert rest == "ended\n"
    assert not Path(layout[0]).exists()
    return json.loads(seen.stdout), lines


def test_a_viewer_connects_seeks_and_receives_the_files_bytes(log: Path) -> None:
    viewer_is_there()
    reader, data = McapReader(log), mcaprl.open(log)
    where = int(data.episodes[1].log_time_ns[3])
    seen, lines = look([str(log)], [["seek", str(where)], ["play", 4.0, 12], ["episode", 2]])
    assert "app.foxglove.dev" in lines[0]
    info = seen["server"]
    assert {"time", "parameters", "playbackControl"} <= set(info["capabilities"])
    assert info["dataStartTime"]["sec"] == START_NS // 10**9
    channels = {channel.topic: channel for channel in reader.channels.values()}
    assert seen["topics"].keys() == channels.keys()
    for topic, reported in seen["topics"].items():
        schema = reader.schema_of(channels[topic])
        assert reported["schemaName"] == schema.name
        assert reported["schema"] == hashlib.sha256(schema.data).hexdigest()
        assert (reported["encoding"], reported["schemaEncoding"]) == ("cdr", "ros2msg")
    in_file = {
        (topic, str(time_ns), hashlib.sha256(message).hexdigest())
        for topic, channel in channels.items()
        for time_ns, message in reader.messages(channel)
    }
    sought, played, jumped = seen["steps"]
    for step in seen["steps"]:
        for message in step["messages"]:
            assert (message["topic"], message["time"], message["sha256"]) in in_file
    assert sought["states"][0] | {"status": 1} == sought["states"][0]
    assert sought["states"][0]["seeked"]
    assert {m["topic"]: m["time"] for m in sought["messages"]}["/scene"] == str(where)
    assert {m["topic"] for m in sought["messages"]} == set(channels)
    assert played["states"][0]["status"] == 0
    assert played["states"][0]["speed"] == 4.0
    assert all(int(m["time"]) > where for m in played["messages"])
    start = str(int(data.episodes[2].log_time_ns[0]))
    assert jumped["states"][0]["time"] == start
    assert {m["topic"]: m["time"] for m in jumped["messages"]}["/tf"] == start
    assert seen["parameters"][-1][0] == {"name": "episode", "value": 2}


def test_a_channel_without_a_schema_is_played(log: Path, tmp_path: Path) -> None:
    viewer_is_there()
    notes, both = tmp_path / "notes.mcap", tmp_path / "both.mcap"
    with notes.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        channel = writer.register_channel("/notes", "json", 0)
        writer.add_message(channel, START_NS, b"{}", START_NS)
        writer.finish()
    mcaprl.merge([log, notes], both)
    seen, _ = look([str(both)], [["play", 4.0, 12]])
    assert seen["topics"]["/notes"]["encoding"] == "json"
    assert seen["topics"].keys() > {"/rl/step", "/notes"}


def test_time_comes_before_the_messages_after_a_restart_and_a_jump_back(log: Path) -> None:
    viewer_is_there()
    starts = [str(e.log_time_ns[0]) for e in mcaprl.open(log).episodes]
    seen, _ = look([str(log)], [["loop", 20.0, 2], ["episode", 1], ["episode", 0]])
    looped, _, jumped = (step["wire"] for step in seen["steps"])
    shown = ("/scene", "/scene/map", "/scene/static", "/tf", "/tf_static", "/telemetry")
    shown_topics = {"/rl/step", "/rl/phase", "/rosout", *shown}
    for wire, rounds in ((looped, 2), (jumped, 1)):
        assert not [kind for kind, _ in wire if kind == "session"]
        seeks = [i for i, (kind, _) in enumerate(wire) if kind == "seeked"]
        assert len(seeks) >= rounds
        for i in seeks:
            after = [pair for pair in wire[i + 1 :] if pair[0] != "state"]
            assert after[0] == ["time", starts[0]]
            # After the new time, the server sends the current message of each topic.
            sent = dict([pair for pair in after if pair[0] != "time"][: len(shown_topics)])
            assert sent == dict.fromkeys(shown_topics, starts[0])


def test_the_first_log_line_comes_once(log: Path) -> None:
    viewer_is_there()
    seen, _ = look([str(log)], [["loop", 20.0, 1]])
    wire = seen["start"] + seen["steps"][0]["wire"]
    wire = wire[: next(i for i, (kind, _) in enumerate(wire) if kind == "seeked")]
    # There are three episodes of 9 records at intervals of 0.25 s.
    starts_ns = [START_NS + 9 * STEP_NS * episode for episode in range(3)]
    expected = [time_ns for start in starts_ns for time_ns in (start, start + 8 * STEP_NS)]
    assert [int(time_ns) for kind, time_ns in wire if kind == "/rosout"] == expected


def test_a_second_viewer_gets_the_current_messages_and_the_first_one_no_line_twice(
    log: Path,
) -> None:
    viewer_is_there()
    from mcaprl.recorder.viewer.foxglove_server import LiveServer

    player = Player([Track(McapReader(log))])
    with closing(LiveServer(player, port=0)) as server:
        first = Watcher(server.url)
        server.tick(0.0)
        # The first episode ends after 8 steps of 0.25 s, and the second one begins 0.25 s later.
        server.tick(2.25)
        second = Watcher(server.url)
        server.tick(0.0)
        # Wait for the messages, because `close` drops messages that are not sent yet.
        time.sleep(0.5)
    events = Counter(m["topic"] for m in first.seen()["messages"])
    assert (events["/rosout"], events["/rl/episode"]) == (3, 1)
    topics = {m["topic"] for m in second.seen()["messages"]}
    assert {"/scene", "/scene/static", "/tf", "/tf_static", "/telemetry", "/rl/phase"} <= topics
    assert not topics & {"/rosout", "/rl/episode"}


def test_labels_are_played_beside_the_log(log: Path, tmp_path: Path) -> None:
    viewer_is_there()
    labeled = tmp_path / "lane.mcap"
    labeled.write_bytes(log.read_bytes())
    mcaprl.label(labeled, episode=1, success=False, note="left the lane")
    stop, addresses = threading.Event(), list[Any]()
    is_open = threading.Event()

    def opened(address: Any) -> None:
        addresses.append(address)
        is_open.set()

    playing = threading.Thread(
        target=mcaprl.replay,
        args=(labeled,),
        kwargs={"port": 0, "episode": 1, "on_open": opened, "stop": stop},
    )
    playing.start()
    try:
        assert is_open.wait(30)
        viewer = Watcher(addresses[0].url)
        time.sleep(0.5)
    finally:
        stop.set()
        playing.join()
    seen = viewer.seen()["messages"]
    text = messages.decode(bytes_of(seen, "/rl/labels"), messages.TEXT_TYPE).data
    assert text == "failure: left the lane"
    assert "/scene" in {message["topic"] for message in seen}


def test_a_log_with_labels_of_other_data_is_played_without_them(log: Path, tmp_path: Path) -> None:
    labeled, stop = tmp_path / "lane.mcap", threading.Event()
    labeled.write_bytes(log.read_bytes())
    mcaprl.label(labeled, episode=1, success=False)
    path = tmp_path / "lane.mcap.labels.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "log": "0" * 64}))
    addresses = list[Any]()
    stop.set()
    with pytest.warns(UserWarning, match="has the labels of other data than"):
        mcaprl.replay(labeled, port=0, on_open=addresses.append, stop=stop)
    assert len(addresses) == 1
    with pytest.raises(LogError, match="has the labels of other data than"):
        mcaprl.annotate(labeled, tmp_path / "out.mcap", scene=True)


def test_two_logs_are_played_side_by_side(log: Path, tmp_path: Path) -> None:
    viewer_is_there()
    other = record(tmp_path / "pilot.mcap", (5,), 4)
    arguments = [str(log), str(other), "--episode", "0", "--speed", "2"]
    # Closing the terminal sends SIGHUP, which ends the server like Ctrl-C.
    seen, _ = look(arguments, [["seek", str(START_NS + STEP_NS)]], signal.SIGHUP)
    assert {"/lane/rl/step", "/pilot/rl/step", "/pilot/scene"} <= seen["topics"].keys()
    times = {message["topic"]: message["time"] for message in seen["steps"][0]["messages"]}
    assert times["/lane/tf"] == times["/pilot/tf"] == str(START_NS + STEP_NS)


class Channels:
    """Substitute for the channels of a server. It stores all messages that are sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[bytes, int]] = []

    def add_channel(self, topic: str, schema: Any) -> Channels:
        return self

    def has_sinks(self) -> bool:
        return True

    def log(self, data: bytes, log_time: int) -> None:
        self.sent.append((data, log_time))


def test_live_messages_are_sent_at_their_times() -> None:
    from mcaprl.recorder.viewer.live_stream import LiveSink

    viewers: Any = Channels()
    sink = LiveSink(viewers, ["/scene"])
    scene, numbers = (sink.add_channel(topic, "", "") for topic in ("/scene", "/telemetry"))
    now_ns = time.time_ns()
    late_ns = now_ns + 10**9
    hour_ns = now_ns + 3600 * 10**9
    sink.write_messages([(scene, now_ns, b"a"), (numbers, now_ns, b"b"), (scene, late_ns, b"c")])
    sink.write_messages([(numbers, hour_ns, b"d")])
    sink.start()
    sink.send(numbers, now_ns + 1, b"at once")
    time.sleep(0.3)
    sink.welcome()
    time.sleep(0.3)
    first = [data for data, _ in viewers.sent]
    assert sorted(first) == [b"a", b"a", b"at once", b"b"], "/scene again for the new viewer"
    time.sleep(max(0.0, late_ns / 1e9 - time.time()) + 0.3)
    sink.close()
    assert viewers.sent[4:] == [(b"c", late_ns)]


def test_an_episode_in_training_is_shown_at_its_speed() -> None:
    viewer_is_there()
    env = make_sim("lane")
    observation, _ = env.reset(seed=0)
    description = LogMetadata.of_env(env)
    stream = LiveStream(description, env.unwrapped, {"loss": "loss"}, port=0, speed=2.5)
    with closing(env), closing(stream):
        assert not stream.begin_episode(0, "p"), "nobody looks"
        viewer = Watcher(stream.url)
        assert stream.begin_episode(1, "p")
        for k in range(4):
            stream.look(env.unwrapped, 0.0)
            stream.pause()
            after, reward, *_ = env.step(1)
            assert stream.show(LiveStep(1, k, observation, 1, float(reward), False, k == 3))
            observation = after
        stream.end_episode(EpisodeSummary(1, 4, 0.0, False, True, 0, 0, "off_lane"))
        assert not stream.begin_episode(2, "p"), "the first episode is still on screen"
        time.sleep(0.5)
    seen = viewer.seen()["messages"]
    times: dict[str, list[int]] = {}
    for message in seen:
        times.setdefault(message["topic"], []).append(int(message["time"]))
    steps = times["/rl/step"]
    # A step of 0.25 s takes 100 ms, and there are at most 10 scenes per second.
    assert len(steps) == len(times["/scene"]) == 4
    gaps_ns = np.diff(steps)
    assert (gaps_ns >= 100_000_000).all()
    assert times["/tf"] == steps
    motion = [base64.b64decode(m["bytes"]) for m in seen if m["topic"] == "/tf"][1]
    stamps = [
        part.header.stamp.sec * 10**9 + part.header.stamp.nanosec
        for part in messages.decode(motion, "tf2_msgs/msg/TFMessage").transforms
        if part.child_frame_id == "car"
    ]
    assert stamps == sorted(stamps), "viewers draw the motion until the next step"
    assert (stamps[0], stamps[-1]) == (steps[1], steps[2])
    assert times["/rl/phase"][1] == times["/scene/tracks"][0] == steps[-1] + 100_000_000
    end = messages.decode(bytes_of(seen, "/rl/episode"), messages.EPISODE_TYPE)
    assert (end.start_time_ns, end.end_time_ns) == (times["/rosout"][0], times["/rosout"][1])
    warning = messages.decode(bytes_of(seen, "/rosout"), messages.LOG_TYPE)
    assert (warning.level, warning.msg) == (
        messages.WARN,
        "episode 1 ends after 4 steps: off_lane, return 0",
    )


def test_the_rest_of_a_long_episode_is_not_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    viewer_is_there()
    monkeypatch.setattr("mcaprl.recorder.viewer.live_stream.MAX_STEPS", 3)
    env = make_sim("lane")
    observation, _ = env.reset(seed=0)
    description = LogMetadata.of_env(env)
    stream = LiveStream(description, env.unwrapped, {"loss": "loss"}, port=0, speed=math.inf)
    with closing(env), closing(stream):
        viewer = Watcher(stream.url)
        assert stream.begin_episode(7, "p")
        shown = []
        for k in range(3):
            stream.look(env.unwrapped, 0.0)
            stream.pause()
            shown.append(stream.show(LiveStep(7, k, observation, 1, 0.0, False, False)))
        time.sleep(0.3)
    assert shown == [True, True, False]
    seen = viewer.seen()["messages"]
    warning = messages.decode(bytes_of(seen, "/rosout"), messages.LOG_TYPE)
    assert warning.msg == "episode 7 is shown up to step 2 only"
    assert len([m for m in seen if m["topic"] == "/rl/step"]) == 3


def bytes_of(seen: list[Any], topic: str) -> bytes:
    """Return the bytes of the last message of a topic."""
    return base64.b64decode([m["bytes"] for m in seen if m["topic"] == topic][-1])


def test_a_port_in_use_is_refused(log: Path) -> None:
    from mcaprl.recorder.viewer.foxglove_server import LiveServer

    player = Player([Track(McapReader(log))])
    with closing(LiveServer(player, port=0)) as server:
        port = int(server.url.rpartition(":")[2])
        with pytest.raises(UsageError, match=rf"cannot listen on 127.0.0.1:{port}.*`port=`"):
            LiveServer(player, port=port)
