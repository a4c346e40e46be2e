"""Execution of chunks: open loop, temporal ensembling, and episodes that begin at other times."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from mcaprl.chunks import ChunkExecution, Chunks, planned


def predictions(steps: int, length: int) -> NDArray[Any]:
    """Return chunks (T, H, 1): the action of step t + k, as predicted at step t, is 10 t + k."""
    return (10.0 * np.arange(steps)[:, None] + np.arange(length))[:, :, None]


def test_open_loop_by_hand() -> None:
    found = planned(Chunks(4, 3), predictions(7, 4))[:, 0]
    assert found.tolist() == [0, 1, 2, 30, 31, 32, 60]
    assert planned(Chunks(4, 1), predictions(3, 4))[:, 0].tolist() == [0, 10, 20]
    assert planned(Chunks(2, 2), np.array([[4, 5], [6, 7], [8, 9]])).tolist() == [4, 5, 8]


def test_ensembling_by_hand() -> None:
    # At step 2, chunks of 0, 1 and 2 have the actions 2, 11 and 20; the oldest has the weight 1.
    found = planned(Chunks(3, 1, math.log(2)), predictions(5, 3))[:, 0]
    weights = np.array([1, 1 / 2, 1 / 4])
    assert found[0] == 0
    assert found[1] == pytest.approx((1 * 1 + 10 / 2) / 1.5)
    assert found[2] == pytest.approx(weights @ [2, 11, 20] / 1.75)
    assert found[4] == pytest.approx(weights @ [22, 31, 40] / 1.75)
    assert planned(Chunks(3, 1, 0.0), predictions(3, 3))[2, 0] == pytest.approx(11)
    assert planned(Chunks(3, 1, -100.0), predictions(3, 3))[2, 0] == pytest.approx(20)


def acts_reference(chunks: Chunks, table: NDArray[Any], began: int, now: int) -> Any:
    """Return ACT's action at a step: its table (t, t + k) of all predictions, written out."""
    if chunks.ensemble is None:
        at = now - (now - began) % chunks.execute
        return table[at, now - at]
    rows = [table[at, now - at] for at in range(max(began, now - chunks.length + 1), now + 1)]
    weights = np.exp(-chunks.ensemble * np.arange(len(rows)))
    return (weights[:, None] * np.stack(rows)).sum(0) / weights.sum()


@given(data=st.data())
def test_each_row_has_the_actions_of_its_own_episode(data: st.DataObject) -> None:
    length = data.draw(st.integers(1, 5))
    is_open = data.draw(st.booleans())
    execute = data.draw(st.integers(1, length)) if is_open else 1
    chunks = Chunks(length, execute, None if is_open else data.draw(st.floats(-2, 2)))
    steps, count = data.draw(st.integers(1, 12)), data.draw(st.integers(1, 3))
    random = np.random.default_rng(data.draw(st.integers(0, 99)))
    table = random.standard_normal((steps, count, length, 2))
    execution, began, calls = ChunkExecution(chunks), np.zeros(count, int), 0
    for now in range(steps):
        restarted = data.draw(st.lists(st.integers(0, count - 1), unique=True, max_size=count))
        if len(restarted) == count:
            execution.clear()
        else:
            execution.clear(restarted)
        began[restarted] = now

        def predict(step: int = now) -> NDArray[Any]:
            nonlocal calls
            calls += 1
            found: NDArray[Any] = table[step]
            return found

        found = execution.act(count, predict)
        for row in range(count):
            wanted = acts_reference(chunks, table[:, row], int(began[row]), now)
            np.testing.assert_allclose(found[row], wanted, atol=1e-12)
    if count == 1 and is_open and length == execute and not began.any():
        assert calls == -(-steps // length)


def test_another_number_of_episodes_begins_new_ones() -> None:
    execution = ChunkExecution(Chunks(3, 3))
    assert execution.act(2, lambda: np.array([[1, 2, 3], [4, 5, 6]])).tolist() == [1, 4]
    assert execution.act(1, lambda: np.array([[7, 8, 9]])).tolist() == [7]
    execution.clear()
    assert execution.act(1, lambda: np.array([[5, 8, 9]])).tolist() == [5]


@pytest.mark.parametrize(
    "wrong",
    [(0, 1, None), (4, 5, None), (4, 0, None), (4, 1, math.nan), (4, 1, 101.0), ("4", 1, None)],
)
def test_impossible_numbers_are_refused(wrong: Any) -> None:
    with pytest.raises(ValueError, match=r"chunks of|ensemble"):
        Chunks(*wrong)
