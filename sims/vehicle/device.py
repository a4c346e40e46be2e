"""Base class of sims whose vehicles stay on one device, a GPU or the CPU, between steps.

The equations of a sim are compiled functions of one vehicle. On the CPU, a loop calls them for each
vehicle. On a GPU, numba-cuda compiles the same functions, and each thread steps one vehicle. Both
use the same random numbers, so episodes differ only by rounding: the GPU fuses some multiplications
and additions, which rounds once instead of twice.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cache, cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from gymnasium import spaces

from mcaprl.compiled import compiled
from mcaprl.errors import UsageError, import_extra
from mcaprl.sims.vehicle.controls import check_name
from mcaprl.sims.vehicle.fleet import Fleet

DEVICES = ("cpu", "cuda")
_THREADS = 64
"""Threads in a block; with few vehicles, small blocks use more of the GPU's multiprocessors."""

# Constants of SplitMix64: G. Steele, D. Lea and C. Flood, "Fast splittable pseudorandom number
# generators", 2014, https://doi.org/10.1145/2660193.2660195.
_GOLDEN, _MIX_1, _MIX_2 = (
    np.uint64(number) for number in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
)
_SHIFT_1, _SHIFT_2, _SHIFT_3, _SPARE_BITS = (
    np.uint64(30),
    np.uint64(27),
    np.uint64(31),
    np.uint64(11),
)


class Batch(NamedTuple):
    """State and outcome of N vehicles: arrays on the device, one row for each vehicle."""

    states: Any
    """(N, S) float64 states, in the order of the sim's state class."""
    actions: Any
    """(N,) int64 actions of the next step."""
    observations: Any
    """(N, V) float32 observations after the last step, of the new episode if one began."""
    final_observations: Any
    """(N, V) float32 observations after the last step, of the old episode if one ended."""
    rewards: Any
    """(N,) float32 rewards of the last step."""
    terminated: Any
    """(N,) bool, whether the last step terminated the episode."""
    truncated: Any
    """(N,) bool, whether the last step truncated the episode."""
    steps: Any
    """(N,) int64 number of steps of the current episode."""
    episodes: Any
    """(N,) int64 number of started episodes."""


