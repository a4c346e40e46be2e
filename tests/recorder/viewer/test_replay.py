"""Display topics: scene, frames, depth, log lines and layout, complete at any time."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any, get_args

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.cli import run
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.topic import Topic
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.record.layout import layout_of
from mcaprl.recorder.record.scene import (
    MARKER_TYPES,
    DepthSource,
    SceneSource,
    TelemetrySource,
    depth_millimeters,
    marker_array,
)
from mcaprl.sims import SIMS, make_sim
from mcaprl.sims.drawing.scene import Kind, Shape
from mcaprl.sims.evaluation.pilots import make_pilot
from tests.support.layouts import check_layout, series_of

EPISODES, STEPS = 2, 12


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record two episodes of the lane sim with all display topics."""
    path = tmp_path_factory.mktemp("replay") / "lane.mcap"
    env = gym.make("mcaprl/LaneKeeping-v0")
    pilot = make_pilot(env)
    with closing(mcaprl.RecordMcap(env, path, camera=True, policy="pilot")) as recorder:
        for episode in range(EPISODES):
            observation, _ = recorder.reset(seed=episode)
            for _ in range(STEPS):
                observation = recorder.step(pilot.act(observation[None])[0])[0]
    return path


def read(path: Path, topic: str, type_name: str) -> list[tuple[int, Any]]:
    reader = McapReader(path)
    channel = reader.channel_of(topic)
    assert channel is not None, f"no topic {topic}"
    assert reader.schema_of(channel).name == type_name
    return [(time, messages.decode(data, type_name)) for time, data in reader.messages(channel)]


def step_times(path: Path) -> list[list[int]]:
    return [episode.log_time_ns.tolist() for episode in mcaprl.open(path).episodes]


def test_the_lane_sim_records_all_display_topics() -> None:
    env = gym.make("mcaprl/LaneKeeping-v0").unwrapped
    assert isinstance(env, SceneSource)
    assert isinstance(env, TelemetrySource)
    assert isinstance(env, DepthSource)


def test_moving_topics_have_one_message_a_step(log: Path) -> None:
    times = [time for episode in step_times(log) for time in episode]
    for topic, type_name in (
        ("/scene", "visualization_msgs/msg/MarkerArray"),
        ("/camera/depth", "sensor_msgs/msg/Image"),
    ):
        assert [time for time, _ in read(log, topic, type_name)] == times, topic


def test_frames_move_twenty_times_a_second(log: Path) -> None:
    """A step of the lane sim takes 0.25 s: four frames within it, and one at its end."""
    messages_of_tf = read(log, "/tf", "tf2_msgs/msg/TFMessage")
    for times in step_times(log):
        moved = [time for time, _ in messages_of_tf if times[0] <= time <= times[-1]]
        assert moved == list(range(times[0], times[-1] + 1, 50_000_000))
    for time, message in messages_of_tf:
        stamp = message.transforms[0].header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == time


def test_unchanged_static_topics_are_written_once(log: Path) -> None:
    start = step_times(log)[0][0]
    scenes = read(log, "/scene/static", "visualization_msgs/msg/MarkerArray")
    assert [time for time, _ in scenes] == [start]
    assert [time for time, _ in read(log, "/tf_static", "tf2_msgs/msg/TFMessage")] == [start]
    for _, scene in scenes:
        names = [marker.ns for marker in scene.markers[1:]]
        assert len(names) == len(set(names)), "a marker is known by its name"
        assert len(names) > 20


def test_a_frequently_changing_scene_is_subsampled(tmp_path: Path) -> None:
    """The racer has ten steps a second; the scene is written five times a second and at the end."""
    path = tmp_path / "racer.mcap"
    with closing(mcaprl.RecordMcap(gym.make("mcaprl/Racer-v0"), path)) as recorder:
        for _ in range(2):
            recorder.reset(seed=0)
            for _ in range(5):
                recorder.step(0)
    times = step_times(path)
    drawn = [time for time, _ in read(path, "/scene", "visualization_msgs/msg/MarkerArray")]
    assert drawn == [episode[step] for episode in times for step in (0, 2, 4, 5)]


