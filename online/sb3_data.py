"""What a model's file of plain Stable-Baselines3 says of its policy outside of its pickles.

SB3 pickles spaces and classes, but writes their plain attributes beside the pickles, as text. Those
and the names of the weights are enough to build the policy again, save for dict observations.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from mcaprl.errors import PolicyError
from mcaprl.recorder.format.spaces import space_to_json

_KNOWN_KWARGS = {"net_arch", "activation_fn", "optimizer_kwargs", "optimizer_class", "use_sde"}


def description_of(data: Mapping[str, Any], weights: Mapping[str, Any]) -> dict[str, Any]:
    """The description that `read_model` would have found in a file of this package.

    Args:
        data: SB3's own, as `read_model` returns it.
        weights: of the policy, by name.

    Returns:
        As `policy.save_policy` writes it; bounds of observations are unknown and infinite.

    Raises:
        PolicyError: it cannot be told without unpickling, or is of no kind known here.
    """
    kwargs = data.get("policy_kwargs") or {}
    own = {key: value for key, value in kwargs.items() if not key.startswith(":")}
    unknown = sorted(set(own) - _KNOWN_KWARGS)
    if unknown:
        raise PolicyError(f"policy_kwargs {', '.join(unknown)} of the model are not known here")
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
    """The class's name in, say, `<class 'torch.nn.modules.activation.ReLU'>`."""
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
        raise PolicyError(f"the model's {role} space is no {kind.split('.')[1]}")
    missing = [name for name in names if name not in found]
    if missing:
        raise PolicyError(f"the model's {role} space has no {missing[0]}")
    return [found[name] for name in names]
