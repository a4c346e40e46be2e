"""Panels of a Foxglove layout: the configuration of each kind.

Titles have two keys, since Foxglove and Lichtblick read different ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Panel = dict[str, Any]

_COLORS = ("#4e98e2", "#f5774d", "#31b57b", "#a395e2", "#e8c547", "#d65f8a", "#7fd1d8", "#9c755f")
_NEUTRAL, _GOOD, _BAD = "#4e98e2", "#31b57b", "#d64545"
# Viewers warn of transforms that are not loaded ahead.
_TRANSFORMS = {"showLabel": False, "axisScale": 0, "lineWidth": 0, "enablePreloading": True}


def titled(title: str, **panel: Any) -> Panel:
    """Return a panel with a title."""
    return {"foxglovePanelTitle": title, "lichtblickPanelTitle": title, **panel}


def tabs(nodes: Mapping[str, Any]) -> Panel:
    """Return a panel of tabs, each with a layout of its own."""
    parts = [{"title": title, "layout": node} for title, node in nodes.items()]
    return {"activeTabIdx": 0, "tabs": parts}


def plot(title: str, paths: Mapping[str, str], **options: Any) -> Panel:
    """Return a plot of series by label; the legend stands beside several series."""
    series = [
        {
            "value": path,
            "label": label,
            "color": _COLORS[index % len(_COLORS)],
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for index, (label, path) in enumerate(paths.items())
    ]
    return titled(
        title,
        paths=series,
        xAxisVal="timestamp",
        isSynced=True,
        showLegend=len(paths) > 1,
        legendDisplay="left" if len(paths) > 1 else "none",
        showXAxisLabels=True,
        showYAxisLabels=True,
        showPlotValuesInLegend=False,
    ) | dict(options)


def state_transitions(title: str, paths: Mapping[str, str], **options: Any) -> Panel:
    """Return rows of discrete values by label."""
    rows = [
        {"value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime"}
        for label, path in paths.items()
    ]
    return titled(title, paths=rows, isSynced=True) | dict(options)


def gauge(title: str, path: str, highest: float) -> Panel:
    """Return a gauge of a number from 0 to its highest value."""
    return titled(
        title,
        path=path,
        minValue=0,
        maxValue=highest,
        colorMap="turbo",
        colorMode="colormap",
        gradient=[_NEUTRAL, _BAD],
        reverse=False,
    )


def indicator(title: str, path: str, running: str, successes: Sequence[str]) -> Panel:
    """Return a light: neutral while an episode runs, then green for a success, red otherwise."""
    colors = {running: _NEUTRAL, **dict.fromkeys(successes, _GOOD)}
    rules = [
        {"operator": "=", "rawValue": value, "color": color, "label": value.replace("_", " ")}
        for value, color in colors.items()
    ]
    fallback = {"fallbackColor": _BAD, "fallbackLabel": "failed"}
    return titled(title, path=path, style="background", rules=rules, **fallback)


def raw_messages(topic: str) -> Panel:
    """Return the latest message of a topic as a tree."""
    options = {"diffEnabled": False, "diffMethod": "custom", "diffTopicPath": ""}
    return titled(topic, topicPath=topic, showFullMessageForDiff=False, **options)


def slider(variable: str, highest: int) -> Panel:
    """Return a slider that sets a variable of the layout, from 0."""
    bounds = {"min": 0, "max": highest, "step": 1}
    return titled(variable, globalVariableName=variable, sliderProps=bounds)


def log_lines() -> Panel:
    """Return the list of log lines."""
    return titled("log", searchTerms=[], minLogLevel=1, topicToRender="/rosout")


def image(title: str, topic: str, **mode: Any) -> Panel:
    """Return an image, with options of its colors."""
    return titled(
        title,
        cameraState={},
        followMode="follow-none",
        imageMode={"imageTopic": topic, "synchronize": False, **mode},
        layers={},
        publish={},
        scene={"transforms": {"enablePreloading": True}},
        topics={},
        transforms={},
    )


def three_d(
    title: str, topics: Sequence[str], camera: Mapping[str, Any], follow_frame: str = ""
) -> Panel:
    """Return a 3D view without outlines and names of frames.

    Args:
        title: Title of the panel.
        topics: Topics of markers to show.
        camera: Fields of the camera state.
        follow_frame: Frame that the view moves with; empty for a fixed view.
    """
    return titled(
        title,
        cameraState={
            "thetaOffset": 90,
            "target": [0, 0, 0],
            "targetOffset": [0, 0, 0],
            "targetOrientation": [0, 0, 0, 1],
            "fovy": 45,
            "near": 0.5,
            "far": 5000,
            **camera,
        },
        followMode="follow-pose" if follow_frame else "follow-none",
        followTf=follow_frame or "map",
        scene={"backgroundColor": "#10141c", "transforms": _TRANSFORMS},
        transforms={},
        topics={
            topic: {"visible": True, "showOutlines": False, "settings": {"showOutlines": False}}
            for topic in topics
        },
        layers={},
        publish={},
        imageMode={},
    )
