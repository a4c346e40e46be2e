"""Spaces in Minari's JSON text.

Minari does not store the dtype of a Discrete space. This module writes the dtype in addition:
Minari ignores it, and `space_from_text` reads it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from mcaprl.errors import SpaceError
from mcaprl.files import parse_json
from mcaprl.recorder.format.spaces import Leaf, space_from_json

# Shortest edge, in pixels, of the images that Minari may store as JPEG.
_MIN_JPEG_EDGE = 32


class StoredSpace(NamedTuple):
    """A space of a Minari dataset, converted to a space that a log can store.

    Attributes:
        space: Space of the log. A Tuple becomes a Dict with the keys `0`, `1`, ...
        keys: Path of each leaf of `space` in Minari's files, in order. Keys of a Dict are strings,
            indexes of a Tuple are integers.
    """

    space: spaces.Space[Any]
    keys: tuple[tuple[str | int, ...], ...]


def space_to_text(space: spaces.Space[Any]) -> str:
    """Return the JSON text of a space in Minari's form."""
    return json.dumps(_to_plain(space))


def space_from_text(text: str, role: str) -> StoredSpace:
    """Read a space.

    Args:
        text: Space in Minari's JSON text.
        role: `observation` or `action`, for errors.

    Raises:
        SpaceError: The text does not describe a space, or a log cannot store the space.
    """
    try:
        plain = parse_json(text)
        if role == "action" and _members(plain) is not None:
            raise SpaceError(
                f"action is a {plain['type']} space; a log can store Box, Discrete, MultiDiscrete,"
                " MultiBinary"
            )
        ours, keys = _ours(plain, role), tuple(_leaf_keys(plain))
    except SpaceError:
        raise
    # The JSON text can have any structure, so these errors can occur.
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise SpaceError(f"not a description of a space: {str(text)[:80]!r}") from error
    return StoredSpace(space_from_json(json.dumps(ours)), keys)


def may_be_jpeg(space: spaces.Space[Any], leaf: Leaf) -> bool:
    """Return whether Minari stores a leaf as JPEG in a dataset with JPEG encoding."""
    box = leaf.of(space)
    return (
        isinstance(box, spaces.Box)
        and box.dtype == np.uint8
        and len(box.shape) in (2, 3)
        and min(box.shape[:2]) >= _MIN_JPEG_EDGE
        and bool((box.low == 0).all() and (box.high == 255).all())
    )


def _to_plain(space: spaces.Space[Any]) -> dict[str, Any]:
    match space:
        case spaces.Box():
            return {
                "type": "Box",
                "dtype": str(space.dtype),
                "shape": list(space.shape),
                "low": space.low.tolist(),
                "high": space.high.tolist(),
            }
        case spaces.Discrete():
            return {
                "type": "Discrete",
                "dtype": str(space.dtype),
                "start": int(space.start),
                "n": int(space.n),
            }
        case spaces.MultiDiscrete():
            return {
                "type": "MultiDiscrete",
                "dtype": str(space.dtype),
                "nvec": space.nvec.tolist(),
                "start": space.start.tolist(),
            }
        case spaces.MultiBinary():
            return {"type": "MultiBinary", "n": space.n}
        case spaces.Dict():
            parts = {key: _to_plain(part) for key, part in space.spaces.items()}
            return {"type": "Dict", "subspaces": parts}
        case _:
            raise SpaceError(f"a {type(space).__name__} space cannot be stored in a Minari dataset")


def _members(plain: dict[str, Any]) -> list[tuple[str | int, dict[str, Any]]] | None:
    """Return the key and description of each member of a Dict or Tuple; None for other spaces."""
    match plain["type"]:
        case "Dict":
            return list(plain["subspaces"].items())
        case "Tuple":
            return list(enumerate(plain["subspaces"]))
    return None


def _leaf_keys(
    plain: dict[str, Any], path: tuple[str | int, ...] = ()
) -> Iterator[tuple[str | int, ...]]:
    members = _members(plain)
    if members is None:
        yield path
    for key, part in members or ():
        yield from _leaf_keys(part, (*path, key))


def _ours(plain: dict[str, Any], where: str) -> dict[str, Any]:
    """Convert Minari's description of a space to the form that `space_from_json` reads."""
    members = _members(plain)
    if members is not None:
        parts = [[str(key), _ours(part, f"{where}['{key}']")] for key, part in members]
        return {"type": "Dict", "spaces": parts}
    match plain["type"]:
        case "Box":
            bounds = {name: _flat(plain[name]) for name in ("low", "high")}
            return {**plain, **bounds}
        case "Discrete" | "MultiBinary":
            return plain
        case "MultiDiscrete":
            return {**plain, "start": plain.get("start", np.zeros_like(plain["nvec"]).tolist())}
        case other:
            raise SpaceError(
                f"{where} is a {other} space; a log can store Box, Discrete, MultiDiscrete,"
                " MultiBinary, and for observations Dict and Tuple of these"
            )


def _flat(bounds: Any) -> Any:
    """Flatten nested lists of bounds; return one number if all bounds are equal."""
    while isinstance(bounds, list) and bounds and isinstance(bounds[0], list):
        bounds = [value for row in bounds for value in row]
    if isinstance(bounds, list) and bounds and bounds.count(bounds[0]) == len(bounds):
        return bounds[0]
    return bounds
