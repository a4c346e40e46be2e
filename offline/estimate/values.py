"""Values, TD errors, entropy and actions of a policy at logged steps.

T is the number of steps of an episode, A the number of actions, B the number of observations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.actions import joint_actions
from mcaprl.base_policy import BasePolicy, batch_size
from mcaprl.chunks import planned
from mcaprl.errors import PolicyError
from mcaprl.files import read_json
from mcaprl.frames import mapped, rows_of, stacked_frames
from mcaprl.offline.algorithms.config import DQNConfig
from mcaprl.offline.algorithms.losses import q_learning_target
from mcaprl.recorder.dataset.transitions import Episode
from mcaprl.runs import CONFIG_NAME

Columns = dict[str, NDArray[Any]]
_ROWS_AT_ONCE = 4096


def value_columns(
    policy: BasePolicy, episode: Episode, action_space: spaces.Space[Any], gamma: float
) -> Columns:
    """Return the fields (T, ...) of `recorder.format.schema.values_schema` for an episode."""
    observations = policy_inputs(policy, episode)
    joint = joint_actions(action_space)
    if joint is None:
        return _of_commands(policy, observations, episode, action_space, gamma)
    taken = joint.indexes(episode.actions)
    if policy.chunk.length == 1:
        probabilities = policy.action_probabilities(observations)
    else:
        own = joint.indexes(_commands(policy, observations))
        probabilities = np.eye(joint.count, dtype=np.float32)[own]
    preference = probabilities
    best = probabilities[:-1].argmax(1)
    try:
        q = policy.q_values(observations)
    except PolicyError:
        q = np.full_like(probabilities, np.nan)
    else:
        # The probabilities of a greedy policy show only which action is the best.
        is_greedy = bool(((probabilities == 0) | (probabilities == 1)).all())
        preference = softmax(q) if is_greedy else probabilities
    value = q[:-1].max(1)
    return {
        "q": q[:-1],
        "preference": preference[:-1],
        "value": value,
        "advantage": q[np.arange(len(taken)), taken] - value,
        "td_error": td_errors(q, taken, episode.rewards, episode.terminated, gamma),
        "entropy": normalized_entropy(preference[:-1]),
        "policy_action": best + joint.first,
        "agrees": best == taken,
    }


def action_columns(
    actions: NDArray[Any], taken: NDArray[Any], action_space: spaces.Space[Any]
) -> Columns:
    """Return the fields (T, ...) of `recorder.format.schema.values_schema` of actions alone."""
    unknown = np.full(len(taken), np.nan, np.float32)
    joint = joint_actions(action_space)
    if joint is None:
        names = ("q", "value", "advantage", "td_error", "log_prob")
        return command_columns(actions, taken, action_space) | dict.fromkeys(names, unknown)
    if not joint.contain(actions).all():
        raise PolicyError(f"an action is not in {action_space}")
    own, logged = joint.indexes(actions.astype(np.int64)), joint.indexes(taken)
    return {
        **dict.fromkeys(("value", "advantage", "td_error"), unknown),
        "q": np.full((len(own), joint.count), np.nan, np.float32),
        "preference": np.eye(joint.count, dtype=np.float32)[own],
        "entropy": np.zeros(len(own), np.float32),
        "policy_action": own + joint.first,
        "agrees": own == logged,
    }


def _of_commands(
    policy: BasePolicy,
    observations: Any,
    episode: Episode,
    action_space: spaces.Space[Any],
    gamma: float,
) -> Columns:
    """Return the fields of a policy with Box actions, at observations (T + 1, ...)."""
    steps = len(episode)
    command = _commands(policy, observations)
    seen = rows_of(observations, slice(steps))
    try:
        q = policy.action_values(seen, episode.actions)
        value = policy.action_values(observations, command)
    except PolicyError:
        q, value = np.full(steps, np.nan), np.full(steps + 1, np.nan)
    try:
        log_prob = policy.log_prob(seen, episode.actions)
    except PolicyError:
        log_prob = np.full(steps, np.nan)
    ahead = np.where(episode.terminated, 0.0, gamma) * value[1:]
    return {
        **command_columns(command[:steps], episode.actions, action_space),
        "q": q,
        "value": value[:steps],
        "advantage": q - value[:steps],
        "td_error": episode.rewards + np.where(episode.terminated, 0.0, ahead) - q,
        "log_prob": log_prob,
    }


def _commands(policy: BasePolicy, observations: Any) -> NDArray[Any]:
    """Return the actions (T + 1, *shape) that a policy executes along an episode."""
    if policy.chunk.length == 1:
        return by_rows(policy.act, observations)
    return planned(policy.chunk, by_rows(policy.act_chunk, observations))


def command_columns(
    command: NDArray[Any], taken: NDArray[Any], action_space: spaces.Space[Any]
) -> Columns:
    """Return the fields that compare a policy's commands with others, both (T, *shape)."""
    difference = _flat(command) - _flat(taken)
    parts = np.square(difference / half_ranges(action_space, taken))
    distance = np.sqrt(parts.mean(1))
    return {"policy_action": _flat(command), "difference": difference, "distance": distance}


