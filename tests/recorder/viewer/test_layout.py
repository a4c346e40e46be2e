"""Layouts: every message path exists in the log, and every panel is large enough to read."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.recorder.dataset.log_reader import describe
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.format.writing import McapWriter
from mcaprl.recorder.record.layout import layout_of
from mcaprl.recorder.record.panels import share_of_transitions
from mcaprl.recorder.viewer.annotate import annotated_copy, layout_of_log
from mcaprl.recorder.viewer.foxglove_server import side_by_side
from mcaprl.recorder.viewer.page.log_page import LogPage
from mcaprl.sims import make_sim
from mcaprl.sims.evaluation.evaluate import make_pilot
from tests.recorder.viewer.test_browser_page import unpacked
from tests.support.bags import STEPS, write_rosbag2
from tests.support.layouts import (
    AREA_PX,
    Topics,
    check_layout,
    check_panels,
    paths_of,
    series_of,
    sizes_of,
)
from tests.support.recordings import read

SIMS: list[tuple[str, dict[str, Any]]] = [
    ("lane", {}),
    ("lane", {"observation": "rays"}),
    ("lane", {"observation": "depth"}),
    ("powerline", {}),
    ("racer", {}),
    ("highway-lane", {}),
    ("CartPole-v1", {}),
    ("Pendulum-v1", {}),
]


def recorded(path: Path, sim: str, steps: int = 3, **options: Any) -> Path:
    """Record two short episodes of a sim, with the depth camera if the sim has one."""
    env = make_sim(sim, **options)
    camera = hasattr(env.unwrapped, "depth_image_m")
    with closing(mcaprl.RecordMcap(env, path, camera=camera)) as recorder:
        for seed in range(2):
            recorder.reset(seed=seed)
            for _ in range(steps):
                recorder.step(env.action_space.sample())
    return path


def annotated(source: Path, out: Path, names: list[str]) -> Path:
    """Add the outputs of policies, with zero for all values."""
    data = mcaprl.open(source)
    actions = len(data.action_names)
    with annotated_copy(source, out) as copy:
        for name in names:
            found = []
            for episode in data.episodes:
                zeros = np.zeros(episode.length, np.float32)
                columns: dict[str, Any] = {
                    name: np.zeros((episode.length, actions), np.float32)
                    for name in ("q", "preference")
                }
                columns |= dict.fromkeys(("value", "advantage", "td_error", "entropy"), zeros)
                columns |= {"policy_action": zeros.astype(np.int64), "agrees": zeros.astype(bool)}
                found.append((episode.log_time_ns[:-1], columns))
            copy.add_values(name, found)
    return out


@pytest.mark.parametrize(("sim", "options"), SIMS)
def test_paths_are_in_the_log(sim: str, options: dict[str, Any], tmp_path: Path) -> None:
    path = recorded(tmp_path / "log.mcap", sim, **options)
    attached = check_layout(path)
    # A layout that is created from the topics of the log has the same panels.
    again = layout_of_log(McapReader(path))
    check_panels(again, Topics.of_log(path))
    assert again["configById"].keys() == attached["configById"].keys()
    screens = attached["configById"][attached["layout"]]["tabs"]
    assert [tab["title"] for tab in screens] == ["Drive", "Learning", "Data"]


@pytest.mark.parametrize("names", [["/rl/values"], ["/rl/values/a", "/rl/values/b"]])
@pytest.mark.parametrize("sim", ["lane", "highway-lane", "CartPole-v1"])
def test_paths_are_in_annotated_logs(sim: str, names: list[str], tmp_path: Path) -> None:
    source = recorded(tmp_path / "log.mcap", sim)
    path = annotated(source, tmp_path / "annotated.mcap", names)
    panels = check_layout(path)["configById"]
    rows = [row["label"] for row in panels["StateTransitions!actions"]["paths"]]
    expected = {
        1: ["episode", "step", "action", "would take"],
        2: ["episode", "step", "action", "a would take", "b would take"],
    }
    assert rows == expected[len(names)]
    if sim == "lane":
        constants = Topics.of_log(path).constants(names[0])
        assert (constants["BRAKE"], constants["SLIGHTLY_LEFT"]) == (0, 5)


def test_the_topics_of_a_robot_are_shown(tmp_path: Path) -> None:
    mapping = {
        "clock": {"rate_hz": 10},
        "observation": {"speed": {"field": "/odom.twist.twist.linear.x"}},
        "action": {"fields": ["/cmd_vel.angular.z"], "box": {"low": -1, "high": 1}},
        "keep": ["/odom", "/tf", "/camera/*"],
    }
    path = tmp_path / "robot.mcap"
    mcaprl.convert(mcaprl.open(write_rosbag2(tmp_path / "bag"), mapping=mapping), path)
    layout = layout_of_log(McapReader(path))
    check_panels(layout, Topics.of_log(path))
    shown = {name for name in layout["configById"] if "/odom" in name or name[:2] in ("3D", "Im")}
    assert shown == {"Plot!/odom", "3D!robot", "Image!depth"}
    # The page shows, at each step, the last depth image up to it: of 1000 + k millimeters.
    (image,) = unpacked(LogPage(path).episode(0))["images"]
    assert image["title"] == "depth, 0 to 50 m"
    assert image["steps"].tolist() == list(range(STEPS))
    assert np.ravel(image["pixels"][:, 0, 0]).tolist() == [
        1 + round((1 + k / 1000) / 50 * 254) for k in range(STEPS)
    ]


@pytest.mark.parametrize("kind", ["json", "32FC1"])
def test_what_viewers_cannot_show_is_not_in_the_layout(kind: str, tmp_path: Path) -> None:
    """Topics of a robot that have the name, but not the type, of those of a recording."""
    path = recorded(tmp_path / "log.mcap", "CartPole-v1")
    mcap = McapWriter(path, append=True)
    for topic in ("/tf", "/telemetry", "/camera/depth"):
        if kind == "json":
            mcap.write_messages([(mcap.add_topic(topic, "json", ("", "", b"")), 1, b"{}")])
        elif topic == "/camera/depth":
            name = "sensor_msgs/msg/Image"
            channel = mcap.add_channel(topic, name, messages.definition(name))
            image = messages.new(
                name,
                header=messages.header(1, "camera"),
                **{"height": 1, "width": 1, "encoding": kind, "is_bigendian": 0, "step": 4},
                data=np.zeros(4, np.uint8),
            )
            mcap.write_messages([(channel, 1, messages.encode(image))])
    mcap.close()
    panels = layout_of_log(McapReader(path))["configById"]
    assert "Image!depth" not in panels
    assert ("Image!/camera/depth" in panels) == (kind == "32FC1")
    assert unpacked(LogPage(path).episode(0))["images"] == []


@pytest.mark.parametrize("prefixes", [["a", "b"], ["1_lane", "2_lane"]])
def test_paths_are_in_several_logs(prefixes: list[str], tmp_path: Path) -> None:
    first = recorded(tmp_path / "a.mcap", "lane")
    second = annotated(first, tmp_path / "b.mcap", ["/rl/values"])
    both = side_by_side([layout_of_log(McapReader(path)) for path in (first, second)], prefixes)
    logs = [Topics.of_log(*pair) for pair in zip((first, second), prefixes, strict=True)]
    logs[0].names |= logs[1].names
    logs[0].types |= logs[1].types
    # Two logs need a window of 1600 pixels.
    check_panels(both, logs[0], (1600, AREA_PX[1]))
    a, b = prefixes
    panels = both["configById"]
    assert both["globalVariables"] == {f"{a}_episode": 0, f"{b}_episode": 0}
    assert panels[f"GlobalVariableSliderPanel!{b} episode"]["globalVariableName"] == f"{b}_episode"
    chosen = f"/{b}/rl/step{{episode==${b}_episode}}{{final==false}}.reward"
    assert paths_of(panels[f"Plot!{b} episode"]) == [chosen]
    hidden = panels[f"3D!{a} above"]["transforms"]
    assert hidden.keys() == {"frame:map", f"frame:{a}/camera"}
    assert panels[f"3D!{a} scene"]["lichtblickPanelTitle"] == f"{a}: scene"
    screens = panels["Tab!screens"]["tabs"]
    assert [tab["title"] for tab in screens] == ["Drive", "Learning", "Data"]
    assert all(tab["layout"]["direction"] == "row" for tab in screens)


def test_logs_with_other_layouts_are_shown_in_a_row(tmp_path: Path) -> None:
    own = {"configById": {"Plot!x": {"paths": []}}, "layout": "Plot!x"}
    path = recorded(tmp_path / "a.mcap", "CartPole-v1")
    both = side_by_side([layout_of_log(McapReader(path)), own], ["a", "b"])
    assert both["layout"]["first"] == "Tab!a screens"
    assert both["layout"]["second"] == "Plot!b x"


def test_sizes_are_shares_of_the_area() -> None:
    panels: dict[str, Any] = {"Tab!x": {"tabs": [{"layout": "Plot!c"}]}, "Plot!a": {}, "Plot!c": {}}
    tree = {"first": "Plot!a", "second": "Tab!x", "direction": "column", "splitPercentage": 25.0}
    found = dict(sizes_of(tree, panels, (960, 600)))
    # `Plot!a` takes a quarter of the 600 px. The row of tabs takes 30 px of the other 450 px.
    assert found == {"Plot!a": (960, 150), "Tab!x": (960, 450), "Plot!c": (960, 420)}
    # The row takes 64 px, and the title and the axis take 60 px. The screen has 570 px.
    assert share_of_transitions(1) == 124 / 570
    assert share_of_transitions(9) == 0.45


@pytest.mark.parametrize(
    "path",
    [
        "/nothing.data",
        "/rl/step{final==false}.nothing",
        "/rl/step{nothing==1}.reward",
        "/rl/step{final==0}.reward",
        "/rl/step{episode==$nothing}.reward",
        "/rl/step.observation[4]",
        "/rl/step.reward[0]",
        "/rl/phase",
    ],
)
def test_wrong_paths_are_found(path: str, tmp_path: Path) -> None:
    topics = Topics.of_log(recorded(tmp_path / "log.mcap", "CartPole-v1"))
    with pytest.raises(AssertionError):
        topics.resolve(path, {"episode": 0})
    assert topics.resolve("/rl/step{episode==$episode}.observation[3]", {"episode": 0}) == (
        "float32",
        False,
    )


@pytest.mark.parametrize("sim", ["lane", "powerline", "racer", "highway-lane"])
def test_the_whole_track_is_in_view_from_above(sim: str) -> None:
    """All positions of the pilot's vehicle are within the view from above."""
    env = make_sim(sim)
    source: Any = env.unwrapped
    metadata = LogMetadata.of_env(env)
    topics = ["/scene", "/scene/static", "/scene/tracks"]
    topics += ["/camera/depth"] if hasattr(source, "depth_image_m") else []
    layout = layout_of(metadata, topics, ["speed_m_s", "offset_m"], "car")
    sizes = dict(sizes_of(layout["layout"], layout["configById"], AREA_PX))
    width_px, height_px = sizes["3D!above"]
    camera = layout["configById"]["3D!above"]["cameraState"]
    # The title bar is 30 px high.
    half_m = camera["distance"] / 2 * np.array([width_px / (height_px - 30), 1.0])
    if camera["thetaOffset"] == 90:
        half_m = half_m[::-1]
    pilot = make_pilot(env)
    observation, _ = env.reset(seed=1)
    is_over = False
    while not is_over:
        offset_m = np.array(source.frames()[0].position[:2]) - camera["targetOffset"][:2]
        assert (np.abs(offset_m) < half_m).all()
        observation, _, terminated, truncated, _ = env.step(pilot.act(observation[None])[0])
        is_over = terminated or truncated


