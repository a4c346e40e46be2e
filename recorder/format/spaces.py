"""Gymnasium spaces in a log: as JSON text, and as a flat list of leaves.

A leaf is one array of an observation or action. A Dict space has one leaf per key; any other
supported space is a single leaf. Supported spaces are Box, Discrete, MultiDiscrete, MultiBinary
and, for observations, Dict spaces of these at any depth.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import SpaceError, UnknownNameError
from mcaprl.files import parse_json

# Smallest height and width of a uint8 array that is treated as an image. SB3 has no such limit, but
# its Nature CNN needs at least 36 pixels.
MIN_IMAGE_EDGE = 8
IMAGE_ENCODINGS = {1: "mono8", 3: "rgb8", 4: "rgba8"}
# These limits restrict the memory that a reader allocates, since a few bytes of JSON can describe a
# huge space. They permit an RGBA image of 3840 x 2160 pixels and one network output per action.
MAX_ELEMENTS = 2**25
MAX_ACTIONS = 2**20
_MAX_DIMENSIONS = 64


@dataclass(frozen=True)
class Leaf:
    """One array of an observation or action."""

    name: str  # Name of the field in `/rl/step`; for an image, the last part of its topic
    # Keys from the root of a Dict space to the leaf; empty for the root itself.
    path: tuple[str, ...]
    shape: tuple[int, ...]  # Shape of one value; empty for a scalar
    dtype: np.dtype[Any]  # Data type of the environment's values
    # Encoding of an image (`mono8`, `rgb8`, `rgba8`); None for any other leaf.
    encoding: str | None = None

    @property
    def size(self) -> int:
        """Number of elements of one value."""
        return math.prod(self.shape)

    @property
    def topic(self) -> str:
        """Topic of an image leaf."""
        return f"/rl/observation/{self.name}"

    def of(self, observation: Any) -> Any:
        """Return the leaf's part of an observation."""
        for key in self.path:
            observation = observation[key]
        return observation


def observation_leaves(space: spaces.Space[Any]) -> tuple[Leaf, ...]:
    """List the leaves of an observation space, in the space's order."""
    found = leaves_of(space)
    if not found:
        raise SpaceError("the observation space is an empty Dict: there is nothing to record")
    return found


def leaves_of(space: spaces.Space[Any]) -> tuple[Leaf, ...]:
    """List the leaves of an observation space in order. An empty Dict has no leaves."""
    taken: set[str] = set()
    found: list[Leaf] = []
    for path, part in _walk(space, ()):
        shape, dtype = _shape_and_dtype(part, "observation", path)
        encoding = _image_encoding(part)
        words = path or (("image",) if encoding else ())
        name = _field_name(words if encoding else ("observation", *words), taken)
        found.append(Leaf(name, path, shape, dtype, encoding))
    check_elements(sum(leaf.size for leaf in found))
    return tuple(found)


def select(leaves: Sequence[Leaf], keys: Sequence[str] | None) -> list[Leaf]:
    """Select leaves of a Dict space by key: `joints/q` one, `joints` all below it."""
    if keys is None:
        return list(leaves)
    names = {leaf: "/".join(leaf.path) for leaf in leaves}
    for key in keys:
        if not any(is_below(name, key) for name in names.values()):
            raise UnknownNameError("column", key, filter(None, names.values()))
    return [leaf for leaf, name in names.items() if any(is_below(name, key) for key in keys)]


def is_below(name: str, key: str) -> bool:
    """Return whether the leaf `name`, such as `joints/q`, is `key` or below it."""
    return name == key or name.startswith(f"{key}/")


def check_key(key: object, role: str, path: tuple[str | int, ...] = ()) -> None:
    """Check that a key of a Dict space is a text, because a log stores the keys as texts."""
    if not isinstance(key, str):
        raise SpaceError(
            f"keys of a Dict must be texts: {_place(role, path)} has the key {key!r:.60}; rename"
            " them, e.g. with a TransformObservation wrapper"
        )


def outside(space: spaces.Space[Any], values: NDArray[Any]) -> NDArray[np.bool_]:
    """Return an (N,) mask of the values (N, *shape) outside a space; all False for a Dict."""
    bounds = bounds_of(space)
    if bounds is None:
        return np.zeros(len(values), np.bool_)
    low, high = bounds
    wrong = ~((values >= low) & (values <= high))
    # The type is a string, because evaluating it takes as long as the comparison of short arrays.
    return cast("NDArray[np.bool_]", wrong.any(tuple(range(1, wrong.ndim))))


def bounds_of(space: spaces.Space[Any]) -> tuple[NDArray[Any], NDArray[Any]] | None:
    """Return the smallest and largest values (*shape) of a space; None for other spaces."""
    match space:
        case spaces.Discrete():
            bounds = space.start, space.start + space.n - 1
        case spaces.MultiDiscrete():
            bounds = space.start, space.start + space.nvec - 1
        case spaces.MultiBinary():
            bounds = np.zeros(space.shape, np.int8), np.ones(space.shape, np.int8)
        case spaces.Box():
            bounds = space.low, space.high
        case _:
            return None
    return np.asarray(bounds[0]), np.asarray(bounds[1])


