"""Transitions as tensors, packed once and sampled at random.

Each observation is stored once, as a frame. Transitions refer to frames by index. The indexes and
the n-step returns are computed when the data are packed. Frame stacks are built when a batch is
read.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor

from mcaprl.actions import MASK_KEY, BoxActions, JointActions, joint_actions, part_name
from mcaprl.errors import SpaceError, TrainingError, UnknownNameError, UsageError
from mcaprl.frames import frame_rows
from mcaprl.networks import ImageInput
from mcaprl.offline.batches.items import n_step_returns, returns_to_go
from mcaprl.offline.batches.observations import FramesOnDisk, ObservationEncoder, Observations
from mcaprl.offline.batches.packing import Packing
from mcaprl.offline.batches.relative import RelativeActions
from mcaprl.recorder.dataset.arrays import is_beyond_float32
from mcaprl.recorder.format.spaces import check_actions
from mcaprl.texts import counted

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.dataset import Dataset


DEVICES = ("cpu", "cuda")
MAX_JOINT_ACTIONS = 1_024  # Largest number of combinations of a MultiDiscrete or MultiBinary space
_BLOCK_ROWS = 1 << 18  # Rows that are checked at once
_ON_DEVICE = ("frames", "starts", "places", "actions", "returns", "next_rows", "ends")


@dataclass(frozen=True)
class Batch:
    """Batch of R transitions.

    Attributes:
        rows: (R,) int64, row numbers in the buffer.
        observations: R observations.
        actions: (R,) int64 action indexes, starting at 0; of a Box (R, n) float32, scaled to
            [-1, 1].
        rewards: (R,) float32, discounted sums of up to n rewards, divided by the buffer's
            `reward_scale`.
        discounts: (R,) float32, gamma to the power of the number of steps between the two
            observations; 0 if the episode terminated, but not if it was truncated.
        next_observations: R observations, up to n steps later.
    """

    rows: Tensor
    observations: Observations
    actions: Tensor
    rewards: Tensor
    discounts: Tensor
    next_observations: Observations


@dataclass(frozen=True, eq=False)
class TransitionBuffer:
    """All N transitions of a dataset, with their F frames.

    Attributes:
        encoder: Encoder that created the frames.
        action_space: Action space of the log; the values of a finite space are numbered, see
            `joint`, and those of a Box are scaled, see `box`.
        packing: Settings with which the transitions were built.
        frames: All observations, each stored once; images of a mapped dataset stay on disk.
        starts: (F,) int64, first frame of each frame's episode; empty if frames are not stacked.
        places: (2, N) int64, frame indexes of each transition's observation and next observation.
        actions: (N,) int64 action indexes, starting at 0; of a Box (N, n) float32, scaled to
            [-1, 1].
        returns: (2, N) float32, n-step rewards and discounts; see `Batch`.
        reward_scale: Divisor of the rewards in `returns`.
        drawable: (M,) int64, rows with a weight above 0; None if all weights are above 0.
        cumulative: (M,) float64, cumulative weights of the drawable rows; None if the weights are
            equal.
        is_fixed: Whether the transitions stay the same during training.
        box: Scaling of the actions of a Box; None for a finite space.
        next_rows: (N,) int64, row of the transition that starts at each transition's next
            observation; -1 at the end of an episode. Empty for a finite space.
        ends: (N,) int64, row after the last one of each row's episode; empty without chunks.
        relative: Conversion of chunks to relative numbers; None if all actions are absolute.
    """

    encoder: ObservationEncoder
    action_space: spaces.Space[Any]
    packing: Packing
    frames: Observations | FramesOnDisk
    starts: Tensor
    places: Tensor
    actions: Tensor
    returns: Tensor
    reward_scale: float = 1.0
    drawable: Tensor | None = None
    cumulative: Tensor | None = None
    is_fixed: bool = True
    box: BoxActions | None = None
    next_rows: Tensor = field(default_factory=lambda: torch.empty(0, dtype=torch.int64))
    ends: Tensor = field(default_factory=lambda: torch.empty(0, dtype=torch.int64))
    relative: RelativeActions | None = None

    @classmethod
    def from_dataset(
        cls,
        dataset: Dataset,
        packing: Packing | None = None,
        *,
        encoder: ObservationEncoder | None = None,
        reward_scale: float | None = None,
        box: BoxActions | None = None,
        relative: RelativeActions | None = None,
        weights: NDArray[np.float64] | None = None,
    ) -> TransitionBuffer:
        """Pack a dataset.

        Args:
            dataset: Dataset with actions of a finite space or of a Box.
            packing: Settings for building transitions; default: single steps and single frames.
            encoder: Encoder of other data, whose normalization is reused; default: a new one.
            reward_scale: Divisor of the rewards; default: see `packing.scale_rewards`.
            box: Scaling of the actions of a Box; default: by the bounds of the space, and by the
                data where they are infinite, with a warning.
            relative: Ranges of relative actions of other data; default: those of the episodes whose
                weight is above 0.
            weights: (E,) relative sampling weight of each transition of an episode; default: all
                equal.

        Raises:
            SpaceError: The actions are outside their space or never change, or no network supports
                the space or the observations.
            TrainingError: There are no transitions, a number is NaN or infinite, a logged action
                was not allowed, or all weights are 0.
        """
        packing = packing or Packing()
        is_box = isinstance(dataset.action_space, spaces.Box)
        joint = None if is_box else discrete_actions(dataset.action_space)
        encoder = encoder or _new_encoder(dataset, packing, joint.count if joint else 0)
        if len(dataset) == 0:
            raise TrainingError("the dataset has no transitions to learn from")
        lengths = dataset.episode_lengths
        _check_rewards(dataset.rewards)
        if reward_scale is None:
            spread = packing.scale_rewards and return_spread(dataset, packing.gamma)
            reward_scale = spread or 1.0
        places, returns = n_step_returns(dataset, packing.n_steps, packing.gamma)
        returns[0] /= reward_scale
        frames = encoder.encode_frames(dataset.frames)
        if joint is None:
            box = box or _box_of(dataset, packing)
            actions = torch.from_numpy(_scaled(dataset, box, packing))
        else:
            actions = torch.from_numpy(_numbered(dataset, joint))
        _require_finite("sums of rewards", _is_finite(torch.from_numpy(returns[0])))
        _check_data(dataset, frames, actions)
        is_relative = packing.relative and any(each is not None for each in dataset.relative_to)
        ends = torch.from_numpy(np.repeat(np.cumsum(lengths), lengths))
        if is_relative and relative is None:
            assert box is not None, "only actions of a Box are relative"
            used = np.ones(len(dataset)) if weights is None else np.repeat(weights, lengths)
            rows = torch.from_numpy(np.flatnonzero(used > 0))
            states = frames.vector.index_select(0, torch.from_numpy(places[0]))
            relative = RelativeActions.fitted(
                dataset.relative_to, encoder, box, actions, states, ends, rows, packing.chunk
            )
        buffer = cls(
            encoder=encoder,
            action_space=dataset.action_space,
            packing=packing,
            frames=frames,
            starts=_first_frames(lengths + 1, packing.frame_stack),
            places=torch.from_numpy(places),
            actions=actions,
            returns=torch.from_numpy(returns),
            reward_scale=reward_scale,
            box=box,
            next_rows=_next_rows(lengths, packing.n_steps if is_box else 0),
            ends=ends if packing.chunk > 1 or is_relative else ends[:0],
            relative=relative if is_relative else None,
        )
        return buffer if weights is None else buffer.with_weights(np.repeat(weights, lengths))

    def __len__(self) -> int:
        """Return the number of transitions."""
        return len(self.actions)

    @cached_property
    def joint(self) -> JointActions:
        """Numbering of the actions of a finite space: `actions` has the numbers."""
        return discrete_actions(self.action_space)

    @property
    def n_actions(self) -> int:
        """Number of actions of a finite space, A; length of an action of a Box, n."""
        return self.joint.count if self.box is None else self.box.size

    @property
    def device(self) -> torch.device:
        """Device of the transitions."""
        return self.actions.device

    def to(self, device: torch.device) -> TransitionBuffer:
        """Return the same transitions on another device.

        Rows are still drawn on the CPU, so a seed draws the same rows for every device.
        """
        parts = {name: getattr(self, name).to(device) for name in _ON_DEVICE}
        relative = None if self.relative is None else copy.deepcopy(self.relative).to(device)
        return replace(self, **parts, relative=relative)

    def sample_rows(self, count: int, generator: torch.Generator) -> Tensor:
        """Draw row numbers (count,) on the CPU, with replacement, in proportion to the weights."""
        if self.cumulative is None:
            total = len(self) if self.drawable is None else len(self.drawable)
            draws = torch.randint(total, (count,), generator=generator)
        else:
            points = torch.rand(count, generator=generator, dtype=torch.float64)
            draws = torch.searchsorted(self.cumulative, points * self.cumulative[-1], right=True)
            draws.clamp_(max=len(self.cumulative) - 1)
        return draws if self.drawable is None else self.drawable.index_select(0, draws)

    def draw(self, count: int, generators: Sequence[torch.Generator]) -> Tensor:
        """Draw `count` row numbers for each of K seeds, (K * count,)."""
        return torch.cat([self.sample_rows(count, one) for one in generators])

    def batch(self, rows: Tensor) -> Batch:
        """Return the transitions of rows (R,)."""
        here, there = self.places.index_select(1, rows)
        rewards, discounts = self.returns.index_select(1, rows)
        actions = self.actions.index_select(0, rows)
        if isinstance(self.frames, FramesOnDisk):
            # Reading both at once from the disk takes half the time.
            states = self.observe(torch.cat((here, there))).split(len(rows))
        else:
            states = [self.observe(here), self.observe(there)]
        return Batch(rows, states[0], actions, rewards, discounts, states[1])

    def chunks(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return the actions of rows (R,) and of the steps after them, and which of them exist.

        Returns:
            Actions (R, H) or (R, H, n), and a mask (R, H), bool. After the end of the episode, the
            last action is repeated, and the mask is False.
        """
        steps = torch.arange(self.packing.chunk, device=rows.device)
        every, ends = rows.unsqueeze(1) + steps, self.ends.index_select(0, rows).unsqueeze(1)
        found = self.actions.index_select(0, torch.minimum(every, ends - 1).flatten())
        return found.view(*every.shape, *self.actions.shape[1:]), every < ends

    def with_weights(self, weights: NDArray[np.float64]) -> TransitionBuffer:
        """Return the same transitions with relative sampling weights (N,).

        Raises:
            TrainingError: All weights are 0.
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
        """Draw a batch of transitions."""
        return self.batch(self.sample_rows(batch_size, generator).to(self.device))

    def observe(self, places: Tensor) -> Observations:
        """Return the network inputs at frames (R,), stacked with earlier frames if configured."""
        count = self.packing.frame_stack
        if count == 1:
            return self.frames.rows(places)
        ages = torch.arange(count - 1, -1, -1, device=places.device)
        rows = frame_rows(places, self.starts.index_select(0, places), ages)
        return self.frames.rows(rows.flatten()).stacked(count)

    @property
    def vector_width(self) -> int:
        """Length of a network's input vector."""
        return self.encoder.width * self.packing.frame_stack

    @property
    def image_inputs(self) -> list[ImageInput]:
        """Shape and normalization of each image that a network receives."""
        return [image.stacked(self.packing.frame_stack) for image in self.encoder.image_inputs]