def test_depth_fills_the_range_of_its_colors() -> None:
    """The limits of the depth colors are the 1st and the 99th percentile of the depth."""
    for sim in ("lane", "powerline"):
        env = make_sim(sim)
        source: Any = env.unwrapped
        pilot, seen = make_pilot(env), []
        for seed in range(2):
            observation, _ = env.reset(seed=seed)
            for _ in range(150):
                observation, _, terminated, _, _ = env.step(pilot.act(observation[None])[0])
                depth_m = source.depth_image_m()
                seen.append(depth_m[depth_m < 65.5])
                if terminated:
                    break
        low, high = np.percentile(np.concatenate(seen), [1, 99])
        view = LogMetadata.of_env(env).view
        assert view["depth_min_m"] == pytest.approx(low, abs=1.0), sim
        assert view["depth_max_m"] == pytest.approx(high, abs=3.0), sim


def test_old_logs_without_tracks_have_a_track_as_a_plot() -> None:
    metadata = LogMetadata(spaces.Box(-1, 1, (2,)), spaces.Discrete(2))
    old = layout_of(metadata, ["/scene", "/scene/static", "/tf"], ["x_m", "y_m"], "car")
    plot = old["configById"]["Plot!track"]
    assert plot["xAxisPath"]["value"] == "/tf.transforms[0].transform.translation.x"
    assert series_of(old)["y"] == "/telemetry.y_m"
    # The size of the world is unknown, so the view from above follows the vehicle.
    above = old["configById"]["3D!above"]
    assert (above["followTf"], above["followMode"]) == ("car", "follow-position")
    assert above["cameraState"]["distance"] == 100