def restricted(space: spaces.Space[Any], leaves: Sequence[Leaf]) -> spaces.Dict:
    """Return a Dict space with only the parts that are in `leaves`."""
    groups: dict[str, list[Leaf]] = {}
    for leaf in leaves:
        groups.setdefault(leaf.path[0], []).append(replace(leaf, path=leaf.path[1:]))
    return spaces.Dict(
        [
            (key, restricted(space[key], inner) if inner[0].path else space[key])
            for key, inner in groups.items()
            if isinstance(space, spaces.Dict)
        ]
    )


def action_leaf(space: spaces.Space[Any]) -> Leaf:
    """Return the single leaf of an action space."""
    shape, dtype = _shape_and_dtype(space, "action", ())
    check_elements(math.prod(shape))
    check_actions(space)
    return Leaf("action", (), shape, dtype)


def part_names(space: spaces.Space[Any], names: Sequence[str]) -> tuple[str, ...]:
    """Return the name of each number of an action, in C order: `names`, or else `action[0]` etc."""
    shape = tuple(space.shape or ())
    if len(names) == math.prod(shape):
        return tuple(names)
    return tuple(f"action[{index}]" for index in range(math.prod(shape))) if shape else ("action",)


def check_actions(space: spaces.Space[Any]) -> None:
    """Check that a space does not have too many discrete actions for a log or a policy."""
    if isinstance(space, spaces.Discrete) and int(space.n) > MAX_ACTIONS:
        raise SpaceError(
            f"the action space Discrete({space.n}) is too large: at most {MAX_ACTIONS} discrete"
            " actions can be used; group them, or use MultiDiscrete"
        )


def check_elements(count: float) -> None:
    """Check that a space is small enough for a log or a policy."""
    if not count <= MAX_ELEMENTS:
        raise SpaceError(
            f"a space of {count} elements is too large; at most {MAX_ELEMENTS} can be used"
        )


def nest(leaves: tuple[Leaf, ...], arrays: Sequence[Any]) -> Any:
    """Arrange the leaves' arrays in the structure of the space: one array, or nested dicts."""
    if leaves and leaves[0].path == ():
        return arrays[0]
    nested: dict[str, Any] = {}
    for leaf, array in zip(leaves, arrays, strict=True):
        inner = nested
        for key in leaf.path[:-1]:
            inner = inner.setdefault(key, {})
        inner[leaf.path[-1]] = array
    return nested


def space_to_json(space: spaces.Space[Any]) -> str:
    """Convert a space to JSON text, from which `space_from_json` creates an equal space."""
    return json.dumps(_to_plain(space))


def space_from_json(text: str) -> spaces.Space[Any]:
    """Read a space that `space_to_json` wrote."""
    try:
        plain = parse_json(text)
        # Check the size first, because the bounds of a Box take memory for each element.
        check_elements(_elements(plain))
        return _from_plain(plain)
    except SpaceError:
        raise
    # NumPy and Gymnasium raise errors of many types when the text is invalid.
    except Exception as error:
        raise SpaceError(f"not a description of a space: {text[:80]!r}") from error


def _walk(
    space: spaces.Space[Any], path: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], spaces.Space[Any]]]:
    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            check_key(key, "observation", path)
            yield from _walk(part, (*path, key))
    else:
        yield path, space


def _place(role: str, path: tuple[str | int, ...]) -> str:
    return role + "".join(f"[{key!r}]" for key in path)


def _shape_and_dtype(
    space: spaces.Space[Any], role: str, path: tuple[str, ...]
) -> tuple[tuple[int, ...], np.dtype[Any]]:
    where = _place(role, path)
    if not isinstance(
        space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary
    ):
        allowed = "Box, Discrete, MultiDiscrete, MultiBinary"
        if role == "observation":
            allowed += ", or a Dict of these"
        else:
            allowed += ": convert it, e.g. with a TransformAction wrapper"
        raise SpaceError(f"{where} is a {type(space).__name__} space; a log can store {allowed}")
    shape = tuple(space.shape or ())
    if math.prod(shape) == 0:
        raise SpaceError(f"{where} has no elements: its shape is {shape}; remove it from the space")
    dtype = np.dtype(space.dtype)
    if dtype.kind not in "biuf" or dtype.itemsize > 8:
        raise SpaceError(f"{where} has dtype {dtype}; a log can store bool, integers and floats")
    return shape, dtype


def _image_encoding(space: spaces.Space[Any]) -> str | None:
    """Return the encoding of a uint8 image space (height, width[, 1 | 3 | 4]), otherwise None."""
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8:
        return None
    if len(space.shape) not in (2, 3) or min(space.shape[:2]) < MIN_IMAGE_EDGE:
        return None
    return IMAGE_ENCODINGS.get(space.shape[2] if len(space.shape) == 3 else 1)


