"""Transitions as tensors, packed once and drawn from at random.

Each observation is stored once. Next observations, n-step returns and stacks of frames are a matter
of indexes into these frames, worked out when the data are packed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor

from mcaprl.errors import SpaceError, TrainingError, UnknownNameError, UsageError
from mcaprl.offline.batches.observations import ImageInput, ObservationEncoder, Observations

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.dataset import Dataset


DEVICES = ("cpu", "cuda")
_ON_DEVICE = ("frames", "starts", "places", "actions", "returns")


@dataclass(frozen=True)
class Packing:
    """How transitions are made from a log.

    Attributes:
        frame_stack: observations in a row that are seen at once; before an episode's first one
            that one is repeated.
        normalize: bring what networks see to mean 0 and deviation 1.
        gamma: discount within n-step returns, and of what is behind them.
        n_steps: rewards that are added up; fewer at the end of an episode.
    """

    frame_stack: int = 1
    normalize: bool = False
    gamma: float = 1.0
    n_steps: int = 1


@dataclass(frozen=True)
class Batch:
    """R transitions.

    Attributes:
        rows: (R,) int64, where they stand in the buffer.
        observations: R of them.
        actions: (R,) int64, counted from 0.
        rewards: (R,) float32, sums of up to n discounted ones.
        discounts: (R,) float32, gamma to the power of the steps between the two observations; 0
            where the episode terminated (and not where it was truncated).
        next_observations: like `observations`, n steps on.
    """

    rows: Tensor
    observations: Observations
    actions: Tensor
    rewards: Tensor
    discounts: Tensor
    next_observations: Observations


@dataclass(frozen=True, eq=False)
class TransitionBuffer:
    """All N transitions of a dataset, over F frames.

    Attributes:
        encoder: that made the frames.
        action_space: of the log.
        packing: how transitions are made.
        frames: each observation once.
        starts: (F,) int64, the first frame of each frame's episode.
        places: (2, N) int64, the frames of each transition's observation and next observation.
        actions: (N,) int64, counted from 0.
        returns: (2, N) float32, n-step rewards and discounts, see `Batch`.
        drawable: (M,) int64, the rows whose weight is above 0; None if all are.
        cumulative: (M,) float64, their cumulative weights; None if these are equal.
    """

    encoder: ObservationEncoder
    action_space: spaces.Discrete
    packing: Packing
    frames: Observations
    starts: Tensor
    places: Tensor
    actions: Tensor
    returns: Tensor
    drawable: Tensor | None = None
    cumulative: Tensor | None = None

    @classmethod
    def from_dataset(
        cls,
        dataset: Dataset,
        packing: Packing | None = None,
        *,
        encoder: ObservationEncoder | None = None,
        weights: NDArray[np.float64] | None = None,
    ) -> TransitionBuffer:
        """Pack a dataset.

        Args:
            dataset: with discrete actions.
            packing: default: single steps of single frames.
            encoder: of other data, whose normalisation is to be used here; default: a new one.
            weights: (E,) how often each transition of an episode is drawn, relative to others; 0
                is never. Default: all alike.

        Raises:
            SpaceError: the actions are not discrete, or not in their space, or there is no network
                for the observations.
            TrainingError: there are no transitions, a number is NaN or infinite, or a logged
                action was not allowed; or all weights are 0.
        """
        packing = packing or Packing()
        action_space = discrete_actions(dataset.action_space)
        if encoder is None:
            encoder = ObservationEncoder(dataset.observation_space, int(action_space.n))
            if packing.normalize and len(dataset):
                encoder.normalize_to(dataset.frames)
        if len(dataset) == 0:
            raise TrainingError("the dataset has no transitions to learn from")
        lengths = dataset.episode_lengths
        places, returns = _n_step(dataset, packing)
        frames = encoder.encode(dataset.frames)
        actions = _counted_from_zero(dataset.actions, action_space)
        _check_finite("rewards", torch.from_numpy(returns[0]))
        _check_data(dataset, frames, actions)
        buffer = cls(
            encoder=encoder,
            action_space=action_space,
            packing=packing,
            frames=frames,
            starts=torch.from_numpy(_starts(lengths + 1)),
            places=torch.from_numpy(places),
            actions=torch.from_numpy(actions),
            returns=torch.from_numpy(returns),
        )
        return buffer if weights is None else buffer.drawn_by(np.repeat(weights, lengths))

    def __len__(self) -> int:
        """The number of transitions."""
        return len(self.actions)

    @property
    def device(self) -> torch.device:
        """Where the transitions are."""
        return self.actions.device

    def to(self, device: torch.device) -> TransitionBuffer:
        """The same transitions, all of them on another device.

        Rows are drawn on the CPU all the same, so that a seed draws the same ones everywhere.
        """
        parts = {name: getattr(self, name).to(device) for name in _ON_DEVICE}
        return replace(self, **parts)

    def sample_rows(self, count: int, generator: torch.Generator) -> Tensor:
        """Draw (count,) rows with replacement, by their weights, on the CPU."""
        if self.cumulative is None:
            total = len(self) if self.drawable is None else len(self.drawable)
            draws = torch.randint(total, (count,), generator=generator)
        else:
            points = torch.rand(count, generator=generator, dtype=torch.float64)
            draws = torch.searchsorted(self.cumulative, points * self.cumulative[-1], right=True)
            draws.clamp_(max=len(self.cumulative) - 1)
        return draws if self.drawable is None else self.drawable.index_select(0, draws)

    def batch(self, rows: Tensor) -> Batch:
        """The transitions of rows (R,)."""
        here, there = self.places.index_select(1, rows)
        rewards, discounts = self.returns.index_select(1, rows)
        actions = self.actions.index_select(0, rows)
        return Batch(rows, self.observe(here), actions, rewards, discounts, self.observe(there))

    def drawn_by(self, weights: NDArray[np.float64]) -> TransitionBuffer:
        """The same transitions, each drawn by its weight (N,); 0 is never.

        Raises:
            TrainingError: nothing would ever be drawn.
        """
        rows = np.flatnonzero(weights > 0)
        if not len(rows):
            raise TrainingError("no transitions to learn from: all weights are 0")
        above = weights[rows]
        return replace(
            self,
            drawable=None if len(rows) == len(self) else torch.from_numpy(rows),
            cumulative=None if (above == above[0]).all() else torch.from_numpy(above.cumsum()),
        )

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Draw transitions."""
        return self.batch(self.sample_rows(batch_size, generator).to(self.device))

    def observe(self, places: Tensor) -> Observations:
        """What is seen at frames (R,): each frame, with those before it if frames are stacked."""
        count = self.packing.frame_stack
        if count == 1:
            return self.frames.rows(places)
        ages = torch.arange(count - 1, -1, -1, device=places.device)
        stacks = places.unsqueeze(1) - ages
        first = self.starts.index_select(0, places).unsqueeze(1)
        return self.frames.rows(torch.maximum(stacks, first).flatten()).stacked(count)

    @property
    def vector_width(self) -> int:
        """Numbers in the vector that a network sees."""
        return self.encoder.width * self.packing.frame_stack

    @property
    def image_inputs(self) -> list[ImageInput]:
        """How a network takes the pictures that it sees."""
        return [image.stacked(self.packing.frame_stack) for image in self.encoder.image_inputs]


