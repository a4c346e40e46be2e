"""Measure how well the car's speed is predicted from its depth images and its last commands.

    python -m benchmarks.studies.image_speed

The data are 40,000 decisions of the lane sim's pilot with 5 to 50 % random actions, from random
starts. A network with the architecture of online training is trained on four fifths of the
episodes. The table has the explained fraction of the speed's variance (R^2) in the other episodes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, cast

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from mcaprl.networks import Architecture, ImageInput, Network
from mcaprl.sims import make_pilot, make_sim

DECISIONS: Final = 40_000
MAX_SPEED_M_S: Final = 30.0
EPSILONS: Final = (0.05, 0.1, 0.2, 0.3, 0.5)
UPDATES: Final = 4_000
BATCH: Final = 64
HELD_OUT: Final = 5
"""One of this many episodes is held out."""
LATE: Final = 16
"""Number of decisions after the start from which R^2 is computed separately."""
VARIANTS: Final = ((4, 0), (4, 8), (4, 32), (1, 32))
"""Numbers of images and of decisions whose commands are known."""
ARCHITECTURE: Final = Architecture((256, 256), layer_norm=True, encoder="compact")


class Inputs(NamedTuple):
    """Batch of observations in the form that `Network` accepts."""

    vector: Tensor
    images: tuple[Tensor, ...]


@dataclass(frozen=True)
class Drives:
    """Decisions of a car, one array row for each decision.

    Attributes:
        images: (R, 42, 42) uint8 images before the decision.
        commands: (R, 64) last commands.
        speeds: (R,) speeds as a fraction of 30 m/s.
        ages: (R,) numbers of earlier decisions in the episode.
        episodes: (R,) numbers of the episodes.
    """

    images: NDArray[np.uint8]
    commands: NDArray[np.float32]
    speeds: NDArray[np.float32]
    ages: NDArray[np.int64]
    episodes: NDArray[np.int64]

    def stacks(self, rows: NDArray[np.int64], count: int) -> Tensor:
        """Return the last `count` images (B, 42, 42, count) of the same episode, oldest first."""
        before = np.minimum(np.arange(count)[::-1], self.ages[rows, None])
        return torch.from_numpy(np.moveaxis(self.images[rows[:, None] - before], 1, -1))

    def inputs(self, rows: NDArray[np.int64], images: int, decisions: int) -> Inputs:
        """Return the network's inputs in these rows."""
        commands = torch.from_numpy(self.commands[rows, : 2 * decisions])
        return Inputs(commands, (self.stacks(rows, images),))


def drive() -> Drives:
    """Drive the car, and return its decisions."""
    random = np.random.default_rng(0)
    with closing(make_sim("lane", observation="depth-commands")) as env:
        decisions = list(_decisions(env, random))
    return Drives(*(np.array(column) for column in zip(*decisions, strict=True)))


def _decisions(
    env: gym.Env[Any, Any], random: np.random.Generator
) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.float32], np.float32, int, int]]:
    """Yield the columns of `Drives` for each decision."""
    pilot, actions = make_pilot(env), int(cast(spaces.Discrete, env.action_space).n)
    age = episode = 0
    seen, info = env.reset(seed=0)
    epsilon = random.choice(EPSILONS)
    for _ in range(DECISIONS):
        speed = np.float32(info["speed_m_s"] / MAX_SPEED_M_S)
        yield _averaged(seen["depth"]), seen["commands"].copy(), speed, age, episode
        action = int(pilot.act({name: value[None] for name, value in seen.items()})[0])
        if random.random() < epsilon:
            action = int(random.integers(actions))
        seen, _, terminated, truncated, info = env.step(action)
        age += 1
        if terminated or truncated:
            age, episode = 0, episode + 1
            seen, info = env.reset()
            epsilon = random.choice(EPSILONS)


def _averaged(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Average an image (84, 84, 1) over squares of 2x2 pixels."""
    squares = image.reshape(42, 2, 42, 2).mean((1, 3))
    averaged: NDArray[np.uint8] = np.rint(squares).astype(np.uint8)
    return averaged


def explained(drives: Drives, images: int, decisions: int) -> tuple[float, float]:
    """Return R^2 in all held-out decisions, and in those `LATE` or more after the start."""
    torch.manual_seed(0)
    random = np.random.default_rng(0)
    is_held_out = drives.episodes % HELD_OUT == 0
    known, held_out = np.flatnonzero(~is_held_out), np.flatnonzero(is_held_out)
    camera = ImageInput((42, 42, 1)).normalized_to(drives.images[known]).stacked(images)
    network = Network(2 * decisions, [camera], (1,), ARCHITECTURE)
    optimizer = torch.optim.AdamW(network.parameters(), 5e-4)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.04, UPDATES)
    deviation = float(drives.speeds.std())
    for _ in range(UPDATES):
        rows = random.choice(known, BATCH)
        wanted = torch.from_numpy(drives.speeds[rows] / deviation)
        loss = functional.mse_loss(network(drives.inputs(rows, images, decisions))[:, 0], wanted)
        optimizer.zero_grad()
        torch.autograd.backward(loss)
        optimizer.step()
        schedule.step()
    with torch.inference_mode():
        parts = np.array_split(held_out, len(held_out) // 500 + 1)
        found = [network(drives.inputs(rows, images, decisions))[:, 0].numpy() for rows in parts]
    speeds, is_late = drives.speeds[held_out], drives.ages[held_out] >= LATE
    errors = deviation * np.concatenate(found) - speeds
    return _r_squared(errors, speeds), _r_squared(errors[is_late], speeds[is_late])


def _r_squared(errors: NDArray[np.floating], values: NDArray[np.floating]) -> float:
    return 1.0 - float(np.square(errors).mean() / values.var())


def main() -> None:
    """Print a row for each variant."""
    torch.set_num_threads(1)
    drives = drive()
    print("| images | known decisions | R^2 | 4 s or more after the start |\n|---|---|---|---|")
    for images, decisions in VARIANTS:
        everywhere, late = explained(drives, images, decisions)
        print(f"| {images} | {decisions} | {everywhere:.3f} | {late:.3f} |", flush=True)


if __name__ == "__main__":
    main()
