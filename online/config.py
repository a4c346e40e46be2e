"""Settings of the online algorithms, of each preset and of each sim.

All other settings have Stable-Baselines3's defaults.

A preset contains published settings without changes. Its sim is set up as published: observations
are images or rays, there is one environment, and the rules are classic. Presets also reproduce the
faults of the published programs; docs/online.md lists these faults.

    autonomysim-car, autonomysim-drone      https://github.com/nervosys/AutonomySim
    ddqn-racer                              Double DQN on a ray-cast track

`SIM_SETTINGS` are tuned for learning each sim from vectors with its default rules; docs/results.md
has the command and the scores of four seeds. Important settings are:

- A learning rate that decays to 4 % of its initial value. With a constant learning rate, the policy
  oscillates until the end.
- `n_steps` is 3 for powerline and racer, whose rewards are sparse or late. Their target networks
  are updated only every 2,000 steps (powerline, `gamma` 0.95) or 4,000 steps (racer, `gamma` 0.98).
- For continuous actions, `polyak` is 0.02: with 0.005, critics follow the policy too slowly, and
  the car of the lane stays slow. `smoothness` makes the commands smooth. The measurements are in
  docs/decisions/14-continuous-actions.md.
- Checkpoints are compared on separate episodes and the best one is stored, because scores can still
  drop during training.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from mcaprl.architecture import Architecture, NetworkSettings
from mcaprl.errors import UnknownNameError

N_QUANTILES: Final = 25  # Number of quantiles of each critic of TQC, sb3-contrib's default


@dataclass(frozen=True)
class OnlineConfig(NetworkSettings):
    """Settings of all online algorithms; each algorithm adds its own in a subclass.

    Raises:
        UsageError: A setting is outside its range.
    """

    steps: int = 100_000
    """number of environment steps, summed over all environments"""
    envs: int = 8
    """number of environments stepped at once, in this process"""
    learning_rate: float = 1e-4
    gamma: float = 0.99
    """discount per step"""
    hidden: tuple[int, ...] = (64, 64)
    eval_interval: int = 5_000
    """environment steps between two evaluations"""
    eval_episodes: int = 30
    """episodes of one evaluation, the same each time, in a separate environment"""
    checkpoint_interval: int = 20_000
    final_episodes: int = 100
    """new episodes for the final score of the best checkpoint"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require_positive("steps", "envs", "eval_interval", "eval_episodes")
        self._require_fraction("gamma")

    def arguments(self) -> dict[str, Any]:
        """Return arguments of SB3's constructor, except learning rate and networks."""
        return {"gamma": self.gamma}


