"""Runs a policy in an environment, one episode after the other, each from a seed of its own."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import PolicyError


class Policy(Protocol):
    """Whatever chooses actions: a scripted pilot, a trained network.

    One that remembers what it saw has a method `begin`, called where an episode begins.
    """

    @property
    def name(self) -> str:
        """What to call it in logs and tables."""

    def act(self, observations: Any) -> NDArray[Any]:
        """(B, *action shape) actions for observations of shape (B, *shape) or dicts of such."""


@dataclass(frozen=True)
class EpisodeResult:
    """How one episode went.

    Attributes:
        seed: that it was reset with.
        total_reward: undiscounted return.
        length: transitions.
        reason: why it ended; `interrupted` if the caller's budget of steps was used up.
        positions: (length + 1, 2) x and y in metres, where the environment tells them; else (0, 2).
    """

    seed: int
    total_reward: float
    length: int
    reason: str
    positions: NDArray[np.float64]


class EpsilonGreedy:
    """A policy's actions, now and then replaced by random ones; knows their probabilities."""

    def __init__(
        self, policy: Policy | None, epsilon: float, action_space: spaces.Space[Any]
    ) -> None:
        """Explore around `policy`.

        Args:
            policy: None acts at random.
            epsilon: probability of a random action, 0 to 1; 1 where there is no policy.
            action_space: to draw random actions from.
        """
        self.policy = policy
        self.epsilon = 1.0 if policy is None else epsilon
        self.name = "random" if policy is None else policy.name
        self._space = action_space
        self._count = int(action_space.n) if isinstance(action_space, spaces.Discrete) else 0
        self.begin(0)

    def begin(self, seed: int) -> None:
        """Make what follows depend on `seed` alone: an episode begins."""
        forget = getattr(self.policy, "begin", None)
        if forget is not None:
            forget()
        self._random = np.random.default_rng([seed, 1])
        self._space.seed(seed)

    def choose(self, observation: Any) -> tuple[Any, float]:
        """The action for one observation, and the probability with which it is chosen.

        The probability is epsilon/A, and 1 - epsilon more for the policy's own of A actions; NaN
        where actions are not discrete.
        """
        greedy = None if self.policy is None else self.policy.act(_batch(observation))[0]
        explores = self.epsilon > 0 and self._random.random() < self.epsilon
        if not self._count:
            return (self._space.sample() if explores else greedy), math.nan
        start = int(getattr(self._space, "start", 0))
        if explores or greedy is None:
            action = int(self._random.integers(self._count)) + start
        else:
            action = int(greedy)
        own = greedy is not None and action == int(greedy)
        return action, self.epsilon / self._count + (1 - self.epsilon) * own


def episode_seed(seed: int, episode: int) -> int:
    """The seed of an episode: as good as independent of all others', whoever runs it."""
    return int(np.random.SeedSequence([seed, episode]).generate_state(1)[0])


def run_episode(
    env: gym.Env[Any, Any],
    behavior: EpsilonGreedy,
    *,
    seed: int,
    max_steps: int | None = None,
    on_action: Callable[[float], None] | None = None,
) -> EpisodeResult:
    """Run one episode to its end.

    Args:
        env: to run in; it is reset here.
        behavior: chooses the actions.
        seed: for the environment and for the exploration.
        max_steps: break off after so many.
        on_action: called with each action's probability before it is taken.
    """
    observation, info = env.reset(seed=seed)
    behavior.begin(seed)
    telemetry = getattr(env.unwrapped, "telemetry", None)
    positions = [_position(telemetry)]
    total, length, reason = 0.0, 0, "interrupted"
    while max_steps is None or length < max_steps:
        action, probability = behavior.choose(observation)
        if on_action is not None:
            on_action(probability)
        observation, reward, terminated, truncated, info = env.step(action)
        positions.append(_position(telemetry))
        total += float(reward)
        length += 1
        if terminated or truncated:
            reason = str(info.get("reason") or ("terminated" if terminated else "time_limit"))
            break
    known = np.array([position for position in positions if position is not None])
    return EpisodeResult(seed, total, length, reason, known.reshape(-1, 2))


def rollout(
    env: gym.Env[Any, Any],
    behavior: EpsilonGreedy,
    *,
    seed: int,
    episodes: int | None = None,
    steps: int | None = None,
    first_episode: int = 0,
    on_action: Callable[[float], None] | None = None,
    on_episode: Callable[[EpisodeResult], None] | None = None,
) -> list[EpisodeResult]:
    """Run episodes until so many, or so many steps, are done.

    Args:
        env: to run in.
        behavior: chooses the actions.
        seed: episode k is reset with `episode_seed(seed, k)`.
        episodes: how many, or None to count steps.
        steps: how many in all; the last episode is broken off.
        first_episode: k of the first one.
        on_action: called with each action's probability before it is taken.
        on_episode: called after each episode.

    Raises:
        ValueError: neither or both of `episodes` and `steps` are given.
    """
    if (episodes is None) == (steps is None):
        raise ValueError("give either episodes or steps")
    results: list[EpisodeResult] = []
    done = 0
    while (episodes is not None and len(results) < episodes) or (
        steps is not None and done < steps
    ):
        result = run_episode(
            env,
            behavior,
            seed=episode_seed(seed, first_episode + len(results)),
            max_steps=None if steps is None else steps - done,
            on_action=on_action,
        )
        results.append(result)
        done += result.length
        if on_episode is not None:
            on_episode(result)
    return results


def check_fit(policy: Any, env: gym.Env[Any, Any]) -> None:
    """Make sure that a trained policy has the spaces of the environment it is to act in.

    Raises:
        PolicyError: it was trained on others.
    """
    for role in ("observation_space", "action_space"):
        trained, actual = getattr(policy, role, None), getattr(env, role)
        if trained is not None and trained != actual:
            name = env.spec.id if env.spec else "the environment"
            kind = getattr(policy, "env_kwargs", {}).get("observation")
            hint = f"; try --observation {kind}" if kind and role == "observation_space" else ""
            raise PolicyError(
                f"{policy.name} was trained on {role} {trained}; {name} has {actual}{hint}"
            )


def _batch(observation: Any) -> Any:
    if isinstance(observation, dict):
        return {key: _batch(part) for key, part in observation.items()}
    return np.asarray(observation)[None]


def _position(telemetry: Callable[[], dict[str, float]] | None) -> tuple[float, float] | None:
    values = telemetry() if telemetry is not None else {}
    return (values["x_m"], values["y_m"]) if "x_m" in values and "y_m" in values else None
