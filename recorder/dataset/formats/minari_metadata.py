"""`metadata.json` of Minari datasets with their spaces, and their folder on this machine.

Minari does not store the dtype of a Discrete space. It is written in addition: Minari ignores it,
and `space_from_text` reads it.
"""

from __future__ import annotations

import copy
import json
import os
import re
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from mcaprl.errors import LogError, SpaceError, UsageError
from mcaprl.files import parse_json, read_file
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import Leaf, action_leaf, leaves_of, space_from_json

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


DATA, FILE, MAIN = "data", "metadata.json", "main_data.hdf5"
# Minari version in the metadata of written datasets: the oldest one that reads images without JPEG,
# because Minari refuses datasets of a version that is newer than its own.
_MINARI_VERSION = "0.5.4"
_ABOUT = (
    "author",
    "author_email",
    "code_permalink",
    "description",
    "requirements",
    "eval_env_spec",
    "ref_min_score",
    "ref_max_score",
    "num_episodes_average_score",
)
"""Fields of Minari's metadata that are copied to and from `LogMetadata.about`."""
_NAMESPACE_FILE = "namespace_metadata.json"
_ID = re.compile(r"(?:[-\w]+/)*[-\w]+-v\d+")


@dataclass(frozen=True)
class Description:
    """Description of a Minari dataset.

    Attributes:
        metadata: Metadata of the log.
        keys: Path of each leaf of the observation in the files; see `StoredSpace`.
        action_keys: Path of the action, or of each of its parts.
        form: `hdf5`, `arrow` or `parquet`.
        is_jpeg: Whether large images are stored as JPEG.
        episodes: Number of episodes.
        lost: One sentence for each part of the spaces that is left out or changed.
    """

    metadata: LogMetadata
    keys: tuple[tuple[str | int, ...], ...]
    action_keys: tuple[tuple[str | int, ...], ...]
    form: str
    is_jpeg: bool
    episodes: int
    lost: tuple[str, ...] = ()


def datasets_folder() -> Path:
    """Return the folder in which Minari looks for datasets."""
    return Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari/datasets")


def local_path(name: str) -> Path:
    """Return the folder of the local dataset with this id."""
    if not _ID.fullmatch(name):
        raise UsageError(
            f"'{name}' is not the id of a Minari dataset: expected a name that ends with its"
            " version, such as drive/lane-v0"
        )
    return datasets_folder() / name


def options_for(path: Path) -> dict[str, Any]:
    """Return the id of a new dataset at a path, and create the Minari namespaces of the id."""
    folder = datasets_folder().absolute()
    is_local = path.absolute().is_relative_to(folder)
    name = path.absolute().relative_to(folder).as_posix() if is_local else path.name
    if not _ID.fullmatch(name):
        raise UsageError(
            f"{path}: the name of a Minari dataset ends with its version, such as {path.name}-v0"
        )
    if is_local:
        for parent in list(path.absolute().relative_to(folder).parents)[:-1]:
            _add_namespace(folder / parent)
    return {"dataset_id": name}


def data_folder(path: Path) -> Path:
    """Return the folder with a dataset's `metadata.json`: the subfolder `data`, or `path`."""
    return path / DATA if (path / DATA / FILE).exists() else path


def raw_metadata(path: Path) -> dict[str, Any]:
    """Read `metadata.json` of a dataset."""
    file = data_folder(path) / FILE
    try:
        found = parse_json(read_file(file))
    except (OSError, ValueError) as error:
        raise LogError(f"{file} cannot be read: {error}") from error
    if not isinstance(found, dict) or not isinstance(found.get("total_episodes"), int):
        raise LogError(f"{file} does not describe a Minari dataset")
    return found


