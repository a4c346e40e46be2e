"""Tests that a Ray cluster records the same episodes as this process, even if workers die."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

import mcaprl
from mcaprl.errors import LogError, OutputExistsError, UsageError
from mcaprl.recorder.repair.check import check_log
from tests.ray.processes import titled
from tests.ray.seeded import SEEDED
from tests.support.damage.faults import count, tell

pytestmark = pytest.mark.usefixtures("ray_cluster")
EPISODES_PER_KILL = count(40, 60)


def contents(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def record(folder: Path, episodes: int, **options: Any) -> Any:
    return mcaprl.record(
        SEEDED, folder, policy="random", episodes=episodes, seed=3, ray=True, **options
    )


def recorded_locally(tmp_path: Path, episodes: int) -> mcaprl.Dataset:
    path, fast = tmp_path / "local.mcap", {"pause_s": 0.0}
    mcaprl.record(SEEDED, path, policy="random", episodes=episodes, seed=3, sim_options=fast)
    return mcaprl.open(path)


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> mcaprl.Dataset:
    return recorded_locally(tmp_path_factory.mktemp("local"), 13)


@dataclass
class Recorded:
    """Recording of 13 episodes by two workers.

    Attributes:
        folder: Folder with 5 shards.
        copy: URL to which they were uploaded.
        found: Result.
        totals: Total of each progress bar.
        amounts: Reported progress.
    """

    folder: Path
    copy: str
    found: Any
    totals: list[int | None]
    amounts: list[int]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    pytest.importorskip("fsspec")
    parent = tmp_path_factory.mktemp("recorded")
    totals, amounts = list[int | None](), list[int]()

    @contextmanager
    def bar(text: str, total: int | None) -> Iterator[Callable[[int], None]]:
        totals.append(total)
        yield amounts.append

    folder, url = parent / "logs", f"file://{parent}/copy"
    found = record(folder, 13, workers=2, shards=5, upload=url, progress=bar)
    return Recorded(folder, url, found, totals, amounts)


def assert_same(folder: Path, shards: int, expected: mcaprl.Dataset) -> None:
    data = mcaprl.open(folder)
    assert data.fingerprint == expected.fingerprint
    assert [one.seed for one in data.episodes] == [one.seed for one in expected.episodes]
    names = [f"shard-{number:02d}.mcap" for number in range(shards)]
    assert contents(folder) == ["manifest.json", *names]


def test_episodes_are_those_of_one_process(recorded: Recorded, expected: mcaprl.Dataset) -> None:
    assert_same(recorded.folder, 5, expected)
    assert recorded.totals == [13]
    assert sum(recorded.amounts) == 13
    assert (recorded.found.episodes, recorded.found.steps) == (13, len(expected))
    seeds = [one.seed for one in expected.episodes]
    assert [one.seed for one in recorded.found.results] == seeds


def test_a_manifest_is_read_like_its_folder(recorded: Recorded) -> None:
    path = recorded.folder / "manifest.json"
    assert mcaprl.open(path).fingerprint == mcaprl.open(recorded.folder).fingerprint
    files = json.loads(path.read_text())["files"]
    assert [file["episodes"] for file in files] == [2, 3, 2, 3, 3]
    assert sum(file["steps"] for file in files) == len(mcaprl.open(recorded.folder))


def test_an_upload_has_the_manifest(recorded: Recorded) -> None:
    again = mcaprl.open(f"{recorded.copy}/manifest.json")
    assert again.fingerprint == mcaprl.open(recorded.folder).fingerprint


def test_old_shards_are_replaced_only_on_request(
    recorded: Recorded, expected: mcaprl.Dataset, tmp_path: Path
) -> None:
    """Record the same episodes with another number of workers and shards."""
    folder = tmp_path / "logs"
    shutil.copytree(recorded.folder, folder)
    with pytest.raises(OutputExistsError, match="pass `overwrite=True`"):
        record(folder, 2)
    found = record(folder, 13, workers=1, shards=3, overwrite=True)
    assert found.episodes == 13
    assert_same(folder, 3, expected)


def test_steps_do_not_depend_on_the_workers(tmp_path: Path) -> None:
    prints = []
    for workers in (1, 2):
        folder = tmp_path / str(workers)
        done = mcaprl.record(
            SEEDED, folder, policy="random", steps=100, ray=True, workers=workers, shards=3
        )
        assert done.steps == 100
        prints.append(mcaprl.open(folder).fingerprint)
    assert prints[0] == prints[1]


class Killer(threading.Thread):
    """Callback that kills the oldest worker a few times, each at a random time after progress."""

    def __init__(self, kills: int) -> None:
        super().__init__(daemon=True)
        self.kills, self.killed, self.done = kills, 0, threading.Event()
        self.progress = threading.Event()

    def run(self) -> None:
        randoms = random.Random(1)
        while self.killed < self.kills and not self.done.wait(0.2 * randoms.random()):
            if self.progress.wait(0.1):
                workers = titled("ray::run_task")
                if workers:
                    self.progress.clear()
                    os.kill(workers[0], signal.SIGKILL)
                    self.killed += 1


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
def test_killed_workers_lose_and_double_no_episode(tmp_path: Path) -> None:
    kills, shards = count(5, 200), count(4, 40)
    episodes = kills * EPISODES_PER_KILL
    expected = recorded_locally(tmp_path, episodes)
    killer = Killer(kills)
    killer.start()
    amounts = list[int]()

    def advance(amount: int) -> None:
        amounts.append(amount)
        killer.progress.set()

    @contextmanager
    def bar(text: str, total: int | None) -> Iterator[Callable[[int], None]]:
        yield advance

    found = record(tmp_path / "logs", episodes, shards=shards, workers=2, progress=bar)
    killer.done.set()
    killer.join()
    assert killer.killed == kills, "the recording ended before the last kill"
    assert_same(tmp_path / "logs", shards, expected)
    assert (found.episodes, sum(amounts)) == (episodes, episodes)
    for path in (tmp_path / "logs").glob("*.mcap"):
        assert check_log(path) == []
    tell(
        "Ray workers killed with SIGKILL",
        killed=kills,
        episodes=episodes,
        lost=0,
        doubled=0,
    )


def test_a_sim_that_kills_each_worker_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mcaprl.ray.tasks.MOST_DEATHS", 2)
    with pytest.raises(LogError, match=r"shard-00\.mcap: workers died repeatedly without"):
        record(tmp_path / "a", 2, shards=1, sim_options={"dies": True})
    assert "manifest.json" not in contents(tmp_path / "a")


def test_an_error_of_the_sim_ends_the_recording(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="pause"):
        record(tmp_path / "a", 2, shards=1, sim_options={"pause_s": "x"})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"envs": 2}, "`envs=` is for recording without `ray=True`"),
        ({"append": True}, "`append=` is for recording without"),
        ({"rotate_mb": 1.0}, "`rotate_mb=` is for recording without"),
        ({"workers": 0}, "`workers=0`: give"),
        ({"shards": 0}, "`shards=0`: give"),
    ],
)
def test_options_that_exclude_each_other(
    tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        record(tmp_path / "a", 2, **options)
    with pytest.raises(UsageError, match="requires `ray=True`"):
        mcaprl.record(SEEDED, tmp_path / "b", policy="random", episodes=1, shards=2)
    with pytest.raises(UsageError, match="the name of a file"):
        record(tmp_path / "a.mcap", 2)
    assert list(tmp_path.iterdir()) == []
