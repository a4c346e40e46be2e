"""A Foxglove layout for a log: its panels and plotted series.

The classic form (`configById`, `layout`, `globalVariables`, `userNodes`, `playbackConfig`) opens in
Foxglove and in Lichtblick. Each plotted series is a scalar, because viewers join all elements of an
array slice into one line.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import action_leaf, observation_leaves

LAYOUT_NAME = "foxglove-layout.json"
VALUES_TOPIC = "/rl/values"
TRAINING_TOPIC = "/rl/training"
# Maximum number of series in a plot; further series are left out.
MAX_SERIES = 24
RETURN_SO_FAR = "return_so_far"
# Titles of telemetry plots; a plot shows the telemetry whose names have the given suffix.
PLOTTED_ENDINGS = {"speed": "speed_m_s", "offsets": "offset_m"}
# Range of the depth image's color map, millimeters.
DEPTH_RANGE_MM = (0, 50_000)
_COLORS = ("#4e98e2", "#f5774d", "#31b57b", "#a395e2", "#e8c547", "#d65f8a", "#7fd1d8", "#9c755f")

Node = dict[str, Any] | str


def layout_of(
    metadata: LogMetadata,
    topics: Sequence[str],
    telemetry_names: Sequence[str] = (),
    follow_frame: str = "",
    training_names: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the layout for a log with these topics.

    Args:
        metadata: Metadata of the log.
        topics: Topics of the log besides `/rl/step` and `/rl/episode`.
        telemetry_names: Fields of `/telemetry`.
        follow_frame: Frame that the 3D view moves with; empty for a fixed view.
        training_names: Fields of `/rl/training` in a live stream.
    """
    panels: dict[str, dict[str, Any]] = {}
    views = _views(metadata, topics, follow_frame, panels)
    learning = {name: f"{TRAINING_TOPIC}.{name}" for name in training_names}
    plots = _plots(metadata, topics, telemetry_names, learning, panels)
    panels["StateTransitions!actions"] = _state_transitions(metadata, topics)
    below: list[Node] = ["StateTransitions!actions"]
    if "/rosout" in topics:
        panels["RosOut!log"] = {"searchTerms": [], "minLogLevel": 1, "topicToRender": "/rosout"}
        below.append("RosOut!log")
    right = _stack([*plots, *below], "column")
    root = _split(_stack(views, "column", first_percent=68), right, "row", 52) if views else right
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": root,
    }


def is_values_topic(topic: str) -> bool:
    """Return whether a topic contains the outputs of a policy at each step, such as Q-values."""
    return topic == VALUES_TOPIC or topic.startswith(f"{VALUES_TOPIC}/")


def _views(
    metadata: LogMetadata,
    topics: Sequence[str],
    follow_frame: str,
    panels: dict[str, dict[str, Any]],
) -> list[Node]:
    """Add the 3D panel and the images."""
    names: list[Node] = []
    if "/scene" in topics:
        panels["3D!scene"] = _three_d(follow_frame)
        names.append("3D!scene")
    if "/camera/depth" in topics:
        low, high = DEPTH_RANGE_MM
        panels["Image!depth"] = _image(
            "/camera/depth", colorMode="colormap", colorMap="turbo", minValue=low, maxValue=high
        )
        names.append("Image!depth")
    for leaf in observation_leaves(metadata.observation_space):
        if leaf.encoding is not None:
            panels[f"Image!{leaf.name}"] = _image(leaf.topic)
            names.append(f"Image!{leaf.name}")
    return names


def _plots(
    metadata: LogMetadata,
    topics: Sequence[str],
    telemetry_names: Sequence[str],
    learning: Mapping[str, str],
    panels: dict[str, dict[str, Any]],
) -> list[Node]:
    """Add plots of reward and return, and a tab panel with plots of all other numbers."""
    returns = {"return of episode": "/rl/episode.total_reward"}
    if RETURN_SO_FAR in telemetry_names:
        returns = {"return so far": f"/telemetry.{RETURN_SO_FAR}"}
    always = {"reward": {"reward": "/rl/step.reward"}, "return": returns}
    tabs = {
        **{name: {name: path} for name, path in learning.items()},
        **_value_series(metadata, topics),
        **{
            title: {name: f"/telemetry.{name}" for name in telemetry_names if name.endswith(ending)}
            for title, ending in PLOTTED_ENDINGS.items()
        },
        "observations": _observation_series(metadata),
        "actions": _action_series(metadata),
    }
    for title, paths in [*always.items(), *tabs.items()]:
        if paths:
            panels[f"Plot!{title}"] = _plot(title, paths)
    panels["Tab!numbers"] = {
        "activeTabIdx": 0,
        "tabs": [
            {"title": title, "layout": f"Plot!{title}"} for title, paths in tabs.items() if paths
        ],
    }
    return [*(f"Plot!{title}" for title in always), "Tab!numbers"]


