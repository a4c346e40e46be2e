"""Checks of layouts: their structure, and that every message path exists in the log."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.record.layout import LAYOUT_NAME

_PATH = re.compile(
    r"(?P<topic>/[\w/]+)(?P<filters>(?:\{[^}]*\})*)\.(?P<field>\w+)(?:\[(?P<index>\d*:?)\])?"
)
_FILTER = re.compile(r"\{(\w+)==([^}]*)\}")
# Height of a viewer's window of 1280 x 720 below its bars, and the height of a row of tabs.
_HEIGHT_PX, _TABS_PX, _LEAST_PX = 620, 30, 90


def check_layout(path: Path, layout: dict[str, Any] | None = None) -> dict[str, Any]:
    """Check a layout, by default the attached one, against a log's schemas; return the layout."""
    reader = McapReader(path)
    if layout is None:
        attached = reader.attachment(LAYOUT_NAME)
        assert attached is not None
        layout = json.loads(attached)
    assert set(layout) == {"configById", "layout", "globalVariables", "userNodes", "playbackConfig"}
    panels = layout["configById"]
    assert sorted(_panels(layout["layout"], panels)) == sorted(panels)
    for panel in panels.values():
        for series in panel.get("paths", []):
            _check_path(reader, series["value"])
        assert panel.get("foxglovePanelTitle") == panel.get("lichtblickPanelTitle")
        for key, suffix in (("path", ""), ("topicPath", ".x"), ("topicToRender", ".x")):
            if key in panel:
                topic = panel[key].split(".")[0] if suffix else None
                assert topic is None or reader.channel_of(topic) is not None, panel[key]
                if not suffix:
                    _check_path(reader, panel[key])
        for topic in panel.get("topics", {}):
            assert reader.channel_of(topic) is not None, topic
        image = panel.get("imageMode", {}).get("imageTopic")
        assert image is None or reader.channel_of(image) is not None, image
    for height_px in _heights(layout["layout"], panels, _HEIGHT_PX):
        assert height_px >= _LEAST_PX
    return layout


def series_of(layout: dict[str, Any]) -> dict[str, str]:
    """Return all named series of a layout with their paths."""
    panels = layout["configById"].values()
    return {path["label"]: path["value"] for panel in panels for path in panel.get("paths", [])}


def _check_path(reader: McapReader, path: str) -> None:
    match = _PATH.fullmatch(path)
    assert match is not None, path
    channel = reader.channel_of(match["topic"])
    assert channel is not None, path
    fields = _fields(reader.schema_of(channel).data.decode())
    filters = dict(_FILTER.findall(match["filters"]))
    for name in (match["field"], *filters):
        assert name in fields, path
    if match["topic"] == "/rl/step" and match["field"] in ("action", "reward"):
        # A final record has neither.
        assert filters.get("final") == "false", path
    count = fields[match["field"]]
    assert (match["index"] is None) == (count is None), f"{path}: not one number"
    assert count is None or match["index"] == ":" or int(match["index"]) < count, path


def _fields(text: str) -> dict[str, int | None]:
    """Return a message definition's fields with their array lengths; None for a scalar."""
    found: dict[str, int | None] = {}
    for line in text.split("=====")[0].splitlines():
        declaration = re.fullmatch(r"\w+(?:\[(\d+)\])?\s+(\w+)", line.split("#")[0].strip())
        if declaration is not None:
            found[declaration[2]] = None if declaration[1] is None else int(declaration[1])
    return found


def _heights(node: Any, panels: dict[str, Any], height_px: float) -> list[float]:
    """Return the heights of the panels of a layout, those in tabs included."""
    if isinstance(node, str):
        inner = [tab["layout"] for tab in panels[node].get("tabs", [])]
        below = [part for tab in inner for part in _heights(tab, panels, height_px - _TABS_PX)]
        return below or [height_px]
    share = node["splitPercentage"] / 100 if node["direction"] == "column" else 1.0
    rest = 1.0 - share if node["direction"] == "column" else 1.0
    first = _heights(node["first"], panels, share * height_px)
    return first + _heights(node["second"], panels, rest * height_px)


def _panels(node: Any, panels: dict[str, Any]) -> list[str]:
    """Return the panels of a layout, including those in tabs."""
    if isinstance(node, str):
        tabs = panels[node].get("tabs", [])
        return [node, *(name for tab in tabs for name in _panels(tab["layout"], panels))]
    assert node["direction"] in ("row", "column")
    assert 0 < node["splitPercentage"] < 100
    return [*_panels(node["first"], panels), *_panels(node["second"], panels)]
