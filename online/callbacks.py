"""What happens beside SB3's training loop: signs of life and checkpoints."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback


class EveryInterval(BaseCallback):
    """Calls a function each time that so many environment steps more are done, and at the end."""

    def __init__(self, interval: int, function: Callable[[], None]) -> None:
        """Call `function` each `interval` steps, whenever a step of all environments crosses it."""
        super().__init__()
        self._interval = interval
        self._function = function
        self._called_at = -1

    def _on_training_start(self) -> None:
        self._called_at = self.num_timesteps

    def _on_step(self) -> bool:
        if self.num_timesteps // self._interval > self._called_at // self._interval:
            self._call()
        return True

    def _on_training_end(self) -> None:
        if self.num_timesteps > self._called_at:
            self._call()

    def _call(self) -> None:
        self._called_at = self.num_timesteps
        self._function()


class CopyTargetByEpisodes(BaseCallback):
    """Copies a DQN's weights into its target network after so many episodes."""

    def __init__(self, episodes: int) -> None:
        """Copy after each `episodes` finished ones."""
        super().__init__()
        self._episodes = episodes
        self._finished = 0

    def _on_step(self) -> bool:
        before = self._finished
        self._finished += int(np.sum(self.locals["dones"]))
        if self._finished // self._episodes > before // self._episodes:
            model = cast(DQN, self.model)
            model.q_net_target.load_state_dict(model.q_net.state_dict())
        return True


class BetweenRollouts(BaseCallback):
    """Calls a function between two rollouts, when every step is stored and learnt from."""

    def __init__(self, interval: int, function: Callable[[], None]) -> None:
        """Call `function` when `interval` steps or more have passed since the last call."""
        super().__init__()
        self._interval = interval
        self._function = function
        self._called_at = 0

    def _on_training_start(self) -> None:
        self._called_at = self.num_timesteps

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps - self._called_at >= self._interval:
            self._called_at = self.model.num_timesteps
            self._function()

    def _on_step(self) -> bool:
        return True
