"""Panels of a Foxglove layout: their configuration, their arrangement, and the series they plot.

Each title is stored under two keys, because Foxglove and Lichtblick read different keys.

A message path, `/topic{field==value}.field[index]`, selects one number of each message. Array
slices are not used, because viewers join all elements of a slice into one line. The paths exclude
`final` records, which have neither an action nor a reward.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from gymnasium import spaces

from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import action_leaf, observation_leaves, part_names

MAX_SERIES = 24  # Maximum number of series in a plot; further series are left out
_GROUP = 6  # Series in one of several plots of an observation: few enough to distinguish
STEPS = "/rl/step{final==false}"
EPISODE_VARIABLE = "episode"
"""Variable of a layout with the number of the episode that the viewer's user chooses."""
CHOSEN_REWARD = f"/rl/step{{episode==${EPISODE_VARIABLE}}}{{final==false}}.reward"
# Title of each group of similar numbers, and the suffixes of their telemetry names.
_GROUPS = {
    "offsets": ("offset_m", "distance_m"),
    "speeds": ("_m_s",),
    "angles": ("_rad",),
    "positions": ("_m",),
    "other numbers": ("",),
}


def telemetry_series(names: Sequence[str]) -> dict[str, str]:
    """Return the series of fields of `/telemetry`."""
    return {name: f"/telemetry.{name}" for name in names[:MAX_SERIES]}