def read_description(path: Path, *, lossy: bool = False) -> Description:
    """Read the description of a dataset."""
    raw = raw_metadata(path)
    env_id, env_kwargs = _env_of(raw)
    try:
        observation, action = _spaces(raw, env_id, lossy=lossy)
        action_leaf(action.space)
        leaves_of(observation.space)
        metadata = LogMetadata(
            observation_space=observation.space,
            action_space=action.space,
            env_id=env_id,
            env_kwargs=env_kwargs,
            policy=str(raw.get("algorithm_name") or ""),
            versions={"minari": str(raw.get("minari_version", ""))},
            about={name: raw[name] for name in _ABOUT if raw.get(name) is not None},
        )
    except (SpaceError, LogError) as error:
        raise type(error)(f"{path}: {error}") from error
    return Description(
        metadata=metadata,
        keys=observation.keys,
        action_keys=action.keys,
        form=str(raw.get("data_format", "hdf5")),
        is_jpeg=bool(raw.get("jpeg_encoding", True)),
        episodes=raw["total_episodes"],
        lost=(*observation.lost, *action.lost),
    )


def description_text(
    metadata: LogMetadata, space: spaces.Space[Any], *, dataset_id: str, counts: dict[str, Any]
) -> str:
    """Return the content of `metadata.json`."""
    raw = {
        **counts,
        "data_format": "hdf5",
        "jpeg_encoding": False,
        "observation_space": space_to_text(space),
        "action_space": space_to_text(metadata.action_space),
        "dataset_id": dataset_id,
        "minari_version": _MINARI_VERSION,
        **{name: metadata.about[name] for name in _ABOUT if name in metadata.about},
    }
    if metadata.policy:
        raw["algorithm_name"] = metadata.policy
    spec = _env_spec(metadata)
    if spec is not None:
        raw["env_spec"] = spec
    return json.dumps(raw)


def _spaces(raw: dict[str, Any], env_id: str, *, lossy: bool) -> tuple[StoredSpace, StoredSpace]:
    texts = {role: raw.get(f"{role}_space") for role in ("observation", "action")}
    for role, text in texts.items():
        if text is None:
            # Datasets of old Minari versions contain no spaces: use the spaces of the environment.
            texts[role] = space_to_text(getattr(_registered(env_id), f"{role}_space"))
    observation, action = (space_from_text(str(texts[role]), role, lossy=lossy) for role in texts)
    return observation, action


def _registered(env_id: str) -> gym.Env[Any, Any]:
    if env_id not in gym.registry:
        raise SpaceError(
            f"{FILE} has no spaces, and its environment '{env_id}' is not registered: import the"
            " package that registers it"
        )
    try:
        with closing(gym.make(env_id)) as env:
            return env
    # An environment may raise errors of any type.
    except Exception as error:
        raise SpaceError(
            f"{FILE} describes no spaces, and '{env_id}' cannot be made: {error}"
        ) from error


def _env_of(raw: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the id and the keyword arguments of the environment; empty if they are unknown."""
    try:
        spec = parse_json(raw["env_spec"])
        kwargs = dict(spec.get("kwargs") or {})
        # `render_mode` is a choice of the recording, not a property of the environment.
        kwargs.pop("render_mode", None)
        return str(spec["id"]), kwargs
    except (KeyError, ValueError, TypeError, AttributeError):
        return "", {}


def _env_spec(metadata: LogMetadata) -> str | None:
    """Return the specification of the environment as JSON; None if it is unknown or malformed."""
    if not metadata.env_id:
        return None
    # The module in the id is not imported, because the data may come from an untrusted source.
    registered = gym.registry.get(metadata.env_id.rpartition(":")[2])
    try:
        spec = copy.deepcopy(registered) if registered else EnvSpec(metadata.env_id)
        spec.kwargs = {**spec.kwargs, **metadata.env_kwargs}
        return str(spec.to_json())
    # Gymnasium refuses malformed ids, and entry points that are not text.
    except (gym.error.Error, TypeError, ValueError):
        return None


def _add_namespace(folder: Path) -> None:
    file = folder / _NAMESPACE_FILE
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        file.write_text("{}")
