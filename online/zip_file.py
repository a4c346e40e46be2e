"""Stable-Baselines3's `.zip` files: written for everybody, read without running code from them.

SB3 writes an algorithm as a zip of `data` (JSON in which some values are pickled), `policy.pth`
(weights) and more. Its own loader unpickles; here the plain values and the weights are read, and
nothing else. Files written here also hold `mcaprl.json`, which says all that a policy needs and
which SB3 passes over.
"""

from __future__ import annotations

import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import Tensor

from mcaprl.errors import PolicyError
from mcaprl.files import write_atomically
from mcaprl.online.centering import plain_weights

OWN_NAME = "mcaprl.json"
_DATA_NAME = "data"
_WEIGHTS_NAME = "policy.pth"
# SB3 makes these anew; saved, they would bind the file to this package's own classes.
_LEFT_OUT = (
    "replay_buffer_class",
    "replay_buffer_kwargs",
    "exploration_schedule",
    "_last_obs",
    "_last_original_obs",
)


def write_model(path: Path, model: BaseAlgorithm, description: dict[str, Any]) -> None:
    """Save a model so that plain SB3 can load it, and this package without unpickling.

    Args:
        path: of the file to replace.
        model: of SB3.
        description: JSON; what `read_model` is to find again.
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
        The description given to `write_model`, empty in files of plain SB3; SB3's own data, in
        which what is pickled stays so; and the weights by name.

    Raises:
        PolicyError: it is no such file, or broken.
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
        raise PolicyError(f"{path} is no model of Stable-Baselines3: {error.args[0]}") from error
    except (OSError, ValueError, RuntimeError, EOFError, zipfile.BadZipFile) as error:
        raise PolicyError(f"cannot read the model in {path}: {error}") from error
    except pickle.UnpicklingError as error:
        raise PolicyError(f"{path} has weights that are no plain tensors; not loaded") from error
    if not (isinstance(own, dict) and isinstance(data, dict) and isinstance(weights, dict)):
        raise PolicyError(f"{path} is no model of Stable-Baselines3: its parts are of other kinds")
    return own, data, weights
