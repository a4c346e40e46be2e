"""Estimate the resources for many transitions from rates that are measured here.

    python -m benchmarks.ray.sizing [--transitions 1e9] [--sim lane] [--workers 64]

Rates are CPU time in one process, on a log of a few thousand transitions. The prices are examples:
replace them with those of your provider. Nothing here measures a network or several machines.
"""

from __future__ import annotations

import argparse
import struct
import tempfile
from dataclasses import dataclass
from pathlib import Path

import mcaprl
from benchmarks.measure import cpu_s
from mcaprl.offline import TransitionBuffer
from mcaprl.recorder import LogReader

EPISODES = 60
FILE_BYTES = 1e9


@dataclass(frozen=True)
class Rates:
    """Measured sizes and times.

    Attributes:
        episode_steps: Transitions of an episode.
        log_bytes: Bytes of a log for each transition.
        index_bytes: Bytes of a log's summary section for each transition.
        buffer_bytes: Bytes of memory for each transition in training.
        record_s: CPU time of recording a transition.
        read_s: CPU time of reading a transition.
        index_s: CPU time of reading the summary of a log, for each transition.
    """

    episode_steps: float
    log_bytes: float
    index_bytes: float
    buffer_bytes: float
    record_s: float
    read_s: float
    index_s: float


def measure(sim: str) -> Rates:
    """Record a log of a sim, read it, and pack it for training."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        # The first episodes compile the sim.
        mcaprl.record(sim, path, episodes=2)
        record_s = cpu_s(
            lambda: mcaprl.record(sim, path, episodes=EPISODES, epsilon=0.1, overwrite=True)
        )
        data = mcaprl.open(path)
        read_s = min(cpu_s(lambda: mcaprl.open(path)) for _ in range(5))
        index_s = min(cpu_s(lambda: LogReader(path).lengths) for _ in range(5))
        content = path.read_bytes()
    # The fields from the end of an MCAP file backward: magic (8 bytes), CRC (4), summary offset
    # start (8), summary start (8).
    (summary,) = struct.unpack("<Q", content[-28:-20])
    buffer, count = TransitionBuffer.from_dataset(data), len(data)
    frames = buffer.frames.parts()
    tensors = [*frames, buffer.starts, buffer.places, buffer.actions, buffer.returns]
    memory = sum(one.numel() * one.element_size() for one in tensors)
    return Rates(
        count / len(data.episodes),
        len(content) / count,
        (len(content) - summary) / count,
        memory / count,
        record_s / count,
        read_s / count,
        index_s / count,
    )


def sizing(
    rates: Rates, transitions: float, workers: int, cpu_price: float, store_price: float
) -> list[tuple[str, str, str]]:
    """Return the quantities, their values, and how they are computed."""
    total = transitions * rates.log_bytes
    files = max(total / FILE_BYTES, 1)
    record_h, read_h = (transitions * one / 3600 for one in (rates.record_s, rates.read_s))
    episodes = transitions / rates.episode_steps
    return [
        ("episodes", f"{episodes:.3g}", f"/ {rates.episode_steps:.0f} steps each"),
        ("logs", f"{total / 1e9:.3g} GB", f"x {rates.log_bytes:.0f} B"),
        ("files of 1 GB", f"{files:.0f}", "`--shards`"),
        (
            "summaries of all files",
            f"{transitions * rates.index_bytes / 1e9:.3g} GB",
            f"x {rates.index_bytes:.2f} B; read once by the calling process",
        ),
        ("reading the summaries", f"{transitions * rates.index_s / 60:.3g} CPU minutes", ""),
        (
            "memory for training, each worker",
            f"{transitions * rates.buffer_bytes / 1e9:.3g} GB",
            f"x {rates.buffer_bytes:.0f} B; about twice as much while it reads",
        ),
        (
            f"recording by {workers} workers",
            f"{record_h / workers:.3g} hours",
            f"{1 / rates.record_s:,.0f} transitions per CPU second",
        ),
        (
            f"reading by {workers} workers",
            f"{read_h / workers * 60:.3g} minutes",
            f"{1 / rates.read_s:,.0f} transitions per CPU second",
        ),
        ("price of recording", f"{record_h * cpu_price:.3g} $", f"{cpu_price:g} $ per CPU hour"),
        (
            "price of storage",
            f"{total / 1e9 * store_price:.3g} $ a month",
            f"{store_price:g} $ per GB and month",
        ),
    ]


def main() -> None:
    """Print the sizing."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--transitions", type=float, default=1e9)
    parser.add_argument("--sim", default="lane")
    parser.add_argument("--workers", type=int, default=64)
    parser.add_argument("--cpu-price", type=float, default=0.04, help="dollars per CPU hour")
    parser.add_argument("--store-price", type=float, default=0.023, help="dollars per GB and month")
    given = parser.parse_args()
    rows = sizing(
        measure(given.sim), given.transitions, given.workers, given.cpu_price, given.store_price
    )
    print(f"| {given.transitions:.0e} transitions of {given.sim} | | from |\n|---|---|---|")
    for row in rows:
        print("|", " | ".join(row).strip(), "|")


if __name__ == "__main__":
    main()
