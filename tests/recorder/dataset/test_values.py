"""Impossible values are refused with the name of the array and the first wrong row."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcaprl import Dataset
from mcaprl.errors import SpaceError
from mcaprl.recorder.dataset.arrays import exactly, numbers


def _dataset(**changes: Any) -> Dataset:
    """Create an episode of three steps, with the given changes."""
    columns: dict[str, Any] = {
        "observations": np.arange(3.0)[:, None],
        "next_observations": np.arange(1, 4.0)[:, None],
        "actions": np.array([0, 1, 0]),
        "rewards": np.zeros(3),
        "terminated": [False, False, True],
        "truncated": [False, False, False],
    }
    return Dataset.from_arrays(**columns | changes)


IMPOSSIBLE: list[tuple[str, Any, str]] = [
    ("terminated", [0, 2, 1], "terminated are not flags: row 1 is 2, expected 0 or 1"),
    ("terminated", [0, np.nan, 1], "terminated are not flags: row 1 is nan"),
    ("truncated", np.array([0, 255, 0], np.uint8), "truncated are not flags: row 1 is 255"),
    ("terminated", ["0", "0", "1"], "terminated has dtype <U1, .*: row 0 is '0'"),
    ("terminated", [False, None, True], "terminated has dtype object, .*: row 1 is None"),
    ("rewards", ["1", "2", "3"], "rewards has dtype <U1"),
    ("rewards", np.zeros(3, "M8[s]"), r"rewards has dtype datetime64\[s\]"),
    ("rewards", np.zeros(3, complex), "rewards has dtype complex128"),
    ("rewards", np.zeros(3, "V4"), r"rewards has dtype \|V4"),
    ("rewards", np.array([1, "x", 2], object), "rewards has dtype object, .*: row 1 is 'x'"),
    (
        "rewards",
        np.ma.MaskedArray([1.0, 2, 3], [False, False, True]),
        "rewards has no value in row 2",
    ),
    ("rewards", np.array([0, 2**53 + 1, 0]), "rewards is int64 and .*: row 1 is 9007199254740993"),
    ("behavior_probs", [0.5, 0, 1], r"behavior_probs: row 1 is 0.0, expected a number in \(0, 1\]"),
    ("behavior_probs", [0.5, 1, np.inf], "behavior_probs: row 2 is inf"),
    ("behavior_probs", [-1, 0.5, 1], "behavior_probs: row 0 is -1.0"),
    ("actions", np.array([0, -1, 0]), "action -1 in row 1 is negative"),
    ("actions", np.array([0, 2**63, 0], np.uint64), "action 9223372036854775808 in row 1 is too"),
    ("actions", np.array([0, 1, 2**20]), "action 1048576 in row 2 is too large"),
    ("actions", ["a", "b", "c"], "actions has dtype <U1"),
    ("actions", np.array([0.5, 1, np.nan]), "actions: row 2 is nan, which is not finite"),
    ("actions", np.array([[0.5], [-np.inf], [1]]), "actions: row 1 is -inf, which is not finite"),
    ("observations", np.array([["a"], ["b"], ["c"]]), "array of <U1"),
    ("next_observations", np.zeros((3, 1), object), "next_observations has dtype object"),
]


@pytest.mark.parametrize(("name", "values", "message"), IMPOSSIBLE)
def test_arrays_with_impossible_values_are_refused(name: str, values: Any, message: str) -> None:
    with pytest.raises(SpaceError, match=message) as caught:
        _dataset(**{name: values})
    assert "\n" not in str(caught.value)


def test_columns_of_other_libraries_are_read_or_refused() -> None:
    pandas, torch = pytest.importorskip("pandas"), pytest.importorskip("torch")
    arrow = pytest.importorskip("pyarrow")
    expected = _dataset(rewards=[1, 2, 3]).rewards.tolist()
    for rewards in (
        pandas.Series([1.0, 2, 3], index=[7, 3, 5]),
        torch.tensor([1.0, 2, 3]),
        arrow.array([1.0, 2, 3]),
        arrow.chunked_array([[1.0], [2, 3]]),
    ):
        assert _dataset(rewards=rewards).rewards.tolist() == expected
    for rewards, message in (
        (torch.ones(3, requires_grad=True), "rewards cannot be converted to an array: .*grad"),
        (torch.ones(3, dtype=torch.bfloat16), "rewards cannot be converted to an array"),
        (pandas.Series(["1", "2", "3"]), "rewards has dtype"),
        (pandas.Series([1, 2, 3], dtype="datetime64[ns]"), "rewards has dtype datetime64"),
        (arrow.array(["1", "2", "3"]), "rewards has dtype"),
    ):
        with pytest.raises(SpaceError, match=message):
            _dataset(rewards=rewards)
    for flags in (pandas.array([False, None, True], "boolean"), arrow.array([False, None, True])):
        with pytest.raises(
            SpaceError, match=r"terminated (has dtype object|are not flags).*row 1 is"
        ):
            _dataset(terminated=flags)


@given(
    st.lists(st.integers(-(2**63), 2**64 - 1), min_size=1, max_size=5),
    st.sampled_from(["float32", "float64", "int64", "uint64", "int8"]),
)
def test_exact_conversions_are_those_of_python(values: list[int], dtype: str) -> None:
    kind = np.uint64 if max(values) >= 2**63 else np.int64
    array = np.array([max(value, 0) if kind is np.uint64 else value for value in values], kind)
    with np.errstate(all="ignore"):
        cast = array.astype(dtype)
    if [int(value) for value in cast] == [int(value) for value in array]:
        assert exactly("x", array, np.dtype(dtype)).tolist() == cast.tolist()
    else:
        with pytest.raises(SpaceError, match=r"x is u?int64 and cannot be converted exactly"):
            exactly("x", array, np.dtype(dtype))


def test_numbers_are_not_copied() -> None:
    array = np.zeros((4, 2), np.float32)
    assert numbers("x", array) is array
