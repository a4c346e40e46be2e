"""Policies in `.zip` files of Stable-Baselines3, which are read without unpickling."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import (
    ActorCriticCnnPolicy,
    ActorCriticPolicy,
    BasePolicy,
    MultiInputActorCriticPolicy,
)
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.dqn.policies import CnnPolicy, DQNPolicy, MultiInputPolicy

from mcaprl.architecture import Architecture, architecture_of
from mcaprl.errors import PolicyError, SpaceError
from mcaprl.files import as_type
from mcaprl.networks import check_size
from mcaprl.online.features import NetworkDQNPolicy, inputs_of, policy_arguments
from mcaprl.online.frames import (
    FrameMemory,
    channels_first,
    joined,
    parts_of,
    parts_of_space,
    stacked_space,
)
from mcaprl.online.zip_file import OWN_NAME, describe_sb3, read_model, write_model
from mcaprl.recorder.format.spaces import (
    check_actions,
    check_elements,
    observation_leaves,
    space_from_json,
    space_to_json,
)
from mcaprl.runs import BEST_NAME
from mcaprl.storage.tensor_files import check_finite, check_widths

FORMAT_VERSION = 1
_LEAST_IMAGE_FEATURES = 256
_POLICY_TYPES: Final[dict[str, tuple[type[BasePolicy], ...]]] = {
    "q-network": (DQNPolicy, CnnPolicy, MultiInputPolicy),
    "actor-critic": (ActorCriticPolicy, ActorCriticCnnPolicy, MultiInputActorCriticPolicy),
}
"""SB3's policy classes for vectors, images and dicts. Files with other classes are refused."""
_ACTIVATIONS: Final[dict[str, type[torch.nn.Module]]] = {
    "ReLU": torch.nn.ReLU,
    "Tanh": torch.nn.Tanh,
    "ELU": torch.nn.ELU,
    "LeakyReLU": torch.nn.LeakyReLU,
}


@dataclass(frozen=True, eq=False)
class OnlinePolicy:
    """Trained policy with NumPy inputs and outputs, for B observations and A actions.

    Attributes:
        name: Name of the file or, for a policy in a run folder, RUN/seed-K.
        algo: Name of the algorithm that trained it.
        observation_space: Space of one observation; None if the file lacks its bounds.
        action_space: Space of one action.
        env_id: Gymnasium id of the training environment; empty if unknown.
        env_kwargs: Arguments of that environment.
        frame_stack: Number of successive observations that the network receives; see `act`.
        network: SB3's policy object.
    """

    name: str
    algo: str
    observation_space: spaces.Space[Any] | None
    action_space: spaces.Space[Any]
    env_id: str
    env_kwargs: dict[str, Any]
    frame_stack: int
    network: BasePolicy
    _memory: FrameMemory | None

    @property
    def action_commands(self) -> None:
        """None, because the actions of an environment are not commands of a robot."""

    def begin(self) -> None:
        """Drop the stored observations; the next observations start new episodes."""
        if self._memory is not None:
            self._memory.frames = {}

    def act(self, observations: Any) -> NDArray[np.int64]:
        """Return the best actions (B,) in `action_space`.

        A policy with `frame_stack` k > 1 stores the observations of the last k calls since
        `begin`.

        Raises:
            PolicyError: The observations do not fit the network.
        """
        return cast(NDArray[np.int64], self._tried(self._predicted, observations)[0])

    def q_values(self, observations: Any) -> NDArray[np.float32]:
        """Return the Q-values (B, A) of all actions, in the order of the action space.

        Args:
            observations: Observations (B, *shape). If `frame_stack` is k > 1, stacks
                (B, k, *shape) of successive observations, with the oldest first.

        Raises:
            PolicyError: The policy has no Q-values, or the observations do not fit the network.
        """
        if not isinstance(self.network, DQNPolicy):
            raise PolicyError(f"{self.name} ({self.algo}) has no Q-values, only probabilities")
        return cast(NDArray[np.float32], self._tried(self._outputs, observations))

    def action_probabilities(self, observations: Any) -> NDArray[np.float32]:
        """Return the probabilities (B, A) of all actions.

        With a Q-network, the best action has the probability 1 and all others have 0.

        Args:
            observations: Observations as for `q_values`.

        Raises:
            PolicyError: The observations do not fit the network.
        """
        outputs = self._tried(self._outputs, observations)
        if not isinstance(self.network, DQNPolicy):
            return cast(NDArray[np.float32], outputs)
        probabilities: NDArray[np.float32] = np.zeros_like(outputs)
        probabilities[np.arange(len(outputs)), outputs.argmax(1)] = 1.0
        return probabilities

    def _predicted(self, observations: Any) -> Any:
        """Return the network's actions; stack the observations with earlier ones if needed."""
        memory = self._memory
        if memory is not None:
            seen, now = (
                next(iter(p.values()), ()) for p in (memory.frames, parts_of(observations))
            )
            continues = len(seen) == len(now)
            observations = memory.see(observations) if continues else memory.begin(observations)
        return self.network.predict(observations, deterministic=True)

    def _outputs(self, observations: Any) -> NDArray[np.float32]:
        """Return the Q-values or probabilities of all actions."""
        if self._memory is not None:
            observations = joined(observations, self._memory.space)
        tensor = self.network.obs_to_tensor(observations)[0]
        with torch.inference_mode():
            if isinstance(self.network, DQNPolicy):
                outputs = self.network.q_net(cast(Any, tensor))
            else:
                assert isinstance(self.network, ActorCriticPolicy)
                outputs = cast(Any, self.network.get_distribution(tensor).distribution).probs
        return cast(NDArray[np.float32], outputs.numpy())

    def _tried(self, forward: Callable[..., Any], observations: Any) -> Any:
        try:
            return forward(observations)
        except (ValueError, RuntimeError, KeyError, AttributeError) as error:
            raise PolicyError(f"{self.name} does not accept these observations: {error}") from error


