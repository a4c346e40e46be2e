"""Images of bags on disk equal those in memory, and take the memory of a few images."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import mcaprl
from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.dataset import images
from mcaprl.recorder.dataset.images import MappedImages
from mcaprl.recorder.mapping import images as image_copy
from mcaprl.recorder.mapping.images import ImageReader
from tests.support.bags import Channel, integers, write_channels, write_rosbag1, write_rosbag2
from tests.support.recordings import assert_same_bits

COMPRESSED = "sensor_msgs/msg/CompressedImage"
TEXT = "builtin_interfaces/Time stamp\nstring format\nuint8[] data\n"
TEXT += f"{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec"


def message(data: bytes, format: str) -> bytes:
    """Return the payload of an image whose type is defined by `TEXT`."""
    text = format.encode() + b"\0"
    padding = bytes(-(12 + len(text)) % 4)
    return (
        struct.pack("<iII", 0, 0, len(text)) + text + padding + struct.pack("<I", len(data)) + data
    )


def write_bag(path: Path, files: list[bytes], format: str = "png") -> Path:
    """Write a bag with an image and an action in each 0.1 s."""
    images = [(k / 10, message(data, format)) for k, data in enumerate(files)]
    actions = integers("/mode", [(k / 10, k % 2) for k in range(len(files))])
    return write_channels(path, [Channel("/camera", COMPRESSED, TEXT, images), actions])


def file_of(pixels: Any, format: str = "PNG") -> bytes:
    file = BytesIO()
    Image.fromarray(pixels).save(file, format)
    return file.getvalue()


def noise(count: int, *shape: int, dtype: Any = np.uint8) -> list[Any]:
    rng = np.random.default_rng(5)
    return [rng.integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True) for _ in range(count)]


def mapping(stack: int = 1, **options: Any) -> dict[str, Any]:
    return {
        "clock": {"rate_hz": 10},
        "observation": {"camera": {"image": "/camera", **options}},
        "action": {"field": "/mode.data"},
        "stack": stack,
    }


def copies(folder: Path) -> list[str]:
    """Return the names of all entries that are not bags."""
    return sorted(each.name for each in folder.iterdir() if each.suffix != ".mcap")


@pytest.mark.parametrize("stack", [1, 3])
@pytest.mark.parametrize("options", [{}, {"gray": True, "resize": [10, 9]}])
def test_mapped_images_equal_those_in_memory(
    tmp_path: Path, stack: int, options: dict[str, Any]
) -> None:
    bag = write_bag(tmp_path / "bag.mcap", [file_of(each) for each in noise(30, 12, 14, 3)])
    parts = mapping(stack, **options) | {"episodes": {"max_steps": 7}}
    memory = mcaprl.open(bag, mapping=parts, images="memory")
    assert memory.storage == "memory"
    assert not copies(tmp_path)
    mapped = mcaprl.open(bag, mapping=parts, images="mapped")
    assert isinstance(mapped.observations, MappedImages)
    assert isinstance(memory.observations, np.ndarray)
    assert copies(tmp_path) == ["bag.mcap.camera.images"]
    assert mapped.storage == f"images on disk in {tmp_path}/bag.mcap.camera.images"
    assert mapped.observation_space == memory.observation_space
    assert mapped.observations.shape == memory.observations.shape
    assert_same_bits(mapped.observations[:], memory.observations)
    assert_same_bits(mapped.next_observations[5], memory.next_observations[5])
    assert_same_bits(mapped.observations[2:4, 1, ..., -1], memory.observations[2:4, 1, ..., -1])
    assert mapped.fingerprint == memory.fingerprint
    steps = np.array([9, 2, 2])
    assert_same_bits(mapped.batch(steps).observations, memory.batch(steps).observations)
    assert len(mapped.filter(lambda episode: episode.index == 1)) == 7
    both = mcaprl.Dataset.concatenate([mapped, mapped])
    assert_same_bits(both.observations[30:], memory.observations[30 - len(memory) :])
    # The copy can be saved as a log.
    if memory.observations.shape[-1] in (1, 3):
        mapped.save(tmp_path / "log.mcap")
        assert mcaprl.open(tmp_path / "log.mcap").fingerprint == memory.fingerprint


@pytest.mark.parametrize("options", [{}, {"range_m": [0, 40]}])
def test_depth_is_mapped_as_well(tmp_path: Path, options: dict[str, Any]) -> None:
    files = [file_of(each) for each in noise(20, 8, 9, dtype=np.uint16)]
    bag = write_bag(tmp_path / "bag.mcap", files, "16UC1; png compressed ")
    memory = mcaprl.open(bag, mapping=mapping(2, **options), images="memory")
    mapped = mcaprl.open(bag, mapping=mapping(2, **options), images="mapped")
    assert mapped.observations.dtype == (np.uint8 if options else np.float32)
    assert mapped.observations.nbytes == memory.observations.nbytes
    assert_same_bits(mapped.observations[:], memory.observations)
    ours, theirs = (each.statistics.observations["observation"] for each in (mapped, memory))
    for name in ("mean", "std", "low", "high"):
        assert_same_bits(getattr(ours, name), getattr(theirs, name))
    assert ours.not_finite == theirs.not_finite == 0


def test_the_copy_is_used_again_until_bag_or_options_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [file_of(each) for each in noise(20, 9, 9)]
    bag, copy = write_bag(tmp_path / "bag.mcap", files), tmp_path / "bag.mcap.camera.images"
    decoded: list[int] = []
    original = ImageReader._messages

    def counted(self: ImageReader, rows: Any) -> Any:
        decoded.extend(rows.tolist())
        return original(self, rows)

    monkeypatch.setattr(ImageReader, "_messages", counted)

    def count(**parts: Any) -> int:
        """Return the number of messages read; the first one is always read."""
        decoded.clear()
        found = mcaprl.open(bag, mapping=mapping() | parts, images="mapped")
        for k in range(3):
            row = found.observations[k]
            assert row[0, 0, 0] in [np.asarray(Image.open(BytesIO(each)))[0, 0] for each in files]
        return len(decoded)

    assert count() == 20
    assert count() == 1
    # Fewer messages are in the copy, too.
    assert count(clock={"rate_hz": 5}) == 1
    first = copy.stat().st_ino
    assert count(observation={"camera": {"image": "/camera", "crop": [0, 0, 8, 8]}}) == 20
    assert copy.stat().st_ino != first
    assert count() == 20
    os.utime(bag, ns=(1, 1))
    assert count() == 20
    # A damaged copy is replaced.
    copy.write_bytes(copy.read_bytes()[:-50])
    assert count() == 20
    copy.write_bytes(b"nothing")
    assert count() == 20
    # With another version of the decoders, too.
    monkeypatch.setattr(image_copy, "_VERSION", "next")
    assert count() == 20


def test_an_open_dataset_keeps_its_images_when_the_copy_is_replaced(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag.mcap", [file_of(each) for each in noise(20, 9, 9)])
    memory = mcaprl.open(bag, mapping=mapping(), images="memory")
    mapped = mcaprl.open(bag, mapping=mapping(), images="mapped")
    other = mcaprl.open(bag, mapping=mapping(crop=[1, 0, 8, 8]), images="mapped")
    assert_same_bits(mapped.observations[:], memory.observations)
    assert_same_bits(other.observations[:], memory.observations[:, :8, 1:9])


def test_the_copy_is_not_taken_for_a_bag(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag.mcap", [file_of(each) for each in noise(20, 9, 9)])
    memory = mcaprl.open(bag, mapping=mapping(), images="memory")
    mcaprl.open(bag, mapping=mapping(), images="mapped")
    every = sorted(tmp_path.iterdir())
    assert len(every) == 2
    for data in (str(tmp_path / "*"), every):
        found = mcaprl.open(data, mapping=mapping())
        assert found.sources == (bag,)
        assert found.fingerprint == memory.fingerprint
    with pytest.raises(LogError, match="is a copy of images: give the bag beside it"):
        mcaprl.open(every[1], mapping=mapping())


@pytest.mark.parametrize("storage", ["mcap", "sqlite3", "ros1", "FILE", "MESSAGE"])
def test_images_of_all_formats_are_mapped(tmp_path: Path, storage: str) -> None:
    if storage == "ros1":
        bag = write_rosbag1(tmp_path / "drive.bag")
    elif storage in ("FILE", "MESSAGE"):
        bag = write_rosbag2(tmp_path / "drive", compression=storage)
    else:
        bag = write_rosbag2(tmp_path / "drive", storage)
    tree = {
        "clock": {"rate_hz": 10},
        "observation": {"depth": {"image": "/camera/depth"}},
        "action": {"fields": ["/cmd_vel.angular.z"], "edges": [[0]]},
        "stack": 2,
    }
    memory = mcaprl.open(bag, mapping=tree, images="memory")
    for _ in range(2):
        mapped = mcaprl.open(bag, mapping=tree, images="mapped")
        assert_same_bits(mapped.observations[:], memory.observations)
    assert memory.observations[2, 0, 0].tolist() == [
        float(np.float32(1.001)),
        float(np.float32(1.002)),
    ]
    assert len(list(tmp_path.rglob("*.depth.images"))) == 1


def test_automatic_storage_depends_on_the_free_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = write_bag(tmp_path / "bag.mcap", [file_of(each) for each in noise(20, 10, 10)])
    for stack, free_bytes, expected in ((1, 4000, False), (1, 3998, True), (3, 6000, True)):
        monkeypatch.setattr(images, "free_memory_bytes", lambda free=free_bytes: free)
        found = mcaprl.open(bag, mapping=mapping(stack))
        # 20 frames of 100 bytes, more than half of the free memory or not.
        assert isinstance(found.observations, MappedImages) == expected


def test_a_damaged_image_is_left_out_in_the_copy_as_in_memory(tmp_path: Path) -> None:
    files = [file_of(np.full((8, 8), k, np.uint8)) for k in range(20)]
    files[4], files[11] = files[4][:50], b"png"
    bag = write_bag(tmp_path / "bag.mcap", files)
    expected = [0, 1, 2, 3, 3, 5, 6, 7, 8, 9, 10, 10, 12, 13, 14, 15, 16, 17, 18]
    times = []
    for storage in ("memory", "mapped", "mapped"):
        with pytest.warns(UserWarning, match="2 images cannot be decoded, the first is message 4"):
            found = mcaprl.open(bag, mapping=mapping(), images=storage)
        assert found.observations[:, 0, 0, 0].tolist() == expected
        times.append(
            (tmp_path / "bag.mcap.camera.images").stat().st_mtime_ns if storage == "mapped" else 0
        )
    assert times[1] == times[2]
    (problem,) = mcaprl.check(found).problems
    assert "2 images cannot be decoded, the first is message 4 at" in problem.what


def test_the_copy_needs_a_writable_folder_with_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = write_bag(tmp_path / "bag.mcap", [file_of(each) for each in noise(20, 9, 9)])
    usage = shutil.disk_usage(tmp_path)._replace(free=1000)
    with monkeypatch.context() as patched:
        patched.setattr(shutil, "disk_usage", lambda _: usage)
        with pytest.raises(
            LogError, match=r"the images need 1.6 kB, 1000 B are free; set `resize`"
        ):
            mcaprl.open(bag, mapping=mapping(), images="mapped")
    assert not copies(tmp_path)
    (tmp_path / "bag.mcap.camera.images").symlink_to(bag)
    with pytest.raises(UsageError, match="is a symbolic link"):
        mcaprl.open(bag, mapping=mapping(), images="mapped")
    (tmp_path / "bag.mcap.camera.images").unlink()
    (tmp_path / "bag.mcap.camera.images").mkdir()
    with pytest.raises(UsageError, match="is not a regular file"):
        mcaprl.open(bag, mapping=mapping(), images="mapped")


def test_a_copy_with_forged_failures_or_images_is_replaced(tmp_path: Path) -> None:
    from mcaprl.recorder.format.writing import McapWriter

    bag = write_bag(tmp_path / "bag.mcap", [file_of(each) for each in noise(20, 9, 9)])
    memory = mcaprl.open(bag, mapping=mapping(), images="memory")
    mcaprl.open(bag, mapping=mapping(), images="mapped")
    copy = tmp_path / "bag.mcap.camera.images"
    from mcaprl.recorder.format.reading import McapReader

    description = McapReader(copy).metadata[images.CACHE_METADATA]
    for failures in ("[", "[1]", '[["x", ""]]', "[[[0], {}]]", "[[1e999, 2]]", "[[99, 2]]", "{}"):
        with McapWriterOf(McapWriter(copy, compression="none", overwrite=True)) as writer:
            writer.add_metadata(images.CACHE_METADATA, description)
            writer.add_metadata(images.CACHE_NOTES, {"failures": failures})
        found = mcaprl.open(bag, mapping=mapping(), images="mapped")
        assert_same_bits(found.observations[:], memory.observations)


class McapWriterOf:
    """Context that closes a writer."""

    def __init__(self, writer: Any) -> None:
        """Store the writer."""
        self._writer = writer

    def __enter__(self) -> Any:
        """Return the writer."""
        return self._writer

    def __exit__(self, *_: object) -> None:
        """Close the writer."""
        self._writer.close()


PROGRAM = """
import sys, mcaprl
mapping = {
    "clock": {"rate_hz": 10}, "action": {"field": "/mode.data"}, "stack": 4,
    "observation": {"camera": {"image": "/camera"}},
}
def peak_kb():
    # Unlike ru_maxrss, VmHWM does not include the program that started this one.
    with open("/proc/self/status") as file:
        return int(next(line for line in file if line.startswith("VmHWM")).split()[1])
warm, bag, images = sys.argv[1:]
mcaprl.open(warm, mapping=mapping, images=images).observations[0]
before = peak_kb()
data = mcaprl.open(bag, mapping=mapping, images=images)
print(peak_kb() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_mapped_images_take_the_memory_of_a_few_images(tmp_path: Path) -> None:
    frame_kb = 320 * 240 * 3 / 1024
    files = [file_of(each, "JPEG") for each in noise(3, 240, 320, 3)]
    warm = write_bag(tmp_path / "warm.mcap", files[:2] * 8, "jpeg")
    bag = write_bag(tmp_path / "bag.mcap", [files[k % 3] for k in range(200)], "jpeg")
    bag_kb = bag.stat().st_size / 1024

    def extra_frames(images: str) -> float:
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, str(warm), str(bag), images],
            capture_output=True,
            text=True,
            check=True,
        )
        return (int(done.stdout) - bag_kb) / frame_kb

    # The pages of the bag itself, which is mapped into memory, are not counted.
    extra = extra_frames("mapped")

    assert extra < 40
    # 200 stacks of 4 images: the result, and a few images.
    extra = extra_frames("memory")

    assert 500 < extra < 830
