"""Tests of the scene of the highway-lane sim, and of recordings of the scene."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore

import mcaprl
from mcaprl.cli import run
from mcaprl.sims.highway.scene import ASPHALT, GRASS, OTHER_PAINT, PAINT
from tests.support.sims import image_of, near, unwrapped

TRACK: dict[str, Any] = {"road": "racetrack-v0"}


def shapes_of(sim: Any) -> dict[str, Any]:
    return {shape.name: shape for shape in [*sim.static_scene(), *sim.scene()]}


def test_the_road_is_on_the_ground_and_faces_up() -> None:
    sim = unwrapped("highway-lane", **TRACK)
    sim.reset(seed=0)
    triangles = shapes_of(sim)["road"].points.reshape(-1, 3, 3)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert np.all(triangles[:, :, 2] == 0.0)
    assert np.all(normals[:, 2] > 0.0)


def test_lines_are_at_the_edges_of_lanes() -> None:
    """Lines are 2.5 m from the middle of the nearest lane: outer lines solid, others dashed."""
    sim = unwrapped("highway-lane", **TRACK)
    sim.reset(seed=0)
    points = shapes_of(sim)["lines"].points[:, :2]
    offsets = np.array(
        [[course.nearest(x_m, y_m).offset_m for course in sim.courses] for x_m, y_m in points]
    )
    # The ends of highway-env's lanes differ by some decimeters.
    assert np.quantile(np.abs(np.abs(offsets).min(axis=1) - 2.5), 0.95) < 0.1
    # The first lane is the left one.
    left = np.isclose(offsets[:, 0], 2.5, atol=0.1)
    between = np.isclose(offsets[:, 0], -2.5, atol=0.1) & np.isclose(offsets[:, 1], 2.5, atol=0.1)
    assert left.sum() > 1.3 * between.sum()


def test_other_cars_are_shown_at_their_positions() -> None:
    sim = unwrapped("highway-lane", **TRACK)
    sim.reset(seed=0, options={"pose": (60.0, 0.0, 0.2)})
    (other,) = sim.others
    shape = shapes_of(sim)["other_0"]
    assert shape.position[:2] == (other.x_m, other.y_m)
    assert (shape.size[:2], shape.yaw_rad) == ((5.0, 2.0), other.yaw_rad)
    assert abs(sim.courses[0].nearest(other.x_m, other.y_m).offset_m) < 5.1


def test_the_image_shows_the_car_on_its_road() -> None:
    image = image_of("highway-lane", (60.0, 0.0, 0.0), **TRACK)
    assert image.shape == (600, 600, 3)
    rows, columns = np.nonzero(near(image, PAINT))
    assert (abs(rows.mean() - 300) < 3, abs(columns.mean() - 300) < 5) == (True, True)
    assert near(image, OTHER_PAINT).sum() > 100
    # The scale is 7.5 pixels per meter. The left edge of the left lane is 19 pixels above the
    # middle of the image. The two lanes are 75 pixels wide.
    column = image[250:400, 330]
    rows = np.flatnonzero(near(column, ASPHALT))
    assert rows.min() == pytest.approx(50 - 19, abs=3)
    assert rows.max() == pytest.approx(50 + 56, abs=3)
    assert near(column, GRASS).sum() > 60


def test_it_is_recorded_and_replayed_like_any_environment(tmp_path: Path) -> None:
    log, layout = tmp_path / "highway.mcap", tmp_path / "layout.json"
    assert run(["record", "highway-lane", "--out", str(log), "--episodes", "2"]) == 0
    assert run(["check", str(log)]) == 0
    assert run(["layout", "highway-lane", "--out", str(layout)]) == 0
    data = mcaprl.open(log)
    assert data.env_id == "mcaprl/HighwayLane-v0"
    assert [episode.reason for episode in data.episodes] == ["finished", "finished"]
    assert list(data.action_names.values())[:2] == ["straight", "right"]
    store = get_typestore(Stores.ROS2_HUMBLE)
    shown: dict[str, list[Any]] = {}
    with log.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages(
            topics=["/scene", "/scene/static", "/tf"]
        ):
            assert schema is not None
            shown.setdefault(channel.topic, []).append(
                store.deserialize_cdr(message.data, schema.name)
            )
    assert {marker.ns for marker in shown["/scene/static"][0].markers} >= {"road", "lines"}
    # There is at least one message at each start and end of an episode, and at most one for each
    # observation.
    for topic in ("/scene", "/tf"):
        assert 4 <= len(shown[topic]) <= len(data.rewards) + 2
    place = shown["/tf"][0].transforms[0]
    assert (place.header.frame_id, place.child_frame_id) == ("map", "car")
    panels = json.loads(layout.read_text())["configById"]
    assert panels["3D!scene"]["followTf"] == "car"
    assert "lateral_offset_m" in json.dumps(panels)


def test_logged_actions_can_be_repeated(tmp_path: Path) -> None:
    log = tmp_path / "highway.mcap"
    arguments = ["--episodes", "2", "--policy", "random", "--seed", "5"]
    assert run(["record", "highway-lane", "--out", str(log), *arguments]) == 0
    sim = unwrapped("highway-lane")
    for episode in mcaprl.open(log).episodes:
        seen, _ = sim.reset(seed=episode.seed)
        for step, action in enumerate(episode.actions):
            np.testing.assert_array_equal(episode.observations[step], seen)
            seen, reward, terminated, _, _ = sim.step(action)
            assert (episode.rewards[step], episode.terminated[step]) == (reward, terminated)
        np.testing.assert_array_equal(episode.next_observations[-1], seen)
