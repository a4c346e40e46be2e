"""Settings of the online algorithms. What is not said otherwise is Stable-Baselines3's default."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

from mcaprl.settings import Settings


@dataclass(frozen=True)
class OnlineConfig(Settings):
    """Settings shared by all algorithms; each adds its own in a subclass.

    Raises:
        UsageError: a setting is outside its range.
    """

    steps: int = 100_000
    """environment steps in all, over all environments together"""
    envs: int = 8
    """environments that are stepped at once, in this process"""
    learning_rate: float = 1e-4
    """Adam's step size at the first update"""
    final_learning_rate_fraction: float = 1.0
    """the learning rate falls linearly to this part of itself at the last step"""
    gamma: float = 0.99
    """discount of the reward one step later"""
    hidden: tuple[int, ...] = (64, 64)
    """widths of the hidden layers; for images, of those behind the convolutions"""
    frame_stack: int = 1
    """how many successive observations the network sees at once"""
    center_images: bool = False
    """pictures reach the first convolution as -2 to 2, not as 0 to 1"""
    max_grad_norm: float = 10.0
    """longer gradients are scaled down to this length"""
    eval_interval: int = 5_000
    """environment steps between two evaluations"""
    eval_episodes: int = 30
    """episodes of one evaluation, on an environment of its own; always the same ones"""
    checkpoint_interval: int = 20_000
    """environment steps between two checkpoints to resume from"""
    final_episodes: int = 100
    """episodes that score the best checkpoint at the end, none of which it was chosen by"""

    def __post_init__(self) -> None:
        """Refuse settings that cannot be meant."""
        counts = ("steps", "envs", "frame_stack", "eval_interval", "eval_episodes")
        for name in (*counts, "checkpoint_interval"):
            self._require(name, getattr(self, name) >= 1, "at least 1")
        for name in ("learning_rate", "max_grad_norm"):
            self._require(name, getattr(self, name) > 0, "above 0")
        for name in ("final_learning_rate_fraction", "gamma"):
            self._require(name, 0 <= getattr(self, name) <= 1, "within [0, 1]")
        self._require("hidden", all(width >= 1 for width in self.hidden), "widths of at least 1")

    def arguments(self) -> dict[str, Any]:
        """The same for the constructor of SB3's algorithm, all but learning rate and networks."""
        return {"gamma": self.gamma, "max_grad_norm": self.max_grad_norm}


