"""Chunks: several actions from one observation, and how they are executed.

A policy with chunks of H actions predicts the actions of a step and of the H - 1 steps after it.
Either the first K of them are executed before the next prediction (open loop), or every step has a
prediction, and the actions that the last H ones have for the step are averaged. These are "action
chunking" and "temporal ensembling" in Zhao et al., "Learning Fine-Grained Bimanual Manipulation
with Low-Cost Hardware", 2023, https://arxiv.org/abs/2304.13705.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Chunks:
    """Length of a policy's chunks, and how they are executed.

    Attributes:
        length: Number of actions H that are predicted from one observation.
        execute: Number of actions K, 1 to H, that are executed before the next prediction.
        ensemble: Coefficient m of temporal ensembling; None for open loop. Of the predictions that
            have an action for a step, the k-th one, from 0 for the oldest, has the weight
            exp(-m k). ACT uses 0.01; 0 is the mean, and with a negative one the newest counts most.

    Raises:
        ValueError: A number is out of range.
    """

    length: int = 1
    execute: int = 1
    ensemble: float | None = None

    def __post_init__(self) -> None:
        """Check the numbers."""
        counts = isinstance(self.length, int) and isinstance(self.execute, int)
        if not (counts and 1 <= self.execute <= self.length):
            raise ValueError(f"cannot execute {self.execute} actions of chunks of {self.length}")
        if self.ensemble is not None and not abs(self.ensemble) <= MOST_DECAY:
            raise ValueError(f"ensemble {self.ensemble} is not within +-{MOST_DECAY:g}")

    @property
    def has_memory(self) -> bool:
        """Whether an action depends on earlier observations."""
        return self.execute > 1 or (self.ensemble is not None and self.length > 1)

    def to_json(self) -> dict[str, Any]:
        """Return the numbers as JSON types."""
        return asdict(self)

    def __str__(self) -> str:
        """Return a description for messages."""
        if self.ensemble is not None:
            return f"chunks of {self.length} actions, averaged with m = {self.ensemble:g}"
        return f"chunks of {self.length} actions, of which {self.execute} are executed"


MOST_DECAY = 100.0
"""Largest coefficient of temporal ensembling: a weight of exp(-100) is zero beside 1."""


class ChunkExecution:
    """Execution of the chunks of B episodes, each of which may be at another step."""

    def __init__(self, chunks: Chunks) -> None:
        """Start without episodes."""
        self._chunks = chunks
        self.clear()

    def clear(self, rows: Sequence[int] | None = None) -> None:
        """Drop the predictions of all episodes, or of some rows: the next actions need new ones."""
        if rows is None:
            # Predictions (B, H, *shape), or (B, H, H, *shape) of the last H steps, newest first.
            self._known: NDArray[Any] = np.empty(0)
            self._ages = np.empty(0, np.int64)
        elif len(self._ages):
            self._ages[list(rows)] = self._chunks.length

    def act(self, count: int, predict: Callable[[], NDArray[Any]]) -> NDArray[Any]:
        """Return the next actions (B, *shape), with a new prediction where one is needed."""
        # With another `count` B than in the last call, all episodes begin. `predict` returns the
        # chunks (B, H, *shape) from the current observations.
        length, every = self._chunks.length, np.arange(count)
        if len(self._ages) != count:
            self._ages = np.full(count, length)
        if self._chunks.ensemble is not None:
            return self._average(predict())
        is_due = self._ages >= self._chunks.execute
        if is_due.any():
            found = predict()
            if not is_due.all():
                found = np.where(is_due.reshape(-1, *[1] * (found.ndim - 1)), found, self._known)
            self._known, self._ages[is_due] = found, 0
        self._ages += 1
        actions: NDArray[Any] = self._known[every, self._ages - 1]
        return actions

    def _average(self, newest: NDArray[Any]) -> NDArray[Any]:
        """Return the means over the last H predictions for this step; `_ages` counts from H."""
        length, steps = self._chunks.length, np.arange(self._chunks.length)
        if not len(self._known):
            self._known = np.repeat(newest[:, None], length, 1)
        self._known = np.concatenate([newest[:, None], self._known[:, :-1]], 1)
        # `clear` sets an age to H; afterward, it is H plus the number of predictions.
        self._ages += 1
        available = np.minimum(self._ages - length, length)[:, None]
        assert self._chunks.ensemble is not None
        # The predictions are numbered from the oldest of those that are available.
        exponents = -self._chunks.ensemble * (available - 1.0 - steps)
        exponents = np.where(steps < available, exponents, -np.inf)
        weights = np.exp(exponents - exponents.max(1, keepdims=True))
        weights /= weights.sum(1, keepdims=True)
        proposed = self._known[:, steps, steps].astype(np.float64)
        mean = (proposed * weights.reshape(*weights.shape, *[1] * (proposed.ndim - 2))).sum(1)
        averaged: NDArray[Any] = mean.astype(newest.dtype)
        return averaged


def planned(chunks: Chunks, predictions: NDArray[Any]) -> NDArray[Any]:
    """Return the actions (T, *shape) of an episode, given its steps' chunks (T, H, *shape)."""
    execution, steps = ChunkExecution(chunks), range(len(predictions))
    return np.concatenate([execution.act(1, predictions[at : at + 1].copy) for at in steps])
