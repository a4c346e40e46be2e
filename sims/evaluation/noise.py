"""Gaussian noise on the commands of a policy, with the exact density of the noisy actions."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.base_policy import BasePolicy, RandomPolicy
from mcaprl.errors import UsageError

Floats = NDArray[np.float64]
_QUANTILE = np.vectorize(NormalDist().inv_cdf, otypes=[np.float64])
_ERF = np.vectorize(math.erf, otypes=[np.float64])
_SMALLEST = 1e-6
"""Smallest standard deviation of an episode, as a fraction of `noise`."""


class NoisyPolicy(BasePolicy):
    """Policy that adds Gaussian noise to the command of a deterministic policy.

    Each part of an action has the normal distribution around the command, truncated to the bounds
    of the action space. Clipped noise would have a positive probability of the bounds themselves,
    hence no density there. A command at a bound leaves half of the distribution. The random numbers
    of an episode depend only on the seed of `seed`.
    """

    is_deterministic = False

    def __init__(
        self,
        policy: BasePolicy,
        noise: float,
        action_space: spaces.Space[Any],
        *,
        per_episode: bool = False,
    ) -> None:
        """Add noise to the commands of `policy`.

        Args:
            policy: Deterministic policy.
            noise: Standard deviation as a fraction of half the range of each part, above 0.
            action_space: Bounded Box of floats.
            per_episode: Whether the standard deviation of each episode is drawn uniformly between 0
                and `noise`. Densities are those for the standard deviation that was drawn.

        Raises:
            UsageError: The policy has no command, or the actions have no density.
        """
        if not policy.is_deterministic or isinstance(policy, RandomPolicy):
            raise UsageError(
                f"`noise=` is added to the commands of a deterministic policy, not of {policy.name}"
            )
        if not (isinstance(action_space, spaces.Box) and action_space.dtype.kind == "f"):
            raise UsageError(
                f"`noise=` needs a Box of floats, not {action_space}: use `epsilon=`, or continuous"
                " actions"
            )
        if not action_space.is_bounded():
            raise UsageError(f"`noise=` needs finite bounds, not {action_space}")
        self.name = noisy_name(policy.name, noise, per_episode=per_episode)
        self.action_space, self.mask_from = action_space, policy.mask_from
        self.observation_space = policy.observation_space
        self._policy, self._noise, self._per_episode = policy, noise, per_episode
        self._low, self._high = (
            bound.astype(np.float64) for bound in (action_space.low, action_space.high)
        )
        self._last: tuple[Any, Floats] | None = None
        self.seed(0)

    def seed(self, seed: int) -> None:
        """Seed the noise of the episodes that begin from now on."""
        self._random = np.random.default_rng([seed, 2])

    def begin(self) -> None:
        """Start an episode: reset the policy's memory and draw the standard deviation."""
        self._policy.begin()
        self._last = None
        share = max(self._random.random(), _SMALLEST) if self._per_episode else 1.0
        self._sigma = share * self._noise * (self._high - self._low) / 2

    def act(self, observations: Any) -> NDArray[Any]:
        """Return noisy actions (B, *shape)."""
        mean = self._means(observations)
        drawn = quantile(self._random.random(mean.shape), mean, self._sigma, *self._bounds)
        assert self.action_space is not None
        actions: NDArray[Any] = drawn.astype(self.action_space.dtype)
        return actions

    def log_prob(self, observations: Any, actions: NDArray[Any]) -> Floats:
        """Return the log densities (B,) of actions (B, *shape), for the episode's deviation.

        The observations of the last call of `act` do not run the policy again.
        """
        last = self._last
        is_last = last is not None and last[0] is observations
        mean = last[1] if last is not None and is_last else self._means(observations)
        found = log_density(np.asarray(actions, np.float64), mean, self._sigma, *self._bounds)
        total: Floats = found.reshape(len(found), -1).sum(1)
        return total

    @property
    def _bounds(self) -> tuple[Floats, Floats]:
        return self._low, self._high

    def _means(self, observations: Any) -> Floats:
        """Return the commands (B, *shape), and store them for `log_prob`."""
        commands = np.asarray(self._policy.act(observations), np.float64)
        mean: Floats = np.clip(commands, *self._bounds)
        self._last = observations, mean
        return mean


def quantile(
    share: Floats, mean: Floats, sigma: Floats | float, low: Floats | float, high: Floats | float
) -> Floats:
    """Return the quantiles of normal distributions truncated to [low, high].

    Uniform numbers from 0 to 1 as `share` draw numbers with the density of `log_density`.
    """
    first, last = (_probability((bound - mean) / sigma) for bound in (low, high))
    shares = np.clip(first + (last - first) * share, 1e-16, 1 - 1e-16)
    found: Floats = np.clip(mean + sigma * _QUANTILE(shares), low, high)
    return found


def log_density(
    actions: Floats,
    mean: Floats,
    sigma: Floats | float,
    low: Floats | float,
    high: Floats | float,
) -> Floats:
    """Return the log densities of numbers under normal distributions truncated to [low, high].

    The density is phi(z) / (sigma (Phi(b) - Phi(a))), where z, a and b are the standardized number
    and bounds. A number outside of the bounds has the log density -inf.
    """
    z = (actions - mean) / sigma
    inside = _probability((high - mean) / sigma) - _probability((low - mean) / sigma)
    found = -0.5 * z * z - np.log(math.sqrt(2 * math.pi) * sigma * inside)
    return np.where((actions >= low) & (actions <= high), found, -np.inf)


def _probability(z: Floats) -> Floats:
    """Return the normal distribution function Phi(z)."""
    found: Floats = 0.5 * (1.0 + _ERF(z / math.sqrt(2.0)))
    return found


def noisy_name(policy: str, noise: float, *, per_episode: bool) -> str:
    """Return the name of a policy with noise.

    >>> noisy_name("pilot", 0.1, per_episode=True), noisy_name("pilot", 0.0, per_episode=False)
    ('pilot, noise 0 to 0.1', 'pilot')
    """
    return f"{policy}, noise {'0 to ' if per_episode else ''}{noise:g}" if noise else policy
