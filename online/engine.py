"""The loop of training online: collect a step, then update as often as the settings say.

The learners are those of offline learning, which train all seeds at once; here they learn from a
replay buffer that a collector fills. Exploration, schedules and the syncs of the target network
count environment steps of one agent, summed over its environments.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from gymnasium import spaces
from torch import Tensor

from mcaprl.offline.algorithms import config as learners
from mcaprl.offline.algorithms.actor_critic import ActorCritic
from mcaprl.offline.algorithms.cql import CQL
from mcaprl.offline.algorithms.dqn import DoubleDQN
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.algorithms.sac import SAC
from mcaprl.offline.algorithms.td3 import TD3
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.batches.observations import ObservationEncoder
from mcaprl.online.collector import (
    Behavior,
    Collector,
    Environments,
    EpsilonGreedy,
    NoisyActions,
    SquashedSamples,
)
from mcaprl.online.config import (
    ActorCriticConfig,
    DoubleDQNConfig,
    DQNConfig,
    ReplayConfig,
    SACConfig,
    TD3Config,
)
from mcaprl.online.replay import MixedBuffer, Outcome, ReplayBuffer
from mcaprl.storage.tensor_files import below


class PenalizedDoubleDQN(CQL):
    """Double DQN with the penalty of CQL, whose policies have the name of the online algorithm."""

    name = DoubleDQN.name


class Agents:
    """K agents with E environments each: replay buffer, networks, and the training loop."""

    def __init__(
        self,
        config: ReplayConfig,
        encoder: ObservationEncoder,
        action_space: spaces.Space[Any],
        seeds: Sequence[int],
        device: torch.device,
        log: Callable[[ReplayBuffer], TransitionBuffer] | None = None,
    ) -> None:
        """Create agents with new weights."""
        # `log` returns logged transitions for a part of each batch.
        self.config = config
        learner_type, learner_config = _learner_of(config)
        channels = [image.shape[2] for image in encoder.image_inputs]
        # Replay buffer of all agents.
        self.buffer = ReplayBuffer.allocate(
            encoder,
            action_space,
            learner_config.packing,
            learner_config.architecture_for(channels),
            agents=len(seeds),
            envs=config.envs,
            size=min(config.buffer_size, config.steps + config.envs),
            device=device,
            seed=seeds[0],
            image_shift=config.image_shift,
        )
        if log is not None:
            assert isinstance(config, ActorCriticConfig)
            self.buffer = MixedBuffer.of(self.buffer, log(self.buffer), config.data_fraction)
        self.learner: Learner = learner_type(learner_config, self.buffer, seeds)
        if isinstance(config, DQNConfig):
            self.learner.max_grad_norm = config.max_grad_norm
        self.learner.learning_rate_at = lambda _: self.learning_rate
        self.generator = torch.Generator(device).manual_seed(seeds[0])
        # How actions are selected.
        self.behavior = _behavior_of(config, self.learner, self.generator)
        self.collector: Collector  # Collector of the environments; set by `connect`
        # Number of finished steps of one agent, summed over its environments.
        self.steps = self._episodes = 0
        self.learning_starts = config.learning_starts  # Number of steps before the first update
        # Whether the agents explore with the final epsilon from the start, without random steps.
        self.is_pretrained = False
        # Terms of the loss of the last update; empty before the first.
        self.terms: dict[str, Tensor] = {}

    def connect(self, environments: Environments) -> None:
        """Let the agents act in these environments; call `collector.begin` before `step`."""
        self.collector = Collector(environments, self.buffer, self.behavior)

    def continue_policy(self) -> None:
        """Explore and learn as agents do that start with the networks of a policy."""
        self.is_pretrained = True
        if isinstance(self.learner, ActorCritic):
            assert isinstance(self.config, ActorCriticConfig)
            config = self.config
            self.learner.continue_actor(config.actor_starts, config.actor_rate, config.anchor)

    @property
    def epsilon(self) -> float:
        """Probability of a random action in the next step."""
        if self.is_pretrained:
            return self.config.final_epsilon
        return 1.0 if self.steps < self.learning_starts else self.config.epsilon_at(self.steps)

    @property
    def learning_rate(self) -> float:
        """Learning rate of an update after the steps so far; it decays linearly."""
        last, done = self.config.final_learning_rate_fraction, self.steps / self.config.steps
        return self.config.learning_rate * (1 - (1 - last) * min(done, 1.0))

    def step(self) -> Outcome:
        """Take a step in each environment; then learn, unless it is too early."""
        config = self.config
        outcome = self.collector.step(self.epsilon)
        before, self.steps = self.steps, self.steps + config.envs
        if isinstance(config, DQNConfig) and self._is_sync_due(config, before, outcome):
            self.learner.sync_targets()
        if self.steps > self.learning_starts:
            for _ in range(_due(before, self.steps, config.steps_per_update)):
                # Some updates have no terms of the actor.
                self.terms = {**self.terms, **self.learner.update()}
        return outcome

    def _is_sync_due(self, config: DQNConfig, before: int, outcome: Outcome) -> bool:
        """Return whether the target network is synced after a step that began at `before`."""
        if not config.target_update_episodes:
            return _due(before, self.steps, config.target_update_interval) > 0
        ended = int((outcome.terminated | outcome.truncated).sum())
        earlier, self._episodes = self._episodes, self._episodes + ended
        return _due(earlier, self._episodes, config.target_update_episodes) > 0

    def counters(self) -> dict[str, Any]:
        """Return the numbers of the state, for a checkpoint."""
        return {
            "steps": self.steps,
            "updates": self.learner.step,
            "episodes": self._episodes,
            "learning_starts": self.learning_starts,
            "is_pretrained": self.is_pretrained,
            "generator": self.generator.get_state().tolist(),
            "terms": self.means(),
        }

    def state(self) -> dict[str, Tensor]:
        """Return the tensors of the state of a single agent, for a checkpoint."""
        (seed,) = self.learner.seeds
        return {
            **{f"learner.{name}": part for name, part in self.learner.state(seed).items()},
            **{f"buffer.{name}": part for name, part in self.buffer.state().items()},
        }

    def load_state(self, tensors: Mapping[str, Tensor], counters: Mapping[str, Any]) -> None:
        """Restore what `state` and `counters` returned; KeyError or another if a part is wrong."""
        (seed,) = self.learner.seeds
        if counters["is_pretrained"]:
            self.continue_policy()
        self.learner.load_state(seed, below(tensors, "learner"), int(counters["updates"]))
        self.buffer.load_state(below(tensors, "buffer"))
        self.generator.set_state(torch.tensor(counters["generator"], dtype=torch.uint8))
        self.steps, self._episodes = int(counters["steps"]), int(counters["episodes"])
        self.learning_starts = int(counters["learning_starts"])
        self.terms = {name: torch.tensor([term]) for name, term in counters["terms"].items()}

    def means(self) -> dict[str, float]:
        """Return the means of the terms of the first agent's last update."""
        return {name: float(term.mean()) for name, term in self.terms.items()}


