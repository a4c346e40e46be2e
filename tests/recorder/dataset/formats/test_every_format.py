"""What every format must hold; test_table.py has what each of them keeps."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import HealthCheck, assume, given, settings

import mcaprl
from mcaprl import Dataset
from mcaprl.errors import LogError, OutputExistsError
from mcaprl.recorder.dataset.format_registry import FORMATS, write_format
from mcaprl.recorder.format.spaces import leaves_of
from tests.support.recordings import assert_same_bits
from tests.support.strategies import transitions
from tests.support.transitions import is_plain, same_transitions

NEEDS = {
    "npz": (),
    "hdf5": ("h5py",),
    "d3rlpy": ("h5py",),
    "minari": ("h5py",),
    "parquet": ("pyarrow",),
    "lerobot": ("pyarrow", "PIL"),
}
every_format = pytest.mark.parametrize("form", FORMATS)


@pytest.fixture(autouse=True)
def _extras(request: pytest.FixtureRequest) -> Iterator[None]:
    for package in NEEDS[request.getfixturevalue("form")]:
        pytest.importorskip(package, reason="needs the extras interop and tables")
    with warnings.catch_warnings():
        # Most formats report what they leave out.
        warnings.simplefilter("ignore", UserWarning)
        yield


def recorded(count: int = 5) -> Dataset:
    """Return terminated episodes of one step, with images whose pixels all differ."""
    pixels = np.arange(2 * count * 8 * 9 * 3).reshape(2, count, 8, 9, 3).astype(np.uint8)
    state = np.arange(4 * count, dtype=np.float32).reshape(2, count, 2)
    return Dataset.from_arrays(
        observations={"camera": pixels[0], "state": state[0]},
        next_observations={"camera": pixels[1], "state": state[1]},
        actions=np.arange(count) % 3,
        rewards=np.arange(count) / 4,
        terminated=np.ones(count, bool),
        truncated=np.zeros(count, bool),
        action_space=spaces.Discrete(3),
    )


def written(data: Dataset, form: str, folder: Path | str, **options: Any) -> Path:
    path = Path(folder) / f"toy{FORMATS[form].suffix or '-v0'}"
    write_format(data, path, FORMATS[form], lossy=True, **options)
    return path


@every_format
def test_images_on_disk_are_written_as_those_in_memory(tmp_path: Path, form: str) -> None:
    recorded().save(tmp_path / "log.mcap", compression="none")
    found = []
    for images in ("memory", "mapped"):
        data = mcaprl.open(tmp_path / "log.mcap", images=images)
        assert ("on disk" in data.storage) == (images == "mapped")
        found.append(mcaprl.open(written(data, form, tmp_path, overwrite=True)))
    memory, mapped = found
    same_transitions(mapped, memory)
    steps = [
        leaf.of(mapped.frames)[mapped.frame_of_step] for leaf in leaves_of(mapped.observation_space)
    ]
    (camera,) = (step for step in steps if step.dtype == np.uint8)
    assert_same_bits(np.sort(camera.ravel()), np.sort(recorded().observations["camera"].ravel()))


@every_format
def test_an_existing_dataset_is_replaced_only_on_request(tmp_path: Path, form: str) -> None:
    path = written(recorded(), form, tmp_path)
    with pytest.raises(OutputExistsError, match=path.name):
        written(recorded(), form, tmp_path)
    assert mcaprl.open(path).rewards.tolist() == [0, 0.25, 0.5, 0.75, 1]
    written(recorded(2), form, tmp_path, overwrite=True)
    assert mcaprl.open(path).rewards.tolist() == [0, 0.25]


@every_format
def test_a_dataset_that_is_cut_off_is_refused_in_one_line(tmp_path: Path, form: str) -> None:
    path = written(recorded(), form, tmp_path)
    files = [path] if path.is_file() else [each for each in path.rglob("*") if each.is_file()]
    largest = max(files, key=lambda file: file.stat().st_size)
    largest.write_bytes(largest.read_bytes()[: largest.stat().st_size * 2 // 3])
    with pytest.raises(LogError, match=path.name) as caught:
        mcaprl.open(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("form", ["npz", "hdf5"])
@settings(max_examples=40, suppress_health_check=[HealthCheck.filter_too_much])
@given(arguments=transitions())
def test_any_transitions_come_back(form: str, arguments: dict[str, Any]) -> None:
    data = Dataset.from_arrays(**arguments)
    assume(is_plain(data))
    lasts = np.cumsum(data.episode_lengths) - 1
    assume(form == "npz" or (data.terminated | data.truncated)[lasts].all())
    with TemporaryDirectory() as folder:
        same_transitions(mcaprl.open(written(data, form, folder)), data)
