"""The loop of training online: collect a step, then update as often as the settings say.

The learners are those of offline learning, which train all seeds at once; here they learn from a
replay buffer that a collector fills. Exploration, schedules and the syncs of the target network
count environment steps of one agent, summed over its environments.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from gymnasium import spaces
from torch import Tensor

from mcaprl.offline.algorithms.config import CQLConfig
from mcaprl.offline.algorithms.config import DoubleDQNConfig as LearnerConfig
from mcaprl.offline.algorithms.cql import CQL
from mcaprl.offline.algorithms.dqn import DoubleDQN
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.batches.observations import ObservationEncoder
from mcaprl.online.collector import Collector, Environments, EpsilonGreedy, epsilon_at
from mcaprl.online.config import DoubleDQNConfig
from mcaprl.online.replay import Outcome, ReplayBuffer
from mcaprl.storage.tensor_files import below


class PenalizedDoubleDQN(CQL):
    """Double DQN with the penalty of CQL, whose policies have the name of the online algorithm."""

    name = DoubleDQN.name


class Agents:
    """K agents with E environments each: replay buffer, networks, and the loop of their training.

    Attributes:
        config: Settings of each agent.
        learner: Learner of all agents.
        buffer: Replay buffer of all agents.
        behavior: How actions are selected.
        collector: Collector of the environments; set by `connect`.
        generator: Generator of the exploration.
        steps: Number of finished steps of one agent, summed over its environments.
        learning_starts: Number of steps before the first update.
        is_pretrained: Whether the agents explore with the final epsilon from the start, without
            random steps.
        terms: Terms of the loss of the last update; empty before the first.
    """

    def __init__(
        self,
        config: DoubleDQNConfig,
        encoder: ObservationEncoder,
        action_space: spaces.Space[Any],
        seeds: Sequence[int],
        device: torch.device,
    ) -> None:
        """Create agents with new weights."""
        self.config = config
        learner_type, learner_config = _learner_of(config)
        channels = [image.shape[2] for image in encoder.image_inputs]
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
        self.learner: Learner = learner_type(learner_config, self.buffer, seeds)
        self.learner.max_grad_norm = config.max_grad_norm
        self.learner.learning_rate_at = lambda _: self.learning_rate
        self.generator = torch.Generator(device).manual_seed(seeds[0])
        self.behavior = EpsilonGreedy(self.learner, self.generator)
        self.collector: Collector
        self.steps = self._episodes = 0
        self.learning_starts = config.learning_starts
        self.is_pretrained = False
        self.terms: dict[str, Tensor] = {}

    def connect(self, environments: Environments) -> None:
        """Let the agents act in these environments; call `collector.begin` before `step`."""
        self.collector = Collector(environments, self.buffer, self.behavior)

    @property
    def epsilon(self) -> float:
        """Probability of a random action in the next step."""
        if self.is_pretrained:
            return self.config.exploration_final_eps
        return 1.0 if self.steps < self.learning_starts else epsilon_at(self.config, self.steps)

    @property
    def learning_rate(self) -> float:
        """Learning rate of an update after the steps so far; it decays linearly."""
        last, done = self.config.final_learning_rate_fraction, self.steps / self.config.steps
        return self.config.learning_rate * (1 - (1 - last) * min(done, 1.0))

    def step(self) -> Outcome:
        """Take a step in each environment; then learn, unless it is too early.

        Raises:
            NotFiniteError: The loss is NaN or infinite.
        """
        config = self.config
        outcome = self.collector.step(self.epsilon)
        before, self.steps = self.steps, self.steps + config.envs
        if config.target_update_episodes:
            ended = int((outcome.terminated | outcome.truncated).sum())
            earlier, self._episodes = self._episodes, self._episodes + ended
            if _due(earlier, self._episodes, config.target_update_episodes):
                self.learner.sync_targets()
        elif _due(before, self.steps, config.target_update_interval):
            self.learner.sync_targets()
        if self.steps > self.learning_starts:
            for _ in range(_due(before, self.steps, config.steps_per_update)):
                self.terms = self.learner.update()
        return outcome

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
        """Restore what `state` and `counters` returned.

        Raises:
            KeyError: A part is missing.
            RuntimeError, IndexError: A tensor has another shape.
        """
        (seed,) = self.learner.seeds
        self.learner.load_state(seed, below(tensors, "learner"), int(counters["updates"]))
        self.buffer.load_state(below(tensors, "buffer"))
        self.generator.set_state(torch.tensor(counters["generator"], dtype=torch.uint8))
        self.steps, self._episodes = int(counters["steps"]), int(counters["episodes"])
        self.learning_starts = int(counters["learning_starts"])
        self.is_pretrained = bool(counters["is_pretrained"])
        self.terms = {name: torch.tensor([term]) for name, term in counters["terms"].items()}

    def means(self) -> dict[str, float]:
        """Return the means of the terms of the first agent's last update."""
        return {name: float(term.mean()) for name, term in self.terms.items()}


def _due(before: int, now: int, interval: int) -> int:
    """Return how many multiples of an interval were reached."""
    return now // interval - before // interval


def _learner_of(config: DoubleDQNConfig) -> tuple[type[DoubleDQN], LearnerConfig]:
    """Return the learner of an online algorithm, with its settings."""
    same: dict[str, Any] = {
        name: getattr(config, name)
        for name in (
            "batch_size",
            "learning_rate",
            "gamma",
            "n_steps",
            "hidden",
            "layer_norm",
            "dueling",
            "frame_stack",
            "encoder",
            "channels",
            "center_images",
        )
    }
    # The target network is synced by environment steps instead of updates.
    same["target_interval"] = sys.maxsize
    if config.alpha:
        return PenalizedDoubleDQN, CQLConfig(**same, alpha=config.alpha)
    return DoubleDQN, LearnerConfig(**same)
