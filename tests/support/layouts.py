"""Checks of layouts: structure, sizes of panels, and message paths that exist in the log."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rosbags.typesys import get_types_from_msg

from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.record.layout import LAYOUT_NAME

# Sizes in pixels. AREA_PX is the area for panels in a window of 1280 x 720 whose sidebar is open.
# TABS_PX is the height of a row of tabs. LEAST_PX is the size of the smallest useful panel.
AREA_PX, TABS_PX, LEAST_PX = (960, 600), 30, (150, 90)
_TOPIC = re.compile(r"(?:/\w+)+")
_PART = re.compile(r"\.(?P<field>\w+)|\[(?P<slice>\d+|:)\]|\{(?P<filter>[^{}]+)\}")
_FILTER = re.compile(r"(?P<field>\w+)==(?P<value>\$?\w+)")
_BASE, _NAMED, _ARRAY, _SEQUENCE = 1, 2, 3, 4
_TEXT = "string"
_MESSAGES = {
    "3D": ("visualization_msgs/msg/MarkerArray",),
    "Image": ("sensor_msgs/msg/Image", "foxglove_msgs/msg/CompressedVideo"),
    "RosOut": ("rcl_interfaces/msg/Log",),
}


class Topics:
    """The topics of a log or stream with their types, to resolve message paths."""

    def __init__(self, schemas: Mapping[str, tuple[str, str]]) -> None:
        """Parse the schemas: type name and definition of each topic."""
        self.types: dict[str, Any] = {}
        self.names = {topic: name for topic, (name, _) in schemas.items()}
        for name, text in schemas.values():
            self.types |= get_types_from_msg(text, name)

    @classmethod
    def of_log(cls, path: Path, prefix: str = "") -> Topics:
        """Read the topics of a log, each with a prefix."""
        reader = McapReader(path)
        found = {}
        for channel in reader.channels.values():
            schema = reader.schema_of(channel)
            topic = f"/{prefix}{channel.topic}" if prefix else channel.topic
            found[topic] = (schema.name, schema.data.decode())
        return cls(found)

    def constants(self, topic: str) -> dict[str, Any]:
        """Return the constants of a topic's type."""
        return {name: value for name, _, value in self.types[self.names[topic]][0]}

    def resolve(self, path: str, variables: Mapping[str, Any]) -> tuple[str, bool]:
        """Return the basic type that a path selects, and whether it selects a whole array."""
        topic = _TOPIC.match(path)
        assert topic is not None, path
        assert topic[0] in self.names, f"{path}: no such topic"
        kind: Any = (_NAMED, self.names[topic[0]])
        position, whole = topic.end(), False
        while position < len(path):
            part = _PART.match(path, position)
            assert part is not None, f"{path}: cannot be parsed at {position}"
            if part["field"] is not None:
                kind = self._fields(kind, path)[part["field"]]
            elif part["slice"] is not None:
                assert kind[0] in (_ARRAY, _SEQUENCE), f"{path}: no array"
                whole = whole or part["slice"] == ":"
                outside = kind[0] == _ARRAY and not whole and int(part["slice"]) >= kind[1][1]
                assert not outside, f"{path}: index out of range"
                kind = kind[1][0]
            else:
                self._check_filter(part["filter"], kind, path, variables)
            position = part.end()
        assert kind[0] == _BASE, f"{path}: not a number or text"
        return str(kind[1][0]), whole

    def _fields(self, kind: Any, path: str) -> dict[str, Any]:
        assert kind[0] == _NAMED, f"{path}: no field of a message"
        return _Strict(self.types[kind[1]][1])

    def _check_filter(self, text: str, kind: Any, path: str, variables: Mapping[str, Any]) -> None:
        parts = _FILTER.fullmatch(text)
        assert parts is not None, path
        field, value = self._fields(kind, path)[parts["field"]], parts["value"]
        if value.startswith("$"):
            assert value[1:] in variables, f"{path}: unknown variable"
            value = str(variables[value[1:]])
        is_flag = field[1][0] == "bool"
        assert re.fullmatch("true|false" if is_flag else r"-?\d+", value), path


