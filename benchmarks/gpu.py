"""Updates per second on a GPU: data on the device, the update one CUDA graph, K seeds in a batch.

    python -m benchmarks.gpu [--seeds 1,4,16,64] [--updates 2000]

Three ways to make the same updates of CQL (19 numbers, 9 actions, 256x256, batch 256): launched
kernel by kernel, as a graph, and, as the limit of the device, nothing but the matrix products of
these updates (forward, next states, and backward for weights and inputs) in a graph of their own.
The share of the limit is the time of these products over that of our update. Prints a table, and
writes it to benchmarks/gpu.json. Where torch finds no GPU, nothing is measured, and that is said.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.workloads import vectors
from mcaprl.offline import CQL, CQLConfig, TransitionBuffer

ROWS, BATCH, WIDTHS = 1_000_000, 256, (19, 256, 256, 9)
RESULTS = Path(__file__).with_name("gpu.json")


def main() -> None:
    """Measure all numbers of seeds."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", default="1,4,16,64")
    parser.add_argument("--updates", type=int, default=2_000)
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        print(f"nothing measured: torch {torch.__version__} finds no CUDA device", file=sys.stderr)
        return
    device = torch.device("cuda")
    name = torch.cuda.get_device_name(device)
    config = CQLConfig(batch_size=BATCH)
    buffer = TransitionBuffer.from_dataset(vectors(ROWS), config.packing).to(device)
    print(f"{name}; updates a second, of one seed each, in batches of {BATCH}")
    print("| seeds | kernel by kernel | as a graph | bare matrix products | share of the limit |")
    print("|---|---|---|---|---|")
    rows = []
    for seeds in map(int, arguments.seeds.split(",")):
        rates = measure(config, buffer, seeds, arguments.updates)
        share = rates["graph"] / rates["limit"]
        print(f"| {seeds} | {' | '.join(f'{r:.0f}' for r in rates.values())} | {share:.0%} |")
        rows.append({"seeds": seeds, **rates, "share": share})
    RESULTS.write_text(json.dumps({"device": name, "rows": rows}, indent=2) + "\n")


def measure(
    config: CQLConfig, buffer: TransitionBuffer, seeds: int, updates: int
) -> dict[str, float]:
    """Updates of one seed per second of wall time, each way."""
    learner = CQL(config, buffer, range(seeds))
    sides: dict[str, Callable[[], object]] = {
        "eager": eager(CQL(config, buffer, range(seeds))),
        "graph": learner.update,
        "limit": bare_products(seeds, buffer.device),
    }
    return {name: seeds * rate(side, updates) for name, side in sides.items()}


def eager(learner: CQL) -> Callable[[], object]:
    """The same update without a graph: launched kernel by kernel, nothing waited for."""
    update = learner.static_update
    assert update is not None
    update._run = update._update
    return learner.update


def bare_products(seeds: int, device: torch.device) -> Callable[[], object]:
    """The matrix products of an update, and nothing else, as a graph."""
    layers = [
        tuple(
            torch.randn(seeds, *shape, device=device) for shape in ((BATCH, n), (m, n), (BATCH, m))
        )
        for n, m in itertools.pairwise(WIDTHS)
    ]

    def run() -> None:
        for number, (inputs, matrix, slope) in enumerate(layers):
            products(inputs, matrix, slope, with_inputs=number > 0)

    cuda: Any = torch.cuda
    stream = cuda.Stream()
    stream.wait_stream(cuda.current_stream())
    with cuda.stream(stream):
        run()
    cuda.current_stream().wait_stream(stream)
    graph = cuda.CUDAGraph()
    with cuda.graph(graph):
        run()
    replay: Callable[[], object] = graph.replay
    return replay


def products(inputs: Tensor, matrix: Tensor, slope: Tensor, *, with_inputs: bool) -> None:
    """Forward for states and next states, backward for weights and, but at first, for inputs."""
    torch.bmm(inputs, matrix.mT)
    torch.bmm(inputs, matrix.mT)
    torch.bmm(slope.mT, inputs)
    if with_inputs:
        torch.bmm(slope, matrix)


def rate(run: Callable[[], object], count: int) -> float:
    """Calls per second, the best of three turns, behind a tenth of a turn to warm up."""
    best = 0.0
    for _ in range(count // 10):
        run()
    for _ in range(3):
        torch.cuda.synchronize()
        start = time.perf_counter()
        for _ in range(count):
            run()
        torch.cuda.synchronize()
        best = max(best, count / (time.perf_counter() - start))
    return best


if __name__ == "__main__":
    main()
