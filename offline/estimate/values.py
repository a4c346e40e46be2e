"""Values, TD errors, entropy and actions of a policy at logged steps.

T is the number of steps of an episode, A the number of actions, B the number of observations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import PolicyError, UsageError
from mcaprl.files import read_json
from mcaprl.joint_actions import joint_actions
from mcaprl.offline.algorithms.config import DQNConfig
from mcaprl.offline.algorithms.losses import q_learning_target
from mcaprl.recorder.dataset.episode import Episode
from mcaprl.runs import CONFIG_NAME

Columns = dict[str, NDArray[Any]]
_ROWS_AT_ONCE = 4096


class ValuePolicy(Protocol):
    """A trained policy with discrete actions."""

    @property
    def name(self) -> str:
        """Name of the policy."""

    def q_values(self, observations: Any) -> NDArray[np.float32]:
        """Return the values (B, A); raise PolicyError if the policy has none."""

    def action_probabilities(self, observations: Any) -> NDArray[np.float32]:
        """Return the probabilities (B, A)."""


def value_columns(
    policy: ValuePolicy, episode: Episode, action_space: spaces.Space[Any], gamma: float
) -> Columns:
    """Return the fields (T, ...) of `recorder.format.schema.values_schema` for an episode.

    Args:
        policy: Policy to evaluate; if it has no Q-values, fields computed from them are NaN.
        episode: Episode of T steps.
        action_space: Action space of the log.
        gamma: Discount with which the policy was trained.

    Raises:
        UsageError: The action space is not finite.
        PolicyError: The observations do not fit the policy.
    """
    joint = joint_actions(action_space)
    if joint is None:
        raise UsageError(f"values need discrete actions, got {action_space}")
    observations = policy_inputs(policy, episode)
    taken = joint.indexes(episode.actions)
    preference = probabilities = policy.action_probabilities(observations)
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


def policy_inputs(policy: object, episode: Episode) -> Any:
    """Return an episode's observations (T + 1, ...), including the last next observation.

    For a policy with a frame stack of k > 1, they are stacks (T + 1, k, ...), oldest frame first.
    """
    frames = _with_last(episode.observations, episode.next_observations)
    return _stacked(frames, getattr(policy, "frame_stack", 1))


def td_errors(
    q: NDArray[np.float32],
    actions: NDArray[np.int64],
    rewards: NDArray[np.float64],
    terminated: NDArray[np.bool_],
    gamma: float,
) -> NDArray[np.float32]:
    """Return the Q-learning errors (T,): r + gamma max_a Q(s', a) - Q(s, a_data).

    Args:
        q: (T + 1, A) values at each observation, including the last next observation.
        actions: (T,) actions taken, counted from 0.
        rewards: (T,) rewards.
        terminated: (T,) whether the episode terminated at each step.
        gamma: Discount per step.
    """
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
    """Apply a function to N observations in slices of limited size, and join the results.

    The limit bounds the memory that networks need for images.
    """
    part = next(iter(observations.values())) if isinstance(observations, dict) else observations
    starts = range(0, len(part), _ROWS_AT_ONCE)
    return np.concatenate(
        [function(_rows(observations, start, start + _ROWS_AT_ONCE)) for start in starts]
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


def _rows(observations: Any, start: int, stop: int) -> Any:
    if isinstance(observations, dict):
        return {key: _rows(part, start, stop) for key, part in observations.items()}
    return observations[start:stop]


def _with_last(observations: Any, next_observations: Any) -> Any:
    """Return the observations of all steps, followed by the last next observation: (T + 1, ...)."""
    if isinstance(observations, dict):
        return {k: _with_last(observations[k], next_observations[k]) for k in observations}
    return np.concatenate([observations, next_observations[-1:]])


def _stacked(observations: Any, count: int) -> Any:
    """Return frame stacks (T + 1, count, ...), oldest frame first.

    If `count` is 1, no axis is added.
    """
    if count == 1:
        return observations
    if isinstance(observations, dict):
        return {key: _stacked(part, count) for key, part in observations.items()}
    rows = np.arange(len(observations))[:, None] - np.arange(count)[::-1]
    return observations[np.maximum(rows, 0)]