class _Strict(dict[str, Any]):
    """Dict of fields by name; an unknown name fails the test."""

    def __missing__(self, name: str) -> Any:
        raise AssertionError(f"no field {name}: {sorted(self)}")


def check_layout(path: Path, layout: dict[str, Any] | None = None) -> dict[str, Any]:
    """Check a layout, by default the attached one, against a log; return the layout."""
    if layout is None:
        attached = McapReader(path).attachment(LAYOUT_NAME)
        assert attached is not None
        layout = json.loads(attached)
    check_panels(layout, Topics.of_log(path))
    return layout


def check_panels(
    layout: dict[str, Any], topics: Topics, area_px: tuple[float, float] = AREA_PX
) -> None:
    """Check the structure of a layout, each panel, and the sizes of the panels in an area."""
    assert set(layout) == {"configById", "layout", "globalVariables", "userNodes", "playbackConfig"}
    panels, variables = layout["configById"], layout["globalVariables"]
    placed = dict(sizes_of(layout["layout"], panels, area_px))
    assert sorted(placed) == sorted(panels), "each panel is in exactly one place"
    for name, panel in panels.items():
        kind = name.partition("!")[0]
        if kind != "Tab":
            assert panel["foxglovePanelTitle"] == panel["lichtblickPanelTitle"] != ""
            width_px, height_px = placed[name]
            assert height_px >= LEAST_PX[1], f"{name}: {height_px} px"
            assert width_px >= LEAST_PX[0], f"{name}: {width_px} px"
        for topic in _topics_of(panel):
            assert topics.names[topic] in _MESSAGES.get(kind, topics.names[topic]), name
        for path in paths_of(panel):
            found, is_array = topics.resolve(path, variables)
            assert is_array == (panel.get("xAxisVal") == "index"), path
            assert found != _TEXT or kind in ("StateTransitions", "Indicator"), path
            if path.partition("{")[0].endswith("/rl/step") or "/rl/step." in path:
                assert "{final==false}" in path, f"{path}: final records have no action"
        if kind == "Plot" and panel["xAxisVal"] == "custom":
            x_topic = panel["xAxisPath"]["value"].partition(".")[0]
            assert not any(path["value"].startswith(f"{x_topic}.") for path in panel["paths"])
        if kind == "GlobalVariableSliderPanel":
            assert panel["globalVariableName"] in variables
        if kind == "3D" and panel["cameraState"]["perspective"]:
            camera = panel["cameraState"]
            assert 90 - camera["phi"] < camera["fovy"] / 2 - 3, "the horizon is in view"


def paths_of(panel: dict[str, Any]) -> list[str]:
    """Return all message paths of a panel."""
    found = [path["value"] for path in panel.get("paths", [])]
    found += [panel["path"]] if "path" in panel else []
    return found + ([panel["xAxisPath"]["value"]] if "xAxisPath" in panel else [])


def series_of(layout: dict[str, Any]) -> dict[str, str]:
    """Return all named series of a layout with their paths."""
    panels = layout["configById"].values()
    return {path["label"]: path["value"] for panel in panels for path in panel.get("paths", [])}


def sizes_of(
    node: Any, panels: dict[str, Any], area_px: tuple[float, float]
) -> Iterator[tuple[str, tuple[float, float]]]:
    """Yield the width and height of each panel of a layout in pixels, including panels in tabs."""
    width_px, height_px = area_px
    if isinstance(node, str):
        yield node, area_px
        for tab in panels[node].get("tabs", []):
            yield from sizes_of(tab["layout"], panels, (width_px, height_px - TABS_PX))
        return
    share = node["splitPercentage"] / 100
    assert 0 < share < 1
    for part, name in ((share, "first"), (1 - share, "second")):
        areas = {"row": (part * width_px, height_px), "column": (width_px, part * height_px)}
        yield from sizes_of(node[name], panels, areas[node["direction"]])


def _topics_of(panel: dict[str, Any]) -> list[str]:
    """Return the topics that a panel shows as a whole."""
    found = [*panel.get("topics", {})]
    found += [panel[key] for key in ("topicPath", "topicToRender") if key in panel]
    image = panel.get("imageMode", {}).get("imageTopic")
    return found + ([image] if image else [])
