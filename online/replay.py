"""Replay buffer: the last transitions of agents in training, as the data of a `Learner`.

Each observation is stored once: the next observation of a step is that of the following step. Only
the last observation of an episode is stored separately. Images are stored in the size to which the
network averages them. The n-step returns of earlier steps grow with each reward, so all stored
transitions can be drawn at any time.

The images of a batch may be shifted at random, which reduces overfitting ("Image Augmentation Is
All You Need", https://arxiv.org/abs/2004.13649).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, cast

import torch
from gymnasium import spaces
from torch import Tensor

from mcaprl.actions import BoxActions
from mcaprl.architecture import Architecture
from mcaprl.offline.batches.buffer import Batch, TransitionBuffer
from mcaprl.offline.batches.observations import ObservationEncoder, Observations
from mcaprl.offline.batches.packing import Packing
from mcaprl.recorder.dataset.dataset import Dataset


@dataclass(frozen=True, eq=False)
class Outcome:
    """Outcome of one step of W environments that reset themselves when an episode ends."""

    rewards: Tensor  # (W,) float32
    terminated: Tensor  # (W,) bool
    truncated: Tensor  # (W,) bool
    # W observations, the first ones of new episodes where an episode ended.
    observations: Observations
    finals: Observations  # Last observations of the episodes that ended
    # (E,) int64, environments of `finals`; None if `finals` has a row for each.
    ended: Tensor | None


@dataclass
class _Counts:
    """What changes besides the tensors: completed slots so far, and the shift of the next batch."""

    steps: int = 0
    shifts: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class ReplayBuffer(TransitionBuffer):
    """The last transitions of K agents with E environments each; each agent draws its own.

    A slot holds one step of all W = K * E environments, ordered by agent; there are S slots. A new
    step replaces the oldest slot. Row `slot * W + environment` has the transition of a step, and
    the frame with this number its observation. The frame `S * W + row` is the last observation of
    an episode that ended with the transition `row`. The newest slot has observations only.
    """

    agents: int  # Number of agents K
    slots: int  # Number of slots S
    # Number of the newest slots from which transitions are drawn. More slots are stored, so that
    # the frame stacks of these are complete.
    capacity: int
    goes_on: Tensor  # (S, W) bool, whether the episode continues after the transition
    ages: Tensor  # (S, W) int64, number of earlier frames in the stack of each observation
    # Factor by which the images of each camera are averaged when they are stored.
    pools: tuple[int, ...]
    image_shift: int  # Largest shift of the images in a batch, in pixels of the stored size
    generator: torch.Generator  # Generator of the draws and shifts, on the device of the buffer
    counts: _Counts

    @classmethod
    def allocate(
        cls,
        encoder: ObservationEncoder,
        action_space: spaces.Space[Any],
        packing: Packing,
        architecture: Architecture,
        *,
        agents: int,
        envs: int,
        size: int,
        device: torch.device,
        seed: int,
        image_shift: int = 0,
    ) -> ReplayBuffer:
        """Reserve the memory. On a CPU, the operating system allocates it when it is filled."""
        width = agents * envs
        capacity = max(size // envs, 1)
        slots = max(capacity + packing.frame_stack, packing.n_steps + 1)
        rows = slots * width
        shapes = [image.shape for image in encoder.image_inputs]
        pools = tuple(architecture.encoder_of(shape).pool(shape) for shape in shapes)

        def zeros(*shape: int, dtype: torch.dtype) -> Tensor:
            return torch.zeros(shape, dtype=dtype, device=device)

        images = [
            zeros(2 * rows, height // pool, width_ // pool, channels, dtype=torch.uint8)
            for (height, width_, channels), pool in zip(shapes, pools, strict=True)
        ]
        mask = None
        if encoder.mask is not None:
            mask = zeros(2 * rows, *encoder.mask.shape, dtype=torch.bool)
        vectors = zeros(2 * rows, encoder.width, dtype=torch.float32)
        box = BoxActions.of(action_space) if isinstance(action_space, spaces.Box) else None
        if box is None:
            actions = zeros(rows, dtype=torch.int64)
        else:
            actions = zeros(rows, box.size, dtype=torch.float32)
        return cls(
            encoder=encoder,
            action_space=action_space,
            packing=packing,
            frames=Observations(vectors, tuple(images), mask),
            starts=zeros(0, dtype=torch.int64),
            places=torch.arange(2 * rows, device=device).view(2, rows),
            actions=actions,
            box=box,
            returns=zeros(2, rows, dtype=torch.float32),
            is_fixed=False,
            agents=agents,
            slots=slots,
            capacity=capacity,
            goes_on=zeros(slots, width, dtype=torch.bool),
            ages=zeros(slots, width, dtype=torch.int64),
            pools=pools,
            image_shift=image_shift if images else 0,
            generator=torch.Generator(device).manual_seed(seed),
            counts=_Counts(),
        )

    @property
    def width(self) -> int:
        """Number of environments W of all agents."""
        return self.goes_on.shape[1]

    @property
    def steps(self) -> int:
        """Number of completed slots so far, including those that were replaced."""
        return self.counts.steps

    @property
    def stored(self) -> int:
        """Number of slots from which transitions are drawn."""
        return min(self.steps, self.capacity)

    def begin(self, observations: Observations) -> None:
        """Start episodes in all environments with W observations; open ones count as truncated."""
        if self.steps:
            self._truncate()
        slot = self.steps % self.slots
        self._put(slot * self.width, observations)
        self.ages[slot] = 0

    def now(self) -> Observations:
        """Return the network inputs for the W newest observations, stored at the same size."""
        first = self.steps % self.slots * self.width
        if self.packing.frame_stack == 1:
            assert isinstance(self.frames, Observations)
            parts = [part[first : first + self.width] for part in self.frames.parts()]
            return self.frames.like(parts)
        return self.observe(torch.arange(first, first + self.width, device=self.device))

    def add(self, actions: Tensor, outcome: Outcome) -> None:
        """Add a step of all environments: actions (W, *shape) of the space, and what followed."""
        if self.box is not None:
            actions = torch.from_numpy(self.box.scaled(actions.numpy()).clip(-1, 1))
        slot, following = self.steps % self.slots, (self.steps + 1) % self.slots
        over = outcome.terminated | outcome.truncated
        finals = self._finals_of(slot)
        if outcome.ended is None:
            self._put(finals, outcome.finals)
        elif len(outcome.ended):
            self._put(finals, outcome.finals, outcome.ended)
        self._put(following * self.width, outcome.observations)
        if self.packing.frame_stack > 1:
            ages = (self.ages[slot] + 1).clamp_(max=self.packing.frame_stack - 1)
            self.ages[following] = ages.masked_fill_(over, 0)
        of_slot = torch.arange(self.width, device=self.device)
        places = torch.where(over, finals + of_slot, following * self.width + of_slot)
        self.actions.view(self.slots, self.width, *self.actions.shape[1:])[slot] = actions
        self._returns[0, slot] = outcome.rewards
        self._returns[1, slot] = self.packing.gamma * ~outcome.terminated
        self._next_places[slot] = places
        self.goes_on[slot] = ~over
        self._extend_returns(slot, outcome.rewards, outcome.terminated, places)
        self.counts.steps += 1

    def draw(self, count: int, generators: Sequence[torch.Generator]) -> Tensor:
        """Draw `count` rows for each agent, (K * count,), with one generator for all agents."""
        envs, device = self.width // self.agents, self.device
        draw = partial(torch.randint, generator=self.generator, device=device)
        drawn = draw(self.stored * envs, (self.agents, count))
        if self.image_shift:
            shifts = draw(-self.image_shift, self.image_shift + 1, (2, 2)).tolist()
            self.counts.shifts = tuple(map(tuple, shifts))
        slots = (self.steps - 1 - drawn // envs) % self.slots
        first = torch.arange(self.agents, device=device).unsqueeze(1) * envs
        rows: Tensor = slots * self.width + first + drawn % envs
        return rows.flatten()

    def batch(self, rows: Tensor) -> Batch:
        """Return the transitions of rows (R,), with the shift of the last draw."""
        return self._augmented(super().batch(rows))

    def _augmented(self, batch: Batch) -> Batch:
        """Shift the images of a batch by the shift of the last draw."""
        if not self.image_shift:
            return batch
        here, there = self.counts.shifts
        return replace(
            batch,
            observations=_shifted(batch.observations, *here),
            next_observations=_shifted(batch.next_observations, *there),
        )

    def observe(self, places: Tensor) -> Observations:
        """Return the network inputs at frames (R,), stacked with earlier frames if configured."""
        count = self.packing.frame_stack
        if count == 1:
            return self.frames.rows(places)
        rows = len(self.actions)
        is_final = places >= rows
        after = places - rows * is_final
        # The last observation of an episode follows the frame of its last transition.
        back = torch.arange(count - 1, -1, -1, device=places.device) - is_final.unsqueeze(1).long()
        known = self.ages.view(-1).index_select(0, after).unsqueeze(1)
        slots = (after // self.width).unsqueeze(1) - torch.minimum(back.clamp(min=0), known)
        frames = slots % self.slots * self.width + (after % self.width).unsqueeze(1)
        frames = torch.where(back < 0, places.unsqueeze(1), frames)
        return self.frames.rows(frames.flatten()).stacked(count)

    def state(self) -> dict[str, Tensor]:
        """Return the content and the state of the generator."""
        used = min(self.steps + 1, self.slots) * self.width
        next_places = self.places[1, :used]
        finals = torch.unique(next_places[next_places >= len(self.actions)])
        assert isinstance(self.frames, Observations)
        parts = {
            f"frames.{number}": torch.cat([part[:used], part.index_select(0, finals)])
            for number, part in enumerate(self.frames.parts())
        }
        return {
            **parts,
            "finals": finals,
            "next_places": next_places,
            "actions": self.actions[:used],
            "returns": self.returns[:, :used],
            "goes_on": self.goes_on.view(-1)[:used],
            "ages": self.ages.view(-1)[:used],
            "steps": torch.tensor(self.steps),
            "generator": self.generator.get_state(),
        }

    def load_state(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore what `state` returned; KeyError, RuntimeError or IndexError if it is wrong."""
        finals, used = tensors["finals"], len(tensors["next_places"])
        assert isinstance(self.frames, Observations)
        for number, part in enumerate(self.frames.parts()):
            content = tensors[f"frames.{number}"]
            part[:used] = content[:used]
            part[finals] = content[used:]
        self.places[1, :used] = tensors["next_places"]
        self.actions[:used] = tensors["actions"]
        self.returns[:, :used] = tensors["returns"]
        self.goes_on.view(-1)[:used] = tensors["goes_on"]
        self.ages.view(-1)[:used] = tensors["ages"]
        self.counts.steps = int(tensors["steps"])
        self.generator.set_state(tensors["generator"])

    @property
    def _returns(self) -> Tensor:
        return self.returns.view(2, self.slots, self.width)

    @property
    def _next_places(self) -> Tensor:
        return self.places[1].view(self.slots, self.width)

    def _finals_of(self, slot: int) -> int:
        """Return the first of the W frames for the last observations after a slot."""
        return len(self.actions) + slot * self.width

    def _put(self, first: int, observations: Observations, rows: Tensor | None = None) -> None:
        """Store observations as frames from `first` on, or as some `rows` of these."""
        assert isinstance(self.frames, Observations)
        given = _averaged(observations, self.pools)
        for part, values in zip(self.frames.parts(), given.parts(), strict=True):
            if rows is None:
                part[first : first + self.width] = values
            else:
                part[first + rows] = values

    def _extend_returns(
        self, slot: int, rewards: Tensor, terminated: Tensor, places: Tensor
    ) -> None:
        """Add the rewards of a slot to the n-step returns of the slots before it."""
        gamma, reaches = self.packing.gamma, None
        for k in range(1, self.packing.n_steps):
            earlier = (slot - k) % self.slots
            goes_on = self.goes_on[earlier]
            reaches = goes_on if reaches is None else reaches & goes_on
            self._returns[0, earlier] += gamma**k * reaches * rewards
            discounts = gamma ** (k + 1) * ~terminated
            self._returns[1, earlier] = torch.where(reaches, discounts, self._returns[1, earlier])
            self._next_places[earlier] = torch.where(reaches, places, self._next_places[earlier])

    def _truncate(self) -> None:
        """End all episodes with the newest observations, which are moved to the final frames."""
        slot = (self.steps - 1) % self.slots
        now, finals = self.steps % self.slots * self.width, self._finals_of(slot)
        reaches = self.goes_on[slot].clone()
        assert isinstance(self.frames, Observations)
        rows = reaches.nonzero().squeeze(1)
        for part in self.frames.parts():
            part[finals + rows] = part[now + rows]
        places = finals + torch.arange(self.width, device=self.device)
        for k in range(self.packing.n_steps):
            earlier = (slot - k) % self.slots
            reaches &= self.goes_on[earlier]
            self._next_places[earlier] = torch.where(reaches, places, self._next_places[earlier])
        self.goes_on[slot] = False