@dataclass(frozen=True)
class ReplayConfig(OnlineConfig):
    """Settings of algorithms that learn from a replay buffer."""

    batch_size: int = 256
    """transitions in one gradient step"""
    buffer_size: int = 1_000_000
    """capacity of the replay buffer in transitions, capped at the number of steps"""
    learning_starts: int = 100
    """random steps before the first gradient step"""
    steps_per_update: int = 1
    """environment steps for each gradient step"""
    n_steps: int = 1
    """number of rewards in a target before the bootstrap value"""
    image_shift: int = 0
    """largest random shift of the images in a batch, in pixels of the network's input"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require_positive("batch_size", "steps_per_update", "n_steps")
        self._require("buffer_size", self.buffer_size >= self.envs, f"at least envs ({self.envs})")
        self._require("learning_starts", self.learning_starts >= 0, "at least 0")
        self._require("image_shift", self.image_shift >= 0, "at least 0")
        even = max(self.steps_per_update, self.envs) % min(self.steps_per_update, self.envs) == 0
        self._require("steps_per_update", even, f"a multiple or a divisor of envs ({self.envs})")

    @property
    def final_epsilon(self) -> float:
        """Probability of a random action at the end of the training."""
        return 0.0

    def epsilon_at(self, steps: int) -> float:
        """Return the probability of a random action after a number of steps of one agent."""
        return self.final_epsilon

    def arguments(self) -> dict[str, Any]:
        """Return arguments of SB3's constructor, except learning rate and networks."""
        same = ("batch_size", "learning_starts", "n_steps")
        return {
            **super().arguments(),
            **{name: getattr(self, name) for name in same},
            "buffer_size": min(self.buffer_size, self.steps + self.envs),
            # SB3 counts calls of `step`; each call steps every environment.
            "train_freq": max(1, self.steps_per_update // self.envs),
            "gradient_steps": max(1, self.envs // self.steps_per_update),
        }


@dataclass(frozen=True)
class DQNConfig(ReplayConfig):
    """Settings of DQN."""

    max_grad_norm: float = 10.0
    """maximum norm of the gradient"""
    batch_size: int = 32
    """transitions in one gradient step"""
    steps_per_update: int = 4
    """environment steps for each gradient step"""
    target_update_interval: int = 10_000
    """environment steps between two updates of the target network"""
    target_update_episodes: int = 0
    """episodes between two updates of the target network; 0 selects an interval in steps"""
    exploration_fraction: float = 0.1
    """fraction of the training during which epsilon falls linearly to its final value"""
    exploration_initial_eps: float = 1.0
    """epsilon, the probability of a random action, at the start"""
    exploration_final_eps: float = 0.05
    """epsilon at the end"""
    exploration_decay: float = 0.0
    """factor on epsilon at each step; 0 selects the linear decay"""
    dueling: bool = False
    """learn the value of a state separately from the advantages of its actions"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("max_grad_norm", self.max_grad_norm > 0, "above 0")
        self._require_positive("target_update_interval")
        self._require("target_update_episodes", self.target_update_episodes >= 0, "at least 0")
        self._require_fraction("exploration_fraction", "exploration_initial_eps")
        self._require_fraction("exploration_final_eps", "exploration_decay")
        self._require("hidden", bool(self.hidden) or not self.dueling, "not empty if dueling")

    @property
    def final_epsilon(self) -> float:
        """Probability of a random action at the end of the training."""
        return self.exploration_final_eps

    def epsilon_at(self, steps: int) -> float:
        """Return the probability of a random action after a number of steps of one agent."""
        first, last = self.exploration_initial_eps, self.exploration_final_eps
        if self.exploration_decay:
            return max(last, first * float(self.exploration_decay**steps))
        done = steps / max(self.exploration_fraction * self.steps, 1)
        return last if done >= 1 else first + (last - first) * done

    def architecture_for(self, channels: Iterable[int]) -> Architecture:
        """Return the network's architecture, given the channels of each image before stacking."""
        return replace(super().architecture_for(channels), dueling=self.dueling)

    def arguments(self) -> dict[str, Any]:
        """Return arguments of SB3's constructor, except learning rate and networks."""
        same = (
            "max_grad_norm",
            "target_update_interval",
            "exploration_fraction",
            "exploration_initial_eps",
            "exploration_final_eps",
        )
        return {**super().arguments(), **{name: getattr(self, name) for name in same}}


@dataclass(frozen=True)
class DoubleDQNConfig(DQNConfig):
    """Settings of Double DQN: those of DQN, plus alpha."""

    alpha: float = 0.0
    """weight of CQL's penalty on actions that are not in the replay buffer; 1 keeps a CQL policy"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("alpha", self.alpha >= 0, "at least 0")


@dataclass(frozen=True)
class ActorCriticConfig(ReplayConfig):
    """Settings of the algorithms with an actor and two critics, for the actions of a Box."""

    learning_rate: float = 3e-4
    hidden: tuple[int, ...] = (256, 256)
    polyak: float = 0.005
    """weight of the learning networks in an update of the target networks; 1 copies them"""
    critic_layer_norm: bool = False
    """normalize the hidden layers of the critics; the default with logs is yes"""
    data_fraction: float = 0.5
    """fraction of each batch that is drawn from given logs; 0 copies them to the replay buffer"""
    smoothness: float = 0.0
    """weight of the mean change of the actions in [-1, 1] from a state to the next one"""
    actor_starts: int = 1_000
    """updates of the critics before the first one of the actor of a policy that is continued"""
    actor_rate: float = 0.1
    """learning rate of the actor of a policy that is continued, as a multiple of the critics'"""
    anchor: float = 0.3
    """weight that keeps the actions of a continued policy close to what they were; 0: none"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("polyak", 0 < self.polyak <= 1, "within (0, 1]")
        self._require("actor_starts", self.actor_starts >= 0, "at least 0")
        self._require("actor_rate", 0 < self.actor_rate < math.inf, "above 0 and finite")
        self._require("anchor", 0 <= self.anchor < math.inf, "at least 0 and finite")
        self._require_fraction("data_fraction")
        self._require("smoothness", 0 <= self.smoothness < math.inf, "at least 0 and finite")

    def arguments(self) -> dict[str, Any]:
        """Return arguments of SB3's constructor, except learning rate and networks."""
        return {**super().arguments(), "tau": self.polyak}


@dataclass(frozen=True)
class SACConfig(ActorCriticConfig):
    """Settings of SAC."""

    temperature: float = 1.0
    """initial weight of the policy's entropy beside the rewards"""
    target_entropy: float = -1.0
    """entropy per number of an action in [-1, 1] to which the temperature is tuned"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("temperature", 0 < self.temperature < math.inf, "above 0 and finite")
        allowed = f"below {math.log(2):.2f}, the entropy of uniform numbers"
        self._require("target_entropy", -math.inf < self.target_entropy < math.log(2), allowed)

    def arguments(self) -> dict[str, Any]:
        """Return arguments of SB3's constructor, except learning rate, entropy and networks."""
        return {**super().arguments(), "ent_coef": f"auto_{self.temperature}"}


@dataclass(frozen=True)
class TD3Config(ActorCriticConfig):
    """Settings of TD3."""

    learning_rate: float = 1e-3
    exploration_noise: float = 0.1
    """standard deviation of the noise on the actor's actions, as a fraction of half the Box"""
    policy_interval: int = 2
    """updates of the critics per update of the actor and the target networks"""
    policy_noise: float = 0.2
    """standard deviation of the noise on target actions, as a fraction of half the Box"""
    noise_clip: float = 0.5
    """largest noise on target actions, as a fraction of half the Box"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require_positive("policy_interval")
        self._require("exploration_noise", self.exploration_noise > 0, "above 0")
        self._require("policy_noise", self.policy_noise >= 0, "at least 0")
        self._require("noise_clip", self.noise_clip >= 0, "at least 0")

    def arguments(self) -> dict[str, Any]:
        """Return arguments of SB3's constructor, except learning rate, noise and networks."""
        return {
            **super().arguments(),
            "policy_delay": self.policy_interval,
            "target_policy_noise": self.policy_noise,
            "target_noise_clip": self.noise_clip,
        }


@dataclass(frozen=True)
class TQCConfig(SACConfig):
    """Settings of TQC: those of SAC, and how optimistic the critics are."""

    dropped_quantiles: int = 2
    """largest quantiles of each critic, of 25, that targets leave out"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        fits = 0 <= self.dropped_quantiles < N_QUANTILES
        self._require("dropped_quantiles", fits, f"within 0 to {N_QUANTILES - 1}")

    def arguments(self) -> dict[str, Any]:
        """Return arguments of SB3's constructor, except learning rate, entropy and networks."""
        return {**super().arguments(), "top_quantiles_to_drop_per_net": self.dropped_quantiles}


@dataclass(frozen=True)
class RolloutConfig(OnlineConfig):
    """Settings of algorithms that learn from rollouts of the current policy."""

    max_grad_norm: float = 0.5
    """maximum norm of the gradient"""
    rollout_steps: int = 40
    """environment steps, summed over all environments, between two rounds of updates"""
    gae_lambda: float = 1.0
    """lambda of GAE, from 0 (one step) to 1 (whole return)"""
    entropy_coefficient: float = 0.0
    """weight of the policy's entropy in the loss"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require("max_grad_norm", self.max_grad_norm > 0, "above 0")
        whole = self.rollout_steps >= self.envs and self.rollout_steps % self.envs == 0
        self._require("rollout_steps", whole, f"a multiple of envs ({self.envs})")

    def arguments(self) -> dict[str, Any]:
        """Return arguments of SB3's constructor, except learning rate and networks."""
        return {
            **super().arguments(),
            "max_grad_norm": self.max_grad_norm,
            "n_steps": self.rollout_steps // self.envs,
            "gae_lambda": self.gae_lambda,
            "ent_coef": self.entropy_coefficient,
        }


@dataclass(frozen=True)
class PPOConfig(RolloutConfig):
    """Settings of PPO."""

    learning_rate: float = 3e-4
    rollout_steps: int = 2_048
    gae_lambda: float = 0.95
    batch_size: int = 64
    """transitions in one gradient step"""
    epochs: int = 10
    """passes over each rollout"""
    clip_range: float = 0.2
    """maximum relative change of an action's probability in one round"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        self._require_positive("batch_size", "epochs")
        enough = self.rollout_steps >= 2 * self.envs
        self._require("rollout_steps", enough, f"at least twice envs ({self.envs})")
        fits = self.rollout_steps % self.batch_size == 0
        self._require("batch_size", fits, f"a divisor of rollout_steps ({self.rollout_steps})")

    def arguments(self) -> dict[str, Any]:
        """Return arguments of SB3's constructor, except learning rate and networks."""
        return {
            **super().arguments(),
            "batch_size": self.batch_size,
            "n_epochs": self.epochs,
            "clip_range": self.clip_range,
        }


@dataclass(frozen=True)
class A2CConfig(RolloutConfig):
    """Settings of A2C, with RMSProp as in the paper."""

    learning_rate: float = 7e-4


CONFIGS: Final[dict[str, type[OnlineConfig]]] = {
    "dqn": DQNConfig,
    "double-dqn": DoubleDQNConfig,
    "sac": SACConfig,
    "td3": TD3Config,
    "tqc": TQCConfig,
    "ppo": PPOConfig,
    "a2c": A2CConfig,
}
"""Settings of the algorithms by name."""
ENGINES: Final[dict[str, tuple[str, ...]]] = {
    "mcaprl": ("double-dqn", "sac", "td3"),
    "sb3": ("dqn", "sac", "td3", "tqc", "ppo", "a2c"),
}
"""Algorithms of this package's learners, and of Stable-Baselines3 with sb3-contrib."""
FINITE_ALGOS: Final = ("double-dqn", "dqn", "ppo", "a2c")
"""Algorithms for finite action spaces, the default first."""
BOX_ALGOS: Final = ("sac", "td3", "tqc", "ppo", "a2c")
"""Algorithms for the actions of a Box, the default first."""


@dataclass(frozen=True)
class Preset:
    """Published settings of one program."""

    algo: str
    sim: str  # Short name of the sim
    sim_options: dict[str, Any]
    settings: dict[str, Any]  # Settings that differ from the algorithm's defaults


_AUTONOMYSIM: Final[dict[str, Any]] = {
    "steps": 500_000,
    "envs": 1,
    "learning_rate": 2.5e-4,
    # There are no hidden layers. The output layer follows the 512 features of SB3's `NatureCNN`.
    "hidden": (),
    "encoder": "nature",
    "center_images": False,
    "batch_size": 32,
    "buffer_size": 500_000,
    "steps_per_update": 4,
    "target_update_interval": 10_000,
    "max_grad_norm": 10.0,
    "exploration_fraction": 0.1,
    "exploration_final_eps": 0.01,
    "eval_interval": 10_000,
    "eval_episodes": 5,
}

PRESETS: Final[dict[str, Preset]] = {
    "autonomysim-car": Preset(
        "dqn",
        "lane",
        {"rules": "classic", "observation": "depth"},
        {**_AUTONOMYSIM, "learning_starts": 200_000},
    ),
    "autonomysim-drone": Preset(
        "dqn",
        "powerline",
        {"rules": "classic", "observation": "depth"},
        {**_AUTONOMYSIM, "learning_starts": 10_000},
    ),
    "ddqn-racer": Preset(
        "double-dqn",
        "racer",
        {"rules": "classic"},
        {
            "steps": 200_000,
            "envs": 1,
            "learning_rate": 5e-4,
            "gamma": 0.99,
            "hidden": (256,),
            "batch_size": 512,
            "buffer_size": 25_000,
            "learning_starts": 512,
            "steps_per_update": 1,
            "target_update_episodes": 50,
            "exploration_decay": 0.9995,
            "exploration_final_eps": 0.1,
            "eval_interval": 10_000,
            "eval_episodes": 5,
        },
    ),
}


_STEADY: Final[dict[str, Any]] = {
    "learning_rate": 5e-4,
    "final_learning_rate_fraction": 0.04,
    "hidden": (256, 256),
    "batch_size": 128,
    "learning_starts": 2_000,
    "exploration_fraction": 0.3,
}
_LONG_HORIZON: Final[dict[str, Any]] = {
    **_STEADY,
    "gamma": 0.98,
    "n_steps": 3,
    "target_update_interval": 4_000,
}

SIM_SETTINGS: Final[dict[str, dict[str, Any]]] = {
    "lane": {
        **_STEADY,
        "steps": 80_000,
        "gamma": 0.97,
        "buffer_size": 100_000,
        "target_update_interval": 1_000,
    },
    "racer": {**_LONG_HORIZON, "steps": 100_000, "buffer_size": 100_000},
    "powerline": {
        **_LONG_HORIZON,
        "steps": 150_000,
        "gamma": 0.95,
        "target_update_interval": 2_000,
        "buffer_size": 150_000,
    },
    "highway-lane": {
        **_STEADY,
        "steps": 40_000,
        "gamma": 0.97,
        "buffer_size": 40_000,
        "target_update_interval": 1_000,
    },
}
"""Settings that differ from the algorithm's defaults, by the sim's short name."""


_BOX: Final[dict[str, Any]] = {
    "learning_rate": 1e-3,
    "final_learning_rate_fraction": 0.05,
    "hidden": (128, 128),
    "batch_size": 128,
    "steps_per_update": 2,
    "learning_starts": 1_000,
    "eval_interval": 2_000,
    "buffer_size": 100_000,
    "polyak": 0.02,
    "smoothness": 0.1,
}
BOX_SETTINGS: Final[dict[str, dict[str, Any]]] = {
    "lane": {**_BOX, "steps": 120_000, "gamma": 0.97, "batch_size": 256},
    "racer": {**_BOX, "steps": 40_000, "gamma": 0.98},
    "powerline": {**_BOX, "steps": 150_000, "gamma": 0.95, "n_steps": 3, "batch_size": 256},
    "highway-lane": {**_BOX, "steps": 40_000, "gamma": 0.97},
}
"""Settings for continuous actions that differ from the algorithm's defaults, by sim."""
_ENTROPIES: Final = {"lane": -4.0, "racer": -2.0, "powerline": -4.0, "highway-lane": -2.0}
_WITH_ENTROPY: Final = {sim: {"target_entropy": target} for sim, target in _ENTROPIES.items()}
BOX_ALGO_SETTINGS: Final[dict[str, dict[str, dict[str, Any]]]] = {
    "sac": _WITH_ENTROPY,
    "td3": {sim: {"exploration_noise": 0.2} for sim in _ENTROPIES},
    "tqc": _WITH_ENTROPY,
}
"""Settings of each algorithm in addition to those of `BOX_SETTINGS`, by sim."""


_FROM_IMAGES: Final[dict[str, Any]] = {
    **_STEADY,
    "batch_size": 64,
    "buffer_size": 100_000,
    "exploration_fraction": 0.15,
    "eval_interval": 20_000,
}
_LANE_IMAGES: Final[dict[str, Any]] = {
    **_FROM_IMAGES,
    "dueling": True,
    "layer_norm": True,
    "steps": 200_000,
    "gamma": 0.97,
    "target_update_interval": 4_000,
}
IMAGE_SETTINGS: Final[dict[tuple[str, str], dict[str, Any]]] = {
    ("lane", "dashboard"): _LANE_IMAGES,
    ("lane", "depth"): {**_LANE_IMAGES, "frame_stack": 4},
    ("lane", "depth-commands"): {**_LANE_IMAGES, "frame_stack": 4},
    ("powerline", "depth"): {
        **_FROM_IMAGES,
        "steps": 240_000,
        "gamma": 0.95,
        "n_steps": 3,
        "target_update_interval": 2_000,
    },
}
"""Settings for learning from images, by the sim's short name and its argument `observation`."""
_BOX_FROM_IMAGES: Final[dict[str, Any]] = {
    "learning_rate": 5e-4,
    "final_learning_rate_fraction": 0.04,
    "hidden": (256, 256),
    "batch_size": 64,
    "buffer_size": 100_000,
    "learning_starts": 2_000,
    "steps_per_update": 4,
    "polyak": 0.01,
    "image_shift": 2,
    "eval_interval": 20_000,
}
_BOX_LANE_IMAGES: Final[dict[str, Any]] = {**_BOX_FROM_IMAGES, "steps": 200_000, "gamma": 0.97}
BOX_IMAGE_SETTINGS: Final[dict[tuple[str, str], dict[str, Any]]] = {
    ("lane", "dashboard"): _BOX_LANE_IMAGES,
    ("lane", "depth"): {**_BOX_LANE_IMAGES, "frame_stack": 4},
    ("lane", "depth-commands"): {**_BOX_LANE_IMAGES, "frame_stack": 4},
    ("powerline", "depth"): {**_BOX_FROM_IMAGES, "steps": 240_000, "gamma": 0.95, "n_steps": 3},
}
"""Settings for continuous actions from images, which were not tuned."""


def find_preset(name: str) -> Preset:
    """Find a preset by its name."""
    if name not in PRESETS:
        raise UnknownNameError("preset", name, PRESETS)
    return PRESETS[name]


def warm_settings(algo: str, *, with_logs: bool, with_policy: bool) -> dict[str, Any]:
    """Return the settings that have other defaults if an agent starts from logs or a policy."""
    # Critics have layer normalization with logs, and no policy (https://arxiv.org/abs/2302.02948).
    # A large temperature would make a policy random again.
    config_type = CONFIGS[algo]
    if with_policy:
        return {"temperature": 0.01} if issubclass(config_type, SACConfig) else {}
    return (
        {"critic_layer_norm": True}
        if with_logs and issubclass(config_type, ActorCriticConfig)
        else {}
    )


def reference_settings(algo: str, sim_options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that replace the tuned ones of a sim, because SB3 lacks them."""
    if not issubclass(CONFIGS[algo], ActorCriticConfig):
        return {}
    # Its buffer of Dict observations has no n-step returns.
    images = {"image_shift": 0, "encoder": "nature", "center_images": False, "n_steps": 1}
    return {"smoothness": 0.0, **(images if _has_images(sim_options) else {})}


def _has_images(sim_options: Mapping[str, Any]) -> bool:
    """Return whether the observations of one of our sims have images."""
    return sim_options.get("observation", "state") not in ("state", "rays")


def settings_for(algo: str, sim: str, sim_options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tuned settings of an algorithm for a sim; empty for classic rules and others."""
    default_rules = sim_options.get("rules", "default") == "default"
    if not (default_rules and issubclass(CONFIGS[algo], ReplayConfig)):
        return {}
    from mcaprl.sims import SIMS

    spec = SIMS.find(SIMS.get(sim, sim), loads=False)
    name = spec.name if spec else sim
    is_box = issubclass(CONFIGS[algo], ActorCriticConfig)
    if not _has_images(sim_options):
        settings = BOX_SETTINGS.get(name, {}) if is_box else SIM_SETTINGS.get(name, {})
        return {**settings, **(BOX_ALGO_SETTINGS[algo].get(name, {}) if is_box else {})}
    images = BOX_IMAGE_SETTINGS if is_box else IMAGE_SETTINGS
    return dict(images.get((name, sim_options["observation"]), {}))
