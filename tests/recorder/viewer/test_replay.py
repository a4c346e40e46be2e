"""Display topics: scene, frames, depth, log lines and layout are complete at any time."""

from __future__ import annotations

from contextlib import closing
from itertools import pairwise
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
    motion_transforms,
)
from mcaprl.recorder.viewer.playback import moments_of_episode
from mcaprl.sims import SIMS, make_sim
from mcaprl.sims.drawing.scene import Frame, Kind, Shape, cut
from mcaprl.sims.evaluation.evaluate import make_pilot
from tests.support.layouts import check_layout, series_of
from tests.support.recordings import read

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


def stamps(message: Any) -> list[int]:
    headers = [transform.header for transform in message.transforms]
    return [header.stamp.sec * 10**9 + header.stamp.nanosec for header in headers]


def test_frames_at_each_step_reach_to_the_next(log: Path) -> None:
    """Each message has poses from its step to the next step, 0.05 s or a multiple apart."""
    found = read(log, "/tf", "tf2_msgs/msg/TFMessage")
    times = step_times(log)
    assert [time for time, _ in found] == [time for episode in times for time in episode]
    after = {now: end for episode in times for now, end in pairwise([*episode, episode[-1]])}
    for time, message in found:
        seen = stamps(message)
        assert (seen[0], seen[-1]) == (time, after[time])
        assert all((stamp - time) % 50_000_000 == 0 for stamp in seen)
        assert seen == sorted(set(seen))
    between = [len(message.transforms) for _, message in found]
    assert max(between) > 2, "a bend needs more than its ends"


def test_poses_within_a_step_are_found_by_interpolation(log: Path, tmp_path: Path) -> None:
    """The path that a viewer draws differs from the path of the sim by at most 0.04 m."""
    path, env = tmp_path / "lane.mcap", gym.make("mcaprl/LaneKeeping-v0")
    way: list[tuple[int, tuple[float, ...]]] = []
    with closing(mcaprl.RecordMcap(env, path)) as recorder:
        recorder.reset(seed=0)
        sim: Any = env.unwrapped
        for step in range(1, 9):
            recorder.step(step % 6)
            end = 250_000_000 * step
            way += [(end - round(left * 1e9), each[0].position) for left, each in sim.motion()]
    (episode,) = mcaprl.open(path).episodes
    seen = list(moments_of_episode(McapReader(path), episode, parts=5))
    start, drawn = seen[0].time_ns, {each.time_ns: each.frames[0].position for each in seen}
    assert len(way) == 8 * 4
    assert len(drawn) == 8 * 5 + 1
    for time, position in way:
        np.testing.assert_allclose(drawn[start + time], position, atol=0.04 + 2**-8)


def test_knots_by_hand() -> None:
    """A stop after 0.1 s needs one pose between the ends; uniform motion needs no such pose."""
    still = (0.0, 0.0, 0.0, 1.0)

    def moments(places_m: list[float]) -> list[tuple[int, list[Frame]]]:
        return [(k * 10**8, [Frame("car", (x, 0.0, 0.0), still)]) for k, x in enumerate(places_m)]

    for places_m, kept in (
        ([0.0, 1.0, 1.0, 1.0], [0, 1, 3]),
        ([0.0, 1.0, 2.0, 3.0], [0, 3]),
        ([0.0, 1.0, 2.03, 3.0], [0, 3]),
        ([5.0], [0]),
    ):
        data = motion_transforms(moments(places_m))
        tree = messages.decode(data, "tf2_msgs/msg/TFMessage")
        assert stamps(tree) == [k * 10**8 for k in kept], places_m
        found = [transform.transform.translation.x for transform in tree.transforms]
        assert found == [places_m[k] for k in kept]


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
    """At 25 steps per second, the scene is written in every second step and at the end."""
    path, env = tmp_path / "racer.mcap", gym.make("mcaprl/Racer-v0")
    sim: Any = env.unwrapped
    sim.step_duration_s = 0.04
    with closing(mcaprl.RecordMcap(env, path)) as recorder:
        for _ in range(2):
            recorder.reset(seed=0)
            for _ in range(5):
                recorder.step(0)
    times = step_times(path)
    drawn = [time for time, _ in read(path, "/scene", "visualization_msgs/msg/MarkerArray")]
    assert drawn == [episode[step] for episode in times for step in (0, 2, 4, 5)]


def test_each_scene_message_is_complete(log: Path) -> None:
    """After a seek, a viewer clears the topic and draws only this message."""
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
    frames = [m.transforms[0] for _, m in read(log, "/tf", "tf2_msgs/msg/TFMessage")]
    assert [frame.child_frame_id for frame in frames] == ["car"] * len(reported["x_m"])
    for axis in "xy":
        places = [getattr(frame.transform.translation, axis) for frame in frames]
        np.testing.assert_allclose(places, reported[f"{axis}_m"], rtol=2**-16, atol=2**-8)
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
    shown = {"3D", "Image", "Plot", "StateTransitions", "RosOut", "Tab", "Gauge", "Indicator"}
    assert kinds == shown | {"RawMessages", "GlobalVariableSliderPanel"}
    (screens,) = [layout["configById"][layout["layout"]]]
    assert [tab["title"] for tab in screens["tabs"]] == ["Drive", "Learning", "Data"]
    views = [layout["configById"][f"3D!{name}"] for name in ("scene", "above")]
    for view in views:
        assert view["scene"]["transforms"]["enablePreloading"] is True
        assert view["scene"]["transforms"]["showLabel"] is False
        assert not any(topic["showOutlines"] for topic in view["topics"].values())
    assert views[1]["cameraState"]["perspective"] is False
    assert "/scene/tracks" in views[1]["topics"]
    rules = {rule["rawValue"]: rule["color"] for rule in _panel(layout, "Indicator")["rules"]}
    assert rules["interrupted"] == "#4e98e2"
    assert rules["time_limit"] == "#31b57b", "that is success in this sim"
    assert rules["off_lane"] == rules["crash"] == "#d64545"
    actions = _panel(layout, "StateTransitions")
    assert (actions["xAxisRange"], actions["isSynced"]) == (20, False)
    assert layout["configById"]["3D!scene"]["followTf"] == "car"
    depth = layout["configById"]["Image!depth"]["imageMode"]
    assert depth["imageTopic"] == "/camera/depth"
    assert depth["colorMode"] == "colormap"
    assert depth["minValue"] < depth["maxValue"]


