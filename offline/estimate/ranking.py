"""Choosing between policies by their estimates, and how good such a choice was."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaprl.offline.estimate.off_policy import Estimate

PREFERENCE: Final = ("WDR", "WPDIS", "DR", "PDIS", "FQE")
"""Estimators to choose by: the first that has a verdict on all policies."""


def ranking(estimates: Sequence[Estimate]) -> dict[str, Any]:
    """Order policies by the most reliable estimator that trusts its answer about each of them.

    Returns:
        `estimator`; `policies`, best first; and `trusted`: false if no estimator has a verdict on
        all of them, and the order is that of FQE for want of a better.
    """
    for estimator in PREFERENCE:
        own = [estimate for estimate in estimates if estimate.estimator == estimator]
        if all(estimate.trusted for estimate in own):
            return {"estimator": estimator, "policies": _best_first(own), "trusted": True}
    own = [estimate for estimate in estimates if estimate.estimator == "FQE"]
    return {"estimator": "FQE", "policies": _best_first(own), "trusted": False}


def rank_correlation(estimated: NDArray[np.floating], true: NDArray[np.floating]) -> float:
    """Spearman's correlation: 1 if the estimates have the policies in their true order.

    Equal values share the mean of their ranks. NaN if all estimates or all true values are equal.

    >>> rank_correlation(np.array([1.0, 2.0, 3.0]), np.array([10.0, 30.0, 20.0]))
    0.5
    """
    first, second = _ranks(estimated), _ranks(true)
    if np.ptp(first) == 0 or np.ptp(second) == 0:
        return float("nan")
    return round(float(np.corrcoef(first, second)[0, 1]), 12)


def regret_at_1(estimated: NDArray[np.floating], true: NDArray[np.floating]) -> float:
    """What choosing the policy of the highest estimate costs, as a share of the range of values.

    (max V - V of the choice) / (max V - min V): 0 for the best policy, 1 for the worst.

    >>> regret_at_1(np.array([1.0, 5.0, 3.0]), np.array([10.0, 15.0, 20.0]))
    0.5
    """
    spread = float(np.ptp(true))
    if spread == 0:
        return 0.0
    return float(true.max() - true[estimated.argmax()]) / spread


def _best_first(estimates: Sequence[Estimate]) -> list[str]:
    ordered = sorted(estimates, key=lambda estimate: -(estimate.value or 0.0))
    return [estimate.policy for estimate in ordered]


def _ranks(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """(N,) ranks from 0; equal values share the mean of theirs."""
    below = (values[:, None] > values).sum(1)
    equal = (values[:, None] == values).sum(1)
    ranks: NDArray[np.float64] = below + (equal - 1) / 2
    return ranks