def return_spread(dataset: Dataset, gamma: float) -> float:
    """Return the standard deviation of all discounted returns; 0 if a reward is not finite."""
    # A return ends at the end of the episode, even if the episode was truncated.
    with np.errstate(over="ignore", invalid="ignore"):
        returns = returns_to_go(dataset.rewards, dataset.episode_lengths, gamma)
        spread = float(returns.std())
    return spread if math.isfinite(spread) else 0.0


def choose_device(name: str) -> torch.device:
    """Return the torch device with this name."""
    if name not in DEVICES:
        raise UnknownNameError("device", name, DEVICES)
    if name == "cuda" and not torch.cuda.is_available():
        raise UsageError(
            f"device cuda: torch {torch.__version__} finds no CUDA device; install a torch that is"
            " built for CUDA, or omit `device=`"
        )
    return torch.device(name)


def discrete_actions(space: spaces.Space[Any], what: str = "this policy") -> JointActions:
    """Return the numbering of a space's joint actions; `what` needs it, for the message."""
    joint = joint_actions(space)
    if joint is None:
        raise SpaceError(f"{what} needs discrete actions, got {space}")
    check_actions(space)
    if joint.shape and joint.count > MAX_JOINT_ACTIONS:
        raise SpaceError(
            f"{space} has {counted(joint.count, 'combination')} of actions; offline learning uses"
            f" at most {MAX_JOINT_ACTIONS:,}: record with fewer or coarser actions"
        )
    return joint


