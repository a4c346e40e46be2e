"""Base classes of the settings of offline algorithms."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mcaprl.networks import NetworkSettings
from mcaprl.offline.batches.buffer import Packing


@dataclass(frozen=True)
class TrainingConfig(NetworkSettings):
    """Settings of all offline algorithms; each algorithm adds its own in a subclass.

    With the defaults, training for lane keeping on 15,000 transitions takes half a minute on one
    CPU core.

    Raises:
        UsageError: A setting is outside its range.
    """

    updates: int = 8_000
    """number of gradient updates"""
    batch_size: int = 256
    """transitions in one gradient update, drawn with replacement"""
    final_learning_rate_fraction: float = 0.02
    weight_decay: float = 0.0
    """weight decay of AdamW"""
    normalize: bool = False
    """normalize the network's inputs to mean 0 and standard deviation 1 over the data"""
    held_out: float = 0.05
    """fraction of the episodes held out for validation"""
    log_interval: int = 100
    """updates between two rows of metrics"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require_positive("updates", "batch_size", "log_interval")
        self._require("weight_decay", self.weight_decay >= 0, "at least 0")
        self._require("held_out", 0 <= self.held_out < 1, "within [0, 1)")

    def learning_rate_at(self, step: int) -> float:
        """Return the learning rate after `step` finished updates."""
        done = step / max(1, self.updates - 1)
        return self.learning_rate * (1 - (1 - self.final_learning_rate_fraction) * done)

    @property
    def packing(self) -> Packing:
        """Settings for building transitions from the log."""
        return Packing(self.frame_stack, self.normalize, self.center_images)


@dataclass(frozen=True)
class BootstrapConfig(TrainingConfig):
    """Settings of algorithms whose targets bootstrap from values of next states."""

    gamma: float = 0.97
    """discount per step; 0.97 has an effective horizon of about 33 steps"""
    n_steps: int = 1
    """number of rewards in a target before the bootstrap value"""
    target_interval: int = 500
    """updates between two updates of the target network"""
    scale_rewards: bool = False
    """divide rewards by the standard deviation of the discounted returns of the log"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require_fraction("gamma")
        self._require_positive("n_steps", "target_interval")

    @property
    def packing(self) -> Packing:
        """Settings for building transitions from the log."""
        return replace(
            super().packing,
            gamma=self.gamma,
            n_steps=self.n_steps,
            scale_rewards=self.scale_rewards,
        )

    @property
    def horizon_fraction(self) -> float:
        """Fraction of an infinite-horizon return that values can represent after training.

        Values start near 0, and each update of the target network adds the rewards of n steps.
        After k updates, the value of a constant reward of 1 is (1 - gamma^(n k)) / (1 - gamma);
        the full return is 1 / (1 - gamma).
        """
        target_updates = max(self.updates / self.target_interval, 1)
        return float(1 - self.gamma ** (self.n_steps * target_updates))
