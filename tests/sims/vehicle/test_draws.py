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

from mcaprl.sims.vehicle.fleet import Generators, draw

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
    randoms, references = _seeded(COUNT), [np.random.default_rng(i) for i in range(COUNT)]
    for i, size in asked:
        assert _some(randoms, i, size) == references[i].random(size).tolist()


@pytest.mark.parametrize("kind", BIT_GENERATORS)
def test_generators_of_all_kinds_give_the_numbers_of_random(kind: Any) -> None:
    randoms = Generators(1)
    randoms.use(0, np.random.Generator(kind(7)))
    reference = np.random.Generator(kind(7)).random(100).tolist()
    assert _some(randoms, 0, 60) + _some(randoms, 0, 40) == reference


def test_the_uncompiled_function_draws_the_same_numbers() -> None:
    numbers = np.empty(5)
    draw.py_func(_seeded(3).addresses[2], numbers)  # type: ignore[attr-defined]
    assert numbers.tolist() == np.random.default_rng(2).random(5).tolist()


def test_calls_of_the_generator_in_between_advance_the_numbers() -> None:
    randoms, generator = Generators(1), np.random.default_rng(5)
    randoms.use(0, generator)
    expected = np.random.default_rng(5).random(6).tolist()
    found = [*_some(randoms, 0, 2), *generator.random(2).tolist(), *_some(randoms, 0, 2)]
    assert found == expected


def test_a_restored_state_repeats_the_numbers() -> None:
    randoms, generator = Generators(1), np.random.default_rng(5)
    randoms.use(0, generator)
    state = generator.bit_generator.state
    first = _some(randoms, 0, 3)
    generator.bit_generator.state = state
    assert _some(randoms, 0, 3) == first


def test_another_generator_replaces_the_first() -> None:
    randoms = _seeded(1)
    _some(randoms, 0, 2)
    randoms.use(0, np.random.default_rng(2))
    assert _some(randoms, 0, 2) == np.random.default_rng(2).random(2).tolist()


def test_only_missing_generators_are_completed() -> None:
    randoms = Generators(3)
    randoms.use(0, np.random.default_rng(8))
    randoms.complete(np.array([0, 2]), [np.random.default_rng(i) for i in range(3)])
    assert _some(randoms, 0, 2) == np.random.default_rng(8).random(2).tolist()
    assert _some(randoms, 2, 2) == np.random.default_rng(2).random(2).tolist()
    assert randoms.addresses[1] == 0


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda randoms: pickle.loads(pickle.dumps(randoms))]
)
def test_a_copy_draws_from_copies_of_the_generators(
    copied: Callable[[Generators], Generators],
) -> None:
    randoms, expected = _seeded(2), np.random.default_rng(1).random(6).tolist()
    before = _some(randoms, 1, 2)
    twin = copied(randoms)
    assert [before + _some(each, 1, 4) for each in (twin, randoms)] == [expected, expected]
    del randoms
    gc.collect()
    assert len(_some(twin, 0, 3)) == 3


def test_generators_live_as_long_as_their_object() -> None:
    randoms = _seeded(100)
    gc.collect()
    every = [np.random.default_rng(i).random(3).tolist() for i in range(100)]
    assert [_some(randoms, i, 3) for i in range(100)] == every


def _seeded(count: int) -> Generators:
    randoms = Generators(count)
    for i in range(count):
        randoms.use(i, np.random.default_rng(i))
    return randoms


def _some(randoms: Generators, i: int, size: int) -> list[float]:
    numbers = np.empty(size)
    draw(randoms.addresses[i], numbers)
    return [float(number) for number in numbers]
