"""Images on disk, in the log or in a copy beside the log, equal the images in memory."""

from __future__ import annotations

import mmap
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.errors import CorruptLogError, UnknownNameError
from mcaprl.recorder.dataset import images as mapped_images
from mcaprl.recorder.dataset import images as storage
from mcaprl.recorder.dataset.images import MappedImages
from tests.recorder.dataset.test_selection import damage
from tests.support.recordings import MIXED_SPACE, assert_same_bits, leaves_of, record

# Each episode has separate chunks, so that a test can damage the chunks of one episode.
pytestmark = pytest.mark.usefixtures("small_chunks")

LENGTHS = [120, 1, 33, 210]


@pytest.fixture
def log(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    path = tmp_path / "log.mcap"
    compression = getattr(request, "param", "none")
    record(path, MIXED_SPACE, spaces.Discrete(5), LENGTHS, compression=compression)
    return path


in_every_way = pytest.mark.parametrize("log", ["none", "zstd", "lz4"], indirect=True)


@in_every_way
def test_mapped_images_equal_those_in_memory(log: Path) -> None:
    memory, mapped = mcaprl.open(log, images="memory"), mcaprl.open(log, images="mapped")
    assert isinstance(mapped.observations["camera"], MappedImages)
    assert mapped.fingerprint == memory.fingerprint
    for name in ("observations", "next_observations"):
        for ours, theirs in zip(
            leaves_of(getattr(mapped, name)), leaves_of(getattr(memory, name)), strict=True
        ):
            assert ours.shape == theirs.shape
            assert_same_bits(ours[5:9], theirs[5:9])
            assert_same_bits(ours, theirs)
    assert_same_bits(
        mapped.episodes[2].next_observations["gray"], memory.episodes[2].next_observations["gray"]
    )
    assert mapped.statistics.observations["gray"].mean == (
        memory.statistics.observations["gray"].mean
    )


@in_every_way
def test_an_unknown_storage_is_refused(log: Path) -> None:
    storage: Any = "map"
    with pytest.raises(UnknownNameError, match="did you mean mapped"):
        mcaprl.open(log, images=storage)


def test_batches(log: Path) -> None:
    memory, mapped = mcaprl.open(log, images="memory"), mcaprl.open(log, images="mapped")
    steps = np.random.default_rng(0).integers(len(memory), size=256)
    batch = mapped.batch(steps)
    for name in ("observations", "next_observations"):
        every = leaves_of(getattr(memory, name))
        for found, column in zip(leaves_of(getattr(batch, name)), every, strict=True):
            assert isinstance(found, np.ndarray)
            assert_same_bits(found, column[steps])
    for name in ("actions", "rewards", "terminated", "truncated", "behavior"):
        assert_same_bits(getattr(batch, name), getattr(memory, name)[steps])


@pytest.mark.parametrize(
    "key",
    [0, -1, slice(3, 40, 7), np.array([5, 5, 2]), slice(0, 0), (slice(2, 5), 0), (4, 1, 2)],
    ids=str,
)
def test_indexing_equals_that_of_arrays(log: Path, key: Any) -> None:
    memory, mapped = mcaprl.open(log, images="memory"), mcaprl.open(log, images="mapped")
    assert_same_bits(mapped.observations["camera"][key], memory.observations["camera"][key])
    with pytest.raises(IndexError):
        mapped.observations["camera"][len(mapped)]


def test_the_dataset_reports_where_its_images_are(log: Path) -> None:
    assert mcaprl.open(log).storage == "memory"
    mapped = mcaprl.open(log, images="mapped")
    assert mapped.storage == f"images on disk in {log}"
    assert repr(mapped).endswith(f", images on disk in {log})")
    assert sorted(path.name for path in log.parent.iterdir()) == ["log.mcap"], "no copy is made"


@pytest.mark.parametrize("log", ["zstd"], indirect=True)
def test_the_copy_is_written_once(log: Path) -> None:
    mapped = mcaprl.open(log, images="mapped")
    assert mapped.storage == f"images on disk in {log}.camera.images and 1 more"
    copies = sorted(log.parent.glob("*.images"))
    assert [path.name for path in copies] == ["log.mcap.camera.images", "log.mcap.gray.images"]
    made = [path.stat().st_ino for path in copies]
    assert mcaprl.open(log, images="mapped", episodes=[1, 2]).storage == mapped.storage
    assert [path.stat().st_ino for path in copies] == made
    assert not list(log.parent.glob("*.tmp"))


@pytest.mark.parametrize("log", ["zstd"], indirect=True)
def test_a_copy_of_another_log_is_replaced(log: Path) -> None:
    mcaprl.open(log, images="mapped")
    record(log, MIXED_SPACE, spaces.Discrete(5), [50, 60], seed=1, overwrite=True)
    memory, mapped = mcaprl.open(log, images="memory"), mcaprl.open(log, images="mapped")
    assert mapped.fingerprint == memory.fingerprint
    copy = log.with_name("log.mcap.camera.images")
    copy.write_bytes(copy.read_bytes()[:-100])
    assert mcaprl.open(log, images="mapped").fingerprint == memory.fingerprint
    copy.write_bytes(b"something else")
    assert mcaprl.open(log, images="mapped").fingerprint == memory.fingerprint


def test_damage_is_reported_when_the_image_is_read(log: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.mcap"
    damage(log, broken, "/rl/observation/camera", number=3)
    memory, mapped = mcaprl.open(log, images="memory"), mcaprl.open(broken, images="mapped")
    assert_same_bits(mapped.episodes[0].observations["camera"], memory.observations["camera"][:120])
    with pytest.raises(CorruptLogError, match="does not match its CRC"):
        mapped.batch(np.arange(len(mapped)))
    with pytest.raises(CorruptLogError, match="does not match its CRC"):
        mapped.batch(np.arange(len(mapped)))


def test_several_logs(tmp_path: Path) -> None:
    for number, compression in enumerate(["none", "zstd", "none"]):
        path = tmp_path / f"{number}.mcap"
        record(path, MIXED_SPACE, spaces.Discrete(5), [9, 4], seed=number, compression=compression)
    memory, mapped = mcaprl.open(tmp_path), mcaprl.open(tmp_path, images="mapped")
    assert mapped.fingerprint == memory.fingerprint
    assert mapped.storage.endswith("0.mcap and 3 more")
    train, test = mapped.split(0.5, seed=3)
    assert isinstance(train.observations["gray"], MappedImages)
    assert (train.fingerprint, test.fingerprint) == tuple(
        part.fingerprint for part in memory.split(0.5, seed=3)
    )


@in_every_way
def test_saving_images_on_disk(log: Path, tmp_path: Path) -> None:
    mapped = mcaprl.open(log, images="mapped")
    mapped.filter(lambda episode: episode.length > 100).save(tmp_path / "long.mcap")
    again = mcaprl.open(tmp_path / "long.mcap")
    assert again.fingerprint == mcaprl.open(log, episodes=[0, 3]).fingerprint


@pytest.mark.parametrize(("free", "expected"), [(10, True), (10**12, False)])
def test_auto_depends_on_free_memory(
    log: Path, monkeypatch: pytest.MonkeyPatch, free: int, expected: bool
) -> None:
    monkeypatch.setattr(storage, "free_memory_bytes", lambda: free)
    data = mcaprl.open(log)
    assert isinstance(data.observations["camera"], MappedImages) == expected


@pytest.mark.parametrize("files", [1, 3])
def test_prefetched_images_are_the_same(
    log: Path, tmp_path: Path, files: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    for number in range(files):
        shutil.copy(log, folder / f"{number}.mcap")
    ranges: list[tuple[int, int]] = []
    prefetch = mapped_images.ImageFile.prefetch

    def note(file: mapped_images.ImageFile, start: int, stop: int) -> None:
        ranges.append((start, stop))
        prefetch(file, start, stop)

    monkeypatch.setattr(mapped_images, "_PREFETCHED_BYTES", 0)
    monkeypatch.setattr(mapped_images.ImageFile, "prefetch", note)
    memory = mcaprl.open(folder, images="memory").observations["camera"]
    mapped = mcaprl.open(folder, images="mapped").observations["camera"]
    rows = np.random.default_rng(0).integers(len(memory), size=50)
    assert_same_bits(mapped[rows], memory[rows])
    assert files <= len(ranges) <= 50
    assert all(start % mmap.PAGESIZE == 0 for start, _ in ranges)
    wanted = sum(stop - start for start, stop in ranges)
    assert len(np.unique(rows)) * memory[0].nbytes <= wanted
    assert mapped[:0].shape == memory[:0].shape