def choose_device(name: str) -> torch.device:
    """Return the device of a name.

    Raises:
        UnknownNameError: The name is not in `DEVICES`.
        UsageError: torch finds no such device on this machine.
    """
    if name not in DEVICES:
        raise UnknownNameError("device", name, DEVICES)
    if name == "cuda" and not torch.cuda.is_available():
        raise UsageError(
            f"device cuda: torch {torch.__version__} finds no CUDA device; install a torch that is"
            " built for CUDA, or omit --device"
        )
    return torch.device(name)


def discrete_actions(space: spaces.Space[Any]) -> spaces.Discrete:
    """The action space, if the algorithms here can learn with it.

    Raises:
        SpaceError: it is not Discrete.
    """
    if not isinstance(space, spaces.Discrete):
        raise SpaceError(f"offline learning needs discrete actions, got {space}")
    return space


def _n_step(dataset: Dataset, packing: Packing) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Places and returns of `TransitionBuffer`: sums of rewards up to n steps or the episode's end.

    Truncation cuts an episode off from outside, so the sum is cut and what is behind it still
    counts; termination ends the return.
    """
    n_rows, lengths = len(dataset), dataset.episode_lengths
    rows = np.arange(n_rows)
    ends = np.repeat(np.cumsum(lengths), lengths)
    ahead = np.minimum(packing.n_steps, ends - rows)
    rewards = np.zeros(n_rows)
    for k in range(packing.n_steps):
        counts = ahead > k
        rewards[counts] += packing.gamma**k * dataset.rewards[rows[counts] + k]
    lasts = rows + ahead - 1
    discounts = np.where(dataset.terminated[lasts], 0.0, packing.gamma ** ahead.astype(float))
    here = dataset.frame_of_step
    places = np.stack([here, here + ahead])
    with np.errstate(over="ignore"):
        return places, np.stack([rewards, discounts]).astype(np.float32)


def _starts(frame_counts: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.repeat(np.cumsum(frame_counts) - frame_counts, frame_counts)


def _check_data(dataset: Dataset, frames: Observations, actions: NDArray[np.int64]) -> None:
    """One NaN would spoil every weight, so it is named here and not met again as a NaN loss."""
    rows = torch.from_numpy(dataset.frame_of_step)
    _check_finite("observations", frames.vector[rows])
    _check_finite("next_observations", frames.vector[rows + 1])
    if frames.mask is not None:
        allowed = frames.mask[rows, torch.from_numpy(actions)]
        if not allowed.all():
            row = int(allowed.int().argmin())
            raise TrainingError(f"action {dataset.actions[row]} of row {row} is masked out there")


def _check_finite(column: str, values: Tensor) -> None:
    finite = values.isfinite().reshape(len(values), -1).all(1)
    if not finite.all():
        row = int(finite.int().argmin())
        raise TrainingError(f"{column} of row {row} have NaN or infinite numbers")


def _counted_from_zero(actions: NDArray[Any], space: spaces.Discrete) -> NDArray[np.int64]:
    indices = actions.astype(np.int64) - int(space.start)
    if indices.min() < 0 or indices.max() >= space.n:
        raise SpaceError(
            f"the dataset has actions from {actions.min()} to {actions.max()}, "
            f"its action space is {space}"
        )
    return indices
