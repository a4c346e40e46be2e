"""Several observations in a row as one, for what a single one does not show: a speed, say.

Oldest first, along the channels of pictures and along the last axis of all else, as the networks of
`offline/` have them, too. Before an episode's first observation, that one stands for what was.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

WHOLE = ""
"""The one part of observations that are no dict."""


def parts_of_space(space: spaces.Space[Any]) -> dict[str, Any]:
    """The parts of a Dict space by key; any other space is its own only part."""
    return dict(space.items()) if isinstance(space, spaces.Dict) else {WHOLE: space}


def parts_of(observations: Any) -> dict[str, NDArray[Any]]:
    """The same of observations."""
    return observations if isinstance(observations, dict) else {WHOLE: observations}


def whole_of(parts: dict[str, Any]) -> Any:
    """Undo `parts_of`."""
    return parts.get(WHOLE, parts)


def stack_axis(space: spaces.Space[Any]) -> int:
    """Along which axis of one observation frames are joined, counted from its end."""
    if is_image_space(space) and is_image_space_channels_first(cast(spaces.Box, space)):
        return -3
    return -1


def stacked_space(space: spaces.Space[Any], count: int) -> spaces.Space[Any]:
    """The space of `count` observations as one."""
    if isinstance(space, spaces.Dict):
        return spaces.Dict({key: stacked_space(part, count) for key, part in space.items()})
    if count == 1:
        return space
    box = cast(spaces.Box, space)
    low, high = (np.concatenate([end] * count, stack_axis(box)) for end in (box.low, box.high))
    return spaces.Box(low, high, dtype=cast(Any, box.dtype))


def joined(frames: Any, space: spaces.Space[Any]) -> Any:
    """Make one observation of each row of frames.

    Args:
        frames: (B, k, *shape), oldest first, or a dict of such.
        space: of a single observation.
    """
    found = {
        key: np.concatenate(list(np.moveaxis(parts_of(frames)[key], 1, 0)), stack_axis(part))
        for key, part in parts_of_space(space).items()
    }
    return whole_of(found)


class FrameMemory:
    """The last k observations of each of B episodes.

    Attributes:
        space: of a single observation.
        frames: by key, (B, k, *shape), oldest first; empty before anything was seen.
    """

    def __init__(self, space: spaces.Space[Any], count: int) -> None:
        """Remember `count` observations of a space."""
        self.space = space
        self.frames: dict[str, NDArray[Any]] = {}
        self._count = count

    def begin(self, observations: Any) -> Any:
        """Take the first observations (B, *shape) of episodes; each as a stack."""
        self.frames = {
            key: np.repeat(part[:, None], self._count, axis=1)
            for key, part in parts_of(observations).items()
        }
        return self.stacked()

    def see(self, observations: Any) -> Any:
        """Take the next observations (B, *shape) of all episodes; each as a stack."""
        self.frames = {
            key: np.concatenate([self.frames[key][:, 1:], part[:, None]], axis=1)
            for key, part in parts_of(observations).items()
        }
        return self.stacked()

    def begin_one(self, row: int) -> None:
        """Let what was seen last in an episode's place be the first observation of another."""
        for part in self.frames.values():
            part[row] = part[row, -1:]

    def ending(self, row: int, last: Any) -> Any:
        """The stack whose newest observation is `last` (*shape), in place of what was seen last."""
        frames = {key: part[row : row + 1].copy() for key, part in self.frames.items()}
        for key, part in parts_of(last).items():
            frames[key][0, -1] = part
        stack = parts_of(joined(whole_of(frames), self.space))
        return whole_of({key: part[0] for key, part in stack.items()})

    def stacked(self) -> Any:
        """(B, *stacked shape)."""
        return joined(whole_of(self.frames), self.space)


class StackedVecEnv(VecEnvWrapper):
    """Environments whose observations are the last k of theirs."""

    def __init__(self, venv: VecEnv, count: int) -> None:
        """Wrap environments that reset themselves in the step that ends an episode."""
        self._memory = FrameMemory(venv.observation_space, count)
        super().__init__(venv, stacked_space(venv.observation_space, count))

    def reset(self) -> VecEnvObs:
        """Start all episodes anew."""
        return cast(VecEnvObs, self._memory.begin(self.venv.reset()))

    def step_wait(self) -> VecEnvStepReturn:
        """Step all; an episode's last observation is a stack, too."""
        observations, rewards, dones, infos = self.venv.step_wait()
        self._memory.see(observations)
        for row in np.flatnonzero(dones).tolist():
            last = infos[row]["terminal_observation"]
            infos[row]["terminal_observation"] = self._memory.ending(row, last)
            self._memory.begin_one(row)
        return cast(VecEnvObs, self._memory.stacked()), rewards, dones, infos
