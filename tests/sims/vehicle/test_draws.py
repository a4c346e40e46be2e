"""Tests that numbers drawn in advance equal the numbers of the generators."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from mcaprl.sims.vehicle.draws import Draws, take

COUNT = 4


@given(st.lists(st.sets(st.integers(0, COUNT - 1)), max_size=80))
def test_each_generator_gives_its_numbers_in_their_order(asked: list[set[int]]) -> None:
    draws, references = Draws(COUNT, 3), [np.random.default_rng(i) for i in range(COUNT)]
    for i in range(COUNT):
        draws.use_generator(i, np.random.default_rng(i))
    for who in asked:
        chosen = np.array(sorted(who), dtype=np.int64)
        expected = [references[i].random(3).tolist() for i in sorted(who)]
        assert _some(draws, chosen) == expected


def test_another_generator_starts_over() -> None:
    draws = Draws(1, 2)
    draws.use_generator(0, np.random.default_rng(1))
    _some(draws, np.array([0]))
    draws.use_generator(0, np.random.default_rng(2))
    assert _some(draws, np.array([0])) == [np.random.default_rng(2).random(2).tolist()]


def _some(draws: Draws, chosen: NDArray[np.int64]) -> list[list[float]]:
    draws.draw_ahead(chosen)
    return [take(draws.numbers, draws.used, i).tolist() for i in chosen]
