"""Measures recording, writing, reading and the sims beside other libraries: `make bench`.

All sides run in one process, in turns, on the same data, by CPU time, and the best of several turns
counts. What is printed are ratios: seconds depend on the machine, ratios much less.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import zstandard
from gymnasium import spaces
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory

import mcaprl
from benchmarks import sims
from mcaprl.recorder.mcap_reader import McapReader
from mcaprl.recorder.schema import message_dtype, step_schema

ROUNDS = 3
EPISODES, LENGTH = 100, 1000
OBSERVATION = spaces.Box(-np.inf, np.inf, (19,), np.float32)
ACTION = spaces.Discrete(9)
RESULTS = Path(__file__).parent / "results.json"


class Constant(gym.Env[Any, Any]):
    """Costs next to nothing, so that what a recorder adds can be seen."""

    observation_space, action_space = OBSERVATION, ACTION

    def __init__(self) -> None:
        """Prepare the one observation."""
        self.observation = np.arange(19, dtype=np.float32)
        self.step_number = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode of LENGTH steps."""
        self.step_number = 0
        return self.observation, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Give the same observation again."""
        self.step_number += 1
        return self.observation, 1.0, False, self.step_number == LENGTH, {}


def dataset() -> mcaprl.Dataset:
    """EPISODES times LENGTH random transitions of 19 numbers and 9 actions."""
    random = np.random.default_rng(0)
    frames = random.normal(size=(EPISODES, LENGTH + 1, 19)).astype(np.float32)
    steps = EPISODES * LENGTH
    ends = np.arange(1, steps + 1) % LENGTH == 0
    return mcaprl.Dataset.from_arrays(
        observations=frames[:, :-1].reshape(steps, 19),
        next_observations=frames[:, 1:].reshape(steps, 19),
        actions=random.integers(9, size=steps),
        rewards=random.normal(size=steps),
        terminated=np.zeros(steps, bool),
        truncated=ends,
        action_space=ACTION,
    )


def run_env(env: gym.Env[Any, Any]) -> None:
    """Step through all episodes."""
    for _ in range(EPISODES):
        env.reset()
        for _ in range(LENGTH):
            env.step(3)
    env.close()


def write_with_mcap(data: mcaprl.Dataset, path: Path) -> None:
    """The same messages, one call each, by the `mcap` package's own Writer."""
    name, text = step_schema(OBSERVATION, ACTION)
    dtype = message_dtype(text)
    assert dtype is not None
    messages = np.zeros(len(data), dtype)
    messages["encapsulation"] = 0x0100
    messages["observation"], messages["action"] = data.observations, data.actions
    messages["reward"] = data.rewards
    size, buffer = dtype.itemsize, messages.tobytes()
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start("ros2")
        schema = writer.register_schema(name, "ros2msg", text.encode())
        channel = writer.register_channel("/rl/step", "cdr", schema)
        for row in range(len(messages)):
            writer.add_message(channel, row, buffer[row * size : (row + 1) * size], row, row)
        writer.finish()


def read_with_mcap(path: Path) -> Any:
    """Into the same columns, one message each, by `mcap` and `mcap-ros2-support`."""
    columns: dict[str, list[Any]] = {"observation": [], "action": [], "reward": []}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, _, _, message in reader.iter_decoded_messages(["/rl/step"]):
            for field, values in columns.items():
                values.append(getattr(message, field))
    return {field: np.array(values) for field, values in columns.items()}


def decompress(path: Path) -> None:
    """Nothing but zstd over the chunks of `/rl/step`: what a reader cannot do without."""
    reader = McapReader(path)
    channel = reader.channel_of("/rl/step")
    assert channel is not None
    for chunk in reader.chunks:
        if channel.id in chunk.message_index_offsets:
            start = chunk.chunk_start_offset + chunk.chunk_length - chunk.compressed_size
            zstandard.decompress(reader.view[start : start + chunk.compressed_size])


def best_seconds(sides: dict[str, Callable[[], object]]) -> dict[str, float]:
    """CPU seconds of each side, the best of ROUNDS turns."""
    best = dict.fromkeys(sides, float("inf"))
    for _ in range(ROUNDS):
        for name, side in sides.items():
            start = time.process_time()
            side()
            best[name] = min(best[name], time.process_time() - start)
    return best


def main() -> None:
    """Measure, print ratios, and write them to results.json."""
    data = dataset()
    with tempfile.TemporaryDirectory() as folder:
        log, other, scratch = (Path(folder) / f"{name}.mcap" for name in ("log", "other", "new"))
        data.save(log)
        write_with_mcap(data, other)

        def record() -> None:
            run_env(mcaprl.RecordMcap(Constant(), scratch, overwrite=True))

        recording = best_seconds({"bare": lambda: run_env(gym.Wrapper(Constant())), "ours": record})
        writing = best_seconds(
            {
                "ours": lambda: data.save(scratch, overwrite=True),
                "mcap": lambda: write_with_mcap(data, other),
            }
        )
        reading = best_seconds(
            {
                "zstd": lambda: decompress(log),
                "ours": lambda: mcaprl.open(log).observations,
                "mcap": lambda: read_with_mcap(log),
            }
        )
        bytes_per_step = log.stat().st_size / len(data)
    added = recording["ours"] - recording["bare"]
    results = {
        "recording, added CPU time per step / that of mcap's Writer": added / writing["mcap"],
        "bulk write, times faster than mcap's Writer": writing["mcap"] / writing["ours"],
        "read to columns, times faster than mcap + mcap-ros2-support": reading["mcap"]
        / reading["ours"],
        "read to columns, share of plain zstd's speed": reading["zstd"] / reading["ours"],
        "bytes per transition on disk (raw: 97)": bytes_per_step,
    }
    timed = sims.sides()
    seconds = best_seconds({name: side.run for name, side in timed.items()})
    results |= sims.ratios(seconds, timed)
    for name, value in results.items():
        print(f"{value:10.2f}  {name}")
    RESULTS.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
