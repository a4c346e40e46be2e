"""A Foxglove layout for a log: its screens and plotted series.

The classic form (`configById`, `layout`, `globalVariables`, `userNodes`, `playbackConfig`) opens in
Foxglove and in Lichtblick. Each plotted series is a scalar, because viewers join all elements of an
array slice into one line. No series contains the `final` records, which have no action.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import action_leaf, observation_leaves
from mcaprl.recorder.format.topics import LOG_TOPIC, PHASE_TOPIC, RUNNING
from mcaprl.recorder.record import panels
from mcaprl.recorder.record.panels import Panel

LAYOUT_NAME = "foxglove-layout.json"
VALUES_TOPIC = "/rl/values"
TRAINING_TOPIC = "/rl/training"
# Maximum number of series in a plot; further series are left out.
MAX_SERIES = 24
RETURN_SO_FAR = "return_so_far"
_SPEED = "speed_m_s"
# Telemetry of the first plot, by the ends of its names: what a driver looks at besides the speed.
_WATCHED = ("offset_m", "steering_rad", "distance_m")
_STEPS, _EPISODES = "/rl/step{final==false}", "/rl/episode"
_SCENES = ("/scene", "/scene/static")
_TRACKS = "/scene/tracks"
_MAX_EPISODE = 100
_DEPTH_M = (0.0, 50.0)
_FIRST_METRICS = ("mean_return", "score")
_METRICS_AFTER = ("loss", "epsilon")

Node = dict[str, Any] | str
Panels = dict[str, Panel]


def layout_of(
    metadata: LogMetadata,
    topics: Sequence[str],
    telemetry_names: Sequence[str] = (),
    follow_frame: str = "",
    training: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Return the layout for a log with these topics: the screens Drive, Learning and Data.

    Args:
        metadata: Metadata of the log.
        topics: Topics of the log besides `/rl/step` and `/rl/episode`.
        telemetry_names: Fields of `/telemetry`.
        follow_frame: Frame that the 3D view moves with; empty for a fixed view.
        training: Labels of the fields of `/rl/training` in a live stream, by name.
    """
    found: Panels = {}
    screens = {
        "Drive": _drive(metadata, topics, telemetry_names, follow_frame, found),
        "Learning": _learning(metadata, topics, telemetry_names, training or {}, found),
        "Data": _data(metadata, topics, telemetry_names, found),
    }
    found["Tab!screens"] = panels.tabs(screens)
    return {
        "configById": found,
        "globalVariables": {"episode": 0},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": "Tab!screens",
    }


def layout_bytes(layout: dict[str, Any]) -> bytes:
    """Return a layout as JSON without spaces: attachments are not compressed."""
    return json.dumps(layout, separators=(",", ":")).encode()


def is_values_topic(topic: str) -> bool:
    """Return whether a topic contains the outputs of a policy at each step, such as Q-values."""
    return topic == VALUES_TOPIC or topic.startswith(f"{VALUES_TOPIC}/")


def _drive(
    metadata: LogMetadata,
    topics: Sequence[str],
    telemetry: Sequence[str],
    follow_frame: str,
    found: Panels,
) -> Node:
    """Add the views and what one reads while driving."""
    beside = _instruments(metadata, topics, telemetry, found)
    views = _images(metadata, topics, found)
    if "/scene" not in topics:
        return _split(_stack(views, "column"), beside, "row", 50) if views else beside
    camera = {
        "perspective": True,
        "distance": metadata.view.get("distance_m", 22.0),
        "phi": metadata.view.get("tilt_deg", 66.0),
        "targetOffset": [4, 0, 0],
    }
    found["3D!scene"] = panels.three_d("scene", _SCENES, camera, follow_frame)
    if _TRACKS in topics:
        found["3D!above"] = panels.three_d(
            "from above: tracks, yellow is the highest return",
            (*_SCENES, _TRACKS),
            _above(metadata),
        )
        views.append("3D!above")
    left: Node = "3D!scene"
    if views:
        left = _split(left, _stack(views, "row"), "column", 62)
    return _split(left, beside, "row", 62)


def _above(metadata: LogMetadata) -> dict[str, Any]:
    """Return the camera that looks down on the whole world."""
    view = metadata.view
    target = [view.get("world_x_m", 0.0), view.get("world_y_m", 0.0), 0]
    return {
        "perspective": False,
        "distance": view.get("world_m", 100.0),
        "phi": 0,
        "thetaOffset": 0,
        "target": target,
    }