def save_policy(path: Path, model: BaseAlgorithm, description: dict[str, Any]) -> None:
    """Save a model with a description of its policy, so that it loads without unpickling.

    Args:
        path: `.zip` file to replace.
        model: Model of SB3.
        description: Description as `describe_run` returns it.
    """
    q_network = isinstance(model.policy, DQNPolicy)
    own = {
        "format_version": FORMAT_VERSION,
        "network": "q-network" if q_network else "actor-critic",
        "activation": "ReLU" if q_network else "Tanh",
        "steps": model.num_timesteps,
        **description,
    }
    write_model(path, model, own)


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
    """Return the description that all policies of a run share, as plain JSON types.

    `architecture` is None if the network is one of SB3's.
    """
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


def read_policy(path: Path) -> OnlinePolicy:
    """Read the policy in a `.zip` of this package or of plain SB3.

    Raises:
        PolicyError: There is no such file, or it is broken.
    """
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
) -> OnlinePolicy:
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
        network = _policy_type(kind, shape)(
            shape,
            action_space,
            lambda _: 0.0,
            net_arch=description.net_arch,
            activation_fn=_ACTIVATIONS[description.activation],
        )
    network.load_state_dict(weights)
    network.set_training_mode(False)
    folder = path.resolve().parent
    name = f"{folder.parent.name}/{folder.name}" if path.name == BEST_NAME else path.stem
    return OnlinePolicy(
        name=name,
        algo=description.algo,
        observation_space=observation_space if exact else None,
        action_space=action_space,
        env_id=description.env_id,
        env_kwargs=description.env_kwargs,
        frame_stack=frames,
        network=network,
        _memory=FrameMemory(observation_space, frames) if frames > 1 else None,
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
    check_size(architecture, width, images, int(cast(spaces.Discrete, action_space).n), weights)
    policy_type: Any = {"q-network": NetworkDQNPolicy, "actor-critic": ActorCriticPolicy}[kind]
    network: BasePolicy = policy_type(
        space, action_space, lambda _: 0.0, **policy_arguments(architecture)
    )
    return network


def _layers(space: spaces.Space[Any], frames: int, net_arch: Any) -> Iterator[list[int]]:
    """Yield the widths of successive layers for each part of the observation.

    Args:
        space: Space of one observation.
        frames: Number of successive observations that the network receives.
        net_arch: Widths of SB3's hidden layers: one list, a dict of lists, or None.
    """
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
    return images if is_image_space(space) else vectors