def _value_series(metadata: LogMetadata, topics: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return series of the Q-values, TD error, advantage and entropy on each values topic."""
    series = {}
    for topic in filter(is_values_topic, topics):
        title = topic.removeprefix("/rl/")
        q_values = enumerate(metadata.action_names().values())
        series[title] = {f"Q {name}": f"{topic}.q[{index}]" for index, name in q_values}
        fields = ("td_error", "advantage", "entropy")
        series[f"{title}: errors"] = {field: f"{topic}.{field}" for field in fields}
    return series


def _action_series(metadata: LogMetadata) -> dict[str, str]:
    """Return a series per action component, or per discrete action, with the steps that took it."""
    names = metadata.action_names()
    if names:
        taken = {
            name: f"/rl/step{{action=={value}}}{{final==false}}.action"
            for value, name in names.items()
        }
        return dict(list(taken.items())[:MAX_SERIES])
    leaf = action_leaf(metadata.action_space)
    suffixes = [f"[{index}]" for index in range(leaf.size)] if leaf.shape else [""]
    return {f"action{suffix}": f"/rl/step.action{suffix}" for suffix in suffixes[:MAX_SERIES]}


def _observation_series(metadata: LogMetadata) -> dict[str, str]:
    """Return a series per component of the vector observations, up to `MAX_SERIES`."""
    paths = {}
    for leaf in observation_leaves(metadata.observation_space):
        if leaf.encoding is not None:
            continue
        named = leaf.path == () and len(metadata.observation_names) == leaf.size
        for index in range(leaf.size):
            label = metadata.observation_names[index] if named else f"{leaf.name}[{index}]"
            suffix = f"[{index}]" if leaf.shape else ""
            paths[label] = f"/rl/step.{leaf.name}{suffix}"
    return dict(list(paths.items())[:MAX_SERIES])


def _state_transitions(metadata: LogMetadata, topics: Sequence[str]) -> dict[str, Any]:
    paths = [_state("/rl/step.episode", "episode")]
    names = metadata.action_names()
    if names:
        legend = ", ".join(f"{value} {name}" for value, name in names.items())
        paths.insert(0, _state("/rl/step.action", f"action ({legend})"))
    for topic in filter(is_values_topic, topics):
        title = topic.removeprefix("/rl/")
        paths += [_state(f"{topic}.policy_action", f"{title} would take")]
        paths += [_state(f"{topic}.agrees", f"{title} agrees")]
    return {"foxglovePanelTitle": "Action and episode", "isSynced": True, "paths": paths}


def _state(path: str, label: str) -> dict[str, Any]:
    return {"value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime"}


def _plot(title: str, paths: Mapping[str, str]) -> dict[str, Any]:
    return {
        "foxglovePanelTitle": title,
        "paths": [
            {
                "value": path,
                "label": label,
                "color": _COLORS[index % len(_COLORS)],
                "enabled": True,
                "timestampMethod": "receiveTime",
            }
            for index, (label, path) in enumerate(paths.items())
        ],
        "xAxisVal": "timestamp",
        "isSynced": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showPlotValuesInLegend": True,
    }


def _image(topic: str, **mode: Any) -> dict[str, Any]:
    return {
        "foxglovePanelTitle": topic,
        "cameraState": {},
        "followMode": "follow-none",
        "imageMode": {"imageTopic": topic, "synchronize": False, **mode},
        "layers": {},
        "publish": {},
        "scene": {},
        "topics": {},
        "transforms": {},
    }


def _three_d(follow_frame: str) -> dict[str, Any]:
    return {
        "foxglovePanelTitle": "Scene",
        "cameraState": {
            "perspective": True,
            "distance": 26,
            "phi": 62,
            "thetaOffset": 90,
            "targetOffset": [4, 0, 0],
            "target": [0, 0, 0],
            "targetOrientation": [0, 0, 0, 1],
            "fovy": 45,
            "near": 0.5,
            "far": 5000,
        },
        "followMode": "follow-pose" if follow_frame else "follow-none",
        "followTf": follow_frame or "map",
        "scene": {"backgroundColor": "#10141c"},
        "transforms": {},
        "topics": {"/scene": {"visible": True}, "/scene/static": {"visible": True}},
        "layers": {},
        "publish": {},
        "imageMode": {},
    }


def _split(first: Node, second: Node, direction: str, percent: float) -> Node:
    return {"first": first, "second": second, "direction": direction, "splitPercentage": percent}


def _stack(nodes: Sequence[Node], direction: str, first_percent: float | None = None) -> Node:
    """Stack panels; their sizes are equal unless `first_percent` sets the size of the first."""
    first, *rest = nodes
    if not rest:
        return first
    percent = first_percent if first_percent is not None else 100 / len(nodes)
    return _split(first, _stack(rest, direction), direction, percent)