def _numbered(dataset: Dataset, joint: JointActions) -> NDArray[np.int64]:
    """Return the numbers (N,) of the logged actions of a finite space."""
    if not joint.contain(dataset.actions).all():
        raise SpaceError(
            f"the dataset has actions from {dataset.actions.min()} to {dataset.actions.max()},"
            f" but its action space is {dataset.action_space}"
        )
    return joint.indexes(dataset.actions)


def _new_encoder(dataset: Dataset, packing: Packing, n_actions: int) -> ObservationEncoder:
    encoder = ObservationEncoder(dataset.observation_space, n_actions)
    if packing.normalize and len(dataset):
        encoder.normalize_to(dataset.frames)
    elif packing.center_images and len(dataset):
        encoder.center_images(dataset.frames)
    return encoder


def _box_of(dataset: Dataset, packing: Packing) -> BoxActions:
    """Return the scaling of the logged actions of a Box; warn if the data replace its bounds."""
    space = dataset.action_space
    assert isinstance(space, spaces.Box)
    _require_finite("actions", _is_finite(torch.from_numpy(np.asarray(dataset.actions))))
    names = dataset.action_part_names
    actions = np.clip(dataset.actions, space.low, space.high)
    box = BoxActions.of(space, actions, names)
    unbounded = np.isinf([space.low.ravel(), space.high.ravel()]).any(0)
    if unbounded.any():
        ranges = ", ".join(
            f"{part_name(part, names)} {box.low[part]:g} to {box.high[part]:g}"
            for part in np.flatnonzero(unbounded).tolist()
        )
        warnings.warn(
            f"{space} has infinite bounds: the policy's actions stay in the range of the data:"
            f" {ranges}",
            stacklevel=3,
        )
    return box


