"""Cars of the racer sim on one device."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from mcaprl.compiled import compiled
from mcaprl.sims.geometry import Path
from mcaprl.sims.racer.course import Car, Track, store_car
from mcaprl.sims.racer.fleet import ANYWHERE, RacerFleet, start_anywhere, start_on_line
from mcaprl.sims.racer.rays import BLOCK_SIZE
from mcaprl.sims.racer.rules import ACTION_COMMANDS, CRASH, advance, observe_with
from mcaprl.sims.vehicle.device import Batch, DeviceSims, begin_episode, finish_step, to_gpu


class World(NamedTuple):
    """Track and constants of all cars."""

    track: Track
    drift: bool
    on_line: bool  # Whether cars start near the start line instead of anywhere


class DeviceRacer(DeviceSims):
    """N cars of the racer sim on one device, with the default rules and nine actions."""

    state_size = len(Car._fields)

    def __init__(
        self,
        num_envs: int,
        *,
        device: str,
        seed: int,
        max_episode_steps: int,
        start: str | None = None,
        drift: bool = False,
        track_seed: int | None = None,
    ) -> None:
        """Allocate the cars; the last three arguments are those of `RacerEnv`."""
        fleet = RacerFleet(1, start=start, drift=drift, track_seed=track_seed)
        super().__init__(fleet, num_envs, device, seed, max_episode_steps)
        self._track, self._drift, self._on_line = fleet.track, drift, start == "line"

    @cached_property
    def world(self) -> World:
        """Track and constants of all cars."""
        track = self._track
        if self.device == "cuda":
            points_m, along_m, yaw_rad, forward = (to_gpu(array) for array in track.path[:4])
            path = Path(points_m, along_m, yaw_rad, forward, track.path.length_m)
            track = Track(to_gpu(track.walls_px), to_gpu(track.gates_px), path, track.start_px)
        return World(track, self._drift, self._on_line)

    def cpu_kernels(self) -> tuple[Callable[..., None], Callable[..., None]]:
        """Return compiled functions that start and step all cars."""
        return _start_cars, _step_cars

    def gpu_kernels(self) -> tuple[Callable[..., None], Callable[..., None]]:
        """Return functions for numba-cuda that start and step the car of a thread."""
        from numba import cuda

        def start(batch: Batch, world: World, seed: Any) -> None:
            i = cuda.grid(1)
            if i < len(batch.actions):
                block = cuda.local.array(BLOCK_SIZE, np.float64)
                batch.episodes[i] = 0
                _start_car(batch, world, seed, i, block)

        def step(batch: Batch, world: World, seed: Any, max_steps: int) -> None:
            i = cuda.grid(1)
            if i < len(batch.actions):
                block = cuda.local.array(BLOCK_SIZE, np.float64)
                _step_car(batch, world, seed, max_steps, i, block)

        return start, step


@compiled
def _start_cars(batch: Batch, world: World, seed: Any) -> None:
    block = np.empty(BLOCK_SIZE)
    for i in range(len(batch.actions)):
        batch.episodes[i] = 0
        _start_car(batch, world, seed, i, block)


@compiled
def _step_cars(batch: Batch, world: World, seed: Any, max_steps: int) -> None:
    block = np.empty(BLOCK_SIZE)
    for i in range(len(batch.actions)):
        _step_car(batch, world, seed, max_steps, i, block)


@compiled
def _start_car(batch: Batch, world: World, seed: Any, i: int, block: Any) -> None:
    # The block is not yet in use, so it holds the random numbers.
    shares = block[:ANYWHERE]
    begin_episode(batch, i, seed, shares)
    if world.on_line:
        car = start_on_line(world.track, shares)
    else:
        car = start_anywhere(world.track, shares)
    store_car(car, batch.states[i])
    observe_with(world.track, car, False, block, batch.observations[i])


@compiled
def _step_car(batch: Batch, world: World, seed: Any, max_steps: int, i: int, block: Any) -> None:
    row, command, track = batch.states[i], ACTION_COMMANDS[batch.actions[i]], world.track
    car, reward, end = advance(track, row, command, False, world.drift)
    observe_with(track, car, False, block, batch.observations[i])
    terminated, truncated = end == CRASH, end > CRASH
    if finish_step(batch, i, reward, terminated, truncated, max_steps):
        _start_car(batch, world, seed, i, block)
