"""Warm start: a replay buffer filled from logs, and weights from a trained policy."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from mcaprl.errors import PolicyError, SpaceError, UsageError
from mcaprl.frames import joined, mapped, parts_of, parts_of_space, stacked_space, whole_of
from mcaprl.networks import Convolutions, Trunk
from mcaprl.offline.policy import Policy
from mcaprl.online.features import channels_first
from mcaprl.online.frame_buffer import FrameReplayBuffer
from mcaprl.recorder.dataset.dataset import Dataset

_CHECKED = 64
"""Number of observations on which the copied network must produce the same values."""


def fill_buffer(model: BaseAlgorithm, dataset: Dataset) -> int:
    """Copy logged transitions into the empty replay buffer of a model.

    The buffer has a column of successive steps for each environment. Therefore, the log is split
    into parts of equal length, one for each environment. An episode that continues beyond the end
    of a part counts as truncated at that end. If the log has more transitions than the buffer can
    store, only the last ones are copied.

    Returns:
        Number of copied transitions, a multiple of the number of environments.
    """
    buffer = model.replay_buffer if isinstance(model, DQN) else None
    if buffer is None:
        raise UsageError(f"{type(model).__name__} cannot learn from logs: it has no replay buffer")
    count = buffer.frame_stack if isinstance(buffer, FrameReplayBuffer) else 1
    space = stacked_space(channels_first(dataset.observation_space), count)
    _check_space("observation_space", space, model)
    _check_space("action_space", dataset.action_space, model)
    rows = min(len(dataset) // buffer.n_envs, buffer.buffer_size)
    if rows == 0:
        raise UsageError(f"{len(dataset)} transitions are too few for {buffer.n_envs} environments")
    last = np.arange(len(dataset) - rows * buffer.n_envs, len(dataset))
    for steps in last.reshape(buffer.n_envs, rows).T:
        _add(buffer, dataset, steps, cut=steps[-1] == last[-1])
    return rows * buffer.n_envs


def _add(buffer: Any, dataset: Dataset, steps: NDArray[np.int64], cut: bool) -> None:
    """Add the transitions `steps`, one from each part of the log, as one row of the buffer."""
    batch = dataset.batch(steps)
    timeouts = (batch.truncated | cut) & ~batch.terminated
    buffer.add(
        _channels_first(batch.observations, dataset.observation_space),
        _channels_first(batch.next_observations, dataset.observation_space),
        batch.actions,
        batch.rewards,
        batch.terminated | timeouts,
        [{"TimeLimit.truncated": bool(flag)} for flag in timeouts],
    )


def take_weights(model: BaseAlgorithm, policy: Policy, space: spaces.Space[Any]) -> None:
    """Copy the weights of a trained Q-network into a DQN, layer by layer."""
    if not isinstance(model, DQN):
        raise UsageError(f"{type(model).__name__} has no Q-values to copy from a policy")
    frames = policy.frame_stack
    if stacked_space(channels_first(space), frames) != model.observation_space:
        raise PolicyError(
            f"{policy.name} stacks {frames} observations, but the agent stacks another number: pass"
            f" `frame_stack={frames}`"
        )
    stacks = _sample_stacks(space, frames)
    expected = policy.q_values(stacks if frames > 1 else mapped(lambda part: part[:, 0], stacks))
    _copy_layers(policy, model.q_net)
    model.q_net_target.load_state_dict(model.q_net.state_dict())
    with torch.inference_mode():
        inputs = model.policy.obs_to_tensor(joined(stacks, space))[0]
        values = model.q_net(inputs).cpu().numpy()
    if not np.allclose(values, expected, rtol=1e-4, atol=1e-4):
        raise PolicyError(
            f"{policy.name} has a network of another architecture (for example, normalized inputs):"
            " the agent's network produces other values with the same weights"
        )


def _copy_layers(policy: Policy, ours: nn.Module) -> None:
    """Copy the weights of a policy's network, and its normalization, into an agent's network."""
    theirs = policy.head.networks["q"]
    if _weights_of(theirs) != _weights_of(ours):
        raise PolicyError(
            f"{policy.name} has layers {_chain(theirs)}, but the agent has {_chain(ours)}:"
            " pass `hidden=`, `encoder=`, `channels=`, `dueling=` or `layer_norm=`"
        )
    for source, target in zip(_layers(theirs), _layers(ours), strict=True):
        target.load_state_dict(source.state_dict())
    for source, target in zip(_convolutions(theirs), _convolutions(ours), strict=False):
        target.shift.copy_(source.shift)
        target.scale.copy_(source.scale)
    if policy.encoder.width:
        _fold_normalization(ours, policy.encoder, policy.frame_stack)


def _fold_normalization(network: nn.Module, encoder: Any, count: int) -> None:
    """Fold the normalization (x - shift) / scale of a vector into the layers that receive it.

    W ((x - shift) / scale) + b = V x + c with V = W / scale and c = b - V shift.
    """
    trunks = [module for module in network.modules() if isinstance(module, Trunk)]
    layer = _layers(trunks[0].stems[-1])[0] if trunks else _layers(network)[0]
    shift, scale = (torch.from_numpy(part).repeat(count) for part in (encoder.shift, encoder.scale))
    with torch.no_grad():
        layer.weight /= scale
        layer.bias -= layer.weight @ shift


def _sample_stacks(space: spaces.Space[Any], count: int) -> Any:
    """Sample stacks (B, count, *shape) of observations to compare networks."""
    space.seed(0)
    drawn = [parts_of(space.sample()) for _ in range(_CHECKED * count)]
    columns = {key: np.stack([one[key] for one in drawn]) for key in parts_of_space(space)}
    return whole_of({k: v.reshape(_CHECKED, count, *v.shape[1:]) for k, v in columns.items()})


def _check_space(role: str, space: spaces.Space[Any], model: BaseAlgorithm) -> None:
    own = getattr(model, role)
    if space != own:
        raise SpaceError(f"the logs have {role} {space}, but the environment has {own}")


def _channels_first(values: Any, space: spaces.Space[Any]) -> Any:
    """Transpose images (N, height, width, channels) for SB3; return other values unchanged."""
    is_last = {key: part != channels_first(part) for key, part in parts_of_space(space).items()}
    parts = parts_of(values)
    return whole_of({k: np.moveaxis(parts[k], -1, 1) if is_last[k] else parts[k] for k in is_last})


def _layers(network: nn.Module) -> list[Any]:
    """Return the layers with weights, from input to output."""
    kinds = nn.Linear | nn.Conv2d | nn.LayerNorm
    return [layer for layer in network.modules() if isinstance(layer, kinds)]


def _convolutions(network: nn.Module) -> list[Convolutions]:
    return [module for module in network.modules() if isinstance(module, Convolutions)]


def _weights_of(network: nn.Module) -> list[tuple[int, ...]]:
    return [tuple(layer.weight.shape) for layer in _layers(network)]


def _chain(network: nn.Module) -> str:
    """Format the widths of the layers from the input to the output.

    >>> _chain(nn.Sequential(nn.Linear(12, 256), nn.LayerNorm(256), nn.Linear(256, 6)))
    '12-256-norm-6'
    """
    widths = ["norm" if len(shape) == 1 else str(shape[0]) for shape in _weights_of(network)]
    return "-".join([str(_weights_of(network)[0][1]), *widths])
