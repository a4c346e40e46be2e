"""Settings that every offline algorithm has, and those of all that look ahead."""

from __future__ import annotations

from dataclasses import dataclass

from mcaprl.offline.algorithms.networks import Architecture
from mcaprl.offline.batches.buffer import Packing
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
    weight_decay: float = 0.0
    """part of each weight that a step of size 1 would take away (AdamW)"""
    hidden: tuple[int, ...] = (256, 256)
    """widths of the hidden layers; for images, of those behind the convolutions"""
    channels: tuple[int, ...] = (32, 64, 64)
    """of the three convolutions over pictures; half as many take less than half the time"""
    layer_norm: bool = False
    """normalise the hidden layers"""
    normalize: bool = False
    """shift and scale what the network sees to mean 0 and deviation 1 over the data"""
    frame_stack: int = 1
    """how many successive observations the network sees at once"""
    held_out: float = 0.05
    """part of the episodes that is not learned from, but watched"""
    log_interval: int = 100
    """updates between two rows of metrics"""
    checkpoint_interval: int = 1_000
    """updates between two checkpoints"""

    def __post_init__(self) -> None:
        """Refuse settings that cannot be meant."""
        for name in (
            "updates",
            "batch_size",
            "frame_stack",
            "log_interval",
            "checkpoint_interval",
        ):
            self._require(name, getattr(self, name) >= 1, "at least 1")
        self._require("learning_rate", self.learning_rate > 0, "above 0")
        fraction = self.final_learning_rate_fraction
        self._require("final_learning_rate_fraction", 0 <= fraction <= 1, "within [0, 1]")
        self._require("weight_decay", self.weight_decay >= 0, "at least 0")
        self._require("hidden", all(width >= 1 for width in self.hidden), "widths of at least 1")
        three = len(self.channels) == 3 and all(count >= 1 for count in self.channels)
        self._require("channels", three, "three numbers of at least 1")
        self._require("held_out", 0 <= self.held_out < 1, "within [0, 1)")

    def learning_rate_at(self, step: int) -> float:
        """The step size of the update that follows `step` finished ones."""
        done = step / max(1, self.updates - 1)
        return self.learning_rate * (1 - (1 - self.final_learning_rate_fraction) * done)

    @property
    def packing(self) -> Packing:
        """How transitions are made from the log."""
        return Packing(frame_stack=self.frame_stack, normalize=self.normalize)

    @property
    def architecture(self) -> Architecture:
        """What networks look like."""
        return Architecture(self.hidden, self.channels, self.layer_norm)


@dataclass(frozen=True)
class BootstrapConfig(TrainingConfig):
    """Settings of algorithms that learn from their own values of later states."""

    gamma: float = 0.97
    """discount of the reward one step later; 0.97 looks about 33 steps ahead"""
    n_steps: int = 1
    """rewards that are counted before the rest is estimated"""
    target_interval: int = 500
    """updates between two copies of the weights into the target network"""

    def __post_init__(self) -> None:
        """Refuse settings that cannot be meant."""
        super().__post_init__()
        self._require("gamma", 0 <= self.gamma <= 1, "within [0, 1]")
        self._require("n_steps", self.n_steps >= 1, "at least 1")
        self._require("target_interval", self.target_interval >= 1, "at least 1")

    @property
    def packing(self) -> Packing:
        """How transitions are made from the log."""
        return Packing(self.frame_stack, self.normalize, self.gamma, self.n_steps)

    @property
    def reach(self) -> float:
        """The part of an endless return that values can have learned of at the last update.

        Values start near 0, and each copy of the target adds the rewards of n steps: after k copies
        they can hold (1 - gamma^(n k)) / (1 - gamma) times a reward, of 1 / (1 - gamma).
        """
        copies = self.updates / self.target_interval
        return float(1 - self.gamma ** (self.n_steps * max(copies, 1)))
