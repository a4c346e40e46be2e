"""Stable-Baselines3's `.zip` files: written for plain SB3, read without executing code from them.

SB3 writes an algorithm as a zip file with the members `data` (JSON in which some values are
pickled), `policy.pth` (weights) and others. SB3's loader unpickles these values; this module reads
only the plain values and the weights. Files of this package also contain `mcaprl.json`, a full
description of the policy, which SB3 ignores. For files of plain SB3, the description is derived
from the names of the weights, and from the plain text that SB3 stores with each pickled space or
class. Dict observations are not supported in files of plain SB3.

`read_policy` wraps SB3's networks as those of a `mcaprl.offline.policy.Policy`.
"""

from __future__ import annotations

import io
import json
import math
import re
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import (
    ActorCriticCnnPolicy,
    ActorCriticPolicy,
    BasePolicy,
    MultiInputActorCriticPolicy,
)
from stable_baselines3.dqn.policies import CnnPolicy, DQNPolicy, MultiInputPolicy
from stable_baselines3.sac import policies as sac
from stable_baselines3.td3 import policies as td3
from torch import Tensor, nn

from mcaprl.actions import BoxActions, joint_actions
from mcaprl.architecture import Architecture, architecture_of
from mcaprl.errors import PolicyError, SpaceError, TrainingError
from mcaprl.files import as_type, check_regular, parse_json, write_atomically
from mcaprl.frames import (
    is_image,
    map_space,
    parts_of,
    parts_of_space,
    stack_axis,
    stacked_space,
    whole_of,
)
from mcaprl.networks import check_size
from mcaprl.offline.algorithms.heads import (
    BoxHead,
    Deterministic,
    Head,
    SquashedGaussian,
    build_head,
    known_sum,
    unsquashed,
)
from mcaprl.offline.algorithms.losses import squashed_normal_log_density
from mcaprl.offline.batches.observations import ObservationEncoder, Observations
from mcaprl.offline.policy import Policy
from mcaprl.online.features import NetworkDQNPolicy, channels_first, inputs_of, policy_arguments
from mcaprl.recorder.format.spaces import (
    check_actions,
    check_elements,
    observation_leaves,
    space_from_json,
    space_to_json,
)
from mcaprl.runs import BEST_NAME
from mcaprl.storage.tensor_files import below, check_finite, check_widths

FORMAT_VERSION = 1
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
_LEAST_IMAGE_FEATURES = 256
_POLICY_TYPES: Final[dict[str, tuple[type[BasePolicy], ...]]] = {
    "q-network": (DQNPolicy, CnnPolicy, MultiInputPolicy),
    "sac": (sac.SACPolicy, sac.CnnPolicy, sac.MultiInputPolicy),
    "td3": (td3.TD3Policy, td3.CnnPolicy, td3.MultiInputPolicy),
    "actor-critic": (ActorCriticPolicy, ActorCriticCnnPolicy, MultiInputActorCriticPolicy),
}
"""SB3's policy classes for vectors, images and dicts. Files with other classes are refused."""
_ACTIVATIONS: Final[dict[str, type[torch.nn.Module]]] = {
    "ReLU": torch.nn.ReLU,
    "Tanh": torch.nn.Tanh,
    "ELU": torch.nn.ELU,
    "LeakyReLU": torch.nn.LeakyReLU,
}
_KNOWN_KWARGS = {"net_arch", "activation_fn", "optimizer_kwargs", "optimizer_class", "use_sde"}


def write_model(path: Path, model: BaseAlgorithm, description: dict[str, Any]) -> None:
    """Save a model in a file that plain SB3 loads, and this package without unpickling."""
    content = io.BytesIO()
    model.save(content, exclude=_LEFT_OUT)
    with zipfile.ZipFile(content, "a") as archive:
        archive.writestr(OWN_NAME, json.dumps(description, indent=2))
    write_atomically(path, content.getvalue(), TrainingError)


def read_model(path: Path) -> tuple[dict[str, Any], dict[str, Any], dict[str, Tensor]]:
    """Read a file: description, SB3's data (pickled values stay pickled), and weights by name."""
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


