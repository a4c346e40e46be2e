"""A writer that is interrupted while it compresses a chunk leaves a consistent file."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mcaprl
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.columns.records import message_rows
from mcaprl.recorder.columns.writer import McapWriter
from mcaprl.sims import make_sim

pytestmark = pytest.mark.usefixtures("python_signals")
START_NS = 10**18


def interrupt_chunk(writer: McapWriter, number: int) -> None:
    """Send SIGINT to this process during the compression of chunk `number`, counted from 0."""
    done = [0]

    def interrupted(compress: Callable[[Any], bytes]) -> Callable[[Any], bytes]:
        def call(records: Any) -> bytes:
            done[0] += 1
            if done[0] == number + 1:
                signal.raise_signal(signal.SIGINT)
            return compress(records)

        return call

    compressors = writer._compressors
    for name in ("short", "long", "mixed", "few", "rare"):
        setattr(compressors, name, interrupted(getattr(compressors, name)))


def write_rows(writer: McapWriter, channel_id: int) -> None:
    rows = message_rows(3, np.dtype("V12"), channel_id)
    rows["log_time"] = START_NS + np.arange(3)
    writer.write_rows(rows)


def write_messages(writer: McapWriter, channel_id: int) -> None:
    data = b"\0\1\0\0" + bytes(8)
    writer.write_messages([(channel_id, START_NS + k, data) for k in range(3)])


@pytest.mark.parametrize("write", [write_rows, write_messages])
def test_the_summary_counts_only_written_messages(
    write: Callable[[McapWriter, int], None], log_path: Path
) -> None:
    writer = McapWriter(log_path)
    channel_id = writer.add_channel("/x", "std_msgs/msg/Float64", "float64 data")
    interrupt_chunk(writer, 1)
    write(writer, channel_id)
    with pytest.raises(KeyboardInterrupt):
        write(writer, channel_id)
    write(writer, channel_id)
    writer.close()
    reader = McapReader(log_path)
    channel = reader.channel_of("/x")
    assert channel is not None
    assert len(list(reader.messages(channel))) == 6


@pytest.mark.parametrize("number", range(10))
def test_an_interrupted_recording_with_a_scene_passes_the_check(
    number: int, log_path: Path
) -> None:
    recorder = mcaprl.RecordMcap(make_sim("lane"), log_path)
    interrupt_chunk(recorder._recording.log.mcap, number)
    with contextlib.suppress(KeyboardInterrupt):
        for seed in range(4):
            recorder.reset(seed=seed)
            ended = False
            while not ended:
                *_, terminated, truncated, _ = recorder.step(2)
                ended = terminated or truncated
    recorder.close()
    assert not [one for one in mcaprl.check(log_path).problems if "no finished" not in str(one)]