def _scaled(dataset: Dataset, box: BoxActions, packing: Packing) -> NDArray[np.float32]:
    """Return the logged actions of a Box as numbers (N, n) in [-1, 1]."""
    if MASK_KEY in getattr(dataset.observation_space, "spaces", ()):
        raise SpaceError(
            f"the observations have an {MASK_KEY}, but {box.space} has no numbered actions: remove"
            " the mask from the observations, or record numbered actions"
        )
    actions = np.asarray(dataset.actions)
    _require_finite("actions", _is_finite(torch.from_numpy(actions)))
    outside = ~box.contain(actions)
    if outside.any() and not packing.clip_actions:
        row = int(outside.argmax())
        low, high, flat = box.space.low.ravel(), box.space.high.ravel(), actions[row].ravel()
        part = int(((flat < low) | (flat > high)).argmax())
        name = part_name(part, dataset.action_part_names)
        raise SpaceError(
            f"{name} of row {row} is {flat[part]:g}, outside its bounds {low[part]:g} to"
            f" {high[part]:g}, as are the actions of {counted(int(outside.sum()), 'row')}; to clip"
            " actions to their bounds: `clip_actions=True`"
        )
    return box.scaled(actions).clip(-1, 1)


def _next_rows(lengths: NDArray[np.int64], n_steps: int) -> Tensor:
    """Return the row after n steps of each transition, -1 beyond its episode; empty for 0 steps."""
    if not n_steps:
        return torch.empty(0, dtype=torch.int64)
    rows = np.arange(lengths.sum()) + n_steps
    return torch.from_numpy(np.where(rows < np.repeat(np.cumsum(lengths), lengths), rows, -1))


def _first_frames(counts: NDArray[np.int64], frame_stack: int) -> Tensor:
    """Return the first frame of each frame's episode (counts E,); empty without stacks."""
    if frame_stack == 1:
        return torch.empty(0, dtype=torch.int64)
    return torch.from_numpy(np.repeat(np.cumsum(counts) - counts, counts))


def _check_data(dataset: Dataset, frames: Observations | FramesOnDisk, actions: Tensor) -> None:
    """Raise if a number is not finite or a logged action is masked out."""
    # All at once, the comparison would need more memory than the frames.
    finite = torch.cat([_is_finite(block) for block in torch.split(frames.vector, _BLOCK_ROWS)])
    if not finite.all():
        rows = torch.from_numpy(dataset.frame_of_step)
        _require_finite("observations", finite[rows])
        _require_finite("next_observations", finite[rows + 1])
    if frames.mask is not None:
        rows = torch.from_numpy(dataset.frame_of_step)
        allowed = frames.mask[rows, actions]
        if not allowed.all():
            row = int(allowed.int().argmin())
            raise TrainingError(f"action {dataset.actions[row]} of row {row} is masked out")


def _check_rewards(rewards: NDArray[np.float64]) -> None:
    """Raise if a reward is not finite, or too large for float32."""
    _require_finite("rewards", torch.from_numpy(np.isfinite(rewards)))
    beyond = is_beyond_float32(rewards)
    if beyond.any():
        row = int(beyond.argmax())
        raise TrainingError(f"reward {rewards[row]:g} of row {row} is beyond float32")


def _is_finite(values: Tensor) -> Tensor:
    """Return for each row whether all of its numbers are finite."""
    return values.isfinite().reshape(len(values), -1).all(1)


def _require_finite(column: str, finite: Tensor) -> None:
    if not finite.all():
        row = int(finite.int().argmin())
        raise TrainingError(f"{column} of row {row} have NaN or infinite numbers")