def save_policy(path: Path, model: BaseAlgorithm, description: dict[str, Any]) -> None:
    """Save a model with its policy's description, so that it loads without unpickling."""
    kind = "tqc" if is_tqc(model.policy) else _kind_of(model.policy)
    own = {
        "format_version": FORMAT_VERSION,
        "network": kind,
        "activation": "Tanh" if kind == "actor-critic" else "ReLU",
        "steps": model.num_timesteps,
        **description,
    }
    write_model(path, model, own)


def is_tqc(network: BasePolicy) -> bool:
    """Return whether a policy is of sb3-contrib's TQC, whose actor is that of SAC."""
    return type(network).__module__.startswith("sb3_contrib.tqc")


def _kind_of(network: BasePolicy) -> str:
    """Return the key of `_POLICY_TYPES` of a policy of SB3."""
    if is_tqc(network):
        return "sac"
    return next(kind for kind, types in _POLICY_TYPES.items() if isinstance(network, types[0]))


def describe_run(
    algo: str,
    hidden: tuple[int, ...],
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    env_id: str,
    env_kwargs: dict[str, Any],
    frame_stack: int = 1,
    architecture: Architecture | None = None,
) -> dict[str, Any]:
    """Return a run's description as JSON types; `architecture` is None of a network of SB3."""
    own = {} if architecture is None else {"architecture": asdict(architecture)}
    return {
        **own,
        "algo": algo,
        "net_arch": list(hidden),
        "frame_stack": frame_stack,
        "observation_space": json.loads(space_to_json(observation_space)),
        "action_space": json.loads(space_to_json(action_space)),
        "env_id": env_id,
        "env_kwargs": env_kwargs,
    }


@dataclass(frozen=True)
class _Description:
    """Description of a policy that is needed to act."""

    algo: str
    network: str
    observation_space: Any
    action_space: Any
    net_arch: Any = None
    activation: str = ""
    architecture: dict[str, Any] | None = None
    frame_stack: int = 1
    env_id: str = ""
    env_kwargs: dict[str, Any] = field(default_factory=dict)


