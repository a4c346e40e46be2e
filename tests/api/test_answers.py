"""Tests of the line that says what a policy is worth, from estimates that are given."""

from __future__ import annotations

import pytest

from mcaprl.api.estimate import LogEstimates
from mcaprl.offline.estimate.box import BehaviorCheck
from mcaprl.offline.estimate.off_policy import Estimate, ranking


def found(*estimates: Estimate, check: BehaviorCheck | None = None) -> LogEstimates:
    """Return estimates from a log whose mean return is 5.0, from 4.0 to 6.0."""
    return LogEstimates(
        data="log",
        episodes=50,
        gamma=0.97,
        epsilon=0.0,
        behavior_return=5.0,
        behavior_interval=(4.0, 6.0),
        behavior_calibration=None,
        behavior_estimate=None,
        coverage={},
        estimates=estimates,
        ranking=ranking(estimates),
        behavior_check=check,
    )


def by_weights(low: float, high: float, verdict: str = "ok", policy: str = "cql") -> Estimate:
    return Estimate(policy, "WDR", (low + high) / 2, (low, high), 3.25, verdict)


@pytest.mark.parametrize(
    ("low", "high", "answer"),
    [
        (6.5, 7.5, "7.000 (6.500 to 7.500) by WDR: better than the log's 5.000; try it"),
        (1.0, 3.0, "2.000 (1.000 to 3.000) by WDR: worse than the log's 5.000; train on"),
        (
            5.0,
            9.0,
            "7.000 (5.000 to 9.000) by WDR: as good as the log's 5.000, as far as it",
        ),
    ],
)
def test_a_trusted_estimate_is_compared_with_the_log(low: float, high: float, answer: str) -> None:
    estimates = found(by_weights(low, high))
    assert estimates.answers()["cql"].startswith(answer)
    assert estimates.is_ranked


def test_without_a_trusted_estimate_nothing_is_claimed() -> None:
    refused = by_weights(6.5, 7.5, "refused: 3.2 effective episodes, 10 needed")
    model = Estimate("cql", "FQE", 9.0, None, 3.25, "no interval: unknown error")
    estimates = found(refused, model)
    answer = estimates.answers()["cql"]
    assert answer.startswith(
        "unknown, beside the log's 5.000: the log supports no estimate (at best 3.2"
    )
    assert not estimates.is_ranked
    # A policy without a trusted estimate beside one that has it.
    both = found(by_weights(6.5, 7.5), by_weights(1, 2, "refused: none", "bc"))
    assert both.answers()["bc"].startswith("unknown")
    assert not both.is_ranked


def test_a_model_orders_policies_of_a_box_if_it_is_right_about_the_log() -> None:
    model = Estimate("td3", "FQE", 9.0, None, None, "no interval: unknown error", spread=0.5)
    for predicted, passes in ((5.5, True), (8.0, False)):
        estimates = found(model, check=BehaviorCheck(predicted, 0.1, 5.0, (4.0, 6.0)))
        answer = estimates.answers()["td3"]
        assert estimates.is_ranked is passes
        assert answer.startswith("9.000 +- 0.500 over its seeds by FQE" if passes else "unknown")