@dataclass(frozen=True, eq=False, kw_only=True)
class MixedBuffer(ReplayBuffer):
    """Replay buffer of one agent with a log, from which a part of each batch is drawn.

    See "Efficient Online Reinforcement Learning with Offline Data",
    https://arxiv.org/abs/2302.02948. Row i of the log has the number `len(self) + i`.
    """

    log: TransitionBuffer  # Logged transitions
    fraction: float  # Part of each batch that is drawn from the log

    @classmethod
    def of(cls, buffer: ReplayBuffer, log: TransitionBuffer, fraction: float) -> MixedBuffer:
        """Return a buffer that shares the memory of another one."""
        assert buffer.agents == 1
        shared = {each.name: getattr(buffer, each.name) for each in fields(ReplayBuffer)}
        return cls(**shared, log=log, fraction=fraction)

    def draw(self, count: int, generators: Sequence[torch.Generator]) -> Tensor:
        """Draw `count` rows, those of the log last."""
        logged = round(self.fraction * count)
        own = super().draw(count - logged, generators)
        rows = torch.randint(len(self.log), (logged,), generator=self.generator)
        return torch.cat((own, rows + len(self)))

    def batch(self, rows: Tensor) -> Batch:
        """Return the transitions of rows (R,), which `draw` returned."""
        own = int((rows < len(self)).sum())
        first = TransitionBuffer.batch(self, rows[:own])
        last = self.log.batch(rows[own:] - len(self))
        return self._augmented(
            Batch(
                rows,
                _joined(first.observations, last.observations),
                torch.cat((first.actions, last.actions)),
                torch.cat((first.rewards, last.rewards)),
                torch.cat((first.discounts, last.discounts)),
                _joined(first.next_observations, last.next_observations),
            )
        )

    def state(self) -> dict[str, Tensor]:
        """Return the content, the state of the generator, and the log."""
        return super().state() | {f"log.{name}": part for name, part in _log_parts(self.log)}


