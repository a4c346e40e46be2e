"""Test the buffers for the open episodes of vector environments."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from mcaprl.recorder.format.schema import LEARNER_TEXT, TopicRows
from mcaprl.recorder.record import step_rows
from mcaprl.recorder.record.step_rows import OpenRows

ENVIRONMENTS, ROWS, PER_CHUNK = 5, 40, 7


def buffers(chunks: list[NDArray[Any]], fields: list[str]) -> OpenRows[TopicRows]:
    """Create buffers of `/rl/learner` that append copies of the written records to `chunks`."""
    write = lambda rows: chunks.append(rows.copy())  # noqa: E731
    chunk = TopicRows.of_text(LEARNER_TEXT, 3, PER_CHUNK, write)
    chunk.fields["epsilon"][:], chunk.fields["policy_version"][:] = -1.0, -1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(step_rows, "_FIRST_CAPACITY", 4)
        return OpenRows(chunk, ENVIRONMENTS, fields)


@given(
    st.lists(
        st.tuples(
            st.integers(0, ENVIRONMENTS - 1), st.integers(0, ROWS - 1), st.integers(1, ROWS)
        ).map(lambda one: (one[0], one[1], min(one[2], ROWS - one[1]))),
        min_size=1,
        max_size=8,
    )
)
def test_rows_are_written_in_order_and_in_few_chunks(wanted: list[tuple[int, int, int]]) -> None:
    chunks: list[NDArray[Any]] = []
    rows = buffers(chunks, ["epsilon", "policy_version"])
    values = np.arange(ROWS * ENVIRONMENTS).reshape(ROWS, ENVIRONMENTS)
    for row, each in enumerate(values):
        if row + 1 > rows.capacity:
            rows.make_room(row + 1, row - 1)
        rows.put("epsilon", row, each / 2)
        rows.put("policy_version", row, each)
    environments, firsts, counts = map(list, zip(*wanted, strict=True))
    starts = np.arange(len(wanted)) * 1000
    rows.write(environments, firsts, counts, starts, 10)
    written = np.concatenate(chunks)
    expected = np.concatenate([values[row : row + n, env] for env, row, n in wanted])
    np.testing.assert_array_equal(written["payload"]["policy_version"], expected)
    np.testing.assert_array_equal(written["payload"]["epsilon"], expected / 2)
    times = [start + 10 * np.arange(n) for start, (_, _, n) in zip(starts, wanted, strict=True)]
    np.testing.assert_array_equal(written["log_time"], np.concatenate(times))
    assert (written["channel_id"] == 3).all()
    # Environments share a chunk if all their rows fit; only longer ones are divided.
    sizes, used = [], 0
    for count in counts:
        if used and used + count > PER_CHUNK:
            sizes.append(used)
            used = 0
        used += count
        sizes += [PER_CHUNK] * (used // PER_CHUNK)
        used %= PER_CHUNK
    assert [len(chunk) for chunk in chunks] == sizes + [used] * (used > 0)


def test_only_the_fields_after_the_first_that_is_set_change() -> None:
    chunks: list[NDArray[Any]] = []
    rows = buffers(chunks, ["policy_version"])
    rows.put("policy_version", 0, np.arange(ENVIRONMENTS))
    rows.write([4, 2], [0, 0], [1, 1], np.array([0, 100]), 10)
    assert chunks[0]["payload"]["policy_version"].tolist() == [4, 2]
    assert chunks[0]["payload"]["epsilon"].tolist() == [-1.0, -1.0]
    assert chunks[0]["payload"]["encapsulation"].tolist() == [256, 256]


def test_one_environment_is_set_alone() -> None:
    chunks: list[NDArray[Any]] = []
    rows = buffers(chunks, ["policy_version"])
    rows.put("policy_version", 3, np.arange(ENVIRONMENTS))
    rows.put("policy_version", 3, 9, 1)
    rows.put("policy_version", 3, np.array([7, 8]), np.array([0, 4]))
    rows.write(list(range(ENVIRONMENTS)), [3] * ENVIRONMENTS, [1] * 5, np.arange(5), 10)
    assert chunks[0]["payload"]["policy_version"].tolist() == [7, 9, 2, 3, 8]
