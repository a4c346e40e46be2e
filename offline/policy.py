"""Trained policies: saved as safetensors and JSON, loaded without running any code from a file.

`policy.json` says which network to build and what its outputs mean; `policy.safetensors` has its
weights.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from mcaprl.errors import PolicyError, SpaceError
from mcaprl.files import write_json
from mcaprl.offline.learner import Learner, Outputs
from mcaprl.offline.networks import build_network, discrete_actions, observation_tensor
from mcaprl.recorder.spaces import space_from_json, space_to_json
from mcaprl.tensor_files import write_tensors

FORMAT_VERSION = 1
_JSON_NAME = "policy.json"
_WEIGHTS_NAME = "policy.safetensors"
_BROKEN_FILE_ERRORS = (
    OSError,
    ValueError,
    TypeError,
    KeyError,
    RuntimeError,
    SafetensorError,
    SpaceError,
)


@dataclass(frozen=True, eq=False)
class Policy:
    """A trained policy; NumPy in, NumPy out. B is the number of observations, A of actions.

    Attributes:
        name: folder of the run and of the seed.
        algo: that trained it.
        observation_space: of one observation.
        action_space: of one action.
        env_id: of the environment whose log it learned from; empty if unknown.
        env_kwargs: arguments to make that environment.
        outputs: what the network's outputs mean.
        network: (B, *shape) observations to (B, A) outputs.
    """

    name: str
    algo: str
    observation_space: spaces.Space[Any]
    action_space: spaces.Discrete
    env_id: str
    env_kwargs: dict[str, Any]
    outputs: Outputs
    network: nn.Module

    def act(self, observations: NDArray[Any]) -> NDArray[np.int64]:
        """The best actions (B,), values of `action_space`; of equal ones the first.

        Raises:
            PolicyError: the observations have another shape than (B, *shape).
        """
        best: NDArray[np.int64] = self._forward(observations).argmax(1)
        return best + self.action_space.start

    def q_values(self, observations: NDArray[Any]) -> NDArray[np.float32]:
        """The values (B, A) of all actions, in the order of the action space.

        Raises:
            PolicyError: the policy has none, or the observations have another shape.
        """
        if self.outputs != "q_values":
            raise PolicyError(f"{self.name} ({self.algo}) has no Q-values, only probabilities")
        return self._forward(observations)

    def action_probabilities(self, observations: NDArray[Any]) -> NDArray[np.float32]:
        """The probabilities (B, A) of all actions.

        Those of behavior cloning estimate the policy in the log. A policy with Q-values is
        greedy: the action of `act` has 1.

        Raises:
            PolicyError: the observations have another shape.
        """
        outputs = self._forward(observations)
        if self.outputs == "logits":
            odds = np.exp(outputs - outputs.max(1, keepdims=True))
            return cast(NDArray[np.float32], odds / odds.sum(1, keepdims=True))
        probabilities = np.zeros_like(outputs)
        probabilities[np.arange(len(outputs)), outputs.argmax(1)] = 1.0
        return probabilities

    def _forward(self, observations: NDArray[Any]) -> NDArray[np.float32]:
        shape = self.observation_space.shape
        if observations.shape[1:] != shape or observations.ndim == 0:
            wanted = ", ".join(map(str, ("B", *(shape or ()))))
            got = observations.shape
            raise PolicyError(f"{self.name} takes observations ({wanted}), got {got}")
        with torch.inference_mode():
            outputs = self.network(observation_tensor(observations, self.observation_space))
        return cast(NDArray[np.float32], outputs.numpy())


def save_policy(folder: Path, learner: Learner, env_id: str, env_kwargs: dict[str, Any]) -> None:
    """Write the learner's present policy into a folder."""
    weights: dict[str, Tensor] = learner.network.state_dict()
    write_tensors(folder / _WEIGHTS_NAME, weights, {"updates": learner.step})
    description = {
        "format_version": FORMAT_VERSION,
        "algo": learner.name,
        "outputs": learner.outputs,
        "updates": learner.step,
        "hidden": list(learner.config.hidden),
        "env_id": env_id,
        "env_kwargs": env_kwargs,
        "observation_space": json.loads(space_to_json(learner.buffer.observation_space)),
        "action_space": json.loads(space_to_json(learner.buffer.action_space)),
    }
    write_json(folder / _JSON_NAME, description)


def load_policy(path: str | Path) -> Policy:
    """Load the policy of a run's first seed (`RUN`), or of one seed (`RUN/seed-2`).

    Raises:
        PolicyError: there is none, or its files are broken.
    """
    return _load_seed(_seed_folders(Path(path))[0])


def load_policies(path: str | Path) -> list[Policy]:
    """Load the policies of all seeds of a run, in their order.

    Raises:
        PolicyError: there are none, or a file is broken.
    """
    return [_load_seed(folder) for folder in _seed_folders(Path(path))]


def _seed_folders(path: Path) -> list[Path]:
    if (path / _JSON_NAME).exists():
        return [path]
    numbered = {
        int(number): folder
        for folder in path.glob("seed-*")
        if (number := folder.name.removeprefix("seed-")).isdigit()
    }
    if not numbered:
        raise PolicyError(f"{path} has no policy: neither {_JSON_NAME} nor a seed-K folder")
    return [numbered[number] for number in sorted(numbered)]


def _load_seed(folder: Path) -> Policy:
    try:
        description = json.loads((folder / _JSON_NAME).read_text())
        if description["format_version"] != FORMAT_VERSION:
            raise ValueError(f"format_version {description['format_version']} is not known")
        return _build(folder, description, load_file(folder / _WEIGHTS_NAME))
    except FileNotFoundError as error:
        raise PolicyError(
            f"{folder} has no policy: no {_JSON_NAME} and {_WEIGHTS_NAME}; "
            "training writes them with its first checkpoint"
        ) from error
    except _BROKEN_FILE_ERRORS as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise PolicyError(f"cannot load the policy in {folder}: {reason}") from error


def _build(folder: Path, description: dict[str, Any], weights: dict[str, Tensor]) -> Policy:
    if description["outputs"] not in ("q_values", "logits"):
        raise ValueError(f"outputs {description['outputs']!r} are not known")
    observation_space = space_from_json(json.dumps(description["observation_space"]))
    action_space = discrete_actions(space_from_json(json.dumps(description["action_space"])))
    hidden = tuple(description["hidden"])
    network = build_network(observation_space, int(action_space.n), hidden)
    network.load_state_dict(weights)
    return Policy(
        name=f"{folder.resolve().parent.name}/{folder.resolve().name}",
        algo=description["algo"],
        observation_space=observation_space,
        action_space=action_space,
        env_id=description["env_id"],
        env_kwargs=description["env_kwargs"],
        outputs=description["outputs"],
        network=network.eval(),
    )