_IMAGES_AT_ONCE = 4_096
_LOG_PARTS = ("starts", "places", "actions", "returns")


def _log_parts(log: TransitionBuffer) -> Iterator[tuple[str, Tensor]]:
    """Yield the tensors of a log by name."""
    assert isinstance(log.frames, Observations)
    yield from ((name, getattr(log, name)) for name in _LOG_PARTS)
    yield from ((f"frames.{number}", part) for number, part in enumerate(log.frames.parts()))


def packed_log(dataset: Dataset, buffer: ReplayBuffer) -> TransitionBuffer:
    """Return logged transitions in the form in which a replay buffer stores its own."""
    packed = TransitionBuffer.from_dataset(
        dataset, buffer.packing, encoder=buffer.encoder, reward_scale=1.0, box=buffer.box
    )
    blocks = torch.split(torch.arange(len(packed.frames)), _IMAGES_AT_ONCE)
    frames = [_averaged(packed.frames.rows(rows), buffer.pools) for rows in blocks]
    return replace(packed, frames=_joined(*frames))


def restored_log(tensors: Mapping[str, Tensor], buffer: ReplayBuffer) -> TransitionBuffer:
    """Return the log of a `MixedBuffer` from its state, without the prefix `log.`."""
    count = sum(name.startswith("frames.") for name in tensors)
    vector, *images = (tensors[f"frames.{number}"] for number in range(count))
    parts: dict[str, Any] = {name: tensors[name] for name in _LOG_PARTS}
    return TransitionBuffer(
        encoder=buffer.encoder,
        action_space=buffer.action_space,
        packing=buffer.packing,
        frames=Observations(vector, tuple(images)),
        box=buffer.box,
        **parts,
    )


