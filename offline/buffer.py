"""Transitions as tensors, packed once and drawn from at random."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor

from mcaprl.errors import SpaceError, TrainingError
from mcaprl.offline.networks import box_observations, discrete_actions, observation_tensor

if TYPE_CHECKING:
    from mcaprl.recorder.dataset import Dataset


@dataclass(frozen=True)
class Batch:
    """B transitions.

    Attributes:
        rows: (B,) int64, where they stand in the buffer.
        observations: (B, *shape) float32, or uint8 for images.
        actions: (B,) int64, counted from 0.
        rewards: (B,) float32.
        continues: (B,) float32, 0 where the episode terminated, else 1 (truncated ones too).
        next_observations: like `observations`.
    """

    rows: Tensor
    observations: Tensor
    actions: Tensor
    rewards: Tensor
    continues: Tensor
    next_observations: Tensor


@dataclass(frozen=True, eq=False)
class TransitionBuffer:
    """All transitions of a dataset, in the shapes and dtypes of `Batch`."""

    observation_space: spaces.Box
    action_space: spaces.Discrete
    observations: Tensor
    actions: Tensor
    rewards: Tensor
    continues: Tensor
    next_observations: Tensor

    @classmethod
    def from_dataset(cls, dataset: Dataset) -> TransitionBuffer:
        """Pack a dataset.

        A truncated episode was cut off from outside and would have gone on, so only `terminated`
        ends the return.

        Raises:
            SpaceError: the actions are not discrete, or not in their space, or there is no network
                for the observations.
            TrainingError: there are no transitions, or a number is NaN or infinite.
        """
        action_space = discrete_actions(dataset.action_space)
        observation_space = box_observations(dataset.observation_space)
        if len(dataset.rewards) == 0:
            raise TrainingError("the dataset has no transitions to learn from")
        for column in ("observations", "rewards", "next_observations"):
            _check_finite(column, getattr(dataset, column))
        return cls(
            observation_space=observation_space,
            action_space=action_space,
            observations=observation_tensor(dataset.observations, observation_space),
            actions=torch.from_numpy(_counted_from_zero(dataset.actions, action_space)),
            rewards=torch.from_numpy(dataset.rewards.astype(np.float32)),
            continues=torch.from_numpy((~dataset.terminated).astype(np.float32)),
            next_observations=observation_tensor(dataset.next_observations, observation_space),
        )

    def __len__(self) -> int:
        """The number of transitions."""
        return len(self.rewards)

    def take(self, rows: Tensor) -> TransitionBuffer:
        """The transitions in these (N,) rows, copied."""
        return replace(
            self,
            observations=self.observations.index_select(0, rows),
            actions=self.actions.index_select(0, rows),
            rewards=self.rewards.index_select(0, rows),
            continues=self.continues.index_select(0, rows),
            next_observations=self.next_observations.index_select(0, rows),
        )

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Draw transitions uniformly, with replacement."""
        rows = torch.randint(len(self), (batch_size,), generator=generator)
        return Batch(
            rows=rows,
            observations=self.observations.index_select(0, rows),
            actions=self.actions.index_select(0, rows),
            rewards=self.rewards.index_select(0, rows),
            continues=self.continues.index_select(0, rows),
            next_observations=self.next_observations.index_select(0, rows),
        )


def _check_finite(column: str, values: NDArray[Any]) -> None:
    """One NaN would spoil every weight, so it is named here and not met again as a NaN loss."""
    finite = np.isfinite(values).reshape(len(values), -1).all(1)
    if not finite.all():
        raise TrainingError(f"{column} of row {finite.argmin()} have NaN or infinite numbers")


def _counted_from_zero(actions: NDArray[Any], space: spaces.Discrete) -> NDArray[np.int64]:
    indices = actions.astype(np.int64) - int(space.start)
    if indices.min() < 0 or indices.max() >= space.n:
        raise SpaceError(
            f"the dataset has actions from {actions.min()} to {actions.max()}, "
            f"its action space is {space}"
        )
    return indices
