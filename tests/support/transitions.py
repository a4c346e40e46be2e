"""Transitions that formats without spaces can hold, and their comparison."""

from __future__ import annotations

import numpy as np

from mcaprl import Dataset
from mcaprl.recorder.format.spaces import leaves_of
from tests.support.recordings import assert_same_bits


def is_plain(data: Dataset) -> bool:
    """Return whether rewards and actions are finite, and integer actions small and not negative."""
    actions, is_scalar = data.actions, data.actions.ndim == 1
    if actions.dtype.kind in "iu" and is_scalar:
        is_fine = bool((actions >= 0).all() and (actions < 2**20).all())
    else:
        is_fine = actions.dtype.kind != "f" or bool(np.isfinite(actions).all())
    return is_fine and bool(np.isfinite(data.rewards).all())


def same_transitions(found: Dataset, data: Dataset, *, probs: bool = True) -> None:
    """Check that all transitions have the same bits, and that leaves have the same order.

    Without a space, scalar integer actions are discrete, so they may have another dtype.

    Args:
        found: Dataset that was read.
        data: Dataset that was written.
        probs: Whether to compare probabilities or densities of actions.
    """
    assert found.episode_lengths.tolist() == data.episode_lengths.tolist()
    is_index = data.actions.ndim == 1 and data.actions.dtype.kind in "iu"
    assert_same_bits(found.actions, data.actions.astype(np.int64) if is_index else data.actions)
    names = ["rewards", "terminated", "truncated"]
    for name in [*names, "behavior"] if probs else names:
        assert_same_bits(getattr(found, name), getattr(data, name))
    mine, theirs = leaves_of(found.observation_space), leaves_of(data.observation_space)
    for leaf, other in zip(mine, theirs, strict=True):
        assert_same_bits(leaf.of(found.frames), other.of(data.frames))