def test_the_vehicle_is_marked_from_above(tmp_path: Path) -> None:
    log = recorded(tmp_path / "log.mcap", "lane")
    panels = check_layout(log)["configById"]
    assert panels["3D!above"]["topics"]["/scene/map"]["visible"]
    assert panels["3D!above"]["scene"]["transforms"]["axisScale"] == 0
    (_, shown), *_ = read(log, "/scene/map", "visualization_msgs/msg/MarkerArray")
    arrow = shown.markers[-1]
    # 5 % of the 190 m that are visible.
    assert (arrow.ns, arrow.header.frame_id, arrow.type) == ("vehicle", "car", 0)
    assert [point.x for point in arrow.points] == pytest.approx([-4.75, 4.75])
    topics = ["/scene", "/scene/static", "/tf"]
    old = layout_of(LogMetadata.of_env(make_sim("lane")), topics, [], "car")["configById"]
    # Axes are 0.2 m long at a scale of 1. They must be 3 % of the world's 190 m, which is 5.7 m.
    scale = old["3D!above"]["scene"]["transforms"]["axisScale"]
    assert 0.2 * scale == pytest.approx(5.7)
    assert panels["3D!scene"]["scene"]["transforms"]["axisScale"] == 0
    assert panels["3D!above"]["topics"]["/scene"]["namespaces"] == {"speed": {"visible": False}}


