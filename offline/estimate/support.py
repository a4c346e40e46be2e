"""Support: whether a log has actions like those of a policy, in states like those of the log.

The distance of an action in a state to the log is that to the nearest logged pair of a state and an
action of another episode: successive steps of one episode are alike. Each number of a state or an
action is divided by its standard deviation in the log. The mean squares over the numbers of a state
and over those of an action are added, so both count the same, however many numbers there are.

An action is supported if its distance is at most the 95 % quantile of the distances of the logged
actions, computed in the same way. Of the actions of the behavior policy, 95 % are thus supported.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

Floats = NDArray[np.float64]

QUANTILE: Final = 0.95
_QUERIES: Final = 2_000
_REFERENCES: Final = 20_000
_AT_ONCE: Final = 200


class Support:
    """Distances to the actions of one log."""

    def __init__(
        self,
        states: NDArray[np.floating[Any]],
        actions: NDArray[np.floating[Any]],
        episodes: NDArray[np.int64],
        seed: int = 0,
    ) -> None:
        """Compute the distances of the logged actions, of at most 2,000 rows with 20,000."""
        order = np.random.default_rng(seed).permutation(len(states))
        self._queries, self._references = np.sort(order[:_QUERIES]), np.sort(order[:_REFERENCES])
        self._states = _scaled(states, states)
        self._logged = np.asarray(actions, np.float64)
        self._episodes = episodes
        self.limit = float(np.quantile(self._distances(self._logged), QUANTILE))

    def of(self, actions: NDArray[np.floating[Any]]) -> float:
        """Return the fraction of actions (N, n) in the logged states that are supported."""
        return float((self._distances(actions) <= self.limit).mean())

    def _distances(self, actions: NDArray[np.floating[Any]]) -> Floats:
        """Return the distances of the actions in the states of the queries."""
        queries, references = self._queries, self._references
        points = np.hstack(
            [self._states[references], _scaled(self._logged, self._logged[references])]
        )
        asked = np.hstack([self._states[queries], _scaled(self._logged, actions[queries])])
        found = []
        for start in range(0, len(queries), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            distances = cdist(asked[part], points)
            same = self._episodes[queries[part], None] == self._episodes[references]
            found.append(np.where(same, np.inf, distances).min(1))
        return np.concatenate(found)


def _scaled(logged: NDArray[np.floating[Any]], values: NDArray[np.floating[Any]]) -> Floats:
    """Divide values by `logged`'s deviations (constants: 1) and by the root of n."""
    deviations = np.asarray(logged, np.float64).std(0)
    scale = np.where(deviations > 0, deviations, 1.0) * np.sqrt(logged.shape[1])
    found: Floats = np.asarray(values, np.float64) / scale
    return found
