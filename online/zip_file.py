"""Stable-Baselines3's `.zip` files: written for plain SB3, read without executing code from them.

SB3 writes an algorithm as a zip of `data` (JSON in which some values are pickled), `policy.pth`
(weights) and more. Its own loader unpickles; this one reads only the plain values and the weights.
Files of this package also contain `mcaprl.json`, a full description of the policy, which SB3
ignores. In files of plain SB3, the text that SB3 writes beside its pickled spaces and classes and
the names of the weights replace that description, except for dict observations.
"""

from __future__ import annotations

import io
import json
import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import Tensor

from mcaprl.errors import PolicyError
from mcaprl.files import write_atomically
from mcaprl.online.centering import plain_weights
from mcaprl.recorder.format.spaces import space_to_json

OWN_NAME = "mcaprl.json"
_DATA_NAME = "data"
_WEIGHTS_NAME = "policy.pth"
# SB3 creates these again; stored, they would tie the file to this package's classes.
_LEFT_OUT = (
    "replay_buffer_class",
    "replay_buffer_kwargs",
    "exploration_schedule",
    "_last_obs",
    "_last_original_obs",
)
_KNOWN_KWARGS = {"net_arch", "activation_fn", "optimizer_kwargs", "optimizer_class", "use_sde"}


def write_model(path: Path, model: BaseAlgorithm, description: dict[str, Any]) -> None:
    """Save a model so that plain SB3 can load it, and this package without unpickling.

    Args:
        path: File to replace.
        model: Model of SB3.
        description: JSON object that `read_model` returns again.
    """
    content = io.BytesIO()
    with plain_weights(model.policy):
        model.save(content, exclude=_LEFT_OUT)
    with zipfile.ZipFile(content, "a") as archive:
        archive.writestr(OWN_NAME, json.dumps(description, indent=2))
    write_atomically(path, content.getvalue())


def read_model(path: Path) -> tuple[dict[str, Any], dict[str, Any], dict[str, Tensor]]:
    """Read a model's file.

    Returns:
        Description given to `write_model`, empty in files of plain SB3; SB3's own data, with
        pickled values left as they are; and the weights by name.

    Raises:
        PolicyError: The file is not a model of SB3, or is broken.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            own = json.loads(archive.read(OWN_NAME)) if OWN_NAME in names else {}
            data = json.loads(archive.read(_DATA_NAME))
            weights = torch.load(
                io.BytesIO(archive.read(_WEIGHTS_NAME)), map_location="cpu", weights_only=True
            )
    except FileNotFoundError as error:
        raise PolicyError(f"{path} does not exist") from error
    except KeyError as error:
        raise PolicyError(f"{path} is not a model of Stable-Baselines3: {error.args[0]}") from error
    except (OSError, ValueError, RuntimeError, EOFError, zipfile.BadZipFile) as error:
        raise PolicyError(f"cannot read the model in {path}: {error}") from error
    except pickle.UnpicklingError as error:
        raise PolicyError(f"{path} has weights that are not plain tensors; not loaded") from error
    if not (isinstance(own, dict) and isinstance(data, dict) and isinstance(weights, dict)):
        raise PolicyError(f"{path} is not a model of Stable-Baselines3: its parts have other types")
    return own, data, weights


def describe_sb3(data: Mapping[str, Any], weights: Mapping[str, Any]) -> dict[str, Any]:
    """Derive the description of a policy from a file of plain SB3.

    Args:
        data: SB3's own data, as `read_model` returns it.
        weights: Weights of the policy by name.

    Returns:
        Description as `save_policy` writes it; the bounds of observations are unknown and infinite.

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
        raise PolicyError("the model is none of DQN, PPO and A2C")
    return {
        "algo": "actor-critic" if critic else "dqn",
        "network": "actor-critic" if critic else "q-network",
        "net_arch": own.get("net_arch"),
        "activation": _activation(own.get("activation_fn"), "Tanh" if critic else "ReLU"),
        "observation_space": json.loads(space_to_json(_box(data.get("observation_space")))),
        "action_space": json.loads(space_to_json(_discrete(data.get("action_space")))),
    }


def _activation(text: object, default: str) -> str:
    """Return the name of a class such as `<class 'torch.nn.modules.activation.ReLU'>`."""
    return default if text is None else str(text).rsplit(".", 1)[-1].rstrip("'>")


def _box(found: Any) -> spaces.Box:
    shape, dtype = _attributes(found, "observation", "box.Box", ("_shape", "dtype"))
    if dtype == "uint8":
        return spaces.Box(0, 255, tuple(shape), np.uint8)
    return spaces.Box(-np.inf, np.inf, tuple(shape), np.dtype(dtype).type)


def _discrete(found: Any) -> spaces.Discrete:
    count, start = _attributes(found, "action", "discrete.Discrete", ("n", "start"))
    return spaces.Discrete(int(count), start=int(start))


def _attributes(found: Any, role: str, kind: str, names: tuple[str, ...]) -> list[Any]:
    if not isinstance(found, dict) or f"{kind}'" not in str(found.get(":type:")):
        raise PolicyError(f"the model's {role} space is not a {kind.split('.')[1]}")
    missing = [name for name in names if name not in found]
    if missing:
        raise PolicyError(f"the model's {role} space has no {missing[0]}")
    return [found[name] for name in names]
