"""Algorithms by name: their settings and classes, which are those of Stable-Baselines3 but one.

Double DQN is SB3's DQN, in which the target network evaluates the online network's best action.

    https://arxiv.org/abs/1509.06461    target r + gamma Q'(s', argmax_a Q(s', a))

With `n_steps` n, the target is the sum of n discounted rewards, plus gamma^n times the value Q' n
steps later. SB3's replay buffer returns the sum and gamma^n. If the episode ends earlier, n is
smaller.

With `alpha` above 0, CQL's penalty is added to the loss, as in `offline/algorithms/cql.py`:

    https://arxiv.org/abs/2006.04779    alpha (logsumexp_a Q(s, a) - Q(s, a_buffer))
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv
from torch.nn import functional

from mcaprl.actions import joint_actions
from mcaprl.architecture import SMALL_EDGE, Architecture
from mcaprl.errors import SpaceError, UnknownNameError, UsageError
from mcaprl.frames import is_image, parts_of_space
from mcaprl.online.config import (
    CONFIGS,
    DoubleDQNConfig,
    DQNConfig,
    OnlineConfig,
)
from mcaprl.online.features import (
    NetworkDQNPolicy,
    channels_first,
    inputs_of,
    policy_arguments,
    pools_of,
)
from mcaprl.online.frame_buffer import FrameReplayBuffer


class WarmDQN(DQN):
    """SB3's DQN with an option for pretrained weights.

    Attributes:
        skips_random_steps: Whether the steps before learning follow the policy instead of taking
            random actions. Learning does not start earlier, because learning from too few
            transitions would destroy the pretrained weights (https://arxiv.org/abs/2412.07762).
    """

    skips_random_steps = False

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        starts = 0 if self.skips_random_steps else learning_starts
        return super()._sample_action(starts, action_noise, n_envs)


class DoubleDQN(WarmDQN):
    """SB3's DQN with the Double DQN target and an optional penalty of CQL.

    `DQN.load` also loads the `.zip` files of this class.

    Attributes:
        alpha: Weight of CQL's penalty on actions that are not in the replay buffer; 0 disables it.
    """

    alpha = 0.0

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Run gradient steps on batches from the replay buffer."""
        assert self.replay_buffer is not None
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        losses, mean_values = [], []
        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            discounts = self.gamma if batch.discounts is None else batch.discounts
            with torch.no_grad():
                best = self.q_net(batch.next_observations).argmax(1, keepdim=True)
                values_t = self.q_net_target(batch.next_observations).gather(1, best)
                targets = batch.rewards + (1 - batch.dones) * discounts * values_t
            values_of_all = self.q_net(batch.observations)
            values = values_of_all.gather(1, batch.actions.long())
            loss = functional.smooth_l1_loss(values, targets)
            if self.alpha:
                actions = batch.actions[:, 0].long()
                loss = loss + self.alpha * functional.cross_entropy(values_of_all, actions)
            self.policy.optimizer.zero_grad()
            torch.autograd.backward(loss)
            torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
            self.policy.optimizer.step()
            losses.append(loss.detach().item())
            mean_values.append(values.detach().mean().item())
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/loss", np.mean(losses))
        self.logger.record("train/mean_q", np.mean(mean_values))


@dataclass(frozen=True)
class Algorithm:
    """Classes of an algorithm.

    Attributes:
        config_type: Dataclass of the algorithm's settings.
        model_type: SB3 class of the algorithm's model.
    """

    config_type: type[OnlineConfig]
    model_type: type[BaseAlgorithm]


_MODELS: Final[dict[str, type[BaseAlgorithm]]] = {
    "dqn": WarmDQN,
    "double-dqn": DoubleDQN,
    "ppo": PPO,
    "a2c": A2C,
}
ALGORITHMS: Final = {
    name: Algorithm(config_type, _MODELS[name]) for name, config_type in CONFIGS.items()
}


def find_algorithm(name: str) -> Algorithm:
    """Find an algorithm by its name."""
    if name not in ALGORITHMS:
        raise UnknownNameError("algorithm", name, ALGORITHMS)
    return ALGORITHMS[name]


def check_spaces(
    algo: str, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
) -> None:
    """Check that an algorithm supports the spaces of an environment."""
    find_algorithm(algo)
    joint = joint_actions(action_space)
    if joint is None or joint.shape:
        hint = ""
        if joint is not None:
            hint = ": wrap the environment so that one Discrete action has all elements, or record"
            hint += " and train offline (train-offline)"
        raise SpaceError(f"{algo} needs discrete actions, got {action_space}{hint}")
    if joint.first != 0:
        raise SpaceError(
            f"{algo} needs actions that start at 0, got {action_space}:"
            " wrap the environment in gymnasium.wrappers.TransformAction"
        )
    for space in parts_of_space(observation_space).values():
        if not isinstance(space, spaces.Box):
            raise SpaceError(f"{algo} needs Box observations, or a Dict of them, got {space}")


def make_model(algo: str, config: OnlineConfig, env: VecEnv, seed: int) -> BaseAlgorithm:
    """Create a model with new weights, and seed Python, NumPy and torch."""
    algorithm = find_algorithm(algo)
    last_rate = config.learning_rate * config.final_learning_rate_fraction
    architecture = own_architecture(config, env.observation_space)
    policy_kwargs: dict[str, Any] = {"net_arch": list(config.hidden)}
    policy: Any = _policy_name(env.observation_space)
    if architecture is not None:
        policy_kwargs = policy_arguments(architecture)
        if issubclass(algorithm.model_type, DQN):
            policy = NetworkDQNPolicy
    if algorithm.model_type is not A2C:
        policy_kwargs["optimizer_kwargs"] = {"fused": True}
    # The constructors of SB3's models have different signatures, so the type checker cannot check
    # the arguments.
    model_type: Any = algorithm.model_type
    model: BaseAlgorithm = model_type(
        policy,
        env,
        learning_rate=LinearSchedule(config.learning_rate, last_rate, 1.0),
        policy_kwargs=policy_kwargs,
        seed=seed,
        device="auto",
        **_arguments(config, env.observation_space),
    )
    encoder = "nature" if architecture is None else architecture.encoder
    if encoder == "nature" and _has_images(env.observation_space):
        # Convolutions take 25 % less time in channels-last format; results do not change.
        cast(Any, model.policy).to(memory_format=torch.channels_last)
    if isinstance(config, DoubleDQNConfig):
        cast(DoubleDQN, model).alpha = config.alpha
    if isinstance(config, DQNConfig) and config.exploration_decay:
        cast(DQN, model).exploration_schedule = ExponentialSchedule(
            config.exploration_initial_eps,
            config.exploration_final_eps,
            config.exploration_decay,
            config.steps,
        )
    return model


def own_architecture(config: OnlineConfig, space: spaces.Space[Any]) -> Architecture | None:
    """Return the architecture of this package's network, or None to use SB3's own network."""
    images = inputs_of(channels_first(space))[1]
    architecture = config.architecture_for(image.shape[2] // config.frame_stack for image in images)
    adapts_images = images and (config.center_images or architecture.encoder != "nature")
    if (
        adapts_images
        or _has_small_images(space)
        or architecture != Architecture(config.hidden, encoder=architecture.encoder)
    ):
        return architecture
    return None


def _arguments(config: OnlineConfig, space: spaces.Space[Any]) -> dict[str, Any]:
    """Return the arguments for SB3's constructor.

    DQN uses a `FrameReplayBuffer` if it observes images or stacks.
    """
    arguments = config.arguments()
    if getattr(config, "image_shift", 0) and not _has_images(space):
        raise UsageError("image_shift is for images, but the observations have none")
    if isinstance(config, DQNConfig) and (config.frame_stack > 1 or _has_images(space)):
        extra = {"n_steps": arguments.pop("n_steps"), "gamma": config.gamma}
        extra |= {"frame_stack": config.frame_stack, "image_shift": config.image_shift}
        architecture = own_architecture(config, space)
        if architecture is not None:
            extra["pools"] = pools_of(channels_first(space), architecture)
        arguments |= {"replay_buffer_class": FrameReplayBuffer, "replay_buffer_kwargs": extra}
    return arguments


def _has_small_images(space: spaces.Space[Any]) -> bool:
    """Return whether SB3's own networks refuse images of the space."""
    parts = parts_of_space(channels_first(space)).values()
    return any(is_image(part) and min(part.shape[1:]) < SMALL_EDGE for part in parts)


def _has_images(space: spaces.Space[Any]) -> bool:
    return any(is_image(part) for part in parts_of_space(space).values())


@dataclass(frozen=True)
class ExponentialSchedule:
    """Schedule that multiplies `first` by `factor` at each step, down to the minimum `last`."""

    first: float
    last: float
    factor: float
    steps: int

    def __call__(self, remaining: float) -> float:
        """Return the value for a remaining fraction of the steps, from 1 (start) to 0 (end)."""
        return max(self.last, self.first * float(self.factor ** ((1 - remaining) * self.steps)))


def _policy_name(space: spaces.Space[Any]) -> str:
    if isinstance(space, spaces.Dict):
        return "MultiInputPolicy"
    return "CnnPolicy" if is_image(space) else "MlpPolicy"
