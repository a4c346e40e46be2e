"""What happens beside SB3's training loop: signs of life and checkpoints."""

from __future__ import annotations

from collections.abc import Callable

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