def _joined(*blocks: Observations) -> Observations:
    parts = zip(*(block.parts() for block in blocks), strict=True)
    return blocks[0].like([torch.cat(part) for part in parts])


def _averaged(observations: Observations, pools: Sequence[int]) -> Observations:
    """Return observations with the images of each camera averaged by a factor."""
    pairs = zip(observations.images, pools, strict=True)
    return replace(observations, images=tuple(averaged(image, pool) for image, pool in pairs))


def averaged(images: Tensor, pool: int) -> Tensor:
    """Average images (N, height, width, channels) over `pool` x `pool` pixels, and round."""
    if pool == 1:
        return images
    height, width = (edge // pool * pool for edge in images.shape[1:3])
    rows: Any = sum(images[:, row:height:pool].int() for row in range(pool))
    sums: Any = sum(rows[:, :, column:width:pool] for column in range(pool))
    return cast(Tensor, (sums + pool**2 // 2) // pool**2).to(torch.uint8)


def _shifted(observations: Observations, down: int, right: int) -> Observations:
    """Shift images by pixels; copies of the edge pixels fill the gap."""
    return replace(
        observations, images=tuple(shifted(image, down, right) for image in observations.images)
    )


def shifted(images: Tensor, down: int, right: int) -> Tensor:
    """Shift images (N, height, width, channels); copies of the edge pixels fill the gap."""
    height, width = images.shape[1:3]
    rows = (torch.arange(height, device=images.device) - down).clamp(0, height - 1)
    columns = (torch.arange(width, device=images.device) - right).clamp(0, width - 1)
    return images.index_select(1, rows).index_select(2, columns)
