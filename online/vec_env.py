"""Batched Gymnasium environments with the interface of Stable-Baselines3, in one process.

SB3's `DummyVecEnv` steps environments one after the other; `BatchedVecEnv` passes all actions to
one `gymnasium.vector.VectorEnv` at once. This package's sims step in a single compiled call.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from mcaprl.frames import FrameStack, joined, mapped, parts_of, stacked_space, whole_of
from mcaprl.sims.evaluation.rollout import episode_seed


class BatchedVecEnv(VecEnv):
    """A `gymnasium.vector.VectorEnv` with SB3's interface.

    At an episode's end, `infos[i]` contains the entries that SB3 reads: `terminal_observation`,
    `TimeLimit.truncated`, and `episode` with the entries of SB3's `Monitor`. It also contains
    `reason` and `progress_m` if the environment reports them. At other steps, `infos[i]` is
    empty.

    Attributes:
        before_step: Callback that receives the actions (N,) before each step, if any.
    """

    def __init__(self, env: Any) -> None:
        """Adapt `env`. In the step that ends an episode, it must also reset that environment."""
        assert isinstance(env, VectorEnv)
        assert env.metadata.get("autoreset_mode") is AutoresetMode.SAME_STEP
        self.env: Any = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self.before_step: Callable[[NDArray[Any]], None] | None = None
        self._actions: NDArray[Any] = np.zeros(0)
        self._returns = np.zeros(env.num_envs)
        self._lengths = np.zeros(env.num_envs, dtype=np.int64)
        self._began_s = time.time()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the next reset; the seed of environment i is `episode_seed(seed, i)`."""
        if seed is not None:
            self._seeds = [episode_seed(seed, i) for i in range(self.num_envs)]
        return self._seeds

    def reset(self) -> VecEnvObs:
        """Start new episodes in all environments."""
        observations, _ = self.env.reset(seed=None if self._seeds[0] is None else self._seeds)
        self._reset_seeds()
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return cast(VecEnvObs, observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions for `step_wait`."""
        if self.before_step is not None:
            self.before_step(actions)
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all environments; those whose episode ends are reset in the same step."""
        observations, rewards, terminated, truncated, batch_info = self.env.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        dones = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(dones).tolist():
            infos[i] = self._end(i, batch_info, bool(truncated[i] and not terminated[i]))
        return cast(VecEnvObs, observations), rewards.astype(np.float32), dones, infos

    def _end(self, i: int, batch_info: dict[str, Any], timed_out: bool) -> dict[str, Any]:
        """Return SB3's info dict for the episode that has ended in environment i."""
        final_info = batch_info["final_info"]
        monitor = {
            "r": float(self._returns[i]),
            "l": int(self._lengths[i]),
            "t": time.time() - self._began_s,
        }
        self._returns[i], self._lengths[i] = 0.0, 0
        info = {
            "terminal_observation": batch_info["final_obs"][i],
            "TimeLimit.truncated": timed_out,
            "episode": monitor,
        }
        for key, kind in (("reason", str), ("progress_m", float)):
            if final_info.get(f"_{key}", np.zeros(self.num_envs, dtype=bool))[i]:
                info[key] = kind(final_info[key][i])
        return info

    def close(self) -> None:
        """Close the environments."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the batch, repeated for each environment."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the batch. Its environments have no separate attributes."""
        setattr(self.env, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of the batch, once for all environments."""
        return [getattr(self.env, method_name)(*method_args, **method_kwargs)]

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return False for each environment, because only the batch can be wrapped."""
        return [False] * len(list(self._get_indices(indices)))


class StackedVecEnv(VecEnvWrapper):
    """Wrapper whose observations are stacks of the last k observations."""

    def __init__(self, venv: VecEnv, count: int) -> None:
        """Stack `count` observations; `venv` must reset an environment when its episode ends."""
        self._frames = FrameStack(count)
        super().__init__(venv, stacked_space(venv.observation_space, count))

    def reset(self) -> VecEnvObs:
        """Start new episodes in all environments."""
        self._frames.clear()
        return self._joined(self._frames.see(parts_of(self.venv.reset())))

    def step_wait(self) -> VecEnvStepReturn:
        """Step all environments; stack the observations, and also each `terminal_observation`."""
        observations, rewards, dones, infos = self.venv.step_wait()
        self._frames.see(parts_of(observations))
        for row in np.flatnonzero(dones).tolist():
            last = parts_of(infos[row]["terminal_observation"])
            stack = self._joined(self._frames.ending(row, last))
            infos[row]["terminal_observation"] = mapped(lambda part: part[0], stack)
            self._frames.begin_one(row)
        return self._joined(self._frames.frames), rewards, dones, infos

    def _joined(self, frames: dict[Any, NDArray[Any]]) -> VecEnvObs:
        return cast(VecEnvObs, joined(whole_of(frames), self.venv.observation_space))
