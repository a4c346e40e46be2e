"""Spaces in Minari's JSON text.

Minari does not store the dtype of a Discrete space. This module writes the dtype in addition:
Minari ignores it, and `space_from_text` reads it.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from mcaprl.errors import SpaceError
from mcaprl.files import parse_json
from mcaprl.recorder.format.spaces import Leaf, leaves_of, space_from_json

# Shortest edge, in pixels, of the images that Minari may store as JPEG.
_MIN_JPEG_EDGE = 32
_STORABLE = ("Box", "Discrete", "MultiDiscrete", "MultiBinary")
_REMEDY = "convert it with `lossy=True` to {}"


class StoredSpace(NamedTuple):
    """A space of a Minari dataset, converted to a space that a log can store.

    Attributes:
        space: Space of the log. A Tuple becomes a Dict with the keys `0`, `1`, ...
        keys: Path of each leaf of `space` in Minari's files, in order. Keys of a Dict are strings,
            indexes of a Tuple are integers. If several leaves of an action are joined to one, these
            are their paths.
        lost: One sentence for each part that is left out or changed.
    """

    space: spaces.Space[Any]
    keys: tuple[tuple[str | int, ...], ...]
    lost: tuple[str, ...] = ()


def space_to_text(space: spaces.Space[Any]) -> str:
    """Return the JSON text of a space in Minari's form."""
    return json.dumps(_to_plain(space))


def space_from_text(text: str, role: str, *, lossy: bool = False) -> StoredSpace:
    """Read a space."""
    try:
        plain = parse_json(text)
        is_joined = role == "action" and _members(plain) is not None
        if is_joined and not lossy:
            raise SpaceError(
                f"action is a {plain['type']} space; a log can store Box, Discrete, MultiDiscrete,"
                f" MultiBinary; {_REMEDY.format('join its parts')}"
            )
        lost: list[str] = []
        leaves: list[tuple[str | int, ...]] = []
        ours = _ours(plain, role, (), leaves, lost if lossy else None)
        if ours is None:
            raise SpaceError(f"nothing is left of the {role}: {'; '.join(lost)}")
        space = space_from_json(json.dumps(ours))
    except SpaceError:
        raise
    # The JSON text can have any structure, so these errors can occur.
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise SpaceError(f"not a description of a space: {str(text)[:80]!r}") from error
    if is_joined:
        space, sentence = _joined(space)
        lost.append(sentence)
    return StoredSpace(space, tuple(leaves), tuple(lost))


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


def _ours(
    plain: dict[str, Any],
    where: str,
    path: tuple[str | int, ...],
    leaves: list[tuple[str | int, ...]],
    lost: list[str] | None,
) -> dict[str, Any] | None:
    """Convert Minari's description of a space to the form that `space_from_json` reads.

    Returns:
        The description; None if the space is left out.
    """
    members = _members(plain)
    if members is not None:
        parts = []
        for key, part in members:
            inner = _ours(part, f"{where}['{key}']", (*path, key), leaves, lost)
            if inner is not None:
                parts.append([str(key), inner])
        return {"type": "Dict", "spaces": parts} if parts or not members else None
    if plain["type"] not in _STORABLE:
        sentence = f"{where} is a {plain['type']} space"
        if lost is None:
            remedy = f"; {_REMEDY.format('leave it out')}" if path else ""
            raise SpaceError(
                f"{sentence}; a log can store Box, Discrete, MultiDiscrete, MultiBinary, and for"
                f" observations Dict and Tuple of these{remedy}"
            )
        lost.append(f"{sentence}, which is left out")
        return None
    leaves.append(path)
    match plain["type"]:
        case "Box":
            bounds = {name: _flat(plain[name]) for name in ("low", "high")}
            return {**plain, **bounds}
        case "Discrete" | "MultiBinary":
            return plain
        case _:
            return {**plain, "start": plain.get("start", np.zeros_like(plain["nvec"]).tolist())}


def _joined(space: spaces.Space[Any]) -> tuple[spaces.Space[Any], str]:
    """Join the leaves of a Dict to one space; return the space and a sentence about it."""
    parts = [leaf.of(space) for leaf in leaves_of(space)]
    names = ", ".join("/".join(leaf.path) for leaf in leaves_of(space))
    if len(parts) == 1:
        return parts[0], f"the action is its only part {names}"
    if parts and all(isinstance(part, spaces.Box) for part in parts):
        low, high = (
            np.concatenate([np.ravel(getattr(part, name)) for part in parts])
            for name in ("low", "high")
        )
        joined: spaces.Space[Any] = spaces.Box(low, high, dtype=low.dtype.type)
    elif parts and all(isinstance(part, spaces.Discrete | spaces.MultiDiscrete) for part in parts):
        counts: list[Any] = [getattr(part, "nvec", getattr(part, "n", 0)) for part in parts]
        joined = spaces.MultiDiscrete(
            np.concatenate([np.ravel(count) for count in counts]),
            start=np.concatenate([np.ravel(part.start) for part in parts]),
        )
    else:
        kinds = ", ".join(type(part).__name__ for part in parts) or "nothing"
        raise SpaceError(
            f"the parts of the action are {kinds}; only parts of one kind can be joined"
        )
    return joined, f"the parts {names} of the action are joined to one vector"


def _flat(bounds: Any) -> Any:
    """Flatten nested lists of bounds; return one number if all bounds are equal."""
    while isinstance(bounds, list) and bounds and isinstance(bounds[0], list):
        bounds = [value for row in bounds for value in row]
    if isinstance(bounds, list) and bounds and bounds.count(bounds[0]) == len(bounds):
        return bounds[0]
    return bounds
