"""N vehicles of one sim, held as arrays: what its single and its batched environment share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.sims.geometry.compiled import ready

GOING_ON = 0
"""In `Fleet.ends`: the episode is not over."""


class Fleet(ABC):
    """N vehicles that do not meet each other; each starts by itself.

    Attributes:
        count: N.
        observation_space: of one vehicle.
        observation_names: of the numbers in a vector that is observed; none for pictures.
        action_meanings: what each action does.
        step_duration_s: simulated time of one step.
        actions: (N,) what each is to do in the next step; valid ones.
        rewards: (N,) of the last step; 0 at a start.
        ends: (N,) how the last step ended the episodes: `GOING_ON` or an index of `reasons`.
        noise: (N, K) standard normal numbers for the next step, which the environment draws before
            it; K is 0 where nothing in a step is random.
    """

    reasons: ClassVar[tuple[str, ...]]
    """Why an episode ends, by the codes in `ends`."""
    truncates: ClassVar[tuple[bool, ...]]
    """Of each of them, whether it only breaks the episode off."""

    def __init__(
        self,
        count: int,
        observation_space: spaces.Space[Any],
        observation_names: tuple[str, ...],
        action_meanings: tuple[str, ...],
        step_duration_s: float,
        noise_size: int = 0,
    ) -> None:
        """Make the arrays that all fleets have."""
        self.count = count
        self.observation_space = observation_space
        self.observation_names = observation_names
        self.action_meanings = action_meanings
        self.step_duration_s = step_duration_s
        self.actions = np.zeros(count, dtype=np.int64)
        self.rewards = np.zeros(count)
        self.ends = np.zeros(count, dtype=np.int64)
        self.noise = np.zeros((count, noise_size))

    @abstractmethod
    def begin(self, i: int, random: np.random.Generator, options: dict[str, Any] | None) -> None:
        """Start an episode of vehicle i.

        Args:
            i: 0 to N - 1.
            random: all that is drawn is drawn from it.
            options: of `reset`.

        Raises:
            UsageError: `options` has an unknown key, or a pose that cannot be started from.
        """

    def begin_all(self, chosen: NDArray[np.int64], randoms: Sequence[np.random.Generator]) -> None:
        """Start an episode of some vehicles, as `begin` does without options.

        Args:
            chosen: (K,) which.
            randoms: a generator for each of the N vehicles.
        """
        for i in chosen.tolist():
            self.begin(i, randoms[i], None)

    @abstractmethod
    def advance(self) -> None:
        """Take one step with each vehicle, by its number in `actions`."""

    def step_one(self, action: int) -> tuple[Any, float, int, dict[str, Any]]:
        """Take a step with the only vehicle of a fleet of one.

        Args:
            action: a valid one.

        Returns:
            What it observes, its reward, how its episode ended as in `ends`, and its `info`.
        """
        self.actions[0] = action
        self.advance()
        return self.observation(0), self.rewards.item(), self.ends.item(), self.info(0)

    @abstractmethod
    def _kernel(self) -> tuple[Any, ...]:
        """Give the compiled function of a step, and its arguments, which are never replaced."""

    @cached_property
    def _step(self) -> Callable[[], None]:
        """What `_kernel` gives, as machine code; compiled when it is first needed."""
        return ready(*self._kernel())

    def __getstate__(self) -> dict[str, Any]:
        """For copies: all but what looks into this fleet's own arrays, and is made when needed."""
        kind = type(self)
        return {
            name: value
            for name, value in vars(self).items()
            if not isinstance(getattr(kind, name, None), cached_property)
        }

    def imitate(self, i: int, other: Fleet, j: int) -> None:
        """Make vehicle i the same as vehicle j of another fleet of this kind.

        What a fleet knows of its vehicles are arrays with a row for each, and dicts by number of
        what was worked out for some.
        """
        for name, theirs in vars(other).items():
            mine = getattr(self, name)
            if isinstance(theirs, np.ndarray) and theirs.shape[:1] == (other.count,):
                mine[i] = theirs[j]
            elif isinstance(theirs, dict):
                mine.pop(i, None)
                mine |= {i: theirs[j]} if j in theirs else {}

    @abstractmethod
    def observation(self, i: int) -> Any:
        """Give what vehicle i observes, the caller's own."""

    @abstractmethod
    def observations(self) -> Any:
        """Give what all observe, with a leading dimension of N, the caller's own."""

    @abstractmethod
    def places(self) -> NDArray[np.float64]:
        """Give where all are, (N, 2) x and y in the map, metres; the caller's own."""

    @abstractmethod
    def info(self, i: int) -> dict[str, Any]:
        """Give the `info` of vehicle i, without the reason of an end."""

    @abstractmethod
    def infos(self) -> dict[str, NDArray[Any]]:
        """Give the same of all, each an array (N,), the caller's own."""
