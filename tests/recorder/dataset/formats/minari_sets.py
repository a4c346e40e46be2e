"""Datasets that Minari's own collector writes, and an environment with Dict observations."""

from __future__ import annotations

import gc
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

import mcaprl

AUTHOR = {
    "author": "A. Author",
    "author_email": "a@example.org",
    "code_permalink": "https://example.org/code",
    "description": "Test data.",
}


class Cameras(gym.Env[dict[str, Any], np.ndarray[Any, Any]]):
    """Environment with two cameras and an arm.

    Episodes are terminated after five steps, or truncated after the number of steps in the option
    `limit`.
    """

    observation_space = spaces.Dict(
        {
            "arm": spaces.Dict(
                {
                    "joints": spaces.Box(-np.inf, np.inf, (2,), np.float32),
                    "grip": spaces.Discrete(3, start=-1),
                }
            ),
            "front": spaces.Box(0, 255, (32, 40, 3), np.uint8),
            "gray": spaces.Box(0, 255, (36, 33), np.uint8),
        }
    )
    action_space = spaces.MultiDiscrete([3, 2])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        self._step, self._limit = 0, int((options or {}).get("limit", 5))
        return self._observation(), self._info()

    def step(
        self, action: np.ndarray[Any, Any]
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self._step += 1
        terminated, truncated = self._step == 5, self._step == self._limit < 5
        return self._observation(), 0.1 * self._step, terminated, truncated, self._info()

    def _observation(self) -> dict[str, Any]:
        draw = self.np_random
        return {
            "arm": {
                "joints": draw.normal(size=2).astype(np.float32),
                "grip": np.int64(draw.integers(-1, 2)),
            },
            "front": draw.integers(0, 256, (32, 40, 3), np.uint8),
            "gray": draw.integers(0, 256, (36, 33), np.uint8),
        }

    def _info(self) -> dict[str, Any]:
        return {
            "battery": 1 - self._step / 8,
            "pose": {"xy": np.array([self._step, -self._step], np.float32)},
            "late": self._step > 2,
        }


def collect(
    env: gym.Env[Any, Any],
    dataset_id: str,
    *,
    log: Path | None = None,
    data_format: str = "hdf5",
    jpeg: bool = False,
    infos: bool = False,
    seeded: bool = True,
    options: Sequence[dict[str, Any] | None] = (None, {"limit": 3}, {"limit": 4, "task": "turn"}),
) -> Any:
    """Collect episodes with Minari, and record the same episodes as a log.

    The seeds are 3, 4, ...; if `seeded` is not set, Minari draws the seeds. The actions are random.

    Returns:
        The `MinariDataset`.
    """
    import minari

    recorded = env if log is None else mcaprl.RecordMcap(env, log, infos=infos)
    collector = minari.DataCollector(
        recorded, data_format=data_format, jpeg_encoding=jpeg, record_infos=infos
    )
    for seed, option in enumerate(options, 3):
        collector.reset(seed=seed if seeded else None, options=option)
        collector.action_space.seed(seed)
        is_over = False
        while not is_over:
            _, _, terminated, truncated, _ = collector.step(collector.action_space.sample())
            is_over = terminated or truncated
    if log is not None:
        recorded.close()
    with warnings.catch_warnings():
        # Minari warns about an environment that is not registered, and about temporary folders that
        # are removed by garbage collection.
        warnings.simplefilter("ignore")
        made = collector.create_dataset(dataset_id, algorithm_name="random", **AUTHOR)
        del collector
        gc.collect()
    return made
