"""Measure the sims on a GPU, without and with learning, beside one core of the same machine.

`python -m benchmarks.speed.gpu_sims` prints, for each sim and number of vehicles, millions of steps
per second of wall time on the GPU and on one core: the median of several turns, and their range.
With `--learn`, it also trains Double DQN (`mcaprl train-online lane --device cuda`), with matrix
products in float32, and prints the steps and updates per second of all seeds. Without a GPU, it
says so and ends.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch

from mcaprl.device import device_task, make_agents
from mcaprl.sims import make_device_sims

SIMS = ("lane", "racer")
COUNTS = (65_536, 1_048_576)
CPU_COUNT = 1_024
TURNS = 7


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--learn", action="store_true", help="also measure training")
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        print("no CUDA device: nothing is measured")
        return
    print(f"{torch.cuda.get_device_name()}, {TURNS} turns: median [lowest, highest]")
    for sim in SIMS:
        one_core = _steps_only(sim, "cpu", CPU_COUNT, 50)
        print(f"{sim}, one core, {CPU_COUNT:,} vehicles: {_show(one_core)} M steps/s")
        for count in COUNTS:
            rates = _steps_only(sim, "cuda", count, 200 if count < 1_000_000 else 40)
            ratio = statistics.median(rates) / statistics.median(one_core)
            print(f"{sim}, GPU, {count:,} vehicles: {_show(rates)} M steps/s, {ratio:.0f} x")
    if arguments.learn:
        for sim, seeds in (("lane", 8), ("lane", 32), ("racer", 32)):
            print(
                f"{sim}, Double DQN, {seeds} seeds of {65_536 // seeds:,}: {_learning(sim, seeds)}"
            )


def _steps_only(sim: str, device: str, count: int, steps: int) -> list[float]:
    """Return millions of steps per second in each turn; random actions are drawn beforehand."""
    sims = make_device_sims(sim, count, device=device)
    sims.reset()
    actions = torch.as_tensor(sims.batch.actions, device=device)
    random = torch.randint(int(sims.single_action_space.n), (8, count), device=device)

    def turn() -> None:
        for k in range(steps):
            actions.copy_(random[k % 8])
            sims.step()

    return [count * steps / 1e6 / seconds for seconds in _seconds(turn, device)]


def _learning(sim: str, seeds: int) -> str:
    """Return the steps and updates per second of a training, after the random steps."""
    task = device_task(sim, envs=65_536 // seeds)
    config: Any = task.config
    sims = make_device_sims(sim, 65_536, device="cuda")
    agents = make_agents(sims, config, range(seeds), torch.device("cuda"))
    while agents.learner.step < 64:
        agents.step()
    counts: list[Any] = []

    def turn() -> None:
        before = agents.steps, agents.learner.step
        for _ in range(20):
            agents.step()
        counts.append((agents.steps - before[0], agents.learner.step - before[1]))

    seconds = _seconds(turn, "cuda")
    steps, updates = counts[-1]
    million = [seeds * steps / 1e6 / each for each in seconds]
    rate = statistics.median(seeds * updates / each for each in seconds)
    size = f"{config.batch_size} transitions, hidden {config.hidden}"
    return f"{_show(million)} M steps/s and {rate:,.0f} updates/s ({size})"


def _seconds(turn: Callable[[], None], device: str) -> list[float]:
    """Return the wall time of each turn, after a turn that warms up."""
    seconds = []
    for _ in range(TURNS + 1):
        _wait(device)
        began = time.perf_counter()
        turn()
        _wait(device)
        seconds.append(time.perf_counter() - began)
    return seconds[1:]


def _wait(device: str) -> None:
    """Wait until the device has finished."""
    if device == "cuda":
        torch.cuda.synchronize()


def _show(rates: list[float]) -> str:
    return f"{statistics.median(rates):.3g} [{min(rates):.3g}, {max(rates):.3g}]"


if __name__ == "__main__":
    main()
