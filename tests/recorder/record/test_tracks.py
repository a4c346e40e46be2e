"""Topics about whole episodes: phases, log lines, static shapes and tracks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import mcaprl
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.format import messages
from mcaprl.recorder.record.scene import Tracks
from mcaprl.sims import make_sim
from mcaprl.sims.drawing.scene import Shape
from tests.support.recordings import read

START_NS = 1_700_000_000 * 10**9
STEP_NS = 250_000_000
RIGHT = 2
# The vehicle starts at the edge of the lane and drives away at 20 m/s, so that it leaves the lane
# in the first step.
EDGE = {"pose": (60.0, -2.0, -math.pi / 2, 20.0)}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record an interrupted episode of three steps, and an episode that ends off the lane."""
    path = tmp_path_factory.mktemp("phases") / "lane.mcap"
    with closing(mcaprl.RecordMcap(make_sim("lane"), path, start_time_ns=START_NS)) as env:
        env.reset(seed=0)
        for _ in range(3):
            env.step(1)
        env.reset(seed=1)
        while not any(env.step(RIGHT)[2:4]):
            pass
    return path


def test_phase_is_running_until_the_reason_of_the_end(log: Path) -> None:
    found = [(time, text.data) for time, text in read(log, "/rl/phase", messages.TEXT_TYPE)]
    second_ns = START_NS + 4 * STEP_NS
    steps = mcaprl.open(log).episodes[1].length
    assert found == [
        (START_NS, "running"),
        (START_NS + 3 * STEP_NS, "interrupted"),
        (second_ns, "running"),
        (second_ns + steps * STEP_NS, "off_lane"),
    ]


def test_only_the_end_of_a_failed_episode_is_a_warning(log: Path) -> None:
    lines = [(line.level, line.msg) for _, line in read(log, "/rosout", messages.LOG_TYPE)]
    assert [level for level, _ in lines] == [20, 20, 20, 30]
    assert lines[3][1].startswith("episode 1 ends after ")
    assert "off_lane" in lines[3][1]


def test_an_environment_without_success_reasons_causes_no_warnings(tmp_path: Path) -> None:
    path = tmp_path / "cart.mcap"
    with closing(mcaprl.RecordMcap(make_sim("CartPole-v1"), path)) as env:
        env.reset(seed=0)
        while not any(env.step(0)[2:4]):
            pass
    lines = read(path, "/rosout", messages.LOG_TYPE)
    assert [line.level for _, line in lines] == [messages.INFO, messages.INFO]
    assert read(path, "/rl/phase", messages.TEXT_TYPE)[-1][1].data == "terminated"


class _World(gym.Env[Any, Any]):
    """An environment that shows these static shapes; an episode has one step."""

    observation_space = action_space = gym.spaces.Discrete(2)
    shapes: Sequence[Shape] = ()

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[int, dict[str, Any]]:
        return 0, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        return 0, 0.0, True, False, {}

    def static_scene(self) -> Sequence[Shape]:
        return self.shapes

    def scene(self) -> Sequence[Shape]:
        return ()

    static_frames = frames = scene


