"""Hypothesis strategies: spaces that a log can store, and transitions in them."""

from __future__ import annotations

from typing import Any

import hypothesis.extra.numpy as numpy_strategies
import hypothesis.strategies as st
import numpy as np
from gymnasium import spaces

from mcaprl.recorder.format.behavior import LOG_DENSITY, behavior_field

DTYPES = ("float32", "float64", "float16", "int64", "int32", "int16", "int8", "uint8", "uint64")


@st.composite
def boxes(draw: st.DrawFn) -> spaces.Box:
    """Draw unbounded Boxes of any dtype; their shapes range from scalars to small images."""
    dtype = np.dtype(draw(st.sampled_from(DTYPES)))
    shape = draw(st.sampled_from([(), (1,), (3,), (7,), (2, 2), (2, 3, 2), (8, 9, 3), (9, 8)]))
    if dtype.kind == "f":
        return spaces.Box(-np.inf, np.inf, shape, dtype.type)
    info = np.iinfo(str(dtype))
    low, high = int(info.min), int(info.max)
    return spaces.Box(low, high, shape, dtype.type)


def simple_spaces() -> st.SearchStrategy[spaces.Space[Any]]:
    """Draw spaces of all kinds that have a single leaf."""
    return st.one_of(
        boxes(),
        st.builds(
            lambda n, start: spaces.Discrete(n, start=start), st.integers(1, 9), st.integers(-5, 5)
        ),
        st.builds(spaces.MultiBinary, st.integers(1, 6)),
        st.builds(
            lambda n: spaces.MultiDiscrete(n), st.lists(st.integers(1, 9), min_size=1, max_size=4)
        ),
    )


def observation_spaces() -> st.SearchStrategy[spaces.Space[Any]]:
    """Draw spaces with a single leaf, and Dicts of such spaces with any keys."""
    keys = st.text(min_size=1, max_size=6)
    dicts = st.dictionaries(keys, simple_spaces(), min_size=1, max_size=3).map(spaces.Dict)
    return st.one_of(simple_spaces(), dicts)


@st.composite
def values_of(draw: st.DrawFn, space: spaces.Space[Any], rows: int) -> Any:
    """Draw `rows` values of a space as arrays, with any bit pattern of the dtype."""
    if isinstance(space, spaces.Dict):
        return {key: draw(values_of(part, rows)) for key, part in space.spaces.items()}
    dtype, shape = np.dtype(space.dtype), (rows, *(space.shape or ()))
    if isinstance(space, spaces.Box):
        unsigned = np.dtype(f"u{dtype.itemsize}")
        bits = draw(numpy_strategies.arrays(unsigned, shape))
        return bits.view(dtype)
    space.seed(draw(st.integers(0, 2**31)))
    return np.stack([np.asarray(space.sample()) for _ in range(rows)])


def _finite(actions: Any) -> Any:
    """Return actions as `from_arrays` accepts them."""
    return np.where(np.isfinite(actions), actions, 0).astype(actions.dtype)


@st.composite
def transitions(draw: st.DrawFn) -> dict[str, Any]:
    """Draw keyword arguments for `Dataset.from_arrays`, including spaces."""
    observation_space, action_space = draw(observation_spaces()), draw(simple_spaces())
    rows = draw(st.integers(1, 12))
    ends = numpy_strategies.arrays(np.bool_, rows)
    kind = behavior_field(action_space)
    limit = 2.0**100 if kind is LOG_DENSITY else 1.0
    least = -limit if kind is LOG_DENSITY else 2.0**-100
    values = st.one_of(st.just(np.nan), st.floats(least, limit, width=32))
    behavior = numpy_strategies.arrays(np.float32, rows, elements=values)
    rewards = numpy_strategies.arrays(np.uint64, rows).map(lambda bits: bits.view(np.float64))
    return {
        "observation_space": observation_space,
        "action_space": action_space,
        "observations": draw(values_of(observation_space, rows)),
        "next_observations": draw(values_of(observation_space, rows)),
        "actions": _finite(draw(values_of(action_space, rows))),
        "rewards": draw(rewards),
        "terminated": draw(ends),
        "truncated": draw(ends),
        kind.plural: draw(behavior),
    }
