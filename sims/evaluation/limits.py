"""Limits on the steps of an episode, so that each episode ends.

An environment without a time limit may never end an episode, for example if a greedy policy walks
against a wall.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from functools import partial
from typing import Any, Final

import gymnasium as gym

from mcaprl.limits import STEP_LIMIT
from mcaprl.sims import make_sim, make_sims
from mcaprl.sims.evaluation.rollout import EpisodeResult

DEFAULT_MAX_STEPS: Final = 27_000
"""Limit in environments without a time limit: half an hour of an Atari game, as in ALE's papers."""


class StepLimit(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper that truncates episodes, with the reason `step_limit`.

    Attributes:
        max_steps: Steps after which an episode is truncated.
    """

    def __init__(self, env: gym.Env[Any, Any], max_steps: int) -> None:
        """Wrap `env`."""
        super().__init__(env)
        self.max_steps = max_steps
        self._step = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        self._step = 0
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment, and truncate the episode if it has reached the limit."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._step += 1
        if self._step >= self.max_steps and not (terminated or truncated):
            truncated, info = True, {**info, "reason": STEP_LIMIT}
        return observation, reward, terminated, truncated, info


class _Borrowed(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper of a caller's environment, which leaves it open."""

    def close(self) -> None:
        """Do nothing."""


def make_or_borrow(name: str | gym.Env[Any, Any], /, **kwargs: Any) -> gym.Env[Any, Any]:
    """Make a sim as `make_sim` does, or wrap an environment so that `close` leaves it open."""
    return make_sim(name, **kwargs) if isinstance(name, str) else _Borrowed(name)


def make_limited(
    name: str | gym.Env[Any, Any], max_steps: int | None, /, **kwargs: Any
) -> gym.Env[Any, Any]:
    """Make an environment whose episodes end.

    Args:
        name: As in `make_sim`, or an environment, which `close` leaves open.
        max_steps: Limit on the steps of an episode; None for `DEFAULT_MAX_STEPS` if the environment
            has no time limit, and otherwise for no other limit.
        **kwargs: As in `make_sim`.

    Raises:
        UnknownNameError, MissingExtraError, UsageError: As in `make_sim`.
    """
    env = make_or_borrow(name, **kwargs)
    if max_steps is None and not _has_time_limit(env):
        max_steps = DEFAULT_MAX_STEPS
    return env if max_steps is None else StepLimit(env, max_steps)


def make_limited_sims(
    name: str, num_envs: int, max_steps: int | None, /, **kwargs: Any
) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Make environments whose episodes end, which are stepped together; see `make_limited`.

    With another limit than that of the environment, they are stepped one after the other.

    Args:
        name: As in `make_sims`.
        num_envs: Number of environments.
        max_steps: As in `make_limited`.
        **kwargs: As in `make_sims`.

    Raises:
        UnknownNameError, MissingExtraError, UsageError: As in `make_sims`.
    """
    limit = max_steps or _default_of(name, kwargs)
    if limit is None:
        return make_sims(name, num_envs, **kwargs)
    return make_sims(name, num_envs, wrappers=[partial(StepLimit, max_steps=limit)], **kwargs)


def warn_of_cuts(results: Iterable[EpisodeResult], policy: str, sim: str) -> None:
    """Warn if episodes reached the limit on their steps.

    Args:
        results: Results of the episodes.
        policy: Name of the policy.
        sim: Name of the environment.
    """
    cut, count = [], 0
    for result in results:
        count += 1
        if result.reason == STEP_LIMIT:
            cut.append(result.length)
    if cut:
        warnings.warn(
            f"{policy}: {len(cut)} of {count} episodes in {sim} reached the limit of {max(cut)}"
            f" steps and were truncated ({STEP_LIMIT}); set another limit with --max-steps"
            " (max_steps in Python)",
            stacklevel=3,
        )


def _default_of(name: str, kwargs: dict[str, Any]) -> int | None:
    """Return the default limit of an environment; None if it has a time limit."""
    options = {key: value for key, value in kwargs.items() if key != "autoreset_mode"}
    env = make_limited(name, None, **options)
    env.close()
    return env.max_steps if isinstance(env, StepLimit) else None


def _has_time_limit(env: gym.Env[Any, Any]) -> bool:
    if env.spec is not None and env.spec.max_episode_steps is not None:
        return True
    while isinstance(env, gym.Wrapper):
        if isinstance(env, gym.wrappers.TimeLimit):
            return True
        env = env.env
    return False