def _instruments(
    metadata: LogMetadata, topics: Sequence[str], telemetry: Sequence[str], found: Panels
) -> Node:
    rows: list[Node] = []
    lights: list[Node] = []
    if _SPEED in telemetry:
        highest = metadata.view.get("speed_m_s", 30.0)
        found["Gauge!speed"] = panels.gauge("speed, m/s", f"/telemetry.{_SPEED}", highest)
        lights.append("Gauge!speed")
    if PHASE_TOPIC in topics:
        successes = metadata.success_reasons
        found["Indicator!state"] = panels.indicator(
            "state of the episode", f"{PHASE_TOPIC}.data", RUNNING, successes
        )
        lights.append("Indicator!state")
    if lights:
        rows.append(_stack(lights, "row"))
    watched = [name for name in telemetry if name.endswith(_WATCHED)]
    if watched:
        paths = {name: f"/telemetry.{name}" for name in watched}
        found["Plot!drive"] = panels.plot("offsets, steering", paths)
        rows.append("Plot!drive")
    _put_returns(telemetry, found)
    rows.append(_stack(["Plot!reward", "Plot!return"], "row"))
    rows.append(_actions_row(metadata, topics, found))
    return _stack(rows, "column")


def _put_returns(telemetry: Sequence[str], found: Panels) -> None:
    found["Plot!reward"] = panels.plot("reward", {"reward": f"{_STEPS}.reward"})
    returns = {"return of episode": f"{_EPISODES}.total_reward"}
    if RETURN_SO_FAR in telemetry:
        returns = {"return so far": f"/telemetry.{RETURN_SO_FAR}"}
    found["Plot!return"] = panels.plot(next(iter(returns)), returns)


def _actions_row(metadata: LogMetadata, topics: Sequence[str], found: Panels) -> Node:
    """Add the actions of the last 20 s; not synchronized, since that would drag all plots along."""
    rows = {}
    if metadata.action_names():
        rows["action"] = f"{_STEPS}.action"
    if PHASE_TOPIC in topics:
        rows["state"] = f"{PHASE_TOPIC}.data"
    rows["episode"] = "/rl/step.episode"
    found["StateTransitions!actions"] = panels.state_transitions(
        "action and state, last 20 s", rows, xAxisRange=20, isSynced=False
    )
    return "StateTransitions!actions"


def _images(metadata: LogMetadata, topics: Sequence[str], found: Panels) -> list[Node]:
    """Add the depth camera and the image observations."""
    names: list[Node] = []
    if "/camera/depth" in topics:
        low = metadata.view.get("depth_min_m", _DEPTH_M[0])
        high = metadata.view.get("depth_max_m", _DEPTH_M[1])
        found["Image!depth"] = panels.image(
            f"depth, {low:g} to {high:g} m; black is nothing",
            "/camera/depth",
            colorMode="colormap",
            colorMap="turbo",
            minValue=1000 * low,
            maxValue=1000 * high,
        )
        names.append("Image!depth")
    for leaf in observation_leaves(metadata.observation_space):
        if leaf.encoding is not None:
            found[f"Image!{leaf.name}"] = panels.image(leaf.topic, leaf.topic)
            names.append(f"Image!{leaf.name}")
    return names


def _learning(
    metadata: LogMetadata,
    topics: Sequence[str],
    telemetry: Sequence[str],
    training: Mapping[str, str],
    found: Panels,
) -> Node:
    """Add the returns, the metrics of training, and the outputs of policies."""
    found["Plot!returns"] = panels.plot(
        "return of each episode", {"return": f"{_EPISODES}.total_reward"}
    )
    values = {
        topic.removeprefix("/rl/"): _policy(metadata, topic, found)
        for topic in filter(is_values_topic, topics)
    }
    rows: list[Node] = _metrics(training, found) if training else []
    if not training:
        rows.append("Plot!returns")
    if len(values) > 1:
        found["Tab!policies"] = panels.tabs(values)
    node = "Tab!policies" if len(values) > 1 else next(iter(values.values()), None)
    if LOG_TOPIC in topics and (training or not values):
        found["RosOut!learning"] = panels.log_lines()
        rows.append("RosOut!learning")
    left = _stack(rows, "column")
    if training:
        # The returns are among the metrics.
        del found["Plot!returns"]
    return left if node is None else _split(left, node, "row", 40)


