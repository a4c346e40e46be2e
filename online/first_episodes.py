"""Keeps the episodes of an evaluation: the first one of each environment since the last reset."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.dataset.dataset import Dataset


class _Step(NamedTuple):
    """What one step did in the K environments whose first episode was still open."""

    environments: NDArray[np.int64]
    observations: Any
    actions: NDArray[Any]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    next_observations: Any


class FirstEpisodes(gym.vector.VectorWrapper[Any, Any, Any, Any, Any]):
    """Wraps environments that reset themselves in the step that ends an episode.

    An evaluation takes as many episodes as there are environments. While the longest one goes on,
    the others have begun anew; keeping those too would count short episodes too often.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any], env_id: str) -> None:
        """Wrap `env`; `env_id` is told in the log."""
        super().__init__(env)
        self._env_id = env_id
        self._open = np.ones(env.num_envs, dtype=np.bool_)
        self._steps: list[_Step] = []
        self._observations: Any = None

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Forget the episodes of before."""
        self._observations, infos = self.env.reset(seed=seed, options=options)
        self._open[:] = True
        self._steps = []
        return self._observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Keep what happens in environments that are still in their first episode."""
        result = self.env.step(actions)
        observations, rewards, terminated, truncated, infos = result
        numbers = np.flatnonzero(self._open)
        if len(numbers):
            following = _rows(observations, numbers)
            ended = terminated[numbers] | truncated[numbers]
            for row in np.flatnonzero(ended).tolist():
                _put_row(following, row, infos["final_obs"][numbers[row]])
            step = _Step(
                numbers,
                _rows(self._observations, numbers),
                np.asarray(actions)[numbers],
                rewards[numbers],
                terminated[numbers],
                truncated[numbers],
                following,
            )
            self._steps.append(step)
            self._open[numbers[ended]] = False
        self._observations = observations
        return result

    def dataset(self) -> Dataset:
        """The episodes in the order of their environments, taken by a greedy policy."""
        environments = np.concatenate([step.environments for step in self._steps])
        order = np.argsort(environments, kind="stable")
        columns = {
            name: _rows(_joined([getattr(step, name) for step in self._steps]), order)
            for name in _Step._fields[1:]
        }
        return Dataset.from_arrays(
            **columns,
            behavior_probs=np.ones(len(order)),
            env_id=self._env_id,
            observation_space=self.single_observation_space,
            action_space=self.single_action_space,
        )


def _rows(values: Any, numbers: NDArray[np.int64]) -> Any:
    """Some rows of an array, or of each array in a dict; a copy."""
    if isinstance(values, dict):
        return {key: _rows(part, numbers) for key, part in values.items()}
    return values[numbers]


def _put_row(values: Any, row: int, value: Any) -> None:
    if isinstance(values, dict):
        for key, part in values.items():
            _put_row(part, row, value[key])
    else:
        values[row] = value


def _joined(parts: Sequence[Any]) -> Any:
    if isinstance(parts[0], dict):
        return {key: _joined([part[key] for part in parts]) for key in parts[0]}
    return np.concatenate(parts)
