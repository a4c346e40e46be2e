"""Mutated files are read correctly or refused, without a crash, a hang or a wrong value."""

from __future__ import annotations

import itertools
import multiprocessing
import random
import resource
import signal
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mcaprl
from mcaprl.errors import McaprlError
from mcaprl.recorder.repair.check import check_log
from mcaprl.recorder.repair.recover import recover_log
from tests.support.damage.faults import assert_is_known, count, tell, write_log
from tests.support.damage.mutations import MUTATIONS, Mutation

MEMORY_BYTES = 512 * 2**20
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(["tests.support.damage.faults"])


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda mutation: mutation.__name__)
def test_mutated_files(tmp_path: Path, mutation: Mutation) -> None:
    """Read mutated files in a separate process with limited memory."""
    reported, telling = FORKS.Pipe(duplex=False)
    trials = count(12, 1250)
    process = FORKS.Process(target=_try_all, args=(tmp_path, mutation, trials, telling))
    process.start()
    telling.close()
    try:
        figures = reported.recv()
    except EOFError:
        pytest.fail(f"the process died with {process.exitcode}")
    finally:
        process.join()
    assert "failed" not in figures, figures["failed"]
    assert figures["tried"] == trials
    tell(f"files {mutation.__name__.replace('_', ' ')}", **figures)


def _try_all(folder: Path, mutation: Mutation, trials: int, telling: Any) -> None:
    originals = []
    for name, compression in itertools.product(("a", "b"), ("zstd", "lz4", "none")):
        path = folder / f"{name}-{compression}.mcap"
        write_log(path, 3 if name == "a" else 12, compression=compression)
        originals.append(path.read_bytes())
    _limit_memory()
    seen: Counter[str] = Counter()
    slowest_s, path = 0.0, folder / "spoilt.mcap"
    for trial in range(trials):
        chance = random.Random(f"{mutation.__name__} {trial}")
        spoilt = mutation(chance.choice(originals), chance)
        path.write_bytes(spoilt)
        try:
            # The alarm ends the process if a file takes more than 60 s.
            signal.alarm(60)
            began = time.process_time()
            seen[_outcome(path)] += 1
            slowest_s = max(slowest_s, time.process_time() - began)
            signal.alarm(0)
        except BaseException as error:
            kept = folder.parent / f"{mutation.__name__}-{trial}.mcap"
            kept.write_bytes(spoilt)
            telling.send({"failed": f"{type(error).__name__}: {error} ({kept})"})
            raise
    telling.send({"tried": trials, **seen, "most_CPU_s": round(slowest_s, 2)})


def _limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _outcome(path: Path) -> str:
    """Read, check and recover a file, and check that all returned values were recorded."""
    out = path.with_name("out.mcap")
    problems = check_log(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            data = mcaprl.open(path)
            _assert_is_right(data)
            outcome = "read"
        except McaprlError:
            outcome = "refused"
            assert problems, "what cannot be read has a problem that is reported"
        try:
            recover_log(path, out, overwrite=True)
        except McaprlError:
            return f"{outcome}_and_hopeless"
        if out.exists():
            _assert_is_right(mcaprl.open(out))
            assert check_log(out) == []
    return outcome


def _assert_is_right(data: mcaprl.Dataset) -> None:
    assert data.env_id == ""
    assert [leaf.shape[1:] for leaf in data.observations.values()] == [(8, 8), (3,)]
    for episode in data.episodes:
        assert_is_known(episode)
    times = np.concatenate([episode.log_time_ns for episode in data.episodes])
    assert ((times - 10**18) % 10**8 == 0).all()