def test_failures_are_unknown_without_reasons_of_success(tmp_path: Path) -> None:
    panels = check_layout(recorded(tmp_path / "log.mcap", "CartPole-v1"))["configById"]
    light = panels["Indicator!state"]
    assert {rule["color"] for rule in light["rules"]} == {light["fallbackColor"]} == {"#4e98e2"}
    assert light["path"] == "/rl/episode.reason", "it stays until the next end"
    assert light["fallbackLabel"] == "none yet, or another reason"


def test_the_window_of_actions_has_80_steps(tmp_path: Path) -> None:
    for sim, last_s in (("lane", 20.0), ("racer", 8.0), ("CartPole-v1", 1.6)):
        panels = check_layout(recorded(tmp_path / f"{sim}.mcap", sim))["configById"]
        actions = panels["StateTransitions!actions"]
        root = panels["Tab!screens"]["tabs"][0]["layout"]
        if sim == "CartPole-v1":
            # Without a gauge and images, the indicator is a strip beside the plots.
            assert root["first"]["first"] == "Indicator!state"
            assert root["first"]["splitPercentage"] == 16
        assert (actions["xAxisRange"], actions["isSynced"]) == (last_s, False)
        assert actions["foxglovePanelTitle"] == f"the last {last_s:g} s"


def test_policies_with_values_are_first(tmp_path: Path) -> None:
    names = ["/rl/values/a", "/rl/values/b"]
    path = annotated(recorded(tmp_path / "log.mcap", "lane"), tmp_path / "annotated.mcap", names)
    reader = McapReader(path)
    metadata, topics = describe(reader), ["/rl/values/a", "/rl/values/b"]
    layout = layout_of(
        metadata, topics, without_q=["/rl/values/a"], episodes=7, agreement={topics[1]: 0.834}
    )
    panels = layout["configById"]
    titles = [panels[f"StateTransitions!values/{each}"]["foxglovePanelTitle"] for each in "ab"]
    assert titles[0] == "values/a: agrees with the actions of the log"
    assert titles[1] == "values/b: agrees with 83% of the actions of the log"
    shown = [tab["title"] for tab in panels["Tab!policies"]["tabs"]]
    assert shown == ["values/b", "values/a"]
    # The policy without values has plots of its probabilities alone.
    tabs = {each: panels[f"Tab!values/{each} over time"]["tabs"] for each in "ab"}
    assert [tab["title"] for tab in tabs["a"]] == ["probabilities"]
    assert [tab["title"] for tab in tabs["b"]] == ["Q-values", "probabilities"]
    assert paths_of(panels["Plot!values/a errors"]) == ["/rl/values/a.entropy"]
    assert panels["GlobalVariableSliderPanel!episode"]["sliderProps"]["max"] == 6


