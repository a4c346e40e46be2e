"""Settings of the offline algorithms. Importing this module loads no torch."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from mcaprl.architecture import Architecture, NetworkSettings
from mcaprl.offline.batches.packing import Packing

if TYPE_CHECKING:
    # Help texts are shown without NumPy.
    from mcaprl.chunks import Chunks

ENTRY_POINT_GROUP: Final = "mcaprl.algorithms"
HEADS: Final = ("deterministic", "gaussian", "mixture")
"""What the network of a policy for a Box outputs."""
MAX_CHUNK: Final = 1_000
ACT_DECAY: Final = 0.01  # Coefficient of temporal ensembling in ACT
ALPHA_RANGE: Final = (1e-4, 100.0)  # Range of CQL's alpha if it is learned


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
    clip_actions: bool = False
    """clip logged actions outside a Box to its bounds; otherwise, they are an error"""

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
        return Packing(
            self.frame_stack, self.normalize, self.center_images, clip_actions=self.clip_actions
        )

    @property
    def best(self) -> tuple[float, str]:
        """Fraction of the best episodes that are learned from, and the expression that ranks."""
        return 1.0, ""


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
        return float(1 - self.gamma ** (self.n_steps * max(self.syncs, 1)))

    @property
    def syncs(self) -> float:
        """Number of updates of the target network."""
        return self.updates / self.target_interval


@dataclass(frozen=True)
class BCConfig(TrainingConfig):
    """Settings of behavior cloning."""

    top: float = 1.0
    """fraction of the episodes to learn from: those with the largest returns"""
    top_by: str = ""
    """expression of an episode that ranks it for top instead of its return, such as success"""
    chunk: int = 1
    """actions that are predicted from one observation: those of its step and of the next ones"""
    execute: int = 0
    """actions of a chunk that are executed before the next prediction; 0 for half of them"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("top", 0 < self.top <= 1, "within (0, 1]")
        self._require("top_by", not self.top_by or self.top < 1, "omitted, or used with top")
        self._require("chunk", 1 <= self.chunk <= MAX_CHUNK, f"within [1, {MAX_CHUNK}]")
        self._require("execute", 0 <= self.execute <= self.chunk, f"within [0, {self.chunk}]")

    @property
    def chunks(self) -> Chunks:
        """Length of the chunks and how they are executed."""
        from mcaprl.chunks import Chunks

        return Chunks(self.chunk, self.execute or (self.chunk + 1) // 2)

    @property
    def packing(self) -> Packing:
        """Settings for building transitions from the log."""
        return replace(super().packing, chunk=self.chunk)

    @property
    def best(self) -> tuple[float, str]:
        """Fraction of the best episodes that are learned from, and the expression that ranks."""
        return self.top, self.top_by


@dataclass(frozen=True)
class BoxBCConfig(BCConfig):
    """Settings of behavior cloning of the actions of a Box."""

    normalize: bool = True
    """normalize the network's inputs to mean 0 and standard deviation 1 over the data"""
    head: str = "deterministic"
    """what the network outputs: deterministic, gaussian, or mixture (of 5 Gaussians)"""
    ensemble: bool = False
    """predict a chunk at each step, and average those of the last steps (temporal ensembling)"""
    relative: bool = True
    """learn actions relative to observations, where the data declare it (`relative_to`)"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("head", self.head in HEADS, f"one of {', '.join(HEADS)}")
        self._require("execute", not (self.ensemble and self.execute > 1), "1 with an ensemble")

    @property
    def chunks(self) -> Chunks:
        """Length of the chunks and how they are executed."""
        from mcaprl.chunks import Chunks

        return Chunks(self.chunk, 1, ACT_DECAY) if self.ensemble else super().chunks

    @property
    def packing(self) -> Packing:
        """Settings for building transitions from the log."""
        return replace(super().packing, relative=self.relative)


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
    """weight of the penalty on actions that are not in the data (td3-bc: of the values)"""
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


@dataclass(frozen=True)
class ActorCriticConfig(BootstrapConfig):
    """Settings of the algorithms with an actor and two critics, for the actions of a Box."""

    hidden: tuple[int, ...] = (128, 128)
    """widths of the hidden layers; for images, of the layers after the convolutions"""
    normalize: bool = True
    """normalize the network's inputs to mean 0 and standard deviation 1 over the data"""
    scale_rewards: bool = True
    """divide rewards by the standard deviation of the discounted returns of the log"""
    target_interval: int = 1
    """updates between two updates of the target networks"""
    polyak: float = 0.02
    """weight of the learning networks in an update of the target networks; 1 copies them"""
    critic_layer_norm: bool = False
    """normalize the hidden layers of the critics"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("polyak", 0 < self.polyak <= 1, "within (0, 1]")

    @property
    def syncs(self) -> float:
        """Number of updates of the target network, in which the values of n steps are added."""
        return super().syncs * self.polyak


@dataclass(frozen=True)
class BoxIQLConfig(ActorCriticConfig, IQLConfig):
    """Settings of IQL for the actions of a Box."""

    expectile: float = 0.7
    """expectile of the action values that V estimates; 0.5 is the mean, near 1 the maximum"""
    beta: float = 3.0
    """inverse temperature of the advantage weights in cloning; 0 weights all actions equally"""


@dataclass(frozen=True)
class TD3Config(ActorCriticConfig):
    """Settings of TD3: delayed updates of the actor, and noise on the actions of targets."""

    target_interval: int = 2
    """updates between two updates of the target networks"""
    policy_interval: int = 2
    """updates of the critics per update of the actor"""
    policy_noise: float = 0.2
    """standard deviation of the noise on target actions, as a fraction of half the Box"""
    noise_clip: float = 0.5
    """largest noise on target actions, as a fraction of half the Box"""
    smoothness: float = 0.0
    """weight of the mean change of the actions in [-1, 1] from a state to the next one"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require_positive("policy_interval")
        self._require("policy_noise", self.policy_noise >= 0, "at least 0")
        self._require("noise_clip", self.noise_clip >= 0, "at least 0")
        self._require("smoothness", 0 <= self.smoothness < math.inf, "at least 0 and finite")


@dataclass(frozen=True)
class SACConfig(ActorCriticConfig):
    """Settings of SAC."""

    temperature: float = 1.0
    """initial weight of the policy's entropy beside the rewards"""
    target_entropy: float = -1.0
    """entropy per number of an action in [-1, 1] to which the temperature is tuned"""
    smoothness: float = 0.0
    """weight of the mean change of the actions in [-1, 1] from a state to the next one"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("temperature", 0 < self.temperature < math.inf, "above 0 and finite")
        highest = math.log(2)
        allowed = f"below {highest:.2f}, the entropy of uniform numbers"
        self._require("target_entropy", -math.inf < self.target_entropy < highest, allowed)
        self._require("smoothness", 0 <= self.smoothness < math.inf, "at least 0 and finite")


@dataclass(frozen=True)
class TD3BCConfig(TD3Config):
    """Settings of TD3+BC."""

    alpha: float = 2.5
    """weight of the values, divided by their mean absolute value, beside the cloning error"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("alpha", self.alpha >= 0, "at least 0")


@dataclass(frozen=True)
class ReBRACConfig(TD3Config):
    """Settings of ReBRAC."""

    hidden: tuple[int, ...] = (128, 128, 128)
    """widths of the hidden layers; for images, of the layers after the convolutions"""
    actor_weight: float = 0.1
    """weight of the actor's cloning error, beside the values over their mean absolute value"""
    critic_weight: float = 0.01
    """weight of the squared distance of next actions from the logged ones in targets"""
    critic_layer_norm: bool = True

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("actor_weight", self.actor_weight >= 0, "at least 0")
        self._require("critic_weight", self.critic_weight >= 0, "at least 0")


CONFIGS: Final[dict[str, type[TrainingConfig]]] = {
    "dqn": DQNConfig,
    "double-dqn": DoubleDQNConfig,
    "cql": CQLConfig,
    "bc": BCConfig,
    "bcq": BCQConfig,
    "iql": IQLConfig,
}
"""Settings of the built-in algorithms for finite action spaces by name."""
BOX_CONFIGS: Final[dict[str, type[TrainingConfig]]] = {
    "bc": BoxBCConfig,
    "td3-bc": TD3BCConfig,
    "rebrac": ReBRACConfig,
    "iql": BoxIQLConfig,
}
"""Settings of the built-in algorithms for the actions of a Box by name."""
