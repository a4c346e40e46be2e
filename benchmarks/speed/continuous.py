"""Measure updates per second of the learners of Box actions relative to d3rlpy's.

    python -m benchmarks.speed.continuous [--rounds 5] [--turn-s 2.0] [--size 256] [--algo iql]
    python -m benchmarks.speed.continuous --whole [--algo iql]
    python -m benchmarks.speed.continuous --parts [--size 256] [--algo iql]

Both libraries take turns in one process, on the same random transitions (17 numbers, actions of 6)
and with networks of 256x256; otherwise, settings are the defaults. The measure is CPU time on one
thread, the best of several turns. The limit is the ratio that would be reached if our update
consisted of its matrix products alone, at the speed of the largest of them. The ratios are printed
and written to benchmarks/speed/continuous.json, and the table to docs/results.md; with --size or
--algo, they are only printed.

--whole prints the CPU minutes of 100,000 updates of `mcaprl.train` with default settings on 200,000
rows, without d3rlpy. --parts prints the time of the parts of an update, by PyTorch's profiler.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch.utils.flop_counter import FlopCounterMode

import mcaprl
from benchmarks.page import write_section
from benchmarks.speed.learning import Turns, Update, best_rates
from mcaprl.files import write_json
from mcaprl.offline import BOX_ALGORITHMS, TransitionBuffer

ROWS, EPISODE, WIDTH, ACTION = 20_000, 1_000, 17, 6
HIDDEN = (256, 256)
SIZES = (256, 64, 32)
COUNTED = 4
"""Updates whose products are counted: actors learn in every second one."""
RIVALS = {
    "bc": "BCConfig",
    "td3-bc": "TD3PlusBCConfig",
    "iql": "IQLConfig",
    "rebrac": "ReBRACConfig",
}
OPERATIONS = {
    "products": ("bmm", "aten::mm", "addmm"),
    "optimizer": ("_fused_adamw_", "lerp_", "Optimizer"),
    "ReLU": ("relu", "threshold", "clamp_min"),
    "copies": ("cat", "copy_", "clone", "contiguous", "fill_", "zero_", "pad", "index"),
}
"""Parts of the names of PyTorch's operations, by the part of an update."""
GOALS = {("td3-bc", 256): 2.0, ("iql", 256): 2.0}
GOAL = 3.0
RESULTS = Path(__file__).with_name("continuous.json")


