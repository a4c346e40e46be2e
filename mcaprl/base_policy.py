"""What all policies have in common: scripted, random and trained ones, and a user's own."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Protocol, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.actions import JointActions, allowed_actions
from mcaprl.chunks import Chunks
from mcaprl.errors import PolicyError, UsageError


class Actor(Protocol):
    """Anything with the method of a policy that selects actions."""

    def act(self, observations: Any) -> Any:
        """Return actions (B, *shape) for observations (B, *shape) or nested dicts of them."""


class BasePolicy:
    """Policy for batches of B observations; a subclass has at least `act`.

    Attributes:
        name: Name in logs and tables.
        algo: Name of the training algorithm; empty for policies that were not trained.
        observation_space: Space of one observation; None if the policy accepts others.
        action_space: Space of one action; None if unknown.
        env_id: Gymnasium id of the environment in which the policy was trained; empty if unknown.
        env_kwargs: Arguments of that environment.
        frame_stack: Number of successive observations that determine an action.
        chunk: Length of the chunks of actions that the policy predicts, and their execution.
        action_commands: Commands of a robot that the actions stand for; None if unknown.
        mask_from: Source of the action mask; see `mcaprl.actions`.
        is_deterministic: Whether `act` has no randomness. If not, recordings of finite spaces have
            no `behavior_prob`; those of floats have a `behavior_log_prob` only then.
    """

    name: str = "policy"
    algo: str = ""
    observation_space: spaces.Space[Any] | None = None
    action_space: spaces.Space[Any] | None = None
    env_id: str = ""
    env_kwargs: Mapping[str, Any] = MappingProxyType({})
    frame_stack: int = 1
    chunk: Chunks = Chunks()
    action_commands: Any = None
    mask_from: str = ""
    is_deterministic: bool = True

    def begin(self) -> None:
        """Drop what the policy stores, at the start of an episode."""

    def interrupt(self) -> None:
        """Drop the actions that were predicted for the next steps; observations are kept."""

    def act_chunk(self, observations: Any) -> NDArray[Any]:
        """Return the chunks (B, H, *shape) of observations, whatever was executed before.

        H is `chunk.length`. Nothing is stored.
        """
        raise PolicyError(f"{self.name} predicts no chunks")

    def act(self, observations: Any) -> NDArray[Any]:
        """Return actions (B, *shape) for observations (B, *shape) or nested dicts of them."""
        raise NotImplementedError

    def log_prob(self, observations: Any, actions: NDArray[Any]) -> NDArray[np.floating[Any]]:
        """Return the log probabilities (B,) of actions (B, *shape); log densities in a Box.

        Raises:
            PolicyError: The policy has no probabilities, or the observations have another shape.
        """
        chances = self.action_probabilities(observations)
        numbers = JointActions.of(cast(Any, self.action_space)).indexes(actions)
        with np.errstate(divide="ignore"):
            found: NDArray[np.floating[Any]] = np.log(chances[np.arange(len(numbers)), numbers])
        return found

    def scores(self, observations: Any) -> NDArray[np.floating[Any]] | None:
        """Return scores (B, A), of which the largest selects the action; None without scores."""

    def q_values(self, observations: Any) -> NDArray[np.floating[Any]]:
        """Return the Q-values (B, A) of all actions.

        Raises:
            PolicyError: The policy has no Q-values, or the observations have another shape.
        """
        raise PolicyError(f"{self.name} has no Q-values")

    def action_values(self, observations: Any, actions: NDArray[Any]) -> NDArray[np.floating[Any]]:
        """Return the Q-values (B,) of actions (B, *shape).

        Raises:
            PolicyError: The policy has no Q-values, or the observations have another shape.
        """
        values = self.q_values(observations)
        numbers = JointActions.of(cast(Any, self.action_space)).indexes(actions)
        found: NDArray[np.floating[Any]] = values[np.arange(len(numbers)), numbers]
        return found

    def action_probabilities(self, observations: Any) -> NDArray[np.floating[Any]]:
        """Return the probabilities (B, A) of all actions: 0 or 1 if the policy is greedy.

        Raises:
            PolicyError: The policy has no probabilities, or the observations have another shape.
        """
        raise PolicyError(f"{self.name} has no action probabilities")


class RandomPolicy(BasePolicy):
    """Policy that takes each allowed action with the same probability."""

    name = "random"

    def __init__(self, action_space: spaces.Space[Any]) -> None:
        """Choose among the actions of a space."""
        self.action_space = action_space

    def act(self, observations: Any) -> NDArray[Any]:
        """Return random actions (B, *shape), drawn by the generator of the action space."""
        mask, space = allowed_actions(observations), self.action_space
        assert space is not None
        if mask is None:
            return np.stack([space.sample() for _ in range(batch_size(observations))])
        numbering = JointActions.of(space)
        draws = space.np_random.random(mask.shape) * mask
        return numbering.values(draws.argmax(1))

    def log_prob(self, observations: Any, actions: NDArray[Any]) -> NDArray[np.floating[Any]]:
        """Return the log probabilities (B,) of actions; for a bounded Box, its uniform density."""
        space = self.action_space
        if not isinstance(space, spaces.Box):
            return super().log_prob(observations, actions)
        if np.dtype(space.dtype).kind != "f" or not space.is_bounded():
            raise PolicyError(f"random actions of {space} have no density")
        sizes = space.high.astype(np.float64) - space.low
        with np.errstate(divide="ignore"):
            return np.full(len(actions), -np.log(sizes).sum())

    def action_probabilities(self, observations: Any) -> NDArray[np.float64]:
        """Return equal probabilities (B, A) of the allowed actions."""
        allowed = allowed_actions(observations)
        if allowed is None:
            count = JointActions.of(cast(Any, self.action_space)).count
            allowed = np.ones((batch_size(observations), count), bool)
        uniform: NDArray[np.float64] = allowed / allowed.sum(axis=1, keepdims=True)
        return uniform


class _ForeignPolicy(BasePolicy):
    """Policy with the members that another object has."""

    def __init__(self, policy: object, is_deterministic: bool) -> None:
        known = [name for name in dir(BasePolicy) if not name.startswith("_")]
        own = {name: getattr(policy, name) for name in known if hasattr(policy, name)}
        vars(self).update(
            {"name": type(policy).__name__, "is_deterministic": is_deterministic, **own}
        )


def as_policy(policy: object, *, is_deterministic: bool = True) -> BasePolicy:
    """Return an object with a method `act` as a policy.

    Args:
        policy: Policy, or object with some of its members.
        is_deterministic: Value of this attribute if the object has none.

    Raises:
        UsageError: The object has no such method.
    """
    if isinstance(policy, BasePolicy):
        return policy
    if not callable(getattr(policy, "act", None)):
        raise UsageError(
            f"{policy!r} is not a policy: pass a name, a path, or an object with a method"
            " act(observations) that returns a batch of actions"
        )
    return _ForeignPolicy(policy, is_deterministic)


def batch_size(observations: Any) -> int:
    """Return the number of observations in an array or in nested dicts of arrays."""
    while isinstance(observations, dict):
        observations = next(iter(observations.values()))
    return len(observations)
