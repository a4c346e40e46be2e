"""Round trips: the data that is read from a log equals the recorded data, bit for bit."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings

import mcaprl
from mcaprl.errors import SpaceError
from mcaprl.recorder.format.spaces import space_from_json, space_to_json
from tests.support.recordings import MIXED_SPACE, assert_holds, assert_same_bits, leaves_of, record
from tests.support.strategies import observation_spaces, transitions

VECTOR = spaces.Box(-np.inf, np.inf, (4,), np.float32)


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
@pytest.mark.parametrize(
    ("observation_space", "action_space"),
    [
        (VECTOR, spaces.Discrete(3)),
        (VECTOR, spaces.Discrete(3, start=-2)),
        (spaces.Box(-1, 1, (2, 3), np.float64), spaces.Box(-1, 1, (2,), np.float32)),
        (spaces.Box(0, 255, (20, 16, 1), np.uint8), spaces.MultiDiscrete([3, 4])),
        (MIXED_SPACE, spaces.Box(-1, 1, (1,), np.float64)),
    ],
    ids=["vector", "negative-actions", "float64-matrix", "image", "dict"],
)
def test_recording_round_trip(
    log_path: Path, observation_space: Any, action_space: Any, compression: str
) -> None:
    truth = record(
        log_path, observation_space, action_space, [3, 1, 250, 7], compression=compression
    )
    dataset = mcaprl.open(log_path)
    assert_holds(dataset, truth)
    assert [episode.length for episode in dataset.episodes] == [3, 1, 250, 7]
    assert [episode.seed for episode in dataset.episodes] == [100, 101, 102, 103]
    assert dataset.observation_space == observation_space
    assert dataset.action_space == action_space


@pytest.mark.parametrize(
    "lengths", [[4095, 4096, 4097, 10_000, 2], [1] * 2047 + [4094, 1], [4093, 1, 1]]
)
def test_episodes_that_end_near_the_end_of_a_chunk(log_path: Path, lengths: list[int]) -> None:
    truth = record(log_path, VECTOR, spaces.Discrete(2), lengths)
    dataset = mcaprl.open(log_path)
    assert_holds(dataset, truth)
    assert [episode.length for episode in dataset.episodes] == lengths
    copy = log_path.with_name("copy.mcap")
    dataset.save(copy)
    assert_holds(mcaprl.open(copy), truth)
    assert mcaprl.open(copy).fingerprint == dataset.fingerprint


@settings(max_examples=150)
@given(transitions())
def test_arrays_round_trip(arrays: dict[str, Any]) -> None:
    dataset = mcaprl.Dataset.from_arrays(**arrays, env_id="Any-v0")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        dataset.save(path)
        again = mcaprl.open(path)
    for name in ("actions", "rewards", "terminated", "truncated"):
        assert_same_bits(getattr(again, name), arrays[name])
    for name in ("observations", "next_observations"):
        expected = leaves_of(arrays[name])
        for column, values in zip(leaves_of(getattr(again, name)), expected, strict=True):
            assert_same_bits(column, values)
    assert again.fingerprint == dataset.fingerprint
    assert again.env_id == "Any-v0"
    name = again.behavior_field.plural
    assert_same_bits(getattr(again, name), arrays[name])


@given(observation_spaces())
def test_space_json_round_trip(space: spaces.Space[Any]) -> None:
    assert space_from_json(space_to_json(space)) == space


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("255", "655"),
        ("[2, 3]", "[2, -3]"),
        ("[2, 3]", "[2, 9000000000000]"),
        ('"uint8"', '"uint9"'),
        ('"low": 0', '"low": []'),
        ('"low": 0', '"low": "many"'),
        ('"type"', '"kind"'),
        ("{", "[" * 100_000),
    ],
)
def test_a_damaged_space_description_is_one_error(old: str, new: str) -> None:
    text = space_to_json(spaces.Box(0, 255, (2, 3), np.uint8))
    assert old in text
    with pytest.raises(SpaceError, match=r"not a description of a space|too large"):
        space_from_json(text.replace(old, new))


def test_save_keeps_episodes_and_times(tmp_path: Path) -> None:
    record(
        tmp_path / "a.mcap", MIXED_SPACE, spaces.Discrete(2), [5, 2, 9], policy="p", epsilon=0.25
    )
    first = mcaprl.open(tmp_path / "a.mcap")
    chosen = first.filter(lambda episode: episode.length > 2)
    chosen.save(tmp_path / "b.mcap")
    second = mcaprl.open(tmp_path / "b.mcap")
    assert second.fingerprint == chosen.fingerprint != first.fingerprint
    for old, new in zip(chosen.episodes, second.episodes, strict=True):
        assert (old.seed, old.policy, old.epsilon) == (new.seed, new.policy, new.epsilon)
        assert_same_bits(new.log_time_ns, old.log_time_ns)
