"""Stable-Baselines3's `.zip` files: written for plain SB3, read without executing code from them.

SB3 writes an algorithm as a zip file with the members `data` (JSON in which some values are
pickled), `policy.pth` (weights) and others. SB3's loader unpickles these values; this module reads
only the plain values and the weights. Files of this package also contain `mcaprl.json`, a full
description of the policy, which SB3 ignores. For files of plain SB3, the description is derived
from the names of the weights, and from the plain text that SB3 stores with each pickled space or
class. Dict observations are not supported in files of plain SB3.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import Tensor

from mcaprl.errors import PolicyError, TrainingError
from mcaprl.files import check_regular, parse_json, write_atomically

OWN_NAME = "mcaprl.json"
_DATA_NAME = "data"
_MAX_JSON_BYTES = 2**24
_MAX_EXPANSION = 8
_WEIGHTS_NAME = "policy.pth"
# SB3 recreates these attributes when it loads a model. If they were stored, the file would
# depend on this package's classes.
_LEFT_OUT = (
    "replay_buffer_class",
    "replay_buffer_kwargs",
    "exploration_schedule",
    "_last_obs",
    "_last_original_obs",
)
_KNOWN_KWARGS = {"net_arch", "activation_fn", "optimizer_kwargs", "optimizer_class", "use_sde"}


def write_model(path: Path, model: BaseAlgorithm, description: dict[str, Any]) -> None:
    """Save a model in a file that plain SB3 loads, and that this package loads without unpickling.

    Args:
        path: File to replace.
        model: Model of SB3.
        description: JSON object that `read_model` returns.
    """
    content = io.BytesIO()
    model.save(content, exclude=_LEFT_OUT)
    with zipfile.ZipFile(content, "a") as archive:
        archive.writestr(OWN_NAME, json.dumps(description, indent=2))
    write_atomically(path, content.getvalue(), TrainingError)


def read_model(path: Path) -> tuple[dict[str, Any], dict[str, Any], dict[str, Tensor]]:
    """Read a model's file.

    Returns:
        The description given to `write_model` (empty for files of plain SB3); SB3's own data, whose
        pickled values are not unpickled; and the weights by name.

    Raises:
        PolicyError: The file is not a model of SB3, or is broken.
    """
    try:
        check_regular(path)
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            own = parse_json(_read(archive, OWN_NAME, _MAX_JSON_BYTES)) if OWN_NAME in names else {}
            data = parse_json(_read(archive, _DATA_NAME, _MAX_JSON_BYTES))
            most = _MAX_EXPANSION * path.stat().st_size
            weights_file = io.BytesIO(_read(archive, _WEIGHTS_NAME, most))
            _check_size(weights_file, most)
            weights = _load_weights(weights_file)
    except FileNotFoundError as error:
        raise PolicyError(f"{path} does not exist") from error
    except KeyError as error:
        raise PolicyError(f"{path} is not a model of Stable-Baselines3: {error.args[0]}") from error
    except (OSError, ValueError, RuntimeError, EOFError, zipfile.BadZipFile) as error:
        raise PolicyError(f"cannot read the model in {path}: {error}") from error
    except _NotWeightsError as error:
        raise PolicyError(f"cannot load {path}: its weights are not plain tensors") from error
    if not (isinstance(own, dict) and isinstance(data, dict) and _are_weights(weights)):
        raise PolicyError(f"{path} is not a model of Stable-Baselines3: its parts have wrong types")
    return own, data, weights


class _NotWeightsError(Exception):
    """The weights are not a file of plain tensors."""


def _load_weights(file: io.BytesIO) -> Any:
    try:
        return torch.load(file, map_location="cpu", weights_only=True)
    # PyTorch raises any exception for damaged files.
    except Exception as error:
        raise _NotWeightsError from error


def _read(archive: zipfile.ZipFile, name: str, most: int) -> bytes:
    """Read a member of a zip file.

    Raises:
        ValueError: The member has more than `most` bytes.
        KeyError: There is no such member.
    """
    # A check of the declared size is sufficient, because `zipfile` reads at most this size.
    size = archive.getinfo(name).file_size
    if size > most:
        raise ValueError(
            f"'{name}' has {size} bytes, more than the maximum of {most} for a valid model"
        )
    return archive.read(name)


def _check_size(weights: io.BytesIO, most: int) -> None:
    """Check the declared sizes of the members of a PyTorch file, which is a zip file.

    Raises:
        ValueError: The sum of these sizes is more than `most` bytes.
    """
    if zipfile.is_zipfile(weights):
        with zipfile.ZipFile(weights) as archive:
            size = sum(part.file_size for part in archive.infolist())
        if size > most:
            raise ValueError(
                f"its weights have {size} bytes, more than the maximum of {most} for a valid model"
            )
    weights.seek(0)


def _are_weights(found: object) -> bool:
    """Return whether an object is a dict of tensors, each with enough storage for its elements."""
    return isinstance(found, dict) and all(
        isinstance(tensor, Tensor)
        and tensor.numel() * tensor.element_size() <= tensor.untyped_storage().nbytes()
        for tensor in found.values()
    )


def describe_sb3(data: Mapping[str, Any], weights: Mapping[str, Any]) -> dict[str, Any]:
    """Derive the description of a policy from a file of plain SB3.

    Args:
        data: SB3's own data, as `read_model` returns it.
        weights: Weights of the policy by name.

    Returns:
        Description as `save_policy` writes it. The bounds of observations are unknown; they are set
        to 0 and 255 for uint8, else to infinity.

    Raises:
        PolicyError: The description cannot be derived without unpickling, or is not supported.
    """
    kwargs = data.get("policy_kwargs") or {}
    own = {key: value for key, value in kwargs.items() if not key.startswith(":")}
    unknown = sorted(set(own) - _KNOWN_KWARGS)
    if unknown:
        raise PolicyError(f"policy_kwargs {', '.join(unknown)} of the model are not supported")
    critic = any(name.startswith("action_net.") for name in weights)
    if not critic and not any(name.startswith("q_net.q_net.") for name in weights):
        raise PolicyError("the model is not DQN, PPO or A2C")
    return {
        "algo": "actor-critic" if critic else "dqn",
        "network": "actor-critic" if critic else "q-network",
        "net_arch": own.get("net_arch"),
        "activation": _activation(own.get("activation_fn"), "Tanh" if critic else "ReLU"),
        "observation_space": _box(data.get("observation_space")),
        "action_space": _discrete(data.get("action_space")),
    }


def _activation(text: object, default: str) -> str:
    """Return the name of a class such as `<class 'torch.nn.modules.activation.ReLU'>`."""
    return default if text is None else str(text).rsplit(".", 1)[-1].rstrip("'>")


def _box(found: Any) -> dict[str, Any]:
    """Return the description of a Box as `space_from_json` reads it."""
    shape, dtype = _attributes(found, "observation", "box.Box", ("_shape", "dtype"))
    low, high = (0, 255) if dtype == "uint8" else ("-inf", "inf")
    return {"type": "Box", "low": low, "high": high, "shape": list(shape), "dtype": dtype}


def _discrete(found: Any) -> dict[str, Any]:
    """Return the description of a Discrete as `space_from_json` reads it."""
    count, start = _attributes(found, "action", "discrete.Discrete", ("n", "start"))
    return {"type": "Discrete", "n": int(count), "start": int(start)}


def _attributes(found: Any, role: str, kind: str, names: tuple[str, ...]) -> list[Any]:
    if not isinstance(found, dict) or f"{kind}'" not in str(found.get(":type:")):
        raise PolicyError(f"the model's {role} space is not a {kind.split('.')[1]}")
    missing = [name for name in names if name not in found]
    if missing:
        raise PolicyError(f"the model's {role} space has no {missing[0]}")
    return [found[name] for name in names]