def read_policy(path: Path) -> Policy:
    """Read the policy in a `.zip` of this package or of plain SB3."""
    own, data, weights = read_model(path)
    try:
        if own and own.get("format_version") != FORMAT_VERSION:
            raise ValueError(f"format_version {own.get('format_version')} is not supported")
        found: _Description = as_type(_Description, own or describe_sb3(data, weights), OWN_NAME)
        return _build(path, found, weights, exact=bool(own))
    except (ValueError, TypeError, KeyError, RuntimeError, AssertionError, SpaceError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise PolicyError(f"cannot load the policy in {path}: {reason}") from error
    except PolicyError as error:
        raise PolicyError(f"cannot load the policy in {path}: {error}") from error


def _build(
    path: Path, description: _Description, weights: dict[str, Any], *, exact: bool
) -> Policy:
    observation_space = space_from_json(json.dumps(description.observation_space))
    action_space = space_from_json(json.dumps(description.action_space))
    frames = description.frame_stack
    check_finite(weights)
    check_actions(action_space)
    check_elements(frames * sum(leaf.size for leaf in observation_leaves(observation_space)))
    shape = channels_first(stacked_space(observation_space, frames))
    kind, found = description.network, description.architecture
    if found is not None:
        network = _own_network(kind, architecture_of(found), shape, action_space, weights)
    else:
        for widths in _layers(observation_space, frames, description.net_arch):
            check_widths(widths, weights)
        network = _policy_type("sac" if kind == "tqc" else kind, shape)(
            shape,
            action_space,
            lambda _: 0.0,
            net_arch=description.net_arch,
            activation_fn=_ACTIVATIONS[description.activation],
        )
    if kind == "tqc":
        # Its critics are another class's; policies act without them.
        cast(Any, network).actor.load_state_dict(below(weights, "actor"))
    else:
        network.load_state_dict(weights)
    folder = path.resolve().parent
    name = f"{folder.parent.name}/{folder.name}" if path.name == BEST_NAME else path.stem
    return _policy(network, description, name, exact=exact)


def policy_of(network: BasePolicy, description: dict[str, Any], name: str) -> Policy:
    """Return the greedy policy of a model in training, which shares the weights of `network`."""
    found: _Description = as_type(_Description, {"network": "", **description}, OWN_NAME)
    return _policy(network, found, name, exact=True)


def _policy(network: BasePolicy, description: _Description, name: str, *, exact: bool) -> Policy:
    """Wrap a network of SB3 as a policy; `exact` says whether the bounds of the space are known."""
    observation_space = space_from_json(json.dumps(description.observation_space))
    action_space = space_from_json(json.dumps(description.action_space))
    frames = description.frame_stack
    network.set_training_mode(False)
    box = BoxActions.of(action_space) if isinstance(action_space, spaces.Box) else None
    inner, name_of_network = _inner(network, box)
    networks = {name_of_network: ModelNetwork(inner, channels_last(observation_space), frames)}
    kind = _kind_of(network)
    head: Head
    if box is None:
        head = build_head(
            name_of_network if kind == "actor-critic" else "q_values", networks, action_space
        )
    else:
        head = _BOX_HEADS[kind](networks, box)
    return Policy(
        name=name,
        algo=description.algo,
        observation_space=observation_space if exact else None,
        action_space=action_space,
        env_id=description.env_id,
        env_kwargs=description.env_kwargs,
        frame_stack=frames,
        encoder=ModelEncoder(observation_space),
        head=head.eval(),
    )


def _own_network(
    kind: str,
    architecture: Architecture,
    space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    weights: dict[str, Any],
) -> BasePolicy:
    """Create an SB3 policy with this package's network, after checking the number of weights."""
    parts, (vectors, images) = parts_of_space(space), inputs_of(space)
    width = sum(int(np.prod(parts[key].shape)) for key in vectors)
    joint = joint_actions(action_space)
    outputs = math.prod(action_space.shape or ()) if joint is None else joint.count
    check_size(architecture, width, images, outputs, weights)
    policy_type: Any = {"q-network": NetworkDQNPolicy, "actor-critic": ActorCriticPolicy}[kind]
    network: BasePolicy = policy_type(
        space, action_space, lambda _: 0.0, **policy_arguments(architecture)
    )
    return network


def _layers(space: spaces.Space[Any], frames: int, net_arch: Any) -> Iterator[list[int]]:
    """Yield the widths of successive layers for each part of the observation."""
    chains = net_arch.values() if isinstance(net_arch, dict) else [net_arch or ()]
    for leaf in observation_leaves(space):
        if leaf.encoding is None:
            yield from ([leaf.size * frames, *chain] for chain in chains)
        else:
            # SB3's image extractors have at least this many output features.
            features = Architecture(()).features(leaf.shape)
            yield [max(features, 1), _LEAST_IMAGE_FEATURES]
            yield from (list(chain) for chain in chains)


def _policy_type(network: str, space: spaces.Space[Any]) -> type[BasePolicy]:
    vectors, images, dicts = _POLICY_TYPES[network]
    if isinstance(space, spaces.Dict):
        return dicts
    return images if is_image(space) else vectors


class ModelEncoder(ObservationEncoder):
    """Encoder for SB3's networks: no masks, normalized images, which may have channels first."""

    is_image = staticmethod(is_image)
    layout = ""

    def __init__(self, space: spaces.Space[Any]) -> None:
        """Create the encoder for a space of observations."""
        super().__init__(channels_last(space), 0, mask_key="")
        self.scale[:] = 1

    def arranged(self, observations: Any) -> Any:
        """Return observations with channels last."""
        images = {leaf.path: leaf.shape for leaf in self.images}
        return whole_of(
            {
                key: _moved(part, images.get((key,) if key else ()))
                for key, part in parts_of(observations).items()
            }
        )


class ModelNetwork(nn.Module):
    """Network of SB3 with `Observations` as input."""

    def __init__(self, network: nn.Module, space: spaces.Space[Any], frames: int) -> None:
        """Wrap a network for stacks of observations of a space with channels last."""
        super().__init__()
        self.network = network
        self._parts = parts_of_space(space)
        self._frames = frames

    def forward(self, observations: Observations) -> Tensor:
        """Map observations to values or logits (B, A)."""
        images = iter(observations.images)
        sizes = [box.shape for box in self._parts.values() if not is_image(box)]
        frames = torch.unflatten(observations.vector, 1, (self._frames, -1))
        vectors = iter(torch.split(frames, [int(np.prod(shape)) for shape in sizes], 2))
        inputs = {
            key: next(images).permute(0, 3, 1, 2).contiguous()
            if is_image(box)
            else torch.cat(torch.unflatten(next(vectors), 2, box.shape or (1,)).unbind(1), -1)
            for key, box in self._parts.items()
        }
        # A model in training may be on a GPU.
        device = next(self.network.parameters()).device
        moved = {key: part.to(device) for key, part in inputs.items()}
        return cast(Tensor, self.network(whole_of(moved))).cpu()


class ClampedGaussian(SquashedGaussian):
    """Squashed Gaussian of SB3's SAC: outputs (B, 2, n) are means and log deviations themselves."""

    @staticmethod
    def log_density(
        outputs: Tensor, actions: Tensor, log_std: Tensor | None = None, known: Tensor | None = None
    ) -> Tensor:
        """Return the log densities (B,) of actions (B, n) in [-1, 1]."""
        found = squashed_normal_log_density(unsquashed(actions), *outputs.unbind(1))
        return known_sum(found, known)


class ClippedGaussian(BoxHead):
    """Normal distributions of SB3's PPO and A2C, whose actions are clipped to the Box."""

    # Outputs (B, 2, n) are means and log deviations, for actions scaled to [-1, 1]. An action with
    # a number at a bound has a probability instead of a density: NaN.

    @staticmethod
    def output_shape(size: int) -> tuple[int, ...]:
        """Return the shape of the outputs for actions of n numbers."""
        return (2, size)

    @staticmethod
    def best(outputs: Tensor) -> Tensor:
        """Return the means (B, n), clipped."""
        return outputs[:, 0].clamp(-1, 1)

    @staticmethod
    def log_density(
        outputs: Tensor, actions: Tensor, log_std: Tensor | None = None, known: Tensor | None = None
    ) -> Tensor:
        """Return the log densities (B,) of actions (B, n) in [-1, 1]."""
        mean, log_std = outputs.unbind(1)
        normal: Any = torch.distributions.Normal(mean, log_std.exp())
        found = known_sum(normal.log_prob(actions), known)
        return found.masked_fill((actions.abs() >= 1).any(1), torch.nan)


_BOX_HEADS: Final[dict[str, type[BoxHead]]] = {
    "sac": ClampedGaussian,
    "td3": Deterministic,
    "actor-critic": ClippedGaussian,
}
"""Heads for the actions of a Box, by the key of `_POLICY_TYPES`."""


def _inner(network: BasePolicy, box: BoxActions | None) -> tuple[nn.Module, str]:
    """Return the part of a policy that computes the outputs of a head, and its name there."""
    policy: Any = network
    if isinstance(network, ActorCriticPolicy):
        return _Actor(network, box), "logits" if box is None else "actor"
    if isinstance(network, DQNPolicy):
        return policy.q_net, "q"
    return _BoxActor(policy.actor), "actor"


class _BoxActor(nn.Module):
    """Outputs of the actor of SAC, TQC or TD3."""

    def __init__(self, actor: Any) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, inputs: Any) -> Tensor:
        actor = self.actor
        if hasattr(actor, "get_action_dist_params"):
            return torch.stack(actor.get_action_dist_params(inputs)[:2], 1)
        features = actor.extract_features(inputs, actor.features_extractor)
        # The last layer is a tanh, which the head applies.
        return cast(Tensor, actor.mu[:-1](features))


