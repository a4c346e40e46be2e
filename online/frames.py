"""Frame stacking: joins successive observations into one, so that it shows velocities.

Frames are joined oldest first, along the channels of images and the last axis of other arrays, as
in `offline/`. Frames before an episode's first observation are copies of that observation.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecTransposeImage
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

WHOLE = ""
"""Key under which `parts_of` returns observations that are not a dict."""


def parts_of_space(space: spaces.Space[Any]) -> dict[str, Any]:
    """Return the parts of a Dict space by key; any other space is a single part."""
    return dict(space.items()) if isinstance(space, spaces.Dict) else {WHOLE: space}


def parts_of(observations: Any) -> dict[str, NDArray[Any]]:
    """Return observations as a dict of arrays by key; the key of a single array is `WHOLE`."""
    return observations if isinstance(observations, dict) else {WHOLE: observations}


def whole_of(parts: dict[str, Any]) -> Any:
    """Return the observations that `parts_of` split into these parts."""
    return parts.get(WHOLE, parts)


def stack_axis(space: spaces.Space[Any]) -> int:
    """Return the axis along which frames are joined, as a negative index."""
    if is_image_space(space) and is_image_space_channels_first(cast(spaces.Box, space)):
        return -3
    return -1


def channels_first(space: spaces.Space[Any]) -> spaces.Space[Any]:
    """Return the space as SB3's networks receive it, with image channels first."""
    if isinstance(space, spaces.Dict):
        return spaces.Dict({key: channels_first(part) for key, part in space.items()})
    if is_image_space(space) and not is_image_space_channels_first(cast(spaces.Box, space)):
        return VecTransposeImage.transpose_space(cast(spaces.Box, space))
    return space


def stacked_space(space: spaces.Space[Any], count: int) -> spaces.Space[Any]:
    """Return the space of `count` joined observations."""
    if isinstance(space, spaces.Dict):
        return spaces.Dict({key: stacked_space(part, count) for key, part in space.items()})
    if count == 1:
        return space
    box = cast(spaces.Box, space)
    low, high = (np.concatenate([end] * count, stack_axis(box)) for end in (box.low, box.high))
    return spaces.Box(low, high, dtype=cast(Any, box.dtype))


def joined(frames: Any, space: spaces.Space[Any]) -> Any:
    """Join the frames of each row into one observation.

    Args:
        frames: Arrays (B, k, *shape), oldest first, or a dict of such arrays.
        space: Space of a single observation.
    """
    found = {
        key: np.concatenate(list(np.moveaxis(parts_of(frames)[key], 1, 0)), stack_axis(part))
        for key, part in parts_of_space(space).items()
    }
    return whole_of(found)


class FrameMemory:
    """Last k observations of each of B episodes.

    Attributes:
        space: Space of a single observation.
        frames: Arrays (B, k, *shape) by key, oldest first; empty before the first observation.
    """

    def __init__(self, space: spaces.Space[Any], count: int) -> None:
        """Store the last `count` observations of a space."""
        self.space = space
        self.frames: dict[str, NDArray[Any]] = {}
        self._count = count

    def begin(self, observations: Any) -> Any:
        """Store the first observations (B, *shape) of episodes, and return them as stacks."""
        self.frames = {
            key: np.repeat(part[:, None], self._count, axis=1)
            for key, part in parts_of(observations).items()
        }
        return self.stacked()

    def see(self, observations: Any) -> Any:
        """Store the next observations (B, *shape) of all episodes, and return them as stacks."""
        self.frames = {
            key: np.concatenate([self.frames[key][:, 1:], part[:, None]], axis=1)
            for key, part in parts_of(observations).items()
        }
        return self.stacked()

    def begin_one(self, row: int) -> None:
        """Start a new episode in one row. Its first observation is the newest one of that row."""
        for part in self.frames.values():
            part[row] = part[row, -1:]

    def ending(self, row: int, last: Any) -> Any:
        """Return a row's stack, in which `last` (*shape) replaces the newest observation."""
        frames = {key: part[row : row + 1].copy() for key, part in self.frames.items()}
        for key, part in parts_of(last).items():
            frames[key][0, -1] = part
        stack = parts_of(joined(whole_of(frames), self.space))
        return whole_of({key: part[0] for key, part in stack.items()})

    def stacked(self) -> Any:
        """Return the stored observations as stacks (B, ...) in the format of `stacked_space`."""
        return joined(whole_of(self.frames), self.space)


class StackedVecEnv(VecEnvWrapper):
    """Wrapper whose observations are stacks of the last k observations."""

    def __init__(self, venv: VecEnv, count: int) -> None:
        """Stack `count` observations; `venv` must reset an environment when its episode ends."""
        self._memory = FrameMemory(venv.observation_space, count)
        super().__init__(venv, stacked_space(venv.observation_space, count))

    def reset(self) -> VecEnvObs:
        """Start new episodes in all environments."""
        return cast(VecEnvObs, self._memory.begin(self.venv.reset()))

    def step_wait(self) -> VecEnvStepReturn:
        """Step all environments; stack the observations, and also each `terminal_observation`."""
        observations, rewards, dones, infos = self.venv.step_wait()
        self._memory.see(observations)
        for row in np.flatnonzero(dones).tolist():
            last = infos[row]["terminal_observation"]
            infos[row]["terminal_observation"] = self._memory.ending(row, last)
            self._memory.begin_one(row)
        return cast(VecEnvObs, self._memory.stacked()), rewards, dones, infos