def _field_name(words: tuple[str, ...], taken: set[str]) -> str:
    """Build a unique ROS field name: lower-case letters, digits and single underscores."""
    plain = [re.sub(r"[^a-z0-9]+", "_", str(word).lower()).strip("_") or "x" for word in words]
    name = candidate = "_".join(plain)
    if not name[0].isalpha():
        name = candidate = f"key_{name}"
    number = 2
    while candidate in taken:
        candidate, number = f"{name}_{number}", number + 1
    taken.add(candidate)
    return candidate


def _to_plain(space: spaces.Space[Any]) -> dict[str, Any]:
    match space:
        case spaces.Box():
            return {
                "type": "Box",
                "low": _numbers(space.low),
                "high": _numbers(space.high),
                "shape": list(space.shape),
                "dtype": str(space.dtype),
            }
        case spaces.Discrete():
            plain = {"type": "Discrete", "n": int(space.n), "start": int(space.start)}
            return plain if space.dtype == np.int64 else {**plain, "dtype": str(space.dtype)}
        case spaces.MultiDiscrete():
            return {
                "type": "MultiDiscrete",
                "nvec": space.nvec.tolist(),
                "start": space.start.tolist(),
                "dtype": str(space.dtype),
            }
        case spaces.MultiBinary():
            return {"type": "MultiBinary", "n": space.n}
        case spaces.Dict():
            parts = [[key, _to_plain(part)] for key, part in space.spaces.items()]
            return {"type": "Dict", "spaces": parts}
        case _:
            raise SpaceError(f"a {type(space).__name__} space cannot be written to a log")


def _from_plain(plain: dict[str, Any]) -> spaces.Space[Any]:
    match plain["type"]:
        case "Box":
            shape, dtype = tuple(plain["shape"]), _dtype(plain)
            low = _bounds(plain["low"], shape, dtype)
            high = _bounds(plain["high"], shape, dtype)
            return spaces.Box(low, high, shape, dtype.type)
        case "Discrete":
            # In Gymnasium 1.1, Discrete spaces have no dtype.
            dtype = _dtype({"dtype": "int64", **plain})
            kind: dict[str, Any] = {} if dtype == np.int64 else {"dtype": dtype.type}
            return spaces.Discrete(plain["n"], start=plain["start"], **kind)
        case "MultiDiscrete":
            dtype = _dtype(plain)
            return spaces.MultiDiscrete(plain["nvec"], dtype=dtype.type, start=plain["start"])
        case "MultiBinary":
            return spaces.MultiBinary(plain["n"])
        case "Dict":
            parts = [(_key_text(key), _from_plain(part)) for key, part in plain["spaces"]]
            if len(dict(parts)) < len(parts):
                raise ValueError("two keys of a Dict are the same text")
            return spaces.Dict(parts)
        case other:
            raise ValueError(other)


def _key_text(key: Any) -> str:
    """Return a key of a Dict space as text. In old logs, keys may be numbers or lists."""
    if isinstance(key, list):
        key = tuple(key)
    return key if isinstance(key, str) else str(key)


def _dtype(plain: dict[str, Any]) -> np.dtype[Any]:
    """Return the dtype in a description of a space; refuse strings, which can have any length."""
    dtype: np.dtype[Any] = np.dtype(plain["dtype"])
    if dtype.kind not in "biuf":
        raise ValueError(f"dtype {dtype}")
    return dtype


def _elements(plain: dict[str, Any]) -> int:
    """Return the number of elements of a described space; 1 if the description has no shape."""
    if plain["type"] == "Dict":
        return sum(_elements(part) for _, part in plain["spaces"])
    if plain["type"] not in ("Box", "MultiBinary"):
        return 1
    shape = plain["shape"] if plain["type"] == "Box" else plain["n"]
    sizes = [int(size) for size in (shape if isinstance(shape, list) else [shape])]
    if min(sizes, default=1) < 0 or len(sizes) > _MAX_DIMENSIONS:
        raise ValueError(f"shape {sizes}")
    return math.prod(sizes)


def _numbers(bounds: NDArray[Any]) -> Any:
    """Return bounds for JSON. Equal bounds become one number, and infinities become strings."""
    # An image space has many bounds, but these are nearly always equal. No list is built for equal
    # bounds.
    if bounds.size and (bounds == bounds.flat[0]).all():
        return _number(bounds.flat[0].item())
    flat = [_number(value) for value in bounds.ravel().tolist()]
    return flat[0] if len(set(flat)) == 1 else flat


def _number(value: float) -> float | str:
    return value if math.isfinite(value) else str(value)


def _bounds(plain: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    flat = plain if isinstance(plain, list) else [plain]
    if dtype.kind in "iu":
        # NumPy before 2.0 wraps numbers outside of these limits.
        limits = np.iinfo(dtype)
        if min(flat) < limits.min or max(flat) > limits.max:
            raise ValueError(f"bounds outside of {dtype}")
    values = np.array([float(v) if isinstance(v, str) else v for v in flat], dtype)
    return values.reshape(shape) if len(flat) > 1 else np.broadcast_to(values[0], shape)
