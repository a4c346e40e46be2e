"""Tests of the numbering of actions against a slow reference: itertools.product."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mcaprl.actions import JointActions, joint_actions

SHAPES = hnp.array_shapes(max_dims=2, max_side=3)


@st.composite
def finite_spaces(draw: st.DrawFn) -> spaces.Space[Any]:
    shape = draw(SHAPES)
    if draw(st.booleans()):
        return spaces.MultiBinary(shape if len(shape) > 1 else shape[0])
    nvec = draw(hnp.arrays(np.int32, shape, elements=st.integers(1, 3)))
    start = draw(hnp.arrays(np.int32, shape, elements=st.integers(-4, 4)))
    return spaces.MultiDiscrete(nvec, dtype=np.int32, start=start)


@given(finite_spaces())
def test_every_value_has_its_place_in_the_product_of_the_elements(space: Any) -> None:
    joint = JointActions.of(space)
    sizes = [2] * int(np.prod(space.shape)) if isinstance(space, spaces.MultiBinary) else None
    starts = [0] * len(sizes) if sizes else space.start.ravel().tolist()
    sizes = sizes or space.nvec.ravel().tolist()
    ranges = [range(start, start + size) for start, size in zip(starts, sizes, strict=True)]
    every = np.array(list(itertools.product(*ranges))).reshape(-1, *space.shape)
    assert joint.count == len(every)
    found = joint.values(np.arange(len(every)))
    np.testing.assert_array_equal(found, every)
    assert found.dtype == space.dtype
    assert all(value in space for value in found)
    np.testing.assert_array_equal(joint.indexes(every), np.arange(len(every)))
    assert joint.contain(every).all()
    assert not joint.contain(every + np.array(sizes).reshape(space.shape)).any()


def test_a_discrete_space_is_numbered_from_its_start() -> None:
    joint = JointActions.of(spaces.Discrete(3, start=-1))
    assert (joint.count, joint.first, joint.shape) == (3, -1, ())
    assert joint.values(np.array([0, 2])).tolist() == [-1, 1]
    assert joint.indexes(np.array([1, -1])).tolist() == [2, 0]
    assert joint.contain(np.array([-2, -1, 1, 2])).tolist() == [False, True, True, False]


def test_other_spaces_have_no_numbers() -> None:
    assert joint_actions(spaces.Box(0, 1, (2,))) is None
    assert joint_actions(spaces.Dict({"a": spaces.Discrete(2)})) is None
    with pytest.raises(TypeError, match="not a finite space"):
        JointActions.of(spaces.Box(0, 1, (2,)))
