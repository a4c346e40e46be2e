"""Other rewards for a dataset, from an expression with the columns of its transitions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.labels import labels_of
from mcaprl.recorder.format.spaces import observation_leaves
from mcaprl.recorder.mapping.expression import Expression


def relabeled(dataset: Dataset, reward: str) -> Dataset:
    """Return the same transitions with the reward that an expression has; see `mcaprl.relabel`."""
    columns, rows = _columns(dataset), dataset.frame_of_step
    count = len(rows) + len(dataset.episodes)
    following = np.minimum(np.arange(count) + 1, count - 1)
    expression = Expression(reward)
    if expression.names - columns.keys() and (labels := labels_of(dataset)) is not None:
        lengths = dataset.episode_lengths
        firsts = np.cumsum(lengths + 1) - lengths - 1
        columns = labels.rows_of(firsts.tolist(), lengths.tolist(), count) | columns
    found = expression.evaluate(columns, following)[rows].astype(np.float64)
    if not (finite := np.isfinite(found)).all():
        step = int(finite.argmin())
        raise UsageError(
            f"the reward '{reward}' is {found[step]} in transition {step}, and not finite in"
            f" {np.count_nonzero(~finite)} of {len(found)} transitions"
        )
    return dataset.with_rewards(found)


def _columns(dataset: Dataset) -> dict[str, NDArray[Any]]:
    """Return what an expression can use, by observation."""
    # Later names do not replace earlier ones.
    rows, count = dataset.frame_of_step, len(dataset.frame_of_step) + len(dataset.episodes)
    columns: dict[str, NDArray[Any]] = {}

    def add(name: str, values: NDArray[Any]) -> None:
        if name.isidentifier():
            columns.setdefault(name, values)

    def of_steps(values: NDArray[Any]) -> NDArray[Any]:
        # The last observation of an episode has no action; nothing reads this row.
        full = np.zeros((count, *values.shape[1:]), values.dtype)
        full[rows] = values
        return full

    actions = dataset.actions.reshape(len(rows), -1)
    add("action", of_steps(actions[:, 0] if actions.shape[1] == 1 else actions))
    add("reward", of_steps(dataset.rewards))
    add("terminated", of_steps(dataset.terminated))
    add("truncated", of_steps(dataset.truncated))
    leaves = observation_leaves(dataset.observation_space)
    for leaf in leaves:
        if leaf.encoding is None:
            values = np.asarray(leaf.of(dataset.frames)).reshape(count, -1)
            add(leaf.path[-1] if leaf.path else "observation", values)
            names = dataset.observation_names if len(leaves) == 1 else ()
            for index, name in enumerate(names):
                add(name, values[:, index])
    for name, info in dataset.infos.items():
        if info.ndim == 1 and info.dtype.kind in "biuf":
            add(name, np.ma.filled(info.astype(np.float64), np.nan))
    return columns
