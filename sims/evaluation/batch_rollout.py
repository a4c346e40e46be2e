"""Runs one policy through many episodes at once, in environments that are stepped together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from mcaprl.sims.evaluation.rollout import EpisodeResult, Policy


def batch_rollout(
    envs: gym.vector.VectorEnv[Any, Any, Any],
    policy: Policy,
    seeds: Sequence[int],
    on_episode: Callable[[EpisodeResult], None] | None = None,
) -> list[EpisodeResult]:
    """Run one greedy episode from each seed; the episodes are those of `rollout.run_episode`.

    Environments that are through with theirs go on with others, which are not looked at.

    Args:
        envs: as many as there are seeds, in autoreset mode `NextStep`.
        policy: that takes a batch of observations.
        seeds: of the episodes.
        on_episode: called after each episode, in the order of their ends.
    """
    assert envs.num_envs == len(seeds)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    # The base class is typed for one seed; all that step together take one for each.
    each: Any = list(seeds)
    observations, infos = envs.reset(seed=each)
    results: list[EpisodeResult | None] = [None] * len(seeds)
    running = np.ones(len(seeds), dtype=np.bool_)
    totals, length = np.zeros(len(seeds)), 0
    places = [_places(envs)]
    while running.any():
        actions = policy.act(observations)
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        totals[running] += rewards[running]
        length += 1
        places.append(_places(envs))
        for i in np.flatnonzero(running & (terminated | truncated)).tolist():
            reason = _reason(infos, i) or ("terminated" if terminated[i] else "time_limit")
            way = np.array([place[i] for place in places if place is not None])
            result = EpisodeResult(seeds[i], float(totals[i]), length, reason, way.reshape(-1, 2))
            results[i] = result
            if on_episode is not None:
                on_episode(result)
        running &= ~(terminated | truncated)
    return [result for result in results if result is not None]


def _places(envs: gym.vector.VectorEnv[Any, Any, Any]) -> NDArray[np.float64] | None:
    """(N, 2) x and y of all vehicles in the map, metres, where the sim tells them."""
    places = getattr(envs.unwrapped, "places", None)
    return None if places is None else places()


def _reason(infos: dict[str, Any], i: int) -> str:
    told = infos.get("reason")
    return str(told[i]) if told is not None and infos["_reason"][i] else ""
