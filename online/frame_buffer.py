"""A replay buffer that stores each picture once, and gives n-step returns of any observations.

SB3's own keeps every observation twice, as one step's next and the following step's first: 500,000
depth images of 84x84 then take 7 GB. Here the next observation is the following row's; only those
that end an episode are kept beside.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

# The one part of observations that are no dict.
_WHOLE = ""
_FIRST_FINALS = 64


class FrameReplayBuffer(BaseBuffer):
    """As SB3's `ReplayBuffer`, `DictReplayBuffer` and `NStepReplayBuffer`, in half the memory.

    R rows of N environments; a row's step follows the step of the row before.

    Attributes:
        frames: by key, (R, N, *shape); observations that are no dict have the key "".
        newest: by key, (N, *shape), what followed the last row.
        finals: by key, (F, *shape), where episodes ended.
        final_of: (R, N), which of `finals` followed; -1 where the episode went on.
        actions: (R, N, 1).
        rewards: (R, N) float32.
        dones: (R, N) float32, 1 where an episode ended, for whatever reason.
        timeouts: (R, N) float32, 1 where it was cut off.
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
    ) -> None:
        """Reserve the memory; the system gives it as it is filled.

        Args:
            buffer_size: transitions, over all environments.
            observation_space: as the network takes it.
            action_space: discrete.
            device: of the batches.
            n_envs: N.
            optimize_memory_usage: SB3 passes it; it changes nothing.
            n_steps: rewards that are summed up.
            gamma: discount of the reward one step later.
        """
        super().__init__(buffer_size, observation_space, action_space, device, n_envs)
        self.buffer_size = rows = max(buffer_size // n_envs, 1)
        self.n_steps, self.gamma = n_steps, gamma
        parts = _parts_of(observation_space)
        self.frames = {k: np.zeros((rows, n_envs, *s.shape), s.dtype) for k, s in parts.items()}
        self.newest = {k: np.zeros((n_envs, *s.shape), s.dtype) for k, s in parts.items()}
        self.finals = {k: np.zeros((_FIRST_FINALS, *s.shape), s.dtype) for k, s in parts.items()}
        self.final_of = np.full((rows, n_envs), -1, np.int64)
        self._free = list(range(_FIRST_FINALS))
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
            obs: (N, *shape); where the step before ended no episode, its `next_obs`.
            next_obs: (N, *shape), at an episode's end its last observation.
            action: (N,).
            reward: (N,).
            done: (N,).
            infos: whose `TimeLimit.truncated` says that an episode was cut off.
        """
        row, following = self.pos, _as_parts(next_obs)
        for key, part in _as_parts(obs).items():
            self.frames[key][row] = part
            self.newest[key][:] = following[key]
        self._free += [slot for slot in self.final_of[row].tolist() if slot >= 0]
        self.final_of[row] = -1
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
        """All that is stored, to be kept and given to `restore`."""
        rows = self.size()
        columns = {
            name: getattr(self, name)[:rows]
            for name in ("final_of", "actions", "rewards", "dones", "timeouts")
        }
        columns |= {f"frames.{key}": part[:rows] for key, part in self.frames.items()}
        for name in ("newest", "finals"):
            columns |= {f"{name}.{key}": part for key, part in getattr(self, name).items()}
        return columns

    def restore(self, columns: dict[str, NDArray[Any]]) -> None:
        """Go back to what `columns` gave; `pos` and `full` are set already."""
        rows = self.size()
        for name in ("final_of", "actions", "rewards", "dones", "timeouts"):
            getattr(self, name)[:rows] = columns[name]
        for key, part in self.frames.items():
            part[:rows] = columns[f"frames.{key}"]
            self.newest[key][:] = columns[f"newest.{key}"]
            self.finals[key] = columns[f"finals.{key}"].copy()
        slots = len(next(iter(self.finals.values())))
        self._free = sorted(set(range(slots)) - set(self.final_of[self.final_of >= 0].tolist()))

    def _free_slot(self) -> int:
        """A place for the last observation of an episode; there are twice as many if none is."""
        if not self._free:
            count = len(next(iter(self.finals.values())))
            self.finals = {
                key: np.concatenate([part, np.zeros_like(part)])
                for key, part in self.finals.items()
            }
            self._free = list(range(count, 2 * count))
        return self._free.pop()

    def _get_samples(self, batch_inds: NDArray[Any], env: VecNormalize | None = None) -> Any:
        """Batches of the rows, each of an environment drawn at random; draws as SB3 does."""
        assert env is None
        envs = np.random.randint(0, high=self.n_envs, size=len(batch_inds))  # noqa: NPY002
        rows, returns, discounts = self._look_ahead(batch_inds, envs)
        terminated = self.dones[rows, envs] * (1 - self.timeouts[rows, envs])
        samples = (
            self._tensors({key: part[batch_inds, envs] for key, part in self.frames.items()}),
            self.to_torch(self.actions[batch_inds, envs]),
            self._tensors(self._following(rows, envs)),
            self.to_torch(terminated[:, None]),
            self.to_torch(returns[:, None]),
            self.to_torch(discounts[:, None]) if self.n_steps > 1 else None,
        )
        if _WHOLE in self.frames:
            return ReplayBufferSamples(*samples)
        return DictReplayBufferSamples(*samples)

    def _look_ahead(
        self, rows: NDArray[Any], envs: NDArray[Any]
    ) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
        """Sum up rewards until n are, the episode ends, or what came next is not known yet.

        Returns:
            The last row of each sum, the sum, and gamma to the power of how many.
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

    def _following(self, rows: NDArray[Any], envs: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """What was observed after the steps of rows."""
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

    def _tensors(self, parts: dict[str, NDArray[Any]]) -> Any:
        tensors = {key: self.to_torch(part, copy=False) for key, part in parts.items()}
        return tensors.get(_WHOLE, tensors)


def _parts_of(space: spaces.Space[Any]) -> dict[str, Any]:
    return dict(space.items()) if isinstance(space, spaces.Dict) else {_WHOLE: space}


def _as_parts(observations: Any) -> dict[str, NDArray[Any]]:
    return observations if isinstance(observations, dict) else {_WHOLE: observations}
