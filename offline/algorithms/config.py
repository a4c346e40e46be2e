"""Settings of the offline algorithms. Importing this module loads no torch."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

from mcaprl.architecture import Architecture, NetworkSettings
from mcaprl.entry_points import installed
from mcaprl.offline.batches.packing import Packing

ENTRY_POINT_GROUP: Final = "mcaprl.algorithms"
ALPHA_RANGE: Final = (1e-4, 100.0)
"""Range of CQL's alpha if it is learned."""


@dataclass(frozen=True)
class TrainingConfig(NetworkSettings):
    """Settings of all offline algorithms; each algorithm adds its own in a subclass.

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
    mask_from: str = ""
    """source of the flags of allowed actions: info:NAME, or a key of the observation"""

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
    """updates between two syncs of the target network"""
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


@dataclass(frozen=True)
class BCConfig(TrainingConfig):
    """Settings of behavior cloning, the same as those of `TrainingConfig`."""


@dataclass(frozen=True)
class DQNConfig(BootstrapConfig):
    """Settings of DQN."""

    dueling: bool = False
    """learn the value of a state separately from the advantages of its actions"""
    n_quantiles: int = 1
    """number of quantiles of the return, averaged to select actions; 1 learns only the mean"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("n_quantiles", self.n_quantiles >= 1, "at least 1")
        self._require("hidden", bool(self.hidden) or not self.dueling, "not empty if dueling")

    def architecture_for(self, channels: Iterable[int]) -> Architecture:
        """Return the architecture for images that have these numbers of channels in one frame."""
        return replace(super().architecture_for(channels), dueling=self.dueling)


@dataclass(frozen=True)
class DoubleDQNConfig(DQNConfig):
    """Settings of Double DQN, the same as those of DQN."""


@dataclass(frozen=True)
class BCQConfig(DQNConfig):
    """Settings of discrete BCQ: those of DQN, plus those of the behavior clone."""

    threshold: float = 0.3
    """minimum probability relative to the most likely action; 0 is Double DQN, 1 is cloning"""
    logits_penalty: float = 0.01
    """weight of the mean square of the clone's logits"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("threshold", 0 <= self.threshold <= 1, "within [0, 1]")
        self._require("logits_penalty", self.logits_penalty >= 0, "at least 0")


@dataclass(frozen=True)
class CQLConfig(DoubleDQNConfig):
    """Settings of CQL: those of Double DQN, plus alpha and its target."""

    alpha: float = 1.0
    """weight of the penalty on actions that are not in the data; 0 is Double DQN"""
    target_gap: float = 0.0
    """mean penalty to which alpha is tuned, starting at its setting; 0 leaves alpha fixed"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("alpha", self.alpha >= 0, "at least 0")
        self._require("target_gap", 0 <= self.target_gap < math.inf, "at least 0 and finite")
        low, high = ALPHA_RANGE
        startable = not self.target_gap or low <= self.alpha <= high
        self._require("alpha", startable, f"within [{low:g}, {high:g}] with a target gap")


@dataclass(frozen=True)
class IQLConfig(BootstrapConfig):
    """Settings of IQL."""

    target_interval: int = 50
    """updates between two syncs of the target networks"""
    expectile: float = 0.8
    """expectile of the action values that V estimates; 0.5 is the mean, near 1 the maximum"""
    beta: float = 0.5
    """inverse temperature of the advantage weights in cloning; 0 weights all actions equally"""
    normalize_advantages: bool = True
    """divide advantages by their root mean square in the batch, so that beta has no unit"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("expectile", 0 < self.expectile < 1, "within (0, 1)")
        self._require("beta", self.beta >= 0, "at least 0")


CONFIGS: Final[dict[str, type[TrainingConfig]]] = {
    "dqn": DQNConfig,
    "double-dqn": DoubleDQNConfig,
    "cql": CQLConfig,
    "bc": BCConfig,
    "bcq": BCQConfig,
    "iql": IQLConfig,
}
"""Settings of the built-in algorithms by name."""


def default_configs() -> dict[str, TrainingConfig]:
    """Return the default settings of the built-in algorithms and of those of installed packages.

    Raises:
        UsageError: An entry point is broken.
    """
    if not installed(ENTRY_POINT_GROUP):
        return {name: config_type() for name, config_type in CONFIGS.items()}
    from mcaprl.offline.algorithms.registry import all_algorithms  # This module imports torch.

    return {name: learner.config_type() for name, learner in all_algorithms().items()}
