"""Transitions that formats without spaces can hold, and their comparison."""

from __future__ import annotations

from typing import Any

import numpy as np

from mcaprl import Dataset
from mcaprl.recorder.format.spaces import leaves_of


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
        probs: Whether to compare action probabilities.
    """
    assert found.episode_lengths.tolist() == data.episode_lengths.tolist()
    is_index = data.actions.ndim == 1 and data.actions.dtype.kind in "iu"
    same_bits(found.actions, data.actions.astype(np.int64) if is_index else data.actions)
    names = ["rewards", "terminated", "truncated"]
    for name in [*names, "behavior_probs"] if probs else names:
        same_bits(getattr(found, name), getattr(data, name))
    mine, theirs = leaves_of(found.observation_space), leaves_of(data.observation_space)
    for leaf, other in zip(mine, theirs, strict=True):
        same_bits(leaf.of(found.frames), other.of(data.frames))


def same_bits(found: Any, expected: Any) -> None:
    """Check that two arrays have the same dtype, shape and bytes."""
    found, expected = np.asarray(found), np.asarray(expected)
    assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
    assert found.tobytes() == expected.tobytes()
