"""Environment with slow steps, whose episodes depend only on their seeds.

Importing this module registers the environment."""

from __future__ import annotations

import os
import time
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

SEEDED = "tests.ray.seeded:Seeded-v0"
STEP_S = 0.002


class Seeded(gym.Env[Any, Any]):
    """Environment with episodes of 5 to 34 steps, and random observations and rewards."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space: spaces.Space[Any] = spaces.Discrete(4)

    def __init__(self, pause_s: float = STEP_S, dies: bool = False, box: bool = False) -> None:
        self._pause_s, self._dies = pause_s, dies
        if box:
            self.action_space = spaces.Box(-3.0, 3.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._left = int(self.np_random.integers(5, 35))
        return self.np_random.normal(size=3).astype(np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        time.sleep(self._pause_s)
        if self._dies:
            os._exit(7)
        self._left -= 1
        observation = self.np_random.normal(size=3).astype(np.float32)
        reward = float(self.np_random.normal()) + 0.1 * float(np.sum(action))
        return observation, reward, self._left == 0, False, {}


if "Seeded-v0" not in gym.registry:
    gym.register("Seeded-v0", entry_point=f"{__name__}:Seeded")
