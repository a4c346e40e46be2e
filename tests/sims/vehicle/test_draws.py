"""Tests that compiled code draws the numbers of NumPy's generators."""

from __future__ import annotations

import copy
import gc
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcaprl.sims.vehicle.draws import Draws, draw

COUNT = 4
BIT_GENERATORS = (
    np.random.PCG64,
    np.random.PCG64DXSM,
    np.random.MT19937,
    np.random.Philox,
    np.random.SFC64,
)


@given(st.lists(st.tuples(st.integers(0, COUNT - 1), st.integers(0, 5)), max_size=40))
def test_each_generator_gives_its_numbers_in_their_order(asked: list[tuple[int, int]]) -> None:
    draws, references = _seeded(COUNT), [np.random.default_rng(i) for i in range(COUNT)]
    for i, size in asked:
        assert _some(draws, i, size) == references[i].random(size).tolist()


@pytest.mark.parametrize("kind", BIT_GENERATORS)
def test_generators_of_all_kinds_give_the_numbers_of_random(kind: Any) -> None:
    draws = Draws(1)
    draws.use_generator(0, np.random.Generator(kind(7)))
    reference = np.random.Generator(kind(7)).random(100).tolist()
    assert _some(draws, 0, 60) + _some(draws, 0, 40) == reference


def test_the_uncompiled_function_draws_the_same_numbers() -> None:
    numbers = np.empty(5)
    draw.py_func(_seeded(3).addresses[2], numbers)  # type: ignore[attr-defined]
    assert numbers.tolist() == np.random.default_rng(2).random(5).tolist()


def test_calls_of_the_generator_in_between_advance_the_draws() -> None:
    draws, generator, reference = Draws(1), np.random.default_rng(5), np.random.default_rng(5)
    draws.use_generator(0, generator)
    expected = reference.random(6).tolist()
    found = [*_some(draws, 0, 2), *generator.random(2).tolist(), *_some(draws, 0, 2)]
    assert found == expected


def test_a_restored_state_repeats_the_numbers() -> None:
    draws, generator = Draws(1), np.random.default_rng(5)
    draws.use_generator(0, generator)
    state = generator.bit_generator.state
    first = _some(draws, 0, 3)
    generator.bit_generator.state = state
    assert _some(draws, 0, 3) == first


def test_another_generator_replaces_the_first() -> None:
    draws = _seeded(1)
    _some(draws, 0, 2)
    draws.use_generator(0, np.random.default_rng(2))
    assert _some(draws, 0, 2) == np.random.default_rng(2).random(2).tolist()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda draws: pickle.loads(pickle.dumps(draws))])
def test_a_copy_draws_from_copies_of_the_generators(copied: Callable[[Draws], Draws]) -> None:
    draws, expected = _seeded(2), np.random.default_rng(1).random(6).tolist()
    before = _some(draws, 1, 2)
    twin = copied(draws)
    assert [before + _some(each, 1, 4) for each in (twin, draws)] == [expected, expected]
    del draws
    gc.collect()
    assert len(_some(twin, 0, 3)) == 3


def test_a_generator_lives_as_long_as_its_draws() -> None:
    draws = _seeded(100)
    gc.collect()
    every = [np.random.default_rng(i).random(3).tolist() for i in range(100)]
    assert [_some(draws, i, 3) for i in range(100)] == every


def _seeded(count: int) -> Draws:
    draws = Draws(count)
    for i in range(count):
        draws.use_generator(i, np.random.default_rng(i))
    return draws


def _some(draws: Draws, i: int, size: int) -> list[float]:
    numbers = np.empty(size)
    draw(draws.addresses[i], numbers)
    return [float(number) for number in numbers]
