"""`metadata.json` of Minari datasets, and their folder on this machine."""

from __future__ import annotations

import copy
import json
import os
import re
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from mcaprl.errors import LogError, SpaceError, UsageError
from mcaprl.files import parse_json, read_file
from mcaprl.recorder.dataset.formats.minari.spaces import (
    StoredSpace,
    space_from_text,
    space_to_text,
)
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import action_leaf, leaves_of

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