@pytest.mark.parametrize("kind", [tuple, list])
def test_static_shapes_are_written_when_they_change(tmp_path: Path, kind: Any) -> None:
    white = (1.0, 1.0, 1.0, 1.0)
    first, second = Shape("first", "box", white), Shape("second", "box", white)
    lists = [kind([first]), kind([first]), kind([first, second]), kind([first])]
    world, path = _World(), tmp_path / "world.mcap"
    with closing(mcaprl.RecordMcap(world, path, start_time_ns=0, step_duration_s=1.0)) as env:
        for shapes in lists:
            # The sims return the same object again.
            for world.shapes in (shapes, shapes):
                env.reset()
                env.step(0)
    found = read(path, "/scene/static", "visualization_msgs/msg/MarkerArray")
    assert [(time // 10**9, len(array.markers) - 1) for time, array in found] == [
        (0, 1),
        (8, 2),
        (12, 1),
    ]


def test_static_shapes_in_a_changed_list_are_written(tmp_path: Path) -> None:
    world, path = _World(), tmp_path / "world.mcap"
    world.shapes = shapes = [Shape("first", "box", (1.0, 1.0, 1.0, 1.0))]
    with closing(mcaprl.RecordMcap(world, path)) as env:
        for _ in range(2):
            env.reset()
            env.step(0)
            shapes.append(Shape("second", "box", (1.0, 1.0, 1.0, 1.0)))
    found = read(path, "/scene/static", "visualization_msgs/msg/MarkerArray")
    assert [len(array.markers) - 1 for _, array in found] == [1, 2]


def test_tracks_follow_the_vehicle_and_mark_failures(log: Path) -> None:
    (first_ns, first), (second_ns, second) = read(
        log, "/scene/tracks", "visualization_msgs/msg/MarkerArray"
    )
    ends = [int(episode.log_time_ns[-1]) for episode in mcaprl.open(log).episodes]
    assert [first_ns, second_ns] == ends
    assert [marker.ns for marker in first.markers] == ["", "track_0"]
    assert [marker.ns for marker in second.markers] == ["", "track_0", "track_1", "failed_1"]
    places = [
        transform.transforms[0].transform.translation
        for _, transform in read(log, "/tf", "tf2_msgs/msg/TFMessage")
    ]
    begin, end = first.markers[1].points[0], first.markers[1].points[-1]
    assert math.isclose(begin.x, places[0].x, abs_tol=1 / 64)
    mark = second.markers[3].pose.position
    assert math.isclose(mark.x, places[-1].x, abs_tol=1 / 64)
    assert math.isclose(mark.y, places[-1].y, abs_tol=1 / 64)
    assert end.x != begin.x


def test_track_colors_and_points_by_hand() -> None:
    tracks = Tracks()
    for episode, (steps, total_reward) in enumerate([(2, 0.0), (200, 10.0), (3, 5.0), (1, 7.0)]):
        tracks.begin()
        for step in range(steps):
            tracks.add((float(step), 0.0, 1.0))
        tracks.end(episode, total_reward, failed=episode == 2)
    lowest, highest, middle, mark = tracks.shapes()
    assert [len(shape.points) for shape in (lowest, highest, middle)] == [2, 64, 3]
    np.testing.assert_allclose(lowest.color, (0.30, 0.25, 0.80, 1.0))
    np.testing.assert_allclose(highest.color, (0.98, 0.85, 0.25, 1.0))
    np.testing.assert_allclose(middle.color, (0.64, 0.55, 0.525, 1.0))
    assert lowest.size[0] == 199 / 250
    assert (mark.name, mark.position) == ("failed_2", (2.0, 0.0, 1.2))
    assert highest.points[-1].tolist() == [199.0, 0.0, 1.2]


def test_the_track_of_the_running_episode_by_hand() -> None:
    """It is due at 1 position, 4 later, and then at each sixteenth more, with 64 points at most."""
    tracks = Tracks()
    assert tracks.so_far(2.0) == []
    due = [step for step in range(200) if tracks.add((float(step), 0.0, 1.0))]
    assert due[:4] == [0, 4, 8, 12]
    # 162 + 162 // 16 = 172, 172 + 10 = 182, and 182 + 11 = 193 positions.
    assert due[-4:] == [161, 171, 181, 192]
    (line,) = tracks.so_far(2.0)
    assert line.points[:, 0].tolist() == list(range(0, 200, 4)), "200 / 64 is above 2"
    assert (line.kind, line.size[0]) == ("line", 2.0)
    tracks.begin()
    assert tracks.add((0.0, 0.0, 0.0))
    assert tracks.so_far(2.0) == []


def test_the_map_has_route_track_and_vehicle(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with closing(mcaprl.RecordMcap(make_sim("powerline"), path)) as env:
        for _ in range(2):
            env.reset(seed=1)
            for _ in range(9):
                env.step(0)
    shown = read(path, "/scene/map", "visualization_msgs/msg/MarkerArray")
    names = [[marker.ns for marker in array.markers[1:]] for _, array in shown]
    first, later = ["route", "towers", "vehicle"], ["route", "towers", "track", "vehicle"]
    assert names == [first, later, later] * 2
    markers = {marker.ns: marker for marker in shown[-1][1].markers}
    assert (len(markers["route"].points), len(markers["track"].points)) == (5, 9)
    starts = [episode.log_time_ns[0] for episode in mcaprl.open(path).episodes]
    assert [shown[0][0], shown[3][0]] == starts


def test_only_the_latest_tracks_are_kept() -> None:
    tracks = Tracks()
    for episode in range(40):
        tracks.begin()
        tracks.add((0.0, 0.0, 0.0))
        tracks.add((1.0, 0.0, 0.0))
        tracks.end(episode, math.nan if episode == 39 else math.inf, failed=False)
    shapes = tracks.shapes()
    assert [shape.name for shape in shapes] == [f"track_{k}" for k in range(8, 40)]
    assert all(0 <= part <= 1 for shape in shapes for part in shape.color)


def test_tracks_are_a_small_part_of_a_log_of_short_episodes(tmp_path: Path) -> None:
    path = tmp_path / "short.mcap"
    with closing(mcaprl.RecordMcap(make_sim("lane"), path)) as env:
        for _ in range(60):
            env.reset(options=EDGE)
            env.step(1)
    reader = McapReader(path)
    sizes = {
        channel.topic: sum(len(data) for _, data in reader.messages(channel))
        for channel in reader.channels.values()
    }
    shown = sum(sizes[topic] for topic in ("/scene", "/scene/static", "/tf", "/telemetry"))
    assert 0 < sizes["/scene/tracks"] <= shown / 4
