"""Settings that every offline algorithm has."""

from __future__ import annotations

from dataclasses import dataclass

from mcaprl.settings import Settings


@dataclass(frozen=True)
class TrainingConfig(Settings):
    """Settings shared by all algorithms; each adds its own in a subclass.

    The defaults are those that learn lane keeping from 15,000 transitions in half a CPU minute.

    Raises:
        UsageError: a setting is outside its range.
    """

    updates: int = 8_000
    """gradient steps in all"""
    batch_size: int = 256
    """transitions in one gradient step, drawn with replacement"""
    learning_rate: float = 1e-3
    """Adam's step size at the first update"""
    final_learning_rate_fraction: float = 0.02
    """the learning rate falls linearly to this part of itself at the last update"""
    hidden: tuple[int, ...] = (256, 256)
    """widths of the hidden layers; for images, of those behind the convolutions"""
    log_interval: int = 100
    """updates between two rows of metrics"""
    checkpoint_interval: int = 1_000
    """updates between two checkpoints"""

    def __post_init__(self) -> None:
        """Refuse settings that cannot be meant."""
        for name in ("updates", "batch_size", "log_interval", "checkpoint_interval"):
            self._require(name, getattr(self, name) >= 1, "at least 1")
        self._require("learning_rate", self.learning_rate > 0, "above 0")
        fraction = self.final_learning_rate_fraction
        self._require("final_learning_rate_fraction", 0 <= fraction <= 1, "within [0, 1]")
        self._require("hidden", all(width >= 1 for width in self.hidden), "widths of at least 1")

    def learning_rate_at(self, step: int) -> float:
        """The step size of the update that follows `step` finished ones."""
        done = step / max(1, self.updates - 1)
        return self.learning_rate * (1 - (1 - self.final_learning_rate_fraction) * done)
