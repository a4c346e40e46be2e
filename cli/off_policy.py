"""`mcaprl evaluate --data`: what policies are worth, from a log alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

from mcaprl.api.policies import policy_names, trained_policies
from mcaprl.cli.show import counted, print_table, progress
from mcaprl.recorder.dataset.calibration import calibration
from mcaprl.recorder.dataset.open import open_logs

if TYPE_CHECKING:
    from mcaprl.offline.estimate.off_policy import PolicyEstimates, StochasticPolicy
    from mcaprl.recorder.dataset.dataset import Dataset


def evaluate_from_log(
    names: Sequence[str],
    data: str,
    *,
    gamma: float = 0.97,
    epsilon: float = 0.0,
    updates: int = 10_000,
    seed: int,
    threads: int = 1,
) -> dict[str, Any]:
    """Ask every estimator about every policy.

    Args:
        names: `random`, or paths; of a run with several seeds each is asked about.
        data: file, folder or glob.
        gamma: discount of the returns.
        epsilon: probability with which the policies are to act at random.
        updates: of the model behind FQE, DR and WDR.
        seed: of the model and the resampling.
        threads: that read the logs.

    Returns:
        What `--json` prints.
    """
    from mcaprl.offline.estimate.fqe import FQEConfig
    from mcaprl.offline.estimate.off_policy import OffPolicyEvaluator
    from mcaprl.offline.estimate.ranking import ranking

    dataset = open_logs(data, threads=threads)
    policies = _policies(names, dataset)
    config = replace(FQEConfig(), gamma=gamma, updates=updates)
    evaluator = OffPolicyEvaluator(dataset, config, seed)
    found: list[PolicyEstimates] = []
    with progress("learning values", len(policies) * evaluator.updates_of_model) as advance:
        for name, policy in policies.items():
            found.append(evaluator.evaluate(policy, name, epsilon=epsilon, on_update=advance))
    estimates = [estimate for one in found for estimate in one.estimates]
    calibrated = calibration(dataset.behavior_probs, dataset.action_space)
    return {
        "data": data,
        "episodes": len(dataset.episodes),
        "gamma": gamma,
        "epsilon": epsilon,
        "behavior_return": evaluator.behavior_return,
        "behavior_interval": list(evaluator.behavior_interval),
        "behavior_calibration": calibrated and {**calibrated.to_json(), "text": str(calibrated)},
        "coverage": {one.policy: one.coverage for one in found},
        "estimates": [estimate.to_json() for estimate in estimates],
        "ranking": ranking(estimates) if len(policies) > 1 else None,
    }


def print_estimates(result: dict[str, Any]) -> None:
    """Show the result of `evaluate_from_log` as tables."""
    rows = [
        [
            estimate["policy"],
            estimate["estimator"],
            "" if estimate["value"] is None else f"{estimate['value']:.3f}",
            _interval(estimate["interval"]),
            f"{estimate['effective_sample_size']:.1f}",
            estimate["verdict"],
        ]
        for estimate in result["estimates"]
    ]
    print_table(
        f"{result['data']}: {counted(result['episodes'], 'episode')}, mean return discounted by"
        f" {result['gamma']}: {result['behavior_return']:.3f}"
        f" ({_interval(result['behavior_interval'])})",
        ["policy", "estimator", "value", "95 % interval", "effective episodes", "verdict"],
        rows,
    )
    coverage = ", ".join(f"{share:.0%} by {name}" for name, share in result["coverage"].items())
    click.echo(f"logged actions that the policies would take: {coverage}")
    if result["behavior_calibration"] is not None:
        click.echo(f"the log's behavior_prob speaks of {result['behavior_calibration']['text']}")
    if result["ranking"] is not None:
        order = result["ranking"]
        click.echo(f"best first, by {order['estimator']}: {', '.join(order['policies'])}")
        if not order["trusted"]:
            click.echo("no estimator has a verdict on all of them: do not choose by this order")


def _policies(names: Sequence[str], dataset: Dataset) -> dict[str, StochasticPolicy | None]:
    """The policies by the names that tables show, each made sure to fit the log."""
    shown = policy_names(names)
    found: dict[str, StochasticPolicy | None] = {}
    for name in dict.fromkeys(names):
        if name == "random":
            found[name] = None
            continue
        loaded = trained_policies(name, dataset)
        for policy in loaded:
            found[policy.name if len(loaded) > 1 else shown[name]] = policy
    return found


def _interval(interval: Sequence[float] | None) -> str:
    return "" if interval is None else f"{interval[0]:.3f} to {interval[1]:.3f}"