class _Actor(nn.Module):
    """Logits of an actor-critic policy; for a Box, scaled means and log deviations."""

    def __init__(self, policy: BasePolicy, box: BoxActions | None) -> None:
        super().__init__()
        self.policy: Any = policy
        self._is_box = box is not None
        if box is not None:
            half = (box.high - box.low) / 2
            self.register_buffer("_center", torch.from_numpy(box.low + half), persistent=False)
            self.register_buffer("_half", torch.from_numpy(half), persistent=False)

    def forward(self, inputs: Any) -> Tensor:
        policy = self.policy
        features = BasePolicy.extract_features(policy, inputs, policy.pi_features_extractor)
        outputs: Tensor = policy.action_net(policy.mlp_extractor.forward_actor(features))
        if not self._is_box:
            return outputs
        center, half = cast(Tensor, self._center), cast(Tensor, self._half)
        mean = ((outputs - center) / half).float()
        log_std = (policy.log_std - half.log()).float().expand_as(mean)
        return torch.stack((mean, log_std), 1)


def channels_last(space: spaces.Space[Any]) -> spaces.Space[Any]:
    """Return a space in which the channels of images are last."""

    def last(box: spaces.Box) -> spaces.Space[Any]:
        if stack_axis(box) == -1:
            return box
        low, high = (np.moveaxis(end, -3, -1) for end in (box.low, box.high))
        return spaces.Box(low, high, dtype=cast(Any, box.dtype))

    return map_space(last, space)