@dataclass(frozen=True)
class DQNConfig(OnlineConfig):
    """Settings of DQN."""

    batch_size: int = 32
    """transitions in one gradient step"""
    buffer_size: int = 1_000_000
    """transitions that the replay buffer holds; never more than there are steps"""
    learning_starts: int = 100
    """random steps before the first gradient step"""
    steps_per_update: int = 4
    """environment steps for each gradient step"""
    target_update_interval: int = 10_000
    """environment steps between two copies of the weights into the target network"""
    target_update_episodes: int = 0
    """episodes between two copies, in place of steps; 0 counts steps"""
    n_steps: int = 1
    """rewards that are summed up before the target network's value of what follows"""
    exploration_fraction: float = 0.1
    """part of the training in which the probability of a random action falls to its last value"""
    exploration_initial_eps: float = 1.0
    """probability of a random action at first"""
    exploration_final_eps: float = 0.05
    """probability of a random action at last"""
    exploration_decay: float = 0.0
    """factor on that probability at each step, in place of the linear fall; 0 has none"""

    def __post_init__(self) -> None:
        """Refuse settings that cannot be meant."""
        super().__post_init__()
        for name in ("batch_size", "steps_per_update", "target_update_interval", "n_steps"):
            self._require(name, getattr(self, name) >= 1, "at least 1")
        self._require("buffer_size", self.buffer_size >= self.envs, "at least one row an env")
        self._require("learning_starts", self.learning_starts >= 0, "at least 0")
        self._require("target_update_episodes", self.target_update_episodes >= 0, "at least 0")
        for name in ("fraction", "initial_eps", "final_eps", "decay"):
            value = getattr(self, f"exploration_{name}")
            self._require(f"exploration_{name}", 0 <= value <= 1, "within [0, 1]")
        even = max(self.steps_per_update, self.envs) % min(self.steps_per_update, self.envs) == 0
        self._require("steps_per_update", even, f"a multiple or a divisor of envs ({self.envs})")

    def arguments(self) -> dict[str, Any]:
        """The same for the constructor of SB3's algorithm, all but learning rate and networks."""
        same = (
            "batch_size",
            "learning_starts",
            "target_update_interval",
            "n_steps",
            "exploration_fraction",
            "exploration_initial_eps",
            "exploration_final_eps",
        )
        return {
            **super().arguments(),
            **{name: getattr(self, name) for name in same},
            # Steps that never come: episodes are counted instead.
            **({"target_update_interval": sys.maxsize} if self.target_update_episodes else {}),
            "buffer_size": min(self.buffer_size, self.steps + self.envs),
            # SB3 counts calls of `step`, each of which is a step of every environment.
            "train_freq": max(1, self.steps_per_update // self.envs),
            "gradient_steps": max(1, self.envs // self.steps_per_update),
        }


@dataclass(frozen=True)
class DoubleDQNConfig(DQNConfig):
    """Settings of Double DQN: those of DQN."""


@dataclass(frozen=True)
class PPOConfig(OnlineConfig):
    """Settings of PPO."""

    learning_rate: float = 3e-4
    max_grad_norm: float = 0.5
    rollout_steps: int = 2_048
    """environment steps, over all environments, between two rounds of updates"""
    batch_size: int = 64
    """transitions in one gradient step"""
    epochs: int = 10
    """passes over each rollout"""
    gae_lambda: float = 0.95
    """between 0, advantages from one step, and 1, from whole returns"""
    clip_range: float = 0.2
    """how far the probability of an action may move in one round"""
    entropy_coefficient: float = 0.0
    """weight of the policy's entropy in the loss"""

    def __post_init__(self) -> None:
        """Refuse settings that cannot be meant."""
        super().__post_init__()
        for name in ("batch_size", "epochs"):
            self._require(name, getattr(self, name) >= 1, "at least 1")
        whole = self.rollout_steps >= 2 * self.envs and self.rollout_steps % self.envs == 0
        self._require("rollout_steps", whole, f"a multiple of envs ({self.envs}), and twice it")
        fits = self.rollout_steps % self.batch_size == 0
        self._require("batch_size", fits, f"a divisor of rollout_steps ({self.rollout_steps})")

    def arguments(self) -> dict[str, Any]:
        """The same for the constructor of SB3's algorithm, all but learning rate and networks."""
        return {
            **super().arguments(),
            "n_steps": self.rollout_steps // self.envs,
            "batch_size": self.batch_size,
            "n_epochs": self.epochs,
            "gae_lambda": self.gae_lambda,
            "clip_range": self.clip_range,
            "ent_coef": self.entropy_coefficient,
        }


@dataclass(frozen=True)
class A2CConfig(OnlineConfig):
    """Settings of A2C, with RMSProp as its authors had it."""

    learning_rate: float = 7e-4
    max_grad_norm: float = 0.5
    rollout_steps: int = 40
    """environment steps, over all environments, for each gradient step"""
    gae_lambda: float = 1.0
    """between 0, advantages from one step, and 1, from whole returns"""
    entropy_coefficient: float = 0.0
    """weight of the policy's entropy in the loss"""

    def __post_init__(self) -> None:
        """Refuse settings that cannot be meant."""
        super().__post_init__()
        whole = self.rollout_steps >= self.envs and self.rollout_steps % self.envs == 0
        self._require("rollout_steps", whole, f"a multiple of envs ({self.envs})")

    def arguments(self) -> dict[str, Any]:
        """The same for the constructor of SB3's algorithm, all but learning rate and networks."""
        return {
            **super().arguments(),
            "n_steps": self.rollout_steps // self.envs,
            "gae_lambda": self.gae_lambda,
            "ent_coef": self.entropy_coefficient,
        }