class DeviceSims(ABC):
    """N vehicles of one sim with its default rules, stepped together on one device.

    An episode that ends is followed by a new one in the same step, as with Gymnasium's
    `AutoresetMode.SAME_STEP`. To step, write the actions into `batch.actions` and call `step`; then
    read the other arrays of `batch`, which the next step overwrites. The arrays are NumPy's on the
    CPU, and on a GPU they have `__cuda_array_interface__`: `torch.as_tensor` shares their memory.

    Attributes:
        num_envs: Number of vehicles N.
        device: `cpu` or `cuda`.
        batch: Arrays of all vehicles.
        single_observation_space: Observation space of one vehicle.
        single_action_space: Action space of one vehicle.
        max_episode_steps: Steps after which an episode is truncated.
    """

    state_size: ClassVar[int]
    """Number of values in a vehicle's state."""

    def __init__(
        self, fleet: Fleet, num_envs: int, device: str, seed: int, max_episode_steps: int
    ) -> None:
        """Allocate N vehicles with the spaces of `fleet`; `reset` starts them."""
        check_name("device", device, DEVICES)
        if num_envs < 1 or max_episode_steps < 1 or seed < 0:
            raise UsageError(
                "num_envs and max_episode_steps must be at least 1 and seed at least 0, not"
                f" {num_envs}, {max_episode_steps} and {seed}"
            )
        self.num_envs, self.device = num_envs, device
        self.max_episode_steps = max_episode_steps
        self.single_observation_space = fleet.observation_space
        self.single_action_space = spaces.Discrete(len(fleet.controls.meanings))
        self._seed = np.uint64(seed)
        allocate = _gpu().device_array if device == "cuda" else np.zeros
        seen = (num_envs, len(fleet.observation_names))
        self.batch = Batch(
            # Successive threads read successive values of a column.
            states=allocate((num_envs, self.state_size), order="F"),
            actions=allocate(num_envs, np.int64),
            observations=allocate(seen, np.float32),
            final_observations=allocate(seen, np.float32),
            rewards=allocate(num_envs, np.float32),
            terminated=allocate(num_envs, np.bool_),
            truncated=allocate(num_envs, np.bool_),
            steps=allocate(num_envs, np.int64),
            episodes=allocate(num_envs, np.int64),
        )

    def reset(self) -> None:
        """Start a new episode of each vehicle, the first one that belongs to the seed."""
        self._kernels[0](self.batch, self.world, self._seed)

    def step(self) -> None:
        """Advance each vehicle by a step with its unchecked action; on a GPU, return at once."""
        self._kernels[1](self.batch, self.world, self._seed, self.max_episode_steps)

    @property
    @abstractmethod
    def world(self) -> Any:
        """NamedTuple of arrays on the device, and of constants, that all vehicles share."""

    @abstractmethod
    def cpu_kernels(self) -> tuple[Callable[..., None], Callable[..., None]]:
        """Return compiled functions that start and step all vehicles."""

    @abstractmethod
    def gpu_kernels(self) -> tuple[Callable[..., None], Callable[..., None]]:
        """Return functions for numba-cuda that start and step the vehicle of a thread."""

    @cached_property
    def _kernels(self) -> tuple[Callable[..., None], Callable[..., None]]:
        if self.device == "cpu":
            return self.cpu_kernels()
        blocks = -(-self.num_envs // _THREADS)
        with warnings.catch_warnings():
            # numba-cuda warns about fewer blocks than a GPU can run at once.
            warnings.filterwarnings("ignore", ".*Grid size")
            start, step = (_gpu().jit(one)[blocks, _THREADS] for one in self.gpu_kernels())
        return start, step


@compiled
def draw(seed: Any, i: int, episode: int, shares: Any) -> None:
    """Write numbers (K,) from 0 to 1 by SplitMix64, a function of seed, vehicle and episode."""
    state = _mixed(_mixed(_mixed(seed) + np.uint64(i)) + np.uint64(episode))
    for k in range(len(shares)):
        state += _GOLDEN
        shares[k] = float(_mixed(state) >> _SPARE_BITS) * 2.0**-53


@compiled
def _mixed(number: Any) -> Any:
    """Return the output function of SplitMix64, which changes half of the bits on average."""
    number = (number ^ (number >> _SHIFT_1)) * _MIX_1
    number = (number ^ (number >> _SHIFT_2)) * _MIX_2
    return number ^ (number >> _SHIFT_3)


@compiled
def begin_episode(batch: Batch, i: int, seed: Any, shares: Any) -> None:
    """Count a new episode of vehicle i, and draw the random numbers (K,) of its start."""
    draw(seed, i, batch.episodes[i], shares)
    batch.episodes[i] += 1
    batch.steps[i] = 0


@compiled
def finish_step(
    batch: Batch, i: int, reward: float, terminated: bool, truncated: bool, max_steps: int
) -> bool:
    """Store the outcome of a step of vehicle i, and return whether its episode ended."""
    batch.steps[i] += 1
    truncated = truncated or batch.steps[i] >= max_steps
    batch.rewards[i] = reward
    batch.terminated[i] = terminated
    batch.truncated[i] = truncated
    for k in range(batch.observations.shape[1]):
        batch.final_observations[i, k] = batch.observations[i, k]
    return terminated or truncated


def to_gpu(array: Any) -> Any:
    """Return a copy of an array on the GPU."""
    return _gpu().to_device(np.ascontiguousarray(array))


@cache
def _gpu() -> Any:
    """Return numba's module `cuda`, with NumPy's floor, which it does not have."""
    import_extra("numba_cuda", "gpu")
    from numba import cuda
    from numba.cuda import ufuncs
    from numba.cuda.np import npyfuncs

    if not cuda.is_available():
        raise UsageError("device cuda: numba-cuda finds no GPU; use device cpu")
    ufuncs.ufunc_db().setdefault(np.floor, {"d->d": npyfuncs.np_real_floor_impl})
    return cuda