def _due(before: int, now: int, interval: int) -> int:
    """Return how many multiples of an interval were reached."""
    return now // interval - before // interval


_OF_NETWORKS = ("hidden", "layer_norm", "frame_stack", "encoder", "channels", "center_images")
_OF_UPDATES = ("batch_size", "learning_rate", "gamma", "n_steps")
_OF_ACTOR_CRITIC = ("polyak", "critic_layer_norm", "smoothness")


def _learner_of(config: ReplayConfig) -> tuple[type[Learner], learners.TrainingConfig]:
    """Return the learner of an online algorithm, with its settings."""

    def same(*names: str) -> dict[str, Any]:
        return {name: getattr(config, name) for name in (*_OF_NETWORKS, *_OF_UPDATES, *names)}

    if isinstance(config, DoubleDQNConfig):
        # The target network is synced by environment steps instead of updates.
        settings = {**same("dueling"), "target_interval": sys.maxsize}
        if config.alpha:
            return PenalizedDoubleDQN, learners.CQLConfig(**settings, alpha=config.alpha)
        return DoubleDQN, learners.DoubleDQNConfig(**settings)
    unscaled: dict[str, Any] = {"normalize": False, "scale_rewards": False}
    if isinstance(config, SACConfig):
        settings = same(*_OF_ACTOR_CRITIC, "temperature", "target_entropy")
        return SAC, learners.SACConfig(**settings, **unscaled)
    assert isinstance(config, TD3Config)
    settings = same(*_OF_ACTOR_CRITIC, "policy_interval", "policy_noise", "noise_clip")
    interval = config.policy_interval
    return TD3, learners.TD3Config(**settings, **unscaled, target_interval=interval)


def _behavior_of(config: ReplayConfig, learner: Learner, generator: torch.Generator) -> Behavior:
    """Return how the actions of a training are selected."""
    if isinstance(config, TD3Config):
        return NoisyActions(learner, generator, config.exploration_noise)
    kind = SquashedSamples if isinstance(config, SACConfig) else EpsilonGreedy
    return kind(learner, generator)