def transitions(rows: int = ROWS) -> mcaprl.Dataset:
    """Return random transitions in episodes of 1000."""
    random = np.random.default_rng(0)
    frames = random.normal(size=(rows // EPISODE, EPISODE + 1, WIDTH)).astype(np.float32)
    return mcaprl.Dataset.from_arrays(
        observations=frames[:, :-1].reshape(-1, WIDTH),
        next_observations=frames[:, 1:].reshape(-1, WIDTH),
        actions=random.uniform(-1, 1, (rows, ACTION)).astype(np.float32),
        rewards=random.normal(size=rows),
        terminated=np.zeros(rows, bool),
        truncated=np.arange(1, rows + 1) % EPISODE == 0,
        action_space=spaces.Box(-1, 1, (ACTION,), np.float32),
    )


def ours(data: mcaprl.Dataset, algo: str, batch_size: int, seeds: int = 1) -> Update:
    """Return a function that makes one update of mcaprl's learner."""
    learner_type = BOX_ALGORITHMS[algo]
    config = learner_type.config_type(batch_size=batch_size, hidden=HIDDEN)
    buffer = TransitionBuffer.from_dataset(data, config.packing)
    return learner_type(config, buffer, range(seeds)).update


def d3rlpys(data: mcaprl.Dataset, algo: str, batch_size: int) -> Update:
    """Return a function that draws a batch from d3rlpy's buffer and makes one update."""
    import d3rlpy

    log = d3rlpy.dataset.MDPDataset(
        data.observations,
        data.actions,
        data.rewards.astype(np.float32),
        data.terminated.astype(np.float32),
        data.truncated.astype(np.float32),
        action_space=d3rlpy.ActionSpace.CONTINUOUS,
    )
    encoder = d3rlpy.models.VectorEncoderFactory(list(HIDDEN))
    normed = d3rlpy.models.VectorEncoderFactory(list(HIDDEN), use_layer_norm=True)
    settings: dict[str, Any] = {"encoder_factory": encoder}
    if algo != "bc":
        # The critics of ReBRAC have layer normalization, as in its paper.
        critics = normed if algo == "rebrac" else encoder
        settings = {"actor_encoder_factory": encoder, "critic_encoder_factory": critics}
    config = getattr(d3rlpy.algos, RIVALS[algo])(batch_size=batch_size, **settings)
    learner = config.create("cpu")
    learner.build_with_dataset(log)
    return lambda: learner.update(log.sample_transition_batch(batch_size))


def rates_and_limit(update: Update, rival: Update, size: int, turns: Turns) -> list[float]:
    """Return the updates per CPU second of both sides, and those of ours as products alone."""
    with FlopCounterMode(display=False) as counter:
        for _ in range(COUNTED):
            update()
    weights, columns = torch.randn(2, HIDDEN[0], HIDDEN[1]), torch.randn(2, HIDDEN[1], size)
    product_flops = 2 * weights.numel() * size
    sides: dict[str, tuple[Update, int]] = {
        "ours": (update, 1),
        "rival": (rival, 1),
        "product": (lambda: torch.bmm(weights, columns), 1),
    }
    rates = best_rates(sides, turns)
    limit = rates["product"] * product_flops * COUNTED / counter.get_total_flops()
    return [rates["ours"], rates["rival"], limit]


def ratios(algo: str, size: int, turns: Turns) -> tuple[float, float, float]:
    """Return our updates per CPU second, their ratio to d3rlpy's, and the limit of the ratio."""
    data = transitions()
    found = rates_and_limit(ours(data, algo, size), d3rlpys(data, algo, size), size, turns)
    print(algo, size, [round(rate, 1) for rate in found], flush=True)
    mine, theirs, limit = found
    return mine, mine / theirs, limit / theirs


def parts(name: str, update: Update, updates: int = 100) -> None:
    """Print the milliseconds of an update, and of its parts."""
    for _ in range(updates):
        update()
    rate = best_rates({"ours": (update, 1)}, Turns(5, 0.5))["ours"]
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as found:
        for _ in range(updates):
            update()
    spent = dict.fromkeys((*OPERATIONS, "other"), 0.0)
    for event in found.key_averages():
        named = (part for part, names in OPERATIONS.items() if any(n in event.key for n in names))
        spent[next(named, "other")] += event.self_cpu_time_total / updates / 1e3
    columns = " | ".join(f"{time_ms:.2f}" for time_ms in spent.values())
    print(f"| {name} | {1e3 / rate:.2f} | {columns} |", flush=True)


def whole(algo: str, rows: int = 200_000, updates: int = 100_000) -> None:
    """Print the CPU minutes of a whole training."""
    data = transitions(rows)
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        mcaprl.train(data, Path(folder, "run"), algo=algo, updates=updates)
        minutes = (time.process_time() - start) / 60
    print(f"| {algo}, {updates:,} updates on {rows:,} rows | {minutes:.1f} min |", flush=True)


def main() -> None:
    """Measure, print ratios, and write them."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--turn-s", type=float, default=2.0)
    parser.add_argument("--size", type=int, choices=SIZES)
    parser.add_argument("--algo", choices=RIVALS)
    parser.add_argument("--whole", action="store_true")
    parser.add_argument("--parts", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    algos = [given.algo] if given.algo else list(RIVALS)
    sizes = [given.size] if given.size else list(SIZES)
    if given.whole or given.parts:
        for algo in algos:
            if given.whole:
                whole(algo)
            for size in sizes if given.parts else ():
                parts(f"{algo}, batch {size}", ours(transitions(), algo, size))
        return
    turns = Turns(given.rounds, given.turn_s)
    found = {f"{algo}, batch {size}": ratios(algo, size, turns) for size in sizes for algo in algos}
    print(table := as_table(found))
    if not (given.size or given.algo):
        write_json(RESULTS, json.loads(json.dumps(found)))
        write_section("continuous-speed", table)


def as_table(found: dict[str, tuple[float, float, float]]) -> str:
    """Return the table as Markdown, with the goals, the limits and the versions."""
    lines = ["| what | updates per CPU second | d3rlpy's times | goal | limit |"]
    lines.append("|---|---|---|---|---|")
    for name, (rate, ratio, limit) in found.items():
        algo, size = name.split(", batch ")
        goal = GOALS.get((algo, int(size)), "" if algo == "rebrac" and size == "256" else GOAL)
        lines.append(f"| {name} | {rate:.0f} | {ratio:.2f} | {goal} | {limit:.2f} |")
    versions = ", ".join(f"{name} {version(name)}" for name in ("torch", "d3rlpy"))
    return "\n".join([*lines, "", f"Versions: {versions}."])


if __name__ == "__main__":
    main()