def test_each_scene_message_is_complete(log: Path) -> None:
    """A viewer that seeks clears the topic and draws only this message."""
    for topic in ("/scene", "/scene/static"):
        for _, array in read(log, topic, "visualization_msgs/msg/MarkerArray"):
            first, *rest = array.markers
            assert first.action == 3, "the first marker deletes all"
            assert rest
            for marker in rest:
                assert marker.action == 0
                assert marker.type in MARKER_TYPES.values()
                assert marker.color.a > 0, f"{marker.ns} cannot be seen"
                assert marker.frame_locked
                assert (marker.header.stamp.sec, marker.header.stamp.nanosec) == (0, 0)
                assert (marker.lifetime.sec, marker.lifetime.nanosec) == (0, 0)
                assert all(np.isfinite([p.x, p.y, p.z]).all() for p in marker.points)


def test_frames_form_a_tree_under_map(log: Path) -> None:
    moving = read(log, "/tf", "tf2_msgs/msg/TFMessage")[0][1].transforms
    fixed = read(log, "/tf_static", "tf2_msgs/msg/TFMessage")[0][1].transforms
    parents = {t.child_frame_id: t.header.frame_id for t in [*moving, *fixed]}
    for frame in parents:
        seen = frame
        for _ in parents:
            seen = parents.get(seen, seen)
        assert seen == "map"
    used = {
        marker.header.frame_id
        for topic in ("/scene", "/scene/static")
        for marker in read(log, topic, "visualization_msgs/msg/MarkerArray")[0][1].markers
    }
    assert used <= {"map", *parents}
    for transform in moving:
        q = transform.transform.rotation
        assert np.isclose(q.x**2 + q.y**2 + q.z**2 + q.w**2, 1, atol=1e-3)


def test_car_frame_agrees_with_the_telemetry(log: Path) -> None:
    reported = Topic(McapReader(log), "/telemetry").read(["x_m", "y_m", "speed_m_s"])
    steps = {time for episode in step_times(log) for time in episode}
    moved = read(log, "/tf", "tf2_msgs/msg/TFMessage")
    frames = [message.transforms[0] for time, message in moved if time in steps]
    assert [frame.child_frame_id for frame in frames] == ["car"] * len(reported["x_m"])
    for axis in "xy":
        places = [getattr(frame.transform.translation, axis) for frame in frames]
        np.testing.assert_allclose(places, reported[f"{axis}_m"], rtol=2**-16, atol=2**-10)
    assert (reported["speed_m_s"] >= 0).all()


def test_depth_is_in_millimeters() -> None:
    meters = np.array([[0.0, 1.2344, np.inf], [65.535, 65.536, 50.0]], np.float32)
    assert depth_millimeters(meters).tolist() == [[0, 1234, 0], [65535, 0, 50000]]


def test_depth_topic(log: Path) -> None:
    for _, image in read(log, "/camera/depth", "sensor_msgs/msg/Image"):
        assert image.encoding == "16UC1"
        assert image.step == 2 * image.width
        depth = image.data.view("<u2").reshape(image.height, image.width)
        assert 0 < np.median(depth[-10:]) < 10_000, "the road before the car is near"
        assert (depth > 20_000).any(), "something far is seen, too"


def test_log_lines(log: Path) -> None:
    lines = [line.msg for _, line in read(log, "/rosout", "rcl_interfaces/msg/Log")]
    assert len(lines) == 2 * EPISODES
    assert lines[0] == "episode 0 begins, pilot acts"
    assert lines[1].startswith(f"episode 0 ends after {STEPS} steps: interrupted, return ")


def test_layout_is_attached_and_classic(log: Path) -> None:
    layout = check_layout(log)
    kinds = {panel.split("!")[0] for panel in layout["configById"]}
    assert kinds == {"3D", "Image", "Plot", "StateTransitions", "RosOut", "Tab"}
    assert layout["configById"]["3D!scene"]["followTf"] == "car"
    depth = layout["configById"]["Image!depth"]["imageMode"]
    assert depth["imageTopic"] == "/camera/depth"
    assert depth["colorMode"] == "colormap"
    assert depth["minValue"] < depth["maxValue"]