def _metrics(training: Mapping[str, str], found: Panels) -> list[Node]:
    """Add the metrics of training, the most important first."""
    paths = {name: f"{TRAINING_TOPIC}.{name}" for name in training}
    first = {training[name]: paths[name] for name in _FIRST_METRICS if name in training}
    rows: list[Node] = []
    if first:
        found["Plot!training"] = panels.plot("mean return and score", first)
        rows.append("Plot!training")
    pair: list[Node] = []
    for name in _METRICS_AFTER:
        if name in training:
            found[f"Plot!{name}"] = panels.plot(training[name], {training[name]: paths[name]})
            pair.append(f"Plot!{name}")
    rows += [_stack(pair, "row")] if pair else []
    rest = [name for name in training if name not in (*_FIRST_METRICS, *_METRICS_AFTER)]
    for name in rest:
        found[f"Plot!{name}"] = panels.plot(training[name], {training[name]: paths[name]})
    if rest:
        found["Tab!metrics"] = panels.tabs({name: f"Plot!{name}" for name in rest})
        rows.append("Tab!metrics")
    return rows


def _policy(metadata: LogMetadata, topic: str, found: Panels) -> Node:
    """Add the outputs of one policy: values over time and now, errors, and its actions."""
    title = topic.removeprefix("/rl/")
    names = list(metadata.action_names().values())[:MAX_SERIES]
    over_time = {name: f"{topic}.q[{index}]" for index, name in enumerate(names)}
    found[f"Plot!{title}"] = panels.plot(f"{title}: Q over time", over_time)
    legend = ", ".join(f"{index} {name}" for index, name in enumerate(names))
    found[f"Plot!{title} now"] = panels.plot(
        f"{title}: Q now ({legend})", {"Q": f"{topic}.q[:]"}, xAxisVal="index", isSynced=False
    )
    fields = ("td_error", "advantage", "entropy")
    found[f"Plot!{title} errors"] = panels.plot(
        f"{title}: errors", {field: f"{topic}.{field}" for field in fields}
    )
    found[f"StateTransitions!{title}"] = panels.state_transitions(
        f"{title}: actions, last 20 s",
        {
            "action": f"{_STEPS}.action",
            "would take": f"{topic}.policy_action",
            "agrees": f"{topic}.agrees",
        },
        xAxisRange=20,
        isSynced=False,
    )
    rows = [f"Plot!{title}", f"Plot!{title} now", f"Plot!{title} errors"]
    return _stack([*rows, f"StateTransitions!{title}"], "column")


def _data(
    metadata: LogMetadata, topics: Sequence[str], telemetry: Sequence[str], found: Panels
) -> Node:
    """Add the messages themselves, all numbers of the log, and its log lines."""
    for topic in ("/rl/step", "/rl/episode"):
        found[f"RawMessages!{topic[4:]}"] = panels.raw_messages(topic)
    left = _stack(["RawMessages!step", "RawMessages!episode"], "column")
    numbers = {
        "observations": _observation_series(metadata),
        "actions": _action_series(metadata),
        "telemetry": {name: f"/telemetry.{name}" for name in telemetry[:MAX_SERIES]},
    }
    shown = {title: paths for title, paths in numbers.items() if paths}
    for title, paths in shown.items():
        found[f"Plot!{title}"] = panels.plot(title, paths)
    rows: list[Node] = []
    if shown:
        found["Tab!numbers"] = panels.tabs({title: f"Plot!{title}" for title in shown})
        rows.append("Tab!numbers")
    found["GlobalVariableSliderPanel!episode"] = panels.slider("episode", _MAX_EPISODE)
    chosen = "/rl/step{episode==$episode}{final==false}.reward"
    found["Plot!episode"] = panels.plot("reward of the chosen episode", {"reward": chosen})
    rows.append(_split("GlobalVariableSliderPanel!episode", "Plot!episode", "row", 30))
    if LOG_TOPIC in topics:
        found["RosOut!log"] = panels.log_lines()
        rows.append("RosOut!log")
    return _split(left, _stack(rows, "column"), "row", 35)


def _action_series(metadata: LogMetadata) -> dict[str, str]:
    """Return one series per component of an action, or one per discrete action at its steps."""
    names = metadata.action_names()
    if names:
        taken = {
            name: f"/rl/step{{action=={value}}}{{final==false}}.action"
            for value, name in names.items()
        }
        return dict(list(taken.items())[:MAX_SERIES])
    leaf = action_leaf(metadata.action_space)
    suffixes = [f"[{index}]" for index in range(leaf.size)] if leaf.shape else [""]
    return {f"action{suffix}": f"{_STEPS}.action{suffix}" for suffix in suffixes[:MAX_SERIES]}


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


def _split(first: Node, second: Node, direction: str, percent: float) -> Node:
    return {"first": first, "second": second, "direction": direction, "splitPercentage": percent}


def _stack(nodes: Sequence[Node], direction: str) -> Node:
    """Return panels of equal size in a row or column."""
    first, *rest = nodes
    return _split(first, _stack(rest, direction), direction, 100 / len(nodes)) if rest else first