def test_a_live_training_shows_the_mean_return_on_drive() -> None:
    metadata = LogMetadata(spaces.Box(-1, 1, (2,)), spaces.Box(-1, 1, (1,), np.float32))
    training = {"mean_return": "mean return", "score": "score", "loss": "loss"}
    panels = layout_of(metadata, ["/rl/training"], training=training)["configById"]
    assert paths_of(panels["Plot!return"]) == ["/rl/training.mean_return"]
    # A score of at most 1 would be a flat line beside returns.
    assert paths_of(panels["Plot!training mean_return"]) == ["/rl/training.mean_return"]
    assert paths_of(panels["Plot!training score"]) == ["/rl/training.score"]
    assert panels["Plot!action"]["followingViewWidth"] == 80 * metadata.step_duration_ns / 1e9


def test_steering_is_in_the_first_plot_of_highway_lane(tmp_path: Path) -> None:
    panels = check_layout(recorded(tmp_path / "log.mcap", "highway-lane"))["configById"]
    labels = [path["label"] for path in panels["Plot!drive"]["paths"]]
    assert labels == ["lateral_offset_m", "steering_rad"]
    assert panels["Plot!drive"]["legendDisplay"] == "left"
    assert panels["Plot!reward"]["legendDisplay"] == "none"


def test_continuous_actions_are_plotted(tmp_path: Path) -> None:
    panels = check_layout(recorded(tmp_path / "log.mcap", "Pendulum-v1"))["configById"]
    assert paths_of(panels["Plot!action"]) == ["/rl/step{final==false}.action[0]"]
    # A plot of limited width would not move with the time of a file.
    assert "followingViewWidth" not in panels["Plot!action"]
    assert panels["Plot!action"]["isSynced"] is True
    assert "StateTransitions!actions" not in panels