def _moved(images: Any, shape: tuple[int, ...] | None) -> Any:
    """Return images (..., height, width, channels) of a shape, whose channels may be first."""
    if shape is None or np.shape(images)[-3:] != (shape[2], *shape[:2]):
        return images
    return images if np.shape(images)[-3:] == shape else np.moveaxis(images, -3, -1)


def _read(archive: zipfile.ZipFile, name: str, most: int) -> bytes:
    """Read a member of a zip file."""
    # A check of the declared size is sufficient, because `zipfile` reads at most this size.
    size = archive.getinfo(name).file_size
    if size > most:
        raise ValueError(
            f"'{name}' has {size} bytes, more than the maximum of {most} for a valid model"
        )
    return archive.read(name)


def _check_size(weights: io.BytesIO, most: int) -> None:
    """Check the declared sizes of the members of a PyTorch file, which is a zip file."""
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
    """Derive the description of a policy, as `save_policy` writes it, from plain SB3's file."""
    # Unknown bounds of observations are set to 0 and 255 for uint8, else to infinity.
    kwargs = data.get("policy_kwargs") or {}
    own = {key: value for key, value in kwargs.items() if not key.startswith(":")}
    unknown = sorted(set(own) - _KNOWN_KWARGS)
    if unknown:
        raise PolicyError(f"policy_kwargs {', '.join(unknown)} of the model are not supported")
    known = (
        kind for kind, first in _FIRST_WEIGHTS.items() if any(n.startswith(first) for n in weights)
    )
    kind = next(known, None)
    if kind is None:
        raise PolicyError("the model is not DQN, SAC, TQC, TD3, PPO or A2C")
    if kind == "sac" and "top_quantiles_to_drop_per_net" in data:
        kind = "tqc"
    default = "Tanh" if kind == "actor-critic" else "ReLU"
    return {
        "algo": "dqn" if kind == "q-network" else kind,
        "network": kind,
        "net_arch": own.get("net_arch"),
        "activation": _activation(own.get("activation_fn"), default),
        "observation_space": _box(data.get("observation_space")),
        "action_space": _actions(data.get("action_space")),
    }


_FIRST_WEIGHTS: Final = {
    "actor-critic": "action_net.",
    "q-network": "q_net.q_net.",
    "sac": "actor.log_std.",
    "td3": "actor.mu.",
}
"""Start of the names of weights that only models of a kind have; those of SAC before TD3's."""


def _activation(text: object, default: str) -> str:
    """Return the name of a class such as `<class 'torch.nn.modules.activation.ReLU'>`."""
    return default if text is None else str(text).rsplit(".", 1)[-1].rstrip("'>")


def _box(found: Any) -> dict[str, Any]:
    """Return the description of a Box as `space_from_json` reads it."""
    shape, dtype = _attributes(found, "observation", "box.Box", ("_shape", "dtype"))
    low, high = (0, 255) if dtype == "uint8" else ("-inf", "inf")
    return {"type": "Box", "low": low, "high": high, "shape": list(shape), "dtype": dtype}


def _actions(found: Any) -> dict[str, Any]:
    """Return the description of a space of actions as `space_from_json` reads it."""
    if not (isinstance(found, dict) and "box.Box'" in str(found.get(":type:"))):
        return _discrete(found)
    shape, dtype, *texts = _attributes(
        found, "action", "box.Box", ("_shape", "dtype", "low", "high")
    )
    low, high = ([float(number) for number in _NUMBER.findall(str(text))] for text in texts)
    if not len(low) == len(high) == math.prod(shape):
        raise PolicyError("the bounds of the model's action space are not stored as numbers")
    return {
        "type": "Box",
        "low": np.reshape(low, shape).tolist(),
        "high": np.reshape(high, shape).tolist(),
        "shape": list(shape),
        "dtype": dtype,
    }


_NUMBER: Final = re.compile(r"-?(?:inf|[0-9.]+(?:e[-+]?[0-9]+)?)")


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
