"""The buffer: columns packed into tensors, rows drawn at random."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from mcaprl.errors import McaprlError, SpaceError
from mcaprl.offline.buffer import TransitionBuffer
from mcaprl.recorder.dataset import Dataset


def numbered(n_rows: int, **changes: Any) -> Dataset:
    """Row k goes from (k, -k) to (k + 100, 100 - k) by action 3 + k % 2 and earns k / 2."""
    k = np.arange(n_rows)
    observations = np.stack([k, -k], axis=1).astype(np.float32)
    columns: dict[str, Any] = {
        "observations": observations,
        "actions": 3 + k % 2,
        "rewards": k / 2,
        "terminated": k % 3 == 0,
        "truncated": k % 3 == 1,
        "next_observations": observations + 100,
        "action_space": spaces.Discrete(2, start=3),
    }
    return Dataset.from_arrays(**{**columns, **changes})


def test_columns_become_tensors() -> None:
    buffer = TransitionBuffer.from_dataset(numbered(4))
    assert len(buffer) == 4
    assert buffer.observations.tolist() == [[0, 0], [1, -1], [2, -2], [3, -3]]
    assert buffer.next_observations[1].tolist() == [101, 99]
    assert buffer.rewards.tolist() == [0, 0.5, 1, 1.5]
    assert buffer.rewards.dtype == buffer.observations.dtype == torch.float32


def test_actions_are_counted_from_zero() -> None:
    assert TransitionBuffer.from_dataset(numbered(4)).actions.tolist() == [0, 1, 0, 1]


def test_only_termination_ends_the_return() -> None:
    # Rows 0 and 3 terminated, row 1 was truncated, row 2 neither.
    assert TransitionBuffer.from_dataset(numbered(4)).continues.tolist() == [0, 1, 1, 0]


def test_images_stay_bytes() -> None:
    images: NDArray[np.uint8] = np.full((3, 36, 36, 1), 200, np.uint8)
    dataset = numbered(3, observations=images, next_observations=images)
    buffer = TransitionBuffer.from_dataset(dataset)
    assert buffer.observations.dtype == buffer.next_observations.dtype == torch.uint8
    assert buffer.observations.shape == (3, 36, 36, 1)


@given(n_rows=st.integers(1, 40), batch_size=st.integers(1, 64), seed=st.integers(0, 99))
def test_a_batch_is_made_of_whole_rows(n_rows: int, batch_size: int, seed: int) -> None:
    buffer = TransitionBuffer.from_dataset(numbered(n_rows))
    batch = buffer.sample(batch_size, torch.Generator().manual_seed(seed))
    assert batch.rows.shape == (batch_size,)
    assert batch.rows.min() >= 0
    assert batch.rows.max() < n_rows
    k = batch.rows
    assert torch.equal(batch.observations, torch.stack([k, -k], dim=1).float())
    assert torch.equal(batch.next_observations, batch.observations + 100)
    assert torch.equal(batch.actions, k % 2)
    assert torch.equal(batch.rewards, k / 2)
    assert torch.equal(batch.continues, (k % 3 != 0).float())


def test_the_generator_decides_the_draw() -> None:
    buffer = TransitionBuffer.from_dataset(numbered(50))
    draws = [buffer.sample(8, torch.Generator().manual_seed(seed)).rows for seed in (1, 1, 2)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


def test_every_row_is_drawn_equally_often() -> None:
    buffer = TransitionBuffer.from_dataset(numbered(10))
    rows = buffer.sample(100_000, torch.Generator().manual_seed(0)).rows
    # 10,000 each with a standard deviation of 95.
    assert (torch.bincount(rows) - 10_000).abs().max() < 5 * 95


def test_continuous_actions_are_refused() -> None:
    actions = np.zeros((4, 1), np.float32)
    dataset = numbered(4, actions=actions, action_space=spaces.Box(-1, 1, (1,)))
    with pytest.raises(SpaceError, match="needs discrete actions, got Box"):
        TransitionBuffer.from_dataset(dataset)


def test_dict_observations_are_refused() -> None:
    parts = {"state": np.zeros((4, 2), np.float32)}
    dataset = numbered(4, observations=parts, next_observations=parts)
    with pytest.raises(SpaceError, match="Dict"):
        TransitionBuffer.from_dataset(dataset)


def test_an_action_outside_its_space_is_refused() -> None:
    dataset = numbered(4, actions=np.array([3, 4, 5, 3]))
    with pytest.raises(SpaceError, match="5"):
        TransitionBuffer.from_dataset(dataset)


@pytest.mark.parametrize("column", ["observations", "rewards", "next_observations"])
def test_a_number_that_is_not_finite_is_named_by_column_and_row(column: str) -> None:
    values = np.array(getattr(numbered(4), column))
    values[2] = np.nan
    dataset = numbered(4, **{column: values})
    with pytest.raises(McaprlError, match=rf"{column}.*row 2"):
        TransitionBuffer.from_dataset(dataset)
