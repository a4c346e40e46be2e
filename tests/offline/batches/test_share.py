"""Tests of shares of the data: the draws of one process are divided among several."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import distributed

from mcaprl.errors import TrainingError
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.batches.share import ALONE, GroupShare, divided
from tests.offline.batches.test_buffer import walks

LENGTHS = np.array([3, 1, 4, 2])


@pytest.fixture
def group(tmp_path: Path) -> Iterator[None]:
    """Start a group of one process."""
    store = f"file://{tmp_path / 'store'}"
    distributed.init_process_group("gloo", init_method=store, rank=0, world_size=1)
    yield
    distributed.destroy_process_group()


@given(st.lists(st.integers(1, 50), min_size=1, max_size=30), st.data())
def test_ranges_of_episodes_cover_all_and_are_not_empty(
    lengths: list[int], data: st.DataObject
) -> None:
    parts = data.draw(st.integers(1, len(lengths)))
    ranges = divided(np.array(lengths), parts)
    assert [k for first, stop in ranges for k in range(first, stop)] == list(range(len(lengths)))
    assert len(ranges) == parts
    assert all(first < stop for first, stop in ranges)


def test_ranges_have_about_equally_many_transitions() -> None:
    assert divided(np.array([10, 1, 1, 1, 7]), 2) == [(0, 1), (1, 5)]
    assert divided(np.array([1, 1, 1, 9]), 3) == [(0, 2), (2, 3), (3, 4)]


@pytest.mark.usefixtures("group")
@pytest.mark.parametrize("weights", [[1, 1, 1, 1], [2, 2, 0, 2], [0, 1, 3, 2.5]])
def test_rows_are_those_that_a_whole_buffer_draws(weights: list[float]) -> None:
    buffer = whole_buffer(weights)
    share = GroupShare(LENGTHS, np.array(weights, float), 0, 4)
    found, expected = (
        one.sample_rows(5000, torch.Generator().manual_seed(1)) for one in (share, buffer)
    )
    assert found.tolist() == expected.tolist()


def whole_buffer(weights: list[float]) -> TransitionBuffer:
    data = walks(LENGTHS.tolist(), [True] * 4)
    return TransitionBuffer.from_dataset(data, weights=np.array(weights, float))


@pytest.mark.usefixtures("group")
def test_a_process_gets_its_rows_padded_with_factors_of_zero() -> None:
    """Draw rows for a process that holds rows 3 to 7 of ten.

    For each of two seeds, B = 40 rows are drawn, and the process holds some of them. M is the
    larger of the two numbers of held rows. Both seeds get M rows; missing rows have the factor 0.
    A mean over M rows replaces a mean over B rows, so the other factors are M / B.
    """
    share = GroupShare(LENGTHS, np.ones(4), 1, 3)
    buffer = whole_buffer([1, 1, 1, 1])
    generators = [torch.Generator().manual_seed(seed) for seed in (0, 1)]
    rows, factors = share.draw(buffer, 40, generators)
    wanted = [share.sample_rows(40, torch.Generator().manual_seed(seed)).numpy() for seed in (0, 1)]
    held = [all_rows[(all_rows >= 3) & (all_rows < 8)] - 3 for all_rows in wanted]
    most = max(map(len, held))
    for seed in (0, 1):
        mine = rows.view(2, -1)[seed], factors.view(2, -1)[seed]
        count = len(held[seed])
        assert mine[0][:count].tolist() == held[seed].tolist()
        assert mine[1].tolist() == pytest.approx([most / 40] * count + [0.0] * (most - count))
    means = (rows.float() * factors).view(2, -1).mean(1)
    assert means.tolist() == pytest.approx([part.sum() / 40 for part in held])


@pytest.mark.usefixtures("group")
def test_data_without_weights_above_zero_are_refused() -> None:
    with pytest.raises(TrainingError, match="all weights are 0"):
        GroupShare(LENGTHS, np.zeros(4), 0, 4)


def test_moments_of_parts_are_those_of_the_whole() -> None:
    values = np.random.default_rng(0).normal(3, 2, (50, 4))
    parts = [values[:7], values[7:8], values[8:]]

    class Parts(type(ALONE)):  # type: ignore[misc]
        def gather(self, value: object) -> list[object]:
            return [(len(part), part.mean(0), part.std(0)) for part in parts]

    mean, deviation = Parts().moments(0, None, None)
    assert mean == pytest.approx(values.mean(0), rel=1e-12)
    assert deviation == pytest.approx(values.std(0), rel=1e-12)