@pytest.mark.parametrize("sim", ["lane", "racer", "powerline"])
def test_commands_have_names_limits_and_dials(tmp_path: Path, sim: str) -> None:
    """Up to two dials are above the plot; more of them are on a separate tab."""
    path = tmp_path / "log.mcap"
    with closing(mcaprl.RecordMcap(make_sim(sim, actions="continuous"), path)) as env:
        env.reset(seed=0)
        env.step(env.action_space.sample())
    names = mcaprl.open(path).action_part_names
    panels = check_layout(path)["configById"]
    dials = [panels[f"Gauge!action {name}"] for name in names]
    assert {(dial["minValue"], dial["maxValue"]) for dial in dials} == {(-1, 1)}
    paths = [f"/rl/step{{final==false}}.action[{k}]" for k in range(len(names))]
    assert [dial["path"] for dial in dials] == paths_of(panels["Plot!action"]) == paths
    assert ("Tab!actions" in panels) == (len(names) > 2)
    steps = "/rl/step{final==false}"
    assert paths_of(panels["StateTransitions!running"]) == [f"{steps}.episode", f"{steps}.step"]


def test_long_observations_are_shown_in_plots_of_six_numbers(tmp_path: Path) -> None:
    data = mcaprl.Dataset.from_arrays(
        observations=np.zeros((4, 14), np.float32),
        next_observations=np.zeros((4, 14), np.float32),
        actions=np.zeros(4, np.int64),
        rewards=np.zeros(4),
        terminated=np.arange(4) == 3,
        truncated=np.zeros(4, bool),
        action_space=spaces.Discrete(2),
    )
    data.save(tmp_path / "log.mcap")
    found = check_layout(tmp_path / "log.mcap", layout_of_log(McapReader(tmp_path / "log.mcap")))
    panels = found["configById"]
    for place in ("", "drive "):
        plots = [
            panels[f"Plot!{place}observations {part}"] for part in ("0 to 5", "6 to 11", "12 to 13")
        ]
        paths = [path for plot in plots for path in paths_of(plot)]
        numbers = [f"/rl/step{{final==false}}.observation[{k}]" for k in range(14)]
        assert paths == numbers


def test_images_of_any_environment_are_shown(tmp_path: Path) -> None:
    class Images(gym.Env[Any, Any]):
        observation_space = spaces.Dict(
            {
                "front": spaces.Box(0, 255, (8, 9, 3), np.uint8),
                "speed": spaces.Box(0, 1, (1,), np.float32),
            }
        )
        action_space = spaces.Box(-1, 1, (2,), np.float32)

        def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
            return self.observation_space.sample(), {}

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            return self.observation_space.sample(), 1.0, False, False, {}

    path = tmp_path / "log.mcap"
    with closing(mcaprl.RecordMcap(Images(), path)) as env:
        env.reset(seed=0)
        env.step(np.zeros(2, np.float32))
    layout = check_layout(path)
    images = [name for name in layout["configById"] if name.startswith("Image!")]
    assert len(images) == 1
    assert series_of(layout)["action[1]"] == "/rl/step{final==false}.action[1]"


def test_view_settings_are_numbers_of_the_log(tmp_path: Path) -> None:
    strings = LogMetadata(spaces.Discrete(2), spaces.Discrete(2)).to_strings()
    view = '{"world_m": 80, "tilt_deg": "x", "distance_m": Infinity, "depth_min_m": true}'
    found = LogMetadata.from_strings({**strings, "view": view}).view
    assert found["world_m"] == 80.0
    assert not {"tilt_deg", "distance_m"} & set(found)
    assert LogMetadata.from_strings({**strings, "view": "{}"}).view == {}
    del strings["view"]
    assert LogMetadata.from_strings(strings).view == {}, "a log of an older version"