def half_ranges(space: spaces.Space[Any], actions: NDArray[Any]) -> NDArray[np.float64]:
    """Return half of each element's range (n,), the actions' where infinite, 1 without one."""
    assert isinstance(space, spaces.Box)
    rows = _flat(actions)
    low, high = (end.ravel().astype(np.float64) for end in (space.low, space.high))
    low = np.where(np.isfinite(low), low, rows.min(0))
    high = np.where(np.isfinite(high), high, rows.max(0))
    half = (high - low) / 2
    return np.where(half > 0, half, 1.0)


def _flat(actions: NDArray[Any]) -> NDArray[np.float64]:
    return np.asarray(actions, np.float64).reshape(len(actions), -1)


def policy_inputs(policy: BasePolicy, episode: Episode) -> Any:
    """Return observations (T + 1, ...) with the last one, or stacks (T + 1, k, ...) of them."""
    frames = mapped(
        lambda seen, following: np.concatenate([seen, following[-1:]]),
        episode.observations,
        episode.next_observations,
    )
    return stacked_frames(frames, policy.frame_stack)


def td_errors(
    q: NDArray[np.float32],
    actions: NDArray[np.int64],
    rewards: NDArray[np.float64],
    terminated: NDArray[np.bool_],
    gamma: float,
) -> NDArray[np.float32]:
    """Return the Q-learning errors (T,): r + gamma max_a Q(s', a) - Q(s, a_data)."""
    target = q_learning_target(
        torch.from_numpy(rewards.astype(np.float32)),
        torch.from_numpy(np.where(terminated, 0.0, gamma).astype(np.float32)),
        torch.from_numpy(q[1:]),
    )
    error: NDArray[np.float32] = target.numpy() - q[np.arange(len(actions)), actions]
    return error


def softmax(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the softmax of each row, which is the Boltzmann policy at temperature 1."""
    odds = np.exp(values - values.max(1, keepdims=True))
    return cast(NDArray[np.float32], odds / odds.sum(1, keepdims=True))


def normalized_entropy(probabilities: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the entropy (T,) of rows (T, A), scaled from 0 (deterministic) to 1 (uniform)."""
    actions = probabilities.shape[1]
    if actions == 1:
        return np.zeros(len(probabilities), np.float32)
    logs = np.log(probabilities, where=probabilities > 0, out=np.zeros_like(probabilities))
    entropy: NDArray[np.float32] = -(probabilities * logs).sum(1) / math.log(actions)
    return entropy


def by_rows(function: Callable[[Any], NDArray[Any]], observations: Any) -> NDArray[Any]:
    """Apply a function to slices of N observations, which bounds the memory for images."""
    starts = range(0, batch_size(observations), _ROWS_AT_ONCE)
    return np.concatenate(
        [function(rows_of(observations, slice(at, at + _ROWS_AT_ONCE))) for at in starts]
    )


def gamma_of_run(path: Path) -> float:
    """Return the discount of a run or of its seed folder; DQN's default if there is none."""
    for folder in (path, path.parent):
        if (folder / CONFIG_NAME).is_file():
            match read_json(folder / CONFIG_NAME, PolicyError, dict[str, Any]):
                case {"config": {"gamma": int(gamma) | float(gamma)}} if 0 <= gamma <= 1:
                    return float(gamma)
            break
    return DQNConfig().gamma