def telemetry_groups(names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Group the series of `/telemetry` by title, so that numbers of similar size share a plot.

    >>> telemetry_groups(["offset_m", "x_m"])
    {'offsets': {'offset_m': '/telemetry.offset_m'}, 'positions': {'x_m': '/telemetry.x_m'}}
    """
    groups: dict[str, list[str]] = {title: [] for title in _GROUPS}
    for name in names:
        title = next(title for title, ends in _GROUPS.items() if name.endswith(ends))
        groups[title].append(name)
    return {title: telemetry_series(found) for title, found in groups.items() if found}


def action_series(metadata: LogMetadata) -> dict[str, str]:
    """Return one series per component of an action, or one per value of a discrete action."""
    names = metadata.action_names()
    if names:
        taken = {
            name: f"/rl/step{{action=={value}}}{{final==false}}.action"
            for value, name in names.items()
        }
        return dict(list(taken.items())[:MAX_SERIES])
    return {name: f"{STEPS}.action{suffix}" for name, suffix in action_parts(metadata).items()}


def action_parts(metadata: LogMetadata) -> dict[str, str]:
    """Return the suffix of the path of each element of an action, such as `[0]`, by its name."""
    leaf = action_leaf(metadata.action_space)
    suffixes = [f"[{index}]" for index in range(leaf.size)] if leaf.shape else [""]
    names = part_names(metadata.action_space, metadata.action_part_names)
    return dict(list(zip(names, suffixes, strict=True))[:MAX_SERIES])


class Bounded(NamedTuple):
    """An element of a Box action with finite bounds."""

    name: str
    element: int
    low: float
    high: float
    is_leftward: bool
    """Whether positive numbers point to the left, so that a dial has its highest number there."""

    @property
    def ends(self) -> tuple[float, float]:
        """Number at the left and at the right end of a dial."""
        return (self.high, self.low) if self.is_leftward else (self.low, self.high)


def bounded_actions(metadata: LogMetadata) -> list[Bounded]:
    """Return the elements of a Box action with finite bounds; none for other actions."""
    space = metadata.action_space
    if not isinstance(space, spaces.Box):
        return []
    ends = zip(space.low.ravel().tolist(), space.high.ravel().tolist(), strict=True)
    units = itertools.chain(metadata.action_units, itertools.repeat(""))
    parts = zip(action_parts(metadata), ends, units, strict=False)
    return [
        Bounded(name, index, *pair, " | " in unit and unit.endswith("left"))
        for index, (name, pair, unit) in enumerate(parts)
        if all(map(math.isfinite, pair))
    ]


def observation_groups(metadata: LogMetadata) -> dict[str, dict[str, str]]:
    """Return titles of plots of the vector observations, and up to `_GROUP` series of each."""
    paths = list(_observation_series(metadata).items())
    if len(paths) <= _GROUP + 2:
        return {"observations": dict(paths)} if paths else {}
    starts = range(0, len(paths), _GROUP)
    parts = {k: dict(paths[k : k + _GROUP]) for k in starts}
    return {f"observations {k} to {k + len(part) - 1}": part for k, part in parts.items()}


def _observation_series(metadata: LogMetadata) -> dict[str, str]:
    """Return a series per component of the vector observations, up to `MAX_SERIES`."""
    paths = {}
    for leaf in observation_leaves(metadata.observation_space):
        if leaf.encoding is not None:
            continue
        named = leaf.path == () and len(metadata.observation_names) == leaf.size
        for index in range(min(leaf.size, MAX_SERIES)):
            label = metadata.observation_names[index] if named else f"{leaf.name}[{index}]"
            suffix = f"[{index}]" if leaf.shape else ""
            paths[label] = f"{STEPS}.{leaf.name}{suffix}"
    return dict(list(paths.items())[:MAX_SERIES])


Panel = dict[str, Any]
Node = dict[str, Any] | str  # Node of a layout: the name of a panel, or a split into two nodes
FIELD_OF_VIEW_DEG = 45  # Vertical angle of view of a 3D panel, degrees

NEUTRAL, GOOD, BAD = "#4e98e2", "#31b57b", "#d64545"
_COLORS = ("#4e98e2", "#f5774d", "#31b57b", "#a395e2", "#e8c547", "#d65f8a", "#7fd1d8", "#9c755f")
# Width in pixels of a legend with labels, and of a legend with labels and current values.
_LEGEND_PX, _LEGEND_WITH_VALUES_PX = 200, 260
# Height in pixels of each row of state transitions, and of the title and time axis together.
_TRANSITIONS_ROW_PX, _TRANSITIONS_REST_PX = 64, 60
# Height of a screen in the smallest window, 1280 x 720 pixels.
_SCREEN_PX = 570


def tabs(nodes: Mapping[str, Node]) -> Panel:
    """Return a panel of tabs, one for each node."""
    parts = [{"title": title, "layout": node} for title, node in nodes.items()]
    return {"activeTabIdx": 0, "tabs": parts}


def plot(title: str, paths: Mapping[str, str], *, values: bool = False, **options: Any) -> Panel:
    """Return a plot of series. With several series, there is a legend to the left of the plot."""
    several = len(paths) > 1
    return _titled(
        title,
        paths=[
            _series(label, path, color=_COLORS[index % len(_COLORS)])
            for index, (label, path) in enumerate(paths.items())
        ],
        xAxisVal="timestamp",
        isSynced=True,
        showLegend=several,
        legendDisplay="left" if several else "none",
        sidebarDimension=_LEGEND_WITH_VALUES_PX if values else _LEGEND_PX,
        showXAxisLabels=True,
        showYAxisLabels=True,
        showPlotValuesInLegend=values,
    ) | dict(options)


def points_by_index(title: str, paths: Mapping[str, str]) -> Panel:
    """Return a plot of arrays in the latest message, with one point for each element."""
    return points(plot(title, paths, xAxisVal="index", isSynced=False), 4)


def points(panel: Panel, size: float) -> Panel:
    """Show the series of a plot as points instead of lines."""
    for series in panel["paths"]:
        series |= {"showLine": False, "lineSize": size}
    return panel


def curve(title: str, x_path: str, y_path: str) -> Panel:
    """Return a plot of a number over one of another topic; Lichtblick cannot plot one topic's."""
    x_axis = {"value": x_path, "enabled": True}
    return plot(title, {"y": y_path}, xAxisVal="custom", xAxisPath=x_axis, isSynced=False)


def state_transitions(title: str, paths: Mapping[str, str], last_s: float | None = None) -> Panel:
    """Return a panel with one labeled row of discrete values per message path."""
    # With `last_s`, it is not synchronized: that would also limit the range of other panels.
    rows = [_series(label, path) for label, path in paths.items()]
    if last_s is None:
        return _titled(title, paths=rows, isSynced=True)
    return _titled(title, paths=rows, isSynced=False, xAxisRange=last_s)


def share_of_transitions(rows: int) -> float:
    """Return the fraction of a screen's height that `rows` rows need, at most 0.45."""
    return min(0.45, (rows * _TRANSITIONS_ROW_PX + _TRANSITIONS_REST_PX) / _SCREEN_PX)


def gauge(title: str, path: str, highest: float, lowest: float = 0.0) -> Panel:
    """Return a gauge of a number from its lowest to its highest value."""
    return _titled(
        title,
        path=path,
        minValue=lowest,
        maxValue=highest,
        colorMap="turbo",
        colorMode="colormap",
        gradient=[NEUTRAL, BAD],
        reverse=False,
    )


def indicator(title: str, path: str, colors: Mapping[str, str], other: tuple[str, str]) -> Panel:
    """Return an indicator whose color depends on a string."""
    rules = [
        {"operator": "=", "rawValue": text, "color": color, "label": text.replace("_", " ")}
        for text, color in colors.items()
    ]
    fallback = dict(zip(("fallbackColor", "fallbackLabel"), other, strict=True))
    return _titled(title, path=path, style="background", rules=rules, **fallback)


def raw_messages(topic: str) -> Panel:
    """Return a panel that shows the latest message of a topic as a tree."""
    options = {"diffEnabled": False, "diffMethod": "custom", "diffTopicPath": ""}
    return _titled(topic, topicPath=topic, showFullMessageForDiff=False, **options)


def slider(title: str, variable: str, highest: int) -> Panel:
    """Return a slider that sets a variable of the layout to an integer from 0."""
    bounds = {"min": 0, "max": highest, "step": 1}
    return _titled(title, globalVariableName=variable, sliderProps=bounds)


def log_lines(topic: str) -> Panel:
    """Return the list of log lines."""
    return _titled("log", searchTerms=[], minLogLevel=1, topicToRender=topic)


def image(title: str, topic: str, **mode: Any) -> Panel:
    """Return an image panel; `mode` sets options such as the color map."""
    return _titled(
        title,
        cameraState={},
        followMode="follow-none",
        imageMode={"imageTopic": topic, "synchronize": False, **mode},
        layers={},
        publish={},
        # Without preloading, viewers report missing transforms.
        scene={"transforms": {"enablePreloading": True}},
        topics={},
        transforms={},
    )


def three_d(
    title: str,
    topics: Mapping[str, Sequence[str]],
    camera: Mapping[str, Any],
    follow: tuple[str, str],
    *,
    axes_m: float = 0.0,
    without_axes: Sequence[str] = (),
) -> Panel:
    """Return a 3D view that hides outlines, and the names and connections of frames."""
    return _titled(
        title,
        cameraState={
            "thetaOffset": 90,
            "target": [0, 0, 0],
            "targetOffset": [0, 0, 0],
            "targetOrientation": [0, 0, 0, 1],
            "fovy": FIELD_OF_VIEW_DEG,
            "near": 0.5,
            "far": 5000,
            **camera,
        },
        followTf=follow[0],
        followMode=follow[1],
        scene={
            "backgroundColor": "#10141c",
            "transforms": {
                "showLabel": False,
                # Axes have a length of 0.2 m at a scale of 1.
                "axisScale": axes_m / 0.2,
                "lineWidth": 0,
                "enablePreloading": True,
            },
        },
        transforms={f"frame:{frame}": {"visible": False} for frame in without_axes},
        topics={
            topic: {
                "visible": True,
                "showOutlines": False,
                **({"namespaces": {name: {"visible": False} for name in names}} if names else {}),
            }
            for topic, names in topics.items()
        },
        layers={},
        publish={},
        imageMode={},
    )


def split(first: Node, second: Node, direction: str, percent: float) -> Node:
    """Return two nodes in a `row` or a `column`; the first takes `percent` of the size."""
    return {"first": first, "second": second, "direction": direction, "splitPercentage": percent}


def stack(nodes: Sequence[Node], direction: str) -> Node:
    """Return nodes of equal size in a `row` or a `column`."""
    return weighted([(node, 1.0) for node in nodes], direction)


def weighted(nodes: Sequence[tuple[Node, float]], direction: str) -> Node:
    """Return nodes in a `row` or a `column`, whose sizes are proportional to their weights."""
    (first, weight), *rest = nodes
    if not rest:
        return first
    total = sum(each for _, each in nodes)
    return split(first, weighted(rest, direction), direction, round(100 * weight / total, 2))


def _titled(title: str, **panel: Any) -> Panel:
    return {"foxglovePanelTitle": title, "lichtblickPanelTitle": title, **panel}


def _series(label: str, path: str, **options: Any) -> dict[str, Any]:
    shown = {"enabled": True, "timestampMethod": "receiveTime"}
    return {"value": path, "label": label, **shown, **options}
