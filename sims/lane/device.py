"""Cars of the lane sim on one device."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from mcaprl.compiled import compiled
from mcaprl.sims.lane.block import advance
from mcaprl.sims.lane.fleet import SHARES, LaneFleet, start_anywhere, start_on_line
from mcaprl.sims.lane.rules import ACTION_COMMANDS, DRIVING, Car, observe, store_car
from mcaprl.sims.vehicle.device import Batch, DeviceSims, begin_episode, finish_step


class World(NamedTuple):
    """Constants of all cars."""

    on_line: bool  # Whether cars start on the start line instead of anywhere


class DeviceLane(DeviceSims):
    """N cars of the lane sim on one device, with the default rules and the observed state."""

    state_size = len(Car._fields)

    def __init__(
        self,
        num_envs: int,
        *,
        device: str,
        seed: int,
        max_episode_steps: int,
        start: str | None = None,
    ) -> None:
        """Allocate the cars; `start` is the argument of `LaneKeepingEnv`."""
        fleet = LaneFleet(1, start=start)
        super().__init__(fleet, num_envs, device, seed, max_episode_steps)
        self._world = World(start == "line")

    @property
    def world(self) -> World:
        """Constants of all cars."""
        return self._world

    def cpu_kernels(self) -> tuple[Callable[..., None], Callable[..., None]]:
        """Return compiled functions that start and step all cars."""
        return _start_cars, _step_cars

    def gpu_kernels(self) -> tuple[Callable[..., None], Callable[..., None]]:
        """Return functions for numba-cuda that start and step the car of a thread."""
        from numba import cuda

        def start(batch: Batch, world: World, seed: Any) -> None:
            i = cuda.grid(1)
            if i < len(batch.actions):
                batch.episodes[i] = 0
                _start_car(batch, world, seed, i, cuda.local.array(SHARES, np.float64))

        def step(batch: Batch, world: World, seed: Any, max_steps: int) -> None:
            i = cuda.grid(1)
            if i < len(batch.actions):
                shares = cuda.local.array(SHARES, np.float64)
                _step_car(batch, world, seed, max_steps, i, shares)

        return start, step


@compiled
def _start_cars(batch: Batch, world: World, seed: Any) -> None:
    shares = np.empty(SHARES)
    for i in range(len(batch.actions)):
        batch.episodes[i] = 0
        _start_car(batch, world, seed, i, shares)


@compiled
def _step_cars(batch: Batch, world: World, seed: Any, max_steps: int) -> None:
    shares = np.empty(SHARES)
    for i in range(len(batch.actions)):
        _step_car(batch, world, seed, max_steps, i, shares)


@compiled
def _start_car(batch: Batch, world: World, seed: Any, i: int, shares: Any) -> None:
    begin_episode(batch, i, seed, shares)
    car = start_on_line(shares) if world.on_line else start_anywhere(shares)
    store_car(car, batch.states[i])
    observe(car, batch.observations[i])


@compiled
def _step_car(batch: Batch, world: World, seed: Any, max_steps: int, i: int, shares: Any) -> None:
    car, reward, end = advance(batch.states[i], ACTION_COMMANDS[batch.actions[i]])
    observe(car, batch.observations[i])
    if finish_step(batch, i, reward, end != DRIVING, False, max_steps):
        _start_car(batch, world, seed, i, shares)
