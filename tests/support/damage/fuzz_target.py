"""The function that is fuzzed, and the logs from which fuzzing starts."""

from __future__ import annotations

import struct
import tempfile
import warnings
from pathlib import Path

import numpy as np
from gymnasium import spaces
from mcap.opcode import Opcode

import mcaprl
from mcaprl.errors import McaprlError
from mcaprl.recorder.repair.check import check_log
from mcaprl.recorder.repair.recover import recover_log
from tests.support.damage.mutations import records_of
from tests.support.recordings import MIXED_SPACE, record

_FOLDER = Path(tempfile.mkdtemp(prefix="mcaprl-fuzz-"))


def try_bytes(data: bytes) -> None:
    """Read, check and recover the bytes; only errors of `mcaprl.errors` may be raised."""
    path, out = _FOLDER / "input.mcap", _FOLDER / "out.mcap"
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        problems = check_log(path)
        try:
            dataset = mcaprl.open(path)
            assert len(dataset) == len(dataset.rewards)
            assert len(dataset.next_observations) == len(dataset.observations)
        except McaprlError:
            assert problems, "what cannot be read has a problem that is reported"
        try:
            recovery = recover_log(path, out, overwrite=True)
        except McaprlError:
            return
        # Files that are not logs of this format are recovered as generic MCAP files.
        assert recovery.episodes == 0 or check_log(out) == []


def without_crcs(data: bytes) -> bytes:
    """Return the log without CRCs."""
    plain = bytearray(data)
    for start, opcode, length in records_of(data):
        if opcode == Opcode.CHUNK:
            struct.pack_into("<I", plain, start + 9 + 24, 0)
        elif opcode == Opcode.DATA_END:
            struct.pack_into("<I", plain, start + 9, 0)
        elif opcode == Opcode.FOOTER:
            struct.pack_into("<I", plain, start + length - 4, 0)
    return bytes(plain)


def write_seeds(folder: Path) -> None:
    """Return small logs of all kinds."""
    folder.mkdir(parents=True, exist_ok=True)
    for compression in ("none", "zstd", "lz4"):
        for name, space in (
            ("vector", spaces.Box(-1, 1, (2,), np.float32)),
            ("mixed", MIXED_SPACE),
        ):
            path = folder / f"{name}-{compression}"
            record(path, space, spaces.Discrete(2), [2, 1], compression=compression, overwrite=True)
            data = path.read_bytes()
            (folder / f"{path.name}-plain").write_bytes(without_crcs(data))
            # Without a summary, the reader scans the file.
            end = next(start for start, opcode, _ in records_of(data) if opcode == Opcode.DATA_END)
            (folder / f"{path.name}-cut").write_bytes(without_crcs(data)[:end])