@pytest.mark.parametrize("sim", [*SIMS, "CartPole-v1", "Pendulum-v1"])
def test_layouts_refer_to_paths_in_the_log(sim: str, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    env = make_sim(sim)
    with closing(mcaprl.RecordMcap(env, path)) as recorder:
        recorder.reset(seed=0)
        recorder.step(env.action_space.sample())
    data = mcaprl.open(path)
    labels = series_of(check_layout(path))
    assert "reward" in labels
    assert {"return so far", "return of episode"} & set(labels)
    assert "episode" in labels
    assert set(data.observation_names[:24]) <= set(labels)
    assert set(data.action_names.values()) or "action[0]" in labels
    assert set(data.action_names.values()) <= set(labels)


def test_cumulative_return_is_the_sum_of_rewards(log: Path) -> None:
    reported = Topic(McapReader(log), "/telemetry").read(("return_so_far",))["return_so_far"]
    rewards = [episode.rewards for episode in mcaprl.open(log).episodes]
    sums = np.concatenate([[0.0, *np.cumsum(reward)] for reward in rewards])
    np.testing.assert_allclose(reported, sums, rtol=2**-16)


@pytest.mark.parametrize(("sim", "episodes"), [("lane", 4), ("powerline", 10), ("racer", 1)])
def test_a_scene_makes_a_log_at_most_three_times_as_large(
    sim: str, episodes: int, tmp_path: Path
) -> None:
    sizes: list[int] = []
    for options in ([], ["--no-scene"]):
        path = tmp_path / f"{len(sizes)}.mcap"
        command = ["record", sim, "--epsilon", "0.1", "--episodes", str(episodes), *options]
        assert run([*command, "--out", str(path)]) == 0
        sizes.append(path.stat().st_size)
    assert sizes[0] <= 3 * sizes[1]


def test_layout_without_a_scene() -> None:
    metadata = LogMetadata(
        observation_space=spaces.Box(-1, 1, (2,), np.float32),
        action_space=spaces.Discrete(2),
        observation_names=("x", "v"),
        action_meanings=("left", "right"),
    )
    layout = layout_of(metadata, ["/rosout", "/rl/values"])
    assert "3D!scene" not in layout["configById"]
    series = {
        path["label"]: path["value"]
        for panel in layout["configById"].values()
        for path in panel.get("paths", [])
    }
    assert series["x"] == "/rl/step.observation[0]"
    assert series["Q right"] == "/rl/values.q[1]"
    assert series["action (0 left, 1 right)"] == "/rl/step.action"


def test_each_kind_of_marker_has_its_position() -> None:
    assert set(MARKER_TYPES) == set(get_args(Kind))
    shapes = [
        Shape(name=kind, kind=kind, color=(1, 0, 0, 1), points=np.eye(3), yaw_rad=np.pi / 2)
        for kind in get_args(Kind)
    ]
    array = messages.decode(marker_array(shapes), "visualization_msgs/msg/MarkerArray")
    for shape, marker in zip(shapes, array.markers[1:], strict=True):
        assert marker.type == MARKER_TYPES[shape.kind]
        assert np.isclose(marker.pose.orientation.z, np.sin(np.pi / 4))
        assert [(p.x, p.y, p.z) for p in marker.points] == [(1, 0, 0), (0, 1, 0), (0, 0, 1)]


def test_without_a_scene_only_transitions_are_recorded(tmp_path: Path) -> None:
    path = tmp_path / "plain.mcap"
    env = gym.make("mcaprl/LaneKeeping-v0")
    with closing(mcaprl.RecordMcap(env, path, scene=False)) as recorder:
        recorder.reset(seed=0)
        recorder.step(1)
    topics = {channel.topic for channel in McapReader(path).channels.values()}
    assert topics == {"/rl/step", "/rl/episode", "/rl/phase", "/rosout"}


def test_vectors_are_read_without_the_images(tmp_path: Path) -> None:
    """Each chunk contains one kind of topic; steps are never in a chunk with images."""
    path = tmp_path / "depth.mcap"
    env = gym.make("mcaprl/LaneKeeping-v0", observation="depth")
    with closing(mcaprl.RecordMcap(env, path)) as recorder:
        recorder.reset(seed=0)
        for _ in range(150):
            if any(recorder.step(1)[2:4]):
                recorder.reset()
    reader = McapReader(path)
    by_id = {channel.id: channel.topic for channel in reader.channels.values()}
    kinds = {frozenset(by_id[c] for c in chunk.message_index_offsets) for chunk in reader.chunks}
    assert frozenset({"/rl/step"}) in kinds
    assert frozenset({"/rl/observation/image"}) in kinds
    assert frozenset({"/camera/depth"}) in kinds
    data = mcaprl.open(path)
    assert data.observations.shape[1:] == (84, 84, 1)
