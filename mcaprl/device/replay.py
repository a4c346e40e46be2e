"""Replay buffer of several agents on one device, in which each agent draws its own transitions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from gymnasium import spaces
from torch import Tensor

from mcaprl.offline.algorithms.config import DoubleDQNConfig
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.batches.observations import ObservationEncoder, Observations


class ReplayBuffer:
    """The last transitions of K agents with E environments each, as the data of a `Learner`.

    A slot holds one step of all K * E environments, ordered by agent. A new step replaces the
    oldest slot. The rows of `transitions` are those of the slots, and their frames are the
    observations of all rows, followed by the next observations of all rows.

    Attributes:
        transitions: All transitions; each agent draws from its own.
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Discrete,
        config: DoubleDQNConfig,
        agents: int,
        envs: int,
        slots: int,
        device: torch.device,
        seed: int,
    ) -> None:
        """Allocate the buffer.

        Args:
            observation_space: Observation space of one environment, a vector.
            action_space: Action space of one environment.
            config: Settings of the learner.
            agents: Number of agents K.
            envs: Number of environments E of one agent.
            slots: Number of slots, more than the number of steps in a return.
            device: Device of the buffer.
            seed: Seed of the draws.
        """
        assert slots > config.n_steps
        encoder = ObservationEncoder(observation_space, int(action_space.n))
        self._slots, self._width = slots, agents * envs
        rows = slots * self._width
        vectors = torch.zeros(2 * rows, encoder.width, device=device)
        self._own = OwnRows(agents, envs, slots, config.n_steps, device, seed)
        self.transitions = OwnTransitions(
            encoder=encoder,
            action_space=action_space,
            packing=config.packing,
            frames=Observations(vectors),
            starts=torch.empty(0, dtype=torch.int64, device=device),
            places=torch.arange(2 * rows, device=device).view(2, rows),
            actions=torch.zeros(rows, dtype=torch.int64, device=device),
            returns=torch.zeros(2, rows, device=device),
            is_fixed=False,
            own=self._own,
        )
        # The views below have one row for each slot.
        self._observations, self._next_observations = vectors.view(2, slots, self._width, -1)
        self._actions = self.transitions.actions.view(slots, -1)
        self._returns, self._discounts = self.transitions.returns.view(2, slots, -1)
        self._next_places = self.transitions.places[1].view(slots, -1)
        self._rewards = torch.zeros(slots, self._width, device=device)
        self._goes_on = torch.zeros(slots, self._width, dtype=torch.bool, device=device)
        self._is_terminal = torch.zeros_like(self._goes_on)

    def add_actions(self, observations: Tensor, actions: Tensor) -> None:
        """Begin a slot with the observations (K * E, V) and actions (K * E,) of a step."""
        slot = self._own.steps % self._slots
        self._observations[slot] = observations
        self._actions[slot] = actions

    def add_outcomes(
        self, rewards: Tensor, terminated: Tensor, truncated: Tensor, observations: Tensor
    ) -> None:
        """Complete a slot; compute the returns of the steps whose n rewards are now known.

        Args:
            rewards: (K * E,) rewards.
            terminated: (K * E,) bool.
            truncated: (K * E,) bool.
            observations: (K * E, V) next observations, of the old episode if one ended.
        """
        slot = self._own.steps % self._slots
        self._next_observations[slot] = observations
        self._rewards[slot] = rewards
        self._is_terminal[slot] = terminated
        self._goes_on[slot] = ~(terminated | truncated)
        self._own.steps += 1
        if self._own.steps >= self._own.n_steps:
            self._compute_returns((slot - self._own.n_steps + 1) % self._slots)

    def _compute_returns(self, slot: int) -> None:
        """Compute the n-step returns of a slot; they end at the end of an episode."""
        gamma = self.transitions.packing.gamma
        self._returns[slot] = self._rewards[slot]
        self._discounts[slot] = gamma * ~self._is_terminal[slot]
        self._next_places[slot] = self._places_of(slot)
        goes_on = self._goes_on[slot].clone()
        for k in range(1, self._own.n_steps):
            later = (slot + k) % self._slots
            self._returns[slot] += gamma**k * goes_on * self._rewards[later]
            discount = gamma ** (k + 1) * ~self._is_terminal[later]
            self._discounts[slot] = torch.where(goes_on, discount, self._discounts[slot])
            self._next_places[slot] = torch.where(
                goes_on, self._places_of(later), self._next_places[slot]
            )
            goes_on &= self._goes_on[later]

    def _places_of(self, slot: int) -> Tensor:
        """Return the frames (K * E,) of a slot's next observations."""
        first = len(self.transitions) + slot * self._width
        return torch.arange(first, first + self._width, device=self._returns.device)


class OwnRows:
    """Rows of the environments of each of K agents.

    Attributes:
        steps: Number of completed slots so far, including those that were replaced.
        n_steps: Number of rewards in a return.
    """

    def __init__(
        self, agents: int, envs: int, slots: int, n_steps: int, device: torch.device, seed: int
    ) -> None:
        """Describe the buffer."""
        self.steps, self.n_steps = 0, n_steps
        self._envs, self._slots, self._width = envs, slots, agents * envs
        self._generator = torch.Generator(device).manual_seed(seed)
        self._first = torch.arange(agents, device=device).unsqueeze(1) * envs

    def draw(self, count: int) -> Tensor:
        """Draw `count` rows for each agent, (K * count,), with one generator for all agents."""
        stored = min(self.steps, self._slots) - self.n_steps + 1
        drawn = torch.randint(
            stored * self._envs,
            (len(self._first), count),
            generator=self._generator,
            device=self._first.device,
        )
        # The last step with a known return has the age 0.
        ages = drawn // self._envs
        slots = (self.steps - self.n_steps - ages) % self._slots
        rows = slots * self._width + self._first + drawn % self._envs
        return rows.flatten()


@dataclass(frozen=True, eq=False, kw_only=True)
class OwnTransitions(TransitionBuffer):
    """Transitions from which each agent draws its own.

    Attributes:
        own: Rows of each agent.
    """

    own: OwnRows

    def draw(self, count: int, generators: Sequence[torch.Generator]) -> Tensor:
        """Draw rows of each agent; the draws of `own` replace those of the generators."""
        return self.own.draw(count)
