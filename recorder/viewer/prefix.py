"""Prefixes for the topics and coordinate frames of several logs in one viewer."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mcaprl.recorder.format import messages

WORLD = "map"
"""Name of the coordinate frame that all logs share."""
_MARKERS, _FRAMES = "visualization_msgs/msg/MarkerArray", "tf2_msgs/msg/TFMessage"
PREFIXED_TYPES = (_MARKERS, _FRAMES)
"""Types of messages that contain frame names; these names get a prefix."""


def prefixes_of(paths: Sequence[Path]) -> list[str]:
    """Return a unique prefix for each file; a single file gets an empty prefix.

    >>> prefixes_of([Path("runs/a.mcap"), Path("b/a.mcap"), Path("C-1.mcap")])
    ['a', 'a_2', 'c_1']
    """
    if len(paths) == 1:
        return [""]
    words: list[str] = []
    for path in paths:
        stem = re.sub(r"[^a-z0-9]+", "_", path.stem.lower()).strip("_") or "log"
        word, count = stem, 1
        while word in words:
            count += 1
            word = f"{stem}_{count}"
        words.append(word)
    return words


def prefixed_message(data: bytes, type_name: str, prefix: str, shift_ns: int) -> bytes:
    """Add a prefix to a message's frame names other than `WORLD`, and shift its stamps.

    Args:
        data: CDR bytes of the message.
        type_name: Type of the message, one of `PREFIXED_TYPES`.
        prefix: Prefix of the log.
        shift_ns: Time to add to nonzero stamps.
    """
    message = messages.decode(data, type_name)
    parts = message.markers if type_name == _MARKERS else message.transforms
    for part in parts:
        part.header.frame_id = _below(prefix, part.header.frame_id)
        stamp_ns = part.header.stamp.sec * 10**9 + part.header.stamp.nanosec
        if stamp_ns:
            part.header.stamp = messages.stamp(stamp_ns + shift_ns)
        if type_name == _FRAMES:
            part.child_frame_id = _below(prefix, part.child_frame_id)
    return messages.encode(message)


def side_by_side(layouts: Sequence[dict[str, Any]], prefixes: Sequence[str]) -> dict[str, Any]:
    """Return a layout in which each screen shows several logs side by side."""
    parts = [_prefixed_layout(*pair) for pair in zip(layouts, prefixes, strict=True)]
    if len(parts) == 1:
        return parts[0]
    panels = {name: panel for part in parts for name, panel in part.get("configById", {}).items()}
    variables = {
        name: value for part in parts for name, value in part.get("globalVariables", {}).items()
    }
    roots = [part.get("layout") for part in parts]
    screens = [_screens(panels, root) for root in roots]
    root = _in_a_row(roots)
    if all(screens) and len({tuple(each) for each in screens}) == 1:
        panels = {name: panel for name, panel in panels.items() if name not in roots}
        shown = {title: _in_a_row([each[title] for each in screens]) for title in screens[0]}
        tabs = [{"title": title, "layout": node} for title, node in shown.items()]
        root = "Tab!screens"
        panels[root] = {"activeTabIdx": 0, "tabs": tabs}
    return {**parts[0], "configById": panels, "globalVariables": variables, "layout": root}


def _screens(panels: dict[str, Any], root: Any) -> dict[str, Any]:
    """Return the layout of each screen by title; empty if the root is not a panel with tabs."""
    panel = panels.get(root) if isinstance(root, str) else None
    tabs = panel.get("tabs", []) if isinstance(panel, dict) else []
    return {tab["title"]: tab["layout"] for tab in tabs}


def _in_a_row(nodes: Sequence[Any]) -> Any:
    *firsts, root = nodes
    for count, first in enumerate(reversed(firsts), start=2):
        root = {"first": first, "second": root, "direction": "row", "splitPercentage": 100 / count}
    return root


def _prefixed_layout(layout: dict[str, Any], prefix: str) -> dict[str, Any]:
    """Add a prefix to the topics, coordinate frames, variables and panels of a layout."""
    if not prefix:
        return layout
    text = json.dumps(layout)
    # Strings that begin with a slash are topics. Names of panels have the form `Kind!title`.
    text = re.sub(r'"(/[a-z])', rf'"/{prefix}\1', text)
    text = re.sub(r'"(\w+)!', rf'"\1!{prefix} ', text)
    text = re.sub(r'("followTf": "|"frame:)(?!map")', rf"\g<1>{prefix}/", text)
    text = re.sub(r'(\{\w+==\$|"globalVariableName": ")', rf"\g<1>{prefix}_", text)
    found: dict[str, Any] = json.loads(text)
    variables = found.get("globalVariables", {})
    return {**found, "globalVariables": {f"{prefix}_{name}": variables[name] for name in variables}}


def _below(prefix: str, frame: str) -> str:
    return frame if frame in ("", WORLD) else f"{prefix}/{frame}"