def _panel(layout: dict[str, Any], kind: str) -> dict[str, Any]:
    """Return the first panel of a kind."""
    panels = layout["configById"].items()
    found: dict[str, Any] = next(panel for name, panel in panels if name.startswith(f"{kind}!"))
    return found


def test_each_sim_has_its_own_camera_and_ranges(tmp_path: Path) -> None:
    layouts = {}
    for sim in ("lane", "powerline", "racer"):
        path = tmp_path / f"{sim}.mcap"
        with closing(mcaprl.RecordMcap(make_sim(sim), path, camera=sim != "racer")) as env:
            env.reset(seed=0)
            env.step(0)
        layouts[sim] = mcaprl.layout(path)
        without = tmp_path / f"{sim}-without.mcap"
        mcaprl.open(path).save(without)
        # The log contains the view settings, so they are available for a new layout.
        assert LogMetadata.from_strings(McapReader(without).metadata["mcaprl.dataset"]).view
    cameras = {
        sim: layout["configById"]["3D!scene"]["cameraState"] for sim, layout in layouts.items()
    }
    assert {sim: camera["distance"] for sim, camera in cameras.items()} == {
        "lane": 22,
        "powerline": 20,
        "racer": 15,
    }
    depth = layouts["lane"]["configById"]["Image!depth"]
    # The lowest tenth of the colors is almost black: only missing depths are black.
    assert (depth["imageMode"]["minValue"], depth["imageMode"]["maxValue"]) == (0, 56_000)
    drone = layouts["powerline"]["configById"]["Image!depth"]["imageMode"]
    assert (drone["minValue"], drone["maxValue"]) == (1000 * (8 - 0.1 * 48), 56_000)
    assert depth["foxglovePanelTitle"] == "depth 3-56 m, black: none"


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
    assert {"return so far", "return of each episode"} & set(labels)
    assert "episode" in labels
    assert set(data.observation_names[:24]) <= set(labels)
    assert set(data.action_names.values()) or "action[0]" in labels
    assert set(data.action_names.values()) <= set(labels)


def test_cumulative_return_is_the_sum_of_rewards(log: Path) -> None:
    reported = Topic(McapReader(log), "/telemetry").read(("return_so_far",))["return_so_far"]
    rewards = [episode.rewards for episode in mcaprl.open(log).episodes]
    sums = np.concatenate([[0.0, *np.cumsum(reward)] for reward in rewards])
    np.testing.assert_allclose(reported, sums, rtol=2**-16)


@pytest.mark.parametrize("sim", ["lane", "powerline", "racer", "highway-lane"])
def test_a_scene_makes_a_log_at_most_three_times_as_large(sim: str, tmp_path: Path) -> None:
    sizes: list[int] = []
    for options in ([], ["--no-scene"]):
        path = tmp_path / f"{len(sizes)}.mcap"
        command = ["record", sim, "--episodes", "2", "--seed", "1", *options]
        assert run([*command, "--out", str(path)]) == 0
        sizes.append(path.stat().st_size)
    assert sizes[0] <= 3 * sizes[1]


def test_segments_are_cut_into_pieces() -> None:
    """Cut a segment of 7 m along y into pieces of at most 3 m."""
    pieces = cut(np.array([[1.0, 0.0, 0.5], [1.0, 7.0, 0.5]]), 3.0)
    assert pieces[:, 1].tolist() == [0.0, 3.0, 3.0, 6.0, 6.0, 7.0]
    assert np.unique(pieces[:, [0, 2]], axis=0).tolist() == [[1.0, 0.5]]


def test_depth_images_have_a_camera(log: Path) -> None:
    """The focal lengths follow from the field of view.

    In x, 84 pixels cover 90 degrees, so the focal length is 84 / 2 = 42 pixels. The 84 x 84 image
    shows a view with the aspect ratio 256 : 144, so the focal length in y is 42 * 256 / 144.
    """
    ((time, info),) = read(log, "/camera/camera_info", "sensor_msgs/msg/CameraInfo")
    assert time == step_times(log)[0][0]
    assert (info.width, info.height, info.header.frame_id) == (84, 84, "camera")
    wanted = [42.0, 0.0, 41.5, 0.0, 42.0 * 256 / 144, 41.5, 0.0, 0.0, 1.0]
    np.testing.assert_allclose(info.k, wanted)
    np.testing.assert_allclose(info.p.reshape(3, 4)[:, :3].ravel(), wanted)


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
    assert series["x"] == "/rl/step{final==false}.observation[0]"
    assert series["right"] == "/rl/step{action==1}{final==false}.action"
    assert series["Q"] == "/rl/values.q[:]"
    assert series["action"] == "/rl/step{final==false}.action"


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
    """Each chunk contains one kind of topic, so no chunk has both step records and images."""
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
