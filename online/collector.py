"""Collection of experience: environments, the choice of actions, and the replay buffer they fill.

The environments are those of a Gymnasium `VectorEnv`, whose wrappers record and show the steps, or
sims whose state stays on a GPU.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from torch import Tensor

from mcaprl.frames import mapped
from mcaprl.offline.algorithms.heads import SquashedGaussian
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.algorithms.losses import mean_values
from mcaprl.offline.batches.observations import ObservationEncoder, Observations
from mcaprl.online.replay import Outcome, ReplayBuffer
from mcaprl.sims import DeviceSims
from mcaprl.sims.evaluation.rollout import episode_seed, log_density, quantile
from mcaprl.sims.vehicle.device import Batch


class Environments(Protocol):
    """W environments, each of which starts a new episode in the step that ends one."""

    def reset(self, seed: int) -> Observations:
        """Start new episodes in all environments."""

    def step(self, actions: Tensor) -> Outcome:
        """Take a step with the actions (W, *shape)."""


@dataclass
class Episodes:
    """Returns and lengths of the last 100 finished episodes, and the number of all."""

    count: int = 0
    returns: deque[float] = field(default_factory=lambda: deque(maxlen=100))
    lengths: deque[int] = field(default_factory=lambda: deque(maxlen=100))


class VectorEnvironments:
    """Environments of a Gymnasium `VectorEnv` with autoreset in the same step."""

    def __init__(self, env: VectorEnv[Any, Any, Any], encoder: ObservationEncoder) -> None:
        """Encode the observations of `env` with `encoder`."""
        self._env, self._encoder = env, encoder
        self.episodes = Episodes()  # Statistics of the finished episodes
        self._returns, self._lengths = np.zeros(env.num_envs), np.zeros(env.num_envs, np.int64)

    def reset(self, seed: int) -> Observations:
        """Start new episodes; environment i gets the seed `episode_seed(seed, i)`."""
        seeds: Any = [episode_seed(seed, i) for i in range(self._env.num_envs)]
        self._returns[:], self._lengths[:] = 0.0, 0
        return self._encoder.encode(self._env.reset(seed=seeds)[0])

    def step(self, actions: Tensor) -> Outcome:
        """Take a step with the actions (W, *shape)."""
        # A copy, because environments may change their arguments.
        result = self._env.step(actions.numpy().copy())
        observations, rewards, terminated, truncated, infos = result
        self._returns += rewards
        self._lengths += 1
        encoded = self._encoder.encode(observations)
        ended = np.flatnonzero(terminated | truncated)
        finals = encoded
        if len(ended):
            self._finish(ended)
            last = [infos["final_obs"][number] for number in ended]
            finals = self._encoder.encode(mapped(lambda *parts: np.stack(parts), *last))
        return Outcome(
            torch.from_numpy(rewards.astype(np.float32)),
            torch.from_numpy(terminated),
            torch.from_numpy(truncated),
            encoded,
            finals,
            torch.from_numpy(ended),
        )

    def _finish(self, ended: NDArray[np.int64]) -> None:
        """Add the episodes of these environments to the statistics."""
        self.episodes.count += len(ended)
        self.episodes.returns.extend(self._returns[ended].tolist())
        self.episodes.lengths.extend(self._lengths[ended].tolist())
        self._returns[ended], self._lengths[ended] = 0.0, 0


class DeviceEnvironments:
    """Sims whose state stays on one device; their seed is that of their constructor."""

    def __init__(self, sims: DeviceSims, device: torch.device) -> None:
        """Share the memory of the sims."""
        self._sims = sims
        self._arrays = Batch(*(torch.as_tensor(array, device=device) for array in sims.batch))

    def reset(self, seed: int) -> Observations:
        """Start new episodes in all environments."""
        self._sims.reset()
        return Observations(self._arrays.observations)

    def step(self, actions: Tensor) -> Outcome:
        """Take a step with the actions (W,)."""
        arrays = self._arrays
        arrays.actions.copy_(actions)
        self._sims.step()
        return Outcome(
            arrays.rewards,
            arrays.terminated,
            arrays.truncated,
            Observations(arrays.observations),
            Observations(arrays.final_observations),
            None,
        )


@dataclass(frozen=True, eq=False)
class Choice:
    """Actions of one step, and what is known about them."""

    actions: Tensor  # (W, *shape) actions of the action space
    # Function that returns the probabilities (W,) of the actions under the behavior policy; for the
    # actions of a Box, the natural logarithms of their densities.
    behavior: Callable[[], Tensor]
    # Values (W, A) of all actions from the forward pass that chose them; None if there was none, or
    # if the actions are not finite in number.
    values: Tensor | None = None


class Behavior(ABC):
    """How the actions of a training are selected."""

    @abstractmethod
    def choose(self, observations: Observations, epsilon: float) -> Choice:
        """Select an action for each of W observations; at `epsilon` 1, all are random."""


class EpsilonGreedy(Behavior):
    """Allowed random actions with probability epsilon in each environment, else the best ones."""

    def __init__(self, learner: Learner, generator: torch.Generator) -> None:
        """Select by the Q-network of `learner`; `generator` is on its device."""
        self._learner, self._generator = learner, generator

    @torch.no_grad()
    def choose(self, observations: Observations, epsilon: float) -> Choice:
        """Select an action for each of W observations."""
        drawn = self._random(observations)
        values = None
        actions = drawn
        if epsilon < 1:
            values = self.values(observations)
            explores = torch.empty(len(drawn), device=drawn.device)
            explores.uniform_(generator=self._generator)
            actions = torch.where(explores < epsilon, drawn, values.argmax(1))
        return Choice(
            actions, lambda: self._probabilities(observations, actions, values, epsilon), values
        )

    def values(self, observations: Observations) -> Tensor:
        """Return the values (W, A) of all actions."""
        return mean_values(self._learner.outputs("q", observations))

    def _random(self, observations: Observations) -> Tensor:
        """Draw allowed actions (W,) uniformly."""
        mask, generator = observations.mask, self._generator
        if mask is None:
            drawn = torch.empty(
                len(observations), dtype=torch.int64, device=observations.vector.device
            )
            return drawn.random_(self._learner.n_actions, generator=generator)
        return torch.multinomial(mask.float(), 1, generator=generator).squeeze(1)

    def _probabilities(
        self, observations: Observations, actions: Tensor, values: Tensor | None, epsilon: float
    ) -> Tensor:
        mask = observations.mask
        count = self._learner.n_actions if mask is None else mask.sum(1)
        by_chance = torch.full((len(actions),), epsilon, dtype=torch.float64) / count
        if values is None:
            return by_chance
        return by_chance + (1 - epsilon) * (actions == values.argmax(1))


class BoxBehavior(Behavior):
    """Random actions of a Box: uniform ones at epsilon 1, else those of a stochastic policy."""

    def __init__(self, learner: Learner, generator: torch.Generator) -> None:
        """Select by the actor of `learner`; `generator` is on the CPU."""
        assert learner.buffer.box is not None
        self._learner, self._box, self._generator = learner, learner.buffer.box, generator

    @torch.no_grad()
    def choose(self, observations: Observations, epsilon: float) -> Choice:
        """Select an action for each of W observations."""
        if epsilon == 1:
            shape = (len(observations), self._box.size)
            numbers = 2 * torch.rand(shape, generator=self._generator) - 1
            return self._choice(numbers, lambda taken: torch.full((len(taken),), self._uniform))
        learner = self._learner
        outputs = learner.models["actor"](learner.inputs(observations))
        numbers = self._drawn(outputs)
        return self._choice(numbers, lambda taken: self._log_density(outputs, taken))

    @abstractmethod
    def _drawn(self, outputs: Tensor) -> Tensor:
        """Draw actions (W, n) in [-1, 1], for outputs of the actor."""

    @abstractmethod
    def _log_density(self, outputs: Tensor, numbers: Tensor) -> Tensor:
        """Return the log densities (W,) of actions (W, n) in [-1, 1]."""

    def _choice(self, numbers: Tensor, log_density: Callable[[Tensor], Tensor]) -> Choice:
        """Return actions in the units of the space, with densities of what the log stores."""
        actions = self._box.unscaled(numbers.numpy())

        def behavior() -> Tensor:
            taken = torch.from_numpy(self._box.scaled(actions).clip(-1, 1))
            return log_density(taken) + self._box.log_scale

        return Choice(torch.from_numpy(actions), behavior)

    @property
    def _uniform(self) -> float:
        """Log density of uniform actions in [-1, 1]."""
        return -self._box.size * math.log(2)


class SquashedSamples(BoxBehavior):
    """Samples of a squashed Gaussian: the exploration of SAC."""

    def _drawn(self, outputs: Tensor) -> Tensor:
        noise = torch.randn((len(outputs), self._box.size), generator=self._generator)
        return SquashedGaussian.sample(outputs, noise)[0]

    def _log_density(self, outputs: Tensor, numbers: Tensor) -> Tensor:
        return SquashedGaussian.log_density(outputs, numbers)


class NoisyActions(BoxBehavior):
    """Actions of a deterministic actor with Gaussian noise, truncated to the Box: that of TD3."""

    def __init__(self, learner: Learner, generator: torch.Generator, noise: float) -> None:
        """Add noise with this standard deviation to numbers in [-1, 1]."""
        super().__init__(learner, generator)
        self._noise = noise

    def _drawn(self, outputs: Tensor) -> Tensor:
        share = torch.rand(outputs.shape, generator=self._generator, dtype=torch.float64)
        drawn = quantile(share.numpy(), self._means(outputs), self._noise, -1.0, 1.0)
        return torch.from_numpy(drawn)

    def _log_density(self, outputs: Tensor, numbers: Tensor) -> Tensor:
        taken = numbers.double().numpy()
        found = log_density(taken, self._means(outputs), self._noise, -1.0, 1.0)
        return torch.from_numpy(found.sum(1))

    @staticmethod
    def _means(outputs: Tensor) -> NDArray[np.float64]:
        means: NDArray[np.float64] = outputs.tanh().double().numpy()
        return means


class Collector:
    """Steps environments and stores their transitions in a replay buffer."""

    def __init__(
        self, environments: Environments, buffer: ReplayBuffer, behavior: Behavior
    ) -> None:
        """Connect the parts; call `begin` before the first step."""
        self.environments, self.buffer, self._behavior = environments, buffer, behavior
        # Called with the choice of each step before the environments take it.
        self.before_step: Callable[[Choice], None] = lambda choice: None

    def begin(self, seed: int) -> None:
        """Start new episodes in all environments; those that were going on are truncated."""
        self.buffer.begin(self.environments.reset(seed))

    def step(self, epsilon: float) -> Outcome:
        """Select actions, step the environments, and store the transitions."""
        choice = self._behavior.choose(self.buffer.now(), epsilon)
        self.before_step(choice)
        outcome = self.environments.step(choice.actions)
        self.buffer.add(choice.actions, outcome)
        return outcome
