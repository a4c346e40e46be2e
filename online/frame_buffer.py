"""Replay buffer that stores each image once, with n-step returns for any observations.

SB3's buffers store every observation twice: as the next observation of one step, and as the
observation of the following step. This needs 7 GB for 500,000 depth images of 84x84. Here, the next
observation is read from the following row, and only the last observation of an episode is stored
separately. Each frame of stacked observations is also stored once. If the network first averages
images to a smaller size, they can be stored at this size.

The images of a batch may be shifted at random, which reduces overfitting ("Image Augmentation Is
All You Need", https://arxiv.org/abs/2004.13649).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from mcaprl.frames import (
    WHOLE,
    frame_rows,
    joined,
    map_space,
    parts_of,
    parts_of_space,
    stack_axis,
    whole_of,
)

_FIRST_FINALS = 64
_COLUMNS = ("final_of", "ages", "actions", "rewards", "dones", "timeouts")


class FrameReplayBuffer(BaseBuffer):
    """Replacement for SB3's replay buffers (plain, dict and n-step) that needs half the memory.

    The buffer has R rows, each with one step of N environments. *shape is the shape of a single
    frame. If a frame of a stack was overwritten, a copy of the oldest stored frame replaces it.

    Attributes:
        frames: Observations (R, N, *shape) by key; "" is the key of observations without keys.
        newest: Observations (N, *shape) after the last row, by key.
        finals: Last observations (F, *shape) of episodes, by key.
        final_of: (R, N) indices into `finals`; -1 where the episode continued.
        ages: (R, N) numbers of earlier frames in the episode, at most `frame_stack`.
        actions: (R, N, 1) actions.
        rewards: (R, N) float32 rewards.
        dones: (R, N) float32, 1 where an episode ended.
        timeouts: (R, N) float32, 1 where an episode was truncated.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: torch.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        *,
        n_steps: int = 1,
        gamma: float = 1.0,
        frame_stack: int = 1,
        pools: Mapping[str, int] | None = None,
        image_shift: int = 0,
    ) -> None:
        """Reserve the memory. The operating system allocates it when the buffer is filled.

        Args:
            buffer_size: Number of transitions, summed over all environments.
            observation_space: Space of the network's observations.
            action_space: Discrete action space.
            device: Device of the batches.
            n_envs: Number N of environments.
            optimize_memory_usage: Ignored argument of SB3.
            n_steps: Number of rewards in a return.
            gamma: Discount per step.
            frame_stack: Number of successive frames in an observation.
            pools: Factor by which the images of each key are averaged when they are stored.
            image_shift: Largest shift of the images in a batch, in pixels of the stored size.
        """
        super().__init__(buffer_size, observation_space, action_space, device, n_envs)
        self.buffer_size = rows = max(buffer_size // n_envs, 1)
        self.n_steps, self.gamma, self.frame_stack = n_steps, gamma, frame_stack
        self._image_shift = image_shift
        self._pools = {key: pool for key, pool in (pools or {}).items() if pool > 1}
        frames = parts_of_space(_frame_space(observation_space, frame_stack))
        parts = {
            key: _pooled_space(space, self._pools[key]) if key in self._pools else space
            for key, space in frames.items()
        }
        self.frame_space = parts[WHOLE] if WHOLE in parts else spaces.Dict(parts)
        self.frames = {k: np.zeros((rows, n_envs, *s.shape), s.dtype) for k, s in parts.items()}
        self.newest = {k: np.zeros((n_envs, *s.shape), s.dtype) for k, s in parts.items()}
        self.finals = {k: np.zeros((_FIRST_FINALS, *s.shape), s.dtype) for k, s in parts.items()}
        self.final_of = np.full((rows, n_envs), -1, np.int64)
        self._free = list(range(_FIRST_FINALS))
        self.ages = np.zeros((rows, n_envs), np.int64)
        self.actions = np.zeros((rows, n_envs, self.action_dim), action_space.dtype)
        self.rewards = np.zeros((rows, n_envs), np.float32)
        self.dones = np.zeros((rows, n_envs), np.float32)
        self.timeouts = np.zeros((rows, n_envs), np.float32)

    def add(
        self,
        obs: Any,
        next_obs: Any,
        action: NDArray[Any],
        reward: NDArray[Any],
        done: NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        """Append a step of each environment.

        Args:
            obs: Observations (N, *shape): the first of an episode, or `next_obs` of the previous
                step. Only the newest frame of a stack is read.
            next_obs: Next observations (N, *shape). If an episode ended, its last observation.
            action: Actions (N,).
            reward: Rewards (N,).
            done: (N,) flags of ended episodes.
            infos: Dicts whose `TimeLimit.truncated` marks truncated episodes.
        """
        row, following = self.pos, self._newest_frames(next_obs)
        for key, part in self._newest_frames(obs).items():
            self.frames[key][row] = part
            self.newest[key][:] = following[key]
        self._free += [slot for slot in self.final_of[row].tolist() if slot >= 0]
        self.final_of[row] = -1
        self.ages[row] = self._ages_after(row - 1)
        for env in np.flatnonzero(done).tolist():
            slot = self._free_slot()
            self.final_of[row, env] = slot
            for key, part in following.items():
                self.finals[key][slot] = part[env]
        self.actions[row] = np.reshape(action, (self.n_envs, self.action_dim))
        self.rewards[row], self.dones[row] = reward, done
        self.timeouts[row] = [info.get("TimeLimit.truncated", False) for info in infos]
        self.pos = (row + 1) % self.buffer_size
        self.full |= self.pos == 0

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the contents of the buffer for `restore`."""
        rows = self.size()
        columns = {name: getattr(self, name)[:rows] for name in _COLUMNS}
        columns |= {f"frames.{key}": part[:rows] for key, part in self.frames.items()}
        for name in ("newest", "finals"):
            columns |= {f"{name}.{key}": part for key, part in getattr(self, name).items()}
        return columns

    def restore(self, columns: dict[str, NDArray[Any]]) -> None:
        """Restore the contents that `columns` returned; set `pos` and `full` before this call."""
        rows = self.size()
        for name in _COLUMNS:
            getattr(self, name)[:rows] = columns[name]
        for key, part in self.frames.items():
            part[:rows] = columns[f"frames.{key}"]
            self.newest[key][:] = columns[f"newest.{key}"]
            self.finals[key] = columns[f"finals.{key}"].copy()
        slots = len(next(iter(self.finals.values())))
        self._free = sorted(set(range(slots)) - set(self.final_of[self.final_of >= 0].tolist()))

    def _free_slot(self) -> int:
        """Return a free index of `finals`. If `finals` is full, double its length first."""
        if not self._free:
            count = len(next(iter(self.finals.values())))
            self.finals = {
                key: np.concatenate([part, np.zeros_like(part)])
                for key, part in self.finals.items()
            }
            self._free = list(range(count, 2 * count))
        return self._free.pop()

    def _get_samples(self, batch_inds: NDArray[Any], env: VecNormalize | None = None) -> Any:
        """Return one transition per row index, from a randomly drawn environment."""
        assert env is None
        envs = np.random.randint(0, high=self.n_envs, size=len(batch_inds))  # noqa: NPY002
        rows, returns, discounts = self._look_ahead(batch_inds, envs)
        terminated = self.dones[rows, envs] * (1 - self.timeouts[rows, envs])
        samples = (
            self._tensors(self._shifted(self._stacks(batch_inds, envs))),
            self.to_torch(self.actions[batch_inds, envs]),
            self._tensors(self._shifted(self._following(rows, envs))),
            self.to_torch(terminated[:, None]),
            self.to_torch(returns[:, None]),
            self.to_torch(discounts[:, None]) if self.n_steps > 1 else None,
        )
        if WHOLE in self.frames:
            return ReplayBufferSamples(*samples)
        return DictReplayBufferSamples(*samples)

    def _shifted(self, parts: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Return observations whose images (B, channels, height, width) are shifted at random.

        All images have the same shift. Copies of the pixels at the edge fill the gap.
        """
        if not self._image_shift:
            return parts
        most = self._image_shift
        shift = np.random.randint(-most, most + 1, size=2)  # noqa: NPY002
        return {
            key: shifted(part, *shift) if part.ndim == 4 else part for key, part in parts.items()
        }

    def _look_ahead(
        self, rows: NDArray[Any], envs: NDArray[Any]
    ) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
        """Sum n discounted rewards, or fewer if the episode or the buffer ends earlier.

        Returns:
            Row of the last reward in each sum, the sum, and gamma to the power of the number of
            rewards.
        """
        steps = np.arange(self.n_steps)
        ahead = (rows[:, None] + steps) % self.buffer_size
        newest = (self.pos - 1) % self.buffer_size
        stops = (self.dones[ahead, envs[:, None]] > 0) | (ahead == newest)
        last = np.where(stops.any(1), stops.argmax(1), self.n_steps - 1)
        weights = self.gamma ** steps.astype(np.float32) * (steps <= last[:, None])
        returns = (self.rewards[ahead, envs[:, None]] * weights).sum(1, dtype=np.float32)
        discounts = np.float32(self.gamma) ** (last + 1).astype(np.float32)
        return ahead[np.arange(len(rows)), last], returns, discounts

    def _stacks(self, rows: NDArray[Any], envs: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Return the observations before the steps in these rows."""
        if self.frame_stack == 1:
            return {key: part[rows, envs] for key, part in self.frames.items()}
        places = self._places(rows, envs, np.arange(self.frame_stack)[::-1])
        return self._joined({key: part[places, envs[:, None]] for key, part in self.frames.items()})

    def _following(self, rows: NDArray[Any], envs: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Return the observations after the steps in these rows."""
        following = self._frames_after(rows, envs)
        if self.frame_stack == 1:
            return following
        places = self._places(rows, envs, np.arange(self.frame_stack - 1)[::-1])
        stacks = {
            key: np.concatenate([part[places, envs[:, None]], following[key][:, None]], axis=1)
            for key, part in self.frames.items()
        }
        return self._joined(stacks)

    def _frames_after(self, rows: NDArray[Any], envs: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Return the frames after the steps in these rows."""
        slots = self.final_of[rows, envs]
        ended = slots >= 0
        newest = ~ended & (rows == (self.pos - 1) % self.buffer_size)
        found = {}
        for key, frames in self.frames.items():
            part = frames[(rows + 1) % self.buffer_size, envs]
            part[ended] = self.finals[key][slots[ended]]
            part[newest] = self.newest[key][envs[newest]]
            found[key] = part
        return found

    def _places(
        self, rows: NDArray[Any], envs: NDArray[Any], before: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Return the rows of the frames that are `before` steps older than the frames in `rows`.

        If the episode has no such frame, its oldest frame in the buffer is used.
        """
        oldest = self.pos if self.full else 0
        stored = np.minimum(self.ages[rows, envs], (rows - oldest) % self.buffer_size)
        places: NDArray[np.int64] = frame_rows(rows, rows - stored, before) % self.buffer_size
        return places

    def _ages_after(self, row: int) -> NDArray[np.int64]:
        """Return the `ages` (N,) of the frames in the row that follows this one."""
        if not self.size():
            return np.zeros(self.n_envs, np.int64)
        ages = np.minimum(self.ages[row] + 1, self.frame_stack)
        return np.where(self.dones[row] > 0, 0, ages)

    def _newest_frames(self, observations: Any) -> dict[str, NDArray[Any]]:
        """Return the newest frame of each stack, in the size in which it is stored."""
        newest = {}
        for key, space in parts_of_space(self.frame_space).items():
            part, axis = parts_of(observations)[key], stack_axis(space)
            count = space.shape[axis]
            part = np.take(part, range(-count, 0), axis) if self.frame_stack > 1 else part
            newest[key] = _pooled(part, self._pools[key]) if key in self._pools else part
        return newest

    def _joined(self, frames: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        return parts_of(joined(whole_of(frames), self.frame_space))

    def _tensors(self, parts: dict[str, NDArray[Any]]) -> Any:
        tensors = {key: self.to_torch(part, copy=False) for key, part in parts.items()}
        return whole_of(tensors)


def shifted(images: NDArray[Any], down: int, right: int) -> NDArray[Any]:
    """Shift images (..., height, width) by pixels; copies of the edge pixels fill the gap."""
    height, width = images.shape[-2:]
    rows = np.clip(np.arange(height) - down, 0, height - 1)
    columns = np.clip(np.arange(width) - right, 0, width - 1)
    return images.take(rows, -2).take(columns, -1)


def _pooled(images: NDArray[np.uint8], pool: int) -> NDArray[np.uint8]:
    """Average images (N, channels, height, width) over `pool` x `pool` pixels, and round."""
    height, width = (edge // pool * pool for edge in images.shape[-2:])
    sums = np.zeros((*images.shape[:-2], height // pool, width // pool), np.uint32)
    for row in range(pool):
        for column in range(pool):
            sums += images[..., row:height:pool, column:width:pool]
    return ((sums + pool**2 // 2) // pool**2).astype(np.uint8)


def _pooled_space(space: spaces.Space[Any], pool: int) -> spaces.Box:
    channels, height, width = cast(spaces.Box, space).shape
    return spaces.Box(0, 255, (channels, height // pool, width // pool), np.uint8)


def _frame_space(space: spaces.Space[Any], count: int) -> spaces.Space[Any]:
    """Return the space of a single frame of a stack."""

    def newest(box: spaces.Box) -> spaces.Space[Any]:
        low, high = (np.split(end, count, stack_axis(box))[-1] for end in (box.low, box.high))
        return spaces.Box(low, high, dtype=cast(Any, box.dtype))

    return map_space(newest, space)
